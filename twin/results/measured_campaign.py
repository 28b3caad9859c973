"""Measured PRC points and motions of a campaign, by gap."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from table_io.block import Label
from table_io.errors import InputError
from table_io.records import PrcPoint, StepAdded
from twin.recording.reader import read_recording
from twin.recording.run_paths import resolve_log_path
from twin.results import report_data
from twin.results.paper_cases import GAPS, name_gap
from twin.results.players import SystemMotion
from twin.results.recordings import read_recorded_config
from twin.results.report_data import ReportData, build_report_data
from twin.results.summary import summarise


@dataclass(slots=True)
class MeasuredCampaign:
    """Measured points and their runs, keyed by the paper's name of the gap."""

    points: dict[str, list[PrcPoint]] = field(default_factory=dict)
    runs: dict[str, list[ReportData]] = field(default_factory=dict)

    @property
    def scale(self) -> tuple[float, float] | None:
        """Normalization (u* in m, a* in m/s2) of the measured points."""
        for run in (run for runs in self.runs.values() for run in runs):
            return run.summary.stars
        return None

    def extract_motion(
        self, name: str, frequency_hz: float, direction: str, cycles: int
    ) -> SystemMotion | None:
        """Return the last measured cycles of a step, or None if not measured.

        Time starts at the first zero upcrossing of the table acceleration, as in the model.
        """
        for run in self.runs.get(name, ()):
            for step in run.steps:
                if step.direction != direction or abs(step.frequency_hz - frequency_hz) > 1e-9:
                    continue
                motion = report_data.extract_step_motion(run, "meas", step.index)
                if motion is not None and np.isfinite(motion.u).any():
                    delay_s = _upcrossing_s(run, step.index, frequency_hz, cycles)
                    motion = motion.select_last(cycles)
                    return replace(motion, time=motion.time - delay_s)
        return None


def _upcrossing_s(run: ReportData, step: int, frequency_hz: float, cycles: int) -> float:
    """Return the time in s from the start of the last `cycles` to the first upcrossing of A."""
    chunks = []
    for block in run.measured_blocks:
        in_step = (block.step == step) & (block.label == Label.MEASURE)
        chunks.append(block.channel("table_acc_m_s2")[in_step])
    table_acc, rate = np.concatenate(chunks), run.recording.start.rate_hz
    table_acc = np.nan_to_num(table_acc[-round(cycles * rate / frequency_hz) :])
    rotation = np.exp(-2j * np.pi * frequency_hz * np.arange(table_acc.size) / rate)
    phase = np.angle(np.sum(table_acc * rotation)) + np.pi / 2  # of A = a sin(w t + phase)
    return float((-phase / (2 * np.pi)) % 1.0 / frequency_hz)


def find_logs(paths: list[Path]) -> list[Path]:
    """Return every run.mcap in these logs and folders; raise InputError for a path without one."""
    logs: list[Path] = []
    for path in paths:
        path_logs = sorted(path.rglob("run.mcap")) if path.is_dir() else [path]
        if not path_logs:
            raise InputError(
                "contains no run.mcap",
                where=f"--campaign {path}",
                remedy="give logs or folders of runs",
            )
        logs += path_logs
    return logs


def load_measured_campaign(paths: list[Path]) -> MeasuredCampaign:
    """Load the measured points of the recordings; raise InputError for a gap not in the paper."""
    campaign = MeasuredCampaign()
    for path in find_logs(paths):
        recording = read_recording(resolve_log_path(path))
        run_config = read_recorded_config(recording)
        name = name_gap(run_config.profile.specimen.gap_mm)
        if name not in GAPS:
            raise InputError(
                f"total gap {run_config.profile.specimen.gap_mm:g} mm is not in the paper",
                where=path,
                allowed=", ".join(GAPS),
                remedy="omit this recording",
            )
        run = build_report_data(recording, summarise(recording, run_config.parameters))
        if run.source != "measured":
            raise InputError(
                "simulation without measurement", where=path, remedy="give runs on a table"
            )
        campaign.runs.setdefault(name, []).append(run)
        visits = {step.step for step in recording.records(StepAdded)}  # not part of the PRC grid
        points = [point for point in recording.records(PrcPoint) if point.step not in visits]
        campaign.points.setdefault(name, []).extend(points)
    return campaign
