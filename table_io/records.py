"""The closed set of small records that flow beside Blocks.

Every record carries the sample index from which it holds, so a replay can put it back in its place.
"""

from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class Step:
    """One step of the sweep as planned: `direction` is "forward" or "backward"."""

    index: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float


@dataclass(frozen=True, slots=True)
class RunStart:
    """All that is needed to understand and repeat the run: the texts are whole TOML files."""

    index: int
    run: str
    name: str
    source: str  # "table", "model": who made the measured stream
    profile_toml: str
    rig_toml: str
    model_toml: str
    rate_hz: float
    block_samples: int
    channels: tuple[str, ...]
    steps: tuple[Step, ...]
    planned_samples: int
    tare: dict[str, float]  # SI value subtracted from each channel, taken before precompression
    versions: dict[str, str]
    host: str
    started_at: str  # ISO 8601, for people; never enters a calculation
    epoch_s: float  # monotonic clock of the host at sample 0; only latencies are taken against it


@dataclass(frozen=True, slots=True)
class Params:
    """Model parameters in SI that hold from sample `index` on."""

    index: int
    values: dict[str, float]
    reason: str


@dataclass(frozen=True, slots=True)
class Comparison:
    """Model against measurement over samples index .. index + count - 1, no wall clock inside.

    Per channel, sums over the samples: measured squared, error squared of the free-running twin,
    error squared of the twin that restarts from the measured state. NaN where there is nothing to
    compare.
    """

    index: int
    count: int
    channels: tuple[str, ...]
    measured_ss: tuple[float, ...]
    free_error_ss: tuple[float, ...]
    window_error_ss: tuple[float, ...]


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
class Cycle:
    """One held forcing cycle that ends before sample `index`."""

    index: int
    step: int
    cycle: int
    label: int  # Label.SETTLE or Label.MEASURE
    count: int
    measured: Extremes | None
    twin: Extremes | None


@dataclass(frozen=True, slots=True)
class Quantities:
    """What the laboratory reports at a step (Stefani et al., Eq. 1); all ratios >= 0.

    `drift` is the change of eta_d over the measured cycles relative to its mean, the part of a
    transient that is left; `spread` its range over them relative to its mean.
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


@dataclass(frozen=True, slots=True)
class Point:
    """The PRC point of a step whose measured cycles end before sample `index`."""

    index: int
    step: int
    direction: str
    frequency_hz: float
    measured: Quantities | None
    twin: Quantities | None
    table_acc_peak_m_s2: float
    table_acc_fundamental_m_s2: float
    thd: float


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far the restarted twin was from the measurement over a held cycle ending before `index`.

    Per channel, SI: rms of the error, the band within which noise and what the model may be off
    keep it, and the error by phase: in flight, in contact right, in contact left. NaN where there
    is nothing to compare.
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
    """The specimen as identified from the samples before `index`, recursively, SI.

    `names` are parameters (stiffness, damping, gap_r, gap_l), `sd` standard deviations; `drift` is
    the change since the first estimate that the trend over the test gives, with `drift_sd`.
    """

    index: int
    step: int
    names: tuple[str, ...]
    values: tuple[float, ...]
    sd: tuple[float, ...]
    drift: tuple[float, ...]
    drift_sd: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Ahead:
    """The next jump on the way of the sweep by the model's branch, as known at sample `index`.

    `kind` is "up", "down", or "" where none is ahead; it lies at `jump_hz`, between the steps at
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
    """Something a person should read: `kind` is one word."""

    index: int
    kind: str
    text: str


@dataclass(frozen=True, slots=True)
class Gap:
    """Samples index .. index + count - 1 are no true measurement of `channel` ("" = all)."""

    index: int
    count: int
    channel: str
    reason: str  # "lost", "late", "clipped"


@dataclass(frozen=True, slots=True)
class Fault:
    """A component failed: what it should have made for from_index .. to_index - 1 is missing.

    A replay does the same: nothing in between, then a fresh start at `to_index`.
    """

    index: int
    component: str
    from_index: int
    to_index: int
    reason: str


@dataclass(frozen=True, slots=True)
class Timing:
    """How punctual a component was, over all blocks so far, in ms; `missed` counts deadlines.

    The only record with a wall clock in it; no calculation reads it.
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
    """One line of the loop check: `value` has to lie in low .. high."""

    index: int
    name: str
    channel: str
    value: float
    low: float
    high: float
    unit: str
    passed: bool


@dataclass(frozen=True, slots=True)
class Response:
    """The table's acceleration over its command, identified at low level, at `frequencies_hz`.

    `gain` is a ratio, `phase_rad` negative where the table lags.
    """

    index: int
    frequencies_hz: tuple[float, ...]
    gain: tuple[float, ...]
    phase_rad: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Level:
    """One look at the table's level at a step, on whole cycles that end before sample `index`.

    Fundamental of the measured table acceleration beside the demanded one; `correction` is what the
    command was multiplied with, `update` how often it was changed at this step, `accepted` that it
    now stays for the measured cycles. `harmonics` are those of orders 2 to 5, m/s2.
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
class Decided:
    """A step that was decided on during the test, not planned before it (track, refine)."""

    index: int
    step: int
    direction: str
    frequency_hz: float
    acceleration_m_s2: float
    reason: str


@dataclass(frozen=True, slots=True)
class Trip:
    """Protection: what was seen in `channel` at sample `index`; latched, the table decays to rest.

    `decided` is the sample up to which the session had looked when it saw this.
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
    """The end: `index` samples were acquired; verdict complete, stopped, aborted or halted."""

    index: int
    verdict: str
    reason: str
    states: tuple[str, ...] = field(default=())


Record = (
    RunStart
    | Params
    | Comparison
    | Cycle
    | Point
    | Event
    | Gap
    | Fault
    | Timing
    | Check
    | Response
    | Level
    | Decided
    | Trip
    | Agreement
    | Estimate
    | Ahead
    | RunStop
)
RECORDS: tuple[type, ...] = (
    RunStart, Params, Comparison, Cycle, Point, Event, Gap, Fault, Timing,
    Check, Response, Level, Decided, Trip, Agreement, Estimate, Ahead, RunStop,
)  # fmt: skip
