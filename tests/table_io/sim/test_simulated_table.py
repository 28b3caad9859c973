"""The simulated machine: its converters, its queue, its clock, and bit-exact repeatability."""

import time
from dataclasses import dataclass

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock, RealClock
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.calibration import command_to_volts, compute_tare, volts_to_si
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.simulated_table import SimulatedBackend

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
SPECIMEN = Specimen.model_validate({"mass_kg": 550.0, "gap_mm": 4.0})
RATE_HZ = 2000.0


@dataclass
class Fixed:
    """A clock that notes what it was asked to wait for."""

    waited: list[float]

    def now(self) -> float:
        return 100.0

    def wait_until(self, when: float) -> None:
        self.waited.append(when)


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
    clock: ManualClock | RealClock | Fixed | None = None,
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


def test_the_cut_into_reads_changes_no_bit() -> None:
    whole = play_run(command(2.0), [4000])
    assert np.abs(row(whole, "force_r1_n")).max() > 0.1  # it did impact: over 100 N
    for samples in (1, 7, 64, 500):
        cuts = [samples] * (4000 // samples) + [4000 % samples]
        assert play_run(command(2.0), cuts).tobytes() == whole.tobytes(), samples


def test_every_clock_sees_the_same_samples_and_the_real_one_keeps_time() -> None:
    fast = play_run(command(0.5), [20] * 20)
    before = time.monotonic()
    real = play_run(command(0.5), [20] * 20, clock=RealClock())
    assert time.monotonic() - before >= 399 / RATE_HZ
    assert real.tobytes() == fast.tobytes()


def test_read_waits_for_its_last_sample_and_for_nothing_else() -> None:
    clock = Fixed([])
    machine = backend(clock=clock)
    machine.tare(100)
    machine.queue(0, command(0.1))
    machine.start()
    assert clock.waited == []
    machine.read(20)
    machine.read(5)
    assert clock.waited == [100.0 + 19 / RATE_HZ, 100.0 + 24 / RATE_HZ]
    assert machine.scheduled_time_s(2000) == 101.0


def test_the_seed_decides_the_noise() -> None:
    samples = play_run(command(0.1), [200])
    assert play_run(command(0.1), [200], card=rig(seed=1)).tobytes() == samples.tobytes()
    assert play_run(command(0.1), [200], card=rig(seed=2)).tobytes() != samples.tobytes()


def test_the_command_is_played_in_steps_and_held_at_the_rails() -> None:
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


def test_what_was_tared_reads_the_truth_with_precompression() -> None:
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


def test_the_cells_of_a_side_share_its_force_in_compression() -> None:
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


def test_beyond_the_queue_the_command_holds_its_last_value() -> None:
    drive = play_run(np.array([0.0, 0.5, 1.0]), [2, 3, 40])[0]
    np.testing.assert_allclose(drive[2:], drive[2])
    assert drive[2] == pytest.approx(6e-3 * RIG.sensors[0].volts_per_si, rel=1e-4)


def test_a_replaced_command_plays_from_its_index_on() -> None:
    volts = command(1.0)
    machine = backend()
    machine.queue(0, volts)
    machine.start()
    head = machine.read(100)
    index = 99 + machine.replace_after
    machine.queue(index, np.full(5, volts[index]))
    replaced = np.concatenate([head, machine.read(400)], axis=1)
    expected = volts.copy()
    expected[index:] = volts[index]
    assert replaced.tobytes() == play_run(expected, [500]).tobytes()


def test_a_gap_in_the_queue_holds_the_value_before_it() -> None:
    machine = backend()
    machine.queue(0, np.array([0.0, 1.0]))
    machine.queue(50, np.array([2.0]))
    machine.start()
    filled = np.concatenate([[0.0], np.full(49, 1.0), [2.0]])
    assert machine.read(100).tobytes() == play_run(filled, [100]).tobytes()


@pytest.mark.parametrize("rate_hz", RIG.rates_hz)
def test_what_is_in_the_device_cannot_be_replaced(rate_hz: float) -> None:
    machine = backend(rate_hz=rate_hz)
    assert machine.replace_after <= 0.05 * rate_hz
    machine.queue(0, command(1.0))
    machine.start()
    machine.read(100)
    earliest = 99 + machine.replace_after
    with pytest.raises(ValueError, match=rf"\b{earliest}\b"):
        machine.queue(earliest - 1, np.zeros(10))
    machine.queue(earliest, np.zeros(10))


@pytest.mark.parametrize("away_s", [0.0, 0.001, 0.3])
def test_the_machine_plays_on_while_nobody_reads(away_s: float) -> None:
    clock = ManualClock()
    machine = backend(clock=clock)
    machine.queue(0, command(1.0))
    machine.start()
    machine.read(100)
    clock.wait_until(clock.now() + away_s)
    newest = 99 + round(away_s * RATE_HZ)
    earliest = newest + machine.replace_after
    with pytest.raises(ValueError, match=rf"\b{earliest}\b"):
        machine.queue(earliest - 1, np.zeros(10))
    machine.queue(earliest, np.zeros(10))
    volts = command(1.0)
    volts[earliest:] = 0.0
    behind = machine.read(900)
    assert behind.tobytes() == play_run(volts, [100, 900])[:, 100:].tobytes()


def test_a_command_that_is_no_number_is_refused() -> None:
    with pytest.raises(ValueError, match="NaN"):
        backend().queue(0, np.array([0.0, np.nan]))


def test_the_queue_does_not_grow_with_the_test() -> None:
    machine = backend()
    machine.queue(0, np.zeros(1000))
    machine.start()
    for taken in range(200, 60_001, 200):
        machine.read(200)
        machine.queue(taken + 100, np.zeros(1000))
    assert machine._command.size < 1300


def test_order_of_life_and_rates_are_kept() -> None:
    with pytest.raises(InputError) as error:
        backend(rate_hz=1234.0)
    assert (error.value.key, error.value.value) == ("acquisition.rate_hz", 1234.0)
    assert error.value.allowed == "1000, 2000, 4000 Hz"
    unopened = SimulatedBackend(RIG, SPECIMEN, RATE_HZ, ManualClock())
    with pytest.raises(RuntimeError, match="open"):
        unopened.queue(0, np.zeros(1))
    machine = backend()
    with pytest.raises(RuntimeError, match="start"):
        machine.read(1)
    machine.start()
    machine.close()
    machine.close()
    with pytest.raises(RuntimeError, match="closed"):
        machine.read(1)
