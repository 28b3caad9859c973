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

from table_io.errors import InputError
from twin.archive.catalog import Catalog, update_catalog
from twin.archive.fleet import Fleet, FleetOptions, run_fleet
from twin.archive.notes import RunNotes, note_run
from twin.archive.query import index_runs
from twin.archive.run_row import RunRow
from twin.branches.task import BranchOptions, FollowedBranches, follow_branches
from twin.campaign.simulate_grid import GapOptions, SimulatedGaps, simulate_gaps
from twin.discovery.decide import DecidedTests, decide
from twin.discovery.decisive_test import DecideOptions
from twin.discovery.features.task import FeatureModel, discover_features
from twin.discovery.result import FeatureVerdict, IdentificationReport, Interval, Verdict
from twin.discovery.task import DiscoveredModel, FittedModel, discover, identify
from twin.earthquakes.result import DriveResult, TableTwinResult
from twin.earthquakes.spectrum_record import (
    RecordShape,
    SpectrumRecordOptions,
    compute_spectrum_records,
)
from twin.earthquakes.task import TableDriveOptions, TableTwinOptions, compute_drive, identify_table
from twin.exchange.drive_file import DriveOptions, ExportedDrive, export_drive
from twin.exchange.export import Exported, ExportOptions, export_log
from twin.exchange.import_table import Imported, ImportOptions, import_data, import_table
from twin.inspection.curves import RecordedCurves, read_curves
from twin.inspection.folder_report import write_folder_report
from twin.live.run_command import run_simulated
from twin.log import Log, open_log
from twin.replay.task import ReplayedLog, replay
from twin.replay.verify import Verification, repair_log, verify
from twin.report.compare_command import ComparedRuns, compare_runs
from twin.rig.calibrate import CalibratedSensor, CalibrationOptions, calibrate
from twin.rig.check import CheckedTest, check_test
from twin.rig.check_table import WiringCheckResult, check_table
from twin.rig.tare import TaredRig, TareOptions, tare
from twin.simulation.task import simulate
from twin.studies.maps.results import open_study
from twin.studies.maps.task import MapOptions, StoredMap, compute_map
from twin.studies.task import SimulatedSweeps, SweepOptions, simulate_sweeps

__all__ = [
    "BranchOptions",
    "CalibratedSensor",
    "CalibrationOptions",
    "Catalog",
    "CheckedTest",
    "ComparedRuns",
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
    "Fleet",
    "FleetOptions",
    "FollowedBranches",
    "GapOptions",
    "IdentificationReport",
    "ImportOptions",
    "Imported",
    "InputError",
    "Interval",
    "Log",
    "MapOptions",
    "RecordShape",
    "RecordedCurves",
    "ReplayedLog",
    "RunNotes",
    "RunRow",
    "SimulatedGaps",
    "SimulatedSweeps",
    "SpectrumRecordOptions",
    "StoredMap",
    "SweepOptions",
    "TableDriveOptions",
    "TableTwinOptions",
    "TableTwinResult",
    "TareOptions",
    "TaredRig",
    "Verdict",
    "Verification",
    "WiringCheckResult",
    "calibrate",
    "check_table",
    "check_test",
    "compare_runs",
    "compute_drive",
    "compute_map",
    "compute_spectrum_records",
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
    "index_runs",
    "note_run",
    "open_log",
    "open_study",
    "read_curves",
    "repair_log",
    "replay",
    "run_fleet",
    "run_simulated",
    "simulate",
    "simulate_gaps",
    "simulate_sweeps",
    "tare",
    "update_catalog",
    "verify",
    "write_folder_report",
]
