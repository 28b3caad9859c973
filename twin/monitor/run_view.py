"""What is shown of a running test: rows, curves and words, computed once from its state.

The terminal, the web page and snapshots lay out these values; none works them out again. A tone is
"good", "warn", "bad", "dim" or "": each surface has its own colours for them.
"""

import math
from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter

from table_io.block import Float2D, Label
from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import (
    LABEL_TEXTS,
    Agreement,
    CycleExtremes,
    Estimate,
    Extremes,
    JumpForecast,
    Level,
    NormalizedResponse,
    Timing,
)
from table_io.units import GRAVITY_M_S2
from twin.monitor.recent import LiveMargin, compute_live_margins
from twin.monitor.run_state import EventLine, LiveRunState
from twin.viewer.view_model import (
    FrequencyCurve,
    ParameterRow,
    ResponseQuantity,
    TwinRow,
    describe_channel,
    list_drift_rows,
    list_orbit_curves,
    list_prc_curves,
    list_twin_rows,
)

SILENT_S = 2.0  # without data; blocks arrive a hundred times per second
DEFAULT_TOLERANCE = 0.02  # of the level, where the profile of a run cannot be read
WARN_SHARE, ALARM_SHARE = 0.7, 0.9  # of a limit
TRACE_CYCLES = 3.0  # shown of the last cycles
IDLE_TRACE_S = 2.0  # shown outside a step
STATE_TONES = {
    "running": "good", "checking": "good", "armed": "good", "holding": "warn", "stopping": "warn",
    "fault": "bad", "waiting": "warn", "following": "good", "astray": "bad", "left": "bad",
}  # fmt: skip
STATE_TEXTS = {"astray": "drive lost", "left": "ended in motion"}  # shown for recorded states
eta_d: ResponseQuantity = attrgetter("eta_d")
eta_a: ResponseQuantity = attrgetter("eta_a")


@dataclass(frozen=True, slots=True)
class SessionStatus:
    """Session status: connected components, time without data, rights and command of the user."""

    components: frozenset[str] = frozenset()
    silent_s: float = 0.0
    may_command: bool = False  # the user may send commands
    pending_command: str = ""  # awaits confirmation


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a test is: state in words, step from 1, held cycle from 1, time left in s.

    `phase` places what is outside the steps: "before", "between" or "after" them. A displacement
    history has `windows` instead of steps.
    """

    state: str
    tone: str
    is_live: bool  # data arrive and the test has not ended
    held: bool
    activity: str
    time_s: float
    progress: float | None
    left_s: float | None
    step: int | None
    steps: int
    frequency_hz: float | None
    direction: str
    cycle: int | None
    cycles: int | None
    phase: str
    window: int | None
    windows: int | None
    ended: bool
    reason: str


@dataclass(frozen=True, slots=True)
class TableLevel:
    """Level of the table in g against demand, with its tolerance and the protection's bounds.

    `current_g` is the fundamental, which is controlled, and `peak_g` the peak with all harmonics.
    `accepted`, `updates`, `correction` and `thd` are None before the step's first evaluation.
    """

    demanded_g: float
    current_g: float | None
    deviation: float | None
    tone: str
    tolerance: float
    alarm: float | None
    abort_db: float | None
    peak_g: float | None
    accepted: bool | None = None
    updates: int | None = None
    correction: float | None = None
    thd: float | None = None


@dataclass(frozen=True, slots=True)
class ResponseRow:
    """Impacts and peak of u in the last cycle, and the last PRC point, of one source."""

    source: str
    impacts_right: int | None = None
    impacts_left: int | None = None
    u_peak_m: float | None = None
    eta_d: float | None = None
    eta_a: float | None = None


@dataclass(frozen=True, slots=True)
class FrequencyPlot:
    """Curves over frequency so far; `newest` is the last measured point, with its direction."""

    label: str
    count: int
    curves: tuple[FrequencyCurve, ...]
    range_hz: tuple[float, float] | None
    step_hz: float | None
    newest: FrequencyCurve | None = None

    @property
    def highest(self) -> float:
        """Largest finite value of the curves, 0 without any."""
        values = [y for curve in self.curves for _, y in curve.points if math.isfinite(y)]
        return max(values, default=0.0)


def margin_tone(margin: LiveMargin) -> str:
    """Return how near a peak is to its limit; a lost sensor is as bad as one beyond it."""
    if not math.isfinite(margin.share) or margin.share > ALARM_SHARE:
        return "bad"
    return "warn" if margin.share > WARN_SHARE else "good"


def is_jump_near(forecast: JumpForecast) -> bool:
    """Return whether the test is within the interval of the forecast jump."""
    return forecast.low_hz <= forecast.frequency_hz <= forecast.high_hz


def component_label(component: str, run: str) -> str:
    """Return the display name of a component: a process of this run, or an observer's program."""
    if component.startswith(f"{run}."):
        return component.removeprefix(f"{run}.")
    parts = component.split(".")
    if parts[0] != "observer" or len(parts) < 3:
        return component
    return f"{parts[-1].partition('-')[0]}:{'.'.join(parts[1:-1])}"


class RunView:
    """View of a run in one state; each part is computed at its first use."""

    def __init__(self, run_state: LiveRunState, status: SessionStatus) -> None:
        self.run_state, self.status = run_state, status

    @property
    def name(self) -> str:
        return self.run_state.start.name if self.run_state.start else ""

    @property
    def title(self) -> str:
        return self.run_state.profile.title if self.run_state.profile else ""

    @property
    def rig_title(self) -> str:
        return self.run_state.rig.title if self.run_state.rig else ""

    @cached_property
    def progress(self) -> Progress:
        run_state, (state, tone) = self.run_state, self._describe_state()
        step, profile, stop = run_state.step, run_state.profile, run_state.stop
        position, _, cycle = run_state.position
        has_windows = run_state.start is not None and not run_state.start.steps
        is_swept = profile is not None and isinstance(profile.excitation, Sweep)
        return Progress(
            state=state,
            tone=tone,
            is_live=stop is None and self.status.silent_s < SILENT_S and bool(run_state.run),
            held=run_state.rig_state == "holding",
            activity=self._describe_activity(),
            time_s=run_state.index / run_state.rate_hz,
            progress=run_state.progress,
            left_s=None if run_state.progress is None else run_state.remaining_s,
            step=None if step is None else step.index + 1,
            steps=run_state.step_count,
            frequency_hz=None if step is None else step.frequency_hz,
            direction="" if step is None else step.direction,
            cycle=cycle + 1 if cycle >= 0 else None,
            cycles=profile.sweep.cycles if profile is not None and is_swept else None,
            phase="after" if stop else "between" if run_state.points else "before",
            window=position + 1 if has_windows and position >= 0 else None,
            windows=(profile.plan.windows if profile else 0) if has_windows else None,
            ended=stop is not None,
            reason=stop.reason if stop else "",
        )

    def _describe_state(self) -> tuple[str, str]:
        """Return the state of the run in words, and its tone."""
        stop = self.run_state.stop
        if stop is not None:
            return f"ended: {stop.verdict}", "good" if stop.verdict == "complete" else "bad"
        if self.status.silent_s >= SILENT_S:
            return f"no data for {format_duration(self.status.silent_s)}", "bad"
        if not self.run_state.run:
            return "waiting for a run", "dim"
        state = self.run_state.rig_state
        return STATE_TEXTS.get(state, state) or "joined", STATE_TONES.get(state, "")

    def _describe_activity(self) -> str:
        """Return what the table is doing within the state, "" if the state says it already."""
        if not self.run_state.recent.blocks:
            return ""
        activity = LABEL_TEXTS.get(Label(self.run_state.position[1]), "")
        return "" if activity == self.run_state.rig_state else activity

    @cached_property
    def level(self) -> TableLevel | None:
        """Level at the current step; None outside the steps."""
        step, profile = self.run_state.step, self.run_state.profile
        if step is None:
            return None
        current, peak = self.run_state.recent.table_level(step.frequency_hz) or (None, None)
        demanded = step.acceleration_m_s2
        deviation = None if current is None else current / (demanded or math.nan) - 1.0
        tolerance = profile.control.tolerance if profile else DEFAULT_TOLERANCE
        alarm = profile.protection.alarm if profile else None
        tone = ""
        if deviation is not None:
            size = abs(deviation)
            is_warning = alarm is None or size <= alarm
            tone = "good" if size <= tolerance else "warn" if is_warning else "bad"
        return TableLevel(
            demanded / GRAVITY_M_S2,
            None if current is None else current / GRAVITY_M_S2,
            deviation,
            tone,
            tolerance,
            alarm,
            profile.protection.abort_db if profile else None,
            None if peak is None else peak / GRAVITY_M_S2,
            *self._describe_evaluation(step.index),
        )

    def _describe_evaluation(self, step: int) -> tuple[()] | tuple[bool, int, float, float]:
        """Return (accepted, updates, correction, THD) of the last evaluation at this step."""
        level = self.run_state.get_latest(Level)
        if level is None or level.step != step:
            return ()
        thd = math.hypot(*level.harmonics_m_s2) / (level.measured_m_s2 or math.nan)
        return level.accepted, level.update, level.correction, thd

    @cached_property
    def margins(self) -> list[LiveMargin] | None:
        """Peaks of the last second against their limits; None before the files of the run."""
        run_state = self.run_state
        if run_state.rig is None or run_state.profile is None or run_state.start is None:
            return None
        return compute_live_margins(
            run_state.rig, run_state.profile, run_state.start.tare, run_state.recent
        )

    @property
    def agreement(self) -> Agreement | None:
        return self.run_state.get_latest(Agreement)

    @cached_property
    def twin_rows(self) -> list[TwinRow]:
        return list_twin_rows(self.agreement, self.run_state.recent.twin_errors())

    @cached_property
    def response_rows(self) -> tuple[ResponseRow, ResponseRow]:
        """Last cycle and last point, measured and of the twin."""
        cycle = self.run_state.get_latest(CycleExtremes)
        points = self.run_state.points
        point = points[max(points)] if points else None
        return (
            _describe_response(
                "measured", cycle.measured if cycle else None, point.measured if point else None
            ),
            _describe_response(
                "twin", cycle.twin if cycle else None, point.twin if point else None
            ),
        )

    @property
    def forecast(self) -> JumpForecast | None:
        return self.run_state.get_latest(JumpForecast)

    @cached_property
    def parameters(self) -> list[ParameterRow]:
        return list_drift_rows(self.run_state.get_latest(Estimate))

    @cached_property
    def events(self) -> list[EventLine]:
        """Warnings and events, the newest first."""
        events = enumerate(self.run_state.events.values())
        newest = sorted(events, key=lambda entry: (entry[1].index, entry[0]), reverse=True)
        return [event for _, event in newest]

    @property
    def timings(self) -> list[Timing]:
        """Latencies in ms, by component."""
        return sorted(self.run_state.timings.values(), key=lambda timing: timing.component)

    @property
    def dropouts(self) -> int:
        """Number of invalid samples."""
        return sum(count for _, count in self.run_state.gaps.values())

    @property
    def dropout_channels(self) -> list[str]:
        return sorted(
            {describe_channel(name).label if name else "all" for name, _ in self.run_state.gaps}
        )

    @cached_property
    def components(self) -> Counter[str]:
        """Number of connected programs by the name that is shown."""
        names = (component_label(name, self.run_state.run) for name in self.status.components)
        return Counter(names)

    def plot(self, value: ResponseQuantity) -> FrequencyPlot:
        """Return the PRC of a quantity so far, or the orbits of a continuation over its plan."""
        run_state, profile = self.run_state, self.run_state.profile
        step_hz = run_state.step.frequency_hz if run_state.step is not None else None
        if profile is not None and profile.continuation is not None:
            orbits = list(run_state.orbits.values())
            curves = list_orbit_curves(profile.continuation.orbit_plan, orbits)
            frequencies_hz = [frequency for curve in curves for frequency, _ in curve.points]
            label, count, newest = "amplitude in mm", len(orbits), None
        else:
            points = sorted(run_state.points.values(), key=lambda point: point.step)
            curves = list_prc_curves(points, value)
            frequencies_hz = [point.frequency_hz for point in points]
            if run_state.start is not None:
                frequencies_hz += [step.frequency_hz for step in run_state.start.steps]
            label, count, newest = "η_d", len(points), None
            if points and (measured := points[-1].measured) is not None:
                last = points[-1].frequency_hz, value(measured)
                newest = FrequencyCurve("measured", points[-1].direction, (last,))
        range_hz = (min(frequencies_hz), max(frequencies_hz)) if frequencies_hz else None
        return FrequencyPlot(label, count, tuple(curves), range_hz, step_hz, newest)

    @cached_property
    def trace_span_s(self) -> float:
        """Time shown of u and the contact force: the last cycles of a step."""
        step = self.run_state.step
        return TRACE_CYCLES / step.frequency_hz if step is not None else IDLE_TRACE_S

    @property
    def traces(self) -> dict[str, Float2D]:
        """(index, u in m, contact force in N) by track over `trace_span_s`, (3, point) each."""
        return self.run_state.traces.select_last(self.trace_span_s * self.run_state.rate_hz)


def _describe_response(
    source: str, extremes: Extremes | None, response: NormalizedResponse | None
) -> ResponseRow:
    right = left = peak = None
    if extremes is not None:
        right, left = len(extremes.onsets_r), len(extremes.onsets_l)
        peak = max(extremes.u_max, -extremes.u_min)
    if response is None:
        return ResponseRow(source, right, left, peak)
    return ResponseRow(source, right, left, peak, response.eta_d, response.eta_a)


def format_duration(seconds: float) -> str:
    """Format a duration as hours, minutes and seconds, as in 0:01:02."""
    total_s = max(int(seconds), 0)
    return f"{total_s // 3600}:{total_s // 60 % 60:02d}:{total_s % 60:02d}"
