"""Faults of instruments are found where they are, with their size; usual laboratories are healthy.

The faults are put on recorded readings here, independently of the simulated laboratory.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import signal

from table_io.block import Block, Float1D, Label, join_blocks
from tests.builders.laboratories import draw_laboratory
from tests.discovery.played import SNM, blocks
from twin.discovery.build_verdict import build_sensors
from twin.discovery.discover import PreparedLog, prepare_problem
from twin.discovery.sensor_checks import SensorCheck, check_sensors, compare_sensors
from twin.discovery.signals import build_signals
from twin.discovery.words import describe_sensors

RATE_HZ, MASS_KG = 1000.0, 550.0
MASS, TABLE = ("mass_disp_m", "mass_acc_m_s2"), ("table_disp_m", "table_acc_m_s2")
RIGHT = ("force_r1_n", "force_r2_n")
Distortion = Callable[[Float1D, Block], Float1D]


def check(block: Block) -> tuple[SensorCheck, ...]:
    """Return the checks of a recording."""
    log = PreparedLog(build_signals((block,), "log", MASS_KG, (0.002, 0.002)), 0.0)
    prepared = prepare_problem([log], SNM)
    return check_sensors(prepared.problem.log_residuals, prepared.first_fit, True)


def test_a_gap_read_wrongly_is_blamed_only_where_nothing_else_is_left() -> None:
    signals = build_signals((record(),), "log", MASS_KG, (0.0024, 0.0024))
    prepared = prepare_problem([PreparedLog(signals, 0.0)], SNM)
    for is_explained in (True, False):
        checks = check_sensors(prepared.problem.log_residuals, prepared.first_fit, is_explained)
        blamed = [c.value for c in checks if c.kind == "gap" and not c.is_healthy]
        assert blamed == [pytest.approx(-4e-4, abs=5e-5)] * (2 if is_explained else 0)


@cache
def record() -> Block:
    return join_blocks(blocks())


def distort(channel: str, distortion: Distortion) -> Block:
    """Return the recording with other readings of a channel."""
    block = record()
    values = block.values.copy()
    values[block.channels.index(channel)] = distortion(block.channel(channel), block)
    return replace(block, values=values)


def find_faults(block: Block) -> dict[tuple[str, tuple[str, ...]], SensorCheck]:
    """Return the checks that are not healthy, by kind and channels."""
    return {(c.kind, c.channels): c for c in check(block) if not c.is_healthy}


def noise_of(values: Float1D, block: Block) -> float:
    at_rest = np.cumsum(block.label != Label.REST) == 0
    return float(values[at_rest].std())


def add_hum(values: Float1D, block: Block) -> Float1D:
    time_s = np.arange(values.size) / RATE_HZ
    hum: Float1D = 8.0 * np.sqrt(2.0) * np.sin(2 * np.pi * 49.98 * time_s + 1.0)
    return values + noise_of(values, block) * hum


def filter_low(values: Float1D, block: Block) -> Float1D:
    b, a = signal.butter(4, 90.0, fs=RATE_HZ)
    filtered: Float1D = signal.lfilter(b, a, values)
    return filtered


def filter_high(values: Float1D, block: Block) -> Float1D:
    b, a = signal.butter(1, 0.5, "highpass", fs=RATE_HZ)
    filtered: Float1D = signal.lfilter(b, a, values)
    return filtered


def delay(values: Float1D, block: Block) -> Float1D:
    places = np.arange(values.size)
    return np.interp(places - 0.7, places, values)


FAULTS: dict[str, tuple[str, Distortion, str, tuple[str, ...], float]] = {
    "hum": ("force_l2_n", add_hum, "hum", ("force_l2_n",), 8.0),
    "filter": ("mass_acc_m_s2", filter_low, "filter", ("mass_acc_m_s2",), 90.0),
    "low cut": ("table_acc_m_s2", filter_high, "low_cut", TABLE, 0.5),
    "lag": ("mass_acc_m_s2", delay, "lag", MASS, 7e-4),
    "gain": ("mass_acc_m_s2", lambda x, _: 1.03 * x, "gain", MASS, 0.03),
    "resolution": (
        "mass_acc_m_s2", lambda x, _: 0.2 * np.round(x / 0.2), "resolution", ("mass_acc_m_s2",),
        0.0,
    ),
    "cell": ("force_r1_n", lambda x, _: 1.4 * x, "share", RIGHT, 0.2 / 2.4),
    "plate": (
        "force_r1_n", lambda x, block: x - 9.0 * block.channel("table_acc_m_s2"), "plate", RIGHT,
        9.0 / MASS_KG,
    ),
}  # fmt: skip


def test_ideal_instruments_are_healthy() -> None:
    checks = check(record())
    assert all(c.is_healthy for c in checks)
    assert {c.kind for c in checks} >= {"noise", "hum", "gain", "lag", "low_cut", "share", "plate"}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_on_its_channel_with_its_size(name: str) -> None:
    channel, distortion, kind, channels, size = FAULTS[name]
    faults = find_faults(distort(channel, distortion))
    fault = faults[kind, channels]
    if size:
        assert fault.value == pytest.approx(size, rel=0.2)
    places = {place for check in faults.values() for place in check.channels}
    assert places <= {*MASS, *channels} if channel.startswith("mass") else places <= {*channels}


def discard_peaks(channel: str, share: float) -> Block:
    """Return the recording with lost samples where a channel exceeds a share of its largest."""
    limit = share * np.abs(record().channel(channel)).max()
    return distort(channel, lambda x, _: np.where(np.abs(x) < limit, x, np.nan))


@pytest.mark.parametrize(("share", "count"), [(0.0, 0), (0.01, 1)])
def test_what_healthy_sensors_of_a_rocking_mass_disagree_by_is_stated(
    share: float, count: int
) -> None:
    def rock(values: Float1D, _: Block) -> Float1D:
        f = np.fft.rfftfreq(values.size, 1.0 / RATE_HZ)
        gain = 1.0 + share / (1.0 - (f / 7.0) ** 2 + 0.1j * f / 7.0)
        return np.fft.irfft(np.fft.rfft(values) * gain, values.size)

    sensors = build_sensors(check(distort("mass_acc_m_s2", rock)))
    verdict, *lines = describe_sensors(sensors)
    assert verdict == "sensors: healthy"
    assert len(lines) == count
    assert all("disagreement left of mass_disp_m against mass_acc_m_s2" in line for line in lines)


def test_the_peaks_of_a_laser_that_are_cut_off_are_a_fault() -> None:
    limit_m = 0.8 * np.abs(record().channel(MASS[0])).max()
    assert ("remainder", MASS) in find_faults(
        distort(MASS[0], lambda x, _: np.clip(x, -limit_m, limit_m))
    )


@pytest.mark.parametrize(
    ("channel", "share"),
    [(MASS[0], 0.8), (MASS[0], 0.3), (MASS[1], 0.3), ("force_r1_n", 0.5), ("force_r1_n", 0.2)],
)
def test_samples_that_are_known_to_be_invalid_are_no_fault(channel: str, share: float) -> None:
    lost = discard_peaks(channel, share)
    assert find_faults(lost) == {}
    values = lost.values.copy()
    values[lost.channels.index(MASS[1])] = delay(lost.channel(MASS[1]), lost)
    fault = find_faults(replace(lost, values=values))["lag", MASS]
    assert fault.value == pytest.approx(7e-4, rel=0.2)


def test_hum_that_could_not_be_taken_off_is_no_disagreement() -> None:
    """As where a harmonic of the drive hides it for most of the time."""
    clean = build_signals((record(),), "log", MASS_KG, (0.002, 0.002))
    time_s = np.arange(clean.time_s.size) * clean.grid.decimation / clean.grid.rate_hz
    hum = clean.grid.from_time_domain(6.0 * np.sin(2 * np.pi * 50.02 * time_s))
    humming = replace(clean, spectra={**clean.spectra, MASS[1]: clean.spectra[MASS[1]] + hum})
    for lines_hz, is_healthy in (((), False), ((50.04,), True)):
        checks = compare_sensors(replace(humming, hum_hz=lines_hz))
        of_mass = [check for check in checks if check.channels == MASS]
        assert of_mass
        assert all(check.is_healthy for check in of_mass) is is_healthy


def test_an_offset_beside_lost_samples_is_no_noise() -> None:
    lost = discard_peaks(MASS[0], 0.8)
    values = lost.values.copy()
    values[lost.channels.index(MASS[1])] += 0.02
    noises = [
        build_signals((block,), "log", MASS_KG, (0.002, 0.002)).calibrate_noise().noise[MASS[1]]
        for block in (lost, replace(lost, values=values))
    ]
    assert noises[1] == pytest.approx(noises[0], rel=0.2)


@pytest.mark.parametrize(
    "seed", [1, pytest.param(2, marks=pytest.mark.slow), pytest.param(3, marks=pytest.mark.slow)]
)
def test_a_usual_laboratory_is_healthy(seed: int) -> None:
    laboratory = draw_laboratory("typical", np.random.default_rng(seed))
    truth = ""
    for entry in laboratory:
        place = f'channel = "{entry.channel}"\n' if entry.channel else ""
        place += f'side = "{entry.side}"\n' if entry.side else ""
        numbers = ", ".join(
            f"{key} = {value!r}" for key, value in entry.parameters.items() if np.isfinite(value)
        )
        truth += f'[[imperfections]]\nid = "{entry.id}"\nform = "{entry.form}"\n{place}'
        truth += f"parameters = {{ {numbers} }}\n"
    assert find_faults(join_blocks(blocks(truth))) == {}


@pytest.mark.parametrize("kind", ["offset", "filter"])
def test_a_judgement_is_plain_whatever_its_numbers_are(kind: str) -> None:
    value, low, high, limit = map(np.float64, (0.5, -1.0, 1.0, 0.1))
    judged = SensorCheck("", kind, (), value, low, high, limit)
    assert judged.is_healthy is True
