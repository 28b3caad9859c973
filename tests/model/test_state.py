"""The state of the sampled driver: blocks, lost samples, bumper memory, restarts."""

import math

import numpy as np
import pytest

from tests.model.motion import U_R, kick, restart, run, sine
from tests.model.reference import snm
from twin.model import closed_form


@pytest.mark.parametrize("p, rate", [(snm(), 2000.0), (snm(-0.001), 1000.0), (snm(), 40.0)])
@pytest.mark.parametrize("size", [1, 7, 64, 500])
def test_blocks_of_any_size_give_the_same_bits(p, rate, size):
    base = sine(5.2 if p.gap_r < 0 else 2.2, rate, 4000 / rate)
    base[1234] *= 1.5
    whole, out, events = run(p, rate, base)
    state = closed_form.rest_state(p)
    con = closed_form.discretized_params(p, rate)
    cut = np.empty_like(out)
    for first in range(0, base.size, size):
        window = slice(first, first + size)
        part = base[window]
        part.setflags(write=False)
        closed_form.advance_state(state, con, part, cut[:, window])
    assert len(events) > 10
    assert cut.tobytes() == out.tobytes()
    assert state.tobytes() == whole.tobytes()


@pytest.mark.parametrize("bad", [math.nan, math.inf])
@pytest.mark.parametrize("gap", [0.004, 0.0, -0.002, math.inf])
def test_a_lost_sample_makes_everything_after_it_nan(bad, gap):
    base = sine(3.4, 2000.0, 1)
    base[500] = bad
    with np.errstate(invalid="ignore"):  # of the kernel where it is not compiled
        state, out, _ = run(snm(gap), 2000.0, base)
    assert np.isfinite(out[:, :500]).all()
    assert np.isnan(out[:, 500:]).all()
    assert np.isnan(state).all()
    again = restart(snm(gap), 0.0, 0.0)
    assert np.isfinite(run(snm(gap), 2000.0, sine(3.4, 2000.0, 1), again)[1]).all()


def test_the_bumper_remembers():
    """A released bumper relaxes with C/K and is hit again where it stands then."""
    p = snm(gap_l=math.inf, bumper_damping_r=2e5)
    _, out, events = run(p, 2000.0, sine(1.3, 2000.0, 6))
    release = int(np.ceil(events[1, 0] * 2000)) - 1
    free = out[U_R, release : int(events[2, 0] * 2000)]
    tau = p.bumper_damping_r / p.bumper_stiffness_r
    want = free[0] * np.exp(-np.arange(free.size) / 2000 / tau)
    assert free[0] > 1e-4
    assert free == pytest.approx(want, rel=1e-10)
    second = int(np.ceil(events[2, 0] * 2000)) - 1
    assert out[U_R, second] > 1e-6


def test_a_relaxed_bumper_is_flushed_before_it_is_denormal():
    p = snm()
    state = restart(p, 0.0, 0.0, 1e-3, -1e-3)
    state, _, _ = run(p, 2000.0, np.zeros(1000), state)
    assert state[2] == 0.0 == state[3]


def test_restart_makes_a_state_the_model_allows():
    p = snm()
    pushed = restart(p, 0.003, 0.05, 0.0, 0.0, True, False, base=0.1)
    assert pushed[2] == pytest.approx(0.001)
    assert pushed[4:7].tolist() == [1.0, 0.0, 0.1]
    pulled = restart(p, 0.0021, -0.5, 0.0, 0.0, True, False)
    assert pulled[2] == pytest.approx(0.0001)
    assert pulled[4] == 0.0
    sunk = restart(p, -0.003, -0.05, 0.0, -0.0002)
    assert sunk[3] == pytest.approx(-0.001)
    assert sunk[5] == 1.0
    apart = restart(p, 0.0, 0.1, 0.0005, 0.0, True, False)
    assert apart[2] == 0.0005
    assert apart[4] == 0.0
    none = restart(snm(math.inf), 0.003, 0.05, 0.0, 0.0, True, True)
    assert none[2:6].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_restart_from_the_models_own_state_goes_on_as_before():
    p, con = snm(), closed_form.discretized_params(snm(), 2000.0)
    base = sine(3.4, 2000.0, 2)
    state = kick(p, 0.1)
    for first in range(0, 4000, 37):
        out, other = np.empty((7, 37)), np.empty((7, 37))
        u, v, u_r, u_l, right, left, acceleration = state[:7]
        again = restart(p, u, v, u_r, u_l, right > 0, left > 0, base=acceleration)
        again[7:] = state[7:]
        part = base[first : first + 37]
        closed_form.advance_state(state, con, part, out[:, : part.size])
        closed_form.advance_state(again, con, part, other[:, : part.size])
        assert other[:, : part.size].tobytes() == out[:, : part.size].tobytes()
