"""Both far sides of the UDP packets keep the contract, also where packets are lost on the way."""

from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from table_io.clock import RealClock
from tests.table_io.backends.conformance import CLAUSES, Bench
from tests.table_io.backends.udp_bench import bench_of, c_target, python_target, relay_packets

FAR_SIDES = {"python": python_target, "c": c_target}


# What holds where packets are lost holds where none are; that is tried less often.
CLEAN = [pytest.param(side, marks=pytest.mark.slow) for side in FAR_SIDES]


@pytest.fixture(
    scope="module",
    params=[pytest.param("python, lossy", marks=pytest.mark.slow), "c, lossy", *CLEAN],
)
def bench(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Bench]:
    side, _, lossy = request.param.partition(", ")
    with ExitStack() as stack:
        folder = tmp_path_factory.mktemp(side)
        address = stack.enter_context(FAR_SIDES[side](folder))
        if lossy:
            address = stack.enter_context(relay_packets(address, seed=1)).address
        yield bench_of(address, RealClock(), repeatable=side == "python")


@pytest.mark.parametrize("clause", CLAUSES)
def test_udp_target_keeps_the_contract(clause: str, bench: Bench) -> None:
    CLAUSES[clause](bench)
