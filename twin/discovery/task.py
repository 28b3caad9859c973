"""Discovery of missing effects and identification of parameters, as the commands and `twin.api` do.

They print nothing and write nothing: what they return knows its files.
"""

import contextlib
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from table_io.clock import RealClock
from table_io.config.base import format_toml
from table_io.errors import InputError
from twin.discovery.build_verdict import (
    build_interval,
    build_parameter,
    build_sensors,
    build_verdict,
    format_reason,
)
from twin.discovery.cross_checks import fitted_gap
from twin.discovery.decisive_test import (
    DecideOptions,
    TestProposal,
    propose_decisive_test,
    read_recorded_test,
)
from twin.discovery.discover import Discovery, PreparedLog, discover_effects
from twin.discovery.identify import WINDOW_S, IdentificationResult, identify_parameters
from twin.discovery.law_search import LawProposal, is_explained, propose_law
from twin.discovery.least_squares import MapFunction
from twin.discovery.loading import load_logs, load_recordings
from twin.discovery.model_file import format_fitted_model, list_effect_files
from twin.discovery.parameters import FreeParameter, GapKey, TareKey, get_log
from twin.discovery.result import (
    ContactGap,
    CorrelatedPair,
    EstimatedParameter,
    IdentificationReport,
    IdentifiedGap,
    Interval,
    SubsetParameters,
    Verdict,
    WindowMisfit,
)
from twin.discovery.selection import ProgressCallback
from twin.discovery.sensor_checks import check_sensors
from twin.discovery.symbolic_regression import MISSING_MESSAGE, is_available
from twin.evidence.selection import Cancelled
from twin.laws.library import find_effect
from twin.model.config import ModelConfig
from twin.recording.reader import read_start
from twin.recording.run_paths import resolve_log_path
from twin.results.recordings import build_provenance
from twin.setup.run_config import read_model_template

MIN_THREADED_SAMPLES = 120_000  # of all logs; with fewer, threads do not pay
MAX_THREADS = 4  # limits memory: each thread holds its own motion
METHOD = (
    "least squares of the forces on the measured motion, corrected for the bias caused by noise of "
    "that motion; 95 % intervals from the scatter between forcing cycles"
)
GAPS_NOTE = "gaps belong to the test profile of each log, not to the model file"
PathLike = str | Path


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
class DiscoveredModel(ModelResult):
    """Verdict of a discovery, with the same fields as verdict.json, and the model with the effect.

    `verdict.effects` have id, confidence and parameters; `verdict.gap` the misfit before and after.
    `save_model(path)` writes the model file, `write(folder)` that, the files of proposed laws and
    verdict.json. `proposals` are the tests that would decide, the best first.
    """

    verdict: Verdict
    discovery: Discovery
    logs: tuple[PreparedLog, ...]
    law: LawProposal | None
    effect_files: Mapping[str, str]
    proposals: tuple[TestProposal, ...] = ()
    proposed_profile: str = ""

    @property
    def is_complete(self) -> bool:
        """False if the search was stopped early."""
        return self.discovery.selection.complete

    @property
    def is_decided(self) -> bool:
        """True if nothing is left open, or a law explains it."""
        is_law_sufficient = self.law is not None and self.law.is_sufficient
        return self.discovery.verdict.is_decided or is_law_sufficient

    def write(self, folder: Path, profile: Path | None = None) -> None:
        """Write verdict.json, model.toml, effect files and the proposed test to a folder.

        `profile` is the file of the proposed test, if it is not in the folder.
        """
        for name, text in self.effect_files.items():
            (folder / name).write_text(text, encoding="utf-8")
        self.save_model(folder / "model.toml")
        if self.verdict.decide is not None:
            path = profile or folder / self.verdict.decide.profile
            path.write_text(self.proposed_profile, encoding="utf-8")
        (folder / "verdict.json").write_text(self.verdict.to_json(), encoding="utf-8")


def discover(
    logs: Sequence[PathLike],
    model: PathLike = "snm",
    without: Sequence[str] = (),
    held_out: Sequence[PathLike] = (),
    decide: DecideOptions | None = None,
    report: ProgressCallback = lambda progress: None,
) -> DiscoveredModel:
    """Find the physical effect that a model is missing on recordings, and refit with it.

    Where no effect of the library explains them, a law is searched for. `without` excludes effects
    of the library; `held_out` logs are only judged on; with `decide` the test that would decide is
    proposed, too. InputError if a log cannot be used or an effect is unknown. `report` may raise
    `Cancelled`: the best result so far is returned; if there is none, it is raised.
    """
    clock = RealClock()
    start_s = clock.now()
    paths = [Path(log) for log in logs]
    start, config = read_model_template(str(model))
    for name in without:
        find_effect(name)
    # before the search: it must not be lost
    recorded_test = None if decide is None else read_recorded_test(paths, decide)
    prepared, notes = load_logs(paths)
    judged = load_logs([Path(log) for log in held_out])[0] if held_out else ()
    law = None
    with _open_mapper(prepared) as mapper:
        discovery = discover_effects(prepared, start, report, without, mapper)
        if discovery.selection.complete:
            with contextlib.suppress(Cancelled):  # the discovery is kept
                law = propose_law(discovery, report)
    if not ((law and law.is_sufficient) or is_explained(discovery) or is_available()):
        notes = (*notes, MISSING_MESSAGE)
    verdict = build_verdict(discovery, clock.now() - start_s, notes, judged, start, law)
    proposals: tuple[TestProposal, ...] = ()
    proposed_profile = ""
    if decide and recorded_test and discovery.selection.complete:
        with contextlib.suppress(Cancelled):
            verdict, proposals = propose_decisive_test(
                verdict, discovery, law, *recorded_test, decide, report
            )
        if proposals:
            proposed_profile = proposals[0].format_profile(decide.rig)
    result = collect_result(discovery, prepared, config, verdict, law, format_provenance(paths))
    return replace(result, proposals=proposals, proposed_profile=proposed_profile)


def collect_result(
    discovery: Discovery,
    logs: Sequence[PreparedLog],
    config: ModelConfig,
    verdict: Verdict,
    law: LawProposal | None = None,
    provenance_toml: str = "",
) -> DiscoveredModel:
    """Return a discovery with the texts of its files; `config` is the model as given."""
    model_toml, omitted = _format_discovered_model(discovery, logs, config, law)
    best = law.fitted if law else discovery.verdict.best
    return DiscoveredModel(
        model_toml + provenance_toml,
        verdict.model_copy(update={"notes": [*verdict.notes, *omitted]}),
        discovery,
        tuple(logs),
        law,
        list_effect_files(best.fit, law.laws if law else ()),
    )


def _format_discovered_model(
    discovery: Discovery,
    logs: Sequence[PreparedLog],
    config: ModelConfig,
    law: LawProposal | None,
) -> tuple[str, list[str]]:
    """Return (text of the model file with the effects or the law, notes on what it omits)."""
    best = law.fitted if law else discovery.verdict.best
    if law:
        provisional = "the law was found in these recordings and holds in its range alone"
    elif discovery.verdict.outcome in ("ambiguous", "unexplained"):
        provisional = format_reason(discovery)
    else:
        provisional = ""
    title = f"{config.title}; {' + '.join(best.names) or 'nothing added'}"
    names = ", ".join(log.signals.name for log in logs)
    return format_fitted_model(best.fit, title, config.citation, names, provisional, best.names)


def format_provenance(logs: Sequence[Path]) -> str:
    """Return the table [provenance] of a model that was identified from recordings, as TOML."""
    starts = {path: read_start(path) for path in map(resolve_log_path, logs)}
    return format_toml({"provenance": build_provenance(starts).model_dump()})


@contextlib.contextmanager
def _open_mapper(logs: Sequence[PreparedLog]) -> Iterator[MapFunction]:
    """Yield a threaded map for long logs, else `map`; kernels and array sums release the GIL."""
    if sum(log.signals.time_s.size for log in logs) < MIN_THREADED_SAMPLES:
        yield map
        return
    with ThreadPoolExecutor(min(os.cpu_count() or 1, MAX_THREADS)) as pool:
        yield pool.map


@dataclass(frozen=True, eq=False)
class FittedModel(ModelResult):
    """Model fitted to recordings; `report` is the content of identify.json.

    `parameters` are those of the specimen by name, with 95 % intervals in SI; `log_parameters` are
    the corrections of single logs (gaps, tare). The ends of an interval are None if too few
    cycles determine it. `rms_over_noise` is the misfit in multiples of the noise; `notes` include
    the warnings. `model_toml` is the text of a model file, which `save_model(path)` writes.
    """

    report: IdentificationReport
    log_parameters: Mapping[str, Interval]
    identification: IdentificationResult

    @property
    def parameters(self) -> Mapping[str, Interval]:
        return self.report.parameters

    @property
    def rms_over_noise(self) -> float:
        return self.report.rms_over_noise

    @property
    def undetermined(self) -> tuple[str, ...]:
        return tuple(self.report.not_determined)

    @property
    def converged(self) -> bool:
        return self.report.converged

    @property
    def notes(self) -> tuple[str, ...]:
        report = self.report
        at_bound = (f"{key} is at its bound" for key in report.at_bound)
        return (*report.notes, *report.warnings, *at_bound)


def identify(
    logs: Sequence[PathLike],
    model: PathLike = "snm",
    report: Callable[[str], None] = lambda stage: None,
) -> FittedModel:
    """Fit stiffness, damping, bumpers and gaps to recordings, starting from a model.

    InputError if a log holds too few usable samples or no measurement.
    """
    clock = RealClock()
    start_s = clock.now()
    start, config = read_model_template(str(model))
    report("reading")
    loaded = [*load_recordings([Path(log) for log in logs])]
    report("fitting the forces on the measured motion")
    result = identify_parameters(
        [entry.log for entry in loaded], [entry.blocks for entry in loaded], start
    )
    fit = result.fit
    # gaps and tare errors are those of single logs
    shared = {key: value for key, value in fit.values.items() if get_log(key) is None}
    names = ", ".join(entry.log.signals.name for entry in loaded)
    model_toml, omitted = format_fitted_model(
        replace(fit, values=shared), f"{config.title}; identified", METHOD, names
    )
    notes = [
        *(note for entry in loaded for note in entry.notes),
        *result.notes,
        *omitted,
        GAPS_NOTE,
    ]
    content = build_report(result, notes, str(model), clock.now() - start_s)
    log_parameters = {
        free.name: build_parameter(fit, free) for free in fit.free if get_log(free.key) is not None
    }
    model_toml += format_provenance([Path(log) for log in logs])
    return FittedModel(model_toml, content, log_parameters, result)


def build_report(
    result: IdentificationResult, notes: Sequence[str] = (), start: str = "", seconds: float = 0.0
) -> IdentificationReport:
    """Return the content of identify.json, in SI units."""
    fit, log_residuals = result.fit, result.problem.log_residuals
    names = [residuals.signals.name for residuals in log_residuals]
    units = {parameter.key: parameter.unit for parameter in fit.free}
    return IdentificationReport(
        method=METHOD,
        logs=names,
        parameters={
            free.name: _estimate_parameter(result, free)
            for free in fit.free
            if get_log(free.key) is None
        },
        gaps={name: _build_gap(result, log) for log, name in enumerate(names)},
        zeros={
            free.name: build_parameter(fit, free)
            for free in fit.free
            if isinstance(free.key, TareKey)
        },
        gap_offset=build_interval(*result.asymmetry, "m") if result.asymmetry else None,
        correlations=[
            CorrelatedPair(of=[first, second], value=value)
            for first, second, value in result.correlated_pairs
        ],
        rms_over_noise=result.rms_over_noise,
        converged=fit.converged,
        at_bound=[*map(str, fit.at_bound)],
        not_determined=[*map(str, result.undetermined)],
        sources=[
            SubsetParameters(
                source=part.source,
                entries=part.entry_count,
                converged=part.converged,
                parameters={
                    str(key): build_interval(*pair, units[key]) for key, pair in part.values.items()
                },
            )
            for part in result.subsets
        ],
        contacts=[
            ContactGap(
                **build_interval(gaps.value, gaps.std_error, "m").to_plain(),
                log=names[gaps.log],
                side=gaps.side,
                kind=gaps.kind,
                scatter=gaps.scatter,
                count=int(gaps.gaps.size),
                correction=float(gaps.depth.mean()),
            )
            for gaps in result.contact_gaps
        ],
        windows=[
            WindowMisfit(
                log=name,
                window_s=WINDOW_S,
                nrmse_start=pair[0],
                nrmse_identified=pair[1],
                noise_floor=floor,
            )
            for name, pair, floor in zip(
                names, result.window_errors, result.window_floors, strict=True
            )
            if pair
        ],
        sensors=build_sensors(
            check_sensors(log_residuals, fit, result.problem.is_explained_by(fit))
        ),
        warnings=[*result.warnings],
        notes=[*notes],
        start=start,
        seconds=seconds,
    )


def _estimate_parameter(result: IdentificationResult, free: FreeParameter) -> EstimatedParameter:
    """Return a parameter with the cycles that determine it, if limited, and the start model's."""
    fit = result.fit
    estimate = EstimatedParameter(**build_parameter(fit, free).to_plain())
    count = fit.block_counts.get(free.key, math.inf)
    if math.isfinite(count):
        estimate.cycles = count
    start_value = result.start.values.get(free.keys[0])
    if start_value is not None:
        sd = fit.interval_error(free.key)
        difference = fit.values[free.key] - start_value
        estimate.start = start_value
        estimate.deviations = difference / sd if 0 < sd < math.inf else None
    return estimate


def _build_gap(result: IdentificationResult, log: int) -> IdentifiedGap:
    """Return the total gap of a log in m: stated, and with contact the fitted one."""
    residuals = result.problem.log_residuals[log]
    right, left = (fitted_gap(residuals, result.fit, side) for side in ("right", "left"))
    signals = residuals.signals
    stated = None if signals.measured_sides else sum(signals.gaps_m)
    gap = IdentifiedGap(stated=stated, unit="m", right=right, left=left)
    key = GapKey(log)
    if key in result.fit.std_errors:
        total = build_interval(right + left, 2 * result.fit.interval_error(key), "m")
        gap.value = total.value
        gap.low = total.low
        gap.high = total.high
    return gap
