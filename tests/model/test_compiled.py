"""numba's cache key: a kernel must not outlive a change in a module it calls into."""

import subprocess
import sys
from pathlib import Path

import pytest

from twin.model import orbit, phase, sampled, sweep
from twin.model.compiled import compiled, inner, revision


@pytest.mark.parametrize("decorator", [compiled, inner])
def test_revision_follows_code_and_numbers(decorator):
    @decorator()
    def one(x: float) -> float:
        return 2.0 * x

    @decorator()
    def other(x: float) -> float:
        return 3.0 * x

    assert revision({"f": one}) == revision({"f": one, "text": "x"})
    assert len({revision({"f": one}), revision({"f": other}), revision({"f": one, "K": 1})}) == 3


def nested(size: int):
    def made(x: float) -> float:
        return x * size

    return made


def test_revision_is_the_same_in_every_process():
    """Else no process would find what another one compiled."""
    code = (
        "from tests.model.test_compiled import nested;"
        "from twin.model.compiled import revision;"
        "from twin.model import integrate;"
        "print(revision({'f': nested}), integrate.REVISION)"
    )
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    from twin.model import integrate

    assert found.stdout.split() == [str(revision({"f": nested})), str(integrate.REVISION)]


def test_a_part_of_kernels_is_plain_python_outside_of_them():
    @inner()
    def part(x: float) -> float:
        return 2.0 * x

    @compiled()
    def kernel(x: float) -> float:
        return part(x) + 1.0

    assert kernel(3.0) == 7.0
    assert part(3.0) == 6.0
    assert not hasattr(part, "py_func")


def test_revision_of_the_phase_is_part_of_every_cache_key():
    assert revision({k: v for k, v in vars(phase).items() if k != "REVISION"}) == phase.REVISION
    cached = {
        kernel
        for module in (orbit, phase, sampled, sweep)
        for kernel in vars(module).values()
        if hasattr(kernel, "py_func") and kernel.stats.cache_path is not None
    }
    assert cached == {sampled.march, sweep.stepped, orbit.turns}
    for kernel in (sampled.march, sweep.stepped, orbit.turns):
        assert str(phase.REVISION) in str(kernel.signatures)


def test_the_integrators_key_holds_the_revision_of_all_it_calls():
    from twin.model import events, integrate, laws

    assert integrate.sampled.stats.cache_path is not None
    kernel = integrate.sampled.py_func
    assert kernel.__closure__[0].cell_contents == integrate.REVISION
    names = {k: v for k, v in vars(laws).items() if k != "REVISION"}
    assert revision(names) == laws.REVISION
    assert len({laws.REVISION, events.REVISION, integrate.REVISION}) == 3
    for module in (laws, events):
        kernels = [k for k in vars(module).values() if hasattr(k, "py_func")]
        assert {k.py_func.__name__ for k in kernels if k.stats.cache_path} <= {"no_extra"}
