"""A tap, a press and a shunt prove sign, place and time of each sensor; noise proves nothing."""

from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.config.base import PROFILES_DIR, load_config
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

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
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


def felt(swings: dict[str, Float1D], rig: RigConfig = RIG, seed: int = 1) -> TapResponse:
    values: Float2D = np.array([[one.offset] for one in rig.sensors]) + NOISE[
        :, None
    ] * np.random.default_rng(seed).standard_normal((len(rig.sensors), SAMPLES))
    for name, swing in swings.items():
        values[rig.channels.index(name)] += swing
    return TapResponse(rig, RATE, values, NOISE, BEFORE)


def told(
    hand: Stimulus, swings: dict[str, Float1D], rig: RigConfig = RIG
) -> dict[tuple[str, str], CheckLine]:
    return {(one.name, one.channel): one for one in evaluate_tap(hand, felt(swings, rig), "nobody")}


def test_the_hands_prove_what_the_rig_has() -> None:
    assert [hand.channels for hand in (TABLE, MASS, RIGHT, LEFT)] == [
        ("table_acc_m_s2", "table_disp_m"),
        ("mass_acc_m_s2", "mass_disp_m"),
        ("force_r1_n", "force_r2_n"),
        ("force_l1_n", "force_l2_n"),
    ]


@pytest.mark.parametrize("seed", range(20))
@pytest.mark.parametrize("hand", [TABLE, MASS, RIGHT, LEFT])
def test_noise_is_no_hand(hand: Stimulus, seed: int) -> None:
    assert find_tap_onset(hand, felt({}, seed=seed)) is None


def test_a_tap_to_the_right_is_felt_when_it_comes_and_passes() -> None:
    swings = {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, hz=8.0)}
    at = find_tap_onset(TABLE, felt(swings))
    assert at is not None
    assert AT <= at <= AT + 20
    found = told(TABLE, swings)
    assert {one.verdict for one in found.values()} == {"pass"}
    assert set(found) == {
        ("polarity", "table_acc_m_s2"), ("time after the first", "table_acc_m_s2"),
        ("polarity", "table_disp_m"), ("time after the first", "table_disp_m"),
    }  # fmt: skip


@pytest.mark.parametrize("turned", ["table_acc_m_s2", "table_disp_m"])
def test_a_sensor_that_is_turned_round_is_found_by_its_own_line(turned: str) -> None:
    swings = {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, hz=8.0)}
    found = told(TABLE, swings | {turned: -swings[turned]})
    assert [key for key, one in found.items() if one.verdict == "fail"] == [("polarity", turned)]
    assert found["polarity", turned].value < 0
    assert "volts_per_unit" in found["polarity", turned].do


def test_the_first_swing_counts_and_not_the_largest() -> None:
    swing = tap(0.2)
    swing[AT + 60 : AT + 120] -= 0.5 * np.hanning(60)  # it bumps back harder
    found = told(TABLE, {"table_acc_m_s2": swing})
    assert found["polarity", "table_acc_m_s2"].verdict == "pass"


def test_what_does_not_move_clearly_is_not_judged() -> None:
    found = told(TABLE, {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.02, hz=8.0)})
    assert found["polarity", "table_disp_m"].verdict == "not tested"
    assert found["polarity", "table_acc_m_s2"].verdict == "pass"


def test_a_channel_that_comes_late_is_found() -> None:
    found = told(TABLE, {"table_acc_m_s2": tap(0.2), "table_disp_m": tap(0.4, AT + 300, 8.0)})
    late = found["time after the first", "table_disp_m"]
    assert late.verdict == "fail"
    assert late.value == pytest.approx(150.0, abs=10.0)


def test_accelerometers_at_each_others_input() -> None:
    """The mass was tapped, and the table's accelerometer says that it was the table."""
    swings = {"table_acc_m_s2": tap(0.3), "mass_acc_m_s2": tap(0.02)}
    found = told(MASS, swings)
    assert found["place", "mass_acc_m_s2"].verdict == "fail"
    assert "table_acc_m_s2" in found["place", "mass_acc_m_s2"].do
    assert ("place", "mass_acc_m_s2") not in told(MASS, {"mass_acc_m_s2": tap(0.3)})


def test_load_cells_of_the_other_side_and_tension_for_compression() -> None:
    pressed = {"force_r1_n": press(0.3), "force_r2_n": press(0.2, AT + 400)}
    right = told(RIGHT, pressed)
    assert {one.verdict for one in right.values()} == {"pass"}
    assert all(name == "polarity" for name, _ in right)  # one after the other is no fault
    swapped = felt({"force_l1_n": press(0.3), "force_l2_n": press(0.2)})
    assert find_tap_onset(RIGHT, swapped) is not None
    found = {(one.name, one.channel): one for one in evaluate_tap(RIGHT, swapped, "nobody")}
    assert found["place", "force_r1_n"].verdict == "fail"
    assert found["polarity", "force_r1_n"].verdict == "not tested"
    turned = told(RIGHT, pressed | {"force_r2_n": -press(0.2)})
    assert [key for key, one in turned.items() if one.verdict == "fail"] == [
        ("polarity", "force_r2_n")
    ]


def test_lost_samples_are_no_swing() -> None:
    one = felt({"table_acc_m_s2": tap(0.2)})
    one.values[RIG.channels.index("table_disp_m")] = np.nan
    found = {
        line.channel: line for line in evaluate_tap(TABLE, one, "nobody") if line.name == "polarity"
    }
    assert found["table_disp_m"].verdict == "not tested"
    assert found["table_acc_m_s2"].verdict == "pass"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_press_in_the_samples_at_rest_proves_nothing(sign: float) -> None:
    """Good cells do not fail and turned ones do not pass where a person was too quick."""
    early = {name: sign * press(1.0, BEFORE // 2) for name in RIGHT.channels}
    assert is_disturbed(RIGHT, felt(early))
    found = told(RIGHT, early)
    assert {one.verdict for one in found.values()} == {"not tested"}
    assert all(RIGHT.prompt in one.do for one in found.values())
    at_once = {name: sign * press(1.0, BEFORE + 40) for name in RIGHT.channels}
    assert not is_disturbed(RIGHT, felt(at_once))
    verdicts = {one.verdict for one in told(RIGHT, at_once).values()}
    assert verdicts == {"pass" if sign > 0 else "fail"}


def test_cells_that_are_still_pressed_are_not_taken_for_swapped_ones() -> None:
    let_go = {name: 1.0 - press(1.0, BEFORE + 100) for name in RIGHT.channels}
    one = felt(let_go | {name: press(0.5) for name in LEFT.channels})
    rest = np.array([sensor.offset for sensor in RIG.sensors])
    assert is_disturbed(LEFT, replace(one, rest_means=rest))
    lines = evaluate_tap(LEFT, replace(one, rest_means=rest), "nobody")
    assert {line.verdict for line in lines} == {"not tested"}
    free = replace(felt({name: press(0.5) for name in LEFT.channels}), rest_means=rest)
    assert {line.verdict for line in evaluate_tap(LEFT, free, "nobody")} == {"pass"}


def test_what_swings_in_the_samples_at_rest_is_not_the_first_swing() -> None:
    swing = tap(0.2)
    swing[100] = -0.004  # below what is clear alone, and not small beside the tap's own first
    one = felt({"table_acc_m_s2": swing})
    first = one.find_first_swing("table_acc_m_s2")
    assert first is not None
    assert first[0] >= BEFORE
    assert one.largest_swing("table_acc_m_s2") == pytest.approx(np.abs(swing).max(), abs=0.005)


def with_shunt(size: float) -> RigConfig:
    cell = RIG.sensors[-1].model_copy(update={"shunt": size, "shunt_tolerance": 0.02})
    return RIG.model_copy(update={"sensors": (*RIG.sensors[:-1], cell)})


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
def test_a_shunt_proves_sign_and_gain(shift: float, verdict: str, what: str, size: float) -> None:
    rig = with_shunt(size)
    hand = list_stimuli(rig)[-1]
    assert hand.shunt
    (line,) = told(hand, {"force_l2_n": press(shift * size, AT)}, rig).values()
    assert (line.name, line.verdict) == ("shunt", verdict)
    assert line.value == pytest.approx(shift * size, abs=0.001)
    assert what in line.do


def test_a_shunt_that_nobody_switched() -> None:
    rig = with_shunt(1.0)
    hand = list_stimuli(rig)[-1]
    assert find_tap_onset(hand, felt({"force_l2_n": press(0.2)}, rig)) is None
    (line,) = evaluate_tap(hand, None, "no operator")
    assert (line.name, line.verdict, line.do) == ("shunt", "not tested", "no operator")
