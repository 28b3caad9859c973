"""Synthetic kinds of excitation against closed forms: pulses, chirp, random, cyclic protocol."""

from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.config.excitation import History, find_excitation
from table_io.config.excitation.waveform import interpolate_level, smoothstep
from table_io.units import GRAVITY_M_S2
from tests.input_errors import raises_input_error

RATE_HZ = 2000.0


def make(kind: str, **keys: Any) -> History:
    excitation = find_excitation(kind).model_validate({"kind": kind, **keys})
    assert isinstance(excitation, History)
    return excitation


def accelerate(displacement: Float1D) -> Float1D:
    """Acceleration in m/s2 by second differences, rest around it."""
    return np.diff(displacement, 2, prepend=0.0, append=0.0) * RATE_HZ**2


@pytest.mark.parametrize(("cycles", "pulses"), [(1, 1), (5, 1), (4, 3)])
def test_sine_pulse_has_the_stated_peak_and_cycles(cycles: int, pulses: int) -> None:
    keys = {"frequency_hz": 2.0, "acceleration_g": 0.1, "cycles": cycles, "pulses": pulses}
    played = make("sine_pulse", **keys, pause_s=0.75).displacement(RATE_HZ)
    assert played.size == pytest.approx(
        RATE_HZ * (pulses * cycles / 2 + 0.75 * (pulses - 1)), abs=4
    )
    assert np.abs(accelerate(played)).max() == pytest.approx(0.1 * GRAVITY_M_S2, rel=1e-3)
    assert np.count_nonzero(np.diff(np.sign(played[played != 0.0]))) == 2 * cycles * pulses - 1
    first = played[: round(RATE_HZ * cycles / 2) + 1]
    t = np.arange(first.size) / RATE_HZ
    shape = np.sin(np.pi * t * 2 / cycles) ** 2 * np.sin(2 * np.pi * 2 * t)
    assert np.corrcoef(first, shape)[0, 1] > 1 - 1e-9


@pytest.mark.parametrize("direction", ["right", "left"])
@pytest.mark.parametrize(("duration_s", "ratio"), [(0.2, 0.2), (0.05, 0.1), (0.1, 1.0)])
def test_half_sine_returns_to_rest_with_the_closed_form_of_its_peak(
    duration_s: float, ratio: float, direction: str
) -> None:
    keys = {"duration_s": duration_s, "compensation": ratio, "direction": direction}
    played = make("half_sine", acceleration_g=0.3, **keys).displacement(RATE_HZ)
    peak, sign = 0.3 * GRAVITY_M_S2, 1.0 if direction == "right" else -1.0
    deepest = peak * duration_s**2 * (1 / (4 * np.pi * ratio) + 1 / np.pi**2)
    assert -sign * played[played.size // 2] == pytest.approx(deepest, rel=1e-6)
    assert np.abs(played).max() == pytest.approx(deepest, rel=1e-6)
    assert played[0] == played[-1] == 0.0
    acceleration = sign * accelerate(played)
    t = (np.arange(played.size) - played.size // 2) / RATE_HZ
    inside = np.abs(t) < 0.5 * duration_s
    assert np.abs(acceleration - peak * np.cos(np.pi * t / duration_s))[inside].max() < 0.01 * peak
    assert acceleration.min() == pytest.approx(-ratio * peak, rel=0.01)
    assert abs(acceleration.sum()) / RATE_HZ < 1e-6  # m/s left


def measure_cycles(acceleration: Float1D) -> tuple[Float1D, Float1D]:
    """Frequency in Hz and peak in m/s2 of each half cycle, by zero crossings."""
    crossings = np.flatnonzero(np.diff(np.sign(acceleration)))
    edges = crossings + acceleration[crossings] / (
        acceleration[crossings] - acceleration[crossings + 1]
    )
    peaks = [np.abs(acceleration[a : b + 1]).max() for a, b in zip(crossings, crossings[1:])]  # noqa: B905, RUF007
    return 0.5 * RATE_HZ / np.diff(edges), np.array(peaks)


@pytest.mark.parametrize("law", ["linear", "logarithmic"])
@pytest.mark.parametrize(("start", "stop"), [(1.0, 8.0), (8.0, 1.0)])
def test_chirp_passes_all_frequencies_at_its_level(law: str, start: float, stop: float) -> None:
    chirp = make("chirp", start_hz=start, stop_hz=stop, duration_s=60.0, law=law)
    played = chirp.displacement(RATE_HZ)
    frequency, peak = measure_cycles(accelerate(played))
    middle = slice(8, -8) if start < stop else slice(20, -8)
    assert peak[middle] == pytest.approx(0.05 * GRAVITY_M_S2, rel=0.02)
    assert (frequency[middle].min(), frequency[middle].max()) == (
        pytest.approx(1.0, rel=0.05),
        pytest.approx(8.0, rel=0.02),
    )
    ramps = np.array([3 / start, 3 / stop])
    assert played.size / RATE_HZ == pytest.approx(60.0 + np.maximum(ramps, 0.5).sum(), abs=1e-3)
    half = round((max(3 / start, 0.5) + 30.0) * RATE_HZ)  # the middle of the sweep
    around = np.flatnonzero(np.diff(np.sign(accelerate(played))))
    near = np.argsort(np.abs(around - half))[:2]
    measured = 0.5 * RATE_HZ / abs(float(np.diff(around[near])[0]))
    expected = 0.5 * (start + stop) if law == "linear" else np.sqrt(start * stop)
    assert measured == pytest.approx(expected, rel=0.03)


def test_chirp_follows_the_break_points_of_its_level() -> None:
    points = [[1.0, 0.01], [3.0, 0.06], [9.0, 0.06]]
    chirp = make("chirp", start_hz=1.0, stop_hz=9.0, duration_s=100.0, level_points=points)
    acceleration = accelerate(chirp.displacement(RATE_HZ))
    frequency, peak = measure_cycles(acceleration)
    middle = slice(10, -10)
    expected = np.where(frequency < 3.0, 0.06 * (frequency / 3.0) ** (np.log(6) / np.log(3)), 0.06)
    assert peak[middle] == pytest.approx(expected[middle] * GRAVITY_M_S2, rel=0.04)
    jerk = np.abs(np.diff(acceleration)).max() * RATE_HZ
    assert jerk < 1.2 * 0.06 * GRAVITY_M_S2 * 2 * np.pi * 9.0  # no kink at 3 Hz


@pytest.mark.parametrize("corner_hz", [None, 3.0])
@pytest.mark.parametrize("seed", [1, 7])
def test_noise_has_the_rms_and_the_spectrum_that_are_stated(
    corner_hz: float | None, seed: int
) -> None:
    keys = {"low_hz": 0.5, "high_hz": 15.0, "rms_g": 0.04, "duration_s": 40.0, "seed": seed}
    played = make("random", **keys, corner_hz=corner_hz, ramp_s=1.5).displacement(RATE_HZ)
    assert played.size == 43 * RATE_HZ + 1
    period = played[3000:83000]
    f = np.fft.rfftfreq(period.size, 1 / RATE_HZ)
    lines = np.abs(np.fft.rfft(period)) * 2 / period.size * (2 * np.pi * f) ** 2
    inside = (f >= 0.5) & (f <= 15.0)
    assert np.sqrt((lines**2).sum() / 2) == pytest.approx(0.04 * GRAVITY_M_S2, rel=1e-6)
    shape = np.minimum(f / (corner_hz or 0.5), 1.0)[inside]
    assert lines[inside] / lines[inside].max() == pytest.approx(shape, rel=1e-6)
    assert lines[~inside].max() < 1e-6 * lines[inside].max()
    flat = accelerate(played)[3000:83000]
    assert flat.std() == pytest.approx(0.04 * GRAVITY_M_S2, rel=1e-3)
    assert 2.5 < np.abs(flat).max() / flat.std() < 5.0  # crest factor of noise


def test_noise_is_the_same_for_a_seed_and_at_any_rate() -> None:
    keys = {"low_hz": 0.5, "high_hz": 15.0, "duration_s": 20.0}
    first = make("random", **keys).displacement(2000.0)
    assert first.tobytes() == make("random", **keys).displacement(2000.0).tobytes()
    assert np.abs(first[::2] - make("random", **keys).displacement(1000.0)).max() < 1e-9
    other = make("random", **keys, seed=2).displacement(2000.0)
    assert abs(np.corrcoef(first, other)[0, 1]) < 0.3
    # A version of numpy that changed these would change what a seed stands for.
    assert np.random.PCG64(1).random_raw() == 9441442522235856127


def test_cyclic_protocol_has_the_stated_cycles_of_each_amplitude() -> None:
    blocks = [[2.0, 0.5, 3], [5.0, 0.5, 2], [5.0, 0.5, 1], [3.0, 1.0, 4]]
    played = 1e3 * make("cyclic", protocol=blocks).displacement(RATE_HZ)
    for amplitude, count in ((2.0, 3), (5.0, 3), (3.0, 4)):
        tops = (played[1:-1] > played[:-2]) & (played[1:-1] >= played[2:])
        exact = np.abs(played[1:-1] - amplitude) < 1e-4 * amplitude
        assert np.count_nonzero(tops & exact) in (count, count + 1)
    blend_s = 1.5 / 0.5 + 1.5 / 0.5 + 1.5 / 0.75 + 1.5 / 1.0
    assert played.size / RATE_HZ == pytest.approx(6 / 0.5 + 4 / 1.0 + blend_s, abs=1e-3)
    assert played[0] == 0.0
    assert abs(played[-1]) < 1e-6
    velocity = np.abs(np.diff(played)).max() * RATE_HZ
    assert velocity == pytest.approx(2 * np.pi * 3.0 * 1.0, rel=0.02)  # no jump between blocks


def test_ramp_has_no_kink() -> None:
    x = np.linspace(-0.5, 1.5, 2001)
    ramp = smoothstep(x)
    assert (ramp[x <= 0] == 0).all()
    assert (ramp[x >= 1] == 1).all()
    assert np.abs(np.diff(ramp, 2)).max() / 1e-6 == pytest.approx(5.7735, rel=1e-3)


def test_level_is_linear_in_logarithms() -> None:
    points = ((1.0, 0.01), (4.0, 0.04), (8.0, 0.02))
    levels = interpolate_level(points, np.array([1.0, 2.0, 4.0, np.sqrt(32.0)]))
    assert levels == pytest.approx([0.01, 0.02, 0.04, 0.02 * np.sqrt(2)])


CHIRP = {"start_hz": 1.0, "stop_hz": 8.0, "duration_s": 10.0}
NOISE = {"low_hz": 0.5, "high_hz": 15.0}


@pytest.mark.parametrize(
    ("kind", "keys", "rate_hz"),
    [("half_sine", {"duration_s": 0.004}, 2000.0), ("random", NOISE | {"high_hz": 450.0}, 1000.0)],
)
def test_kind_too_fast_for_the_rate_is_refused(
    kind: str, keys: dict[str, Any], rate_hz: float
) -> None:
    with raises_input_error(where=f"excitation {kind!r}") as refusal:
        make(kind, **keys).plan(rate_hz)
    assert refusal.value.allowed
