"""State of the sequencer: test plan, drive so far, tuning and the next decision."""

from dataclasses import dataclass, field

from table_io.adaptive import Policy, StepResult
from table_io.block import Block
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.amplitude_control import Tuning
from table_io.control.order_tracking import NO_FIT, HarmonicFit
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import Trajectory
from table_io.records import Record, Step


@dataclass(frozen=True, slots=True)
class TestPlan:
    """Constant part of a test: profile, rig, decision margin in samples and adaptive policy."""

    profile: Profile
    rig: RigConfig
    margin: int
    policy: Policy | None = None


@dataclass(frozen=True, slots=True)
class Stage:
    """Next decision; it is made on samples first .. last - 1 once they are acquired."""

    kind: str  # check, tune, hold, open, end
    step: int = -1
    first: int = 0
    last: int = 0
    update: int = 0
    first_fit: HarmonicFit = NO_FIT  # first harmonic fit at this step


@dataclass(frozen=True)
class SequencerState:
    """State of a running test; `drive` differs from the previous one from `changed_from` on."""

    plan: TestPlan
    trajectory: Trajectory
    drive: Drive
    stage: Stage
    steps: tuple[Step, ...]
    tuning: Tuning = field(default_factory=Tuning)
    changed_from: int = 0
    refusal: str = ""  # reason why the run must not continue
    noise: dict[str, float] | None = None  # rms of each channel at the tare, SI
    blocks: tuple[Block, ...] = ()
    results: tuple[StepResult, ...] = ()
    records: tuple[Record, ...] = field(default=())

    @property
    def is_finished(self) -> bool:
        """True if no decision is left: the drive is known to its end."""
        return self.stage.kind == "end"
