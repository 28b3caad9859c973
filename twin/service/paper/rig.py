"""What recordings of a campaign measured: PRC points and motions by gap."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from table_io.block import Label
from table_io.card import BadInput
from table_io.records import Decided, Point
from twin.service import evidence
from twin.service.evidence import Run, gather
from twin.service.paper.cases import GAPS
from twin.service.paper.players import Motion
from twin.service.recordings import recorded_bundle
from twin.service.summary import summarise
from twin.stream.folder import log_path
from twin.stream.recording import read


@dataclass(slots=True)
class Rig:
    """The measured points by the paper's name of the gap, and the runs that they come from."""

    points: dict[str, list[Point]] = field(default_factory=dict)
    runs: dict[str, list[Run]] = field(default_factory=dict)

    @property
    def stars(self) -> tuple[float, float] | None:
        """(u* in m, a* in m/s2) by which the measured points are divided."""
        for run in (run for runs in self.runs.values() for run in runs):
            return run.summary["u_star_m"], run.summary["a_star_m_s2"]
        return None

    def motion(
        self, name: str, frequency_hz: float, direction: str, cycles: int
    ) -> tuple[Motion, float] | None:
        """(the last measured cycles of a step, the force above which it is contact), if any.

        Time runs from the first zero upcrossing of the table's acceleration, as the model's does.
        """
        for run in self.runs.get(name, ()):
            for step in run.steps:
                if (
                    step["direction"] != direction
                    or abs(step["frequency_hz"] - frequency_hz) > 1e-9
                ):
                    continue
                found = evidence.motion(run, "meas", step["index"])
                if found is not None and np.isfinite(found.u).any():
                    late = _upcrossing_s(run, step["index"], frequency_hz, cycles)
                    return _positions(found.last(cycles), run.contact_n, late), run.contact_n
        return None


def _upcrossing_s(run: Run, step: int, frequency_hz: float, cycles: int) -> float:
    """Time in s from the start of the last measured cycles to the first upcrossing of A there."""
    found = []
    for piece in run.streams["meas"]:
        held = (piece.step == step) & (piece.label == Label.MEASURE)
        found.append(piece.channel("table_acc_m_s2")[held])
    base, rate = np.concatenate(found), run.recording.start.rate_hz
    base = np.nan_to_num(base[-round(cycles * rate / frequency_hz) :])
    turn = np.exp(-2j * np.pi * frequency_hz * np.arange(base.size) / rate)
    phase = np.angle(np.sum(base * turn)) + np.pi / 2  # of A = a sin(w t + phase)
    return float((-phase / (2 * np.pi)) % 1.0 / frequency_hz)


def _positions(seen: evidence.Motion, contact_n: float, late_s: float) -> Motion:
    """A bumper stands where the mass does in contact; out of it nobody measures where it is."""
    v_r, v_l = (
        np.where(touch > contact_n, seen.u, np.nan) for touch in (seen.force_r, -seen.force_l)
    )
    return Motion(seen.time - late_s, seen.u, seen.v, seen.a, seen.force_r, seen.force_l, v_r, v_l)


def logs(paths: list[Path]) -> list[Path]:
    """Every run.mcap of these logs, runs and folders of runs; BadInput where there is none."""
    found: list[Path] = []
    for path in paths:
        inside = sorted(path.rglob("run.mcap")) if path.is_dir() else [path]
        if not inside:
            raise BadInput(f"--campaign {path}: no run.mcap in it; give logs or folders of runs")
        found += inside
    return found


def measured(paths: list[Path]) -> Rig:
    """What the recordings measured; a gap that the paper does not have is refused."""
    rig = Rig()
    for path in logs(paths):
        recording = read(log_path(path))
        bundle = recorded_bundle(recording)
        name = _name(bundle.profile.specimen.gap_mm)
        if name is None:
            raise BadInput(
                f"{path}: total gap {bundle.profile.specimen.gap_mm:g} mm; allowed: the paper's, "
                f"{', '.join(GAPS)}; leave this recording out"
            )
        run = gather(recording, summarise(recording, bundle.parameters))
        if run.who != "measured":
            raise BadInput(f"{path}: the model alone, nothing measured; give runs on a table")
        rig.runs.setdefault(name, []).append(run)
        visits = {one.step for one in recording.of(Decided)}  # no points of a curve
        points = [point for point in recording.of(Point) if point.step not in visits]
        rig.points.setdefault(name, []).extend(points)
    return rig


def _name(gap_mm: float) -> str | None:
    name = "G∞" if np.isinf(gap_mm) else f"G{gap_mm:g}"
    return name if name in GAPS else None
