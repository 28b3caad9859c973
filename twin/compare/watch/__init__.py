"""The watch: what a person should be told about a running test, from its samples alone.

Pure, at sample indices, the same however the samples are cut: a replay says the same. It warns; it
never trips a table.
"""

from dataclasses import dataclass, field, replace

from table_io.block import Block
from table_io.records import Point, Record
from twin.compare.watch import jumps
from twin.compare.watch.agreement import Told, agreement
from twin.compare.watch.held import Held, Noise, WatchSetup
from twin.compare.watch.identified import Identified, identify
from twin.compare.watch.instruments import Doubts, doubted
from twin.compare.watch.jumps import Foreseen, Passing
from twin.compare.watch.steady import Steady, steadied

# Of its Events. A jump is one that came where the model has it; all others are warnings.
KINDS = (
    "jump", "unexpected jump", "no jump", "disagreement", "drift", "attractor", "instrument",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Watch:
    """What is remembered from cycle to cycle."""

    noise: Noise = field(default_factory=Noise)
    told: Told = field(default_factory=Told)
    identified: Identified = field(default_factory=Identified)
    steady: Steady = field(default_factory=Steady)
    doubts: Doubts = field(default_factory=Doubts)
    passing: Passing = field(default_factory=Passing)


def begin(known: Foreseen) -> Watch:
    """Before the first sample, with what the model does on the way."""
    return Watch(passing=jumps.begin(known))


def rested(watch: Watch, block: Block) -> Watch:
    """With what the sensors say at rest."""
    return replace(watch, noise=watch.noise.seen(block))


def looked(setup: WatchSetup, watch: Watch, held: Held) -> tuple[Watch, list[Record]]:
    """After a held cycle."""
    told, agreed = agreement(setup, watch.told, watch.noise, held)
    doubts, sensors = doubted(setup, watch.doubts, watch.noise, held)
    identified, estimates = identify(
        setup, watch.identified, watch.noise, held, trusted=not told.ever, doubt=doubts.any
    )
    steady, changed = steadied(watch.steady, held)
    after = replace(watch, told=told, identified=identified, steady=steady, doubts=doubts)
    return after, [*agreed, *estimates, *changed, *sensors]


def passed(watch: Watch, point: Point) -> tuple[Watch, list[Record]]:
    """After a planned step of the sweep."""
    passing, items = jumps.passed(watch.passing, point)
    return replace(watch, passing=passing), items
