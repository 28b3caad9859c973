"""The state of a test under way: what is played, what is known, what is decided next."""

from dataclasses import dataclass, field

from table_io.block import Block
from table_io.control import Tuning
from table_io.course import Course
from table_io.drive import Drive
from table_io.policies import Policy, Result
from table_io.profile import Profile
from table_io.records import Record, Step
from table_io.rig import Rig
from table_io.tracking import NOTHING, Tracked


@dataclass(frozen=True, slots=True)
class Score:
    """What does not change: the test, the machine, and how a test finds its way, if it does."""

    profile: Profile
    rig: Rig
    margin: int
    policy: Policy | None = None


@dataclass(frozen=True, slots=True)
class Stage:
    """What is decided next: on samples first .. last - 1, when `last` is there."""

    kind: str  # check, tune, hold, open, end
    step: int = -1
    first: int = 0
    last: int = 0
    update: int = 0
    look: Tracked = NOTHING  # the first one at this step


@dataclass(frozen=True)
class Conductor:
    """State of a test under way. `drive` differs from what it was only from `changed` on."""

    score: Score
    course: Course
    drive: Drive
    stage: Stage
    steps: tuple[Step, ...]
    tuning: Tuning = field(default_factory=Tuning)
    changed: int = 0
    refused: str = ""  # why the run must not go on
    noise: dict[str, float] | None = None  # rms of each channel at the tare, SI
    heard: tuple[Block, ...] = ()
    results: tuple[Result, ...] = ()
    records: tuple[Record, ...] = field(default=())

    @property
    def over(self) -> bool:
        """True where nothing is left to decide: the drive is known to its end."""
        return self.stage.kind == "end"
