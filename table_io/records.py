"""Record types of the stream next to Blocks, a closed set of small messages, and their text.

Every record carries the sample index from which it holds, so that a replay can order it exactly.
The one-line text of a record is the same on the terminal, in the viewer and in the report.
"""

import math
from dataclasses import dataclass, field

from table_io.block import Label
from table_io.units import GRAVITY_M_S2

RESPONSE_RATIOS = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")  # of a NormalizedResponse
MIN_JUMP_RATIO = 1.6  # of the peaks of u at neighboring steps; a smooth branch stays below


@dataclass(frozen=True, slots=True)
class Step:
    """Step of the sweep; `direction` is "forward" or "backward"."""

    index: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float


@dataclass(frozen=True, slots=True)
class RunStart:
    """Start record: all that is needed to understand and repeat the run, with whole TOML files."""

    index: int
    run: str
    name: str
    source: str  # origin of the measured stream: "table" or "model"
    profile_toml: str
    rig_toml: str
    model_toml: str
    rate_hz: float
    block_samples: int
    channels: tuple[str, ...]
    steps: tuple[Step, ...]
    planned_samples: int
    tare: dict[str, float]  # SI value subtracted from each channel, without preload
    versions: dict[str, str]
    host: str
    started_at: str  # ISO 8601, for display only
    epoch_s: float  # monotonic clock of the host at sample 0, for latencies only
    predictions_every: int = 0  # of the twin's blocks only every n-th is recorded; 0: all

    @property
    def has_all_predictions(self) -> bool:
        """Whether all of the twin's blocks are recorded."""
        return self.predictions_every <= 1


@dataclass(frozen=True, slots=True)
class Params:
    """Model parameters in SI, valid from sample `index` on."""

    index: int
    values: dict[str, float]
    reason: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """Model compared with measurement over samples index .. index + count - 1.

    Sums of squares per channel, SI: of the measurement, of the error of the free-running twin, and
    of the error of the twin that restarts from the measured state. NaN where nothing can be
    compared.
    """

    index: int
    count: int
    channels: tuple[str, ...]
    measured_ss: tuple[float, ...]
    free_error_ss: tuple[float, ...]
    window_error_ss: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PredictionHash:
    """Hash of the twin's output over samples index .. index + count - 1.

    So a replay proves that it predicts the same also where no predictions were recorded. `free` and
    `window` are the states of the two solvers after these samples, from which what follows is
    computed without what came before; empty of most hashes, and where they are not enough.
    """

    index: int
    count: int
    digest: bytes  # BLAKE2b, 16 bytes
    free: tuple[float, ...] = ()
    window: tuple[float, ...] = ()

    @property
    def end(self) -> int:
        """Index of the first sample after those of the hash."""
        return self.index + self.count

    def is_same_output(self, other: "PredictionHash | None") -> bool:
        """Return whether another hash is of the same samples and the same output."""
        return other is not None and (self.index, self.count, self.digest) == (
            other.index, other.count, other.digest,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Extremes:
    """Extremes of one forcing cycle, SI, right positive; `onsets_*` are sample indices."""

    u_max: float
    u_min: float
    a_max: float
    a_min: float
    force_r: float  # max of F_R, N
    force_l: float  # max of -F_L, N
    onsets_r: tuple[int, ...]
    onsets_l: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class CycleExtremes:
    """Extremes of one held forcing cycle that ends before sample `index`."""

    index: int
    step: int
    cycle: int
    label: int  # Label.SETTLE or Label.MEASURE
    count: int
    measured: Extremes | None
    twin: Extremes | None


@dataclass(frozen=True, slots=True)
class NormalizedResponse:
    """Normalized response at a step (Stefani et al., Eq. 1); all ratios >= 0.

    Each ratio is the mean over the measured cycles of the ratio of each cycle. Eq. 1 takes one
    largest and one smallest value of the steady motion: the same where every cycle is alike, more
    where they differ.
    `drift` is the change of eta_d over the measured cycles relative to its mean (the remaining
    transient); `spread` and `spread_a` are the ranges of eta_d and eta_a over the measured cycles
    relative to their means; `spread_a` is None in recordings from before it was recorded.
    """

    eta_d: float
    eta_a: float
    eta_r: float
    eta_l: float
    r_r: float
    r_l: float
    impacts_right: tuple[int, ...]
    impacts_left: tuple[int, ...]
    drift: float
    spread: float
    spread_a: float | None = None


@dataclass(frozen=True, slots=True)
class PrcPoint:
    """PRC point of a step whose measured cycles end before sample `index`."""

    index: int
    step: int
    direction: str
    frequency_hz: float
    measured: NormalizedResponse | None
    twin: NormalizedResponse | None
    table_acc_peak_m_s2: float
    table_acc_fundamental_m_s2: float
    thd: float


@dataclass(frozen=True, slots=True)
class Agreement:
    """Error of the restarted twin against the measurement over a held cycle ending before `index`.

    Per channel, SI: rms error, the band expected from noise and allowed model error, and the rms
    error by contact regime: in flight, in contact right, in contact left. NaN where nothing can be
    compared.
    """

    index: int
    step: int
    cycle: int
    count: int
    channels: tuple[str, ...]
    error: tuple[float, ...]
    band: tuple[float, ...]
    flight: tuple[float, ...]
    right: tuple[float, ...]
    left: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Estimate:
    """Recursive parameter estimate of the specimen from the samples before `index`, SI.

    `names` are parameters (stiffness, damping, gap_r, gap_l), `sd` standard deviations; `drift` is
    the change since the first estimate according to the trend over the test, with `drift_sd`.
    """

    index: int
    step: int
    names: tuple[str, ...]
    values: tuple[float, ...]
    sd: tuple[float, ...]
    drift: tuple[float, ...]
    drift_sd: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class JumpForecast:
    """Forecast of the next jump along the sweep from the model's branch, made at sample `index`.

    `kind` is "up", "down" or "" (no jump ahead); the jump lies at `jump_hz`, between the steps at
    `low_hz` and `high_hz`.
    """

    index: int
    step: int
    direction: str
    frequency_hz: float
    kind: str
    jump_hz: float
    low_hz: float
    high_hz: float


@dataclass(frozen=True, slots=True)
class Event:
    """Message to the user; `kind` is a short machine-readable word."""

    index: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class SampleGap:
    """Gap: samples index .. index + count - 1 of `channel` ("" = all) are not valid."""

    index: int
    count: int
    channel: str
    reason: str  # "lost", "late", "clipped", "stuck", "wild"

    @property
    def end(self) -> int:
        """Index of the first sample after the gap."""
        return self.index + self.count


@dataclass(frozen=True, slots=True)
class Fault:
    """Failure of a component: its output for samples from_index .. to_index - 1 is missing.

    A replay reproduces it: no output in between, then a fresh start at `to_index`.
    """

    index: int
    component: str
    from_index: int
    to_index: int
    reason: str


@dataclass(frozen=True, slots=True)
class Timing:
    """Latency of a component over all blocks so far in ms; `missed` counts missed deadlines.

    The only record that depends on a wall clock; no calculation reads it.
    """

    index: int
    component: str
    p50_ms: float
    p99_ms: float
    max_ms: float
    missed: int
    blocks: int
    cpu_share: float
    scheduler: str


@dataclass(frozen=True, slots=True)
class Check:
    """Result line of the loop check; it passes if `value` lies in low .. high."""

    index: int
    name: str
    channel: str
    value: float
    low: float
    high: float
    unit: str
    passed: bool


@dataclass(frozen=True, slots=True)
class FrequencyResponse:
    """FRF of the table, acceleration over command, identified at low level at `frequencies_hz`.

    `gain` is a ratio; `phase_rad` is negative where the table lags.
    """

    index: int
    frequencies_hz: tuple[float, ...]
    gain: tuple[float, ...]
    phase_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Level:
    """Level measurement at a step, over whole cycles that end before sample `index`.

    Fundamental of the measured and of the demanded table acceleration; `correction` is the factor
    on the command, `update` counts its changes at this step, and `accepted` means that it is frozen
    for the measured cycles. `harmonics_m_s2` are the amplitudes of orders 2 to 5.
    """

    index: int
    step: int
    demanded_m_s2: float
    measured_m_s2: float
    correction: float
    update: int
    accepted: bool
    harmonics_m_s2: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class SweepLevel:
    """Level of a swept sine, over whole cycles that end before sample `index`.

    `frequency_hz` is that in their middle. `reference_m_s2` is the level of the profile,
    `demanded_m_s2` what limits leave of it, on average over the cycles, and `measured_m_s2` that of
    the control channels. `limited_by` is the channel that reduces the level, "" if none does.
    `correction` is the factor on the command. `amplitudes` are fundamentals of `channels`, SI.
    """

    index: int
    step: int
    frequency_hz: float
    reference_m_s2: float
    demanded_m_s2: float
    measured_m_s2: float
    correction: float
    limited_by: str
    channels: tuple[str, ...]
    amplitudes: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class StepAdded:
    """Step added during the test by an adaptive policy (dwell, track or refine)."""

    index: int
    step: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float
    reason: str

    @property
    def as_step(self) -> Step:
        """The step as a planned one would be."""
        return Step(self.step, self.direction, self.frequency_hz, self.acceleration_m_s2)


@dataclass(frozen=True, slots=True)
class OrbitPoint:
    """Periodic orbit held by feedback at a planned point, over whole cycles before sample `index`.

    The orbit is that of the table without feedback only if the feedback has vanished: `accepted`
    means that its harmonics are at noise level or below the tolerance, and that the amplitude is
    that of the sought branch; else `reason` says what is missing. Of an accepted orbit amplitude
    and `u_m` are without what the feedback left moves u by. `u_m` are the harmonics U_0,
    U_1, ... as Re U_0, Im U_0, Re U_1, ... with u(t) = Re sum U_k exp(i k phi), where the table's
    acceleration is a sin(phi). `feedback_m` are the amplitudes of harmonics 0, 1, ... of the
    correction, `feedback_size_m` the root sum of squares of all but the mean, which moves table and
    mass alike, `noise_m` its standard error by the scatter between cycles, and `command_m` is the
    amplitude of the command. `periods` counts from the change of point. `multiplier` is the largest
    Floquet multiplier without feedback, `multiplier_sd` its standard deviation.
    """

    index: int
    step: int
    frequency_hz: float
    acceleration_m_s2: float  # fundamental of the table, measured
    amplitude_m: float  # half of max u - min u
    u_m: tuple[float, ...]
    feedback_m: tuple[float, ...]
    noise_m: float
    command_m: float
    periods: int
    updates: int
    stable: bool  # by the plan
    multiplier: float  # measured; NaN if it was not
    accepted: bool
    reason: str
    multiplier_sd: float | None = None  # None if the multiplier was not measured

    @property
    def feedback_size_m(self) -> float:
        """Root sum of squares of the harmonics of the feedback in m."""
        return math.hypot(*self.feedback_m[1:])


@dataclass(frozen=True, slots=True)
class Trip:
    """Protection trip in `channel` at sample `index`; latched, the table decays to rest.

    `decided` is the sample up to which the session had read when it tripped.
    """

    index: int
    decided: int
    kind: str  # one word: stroke, velocity, acceleration, force, lost, stuck, level, ...
    channel: str
    value: float
    limit: float
    text: str


@dataclass(frozen=True, slots=True)
class RunStop:
    """Stop record after `index` samples; the verdict is complete, stopped, aborted or halted."""

    index: int
    verdict: str
    reason: str
    states: tuple[str, ...] = field(default=())


Record = (
    RunStart
    | Params
    | Comparison
    | PredictionHash
    | CycleExtremes
    | PrcPoint
    | Event
    | SampleGap
    | Fault
    | Timing
    | Check
    | FrequencyResponse
    | Level
    | SweepLevel
    | StepAdded
    | OrbitPoint
    | Trip
    | Agreement
    | Estimate
    | JumpForecast
    | RunStop
)

LABEL_TEXTS = {
    Label.REST: "at rest",
    Label.BLEND: "blending",
    Label.SETTLE: "settling",
    Label.MEASURE: "measuring",
    Label.STOP: "decaying to rest",
    Label.CHECK: "loop check",
}
SEVERITY_KINDS = {
    "ERROR": {"fault", "halted", "error", "died", "twin_failed"},
    "WARN": {
        "warning", "calibration", "alarm", "divergence", "late", "stop", "stopped", "sensor",
        "disagreement", "drift", "no jump", "unexpected jump", "attractor", "instrument", "refused",
        "law_range",
    },
}  # fmt: skip


def format_record(record: Record, rate_hz: float) -> tuple[str, str] | None:
    """Return (INFO, WARN or ERROR, text) of a record, or None for a record that is only data."""
    match record:
        case Event(kind=kind, text=text):
            level = next(
                (severity for severity, kinds in SEVERITY_KINDS.items() if kind in kinds), "INFO"
            )
            return level, f"{format_kind(kind)}: {text}"
        case SampleGap(count=count, channel=channel, reason=reason):
            return "WARN", f"dropout: {count} samples of {channel or 'all channels'} {reason}"
        case Fault(component=component, from_index=first, to_index=last, reason=reason):
            span = f"{first / rate_hz:.3f} s to {last / rate_hz:.3f} s"
            return "ERROR", f"{component} failed, no output from {span}: {reason}"
        case Params(reason=reason):
            return "INFO", f"twin parameters: {reason}"
        case Trip(kind=kind, text=text):
            return "ERROR", f"protection ({kind}): {text}"
        case Check():
            return ("INFO" if record.passed else "ERROR"), _format_check(record)
        case FrequencyResponse(frequencies_hz=frequencies, gain=gain):
            points = ", ".join(
                f"{g:.3f} at {f:g} Hz" for f, g in zip(frequencies, gain, strict=True)
            )
            return "INFO", f"table FRF gain (acceleration / command): {points}"
        case Level():
            return ("INFO" if record.accepted else "WARN"), _format_level(record)
        case SweepLevel():
            return "INFO", _format_sweep_level(record)
        case StepAdded(frequency_hz=frequency, reason=reason):
            return "INFO", f"next step at {frequency:g} Hz: {reason}"
        case OrbitPoint():
            return ("INFO" if record.accepted else "WARN"), _format_orbit(record)
        case RunStop(verdict=verdict, reason=reason):
            return ("INFO" if verdict == "complete" else "WARN"), f"{verdict}: {reason}"
    return None


def format_kind(kind: str) -> str:
    """Return the kind of an event in words."""
    return kind.replace("_", " ")


def _format_check(check: Check) -> str:
    how = "pass" if check.passed else "FAIL"
    value = f"{check.value:.4g} {check.unit}".rstrip()
    limited = math.isfinite(check.low) or math.isfinite(check.high)
    allowed = f" (allowed {check.low:.4g} to {check.high:.4g})" if limited else ""
    return f"check {how}: {check.name}, {check.channel}: {value}{allowed}"


def _format_level(level: Level) -> str:
    return (
        f"level at step {level.step}: {level.measured_m_s2 / GRAVITY_M_S2:.4f} g measured, "
        f"{level.demanded_m_s2 / GRAVITY_M_S2:.4f} g demanded; command multiplied by "
        f"{level.correction:.4f} after {level.update} updates"
    )


def _format_sweep_level(level: SweepLevel) -> str:
    notch = f", reduced by the limit of {level.limited_by}" if level.limited_by else ""
    return (
        f"sweep at {level.frequency_hz:.4g} Hz: {level.measured_m_s2 / GRAVITY_M_S2:.4f} g "
        f"measured, {level.demanded_m_s2 / GRAVITY_M_S2:.4f} g demanded{notch}; command multiplied "
        f"by {level.correction:.4f}"
    )


def _format_orbit(orbit: OrbitPoint) -> str:
    feedback = orbit.feedback_size_m
    share = 100 * feedback / orbit.command_m
    text = (
        f"orbit {orbit.step}: +-{1e3 * orbit.amplitude_m:.4g} mm at {orbit.frequency_hz:.5g} Hz; "
        f"feedback {1e6 * feedback:.2g} um, {share:.2g} % of the command; {orbit.periods} periods"
    )
    if orbit.multiplier_sd is not None:
        text += f"; multiplier {orbit.multiplier:.3g} +-{orbit.multiplier_sd:.1g}"
    return text if orbit.accepted else f"{text}; not accepted: {orbit.reason}"
