"""Cycle checks of the protection: one cycle in closed form, each limit in both directions."""

import cmath
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.rig import RigConfig
from table_io.control.table_response import evaluate_transfer
from table_io.records import FrequencyResponse
from table_io.safety import cycle_checks, protection
from table_io.safety.consistency import SENSOR_PAIRS, WeakFormPair, compare_motion
from table_io.safety.cycle_checks import (
    DriveCycle,
    ForceShare,
    PairBaseline,
    ProtectionContext,
    SwingAverage,
    check_cell_pairs,
)
from table_io.safety.findings import Suspicion
from table_io.safety.protection import (
    CycleCheckState,
    SampleSpan,
    check_cycle,
    set_response,
    start_protection,
)
from table_io.safety.sample_checks import TABLE_GAIN, TABLE_LAG
from table_io.sensor_errors import PairErrorEstimate, PairErrors, highpass
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_history_profile, make_profile
from tests.builders.rigs import RIG, change_rig
from tests.table_io.safety.test_protection import (
    PLAN,
    evaluate_drive,
    list_findings,
    simulate_channels,
)

DRIVE, TABLE, ACC, MASS, MASS_ACC = range(5)
SIGNS = st.sampled_from([-1.0, 1.0])


CYCLE_SAMPLES = 1000  # a cycle of 2 Hz
PHASE = np.arange(CYCLE_SAMPLES) / CYCLE_SAMPLES
WAVE = np.sin(2.0 * math.pi * PHASE)
OMEGA = 4.0 * math.pi
LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
AMPLITUDE_M = LEVEL_M_S2 / OMEGA**2
LSB_M = RIG.output.lsb_m
MANY = settings(max_examples=12, derandomize=True)


@dataclass(frozen=True)
class Edge:
    """Just inside or just beyond a limit on one side, as a share of it."""

    sign: float
    share: float

    @property
    def is_beyond(self) -> bool:
        return self.share > 1.0

    @property
    def signed_factor(self) -> float:
        return self.sign * self.share


EDGES = st.sampled_from(
    [Edge(sign, share) for sign in (-1.0, 1.0) for share in (1 - 1e-6, 1 + 1e-6)]
)


def require_suspicion(
    suspicions: list[Suspicion],
    is_expected: bool,
    kind: str,
    channel: str,
    value: float,
    limit: float,
) -> None:
    """Require one suspicion with these fields, or none."""
    assert len(suspicions) == is_expected
    for item in suspicions:
        assert (item.kind, item.channel) == (kind, channel)
        assert (item.value, item.limit) == pytest.approx((value, limit))


REL_RIG = change_rig(sensors={"mass_disp_m": {"channel": "rel_disp_m"}})
BARE_RIG = RigConfig.model_validate(RIG.model_dump() | {"sensors": RIG.sensors[:3]})


def make_cycle(
    channels: dict[str, Any],
    rig: RigConfig = RIG,
    sigma: dict[str, float] | None = None,
    specimen: dict[str, float] | None = None,
    protection: dict[str, float] | None = None,
    command: Any = -AMPLITUDE_M * WAVE,
    level: float = LEVEL_M_S2,
    label: Label = Label.MEASURE,
) -> DriveCycle:
    """A cycle of 2 Hz at 2000 Hz with these channels, (sample,), the others zero."""
    values = np.zeros((len(rig.channels), CYCLE_SAMPLES))
    for name, row in channels.items():
        values[rig.channels.index(name)] = row
    tables: dict[str, Any] = {"protection": protection or {}}
    tables["specimen"] = {"mass_kg": 550.0, "gap_mm": 4.0} | (specimen or {})
    profile = make_profile(tables=tables)
    noise = np.array([(sigma or {}).get(name, 0.0) for name in rig.channels])
    context = ProtectionContext(profile, rig, noise, np.full(noise.size, math.inf))
    return DriveCycle(context, values, command, PHASE, level, int(label))


@pytest.mark.parametrize("label", [Label.SETTLE, Label.MEASURE])
@given(
    edge=EDGES, alarm=st.floats(0.02, 0.5), abort_db=st.floats(1.0, 12.0), level=st.floats(0.1, 5.0)
)
@MANY
def test_check_level_alarm_and_stop(
    label: Label, edge: Edge, alarm: float, abort_db: float, level: float
) -> None:
    def suspect(ratio: float, severity: str, demanded: float = level) -> list[Suspicion]:
        cycle = make_cycle(
            {"table_acc_m_s2": ratio * level * WAVE},
            protection={"alarm": alarm, "abort_db": abort_db},
            level=demanded,
            label=label,
        )
        return [item for item in cycle_checks.check_level(cycle) if item.severity == severity]

    ratio = 1.0 + edge.signed_factor * alarm
    alarms = suspect(ratio, "alarm")
    is_measured = label == Label.MEASURE
    limit = (1 + edge.sign * alarm) * level
    require_suspicion(
        alarms, edge.is_beyond and is_measured, "level", "table_acc_m_s2", ratio * level, limit
    )
    for item in alarms:
        assert item.required_checks == 1
    ratio = 10.0 ** (edge.signed_factor * abort_db / 20.0)
    stops = suspect(ratio, "stop")
    limit = 10.0 ** (edge.sign * abort_db / 20.0) * level
    require_suspicion(stops, edge.is_beyond, "level", "table_acc_m_s2", ratio * level, limit)
    assert {item.required_checks for item in stops} <= {3}
    assert suspect(0.0, "stop")
    assert not suspect(9.0, "stop", 0.0)  # at rest no level is demanded
    assert not suspect(math.nan, "stop")


@given(edge=EDGES, command_m=st.floats(1e-5, 0.05))
@MANY
def test_check_command_gain_at_its_limit(edge: Edge, command_m: float) -> None:
    limit = 0.02 + LSB_M / command_m
    gain = 1.0 + edge.signed_factor * limit
    cycle = make_cycle({"drive_disp_m": gain * command_m * WAVE}, command=command_m * WAVE)
    suspicions = list(cycle_checks.check_command_gain(cycle))
    require_suspicion(
        suspicions, edge.is_beyond, "command", "drive_disp_m", gain, 1.0 + edge.sign * limit
    )
    for other in (
        make_cycle({"drive_disp_m": WAVE}, command=0.0 * WAVE),
        make_cycle({"drive_disp_m": math.nan}),
    ):
        assert not list(cycle_checks.check_command_gain(other))


@given(
    edge=EDGES,
    amplitude_m=st.floats(0.0, 0.05),
    sigma=st.floats(0.0, 1e-4),
    command_mean_m=st.sampled_from([0.0, -1e-3, 1e-3]),
)
@MANY
def test_check_table_mean_at_its_limit(
    edge: Edge, amplitude_m: float, sigma: float, command_mean_m: float
) -> None:
    """A command that has a mean, as a feedback that changes within the cycle, moves the table."""
    limit = 0.075e-3 + 0.02 * amplitude_m + sigma
    mean = edge.signed_factor * limit
    cycle = make_cycle(
        {"table_disp_m": amplitude_m * WAVE + command_mean_m + mean},
        sigma={"table_disp_m": sigma},
        command=amplitude_m * WAVE + command_mean_m,
    )
    suspicions = list(cycle_checks.check_table_mean(cycle))
    require_suspicion(suspicions, edge.is_beyond, "drift", "table_disp_m", mean, limit)
    assert not list(cycle_checks.check_table_mean(make_cycle({"table_disp_m": math.nan})))


@pytest.mark.parametrize("rig", [RIG, REL_RIG])
@pytest.mark.parametrize(
    ("gaps", "asymmetry_m"),
    [
        ({}, 0.0),
        ({"gap_mm": math.inf}, 0.0),
        ({"gap_right_mm": 2.0, "gap_left_mm": 8.0}, 3e-3),
        ({"gap_right_mm": 8.0, "gap_left_mm": 2.0}, 3e-3),
    ],
)
@given(edge=EDGES, half_m=st.floats(0.0, 0.05))
@MANY
def test_check_mass_mean_at_its_limit(
    rig: RigConfig, gaps: dict[str, float], asymmetry_m: float, edge: Edge, half_m: float
) -> None:
    limit = 0.1e-3 + 0.35 * half_m + asymmetry_m
    swing = SwingAverage(edge.signed_factor * limit, half_m, 20)
    cycle = make_cycle({}, rig, specimen=gaps)
    suspicions = list(cycle_checks.check_mass_mean(cycle, swing))
    require_suspicion(suspicions, edge.is_beyond, "drift", rig.channels[3], swing.mean, limit)
    early = replace(swing, check_count=19)
    assert not list(cycle_checks.check_mass_mean(cycle, early))
    assert not list(cycle_checks.check_mass_mean(make_cycle({}, BARE_RIG), swing))


@pytest.mark.parametrize("rig", [RIG, REL_RIG])
def test_update_swing_averages_twenty_checks(rig: RigConfig) -> None:
    chance = np.random.default_rng(3)
    average, expected, sums = SwingAverage(), np.zeros(2), np.zeros(2)
    table = 0.01 * WAVE if rig is RIG else 0.0 * WAVE
    for count in range(1, 46):
        mean, half = chance.standard_normal(), abs(chance.standard_normal())
        swing = mean + half * WAVE
        channels = {rig.channels[3]: swing + table, "table_disp_m": table}
        average = cycle_checks.update_swing(make_cycle(channels, rig), average)
        sums += mean, half
        expected += (np.array([mean, half]) - expected) / 20.0
        expected = sums / count if count <= 20 else expected
        assert [average.mean, average.half] == pytest.approx(expected.tolist())
        assert average.check_count == count
    lost = make_cycle({rig.channels[3]: math.nan}, rig)
    assert cycle_checks.update_swing(lost, average) == average


@given(
    lag_s=st.floats(0.0, 0.05),
    gain=st.floats(0.5, 1.5),
    a=st.floats(0.0, 9.0),
    low_cut=st.floats(0.0, 3.0),
)
@MANY
def test_measure_transfer_and_payload_deflection(
    lag_s: float, gain: float, a: float, low_cut: float
) -> None:
    transfer = gain * cmath.exp(-1j * OMEGA * lag_s)
    # Acceleration of the table behind the low cut of its sensor, s / (s + w_c).
    behind = -(OMEGA**2) * 1j * OMEGA / (1j * OMEGA + low_cut)
    tone = -AMPLITUDE_M * np.exp(2j * math.pi * PHASE)
    channels = {
        "table_disp_m": (transfer * tone).imag,
        "table_acc_m_s2": (behind * transfer * tone).imag,
        "mass_acc_m_s2": a * WAVE + 3.0 * np.sin(4 * math.pi * PHASE),
    }
    cycle = make_cycle(channels)
    assert cycle.omega == pytest.approx(OMEGA)
    both = cycle_checks.measure_transfer(cycle, low_cut)
    assert both == pytest.approx((transfer, transfer))
    assert cycle_checks.phase_lag_s(both[0], OMEGA) == pytest.approx(lag_s, abs=1e-9)
    deflection = 550.0 / 2000.0 * a * (0.5 * lag_s) ** 2 / (gain * AMPLITUDE_M)
    assert cycle_checks.payload_deflection(cycle, lag_s) == pytest.approx(deflection, abs=1e-12)
    for name in ("table_disp_m", "table_acc_m_s2", "mass_acc_m_s2"):
        lost = make_cycle({**channels, name: math.nan})
        known = [not cmath.isnan(item) for item in cycle_checks.measure_transfer(lost, low_cut)]
        assert known == [name != "table_disp_m", name != "table_acc_m_s2"]
        if name != "table_acc_m_s2":
            assert cycle_checks.payload_deflection(lost, lag_s) == 0.0
    still = cycle_checks.measure_transfer(make_cycle(channels, command=0.0 * WAVE), low_cut)
    assert all(cmath.isnan(item) for item in still)


@pytest.mark.parametrize("more", [0, 1])  # the sensor that shows the larger change
@pytest.mark.parametrize("a", [0.0, 2.0])
@given(edge=EDGES, other=SIGNS, larger=st.floats(1.001, 1.2), lag_s=st.floats(0.0, 0.02))
@MANY
def test_check_response_of_both_sensors(
    more: int, a: float, edge: Edge, other: float, larger: float, lag_s: float
) -> None:
    cycle = make_cycle({"table_disp_m": AMPLITUDE_M * WAVE, "mass_acc_m_s2": a * WAVE})
    reference = 0.9 * cmath.exp(-1j * OMEGA * lag_s)
    deflection = 550.0 / 2000.0 * a * (0.5 * lag_s) ** 2 / AMPLITUDE_M

    def suspect(ratios: list[complex]) -> list[Suspicion]:
        first, second = reversed(ratios) if more == 0 else ratios
        pair = (first * reference, second * reference)
        return list(cycle_checks.check_response(cycle, pair, reference))

    limit = 0.2 + deflection
    gain = 1.0 + edge.signed_factor * limit
    bound = 1.0 + edge.sign * limit
    gains = suspect([gain, 1.0 + other * larger * limit])
    require_suspicion(gains, edge.is_beyond, "response", "table_acc_m_s2", gain, bound)
    limit_s = max(0.5 * lag_s, 0.003) + deflection / OMEGA
    extra_s = edge.signed_factor * limit_s, other * larger * limit_s
    lags = suspect([cmath.exp(-1j * OMEGA * each) for each in extra_s])
    lag, bound = lag_s + extra_s[0], lag_s + edge.sign * limit_s
    require_suspicion(lags, edge.is_beyond, "response", "table_disp_m", lag, bound)
    assert suspect([complex("nan"), 2.0]) == suspect([2.0, complex("nan")]) == []
    assert suspect([0j, 2.0]) == suspect([2.0, 0j]) == []


# Laws of the comparison of a displacement with an acceleration

PAIRS = [(RIG, SENSOR_PAIRS[0], 2.0), (RIG, SENSOR_PAIRS[1], 5.0), (REL_RIG, SENSOR_PAIRS[2], 5.0)]


def make_pair(
    displacement: list[float],
    acceleration: list[float],
    constant: tuple[float, float, float] = (1.0, 0.0, 0.0),
    sigma: float = 0.0,
) -> WeakFormPair:
    """Return a pair of these amplitudes without low cut and delay; noise in the average only."""
    zeros = np.zeros(3, dtype=np.complex128)
    amplitudes = np.array([displacement, acceleration, constant], dtype=np.complex128)
    noise = np.array([sigma, 1e-12, 1e-12])
    return WeakFormPair(amplitudes[0], amplitudes[1], amplitudes[2], noise, zeros, zeros)


def make_baseline(checks: int, gain: float = 1.0, last: WeakFormPair | None = None) -> PairBaseline:
    return PairBaseline(last, PairErrorEstimate(PairErrors(gain), check_count=checks))


def suspect_pair(
    rig: RigConfig, names: tuple[tuple[str, ...], str], pair: WeakFormPair, baseline: PairBaseline
) -> list[Suspicion]:
    return list(cycle_checks.check_sensor_pair(make_cycle({}, rig), *names, pair, baseline))


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@given(
    edge=EDGES,
    gain=st.floats(0.97, 1.03),
    size=st.floats(0.5, 20.0),
    order=st.sampled_from([1, 2]),
    checks=st.sampled_from([0, 5, 6, 20]),
)
@MANY
def test_check_sensor_pair_gain_at_its_limits(
    rig: RigConfig,
    names: tuple[tuple[str, ...], str],
    range_g: float,
    edge: Edge,
    gain: float,
    size: float,
    order: int,
    checks: int,
) -> None:
    displacements, _ = names

    def suspect(limit: float, expected: float, at: int, baseline: PairBaseline) -> list[Suspicion]:
        motion = [0.0, size, size]
        moved = [0.0, expected * size, expected * size]
        moved[at] *= 1.0 - edge.share * limit if edge.sign < 0 else 1.0 / (1.0 - edge.share * limit)
        return suspect_pair(rig, names, make_pair(motion, moved), baseline)

    def check(suspicions: list[Suspicion], limit: float, expected: bool) -> None:
        assert len(suspicions) == expected
        for item in suspicions:
            assert (item.kind, item.channel) == ("consistency", displacements[0])
            assert item.group == displacements[0]
            assert (item.value, item.limit) == pytest.approx((edge.share * limit, limit))

    # Of either order of the motion, whatever is known of the pair.
    if order == 2 or checks < 6:
        check(suspect(0.12, 1.0, order, make_baseline(checks)), 0.12, edge.is_beyond)
    # Of the fundamental, from the gain that the pair had, once that is known.
    check(suspect(0.05, gain, 1, make_baseline(checks, gain)), 0.05, edge.is_beyond and checks >= 6)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@given(
    edge=EDGES,
    average=st.floats(1.0, 5.0),
    sigma=st.floats(0.0, 0.05),
    checks=st.sampled_from([0, 6]),
    wave=st.floats(3.0, 9.0),
)
@MANY
def test_check_sensor_pair_offset_is_a_drift(
    rig: RigConfig,
    names: tuple[tuple[str, ...], str],
    range_g: float,
    edge: Edge,
    average: float,
    sigma: float,
    checks: int,
    wave: float,
) -> None:
    _, acceleration = names

    def suspect(pair: WeakFormPair) -> Suspicion | None:
        suspicions = suspect_pair(rig, names, pair, make_baseline(checks))
        assert len(suspicions) <= 1
        return suspicions[0] if suspicions else None

    def is_drift(item: Suspicion | None, value: float, limit: float) -> bool:
        if item is None or item.kind != "drift":
            return False
        assert item.channel == acceleration
        assert (item.value, item.limit) == pytest.approx((value, limit))
        return True

    # Below an error of gain of the average, and where it spoils nothing else.
    max_offset = 1e-3 * range_g * GRAVITY_M_S2 + 6.0 * sigma
    limit = max_offset + 0.12 * average
    offset = edge.signed_factor * limit
    motion = [-edge.sign * average, wave, wave]
    item = suspect(make_pair(motion, [motion[0] + offset, wave, wave], sigma=sigma))
    assert (item is not None) == is_drift(item, offset, limit) == edge.is_beyond
    # Where it spoils the motion, it explains the difference, or most of it.
    offset, spoiled = edge.signed_factor * max_offset, 0.5 * wave
    constant = (1.0, spoiled / offset, 0.0)
    limit = 1e-3 * range_g * GRAVITY_M_S2
    weight = 1.0 + constant[1] ** 2
    limit += 6.0 * math.hypot(sigma, constant[1] * 1e-12) / weight
    offset = edge.signed_factor * limit
    constant = (1.0, spoiled / offset, 0.0)
    item = suspect(make_pair([0.0, wave, wave], [offset, wave + spoiled, wave], constant))
    assert item is not None
    assert is_drift(item, offset, 1e-3 * range_g * GRAVITY_M_S2) == (
        abs(offset) > 1e-3 * range_g * GRAVITY_M_S2
    )
    offset = 10.0 * edge.sign * max_offset
    constant = (1.0, spoiled / offset, 0.0)
    rest = 0.3 * edge.share * spoiled
    item = suspect(make_pair([0.0, wave, wave], [offset, wave + spoiled, wave + rest], constant))
    assert item is not None
    assert (item.kind == "drift") == (not edge.is_beyond)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("change", [0.5, 1.0, 1.5])
def test_check_sensor_pair_suspects_the_larger_change(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float, sign: float, change: float
) -> None:
    displacements, acceleration = names
    pair = make_pair([0.0, 11.0, 9.0], [0.0, 14.0, 9.0])
    last = make_pair([5.0, 11.0 - sign, 2.0], [3.0, 14.0 - sign * change, 7.0])
    (item,) = suspect_pair(rig, names, pair, PairBaseline(last))
    assert item.channel == (acceleration if change > 1.0 else displacements[0])


def test_baseline_is_known_after_six_comparisons() -> None:
    clear, unclear = make_pair([0.0, 9.0, 9.0], [0.0, 9.0, 9.0]), make_pair([0.0] * 3, [0.0] * 3)
    baseline = PairBaseline()
    for count in range(1, 9):
        baseline = baseline.update(unclear, OMEGA)
        assert (baseline.last, baseline.estimate.check_count) == (unclear, count - 1)
        baseline = baseline.update(clear, OMEGA)
        assert (baseline.last, baseline.estimate.check_count) == (clear, count)
        assert baseline.is_known == (count >= 6)


@pytest.mark.parametrize(("rig", "names", "range_g"), PAIRS)
def test_compare_sensor_pair_adds_displacements(
    rig: RigConfig, names: tuple[tuple[str, ...], str], range_g: float
) -> None:
    displacements, acceleration = names
    chance = np.random.default_rng(4)
    sizes = {name: chance.uniform(1e-3, 5e-3) for name in displacements}
    sigma = {name: chance.uniform(1e-6, 1e-5) for name in (*displacements, acceleration)}
    a = chance.standard_normal(CYCLE_SAMPLES)
    channels = {name: size * WAVE for name, size in sizes.items()} | {acceleration: a}
    cycle = make_cycle(channels, rig, sigma)
    filtered = chance.standard_normal(CYCLE_SAMPLES)
    x, noise = sum(sizes.values()) * WAVE, math.hypot(*(sigma[name] for name in displacements))
    expected = compare_motion(cycle.window, x, a, (noise, sigma[acceleration]), (filtered, 0.7))
    pair = cycle_checks.compare_sensor_pair(cycle, displacements, acceleration, filtered, 0.7)
    for name in ("displacement", "acceleration", "sigma", "low_cut_term", "delay_term"):
        np.testing.assert_allclose(getattr(pair, name), getattr(expected, name), rtol=1e-9)


# Laws of the load cells

SIDES = pytest.mark.parametrize(("side", "direction"), [(RIGHT_CELLS, 1.0), (LEFT_CELLS, -1.0)])


@SIDES
@given(edge=EDGES, sigma=st.floats(0.0, 50.0), other=st.sampled_from([0.0, 2.0]))
@MANY
def test_cells_without_contact_carry_nothing(
    side: tuple[str, str], direction: float, edge: Edge, sigma: float, other: float
) -> None:
    u = direction * 0.01 * WAVE
    count = int((direction * u < 0).sum())
    limit = 5.0 + 6.0 * sigma / math.sqrt(count)
    offset = edge.signed_factor * limit
    for first, second in (side, side[::-1]):
        channels = {"mass_disp_m": u, first: offset, second: other * offset}
        suspicions, shares = check_cell_pairs(make_cycle(channels, sigma={first: sigma}), {})
        expected = {first} if edge.is_beyond else set()
        expected |= {second} if other else set()
        if len(expected) == 2:  # then the displacement is
            expected = {"mass_disp_m"}
        assert {item.channel for item in suspicions} == expected
        assert {item.kind for item in suspicions} <= {"drift"}
        if expected == {first}:
            assert (suspicions[0].value, suspicions[0].limit) == pytest.approx((offset, limit))
        assert shares == {}
        for gap_mm in (0.0, -3.0):
            closed = make_cycle(channels, sigma={first: 1.0}, specimen={"gap_mm": gap_mm})
            assert check_cell_pairs(closed, {}) == ([], {})
        unmeasured = make_cycle(channels | {"mass_disp_m": math.nan}, sigma={first: 1.0})
        assert check_cell_pairs(unmeasured, {}) == ([], {})
    alone = make_cycle({"mass_disp_m": u, side[0]: 2.0 * offset, side[1]: math.nan})
    assert [item.channel for item in check_cell_pairs(alone, {})[0]] == [side[0]]


@SIDES
@pytest.mark.parametrize("count", [4, 5])
def test_five_samples_without_contact_show_the_force_of_a_cell(
    side: tuple[str, str], direction: float, count: int
) -> None:
    u = np.where(np.arange(CYCLE_SAMPLES) < count, -1e-3, np.where(PHASE < 0.5, 0.0, 1e-3))
    cycle = make_cycle({"mass_disp_m": direction * u, side[0]: 20.0})
    assert len(check_cell_pairs(cycle, {})[0]) == (count >= 5)
    # Contact on the own side bears nothing on the other one.
    pushed = make_cycle({"mass_disp_m": direction * u, side[0]: np.where(u >= 0, 1e3, 0.0)})
    assert check_cell_pairs(pushed, {side[0]: ForceShare(0.0, (500.0, 0.0))})[0] == []


@SIDES
@given(offset=st.floats(-4.0, 4.0), peak=st.floats(50.0, 5e3))
@MANY
def test_cells_in_tension_where_the_bumper_presses_are_reversed(
    side: tuple[str, str], direction: float, offset: float, peak: float
) -> None:
    u = direction * 0.01 * WAVE
    pulses = peak * np.clip(direction * u / 0.01 - 0.5, 0.0, None)
    for signs in ((1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)):
        cells = {name: offset + sign * pulses for name, sign in zip(side, signs, strict=True)}
        suspicions, _ = check_cell_pairs(make_cycle({"mass_disp_m": u, **cells}), {})
        wrong = [name for name, sign in zip(side, signs, strict=True) if sign < 0]
        assert [item.kind for item in suspicions] == ["polarity"] * bool(wrong)
        assert all(name in suspicions[0].text for name in wrong)
    # A sticking surface pulls less than it was pressed.
    sticky = {name: pulses - 0.2 * np.roll(pulses, CYCLE_SAMPLES // 16) for name in side}
    assert check_cell_pairs(make_cycle({"mass_disp_m": u, **sticky}), {})[0] == []


def share_force(
    side: tuple[str, str],
    angle: float,
    force_n: float,
    means: tuple[float, float] = (0.0, 0.0),
    sigma: float = 0.0,
) -> DriveCycle:
    """A cycle with a swinging force at this angle between both cells, precompressed."""
    first, second = math.cos(angle), math.sin(angle)
    channels = {
        side[0]: force_n * first * WAVE + means[0],
        side[1]: force_n * second * WAVE + means[1],
    }
    noise = {side[0]: sigma, side[1]: 0.5 * sigma}
    return make_cycle(channels, sigma=noise, specimen={"gap_mm": -1.0})


@SIDES
@given(
    edge=EDGES,
    angle=st.floats(0.4, 1.1),
    sigma=st.sampled_from([0.0, 0.1, 2.0]),
    less=st.sampled_from([0, 1]),
    force_n=st.floats(200.0, 2e3),
)
@MANY
def test_check_cell_pairs_share_at_its_limits(
    side: tuple[str, str],
    direction: float,
    edge: Edge,
    angle: float,
    sigma: float,
    less: int,
    force_n: float,
) -> None:
    sigma_angle = sigma / math.sqrt(CYCLE_SAMPLES) / (force_n / math.sqrt(2.0))
    means = (300.0, 400.0) if less == 0 else (400.0, 300.0)
    for expected, max_change, before in (
        (math.pi / 4, math.radians(25.0), {}),
        (angle, math.radians(3.0), {side[0]: ForceShare(angle, means, 7)}),
    ):
        measured = expected + edge.signed_factor * (max_change + 6.0 * sigma_angle)
        cycle = share_force(side, measured, force_n, means, sigma)
        suspicions, shares = check_cell_pairs(cycle, before)
        assert len(suspicions) == edge.is_beyond
        for item in suspicions:
            assert (item.kind, item.channel, item.group) == ("share", side[less], side[0])
            assert (item.value, item.limit) == pytest.approx(
                (measured, expected + edge.sign * max_change)
            )
            assert shares == before
        if not suspicions:
            weight = 1.0 / 8.0 if before else 1.0
            start = expected if before else 0.0
            assert shares[side[0]].angle == pytest.approx(start + weight * (measured - start))
            assert shares[side[0]].check_count == (8 if before else 1)
            assert shares[side[0]].means == pytest.approx(means)
    # A force within its noise says nothing; the force is the root mean square of both.
    force_n = 20.0 * sigma * math.sqrt(2.0) * edge.share
    assert (
        side[0] in check_cell_pairs(share_force(side, angle, force_n, means, sigma), {})[1]
    ) == (edge.is_beyond and sigma > 0.0)


@SIDES
@given(
    edge=EDGES,
    angle=st.floats(0.4, 1.1),
    sigma=st.sampled_from([0.0, 0.1, 2.0]),
    along_n=st.floats(-300.0, 300.0),
    count=st.sampled_from([1, 4, 20]),
)
@MANY
def test_check_cell_pairs_drift_across_the_axis(
    side: tuple[str, str],
    direction: float,
    edge: Edge,
    angle: float,
    sigma: float,
    along_n: float,
    count: int,
) -> None:
    """A force along the axis is a load; across it, half the contact force on both cells."""
    force_n, before = 1e3, ForceShare(angle, (50.0, 70.0), count)
    sigma_mean = sigma / math.sqrt(CYCLE_SAMPLES)
    sigma_angle = sigma_mean / (force_n / math.sqrt(2.0)) / math.sqrt(count)
    across_n = 5.0 * math.sqrt(2.0)
    for _ in range(50):  # the uncertainty grows with the force itself
        uncertainty = sigma_angle * math.hypot(along_n, across_n)
        across_n = 5.0 * math.sqrt(2.0) + 6.0 * math.hypot(uncertainty, 2.0 * sigma_mean)
    limit, across_n = across_n, edge.signed_factor * across_n
    means = (
        50.0 + along_n * math.cos(angle) - across_n * math.sin(angle),
        70.0 + along_n * math.sin(angle) + across_n * math.cos(angle),
    )
    cycle = share_force(side, angle, force_n, means, sigma)
    suspicions, shares = check_cell_pairs(cycle, {side[0]: before})
    assert len(suspicions) == edge.is_beyond
    for item in suspicions:
        assert (item.kind, item.channel) == ("drift", side[0] if edge.sign < 0 else side[1])
        assert item.value == pytest.approx(abs(across_n))
        assert item.limit == pytest.approx(limit, rel=1e-5)
    if not suspicions and count < 20:
        expected = [
            old + (new - old) / (count + 1) for old, new in zip((50, 70), means, strict=True)
        ]
        assert shares[side[0]].means == pytest.approx(expected)
    if count == 20:
        assert shares[side[0]] == before  # fixed from then on


# Laws of the schedule: which samples are checked together, and when a suspicion is confirmed


def make_span(
    first: int,
    count: int,
    key: int = 1,
    channels: dict[str, Any] | None = None,
    rig: RigConfig = RIG,
    is_half_cycle: bool = True,
) -> SampleSpan:
    """Samples of a table that follows exactly at 2 Hz; the phase starts again at every cycle."""
    phase = (np.arange(first, first + count) / CYCLE_SAMPLES + 0.3) % 1.0
    wave = np.sin(2 * math.pi * phase)
    values = np.zeros((len(rig.channels), count))
    values[[DRIVE, TABLE]] = -AMPLITUDE_M * wave
    values[ACC] = LEVEL_M_S2 * wave
    if rig is not BARE_RIG:
        values[MASS] = -AMPLITUDE_M * wave if rig is RIG else 0.0
        values[MASS_ACC] = LEVEL_M_S2 * wave
    for name, factor in (channels or {}).items():
        values[rig.channels.index(name)] *= factor
    label = int(Label.MEASURE if key > 1 else Label.BLEND)
    return SampleSpan(values, -AMPLITUDE_M * wave, phase, LEVEL_M_S2, label, key, is_half_cycle)


@pytest.mark.parametrize("rig", [RIG, REL_RIG, BARE_RIG])
@given(counts=st.lists(st.integers(2, 1100), min_size=1, max_size=12))
@settings(max_examples=5, derandomize=True)
def test_check_cycle_joins_the_fewest_spans(rig: RigConfig, counts: list[int]) -> None:
    context = make_cycle({}, rig).context
    state, first, spans = CycleCheckState(), 0, []
    low_cuts = {"table_disp_m": 1.3, "mass_disp_m": 0.4, "rel_disp_m": 2.2}
    baselines = {
        name: PairBaseline(None, PairErrorEstimate(PairErrors(1.0, low_cut)))
        for name, low_cut in low_cuts.items()
    }
    state = replace(state, pair_baselines=baselines)
    for count in counts:
        span = make_span(first, count, rig=rig)
        first += count
        spans.append(span)
        state = replace(check_cycle(context, state, span)[0], pair_baselines=baselines)
        sizes = [item.phase.size for item in spans]
        fewest = next(
            (k for k in range(1, len(sizes) + 1) if sum(sizes[-k:]) > 0.999 * CYCLE_SAMPLES),
            len(sizes),
        )
        assert [item.phase.size for item in state.spans] == sizes[-fewest:]
        assert protection._count_cycles(spans) == pytest.approx(first / CYCLE_SAMPLES)
        cycle = protection._join_spans(context, list(state.spans))
        begin = first - sum(sizes[-fewest:])
        expected = np.arange(begin, first) / CYCLE_SAMPLES + 0.3
        assert cycle.phase == pytest.approx(expected - math.floor(expected[0]))
        assert cycle.command == pytest.approx(-AMPLITUDE_M * np.sin(2 * math.pi * expected))
        assert (cycle.level, cycle.label) == (LEVEL_M_S2, int(Label.BLEND))
        assert cycle.values[TABLE] == pytest.approx(cycle.command)
        # The high-pass runs on from span to span as over all samples in one.
        joined = np.concatenate([item.values for item in spans], axis=1)
        for names, acceleration in SENSOR_PAIRS:
            if not {*names, acceleration} <= {*rig.channels}:
                assert names[0] not in state.spans[-1].filtered
                continue
            x = sum(joined[rig.channels.index(name)] for name in names)
            whole = highpass(np.asarray(x), low_cuts[names[0]], 2000.0)
            filtered = np.concatenate([item.filtered[names[0]] for item in state.spans])
            assert filtered == pytest.approx(whole[-filtered.size :], abs=1e-12)


@pytest.mark.parametrize(
    ("name", "factor", "kind"),
    [
        ("mass_acc_m_s2", 3.0, "consistency"),
        ("mass_disp_m", 3.0, "consistency"),
        ("table_acc_m_s2", 5.0, "level"),
        ("drive_disp_m", 1.3, "command"),
    ],
)
@pytest.mark.parametrize("pause", [None, 3, 5])
def test_suspicion_is_confirmed_by_the_third_check(
    name: str, factor: float, kind: str, pause: int | None
) -> None:
    """Checks begin with the second half cycle; a sound one, or a rest, starts the count again."""
    context, state, numbers = make_cycle({}).context, CycleCheckState(), []
    for number in range(1, 11):
        channels = {} if number in (pause, pause and pause + 1) else {name: factor}
        span = make_span(500 * (number - 1), 500, 2, channels)
        state, suspicions = check_cycle(context, state, span)
        numbers += [
            number for item in suspicions if item.kind == kind and item.required_checks == 3
        ]
    # Two sound half cycles make a sound check.
    assert numbers == {None: [4], 3: [7], 5: [4, 9]}[pause]
    rested, suspicions = check_cycle(context, state, make_span(5000, 500, 0))
    assert (rested.spans, dict(rested.streaks), suspicions) == ((), {}, ())


def test_motion_is_steady_over_two_half_cycles() -> None:
    """Only then are level and command checked: not in blends, nor across steps or parts of them."""
    context, wrong = make_cycle({}).context, {"drive_disp_m": 1.3}
    for keys, is_half, steady in (
        ((2, 2), (True, True), True),
        ((5, 5), (True, True), True),
        ((1, 1), (True, True), False),
        ((1, 2), (True, True), False),
        ((2, 3), (True, True), False),
        ((2, 2), (False, True), False),
        ((2, 2), (True, False), False),
    ):
        state = CycleCheckState()
        for k in range(2):
            span = make_span(500 * k, 500, keys[k], wrong, is_half_cycle=is_half[k])
            state, _ = check_cycle(context, state, span)
        assert (("command", "drive_disp_m", "sensor") in state.streaks) == steady, keys
    whole = check_cycle(context, CycleCheckState(), make_span(0, 1000, 2, wrong))[0]
    assert ("command", "drive_disp_m", "sensor") not in whole.streaks


@given(gain=st.floats(0.6, 1.4), lag_s=st.floats(0.0, 0.09), edge=EDGES)
@MANY
def test_update_table_response_if_plausible(gain: float, lag_s: float, edge: Edge) -> None:
    def update(state: CycleCheckState, gain: float, lag_s: float) -> CycleCheckState:
        table = gain * cmath.exp(-2j * math.pi * 1.5 * lag_s)
        return state.update_table_response(table, 1.5)

    unknown = CycleCheckState()
    state = update(unknown, gain, lag_s)
    assert (state.gain, state.lag_s) == pytest.approx((gain, lag_s), abs=1e-9)
    assert (update(unknown, 1.5 / edge.share, lag_s) is not unknown) == edge.is_beyond
    assert (update(unknown, 0.5 * edge.share, lag_s) is not unknown) == edge.is_beyond
    assert (update(unknown, gain, 0.1 / edge.share) is not unknown) == edge.is_beyond
    assert update(unknown, gain, -1e-6 - lag_s) is unknown
    for bound in (0.5, 1.5):  # themselves excluded, a lag of zero is not
        assert unknown.update_table_response(complex(bound), 1.5) is unknown
        inside = complex(float(np.nextafter(bound, 1.0)))
        assert unknown.update_table_response(inside, 1.5).lag_s == 0.0
    known = replace(unknown, gain=1.0, lag_s=0.0 if edge.sign < 0 else 0.02)
    assert (update(known, 1.0 + 0.1 * edge.signed_factor, lag_s) is known) == edge.is_beyond


def test_visited_response_of_the_first_sound_check() -> None:
    context, state = make_cycle({}).context, CycleCheckState()
    table = {"table_disp_m": 1.1, "table_acc_m_s2": 1.1, "mass_disp_m": 1.1, "mass_acc_m_s2": 1.1}
    for number, channels in enumerate(({"drive_disp_m": 1.3}, {}, table)):
        for k in (2 * number, 2 * number + 1):
            span = make_span(500 * k, 500, 2 + number, channels)
            state, _ = check_cycle(context, state, span)
        if number == 0:
            assert state.visited_responses == {}  # a suspicion is no reference
        else:
            assert list(state.visited_responses) == [2.0]
            assert state.visited_responses[2.0] == pytest.approx(1.0)


@pytest.mark.parametrize("is_history", [False, True])
def test_set_response_at_the_first_step(is_history: bool) -> None:
    """Of a history, which has no step, that in the middle of its band on a logarithmic scale."""
    profile = make_profile(start_hz=3.0, stop_hz=3.0)
    if is_history:
        band = {"start_hz": 1.0, "stop_hz": 9.0, "duration_s": 20.0, "acceleration_g": 0.02}
        profile = make_history_profile("chirp", **band)
    lags_s, frequencies_hz = (0.012, 0.015, 0.02), (1.0, 3.0, 9.0)
    phases = tuple(-2 * math.pi * f * lag for f, lag in zip(frequencies_hz, lags_s, strict=True))
    response = FrequencyResponse(0, frequencies_hz, (1.0, 0.9, 0.7), phases)
    state = set_response(start_protection(profile, RIG, {}), response)
    plan = profile.plan
    frequency_hz = math.sqrt(plan.low_hz * plan.high_hz)
    assert frequency_hz == pytest.approx(3.0, rel=0.05)
    table = evaluate_transfer(response, frequency_hz)
    assert state.cycle_state.response is response
    lag_s = -cmath.phase(table) / (2 * math.pi * frequency_hz)
    assert (state.cycle_state.gain, state.cycle_state.lag_s) == pytest.approx((abs(table), lag_s))
    scalars = state.sample_state.scalars
    assert (scalars[TABLE_GAIN], scalars[TABLE_LAG]) == pytest.approx((abs(table), lag_s))


def test_every_sample_goes_to_the_cycle_checks_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """In spans that end at half a cycle or with the motion, whatever the blocks were."""
    spans: list[SampleSpan] = []

    def record(_: ProtectionContext, state: CycleCheckState, span: SampleSpan) -> Any:
        spans.append(span)
        return state, ()

    monkeypatch.setattr(protection, "check_cycle", record)
    list_findings(cut=97)
    measured = simulate_channels()
    (steps, labels, _), command, phase, level, _ = evaluate_drive(PLAN)
    first = 0
    for span in spans:
        last = first + span.phase.size
        np.testing.assert_array_equal(span.values, measured[:, first:last])
        np.testing.assert_array_equal(span.command, command[first:last])
        assert np.unwrap(span.phase, period=1.0) - span.phase[0] == pytest.approx(
            phase[first:last] - phase[first], abs=1e-9
        )
        assert (span.level, span.label) == (level[last - 1], labels[last - 1])
        step = int(steps[last - 1])
        is_held = span.label in (Label.SETTLE, Label.MEASURE)
        assert span.key == (2 + step if is_held else span.label != Label.REST)
        if is_held:  # nine cycles are 18 halves, of which the last ends with the motion
            half = 0.5 * 2000.0 / PLAN.steps[step].frequency_hz
            assert span.phase.size == pytest.approx(half, abs=1)
        first = last
    assert first >= PLAN.rest_start
    assert [span.is_half_cycle for span in spans if span.key == 2][:17] == [True] * 17
    assert not [span for span in spans if span.key == 1][-1].is_half_cycle
