"""The Python interface for notebooks and scripts: everything public is in this module.

>>> from twin.api import discover, identify, import_data, open_log, replay, run_simulated, simulate
>>> log = run_simulated("quickstart", "runs/first")      # a test on the simulated table
>>> log["rel_disp_m"], log.twin["rel_disp_m"]            # u measured, u of the twin; m, (sample,)
>>> fitted = identify([log.path])
>>> fitted.parameters["stiffness"].value                 # N/m
>>> discover([log.path]).verdict.verdict                 # none, named, ambiguous or unexplained

Profiles, models and tables are names of shipped files or paths of TOML files. Values are SI, right
is positive. A user's mistake raises `InputError`, whose fields state where, what, what is allowed
and what to do. Nothing is overwritten: an output folder must be new or empty; without one, a new
folder `runs/<date>-<time>-<name>` is made.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from table_io.clock import RealClock
from table_io.config.folders import resolve_config
from table_io.errors import InputError
from twin.discovery.discover import discover_effects
from twin.discovery.identify import identify_parameters
from twin.discovery.loading import load_logs, load_recordings
from twin.discovery.parameters import get_log
from twin.discovery.serialize import model_to_toml, parameter_to_json, verdict_to_json
from twin.earthquakes.result import DriveResult, TableTwinResult
from twin.earthquakes.task import TableDriveOptions, TableTwinOptions, compute_drive, identify_table
from twin.exchange.import_table import ImportOptions, import_table
from twin.laws.library import find_effect
from twin.log import Log, open_log
from twin.replay.pipeline_replay import RecordedRun, SampleRange, replay_recording
from twin.results.contracts import Interval, Verdict
from twin.results.recordings import read_recorded_config
from twin.results.summary import dump_contract
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_model_template, read_run_config
from twin.setup.unpaced import play_unpaced, simulate_ideal
from twin.setup.warm_up import compile_kernels
from twin.studies.maps.results import open_study

__all__ = [
    "DiscoveredModel",
    "DriveResult",
    "FittedModel",
    "InputError",
    "Interval",
    "Log",
    "TableDriveOptions",
    "TableTwinOptions",
    "TableTwinResult",
    "Verdict",
    "compute_drive",
    "discover",
    "identify",
    "identify_table",
    "import_data",
    "open_log",
    "open_study",
    "replay",
    "run_simulated",
    "simulate",
]

PathLike = str | Path
LOG_FILE = "run.mcap"


def simulate(profile: PathLike, out: PathLike | None = None, model: PathLike | None = None) -> Log:
    """Simulate the model alone on the ideal drive of a test; return its log in folder `out`.

    The table follows the drive exactly and there is no noise: `log.twin` has the response,
    `log.prc["twin_eta_d"]` and others the curves, (point,). InputError for a faulty profile or
    model.
    """
    config = read_run_config(Path(profile), None, _as_name(model))
    compile_kernels(config)
    folder, run = _make_folder(out, f"{config.name}-model")
    simulate_ideal(config, run, folder / LOG_FILE, lambda _: None)
    return open_log(folder)


def run_simulated(
    profile: PathLike,
    out: PathLike | None = None,
    model: PathLike | None = None,
    table: PathLike | None = None,
) -> Log:
    """Run a test on a simulated table as fast as possible; return its log in folder `out`.

    The table has sensors with noise, a servo, and what its rig file `table` hides; `model` is that
    of the twin. InputError if the test exceeds the limits of the table, or the table is real.
    """
    config = read_run_config(Path(profile), _as_name(table), _as_name(model))
    compile_kernels(config, table=True)
    folder, run = _make_folder(out, config.name)
    play_unpaced(config, run, folder / LOG_FILE, lambda: None, lambda _: None)
    return open_log(folder)


def replay(log: PathLike, out: PathLike | None = None, model: PathLike | None = None) -> Log:
    """Recompute the twin on a recording, with another `model` if given; return the new log.

    With the recorded model its results equal the recorded ones to the bit. InputError if the log
    cannot be read or lacks the table's acceleration.
    """
    recorded = RecordedRun.open(open_log(log).path)
    recording = recorded.recording
    if "table_acc_m_s2" not in recording.start.channels:
        raise InputError(
            "not recorded, but it drives the twin",
            where=recording.path,
            key="table_acc_m_s2",
            remedy="import the table's acceleration too",
        )
    config = read_recorded_config(recording, _as_name(model))
    compile_kernels(config)
    folder, run = _make_folder(out, f"{config.name}-replay")
    span = SampleRange.all_samples(recording)
    replay_recording(recorded, config, folder / LOG_FILE, run, lambda _: None, span)
    return open_log(folder)


def import_data(
    file: PathLike,
    out: PathLike,
    columns: PathLike | None = None,
    profile: PathLike | None = None,
) -> Log:
    """Import a table of samples (CSV, xlsx, Parquet, MAT, ...) to the new log `out`; return it.

    `columns` is the file of a column map; without it the proposed map is taken, whose units and
    channels are in the log's events. `profile` states specimen, gaps and steps. InputError where
    the file leaves a question open, or `out` exists.
    """
    options = ImportOptions(
        profile=None if profile is None else resolve_config(Path(profile), "tests"),
        columns=None if columns is None else Path(columns),
        accept=columns is None,
    )
    import_table(Path(file), Path(out), options)
    return open_log(out)


@dataclass(frozen=True)
class ModelResult:
    """Model that results from recordings; `model_toml` is the text of its file."""

    model_toml: str

    def save_model(self, path: PathLike) -> Path:
        """Write the model file and return its path; InputError if it exists."""
        path = Path(path)
        if path.exists():
            raise InputError(
                "exists; files are never overwritten", where=path, remedy="give a new name"
            )
        path.write_text(self.model_toml, encoding="utf-8")
        return path


@dataclass(frozen=True)
class FittedModel(ModelResult):
    """Model fitted to recordings.

    `parameters` are those of the specimen by name, with 95 % intervals in SI; `log_parameters` are
    the corrections of single logs (gaps, tare). An interval is None if too few
    cycles determine it. `rms_over_noise` is the misfit in multiples of the noise; `notes` include
    the warnings. `model_toml` is the text of a model file, which `save_model(path)` writes.
    """

    parameters: Mapping[str, Interval]
    log_parameters: Mapping[str, Interval]
    rms_over_noise: float
    undetermined: tuple[str, ...]
    notes: tuple[str, ...]
    converged: bool


def identify(logs: Sequence[PathLike], model: PathLike = "snm") -> FittedModel:
    """Fit stiffness, damping, bumpers and gaps to recordings, starting from a model.

    InputError if a log holds too few usable samples or no measurement.
    """
    start, config = read_model_template(str(model))
    loaded = [*load_recordings([Path(log) for log in logs])]
    result = identify_parameters(
        [entry.log for entry in loaded], [entry.blocks for entry in loaded], start
    )
    shared = {key: value for key, value in result.fit.values.items() if get_log(key) is None}
    names = ", ".join(entry.log.signals.name for entry in loaded)
    text, omitted = model_to_toml(
        replace(result.fit, values=shared), f"{config.title}; identified", "identify", names
    )
    intervals = {
        parameter: Interval.model_validate_json(
            dump_contract(Interval, parameter_to_json(result.fit, parameter))
        )
        for parameter in result.fit.free
    }
    return FittedModel(
        text,
        {p.name: value for p, value in intervals.items() if get_log(p.key) is None},
        {p.name: value for p, value in intervals.items() if get_log(p.key) is not None},
        result.rms_over_noise,
        tuple(map(str, result.undetermined)),
        (
            *(note for entry in loaded for note in entry.notes),
            *result.notes,
            *omitted,
            *result.warnings,
            *(f"{key} is at its bound" for key in result.fit.at_bound),
        ),
        result.fit.converged,
    )


@dataclass(frozen=True)
class DiscoveredModel(ModelResult):
    """Verdict of a discovery, with the same fields as verdict.json, and the model with the effect.

    `verdict.effects` have id, confidence and parameters; `verdict.gap` the misfit before and after.
    `save_model(path)` writes the model file.
    """

    verdict: Verdict


def discover(
    logs: Sequence[PathLike],
    model: PathLike = "snm",
    without: Sequence[str] = (),
    held_out: Sequence[PathLike] = (),
) -> DiscoveredModel:
    """Find the physical effect that a model is missing on recordings, and refit with it.

    `without` excludes effects of the library; `held_out` logs are only judged on. InputError if a
    log cannot be used or an effect is unknown.
    """
    clock = RealClock()
    start_s = clock.now()
    start, config = read_model_template(str(model))
    for name in without:
        find_effect(name)
    prepared, notes = load_logs([Path(log) for log in logs])
    judged = load_logs([Path(log) for log in held_out])[0] if held_out else ()
    discovery = discover_effects(prepared, start, lambda _: None, without, map)
    verdict = verdict_to_json(discovery, clock.now() - start_s, notes, judged, start)
    best = discovery.verdict.best
    title = f"{config.title}; {' + '.join(best.names) or 'nothing added'}"
    names = ", ".join(log.signals.name for log in prepared)
    provisional = verdict["why"] if verdict["verdict"] in ("ambiguous", "unexplained") else ""
    text, omitted = model_to_toml(best.fit, title, config.citation, names, provisional, best.names)
    verdict["notes"] += omitted
    return DiscoveredModel(text, Verdict.model_validate_json(dump_contract(Verdict, verdict)))


def _as_name(name: PathLike | None) -> str | None:
    return None if name is None else str(name)


def _make_folder(out: PathLike | None, name: str) -> tuple[Path, str]:
    return make_run_folder(None if out is None else Path(out), name)
