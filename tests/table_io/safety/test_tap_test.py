"""A tap, a press and a shunt prove sign, place and time of each sensor; noise proves nothing."""

from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.config.rig import RigConfig
from table_io.safety.wiring_check import (
    CheckLine,
    Stimulus,
    TapResponse,
    evaluate_tap,
    find_tap_onset,
    is_disturbed,
    list_stimuli,
)
from tests.builders.rigs import RIG, change_rig

RATE, SAMPLES, BEFORE, AT = 2000.0, 3000, 800, 1500
NOISE = np.array([sensor.noise_rms for sensor in RIG.sensors])
TABLE, MASS, RIGHT, LEFT = list_stimuli(RIG)


def tap(size: float, at: int = AT, hz: float = 60.0, damping: float = 0.15) -> Float1D:
    """The swing of a struck body: first the way of the stroke, then it rings."""
    t = (np.arange(SAMPLES) - at) / RATE
    w = 2 * np.pi * hz
    ring: Float1D = np.where(t >= 0, np.exp(-damping * w * t) * np.sin(w * t), 0.0)
    return size * ring


def press(size: float, at: int = AT) -> Float1D:
    """A slow press, held."""
    t = np.clip((np.arange(SAMPLES) - at) / (0.2 * RATE), 0.0, 1.0)
    return size * t * t * (3.0 - 2.0 * t)


def make_response(swings: dict[str, Float1D], rig: RigConfig = RIG, seed: int = 1) -> TapResponse:
    values: Float2D = np.array([[sensor.offset] for sensor in rig.sensors]) + NOISE[
        :, None
    ] * np.random.default_rng(seed).standard_normal((len(rig.sensors), SAMPLES))
    for name, swing in swings.items():
        values[rig.channels.index(name)] += swing
    return TapResponse(rig, RATE, values, NOISE, BEFORE)


def evaluate_lines(
    hand: Stimulus, swings: dict[str, Float1D], rig: RigConfig = RIG
) -> dict[tuple[str, str], CheckLine]:
    return {
        (line.name, line.channel): line
        for line in evaluate_tap(hand, make_response(swings, rig), "nobody")
    }


def test_list_stimuli_of_the_rig() -> None:
    assert [hand.channels for hand in (TABLE, MASS, RIGHT, LEFT)] == [
        ("table_acc_m_s2", "table_disp_m"),
        ("mass_acc_m_s2", "mass_disp_m"),
        ("force_r1_n", "force_r2_n"),
        ("force_l1_n", "force_l2_n"),
    ]


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("hand", [TABLE, MASS, RIGHT, LEFT])
def test_noise_is_no_tap(hand: Stimulus, seed: int) -> None:
    assert find_tap_onset(hand, make_response({}, seed=seed)) is None


def test_tap_to_the_right_passes() -> None:
    swings = {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, hz=8.0)}
    at = find_tap_onset(TABLE, make_response(swings))
    assert at is not None
    assert AT <= at <= AT + 20
    lines = evaluate_lines(TABLE, swings)
    assert {line.verdict for line in lines.values()} == {"pass"}
    assert set(lines) == {
        ("polarity", "table_acc_m_s2"),
        ("time after the first", "table_acc_m_s2"),
        ("polarity", "table_disp_m"),
        ("time after the first", "table_disp_m"),
    }


@pytest.mark.parametrize("turned", ["table_acc_m_s2", "table_disp_m"])
def test_sensor_that_is_turned_round_is_found_by_its_own_line(turned: str) -> None:
    swings = {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, hz=8.0)}
    lines = evaluate_lines(TABLE, swings | {turned: -swings[turned]})
    assert [key for key, line in lines.items() if line.verdict == "fail"] == [("polarity", turned)]
    assert lines["polarity", turned].value < 0
    assert "volts_per_unit" in lines["polarity", turned].do


def test_first_swing_counts_and_not_the_largest() -> None:
    swing = tap(0.2)
    swing[AT + 60 : AT + 120] -= 0.5 * np.hanning(60)  # it bumps back harder
    lines = evaluate_lines(TABLE, {"table_acc_m_s2": swing})
    assert lines["polarity", "table_acc_m_s2"].verdict == "pass"


def test_unclear_motion_is_not_judged() -> None:
    lines = evaluate_lines(TABLE, {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.02, hz=8.0)})
    assert lines["polarity", "table_disp_m"].verdict == "not tested"
    assert lines["polarity", "table_acc_m_s2"].verdict == "pass"


def test_channel_that_comes_late_is_found() -> None:
    lines = evaluate_lines(
        TABLE, {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, AT + 300, 8.0)}
    )
    late = lines["time after the first", "table_disp_m"]
    assert late.verdict == "fail"
    assert late.value == pytest.approx(150.0, abs=10.0)


def test_accelerometers_at_each_others_input() -> None:
    """The mass was tapped, and the table's accelerometer says that it was the table."""
    swings = {"table_acc_m_s2": tap(0.3), "mass_acc_m_s2": tap(0.02)}
    lines = evaluate_lines(MASS, swings)
    assert lines["place", "mass_acc_m_s2"].verdict == "fail"
    assert "table_acc_m_s2" in lines["place", "mass_acc_m_s2"].do
    assert ("place", "mass_acc_m_s2") not in evaluate_lines(MASS, {"mass_acc_m_s2": tap(0.3)})


def test_load_cells_of_the_other_side_and_tension_for_compression() -> None:
    pressed = {"force_r1_n": press(0.3), "force_r2_n": press(0.2, AT + 400)}
    right = evaluate_lines(RIGHT, pressed)
    assert {line.verdict for line in right.values()} == {"pass"}
    assert all(name == "polarity" for name, _ in right)  # one after the other is no fault
    swapped = make_response({"force_l1_n": press(0.3), "force_l2_n": press(0.2)})
    assert find_tap_onset(RIGHT, swapped) is not None
    lines = {(line.name, line.channel): line for line in evaluate_tap(RIGHT, swapped, "nobody")}
    assert lines["place", "force_r1_n"].verdict == "fail"
    assert lines["polarity", "force_r1_n"].verdict == "not tested"
    turned = evaluate_lines(RIGHT, pressed | {"force_r2_n": -press(0.2)})
    assert [key for key, line in turned.items() if line.verdict == "fail"] == [
        ("polarity", "force_r2_n")
    ]


def test_lost_samples_are_no_swing() -> None:
    response = make_response({"table_acc_m_s2": tap(0.2)})
    response.values[RIG.channels.index("table_disp_m")] = np.nan
    lines = {
        line.channel: line
        for line in evaluate_tap(TABLE, response, "nobody")
        if line.name == "polarity"
    }
    assert lines["table_disp_m"].verdict == "not tested"
    assert lines["table_acc_m_s2"].verdict == "pass"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_press_in_the_samples_at_rest_proves_nothing(sign: float) -> None:
    """Good cells do not fail and turned ones do not pass where a person was too quick."""
    early = {name: sign * press(1.0, BEFORE // 2) for name in RIGHT.channels}
    assert is_disturbed(RIGHT, make_response(early))
    lines = evaluate_lines(RIGHT, early)
    assert {line.verdict for line in lines.values()} == {"not tested"}
    assert all(RIGHT.prompt in line.do for line in lines.values())
    at_once = {name: sign * press(1.0, BEFORE + 40) for name in RIGHT.channels}
    assert not is_disturbed(RIGHT, make_response(at_once))
    verdicts = {line.verdict for line in evaluate_lines(RIGHT, at_once).values()}
    assert verdicts == {"pass" if sign > 0 else "fail"}


def test_cells_that_are_still_pressed_are_not_taken_for_swapped_ones() -> None:
    let_go = {name: 1.0 - press(1.0, BEFORE + 100) for name in RIGHT.channels}
    response = make_response(let_go | {name: press(0.5) for name in LEFT.channels})
    rest = np.array([sensor.offset for sensor in RIG.sensors])
    assert is_disturbed(LEFT, replace(response, rest_means=rest))
    lines = evaluate_tap(LEFT, replace(response, rest_means=rest), "nobody")
    assert {line.verdict for line in lines} == {"not tested"}
    free = replace(make_response({name: press(0.5) for name in LEFT.channels}), rest_means=rest)
    assert {line.verdict for line in evaluate_tap(LEFT, free, "nobody")} == {"pass"}


def test_swing_at_rest_is_not_the_first_swing() -> None:
    swing = tap(0.2)
    swing[100] = -0.004  # below what is clear alone, and not small beside the tap's own first
    response = make_response({"table_acc_m_s2": swing})
    first = response.find_first_swing("table_acc_m_s2")
    assert first is not None
    assert first[0] >= BEFORE
    assert response.largest_swing("table_acc_m_s2") == pytest.approx(np.abs(swing).max(), abs=0.005)


def with_shunt(size: float) -> RigConfig:
    return change_rig(sensors={"force_l2_n": {"shunt": size, "shunt_tolerance": 0.02}})


@pytest.mark.parametrize(
    ("shift", "verdict", "what"),
    [
        (1.0, "pass", ""),
        (1.015, "pass", ""),
        (1.1, "fail", "volts_per_unit"),
        (-1.0, "fail", "sign"),
    ],
)
@pytest.mark.parametrize("size", [1.0, -1.0])
def test_shunt_proves_sign_and_gain(shift: float, verdict: str, what: str, size: float) -> None:
    rig = with_shunt(size)
    hand = list_stimuli(rig)[-1]
    assert hand.shunt
    (line,) = evaluate_lines(hand, {"force_l2_n": press(shift * size, AT)}, rig).values()
    assert (line.name, line.verdict) == ("shunt", verdict)
    assert line.value == pytest.approx(shift * size, abs=0.001)
    assert what in line.do


def test_shunt_that_was_not_switched_is_not_tested() -> None:
    rig = with_shunt(1.0)
    hand = list_stimuli(rig)[-1]
    assert find_tap_onset(hand, make_response({"force_l2_n": press(0.2)}, rig)) is None
    (line,) = evaluate_tap(hand, None, "no operator")
    assert (line.name, line.verdict, line.do) == ("shunt", "not tested", "no operator")


@pytest.mark.parametrize("channel", ["table_disp_m", "force_l2_n"])
@pytest.mark.parametrize(
    ("noise", "lsb_share", "expected"),
    [(0.5, 1e-9, 0.5), (0.0, 1e-9, 1e-5), (np.nan, 1e-9, 1e-5), (0.0, 1e-3, 1e-3)],
)
def test_swing_stands_out_of_noise_converter_and_range(
    channel: str, noise: float, lsb_share: float, expected: float
) -> None:
    """All in shares of the range; the smallest swing is ten times the largest of the three."""
    bits = round(np.log2(2.0 / lsb_share))
    rig = change_rig(sensors={channel: {"range": 40.0, "bits": bits}})
    response = replace(make_response({}, rig), noise_rms=np.full(len(rig.sensors), noise * 40.0))
    assert response.min_swing(channel) == pytest.approx(10.0 * expected * 40.0, rel=0.05)
