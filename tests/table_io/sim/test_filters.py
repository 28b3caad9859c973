"""Filters of sampled signals against independent formulations."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import signal

from table_io.block import Float2D
from table_io.sim.laboratory import AnalogFilter, FractionalDelay

RATE_HZ = 1000.0
TURN = 2 * np.pi
OSCILLATOR = [30.0 * complex(-0.1, 0.99), 30.0 * complex(-0.1, -0.99)]


@pytest.mark.parametrize(
    ("zeros", "poles", "gain"),
    [
        ([], [-50.0 + 0j], 50.0),
        ([0j], [-1.0 + 0j], 1.0),
        ([0j], [-10.0 + 0j, -100.0 + 0j], 7.0),
        ([], OSCILLATOR, 900.0),
        ([-150.0 + 0j], OSCILLATOR, 6.0),
        ([0j, 0j], OSCILLATOR, 2.5),
        ([], [*OSCILLATOR, -4000.0 + 0j], 3e6),
    ],
)
def test_filter_is_exact_for_lines_between_samples(
    zeros: list[complex], poles: list[complex], gain: float
) -> None:
    noise = np.random.default_rng(0).standard_normal((2, 400))
    noise[:, 0] = 0.0
    t = np.arange(400) / RATE_HZ
    ours = AnalogFilter(zeros, poles, gain, RATE_HZ).apply(noise)
    system = signal.ZerosPolesGain(zeros, poles, gain)
    for row, line in zip(ours, noise, strict=True):
        expected = signal.lsim(system, line, t, interp=True)[1]
        np.testing.assert_allclose(row, expected.real, rtol=0, atol=1e-8 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("zeros", "poles", "static"), [([], OSCILLATOR, 900 / 891.09), ([0j], [-0.5 + 0j], 0.0)]
)
def test_it_starts_in_the_steady_state_of_its_first_sample(
    zeros: list[complex], poles: list[complex], static: float
) -> None:
    gain = 900.0 if not zeros else 1.0
    out = AnalogFilter(zeros, poles, gain, RATE_HZ).apply(np.full((1, 500), 3.0))
    np.testing.assert_allclose(out, 3.0 * static, atol=1e-9)


@pytest.mark.parametrize("samples", [1, 7, 64])
def test_division_changes_no_bit(samples: int) -> None:
    values = np.random.default_rng(1).standard_normal((3, 300))

    def run(cuts: list[int]) -> tuple[Float2D, Float2D]:
        edges = np.cumsum([0, *cuts])
        analog, delay = AnalogFilter([0j], OSCILLATOR, 2.0, RATE_HZ), FractionalDelay(3.7)
        parts = [values[:, a:b] for a, b in pairwise(edges)]
        return (
            np.concatenate([analog.apply(part) for part in parts], axis=1),
            np.concatenate([delay.apply(part[0])[None] for part in parts], axis=1),
        )

    divided = run([samples] * (300 // samples) + [300 % samples])
    for whole, cut in zip(run([300]), divided, strict=True):
        assert whole.tobytes() == cut.tobytes()


@pytest.mark.parametrize("lag", [0.0, 0.16, 1.0, 2.5, 17.3])
def test_delay_moves_a_cubic_exactly(lag: float) -> None:
    t = np.arange(60.0)

    def cubic(at: np.ndarray) -> np.ndarray:
        return 1.0 + 0.3 * at - 0.02 * at**2 + 1e-3 * at**3

    delayed = FractionalDelay(lag).apply(cubic(t))
    np.testing.assert_allclose(delayed[21:], cubic(t - lag)[21:], rtol=1e-12)
    assert delayed[0] == pytest.approx(1.0)  # constant before sample 0
