"""Recent samples of a run: traces, margins of peaks to limits, table level and twin errors."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Block, Float1D, Float2D
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Comparison
from table_io.units import GRAVITY_M_S2, UNITS
from twin.viewer.motion import extract_motion, extract_track
from twin.viewer.view_model import TwinErrors

WINDOW_S = 1.0
TRACE_HZ = 200.0  # samples kept per second
MAX_TRACE_S = 40.0  # three cycles at the lowest frequency of most tests
MAX_TRACE_POINTS = 400  # of one history as returned
TWIN_TRACKS = ("free", "window")
VELOCITY_WINDOW_S = 0.01  # difference interval of the velocity, as in protection
MAX_CYCLE_S = 20.0  # samples kept for the level, at most one cycle at 0.05 Hz


@dataclass(slots=True)
class RecentSamples:
    """Contiguous measured blocks and comparisons, as far back as needed."""

    blocks: deque[Block] = field(default_factory=deque)
    comparisons: deque[Comparison] = field(default_factory=deque)

    @property
    def end(self) -> int:
        return self.blocks[-1].end if self.blocks else 0

    def add(self, block: Block, cycle_s: float) -> None:
        """Add a block; keep `WINDOW_S` or one cycle of `cycle_s`, whichever is longer."""
        if self.blocks and (block.index != self.end or block.channels != self.blocks[-1].channels):
            self.blocks.clear()
        self.blocks.append(block)
        kept_samples = block.rate_hz * min(max(WINDOW_S, cycle_s), MAX_CYCLE_S)
        while self.blocks[0].end < block.end - kept_samples:
            self.blocks.popleft()

    def add_comparison(self, comparison: Comparison, rate_hz: float) -> None:
        """Add a comparison; keep those of the last `WINDOW_S`."""
        if self.comparisons and (
            comparison.index < self.comparisons[-1].index
            or comparison.channels != self.comparisons[-1].channels
        ):
            self.comparisons.clear()
        self.comparisons.append(comparison)
        while self.comparisons[0].index < comparison.index - WINDOW_S * rate_hz:
            self.comparisons.popleft()

    def last_second(self) -> tuple[tuple[str, ...], Float2D]:
        """Return (channels, values (channel, sample)) of the last second, SI."""
        if not self.blocks:
            return (), np.empty((0, 0))
        rate = self.blocks[-1].rate_hz
        newest = [block.values for block in self.blocks if block.end > self.end - WINDOW_S * rate]
        return self.blocks[-1].channels, np.concatenate(newest, axis=1)

    def table_level(self, frequency_hz: float) -> tuple[float, float] | None:
        """Return (fundamental, peak) of the table acceleration over whole cycles, in m/s2.

        None if the step has not been held for one cycle yet.
        """
        steady = list(_select_steady(self.blocks))
        if not steady or "table_acc_m_s2" not in steady[0].channels:
            return None
        acc = np.concatenate([block.channel("table_acc_m_s2") for block in reversed(steady)])
        cycle = steady[0].rate_hz / frequency_hz
        if acc.size < cycle:
            return None
        count = round(acc.size // cycle * cycle)
        if not np.isfinite(acc[-count:]).all():
            return None
        rotation = np.exp(-2j * np.pi * np.arange(count) / cycle)
        held = acc[-count:]
        return float(2.0 * abs(held @ rotation) / count), float(np.abs(held).max())

    def twin_errors(self) -> dict[str, TwinErrors]:
        """Return (RMS, RMS error of restarted twin, of free twin) by channel, last second, SI."""
        if not self.comparisons:
            return {}
        count = sum(comparison.count for comparison in self.comparisons)
        sums = np.array(
            [
                (comparison.measured_ss, comparison.window_error_ss, comparison.free_error_ss)
                for comparison in self.comparisons
            ]
        ).sum(axis=0)
        rms = np.sqrt(sums / max(count, 1))
        return {
            name: TwinErrors(*rms[:, k].tolist())
            for k, name in enumerate(self.comparisons[-1].channels)
        }


def _select_steady(blocks: Iterable[Block]) -> Iterable[Block]:
    """Yield the newest blocks that lie entirely in held cycles of one step, newest first."""
    step = None
    for block in reversed(list(blocks)):
        step = int(block.step[-1]) if step is None else step
        if not ((block.cycle >= 0).all() and (block.step == step).all()):
            return
        yield block


@dataclass(slots=True)
class TraceBuffer:
    """Decimated samples by track: measured, free (free-running twin), window (restarted twin)."""

    parts: dict[str, deque[Float2D]] = field(default_factory=dict)

    def add(self, block: Block) -> None:
        """Add a block of the measurement or of the twins; older ones after newer ones clear."""
        tracks = (
            {"measured": block}
            if block.stream == "meas"
            else {name: extract_track(block, name) for name in TWIN_TRACKS}
        )
        stride = max(round(block.rate_hz / TRACE_HZ), 1)
        for name, track in tracks.items():
            motion = extract_motion(track)
            rows = np.stack([motion.index, motion.u, motion.force_r + motion.force_l])
            rows = rows[:, motion.index % stride == 0]
            if not rows.size:
                continue
            parts = self.parts.setdefault(name, deque())
            if parts and rows[0, 0] <= parts[-1][0, -1]:
                parts.clear()
            parts.append(rows)
            while parts[0][0, 0] < rows[0, -1] - MAX_TRACE_S * block.rate_hz:
                parts.popleft()

    def select_last(self, samples: float) -> dict[str, Float2D]:
        """Return (index, u in m, force in N) by track over the last `samples` of the measurement.

        Each is (3, point) with at most `MAX_TRACE_POINTS` points.
        """
        joined = {name: np.concatenate(parts, axis=1) for name, parts in self.parts.items()}
        if "measured" not in joined:
            return {}
        first = joined["measured"][0, -1] - samples
        selected = {name: rows[:, rows[0] >= first] for name, rows in joined.items()}
        stride = -(-selected["measured"].shape[1] // MAX_TRACE_POINTS)
        return {name: rows[:, ::stride] for name, rows in selected.items()}


@dataclass(frozen=True, slots=True)
class LiveMargin:
    """Peak and limit of one quantity in `unit`; `limit_source` names the limit. NaN: data lost."""

    name: str
    peak: float
    limit: float
    unit: str
    limit_source: str

    @property
    def share(self) -> float:
        return self.peak / self.limit


def compute_live_margins(
    rig: RigConfig, profile: Profile, tare: dict[str, float], recent: RecentSamples
) -> list[LiveMargin]:
    """Compute one margin per sensor, then velocity and force of the table; the tightest limit each.

    A sensor range applies to the reading including tare, a table limit to the motion. Velocity and
    force as in `table_io.safety.sample_checks`.
    """
    channels, values = recent.last_second()
    limits = rig.limits
    table_limits = {
        "drive_disp_m": (limits.stroke_mm * 1e-3, "stroke"),
        "table_disp_m": (limits.stroke_mm * 1e-3, "stroke"),
        "table_acc_m_s2": (limits.acceleration_g * GRAVITY_M_S2, "table"),
    }
    samples_by_channel = dict(zip(channels, values, strict=True))
    rows = []
    for sensor in rig.sensors:
        if sensor.channel not in samples_by_channel:
            continue
        samples = samples_by_channel[sensor.channel]
        peaks = [(_peak(samples + tare.get(sensor.channel, 0.0)), sensor.range_si, "range")]
        if sensor.channel in table_limits:
            peaks.append((_peak(samples), *table_limits[sensor.channel]))
        peak, limit, limit_source = max(peaks, key=lambda candidate: candidate[0] / candidate[1])
        scale = UNITS[sensor.unit][1]
        rows.append(
            LiveMargin(sensor.channel, peak / scale, limit / scale, sensor.unit, limit_source)
        )
    if {"table_disp_m", "table_acc_m_s2"} <= samples_by_channel.keys():
        span_samples = round(VELOCITY_WINDOW_S * recent.blocks[-1].rate_hz)
        displacement = samples_by_channel["table_disp_m"]
        velocity = (
            (displacement[span_samples:] - displacement[:-span_samples]) * 1e3 / VELOCITY_WINDOW_S
        )
        rows.append(LiveMargin("velocity", _peak(velocity), limits.velocity_mm_s, "mm/s", "table"))
        force = rig.moving_mass_kg * samples_by_channel["table_acc_m_s2"]
        if "mass_acc_m_s2" in samples_by_channel:
            force = force + profile.specimen.mass_kg * np.nan_to_num(
                samples_by_channel["mass_acc_m_s2"]
            )
        rows.append(LiveMargin("force", _peak(force) * 1e-3, limits.force_kn, "kN", "table"))
    return rows


def _peak(samples: Float1D) -> float:
    """Return the largest magnitude; NaN if all samples are lost."""
    known = samples[np.isfinite(samples)]
    return float(np.abs(known).max()) if known.size else float("nan")
