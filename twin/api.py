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

from pathlib import Path

from table_io.errors import InputError
from twin.branches.task import BranchOptions, FollowedBranches, follow_branches
from twin.campaign.simulate_grid import GapOptions, SimulatedGaps, simulate_gaps
from twin.discovery.decide import DecidedTests, decide
from twin.discovery.decisive_test import DecideOptions
from twin.discovery.features.task import FeatureModel, discover_features
from twin.discovery.result import FeatureVerdict, IdentificationReport, Interval, Verdict
from twin.discovery.task import DiscoveredModel, FittedModel, discover, identify
from twin.earthquakes.result import DriveResult, TableTwinResult
from twin.earthquakes.task import TableDriveOptions, TableTwinOptions, compute_drive, identify_table
from twin.exchange.drive_file import DriveOptions, ExportedDrive, export_drive
from twin.exchange.export import Exported, ExportOptions, export_log
from twin.exchange.import_table import Imported, ImportOptions, import_data, import_table
from twin.log import Log, open_log
from twin.replay.pipeline_replay import RecordedRun, SampleRange, replay_recording
from twin.replay.verify import Verification, repair_log, verify
from twin.results.recordings import read_recorded_config
from twin.rig.calibrate import CalibratedSensor, CalibrationOptions, calibrate
from twin.rig.check import CheckedTest, check_test
from twin.rig.check_table import WiringCheckResult, check_table
from twin.setup.folders import make_run_folder
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced, simulate_ideal
from twin.setup.warm_up import compile_kernels
from twin.studies.maps.results import open_study
from twin.studies.maps.task import MapOptions, StoredMap, compute_map
from twin.studies.task import SimulatedSweeps, SweepOptions, simulate_sweeps

__all__ = [
    "BranchOptions",
    "CalibratedSensor",
    "CalibrationOptions",
    "CheckedTest",
    "DecideOptions",
    "DecidedTests",
    "DiscoveredModel",
    "DriveOptions",
    "DriveResult",
    "ExportOptions",
    "Exported",
    "ExportedDrive",
    "FeatureModel",
    "FeatureVerdict",
    "FittedModel",
    "FollowedBranches",
    "GapOptions",
    "IdentificationReport",
    "ImportOptions",
    "Imported",
    "InputError",
    "Interval",
    "Log",
    "MapOptions",
    "SimulatedGaps",
    "SimulatedSweeps",
    "StoredMap",
    "SweepOptions",
    "TableDriveOptions",
    "TableTwinOptions",
    "TableTwinResult",
    "Verdict",
    "Verification",
    "WiringCheckResult",
    "calibrate",
    "check_table",
    "check_test",
    "compute_drive",
    "compute_map",
    "decide",
    "discover",
    "discover_features",
    "export_drive",
    "export_log",
    "follow_branches",
    "identify",
    "identify_table",
    "import_data",
    "import_table",
    "open_log",
    "open_study",
    "repair_log",
    "replay",
    "run_simulated",
    "simulate",
    "simulate_gaps",
    "simulate_sweeps",
    "verify",
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


def _as_name(name: PathLike | None) -> str | None:
    return None if name is None else str(name)


def _make_folder(out: PathLike | None, name: str) -> tuple[Path, str]:
    return make_run_folder(None if out is None else Path(out), name)
