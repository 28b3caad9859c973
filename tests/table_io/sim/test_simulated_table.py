"""The simulated machine: its converters, its queue, its clock, and bit-exact repeatability."""

import time

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock, RealClock
from table_io.config.calibration import command_to_volts, compute_tare, volts_to_si
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import RIG

RATE_HZ = 2000.0


def rig(**simulated: object) -> RigConfig:
    """The machine card with other values in [simulated]."""
    raw = RIG.model_dump()
    raw["simulated"].update(simulated)
    return RigConfig.model_validate(raw)


def sensors(**changes: object) -> RigConfig:
    """The machine card with every sensor changed alike."""
    raw = RIG.model_dump()
    for sensor in raw["sensors"]:
        sensor.update(changes)
    return RigConfig.model_validate(raw)


def backend(
    card: RigConfig = RIG,
    specimen: Specimen = SPECIMEN,
    clock: ManualClock | RealClock | None = None,
    rate_hz: float = RATE_HZ,
) -> SimulatedBackend:
    """An open backend that has not started."""
    machine = SimulatedBackend(card, specimen, rate_hz, clock or ManualClock())
    machine.open()
    return machine


def command(seconds: float, rate_hz: float = RATE_HZ) -> Float1D:
    """Volts of a 1.4 Hz motion that grows from rest over a second; impacts at G4."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    metres = 6e-3 * np.minimum(t, 1.0) ** 3 * np.sin(2 * np.pi * 1.4 * t)
    return command_to_volts(metres, RIG.output)


def play_run(volts: Float1D, cuts: list[int], **options: object) -> Float2D:
    """Samples of a whole run read in blocks of `cuts`."""
    machine = backend(**options)  # type: ignore[arg-type]
    machine.queue(0, volts)
    machine.start()
    return np.concatenate([machine.read(samples) for samples in cuts], axis=1)


def row(values: Float2D, channel: str) -> Float1D:
    line: Float1D = values[RIG.channels.index(channel)]
    return line


def test_every_clock_sees_the_same_samples_and_the_real_one_keeps_time() -> None:
    fast = play_run(command(0.5), [20] * 20)
    before = time.monotonic()
    real = play_run(command(0.5), [20] * 20, clock=RealClock())
    assert time.monotonic() - before >= 399 / RATE_HZ
    assert real.tobytes() == fast.tobytes()


def test_seed_decides_the_noise() -> None:
    samples = play_run(command(0.1), [200])
    assert play_run(command(0.1), [200], card=rig(seed=1)).tobytes() == samples.tobytes()
    assert play_run(command(0.1), [200], card=rig(seed=2)).tobytes() != samples.tobytes()


def test_command_is_played_in_steps_and_held_at_the_rails() -> None:
    raw = RIG.model_dump()
    raw["output"]["bits"] = 12
    step_m = 2 * 60e-3 / 2**12
    volts = np.array([0.0, 0.4, 0.6, 10.2, 3000.0, -3000.0]) * step_m * RIG.output.volts_per_m
    drive = volts_to_si(play_run(volts, [6], card=RigConfig.model_validate(raw)), RIG.sensors, {})[
        0
    ]
    adc_m = 2 * 60e-3 / 2**24
    expected = np.array([0.0, 0.0, 1.0, 10.0, 2047.0, -2048.0]) * step_m
    np.testing.assert_allclose(drive, expected, atol=adc_m)


def test_inputs_come_in_whole_steps_within_their_range() -> None:
    coarse = sensors(bits=10, range=0.01)
    samples = play_run(command(2.0), [4000], card=coarse)
    for line, sensor in zip(samples, coarse.sensors, strict=True):
        step = 2 * 0.01 * sensor.volts_per_unit / 2**10
        codes = line / step
        np.testing.assert_allclose(codes, np.rint(codes), atol=1e-9)
        assert codes.min() >= -512
        assert codes.max() <= 511
    assert row(samples, "table_disp_m").max() == pytest.approx(511 / 512 * 0.01 / 7.5)
    assert row(samples, "table_disp_m").min() == pytest.approx(-0.01 / 7.5)


def test_tare_shows_the_offsets_and_the_stated_noise() -> None:
    values = volts_to_si(backend().tare(20000), RIG.sensors, {})
    for line, sensor in zip(values, RIG.sensors, strict=True):
        sigma = sensor.noise_rms * sensor.si_per_unit
        assert line.mean() == pytest.approx(
            sensor.offset * sensor.si_per_unit, abs=5 * sigma / np.sqrt(20000) + 1e-9
        )
        assert line.std() == pytest.approx(sigma, rel=0.03, abs=1e-9)


def test_noise_is_white_and_of_its_own_in_every_channel() -> None:
    values = backend().tare(20000)[1:]
    correlation = np.corrcoef(np.concatenate([values, np.roll(values, 1, axis=1)]))
    assert np.abs(correlation - np.eye(len(correlation))).max() < 5 / np.sqrt(20000)


def test_tared_sensors_read_precompression() -> None:
    specimen = Specimen.model_validate({"mass_kg": 550.0, "gap_mm": -2.0})
    machine = backend(specimen=specimen)
    tare = compute_tare(machine.tare(20000), RIG.sensors)
    assert "drive_disp_m" not in tare
    machine.queue(0, np.zeros(1))
    machine.start()
    values = volts_to_si(machine.read(20000), RIG.sensors, tare).mean(axis=1)
    expected = [0.0, 0.0, 0.0, 0.0, 0.0, 255.0, 255.0, 255.0, 255.0]  # K_j p / 2 = 510 N / 2
    sigma = np.array([s.noise_rms * s.si_per_unit for s in RIG.sensors]) / np.sqrt(10000)
    assert (np.abs(values - expected) <= 5 * sigma + 1e-9).all()


def test_taring_does_not_change_the_run() -> None:
    machine = backend()
    machine.tare(777)
    machine.queue(0, command(0.1))
    machine.start()
    assert machine.read(200).tobytes() == play_run(command(0.1), [200]).tobytes()


def test_cells_of_a_side_share_its_force_in_compression() -> None:
    samples = play_run(command(2.0), [4000], card=sensors(noise_rms=0.0, offset=0.0))
    values = volts_to_si(samples, RIG.sensors, {})
    cells = values[5:]
    np.testing.assert_array_equal(cells[0], cells[1])
    np.testing.assert_array_equal(cells[2], cells[3])
    assert cells.min() == 0.0
    u = row(values, "mass_disp_m") - row(values, "table_disp_m")
    assert u[np.argmax(cells[0])] > 2e-3
    assert u[np.argmax(cells[2])] < -2e-3
    resisting = 2 * cells[0] - 2 * cells[2]
    v = np.gradient(u, 1 / RATE_HZ)
    lost = 550.0 * row(values, "mass_acc_m_s2") + 1100.0 * v + 36e3 * u + resisting
    assert np.median(np.abs(lost)) < 0.5


def test_queue_does_not_grow_with_the_test() -> None:
    machine = backend()
    machine.queue(0, np.zeros(1000))
    machine.start()
    for taken in range(200, 60_001, 200):
        machine.read(200)
        machine.queue(taken + 100, np.zeros(1000))
    assert machine._command.size < 1300
