"""Both exact drivers on models and drives drawn at random, beside DOP853 with events."""

import math

import numpy as np
import pytest

from tests.model.motion import U_L, U_R, U, kick, run
from tests.model.reference import linear_between, reference
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.event_driven_map import make_period_map
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.stepped_sine import simulate_stepped_sine

SIZE_M = 3e-3  # m: of gaps and motions
POSITION_M, FEWEST_STEPS, LONGEST = 1e-9, 30, 150


def draw_model(random: np.random.Generator) -> tuple[Parameters, float, float]:
    """(a model, its flight frequency and that of its fastest contact in 1/s).

    Bumpers from soft to 200 times the damper, with relaxation from 0.1 ms to 3 s, so under- and
    overdamped in contact; free flight from undamped to overdamped; gaps unequal, precompressed,
    none at all or without a bumper.
    """
    mass, w = 10 ** random.uniform(1.5, 3.7), 2 * math.pi * 10 ** random.uniform(-0.5, 0.9)
    k = mass * w * w
    ratio = random.choice([0.0, 10 ** random.uniform(-3, 0.7)])
    k_j, tau = k * 10 ** random.uniform(-0.5, 2.3, 2), 10 ** random.uniform(-4, 0.5, 2)
    gap = random.choice([-1, 1], 2, p=[0.3, 0.7]) * SIZE_M * 10 ** random.uniform(-2, 0.7, 2)
    if random.uniform() < 0.2:
        gap[random.integers(2)] = random.choice([math.inf, 0.0])
    c_j = (k_j * tau).tolist()
    (right, left), (gap_r, gap_l) = k_j.tolist(), gap.tolist()
    p = Parameters(mass, k, 2 * ratio * mass * w, right, c_j[0], left, c_j[1], gap_r, gap_l)
    return p, w, math.sqrt((k + right + left) / mass)


def start_of(p: Parameters, w: float, random: np.random.Generator) -> np.ndarray:
    return kick(p, SIZE_M * w * random.normal(0, 2))


def sampled_errors(seed: int) -> tuple[float, float, int]:
    """(largest error of position in m and of event times in s, events) of the sampled driver."""
    random = np.random.default_rng(seed)
    p, w, fast = draw_model(random)
    rate = 10 * fast / math.pi * 10 ** random.uniform(-1.5, 0.3)
    t = np.arange(round(np.clip(random.uniform(2, 6) * 2 * math.pi / w * rate, 20, LONGEST))) / rate
    base = np.sum([random.normal() * np.sin(w * random.uniform(0.2, 3) * t) for _ in range(4)], 0)
    base = base * SIZE_M * w**2 * random.uniform(0.3, 3)
    start, drive = start_of(p, w, random), linear_between(t, base)
    touch = bool(start[4]), bool(start[5])
    want, contacts = reference(p, start[:4], touch, drive, t, dt=1 / (FEWEST_STEPS * fast))
    _, out, impacts = run(p, rate, base[1:], start)
    assert impacts[:, 1:3].tolist() == (contacts[:, 1:] * [-2, 1] + [1, 0]).tolist()
    late = np.abs(impacts[:, 0] - contacts[:, 0]).max(initial=0.0)
    return np.abs(out[[U, U_R, U_L]] - want[[0, 2, 3], 1:]).max(), late, len(impacts)


def stepped_errors(seed: int) -> tuple[float, float, int]:
    """The same of the stepped-sine driver, over three cycles."""
    random = np.random.default_rng(seed)
    p, w, fast = draw_model(random)
    w_drive, peak = w * random.uniform(0.3, 3), SIZE_M * w**2 * random.uniform(0.1, 2)
    start, hz = start_of(p, w, random), w_drive / (2 * math.pi)
    touch, ends = (bool(start[4]), bool(start[5])), np.array([0.0, 3 / hz])
    want, contacts = reference(
        p, start[:4], touch, lambda t: peak * math.sin(w_drive * t), ends,
        dt=1 / (FEWEST_STEPS * fast),
    )  # fmt: skip
    period_map = make_period_map(Model(p), hz, peak)
    assert isinstance(period_map, ClosedFormMap)
    impacts, x = period_map.find_contacts(start.take(period_map.indices), 3)
    state = period_map.to_state(x)
    assert impacts[:, 1:].tolist() == contacts[:, 1:].tolist()
    end = simulate_stepped_sine(p, [hz], peak, 3, 8, start).states[0]
    error = max(
        np.abs(state_vector[:4] - want[:, -1])[[0, 2, 3]].max() for state_vector in (state, end)
    )
    return error, np.abs(impacts[:, 0] / hz - contacts[:, 0]).max(initial=0.0), len(impacts)


@pytest.mark.slow  # 2 s each
@pytest.mark.parametrize("driver", [sampled_errors, stepped_errors])
def test_random_models_agree_with_dop853(driver):
    """To 1e-9 m; what is between that and 1e-15 is how a motion with many contacts spreads."""
    errors = np.array([driver(seed) for seed in range(8, 16)])
    assert (errors[:, 0] < POSITION_M).all()
    assert np.median(errors[:, 0]) < 1e-14
    assert errors[:, 2].sum() > 50


@pytest.mark.slow
@pytest.mark.parametrize("driver", [sampled_errors, stepped_errors])
def test_two_hundred_random_models_agree_with_dop853(driver):
    assert all(driver(seed)[0] < POSITION_M for seed in range(100, 300))


def test_the_draw_holds_overdamped_and_underdamped_contacts():
    over = 0
    for seed in range(24):
        p, _, _ = draw_model(np.random.default_rng(seed))
        c, k = p.damping + p.bumper_damping_r, p.stiffness + p.bumper_stiffness_r
        over += c * c > 4 * p.mass * k
    assert 6 <= over <= 18
