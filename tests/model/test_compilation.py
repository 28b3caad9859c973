"""numba's cache key: a kernel must not outlive a change in a module it calls into."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from twin.model import closed_form_kernel, contact_regime, periodic_orbit, stepped_sine_kernel
from twin.model.compilation import jit_helper, jit_kernel, source_revision


@pytest.mark.parametrize("decorator", [jit_kernel, jit_helper])
def test_revision_follows_code_and_numbers(decorator):
    @decorator()
    def one(x: float) -> float:
        return 2.0 * x

    @decorator()
    def other(x: float) -> float:
        return 3.0 * x

    assert source_revision({"f": one}) == source_revision({"f": one, "text": "x"})
    assert (
        len(
            {
                source_revision({"f": one}),
                source_revision({"f": other}),
                source_revision({"f": one, "K": 1}),
            }
        )
        == 3
    )


def make_nested(size: int):
    def multiply(x: float) -> float:
        return x * size

    return multiply


def test_revision_is_the_same_in_every_process():
    """Else no process would find what another one compiled."""
    code = (
        "from tests.model.test_compilation import make_nested;"
        "from twin.model.compilation import source_revision;"
        "from twin.model import event_integrator_kernel;"
        "print(source_revision({'f': make_nested}), event_integrator_kernel.REVISION)"
    )
    completed = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True,
        cwd=Path(__file__).parents[2],
    )  # fmt: skip
    from twin.model import event_integrator_kernel

    assert completed.stdout.split() == [
        str(source_revision({"f": make_nested})),
        str(event_integrator_kernel.REVISION),
    ]


def test_a_part_of_kernels_is_plain_python_outside_of_them():
    @jit_helper()
    def part(x: float) -> float:
        return 2.0 * x

    @jit_kernel()
    def kernel(x: float) -> float:
        return part(x) + 1.0

    assert kernel(3.0) == 7.0
    assert part(3.0) == 6.0
    assert not hasattr(part, "py_func")


def test_revision_of_the_phase_is_part_of_every_cache_key():
    assert (
        source_revision({k: v for k, v in vars(contact_regime).items() if k != "REVISION"})
        == contact_regime.REVISION
    )
    cached = {
        kernel
        for module in (periodic_orbit, contact_regime, closed_form_kernel, stepped_sine_kernel)
        for kernel in vars(module).values()
        if hasattr(kernel, "py_func") and kernel.stats.cache_path is not None
    }
    assert cached == {
        closed_form_kernel.advance_samples,
        stepped_sine_kernel.run_stepped_sine,
        periodic_orbit.advance_cycles,
    }
    kernels: tuple[Any, ...] = (
        closed_form_kernel.advance_samples,
        stepped_sine_kernel.run_stepped_sine,
        periodic_orbit.advance_cycles,
    )
    for kernel in kernels:
        assert str(contact_regime.REVISION) in str(kernel.signatures)


def test_the_integrators_key_holds_the_revision_of_all_it_calls():
    from twin.model import event_integrator_kernel, event_location, force_laws

    kernel: Any = event_integrator_kernel.integrate_samples
    assert kernel.stats.cache_path is not None
    assert kernel.py_func.__closure__[0].cell_contents == event_integrator_kernel.REVISION
    names = {k: v for k, v in vars(force_laws).items() if k != "REVISION"}
    assert source_revision(names) == force_laws.REVISION
    assert (
        len({force_laws.REVISION, event_location.REVISION, event_integrator_kernel.REVISION}) == 3
    )
    for module in (force_laws, event_location):
        kernels = [k for k in vars(module).values() if hasattr(k, "py_func")]
        assert not [k.py_func.__name__ for k in kernels if k.stats.cache_path]
