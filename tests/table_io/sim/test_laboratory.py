"""Imperfect laboratory: each imperfection against a closed form or its measured response."""

import math
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.config.base import parse_toml
from table_io.config.calibration import compute_tare, volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.ground_truth import GroundTruth
from table_io.sim.imperfections import (
    IMPERFECTION_DEFINITIONS,
    IMPERFECTION_IDS,
    Imperfection,
    ImperfectionDefinition,
)
from table_io.sim.laboratory import Laboratory
from table_io.sim.plant import Plant
from table_io.sim.simulated_table import Digitizer, SimulatedBackend, hide_laws
from tests.builders.laboratories import draw_laboratory
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import RIG, change_rig
from tests.builders.truths import seal_truth
from tests.input_errors import raises_input_error

CHANNELS = RIG.channels
RATE_HZ = 2000.0
GRAVITY_M_S2 = 9.80665
TURN = 2 * np.pi
ROW = {name: row for row, name in enumerate(CHANNELS)}
ACCELEROMETERS = [ROW["table_acc_m_s2"], ROW["mass_acc_m_s2"]]
SILENT = change_rig(every_sensor={"noise_rms": 0.0})
NOISE = np.array([s.noise_rms * s.si_per_unit for s in RIG.sensors])


def imperfection(name: str, **keys: object) -> Imperfection:
    """An entry: channel, side and form are keys, the rest parameters."""
    places = {key: keys.pop(key) for key in ("channel", "side", "form") if key in keys}
    return Imperfection.model_validate({"id": name, "parameters": keys} | places)


def laboratory(
    *entries: Imperfection,
    rate: float = RATE_HZ,
    seed: int = 1,
    first: int = 0,
    rig: RigConfig = RIG,
) -> Laboratory:
    return Laboratory(entries, rig, rate, seed, np.random.default_rng([seed, 9]), first)


def take_readings(
    *entries: Imperfection, rate: float = RATE_HZ, signals: Float2D | None = None, **values: Float1D
) -> Float2D:
    """Readings without noise where the named channels and the signals of the plant are so."""
    count = signals.shape[1] if signals is not None else len(next(iter(values.values())))
    true = np.zeros((len(CHANNELS), count))
    for name, line in values.items():
        true[ROW[name]] = line
    plain = np.zeros((6, count)) if signals is None else signals
    return laboratory(*entries, rate=rate).measure(true, plain)


def disturbance(
    *entries: Imperfection, count: int, rate: float = RATE_HZ, seed: int = 1
) -> Float2D:
    """What is added at the converter to a signal of zero without white noise."""
    zeros = np.zeros((len(CHANNELS), count))
    return laboratory(*entries, rate=rate, seed=seed).condition(zeros, zeros)


def harmonic(line: Float1D, frequency: float, rate: float) -> complex:
    """Complex amplitude at a frequency by least squares, with an offset."""
    t = np.arange(line.size) / rate
    basis = np.stack([np.cos(TURN * frequency * t), np.sin(TURN * frequency * t), np.ones_like(t)])
    a, b, _ = np.linalg.lstsq(basis.T, line, rcond=None)[0]
    return complex(a, -b)


def machine(folder: Path, entries: list[Imperfection] | None, **keys: float) -> SimulatedBackend:
    """An open machine with these imperfections; None: with an empty truth."""
    table = GroundTruth(imperfections=tuple(entries or ()))
    lines = []
    for e in table.imperfections:
        places = {"channel": e.channel, "side": e.side, "form": e.form}
        text = "".join(f'{key} = "{value}"\n' for key, value in places.items() if value)
        numbers = ", ".join(f"{key} = {value!r}" for key, value in e.parameters.items())
        lines.append(f'[[imperfections]]\nid = "{e.id}"\n{text}parameters = {{ {numbers} }}\n')
    keys_of_truth = seal_truth(folder, "".join(lines))
    rig = change_rig(every_sensor=keys, simulated=keys_of_truth)
    backend = SimulatedBackend(rig, SPECIMEN, RATE_HZ, ManualClock())
    backend.open()
    return backend


def take_samples(backend: SimulatedBackend, cuts: list[int], frequency: float = 1.4) -> Float2D:
    """Volts of a sine of 6 mm; impacts at 1.4 Hz."""
    t = np.arange(sum(cuts)) / RATE_HZ
    metres = 6e-3 * np.minimum(t, 1.0) ** 3 * np.sin(TURN * frequency * t)
    backend.queue(0, metres * RIG.output.volts_per_m)
    backend.start()
    return np.concatenate([backend.read(samples) for samples in cuts], axis=1)


# Laws over all imperfections


@pytest.mark.parametrize("level", ["typical", "bad"])
def test_division_into_reads_changes_no_bit(tmp_path: Path, level: str) -> None:
    entries = draw_laboratory(level, np.random.default_rng(5))  # type: ignore[arg-type]
    assert {e.id for e in entries} == set(IMPERFECTION_IDS)
    whole = take_samples(machine(tmp_path, entries), [2600])
    assert np.abs(whole[ROW["force_r1_n"]]).max() > 0.1  # it did impact
    for samples in (1, 7, 64, 500):
        cuts = [samples] * (2600 // samples) + [2600 % samples]
        assert take_samples(machine(tmp_path, entries), cuts).tobytes() == whole.tobytes(), samples


def at(definition: ImperfectionDefinition, share: float) -> Imperfection:
    """Imperfection with its sizes at a share of the bad ones' distance from vanishing."""
    given = {}
    for p in definition.parameters:
        assert p.bad is not None
        if p.vanishing == np.inf:
            given[p.name] = np.inf if share == 0.0 else p.bad / share
        elif p.vanishing is not None and p.is_integer:
            given[p.name] = p.bad if share == 1.0 else p.vanishing
        elif p.vanishing is not None:
            given[p.name] = p.vanishing + share * (p.bad - p.vanishing)
    return imperfection(definition.id, form=definition.form, **given)


def test_every_imperfection_vanishes_at_its_vanishing_value(tmp_path: Path) -> None:
    absent = [at(d, 0.0) for d in IMPERFECTION_DEFINITIONS if d.form != "bessel"]
    assert {e.id for e in absent} == set(IMPERFECTION_IDS)
    none = machine(tmp_path, None)
    nominal = none.tare(200), take_samples(none, [1600])
    backend = machine(tmp_path, absent)
    assert backend.tare(200).tobytes() == nominal[0].tobytes()
    assert take_samples(backend, [1600]).tobytes() == nominal[1].tobytes()


ON_THE_MOTION = ("table_pitch", "mass_reading", "gap_reading", "time_base")


@pytest.mark.parametrize(
    "definition",
    [d for d in IMPERFECTION_DEFINITIONS if d.id not in ON_THE_MOTION],
    ids=lambda d: f"{d.id}-{d.form}",
)
def test_tiny_imperfection_does_next_to_nothing_and_a_bad_one_something(
    definition: ImperfectionDefinition,
) -> None:
    t = np.arange(4000) / RATE_HZ
    y = 5e-3 * np.sin(TURN * 3.0 * t)
    y_acc = -((TURN * 3.0) ** 2) * y
    force = np.maximum(2e3 * np.sin(TURN * 3.0 * t + 1.0), 0.0)
    signals = np.array([y, y_acc, 2 * y, 2 * y_acc, force, -force[::-1]])

    def readings(entries: list[Imperfection]) -> Float2D:
        lab = laboratory(*entries)
        true = np.zeros((len(CHANNELS), t.size))
        true[1:5] = signals[:4]
        for name, line in lab.cell_forces(signals).items():
            true[ROW[name]] = line
        digitizer = Digitizer(lab.sensors)
        values = lab.measure(true, signals)
        return digitizer.digitize(values, np.random.default_rng(0), lab)

    nominal = readings([])
    assert nominal.tobytes() == readings([at(definition, 0.0)]).tobytes()
    scale = nominal[1:].std(axis=1)
    tiny = np.abs(readings([at(definition, 1e-9)]) - nominal)[1:]
    assert (tiny.max(axis=1) <= 1e-5 * scale).all()
    bad = np.abs(readings([at(definition, 1.0)]) - nominal)[1:]
    assert (bad.max(axis=1) > 1e-5 * scale).any()


def test_channel_that_the_rig_lacks_or_that_does_not_fit_is_refused() -> None:
    for name, channel in (("hum", "rel_disp_m"), ("highpass", "mass_disp_m")):
        size = {"rms": 1.0} if name == "hum" else {"corner_hz": 1.0}
        with raises_input_error(key="channel", value=channel, allowed="mass_acc_m_s2") as error:
            laboratory(imperfection(name, channel=channel, **size))
        assert name in error.value.where
    with pytest.raises(InputError):
        laboratory(imperfection("light_spot", channel="drive_disp_m", rms=1e-6))


def test_entry_of_a_channel_wins_and_the_command_must_be_stated() -> None:
    entries = [
        imperfection("drift", channel="mass_disp_m", offset_per_h=36.0),
        imperfection("drift", offset_per_h=3.6),
    ]
    slope = disturbance(*entries, count=2001)[:, -1]
    expected = np.full(len(CHANNELS), 1e-3)
    expected[ROW["drive_disp_m"]], expected[ROW["mass_disp_m"]] = 0.0, 1e-2
    np.testing.assert_allclose(slope, expected, rtol=1e-12)
    wired = disturbance(imperfection("drift", channel="drive_disp_m", offset_per_h=3.6), count=2001)
    assert wired[0, -1] == pytest.approx(1e-3)


# Load cells


def test_cells_share_the_contact_force_by_position_and_bear_the_plate() -> None:
    generator = np.random.default_rng(0)
    y, y_acc, x, x_acc = generator.standard_normal((4, 50)) * 1e-2
    y_acc *= 300.0
    right = np.maximum(generator.standard_normal(50), 0.0) * 1e3
    left = -np.maximum(generator.standard_normal(50), 0.0) * 1e3
    lab = laboratory(
        imperfection("load_sharing", side="right", share=0.53, share_per_m=2.0),
        imperfection("load_sharing", side="left", share=0.4),
        imperfection("plate_mass", mass=3.0),
        imperfection("plate_mass", side="left", mass=5.0),
    )
    cells = lab.cell_forces(np.array([y, y_acc, x, x_acc, right, left]))
    share = 0.53 + 2.0 * (x - y)
    np.testing.assert_allclose(cells["force_r1_n"], share * right - 1.5 * y_acc, rtol=1e-12)
    # Newton of each plate: the bumper pushes it outwards, the cells inwards.
    on_right_plate = right - cells["force_r1_n"] - cells["force_r2_n"]
    on_left_plate = left + cells["force_l1_n"] + cells["force_l2_n"]
    np.testing.assert_allclose(on_right_plate, 3.0 * y_acc, atol=1e-9)
    np.testing.assert_allclose(on_left_plate, 5.0 * y_acc, atol=1e-9)
    np.testing.assert_allclose(cells["force_l1_n"], -0.4 * left + 2.5 * y_acc, rtol=1e-12)


def test_share_stays_within_0_and_1() -> None:
    signals = np.zeros((6, 2))
    signals[2], signals[4] = [1.0, -1.0], 100.0
    cells = laboratory(imperfection("load_sharing", share_per_m=2.0)).cell_forces(signals)
    np.testing.assert_array_equal(cells["force_r1_n"], [100.0, 0.0])
    np.testing.assert_array_equal(cells["force_r2_n"], [0.0, 100.0])


# Filters


@pytest.mark.parametrize(
    ("form", "order"),
    [
        ("butterworth", 1),
        ("butterworth", 3),
        ("butterworth", 8),
        ("bessel", 2),
        ("bessel", 5),
        ("bessel", 8),
    ],
)
def test_anti_alias_filter_has_the_response_of_its_prototype(form: str, order: int) -> None:
    rate, corner = 50e3, 100.0  # so fast that lines between samples are no error
    entry = imperfection("anti_alias_filter", form=form, order=order, corner_hz=corner)
    prototype = signal.butter if form == "butterworth" else signal.bessel
    options = {} if form == "butterworth" else {"norm": "mag"}
    b, a = prototype(order, TURN * corner, analog=True, **options)
    for frequency in (20.0, 100.0, 250.0):
        t = np.arange(round(0.4 * rate)) / rate
        line = np.sin(TURN * frequency * t)
        lines = np.tile(line, (len(CHANNELS), 1))
        out = laboratory(entry, rate=rate, rig=SILENT).condition(lines, np.zeros_like(lines))
        half = t.size // 2
        response = harmonic(out[ROW["mass_acc_m_s2"], half:], frequency, rate)
        response /= harmonic(line[half:], frequency, rate)
        expected = signal.freqs(b, a, [TURN * frequency])[1][0]
        assert abs(response - expected) < 2e-4
    assert abs(signal.freqs(b, a, [TURN * corner])[1][0]) == pytest.approx(math.sqrt(0.5), rel=1e-3)
    np.testing.assert_array_equal(out[ROW["drive_disp_m"]], line)


def test_filters_may_differ_between_channels() -> None:
    entries = [
        imperfection("anti_alias_filter", order=2, corner_hz=200.0),
        imperfection("anti_alias_filter", channel="mass_acc_m_s2", order=1, corner_hz=20.0),
        imperfection("anti_alias_filter", channel="mass_disp_m", corner_hz=math.inf),
    ]
    lab = laboratory(*entries, rig=SILENT)
    step = np.zeros((len(CHANNELS), 400))
    step[:, 1:] = 1.0
    out = lab.condition(step, np.zeros_like(step))
    np.testing.assert_allclose(out[:, -1], 1.0, rtol=1e-6)
    t = np.arange(399) / RATE_HZ
    # The step is a ramp over one sample: the mean of the step responses from 0 to h ago.
    pole = TURN * 20.0
    h = 1.0 / RATE_HZ
    expected = 1.0 - np.exp(-pole * (t + h)) * np.expm1(pole * h) / (pole * h)
    np.testing.assert_allclose(out[ROW["mass_acc_m_s2"], 1:], expected, atol=1e-12)
    assert out[ROW["table_disp_m"]].max() == pytest.approx(1.0432, abs=2e-3)  # e^-pi overshoot
    np.testing.assert_array_equal(out[ROW["mass_disp_m"]], step[ROW["mass_disp_m"]])


def test_noise_passes_the_filter_before_the_converter(tmp_path: Path) -> None:
    entries = [imperfection("anti_alias_filter", order=4, corner_hz=100.0)]
    plain, filtered = machine(tmp_path, None), machine(tmp_path, entries)
    count = 40000
    white, band = (b.tare(count)[1:] for b in (plain, filtered))
    b, a = signal.butter(4, TURN * 100.0, analog=True)
    pulse = np.zeros(400)
    pulse[1] = 1.0
    kept = np.linalg.norm(signal.lsim((b, a), pulse, np.arange(400) / RATE_HZ)[1])
    np.testing.assert_allclose(band.std(axis=1) / white.std(axis=1), kept, rtol=0.05)
    density = signal.welch(band, RATE_HZ, nperseg=500)[1]  # bins of 4 Hz
    floor = np.median(density[:, 2:10], axis=1)
    assert (density[:, 100:150].max(axis=1) < 1e-4 * floor).all()  # 400 to 600 Hz
    steps = 2.0 * np.array([[abs(s.range * s.volts_per_unit) / 2**s.bits] for s in RIG.sensors[1:]])
    codes = band / steps
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-6)


def test_filtered_noise_is_stationary_from_the_first_sample() -> None:
    entry = imperfection("anti_alias_filter", order=4, corner_hz=50.0)
    first, later = [], []
    for seed in range(150):
        lab = laboratory(entry, seed=seed)
        noise = np.random.default_rng([seed, 77]).standard_normal((800, len(CHANNELS))).T
        out = lab.condition(np.ones_like(noise), NOISE[:, None] * noise)[1:] - 1.0
        out /= NOISE[1:, None]
        first.append(out[:, 0])
        later.append(out[:, 700])
    # 1200 values each, so their rms is known to 2 %
    assert np.std(first) == pytest.approx(np.std(later), rel=0.12)
    assert np.std(later) < 0.4


def test_low_cut_forgets_a_step() -> None:
    step = np.ones(4000)
    step[0] = 0.0
    out = take_readings(imperfection("highpass", corner_hz=0.5), mass_acc_m_s2=step)
    t = (np.arange(4000) - 0.5) / RATE_HZ  # a ramp over one sample
    np.testing.assert_allclose(
        out[ROW["mass_acc_m_s2"], 1:], np.exp(-TURN * 0.5 * t[1:]), rtol=1e-6
    )
    constant = take_readings(imperfection("highpass", corner_hz=0.5), mass_acc_m_s2=np.ones(50))
    np.testing.assert_allclose(constant[ROW["mass_acc_m_s2"]], 0.0, atol=1e-12)


def test_bracket_resonates() -> None:
    rate, natural, damping = 20e3, 300.0, 0.05
    t = np.arange(20000) / rate
    entry = imperfection("mounting_resonance", frequency=natural, damping_ratio=damping)
    for frequency in (5.0, 300.0, 800.0):
        line = np.sin(TURN * frequency * t)
        out = take_readings(entry, rate=rate, mass_acc_m_s2=line)[ROW["mass_acc_m_s2"], 10000:]
        r = frequency / natural
        expected = (1 + 2j * damping * r) / (1 - r**2 + 2j * damping * r)
        response = harmonic(out, frequency, rate) / harmonic(line[10000:], frequency, rate)
        assert abs(response / expected - 1.0) < 6e-3


def test_cable_errs_on_impacts_and_forgets() -> None:
    signals = np.zeros((6, 3000))
    signals[4, 1:] = 1000.0
    entry = imperfection("cable", channel="mass_acc_m_s2", error_per_n=1e-4, decay_time=0.2)
    out = take_readings(entry, signals=signals)
    t = (np.arange(3000) - 0.5) / RATE_HZ
    expected = 0.1 * 10 / 9 * (np.exp(-t / 0.2) - np.exp(-10 * t / 0.2))
    np.testing.assert_allclose(out[ROW["mass_acc_m_s2"], 1:], expected[1:], atol=4e-6)
    np.testing.assert_array_equal(np.delete(out, ROW["mass_acc_m_s2"], 0), 0.0)


# Sampling


def test_channels_are_sampled_one_after_another() -> None:
    t = np.arange(4000) / RATE_HZ
    line = np.sin(TURN * 5.0 * t)
    values = np.tile(line, (len(CHANNELS), 1))
    skewed = laboratory(imperfection("channel_skew", skew=1e-4))
    out = skewed.measure(values, np.zeros((6, t.size)))
    for row in range(1, len(CHANNELS)):
        expected = np.sin(TURN * 5.0 * (t - (len(CHANNELS) - 1 - row) * 1e-4))
        np.testing.assert_allclose(out[row, 10:], expected[10:], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(out[0], line)


def test_low_bits_leave_coarse_steps(tmp_path: Path) -> None:
    entries = [
        imperfection("quantisation", channel="mass_disp_m", bits=12),
        imperfection("quantisation", channel="table_disp_m", bits=30),
    ]
    plain, coarse = (take_samples(machine(tmp_path, e), [1500]) for e in (None, entries))
    row = ROW["mass_disp_m"]
    step = 2 * 10.0 / 2**12
    codes = coarse[row] / step
    np.testing.assert_allclose(codes, np.rint(codes), atol=1e-9)
    assert np.abs(coarse[row] - plain[row]).max() == pytest.approx(0.5 * step, rel=0.02)
    np.testing.assert_array_equal(np.delete(coarse, row, 0), np.delete(plain, row, 0))


def test_time_base_makes_the_motion_faster_than_stated(tmp_path: Path) -> None:
    def ratio(deviation: float) -> float:
        backend = machine(
            tmp_path, [imperfection("time_base", deviation=deviation)], noise_rms=0.0, offset=0.0
        )
        values = volts_to_si(take_samples(backend, [6000], frequency=5.0), RIG.sensors, {})[
            :, 4000:
        ]
        acc, disp = (harmonic(values[row], 5.0, RATE_HZ) for row in (2, 1))
        return abs(acc / disp)

    # In true time the sine of 5 Hz has 5 Hz x 1.01, so the acceleration grows by 1.01^2.
    assert ratio(1e4) / ratio(0.0) == pytest.approx(1.01**2, rel=2e-4)


# Disturbances


def test_hum_has_its_rms_and_harmonics() -> None:
    entry = imperfection(
        "hum",
        rms_over_noise=2.0,
        frequency=50.02,
        harmonic_2=0.0,
        harmonic_3=0.5,
        harmonic_5=0.0,
        phase=0.3,
        phase_3=-1.0,
    )
    absolute = imperfection("hum", channel="mass_disp_m", rms=1e-3, rms_over_noise=1.0)
    out = disturbance(entry, absolute, count=100_000)
    np.testing.assert_allclose(
        out[ROW["force_l2_n"]].std(), 2.0 * NOISE[ROW["force_l2_n"]], rtol=1e-3
    )
    assert out[ROW["mass_disp_m"]].std() == pytest.approx(
        1e-3 + NOISE[ROW["mass_disp_m"]], rel=1e-3
    )
    line = out[ROW["force_r1_n"]] / NOISE[ROW["force_r1_n"]]
    fundamental, third = (harmonic(line, n * 50.02, RATE_HZ) for n in (1, 3))
    assert abs(third / fundamental) == pytest.approx(0.5, rel=1e-3)
    # sine of phase p has the complex amplitude -i e^(ip)
    assert np.angle(1j * fundamental) == pytest.approx(0.3, abs=2e-3)
    assert np.angle(1j * third) == pytest.approx(-1.0, abs=2e-3)
    np.testing.assert_array_equal(out[ROW["drive_disp_m"]], 0.0)


@pytest.mark.parametrize(("corner", "rate"), [(1.0, 1000.0), (100.0, 1000.0), (30.0, 4000.0)])
def test_pink_noise_has_its_corner(corner: float, rate: float) -> None:
    count = 2**18
    out = disturbance(imperfection("one_over_f", corner_hz=corner), count=count, rate=rate)[1:]
    frequencies, density = signal.welch(out / NOISE[1:, None], rate, nperseg=2**14)
    white = 1.0 / (0.5 * rate)
    product = np.mean(density, axis=0) * frequencies / white
    for low, high in ((0.5, 2.0), (2.0, 10.0), (10.0, 0.1 * rate)):
        band = (frequencies > low) & (frequencies < high)
        assert product[band].mean() == pytest.approx(corner, rel=0.1)
    assert np.abs(np.array(np.corrcoef(out))[~np.eye(8, dtype=bool)]).max() < 0.6


def test_pink_noise_wanders_as_much_at_the_start_as_later() -> None:
    entry = imperfection("one_over_f", corner_hz=10.0)
    runs = [
        disturbance(entry, count=20001, seed=seed)[1:, [0, 20000]] / NOISE[1:, None]
        for seed in range(60)
    ]
    start, end = np.concatenate(runs).T.std(axis=1)
    expected = math.sqrt(2 / RATE_HZ * 10.0 * math.log(0.5 * RATE_HZ / 1e-3))  # from 1 mHz on
    assert start == pytest.approx(expected, rel=0.15)
    assert end == pytest.approx(expected, rel=0.15)


def test_drift_is_a_line_and_an_exponential_and_a_gain() -> None:
    entry = imperfection(
        "drift",
        offset_per_h=2.0,
        offset_share_per_h=0.01,
        warm_up=0.5,
        warm_up_share=0.001,
        gain_per_h=0.05,
        warm_up_time=3.0,
    )
    count = 10_000
    t = np.arange(count) / RATE_HZ
    out = disturbance(entry, count=count)
    full_scale = RIG.sensors[ROW["force_r1_n"]].range_si
    expected = (2.0 + 0.01 * full_scale) * t / 3600
    expected += (0.5 + 0.001 * full_scale) * (1 - np.exp(-t / 3.0))
    np.testing.assert_allclose(out[ROW["force_r1_n"]], expected, rtol=1e-10, atol=1e-12)
    gained = take_readings(entry, mass_disp_m=np.full(count, 7.0))[ROW["mass_disp_m"]]
    np.testing.assert_allclose(gained, 7.0 * (1 + 0.05 * t / 3600), rtol=1e-12)


# Lasers


def test_laser_is_not_linear() -> None:
    full_scale = RIG.sensors[ROW["mass_disp_m"]].range_si
    s = np.linspace(-1.2, 1.2, 201)
    entry = imperfection("laser_nonlinearity", share=2e-3, even_share=1e-3)
    out = take_readings(entry, mass_disp_m=s * full_scale, mass_acc_m_s2=s)
    error = out[ROW["mass_disp_m"]] / full_scale - s
    inside = np.clip(s, -1.0, 1.0)
    chebyshev = np.polynomial.chebyshev.chebval
    expected = 2e-3 * chebyshev(inside, [0] * 7 + [1])
    expected += 1e-3 * (chebyshev(inside, [0] * 6 + [1]) + 1) / 2
    np.testing.assert_allclose(error, expected, atol=1e-14)
    assert error[100] == 0.0  # at rest
    np.testing.assert_array_equal(out[ROW["mass_acc_m_s2"]], s)


def test_light_spot_reads_the_same_error_at_the_same_place() -> None:
    entry = imperfection("light_spot", rms=3e-6, correlation_length=2e-4)
    x = np.linspace(-0.09, 0.09, 90_001)  # steps of 2 um
    out = take_readings(entry, mass_disp_m=x, table_disp_m=x)
    error = out[ROW["mass_disp_m"]] - x
    assert error.std() == pytest.approx(3e-6, rel=0.08)
    for steps in (50, 100, 200):  # 0.1, 0.2, 0.4 mm
        correlation = np.mean(error[steps:] * error[:-steps]) / np.mean(error**2)
        assert correlation == pytest.approx(math.exp(-0.5 * (steps / 100) ** 2), abs=0.06)
    back = take_readings(entry, mass_disp_m=x[::-1])[ROW["mass_disp_m"]]
    np.testing.assert_array_equal(back[::-1] - x, error)
    other = out[ROW["table_disp_m"], 10_000:-10_000] - x[10_000:-10_000]
    assert abs(np.corrcoef(other, error[10_000:-10_000])[0, 1]) < 0.2


# Table


def test_accelerometers_feel_the_vertical_motion() -> None:
    rate, frequency = 20e3, 20.0
    t = np.arange(60_000) / rate
    y_acc = 2.0 * np.sin(TURN * frequency * t)
    y = -y_acc / (TURN * frequency) ** 2
    signals = np.zeros((6, t.size))
    signals[0], signals[1] = y, y_acc
    cross = imperfection(
        "cross_axis",
        channel="mass_acc_m_s2",
        share=0.04,
        vertical_share=0.1,
        frequency=30.0,
        damping_ratio=0.1,
        lever=0.5,
    )
    r = frequency / 30.0
    resonance = 1 / (1 - r**2 + 2j * 0.1 * r)
    sine = slice(40_000, None)

    def amplitude(*entries: Imperfection) -> complex:
        out = take_readings(*entries, rate=rate, signals=signals)[ROW["mass_acc_m_s2"]]
        return harmonic(out[sine], frequency, rate) / harmonic(y_acc[sine], frequency, rate)

    assert abs(amplitude(cross) / (0.04 * 0.1 * resonance) - 1) < 1e-3
    # The pitch b y has the angular acceleration b y'', and tilts the accelerometer by b y.
    pitch = imperfection("table_pitch", per_travel=0.2, per_acceleration=1e-5)
    angle = 1e-5 - 0.2 / (TURN * frequency) ** 2  # per m/s2
    turning = -angle * (TURN * frequency) ** 2  # pitch acceleration over table acceleration
    expected = 0.04 * resonance * (0.1 + 0.5 * turning) + GRAVITY_M_S2 * angle
    assert abs(amplitude(cross, pitch) / expected - 1) < 1e-3


def test_pitching_table_pushes_the_mass_and_tilts_the_accelerometers(tmp_path: Path) -> None:
    entry = imperfection("table_pitch", per_acceleration=2e-3, per_travel=0.5)
    backend = machine(tmp_path, [entry], noise_rms=0.0, offset=0.0)
    recorded: list[Float2D] = []
    backend.observer = lambda first, command, out: recorded.append(out.copy())
    values = volts_to_si(take_samples(backend, [4000]), RIG.sensors, {})
    y, y_acc, x, x_acc, right, left = recorded[0]
    angle = 2e-3 * y_acc + 0.5 * y
    assert np.abs(angle).max() > 1e-3
    for row, acc in zip(ACCELEROMETERS, (y_acc, x_acc), strict=True):
        np.testing.assert_allclose(values[row], acc + GRAVITY_M_S2 * np.sin(angle), atol=1e-5)
    u = x - y
    v = np.gradient(u, 1 / RATE_HZ)
    inertia = 550.0 * (x_acc + GRAVITY_M_S2 * np.sin(angle))
    lost = inertia + 1100.0 * v + 36e3 * u + right + left
    assert np.median(np.abs(lost)) < 0.01
    assert np.median(np.abs(550.0 * GRAVITY_M_S2 * angle)) > 2.0


def test_mass_and_gaps_were_misread() -> None:
    plant = Plant(550.0, 36e3, 1100.0, 51e4, 900.0, 2e-3, 2e-3, 2e3, 20.0, 5e-3, True, RATE_HZ)
    text = """
    [base]
    gap_left_m = 1e-3
    [[imperfections]]
    id = "mass_reading"
    parameters = { ratio = 1.02 }
    [[imperfections]]
    id = "gap_reading"
    parameters = { offset = 2e-4 }
    [[imperfections]]
    id = "gap_reading"
    side = "right"
    parameters = { offset = -3e-4 }
    """
    true = hide_laws(plant, parse_toml(text, GroundTruth, "x"))
    assert true.mass_kg == pytest.approx(561.0)
    assert (true.gap_right_m, true.gap_left_m) == pytest.approx((1.7e-3, 1.2e-3))
    assert true.rate_hz == RATE_HZ


# Tare


def test_tare_reads_sensors_at_rest(tmp_path: Path) -> None:
    entries = [
        imperfection("light_spot", rms=5e-4, correlation_length=5e-3),
        imperfection("hum", channel="mass_acc_m_s2", rms=0.05),
        imperfection("drift", channel="force_r1_n", warm_up=50.0, warm_up_time=10.0),
        imperfection("anti_alias_filter", corner_hz=200.0),
    ]
    backend = machine(tmp_path, entries)
    volts = backend.tare(4000)
    values = volts_to_si(volts, RIG.sensors, {})
    assert abs(values[ROW["mass_disp_m"]].mean() + 0.08e-3) > 2e-5  # the spot at rest
    assert values[ROW["mass_acc_m_s2"]].std() == pytest.approx(0.05, rel=0.02)
    drift = values[ROW["force_r1_n"]]
    # Just before sample 0, so 2 s of warm-up lie in the tare and end at 0.
    assert drift[-200:].mean() - drift[:200].mean() == pytest.approx(
        50.0 * (math.exp(0.195) - math.exp(0.005)), rel=0.05
    )
    backend.queue(0, np.zeros(1))
    backend.start()
    rest = volts_to_si(backend.read(2000), RIG.sensors, compute_tare(volts, RIG.sensors))
    np.testing.assert_allclose(rest[[1, 3]].mean(axis=1), 0.0, atol=1e-6)
    # The tare does not change the run.
    plain = machine(tmp_path, entries)
    plain.queue(0, np.zeros(1))
    plain.start()
    again = machine(tmp_path, entries)
    again.tare(100)
    again.queue(0, np.zeros(1))
    again.start()
    assert plain.read(500).tobytes() == again.read(500).tobytes()
