"""Effects of a table: each term against equations of its own, found again where it is planted."""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from table_io.block import Float1D, Float2D
from table_io.config.provenance import Provenance
from table_io.errors import InputError
from table_io.sim.config import HydraulicTableConfig
from table_io.sim.hydraulic_table import make_coefficients
from tests.earthquakes.hydraulic_rig import (
    RATE_HZ,
    SPECIMEN_KG,
    STALL_N,
    TABLE,
    build_rig,
    identify,
    make_random_motion,
    play,
)
from tests.earthquakes.planted_tables import PlantedTable, record_rehearsal
from twin.earthquakes.drive_computation import compute_command, measure_error
from twin.earthquakes.result import HYDRAULIC, Judgement, TableTwinResult, load_table_twin
from twin.earthquakes.table_effects import EFFECT_BY_ID, LIBRARY
from twin.earthquakes.table_evidence import (
    EffectDiscovery,
    FittedTable,
    TableProblem,
    describe_discovery,
    discover_table_effects,
    list_stranger_forces,
)
from twin.earthquakes.table_identification import (
    BOUNDS,
    RehearsalProblem,
    TableRehearsal,
    fit_basic_twin,
    fit_table,
)
from twin.earthquakes.table_model import TableModel, TableParameters
from twin.evidence.verdict import SelectionVerdict

MASS_KG = TABLE.moving_mass_kg
BASIC = TableParameters(
    pressure_feedback_s=0.003, friction_n=500.0, static_excess_n=150.0, stick_damping_n_s_m=2e4,
    viscous_n_s_m=500.0, frame_ratio=0.05, stall_force_n=STALL_N,
)  # fmt: skip
# Size of each effect in the tests: clear at 0.02 g, but the table still moves.
SIZES: dict[str, dict[str, float]] = {
    "dead_band": {"dead_band_m_s": 3e-3},
    "valve_hysteresis": {"valve_hysteresis_m_s": 1.2e-3},
    "flow_asymmetry": {"flow_asymmetry": 0.05},
    "friction_drift": {"friction_drift_1_s": 0.5},
    "friction_asymmetry": {"friction_asymmetry": 0.25},
    "friction_slope": {"friction_slope_1_m": 40.0},
    "backlash": {"backlash_m": 6e-5},
    "transducer_gain": {"transducer_gain_error": 0.06},
    "transducer_lag": {"transducer_lag_s": 0.006},
    "second_frame_mode": {
        "second_frame_ratio": 0.05, "second_frame_hz": 22.0, "second_frame_damping": 0.06,
    },
}  # fmt: skip
# The same in the simulated table, whose valve opens to 0.9094 m/s.
OPEN_M_S = 63e-3 / 60.0 * math.sqrt(3.0) / 20e-4
PLANTED: dict[str, dict[str, float]] = {
    "dead_band": {"valve_overlap_percent": 100.0 * 3e-3 / OPEN_M_S},
    "friction_drift": {"friction_drift_1_s": 0.5},
    "valve_hysteresis": {"valve_hysteresis_percent": 100.0 * 1.2e-3 / OPEN_M_S},
    "flow_asymmetry": {"flow_asymmetry": 0.05},
    "friction_asymmetry": {"friction_asymmetry": 0.25},
    "friction_slope": {"friction_slope_1_m": 40.0},
    "backlash": {"coupling_play_mm": 0.06},
    "transducer_gain": {"transducer_gain_error": 0.06},
    "transducer_lag": {"transducer_lag_ms": 6.0},
}


def command_at(t: float) -> tuple[float, float]:
    """Return command in m and its rate in m/s: two sines that rise from rest, 4 ms late."""
    t -= 0.004
    if t <= 0.0:
        return 0.0, 0.0
    rise, slope = min(t, 1.0), float(t < 1.0)
    a, b = 2.0 * math.pi * 1.3, 2.0 * math.pi * 6.1
    value = 4e-3 * math.sin(a * t) + 4e-4 * math.sin(b * t)
    rate = 4e-3 * a * math.cos(a * t) + 4e-4 * b * math.cos(b * t)
    return rise**2 * value, 2.0 * rise * slope * value + rise**2 * rate


def solve_independently(p: TableParameters, times: Float1D) -> Float2D:
    """Return displacement and acceleration of the table, (2, sample), by an adaptive method."""
    w_oil, w_valve, w_frame = (2 * math.pi * hz for hz in (p.oil_hz, p.valve_hz, p.frame_hz))
    w_second, stiffness = 2 * math.pi * p.second_frame_hz, MASS_KG * w_oil**2

    def derivatives(t: float, s: Float1D) -> list[float]:
        y, vy, oil, spool, spool_rate, slow, yf, vf, y2, v2, z, x, reading = s
        target, target_rate = command_at(t)
        q, v = y - yf - y2, vy - vf - v2
        direction = 1.0 if v > 0 else -1.0
        half_play = stiffness * p.backlash_m / 2
        force = math.copysign(max(abs(oil) - half_play, 0.0), oil)
        limit = (1 + direction * p.friction_asymmetry) * (1 + p.friction_slope_1_m * q)
        slip = 1 - direction * z / limit
        dry = p.friction_n + p.static_excess_n * math.exp(-((v / p.stribeck_speed_m_s) ** 2))
        friction = dry * z + (p.viscous_n_s_m + p.stick_damping_n_s_m * slip) * v
        net = force - (1 + p.friction_drift_1_s * t) * friction
        opening = spool - p.valve_hysteresis_m_s / 2 * x
        opening = math.copysign(max(abs(opening) - p.dead_band_m_s, 0.0), opening)
        sign = math.copysign(1.0, opening)
        flow = opening * (1 + p.flow_asymmetry * sign) * math.sqrt(1 - sign * force / STALL_N)
        measured = (1 + p.transducer_gain_error) * q
        shown = reading if p.transducer_lag_s else measured
        asked = p.gain_1_s * (target - shown) + p.velocity_feedforward * target_rate
        asked -= p.pressure_feedback_s * (force - slow) / MASS_KG
        valve_sign = 1.0 if spool_rate > 0 else -1.0
        width = p.valve_hysteresis_m_s or 1.0
        return [
            vy, net / MASS_KG,
            stiffness * (flow - v) - 2 * p.oil_damping * w_oil * force,
            spool_rate, w_valve**2 * (asked - spool) - 2 * p.valve_damping * w_valve * spool_rate,
            2 * math.pi * (force - slow),
            vf, -p.frame_ratio * net / MASS_KG - w_frame**2 * yf
            - 2 * p.frame_damping * w_frame * vf,
            v2, -p.second_frame_ratio * net / MASS_KG - w_second**2 * y2
            - 2 * p.second_frame_damping * w_second * v2,
            v / p.presliding_m * slip, 2 * spool_rate / width * (1 - valve_sign * x),
            (measured - reading) / (p.transducer_lag_s or 1.0),
        ]  # fmt: skip

    solution = solve_ivp(
        derivatives, (0.0, times[-1]), np.zeros(13), "RK45", times, rtol=1e-6, atol=1e-10,
        max_step=5e-4,
    )  # fmt: skip
    acceleration = [derivatives(t, s)[1] for t, s in zip(times, solution.y.T, strict=True)]
    return np.array([solution.y[0], acceleration])


@pytest.mark.parametrize("effect", LIBRARY, ids=lambda effect: effect.id)
def test_the_term_is_that_of_an_independent_solution(effect) -> None:
    """The effect itself, the difference that it makes, is that of another integrator."""
    times = np.arange(600) / RATE_HZ
    command = np.array([command_at(t + 0.004)[0] for t in times])
    smooth = BASIC._replace(stick_damping_n_s_m=2e3, presliding_m=1e-4, friction_n=800.0)
    changed = smooth._replace(**SIZES[effect.id])
    before, after = (
        TableModel(MASS_KG, parameters).simulate(command, RATE_HZ)
        for parameters in (smooth, changed)
    )
    expected = solve_independently(changed, times)
    change = np.abs(after - before).max(axis=1)
    error = np.abs(after - expected).max(axis=1)
    assert error[0] < 0.03 * change[0] + 2e-7
    assert np.sqrt(np.mean((after - expected)[1] ** 2)) < 0.1 * np.sqrt(
        np.mean((after - before)[1] ** 2)
    )


def test_without_effects_twin_and_table_keep_their_values_within_1e_9() -> None:
    """Three samples of twin and simulated table from before there were effects."""
    command = make_random_motion(8.0, (0.3, 35.0), 0.2, seed=4)
    out = TableModel(2000.0, BASIC._replace(viscous_n_s_m=500.0)).simulate(command, RATE_HZ)
    samples = [2500, 5000, 7000]
    twin = [
        0.005462180629920816, 0.0033992888682527348, 0.0004038075953410553,
        -0.2556008876248372, -0.09956734013797294, -0.02670700092995691,
    ]  # fmt: skip
    table = [
        0.00555018438670791, 0.0034185671297033314, 0.000414989059959248,
        -0.25044879674301396, -0.06511722263801793, 0.013872974211371774,
    ]  # fmt: skip
    # The command itself comes from a Fourier transform, whose last bits differ between machines.
    np.testing.assert_allclose(out[:2, samples].ravel(), twin, rtol=1e-9)
    np.testing.assert_allclose(play(build_rig(), command)[:2, samples].ravel(), table, rtol=1e-9)


@pytest.mark.parametrize("name", [effect.id for effect in LIBRARY])
def test_shapes_of_an_absent_effect_do_not_matter(name: str) -> None:
    command = make_random_motion(4.0, (0.3, 35.0), 0.2, seed=4)
    shapes = {key: 1.1 * value for key, value in list(SIZES[name].items())[1:]}
    plain, shaped = (
        TableModel(MASS_KG, parameters).simulate(command, RATE_HZ)
        for parameters in (BASIC, BASIC._replace(**shapes))
    )
    np.testing.assert_array_equal(plain, shaped)


def test_a_short_lag_of_the_transducer_is_integrated() -> None:
    """Shorter than a step, across it and in between: the change grows with the lag."""
    command = make_random_motion(4.0, (0.3, 35.0), 0.2, seed=4)
    lags_s = [1e-9, 1e-5, 5e-5, 9e-5, 2e-4, 2.4e-4, 2.5e-4, 2.6e-4, 3e-4, 6e-4]
    plain, *lagging = (
        TableModel(MASS_KG, BASIC._replace(transducer_lag_s=lag_s)).simulate(command, RATE_HZ)[0]
        for lag_s in [0.0, *lags_s]
    )
    per_lag = [
        (out - plain).std() / lag_s for out, lag_s in zip(lagging[1:], lags_s[1:], strict=True)
    ]
    np.testing.assert_allclose(per_lag, per_lag[0], rtol=0.02)
    np.testing.assert_allclose(lagging[0], plain, atol=1e-9)


@pytest.mark.parametrize("name", list(PLANTED))
def test_table_and_twin_are_changed_alike(name: str) -> None:
    """Two codes and two forms of each law: the change of the acceleration has one shape and size.

    Hysteresis is a smooth loop in the twin and play in the table, backlash is without the mass of
    the piston in the twin: these two agree least, by 0.92 and 0.90.
    """
    assert TABLE.hydraulic is not None
    rig = build_rig()
    config = TABLE.hydraulic.model_copy(update=PLANTED[name])
    worn = replace(rig, oil=make_coefficients(config, MASS_KG)._replace(fc=500.0, fs=650.0))
    command = make_random_motion(8.0, (0.3, 20.0), 0.2, seed=7)
    before, after = play(rig, command), play(worn, command)
    twin = TableParameters(
        gain_1_s=20.0, velocity_feedforward=0.2, delay_s=0.002, oil_hz=26.902, oil_damping=0.0493,
        pressure_feedback_s=0.0034641, friction_n=500.0, static_excess_n=150.0, presliding_m=2.6e-5,
        friction_memory=0.85, stick_damping_n_s_m=2e4, viscous_n_s_m=500.0, frame_hz=14.0,
        frame_damping=0.1, frame_ratio=0.05, stall_force_n=STALL_N,
    )  # fmt: skip
    without, with_effect = (
        TableModel(MASS_KG, parameters).simulate(command, RATE_HZ, -SPECIMEN_KG * signals[3])
        for parameters, signals in ((twin, before), (twin._replace(**SIZES[name]), after))
    )
    change, expected = (with_effect - without)[1], (after - before)[1]
    assert np.abs(change).max() > 0.02
    assert change @ expected / math.sqrt((change @ change) * (expected @ expected)) > 0.85
    assert 0.8 < change @ expected / (change @ change) < 1.2


START = {key: values[0] for key, values in BOUNDS.items()} | {
    "friction_n": 500.0 / (9.81 * MASS_KG), "static_excess_n": 150.0 / (9.81 * MASS_KG),
    "delay_s": 0.0072, "velocity_feedforward": 0.001, "stick_damping_n_s_m": 10.0,
    "viscous_n_s_m": 0.75, "frame_ratio": 0.05, "frame_damping": 0.05,
    "pressure_feedback_s": 0.003, "oil_damping": 0.05,
}  # fmt: skip


def record_twin(
    seconds: float,
    sizes: Mapping[str, float] = MappingProxyType({}),
    foreign: Callable[[Float1D, Float1D], Float1D] | None = None,
) -> RehearsalProblem:
    """Return a rehearsal of the twin itself, with a foreign force of stroke and speed on it."""
    command = make_random_motion(seconds, (0.3, 35.0), 0.2, seed=11)
    true = TableModel(MASS_KG, BASIC._replace(viscous_n_s_m=1500.0, friction_memory=0.8, **sizes))
    y, acceleration = true.simulate(command, RATE_HZ)
    for _ in range(4 if foreign else 0):
        assert foreign is not None
        y, acceleration = true.simulate(command, RATE_HZ, foreign(y, np.gradient(y) * RATE_HZ))
    rng = np.random.default_rng(5)
    acceleration = acceleration + 5e-3 * rng.standard_normal(command.size)
    motion = TableRehearsal(RATE_HZ, command, y, acceleration, np.zeros_like(y))
    return RehearsalProblem.from_rehearsal(motion, MASS_KG, STALL_N)


def rehearse_on_twin(name: str, seconds: float = 24.0, **sizes: float) -> EffectDiscovery:
    """Return what is found in a rehearsal of the twin itself, from a fit that begins near it."""
    problem = record_twin(seconds, sizes or SIZES.get(name, {}))
    return discover_table_effects(fit_table(problem, BOUNDS, START))


@cache
def fit_with_dead_band() -> FittedTable:
    """A twin fitted with the dead band that its table has."""
    effect, problem = EFFECT_BY_ID["dead_band"], record_twin(12.0, {"dead_band_m_s": 3e-3})
    start = START | {"dead_band_m_s": 3e-3}
    return FittedTable((effect,), fit_table(problem, {**BOUNDS, **effect.bounds}, start, 4))


@pytest.mark.slow  # 5 s
def test_a_planted_effect_is_named_with_its_size() -> None:
    discovery = rehearse_on_twin("flow_asymmetry")
    verdict = discovery.verdict
    assert (verdict.outcome, verdict.best.names) == ("named", ("flow_asymmetry",))
    assert verdict.confidence > 0.95
    width = discovery.fitted.fit.estimate_half_widths()["flow_asymmetry"]
    assert discovery.fitted.fit.parameters.flow_asymmetry == pytest.approx(0.05, abs=width)
    assert discovery.fitted.gap < 0.6 * discovery.basic.gap
    assert "flow that differs with direction" in describe_discovery(discovery)[1]


@pytest.mark.slow  # 9 s
def test_friction_that_falls_as_the_oil_warms_up_is_named_with_its_drift() -> None:
    discovery = rehearse_on_twin("friction_drift", 50.0, friction_drift_1_s=-0.008)
    assert discovery.verdict.best.names == ("friction_drift",)
    assert discovery.verdict.outcome == "named"
    width = discovery.fitted.fit.estimate_half_widths()["friction_drift_1_s"]
    assert discovery.fitted.fit.parameters.friction_drift_1_s == pytest.approx(-0.008, abs=width)
    assert width < 0.001


def test_nothing_is_named_where_nothing_is_missing() -> None:
    discovery = rehearse_on_twin("")
    assert (discovery.verdict.outcome, discovery.verdict.best.names) == ("none", ())
    assert describe_discovery(discovery)[0].startswith("missing effects: none, with a probability")


@pytest.mark.slow  # 8 s
def test_what_no_effect_explains_is_unexplained_in_its_place() -> None:
    """A friction that grows with the stroke, even in it: no effect of the library."""
    problem = record_twin(24.0, foreign=lambda y, v: -600.0 * np.tanh(v / 5e-3) * (y / 5e-3) ** 2)
    discovery = discover_table_effects(fit_table(problem, BOUNDS, START))
    assert (discovery.verdict.outcome, discovery.verdict.place) == ("unexplained", "friction")
    assert discovery.verdict.confidence > 0.95


def test_the_linear_model_about_a_set_leaves_what_its_fit_leaves() -> None:
    """The secant of a large dead band, not its slope: the residual of its fit is reproduced."""
    fitted = fit_with_dead_band()
    linear = TableProblem(fitted.fit.problem).linearize(fitted, [])
    assert linear.variants[0].candidate.id == "dead_band"
    (amplitude,), _ = linear.estimate([0])
    fitted_amplitude = fitted.fit.parameters.dead_band_m_s
    assert amplitude == pytest.approx(fitted_amplitude, rel=0.01)
    assert linear.level * fitted.fit.residuals.size < fitted.squares


def test_a_stranger_on_the_table_is_none_on_its_command() -> None:
    fitted = fit_with_dead_band()
    for place, force_n, command_m in list_stranger_forces(fitted.fit):
        is_force = place.startswith("friction")
        assert not (command_m if is_force else force_n).any()


def test_a_named_effect_is_described_with_equation_and_source() -> None:
    fit: Any = SimpleNamespace(
        estimate_half_widths=lambda: {"backlash_m": 1e-6},
        parameters=BASIC._replace(backlash_m=5e-5),
    )
    best: Any = SimpleNamespace(
        effects=(EFFECT_BY_ID["backlash"],), names=("backlash",), fit=fit, gap=0.05
    )
    verdict = SelectionVerdict("named", best, 0.99, 0.99, (), False, "the residual is noise", "")
    without: Any = SimpleNamespace(effects=(), names=(), fit=fit, gap=0.1)
    discovery: Any = SimpleNamespace(verdict=verdict, basic=without, fitted=best)
    lines = describe_discovery(discovery)
    assert lines[0] == ("missing effects: named, with a probability of 0.99: the residual is noise")
    assert lines[2].startswith("  equation: f -> f - K b/2 sat(2 f / (K b)) (Nordin, Gutman")
    assert lines[3].startswith("  backlash_m = 5e-05 +- 1e-06 m (95 %)")
    assert lines[4] == "  left on held-out data: 10 % -> 5 % of the motion"
    refused: Any = SimpleNamespace(verdict=verdict, basic=without, fitted=without)
    (note,) = [line for line in describe_discovery(refused) if "not kept" in line]
    assert note.endswith("backlash")


@pytest.mark.slow  # 60 s each
@pytest.mark.parametrize("name", ["friction_asymmetry", ""])
def test_the_effect_of_a_simulated_table_is_named(name: str) -> None:
    """As the rig records it; the drive computed with the effect is better than without."""
    table = PlantedTable(PLANTED.get(name, {}), seed=77, effect=name)
    problem = RehearsalProblem.from_rehearsal(record_rehearsal(table), MASS_KG, STALL_N)
    basic = fit_basic_twin(problem)
    discovery = discover_table_effects(basic)
    assert discovery.verdict.best.names == ((name,) if name else ())
    assert discovery.verdict.outcome == ("named" if name else "none")
    if not name:
        return
    parameter = EFFECT_BY_ID[name].parameters[0].name
    width = discovery.fitted.fit.estimate_half_widths()[parameter]
    size = getattr(discovery.fitted.fit.parameters, parameter)
    assert size == pytest.approx(SIZES[name][parameter], abs=2.0 * width)
    errors = measure_drive_errors(table, basic.parameters, discovery.fitted.fit.parameters)
    assert errors[1] < errors[0]


def measure_drive_errors(table: PlantedTable, *twins: TableParameters) -> list[float]:
    """Return the error of the first run in 0.3 to 18 Hz of drives computed on some twins."""
    assert TABLE.hydraulic is not None
    config = TABLE.hydraulic.model_copy(update=dict(table.hydraulic))
    rig = replace(build_rig(), oil=make_coefficients(config, MASS_KG))
    target = make_random_motion(20.0, (0.4, 12.0), 0.5, seed=9)
    reaction = -SPECIMEN_KG * play(replace(rig, payload_reaction=False), target)[3]
    errors = []
    for parameters in twins:
        # The instruments of a recording are late by 2 ms, which the twin takes as its own delay.
        model = TableModel(MASS_KG, parameters)
        command = compute_command(model, target, RATE_HZ, (0.3, 18.0), reaction).command_m
        achieved = play(rig, command)[0]
        late = min(
            measure_error(np.roll(achieved, shift), target, RATE_HZ, (0.3, 18.0))
            for shift in range(6)
        )
        errors.append(late)
    return errors


@pytest.mark.slow  # 8 s
def test_the_file_keeps_the_effect(tmp_path: Path) -> None:
    discovery = rehearse_on_twin("transducer_gain")
    identification, motion = (
        discovery.fitted.fit.to_identification(),
        discovery.fitted.fit.problem.motion,
    )
    judgement = Judgement(structure=HYDRAULIC, on="other logs", held_out={}, runs=())
    result = TableTwinResult(
        "Table", MASS_KG, identification.model, identification.residual, judgement,
        identification, discovery, motion, Provenance(),
    )  # fmt: skip
    path = result.save(tmp_path / "table.toml")
    config = load_table_twin(path)
    assert config.effects == ("transducer_gain",)
    assert config.effect_verdict is not None
    assert config.effect_verdict.outcome == "named"
    assert config.effect_verdict.probability > 0.95
    assert config.effect_verdict.effects == ("transducer_gain",)
    without = replace(discovery, fitted=discovery.basic)
    lacking = load_table_twin(replace(result, discovery=without).save(tmp_path / "without.toml"))
    assert (lacking.effects, lacking.effect_verdict) == ((), config.effect_verdict)
    model = config.build_model()
    assert isinstance(model, TableModel)
    assert model.parameters.transducer_gain_error == pytest.approx(0.06, abs=0.01)
    assert model.frequency_response(np.zeros(1))[0] == pytest.approx(1.0 / 1.06, abs=0.01)
    path.write_text(path.read_text().replace("transducer_gain", "transducer_gaim"))
    with pytest.raises(InputError, match="gaim"):
        load_table_twin(path)


@pytest.mark.parametrize(
    "change",
    [{"valve_overlap_percent": -1.0}, {"flow_asymmetry": 1.0}, {"transducer_lag_ms": 0.1},
     {"coupling_play_mm": -0.1}, {"coupling_play_mm": 0.1, "coupling_stiffness_n_m": 1e10},
     {"coupling_play_mm": 0.1, "piston_mass_kg": 4.0},
     {"attached_mass_kg": 1e3, "attached_frequency_hz": 1e5}, {"attached_mass_kg": 1e9}],
)  # fmt: skip
def test_an_effect_that_cannot_be_is_refused(change: dict[str, float]) -> None:
    with pytest.raises((ValidationError, InputError)):
        read_changed_table(change)


@pytest.mark.parametrize(
    "change",
    [{"coupling_stiffness_n_m": 1e10}, {"piston_mass_kg": 4.0}, {"attached_frequency_hz": 1e5},
     {"coupling_play_mm": 0.1}, {"attached_mass_kg": 1e3}],
)  # fmt: skip
def test_a_single_key_of_an_absent_effect_is_accepted(change: dict[str, float]) -> None:
    read_changed_table(change)


def read_changed_table(change: dict[str, float]) -> HydraulicTableConfig:
    """Return the table of the rig file with these keys; keys it does not state are not given."""
    assert TABLE.hydraulic is not None
    stated = TABLE.hydraulic.model_dump(exclude_unset=True)
    return HydraulicTableConfig.model_validate(stated | change)


def test_the_library_is_whole() -> None:
    """Every parameter is one of the twin, absent at 0, with its bounds in order."""
    assert set(SIZES) == {effect.id for effect in LIBRARY}
    for effect in LIBRARY:
        assert effect.source
        assert effect.equation
        for parameter in effect.parameters:
            assert parameter.low < parameter.high
            assert parameter.name in TableParameters._fields
        assert getattr(TableParameters(), effect.parameters[0].name) == 0.0
        assert all(len(trial) == len(effect.parameters) for trial in effect.trials)


@pytest.mark.slow  # 30 s
def test_the_fit_begins_where_it_can_reach_the_table() -> None:
    """Much friction, an oil column of 21 Hz and little pressure feedback: typical values mislead.

    From these alone the fit left half of the motion.
    """
    table = PlantedTable(
        {
            "friction_n": 1465.0,
            "static_friction_n": 1753.0,
            "stick_stiffness_n_m": 7.28e7,
            "viscous_friction_n_s_m": 504.0,
            "bulk_modulus_mpa": 629.3,
            "gain_1_s": 26.3,
            "velocity_feedforward": 0.051,
            "pressure_feedback": 0.054,
            "frame_frequency_hz": 16.3,
            "frame_mass_kg": 3e4,
        },
        delay_ms=3.5,
    )
    result = identify(record_rehearsal(table))
    assert result.residual < 0.06
    assert result.model.parameters.friction_n == pytest.approx(1465.0, rel=0.05)
    assert result.model.parameters.oil_hz == pytest.approx(21.34, rel=0.03)
