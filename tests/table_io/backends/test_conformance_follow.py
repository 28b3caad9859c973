"""What only acquires keeps the clauses without output: a table under a controller of its own."""

import inspect

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.clock import Clock, ManualClock, RealClock
from table_io.sim.opendaq import DrivePlayback
from tests.table_io.acquisition.external_controller import Bystander
from tests.table_io.backends.conformance import ACQUIRING, CLAUSES, RATE_HZ, Bench
from tests.table_io.backends.test_conformance import BROKEN, SPECIMEN, card


def following(clock: Clock, kind: type[Bystander] = Bystander) -> Bench:
    """The Source of a session that follows: no queue, and somebody else plays."""
    rig, _ = card("follow_simulated")

    def play(source: Bystander, volts: Float1D) -> None:
        source.file = DrivePlayback(volts / rig.output.volts_per_m, RATE_HZ, RATE_HZ, 0.0)
        source.start()

    def make(rate: float) -> Bystander:
        return kind(rig, SPECIMEN, rate, clock, np.zeros(2), begins=0.0)

    return Bench(rig, clock, make, repeatable=True, play=play)


@pytest.mark.parametrize("clause", ACQUIRING)
@pytest.mark.parametrize("clock", [ManualClock(), RealClock(2.0)], ids=["manual", "real"])
def test_source_keeps_the_contract(clause: str, clock: Clock) -> None:
    ACQUIRING[clause](following(clock))


@pytest.mark.parametrize(
    ("clause", "kind"),
    [
        (clause, kind)
        for clause in ACQUIRING
        for kind in BROKEN[clause]
        if kind.__name__ != "Anonymous"
    ],
    ids=lambda clause_or_kind: (
        clause_or_kind if isinstance(clause_or_kind, str) else clause_or_kind.__name__
    ),
)
def test_clause_fails_for_a_broken_source(clause: str, kind: type) -> None:
    broken = type(kind.__name__, (kind, Bystander), {"__init__": Bystander.__init__})
    with pytest.raises((AssertionError, OSError)):
        ACQUIRING[clause](following(ManualClock(), broken))


def test_omitted_clauses_queue_a_command() -> None:
    for name in CLAUSES.keys() - ACQUIRING.keys():
        assert "backend.queue(" in inspect.getsource(CLAUSES[name])
