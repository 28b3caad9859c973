"""Best linear approximation of systems whose response, distortion and noise are known."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from table_io.config.excitation import history_acceleration
from table_io.config.excitation.synthetic import PeriodicMultisine
from tests.builders.profiles import read_shipped_profile
from twin.results.best_linear import approximate
from twin.results.contracts import BestLinearResult, TrackingResult
from twin.results.excitation_verdict import judge_excitation
from twin.results.table_motion import TableMotion, check_lines, format_tracking
from twin.results.tracking import judge_tracking

RATE_HZ, NOISE = 200.0, 0.01
EXCITATION = PeriodicMultisine(
    low_hz=0.5, high_hz=20.0, duration_s=8.0, periods=4, realisations=8, rms_g=0.1, ramp_s=2.0
)
PERIOD_SAMPLES = 1600
LINES = EXCITATION.list_lines(RATE_HZ)


def respond(shift: int = 1, even: float = 0.0, odd: float = 0.0, seed: int = 1) -> BestLinearResult:
    """Return the approximation of 0.8 times the late command, with powers of it and white noise."""
    command = history_acceleration(EXCITATION.displacement(RATE_HZ), RATE_HZ)
    late = np.roll(command, shift)
    output = 0.8 * late + even * late**2 + odd * late**3
    output += NOISE * np.random.default_rng(seed).standard_normal(output.size)
    shown = np.arange(LINES[0], LINES[-1] + 1)
    parts = EXCITATION.list_starts(RATE_HZ)[..., None] + np.arange(PERIOD_SAMPLES)
    inputs, outputs = (
        np.fft.rfft(row[parts])[..., shown] * (2.0 / PERIOD_SAMPLES) for row in (command, output)
    )
    pair = "command", "table_acc_m_s2"
    return approximate(pair, inputs, inputs, outputs, shown, LINES, RATE_HZ / PERIOD_SAMPLES)


def test_linear_system_has_its_response_and_noise_alone() -> None:
    result = respond()
    true = 0.8 * np.exp(-2j * np.pi * np.array(result.frequency_hz) / RATE_HZ)
    known = np.array(result.gain) * np.exp(1j * np.radians(result.phase_deg))
    inside = np.abs(known - true) < np.array(result.half_width)
    assert inside.mean() > 0.9
    assert np.abs(known - true).max() < 0.01
    noise = np.sqrt(np.mean(np.square(result.noise_m_s2)))
    assert noise == pytest.approx(2.0 * NOISE / np.sqrt(PERIOD_SAMPLES), rel=0.05)
    assert result.distortion_ratio < result.noise_ratio
    assert result.band_hz is not None
    assert result.band_hz[1] > 19.0


@pytest.mark.parametrize(("even", "odd"), [(0.05, 0.0), (0.0, 0.05)])
def test_distortion_comes_on_lines_of_its_parity(even: float, odd: float) -> None:
    result = respond(even=even, odd=odd)
    own, other = (
        (result.even_ratio, result.odd_ratio) if even else (result.odd_ratio, result.even_ratio)
    )
    assert own is not None
    assert other is not None
    assert own > 0.02
    assert other < 0.1 * own
    if odd:  # on excited lines too; half of the even distortion would change no odd line
        assert result.distortion_ratio == pytest.approx(own, rel=0.3)


def test_even_lines_and_one_of_four_odd_ones_are_left_out() -> None:
    assert (LINES % 2 == 1).all()
    every = np.arange(LINES[0] | 1, 160, 2)
    assert LINES.size == pytest.approx(0.75 * every.size, abs=2)
    starts = EXCITATION.list_starts(RATE_HZ)
    history = EXCITATION.displacement(RATE_HZ)
    for first, second, *_ in starts.tolist():
        np.testing.assert_allclose(
            history[first : first + PERIOD_SAMPLES],
            history[second : second + PERIOD_SAMPLES],
            atol=1e-12,
        )
    first, other = (history[start : start + PERIOD_SAMPLES] for start in starts[:2, 0])
    assert np.abs(np.corrcoef(first, other)[0, 1]) < 0.5


def weigh_lines(gain: float = 1.0, lost: int = 0, quiet: int = 0) -> tuple[str, TrackingResult]:
    """Return verdict and tracking of a table of a gain that loses samples, or some lines."""
    disp_m = EXCITATION.displacement(RATE_HZ)
    target = history_acceleration(disp_m, RATE_HZ)
    achieved = gain * target
    if quiet:
        spectrum = np.fft.rfft(achieved)
        hz = np.fft.rfftfreq(achieved.size, 1.0 / RATE_HZ)
        spectrum[hz < (LINES[quiet] - 0.5) * RATE_HZ / PERIOD_SAMPLES] = 0.0
        achieved = np.fft.irfft(spectrum, achieved.size)
    achieved[3000 : 3000 + lost] = np.nan
    motion = TableMotion(
        RATE_HZ, 0, 0, target.size, disp_m, target, np.full(target.size, np.nan), achieved
    )
    profile = read_shipped_profile("multisine").model_copy(update={"excitation": EXCITATION})
    error = judge_tracking(target, achieved, RATE_HZ, (0.5, 20.0))
    tracking = TrackingResult(
        **dict(error), from_s=0.0, to_s=1.0, required_spectrum=None,
        lines=check_lines(motion, profile),
    )  # fmt: skip
    summary: Any = SimpleNamespace(run=SimpleNamespace(source="table"), tracking=tracking)
    return judge_excitation(summary, profile).verdict, tracking


def test_multisine_is_judged_by_the_level_of_its_lines() -> None:
    """Not by its peak, which it has by chance: few lines that are off do not count."""
    verdict, tracking = weigh_lines(gain=0.95)
    assert tracking.lines is not None
    assert (verdict, tracking.lines.outside, tracking.lines.count) == ("reached", 0, LINES.size)
    assert tracking.lines.lowest_ratio == pytest.approx(0.95)
    assert weigh_lines(quiet=2)[0] == "reached"
    verdict, tracking = weigh_lines(quiet=20)
    assert tracking.lines is not None
    assert (verdict, tracking.lines.outside) == ("missed", 20)
    assert tracking.lines.lowest_hz is not None
    assert tracking.lines.lowest_hz < LINES[20] / 8.0
    assert "PGA" not in format_tracking(tracking)
    assert weigh_lines(gain=0.8)[0] == "missed"
    assert weigh_lines(lost=5)[0] == "not judged"
