"""State of the sequencer: test plan, drive so far, tuning and the next decision."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from table_io.adaptive.continuation import MeasuredOrbit, OrbitTarget
from table_io.adaptive.policy import Policy
from table_io.adaptive.result import StepResult
from table_io.block import Block, Float1D
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.amplitude_control import Tuning
from table_io.control.orbit_feedback import FeedbackState
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import UNCHANGED, SweptPosition, Trajectory
from table_io.harmonics import NO_FIT, HarmonicFit
from table_io.records import OrbitPoint, Record, Step, SweepLevel
from table_io.safety.loop_check_data import PreloadLimits

MAX_HOLD_S = 3600.0  # an operator's hold times out after this


@dataclass(frozen=True, slots=True)
class TestPlan:
    """Constant part of a test: profile, rig, margins in samples and adaptive policy.

    A decision changes the command `margin` samples after it, a feedback `feedback_horizon`.
    """

    profile: Profile
    rig: RigConfig
    margin: int
    policy: Policy | None = None
    feedback_horizon: int = 0


@dataclass(frozen=True, slots=True)
class Stage:
    """Next decision; it is made on samples first .. last - 1 once they are acquired."""

    kind: str  # check, tune, hold, orbit, release, sweep, open, end
    step: int = -1
    first: int = 0
    last: int = 0
    update: int = 0
    first_fit: HarmonicFit = NO_FIT  # first harmonic fit at this step


@dataclass(frozen=True, eq=False)
class ReleaseSeries:
    """Releases of the feedback at an accepted orbit, for its Floquet multiplier.

    `point` is recorded when the multiplier is known. `reference` are the harmonics of x in m that
    the feedback holds, and `motion` those measured, at the phase of the drive. `multiplier` is that
    of the plan, at least 1, by which releases are timed, `limit_m` the departure at which they end.
    `spans` are the
    samples first .. last - 1 without feedback so far, the last one of which may be open. Another
    release begins at sample `next_start` or later.
    """

    point: OrbitPoint
    reference: Float1D
    motion: Float1D
    multiplier: float
    limit_m: float
    next_start: int
    spans: tuple[tuple[int, int], ...] = ()
    is_released: bool = False


@dataclass(frozen=True, eq=False)
class OrbitSearch:
    """Continuation so far: feedback, the orbit sought and those measured.

    Beyond the table's response in the loop check `lag_change_s` is the lag behind the command, and
    `level_factor` the factor on it. `losses` count at this point, `lost_points` since the last
    accepted orbit, and `periods` since the change of point, up to sample `since`.
    """

    feedback: FeedbackState
    target: OrbitTarget
    measured: tuple[MeasuredOrbit, ...]
    lag_change_s: float = 0.0
    level_factor: float = 1.0
    losses: int = 0
    lost_points: int = 0
    is_captured: bool = False
    periods: int = 0
    since: int = 0
    releases: ReleaseSeries | None = None


@dataclass(frozen=True, eq=False)
class SweepSearch:
    """Swept sine so far: place at the end of the trajectory, and what was measured.

    Windows begin at sample `since` or later, behind a soft start. `passes` are the levels measured
    by pass or dwell. `dwells` are the resonances in Hz still ahead, None while the passes last; the
    present dwell ends at sample `until`; the operator holds the frequency since `held_from`.
    """

    position: SweptPosition
    since: int
    passes: Mapping[int, tuple[SweepLevel, ...]] = field(default_factory=dict)
    dwells: tuple[float, ...] | None = None
    until: int = 0
    held_from: int | None = None

    @property
    def is_held(self) -> bool:
        """True while the operator holds the frequency."""
        return self.held_from is not None


@dataclass(frozen=True)
class SequencerState:
    """State of a running test; its correction is that of the queue before `corrected_from`."""

    plan: TestPlan
    trajectory: Trajectory
    drive: Drive
    stage: Stage
    steps: tuple[Step, ...]
    tuning: Tuning = field(default_factory=Tuning)
    corrected_from: int = UNCHANGED
    refusal: str = ""  # reason why the run must not continue
    noise: dict[str, float] | None = None  # rms of each channel at the tare, SI
    preload_n: PreloadLimits | None = None  # allowed force on the bumpers at rest
    blocks: tuple[Block, ...] = ()
    results: tuple[StepResult, ...] = ()
    search: OrbitSearch | None = None
    sweep: SweepSearch | None = None
    records: tuple[Record, ...] = field(default=())

    @property
    def changed_from(self) -> int:
        """First sample in which `drive` differs from the one that is queued."""
        return min(self.trajectory.changed_from, self.corrected_from)

    def mark_queued(self) -> "SequencerState":
        """Return the state of which `drive` is queued as it is."""
        trajectory = replace(self.trajectory, changed_from=UNCHANGED)
        return replace(self, trajectory=trajectory, corrected_from=UNCHANGED)

    @property
    def is_finished(self) -> bool:
        """True if no decision is left: the drive is known to its end."""
        return self.stage.kind == "end"
