"""Motion from lasers and accelerometers, and what their disagreement says."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from table_io.block import Block, Label, join_blocks
from table_io.errors import InputError
from tests.discovery.played import TRUE, blocks, format_truth, log
from twin.discovery.signals import build_signals
from twin.model.inverse_dynamics import forces_along
from twin.model.model import Model, SensorModel


def test_velocity_is_that_of_the_displacement() -> None:
    motion = log().signals.fuse_motion()
    inside = motion.moving & (np.arange(motion.u.size) > 500)
    slope = np.gradient(motion.u, 1.0 / motion.rate_hz)
    error = (slope - motion.v)[inside]
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(motion.v[inside] ** 2))


def test_the_fused_motion_is_better_than_the_laser_by_far() -> None:
    """Against the same run without noise: the card's lasers have 5 um, their difference 7."""
    noisy, clean = log(noise=4.0).signals.fuse_motion(), log(noise=1e-3).signals.fuse_motion()
    error = (noisy.u - clean.u)[clean.moving]
    assert 0 < error.std() < 0.5 * 4 * 7e-6
    assert noisy.noise.u == pytest.approx(error.std(), rel=0.3)


@pytest.mark.parametrize("noise", [1.0, 20.0])
def test_sound_sensors_surprise_nobody(noise: float) -> None:
    motion = log(noise=noise).signals.fuse_motion()
    assert [residual.body for residual in motion.consistency_residuals] == [
        "mass",
        "table",
        "right cells",
        "left cells",
    ]
    for residual in motion.consistency_residuals:
        assert np.mean(residual.values[motion.moving] ** 2) == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize(
    ("effect", "channel", "body"),
    [
        ("sensor_gain", "mass_acc_m_s2", "mass"),
        ("sensor_gain", "table_disp_m", "table"),
        ("sensor_gain", "force_l2_n", "left cells"),
    ],
)
def test_the_gate_names_the_body_and_the_belief_closes_it(
    effect: str, channel: str, body: str
) -> None:
    readings = log(format_truth(effect, channel, gain=1.05)).signals

    def odd(sensors: tuple[SensorModel, ...]) -> dict[str, float]:
        motion = readings.fuse_motion(sensors)
        return {
            residual.body: float(np.mean(residual.values[motion.moving] ** 2))
            for residual in motion.consistency_residuals
        }

    before = odd(())
    assert before[body] > 3.0
    assert all(value < 1.3 for name, value in before.items() if name != body)
    assert odd((SensorModel(channel, gain=1.05),))[body] == pytest.approx(1.0, abs=0.15)


def test_no_force_law_breaks_the_gate() -> None:
    motion = log(format_truth("bumper_hardening", k2=1e8)).signals.fuse_motion()
    for residual in motion.consistency_residuals:
        assert np.mean(residual.values[motion.moving] ** 2) < 1.2


def test_a_lag_is_taken_back() -> None:
    late = log(format_truth("sensor_lag", "mass_acc_m_s2", lag=2e-3)).signals
    sound = log().signals.fuse_motion()
    mended = late.fuse_motion((SensorModel("mass_acc_m_s2", lag=2e-3),))
    error = (mended.acc - sound.acc)[sound.moving]
    was = (late.fuse_motion().acc - sound.acc)[sound.moving]
    assert error.std() < 0.1 * was.std()


@pytest.mark.parametrize("channel", ["mass_acc_m_s2", "table_disp_m", "force_r1_n"])
@pytest.mark.parametrize("lag", [0.0, 2e-3])
def test_an_assumed_sensor_gives_the_motion_of_its_corrected_readings(
    channel: str, lag: float
) -> None:
    signals, gain, offset = log().signals, 1.02, 1e-3
    sensor = SensorModel(channel, gain=gain, lag=lag, offset=offset)
    tared = signals.spectra[channel] - offset * signals.unit_spectrum
    spectrum = tared * np.exp(1j * signals.omega * lag) / gain
    corrected = replace(signals, spectra={**signals.spectra, channel: spectrum})
    expected = corrected.fuse_motion()
    for motion in (signals.fuse_motion((sensor,)), signals.fuse_corrected(corrected)):
        for name in ("u", "v", "acc", "table_acc", "table_disp", "right", "left"):
            values, size = getattr(motion, name), float(np.abs(getattr(expected, name)).max())
            np.testing.assert_allclose(values, getattr(expected, name), rtol=0, atol=1e-9 * size)
        pairs = zip(motion.consistency_residuals, expected.consistency_residuals, strict=True)
        for own, other in pairs:
            assert own.body == other.body
            np.testing.assert_allclose(own.values, other.values, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    "lost",
    [("mass_acc_m_s2",), ("mass_disp_m",), ("rel_disp_m",), ("mass_disp_m", "mass_acc_m_s2")],
)
def test_half_a_second_without_a_sensor_is_no_error_of_the_motion_beside_it(
    lost: tuple[str, ...],
) -> None:
    measured = join_blocks(blocks())
    if "rel_disp_m" in lost:
        measured = replace_lasers(measured)
    values = measured.values.copy()
    middle = len(measured) // 2
    for name in lost:
        place = measured.channels.index(name)
        values[place, middle : middle + round(0.5 * measured.rate_hz)] = np.nan
    whole, cut = (
        build_signals((block,), "log", 550.0, (0.002, 0.002))
        for block in (measured, replace(measured, values=values))
    )
    motion, expected = cut.fuse_motion(), whole.fuse_motion()
    used = motion.moving & cut.good
    assert used.sum() < (expected.moving & whole.good).sum()
    for name, noise in (("u", expected.noise.u), ("v", expected.noise.v)):
        error = (getattr(motion, name) - getattr(expected, name))[used]
        assert np.abs(error).max() < 0.1 * noise, name


def replace_lasers(block: Block) -> Block:
    """Return a block whose laser reads the distance of mass and table."""
    lasers = [block.channels.index(name) for name in ("mass_disp_m", "table_disp_m")]
    others = [k for k in range(len(block.channels)) if k not in lasers]
    relative = block.values[lasers[0]] - block.values[lasers[1]]
    names = ("rel_disp_m", *(block.channels[k] for k in others))
    return replace(block, channels=names, values=np.array([relative, *block.values[others]]))


@pytest.mark.parametrize("corner", [0.1, 0.2, 0.35])
def test_the_filter_of_a_logger_shows_in_motion_where_there_is_no_rest(corner: float) -> None:
    """Its response to the force step of an impact was fitted as an appendage of 37 Hz."""
    measured = join_blocks(blocks())
    moving = measured.cut(measured.index + 3000, measured.end - 1000)
    filtered = replace(moving, values=lfilter(*butter(4, 2 * corner), moving.values))
    one_alone = moving.values.copy()
    place = moving.channels.index("mass_acc_m_s2")
    one_alone[place] = filtered.values[place]

    def find_filter_hz(block: Block) -> float:
        return build_signals((block,), "moving", 550.0, (0.002, 0.002)).filter_hz

    assert find_filter_hz(filtered) == pytest.approx(750.0 * corner, rel=0.25)
    assert math.isinf(find_filter_hz(moving))
    assert math.isinf(find_filter_hz(replace(moving, values=one_alone)))


def test_without_displacement_there_is_nothing_to_learn() -> None:
    measured = blocks()[0]
    place = measured.channels.index("mass_acc_m_s2")
    poor = Block(
        measured.stream, measured.index, measured.rate_hz, ("mass_acc_m_s2",),
        measured.values[place : place + 1],
        measured.step, measured.label, measured.cycle,
    )  # fmt: skip
    with pytest.raises(InputError) as error:
        build_signals((poor,), "poor", 550.0, (0.002, 0.002))
    assert error.value.where == "poor"
    assert "rel_disp_m" in error.value.allowed


def test_a_dead_channel_is_no_channel() -> None:
    dead = []
    for block in blocks():
        values = block.values.copy()
        values[block.channels.index("force_r1_n")] = 0.0
        dead.append(
            Block(
                block.stream,
                block.index,
                block.rate_hz,
                block.channels,
                values,
                block.step,
                block.label,
                block.cycle,
            )
        )
    assert "force_r1_n" not in build_signals(tuple(dead), "dead", 550.0, (0.002, 0.002)).channels


def test_along_a_motion_the_forces_are_those_of_the_law() -> None:
    time = np.arange(500) / 500.0
    u, v = 0.004 * np.sin(6.0 * time), 0.024 * np.cos(6.0 * time)
    touched = np.array([u > 0.002, u < -0.002]).astype(np.int8)
    model = Model(TRUE).with_effect("cubic_stiffness", k3=1e8)
    damper, right, left = forces_along(model, u, v, 0 * u, time, touched)
    np.testing.assert_allclose(damper, 36e3 * u + 1.1e3 * v + 1e8 * u**3, rtol=1e-12, atol=1e-9)
    push = 510e3 * (u - 0.002) + 900.0 * v
    np.testing.assert_allclose(right, np.where(u > 0.002, push, 0.0), rtol=1e-12, atol=1e-9)
    pull = 510e3 * (u + 0.002) + 900.0 * v
    np.testing.assert_allclose(left, np.where(u < -0.002, pull, 0.0), rtol=1e-12, atol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_a_record_cut_out_of_a_motion_has_the_motion_of_its_sensors(offset: float) -> None:
    """Up to its ends, also with an accelerometer off zero: offsets are taken off the spectra."""
    rate_hz, size = 1000.0, 12_000
    t, w = np.arange(size) / rate_hz, 2 * np.pi * np.array([0.7, 1.3])
    u = 0.01 * np.sin(w[0] * t + 1.0) + 0.02 * np.sin(w[1] * t + 2.0)
    acc = -0.01 * w[0] ** 2 * np.sin(w[0] * t + 1.0) - 0.02 * w[1] ** 2 * np.sin(w[1] * t + 2.0)
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((4, size)) * np.array([[1e-4], [1e-4], [0.01], [0.01]])
    values = np.array([u, np.zeros(size), acc + offset, np.zeros(size)]) + noise
    names = ("mass_disp_m", "table_disp_m", "mass_acc_m_s2", "table_acc_m_s2")
    outside = np.full(size, -1)
    label = np.full(size, int(Label.SETTLE))
    block = Block("meas", 0, rate_hz, names, values, outside, label, outside)
    signals = build_signals((block,), "cut", 550.0, (np.inf, np.inf))
    motion = signals.fuse_motion([SensorModel("mass_acc_m_s2", offset=offset)])
    error = (motion.u - u[:: signals.grid.decimation])[motion.good]
    # as loud at the ends as in the middle
    assert np.abs(error).max() < 6.0 * error[error.size // 3 : 2 * error.size // 3].std()
