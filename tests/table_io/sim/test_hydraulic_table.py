"""The hydraulic table against equations of its own, closed forms and bounds of its physics."""

import math
from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.integrate import solve_ivp

from table_io.block import Float1D, Float2D
from table_io.config.profile import Specimen
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.hydraulic_table import BRISTLE, SPOOL, HydraulicCoefficients, P
from table_io.sim.plant import SIGNALS, Plant
from table_io.sim.simulated_table import build_plant
from tests.builders.rigs import compute_oil_column_hz, read_rig

RATE_HZ = 1000.0
RIG = read_rig("hydraulic")
CONFIG = RIG.require_section("simulated", SimulatedTableConfig)
FREE = Specimen(mass_kg=550.0, gap_mm=math.inf)
MASS_KG = CONFIG.moving_mass_kg


def build_table(**changes: float) -> Plant:
    """Return the shipped table without payload reaction, some coefficients replaced."""
    plant = build_plant(CONFIG, FREE, RATE_HZ)
    assert plant.oil is not None
    return replace(plant, payload_reaction=False, oil=plant.oil._replace(**changes))


def play(plant: Plant, command: Float1D, state: Float1D | None = None) -> Float2D:
    """Return the signals, (7, sample), for a command in m that stood at 0 before."""
    out = np.empty((len(SIGNALS), command.size))
    state = plant.rest_state() if state is None else state
    plant.advance(state, np.concatenate([np.zeros(plant.history_samples), command]), out)
    return out


def solve_independently(oil: HydraulicCoefficients, times: Float1D) -> Float2D:
    """Return table position and acceleration for a command of 5 mm (1 - cos)^2, by DOP853."""

    def command(t: float) -> tuple[float, float]:
        t = t - 0.002  # servo_delay_ms
        if t <= 0.0:
            return 0.0, 0.0
        c, w = math.cos(20.0 * t), 20.0 * math.sin(20.0 * t)
        return 2.5e-3 * (1.0 - c) ** 2, 5e-3 * (1.0 - c) * w

    def derivatives(t: float, s: Float1D) -> list[float]:
        y, vy, pressure, slow, spool, spool_rate, z, yf, vf = s
        target, speed_of_target = command(t)
        v = vy - vf
        level = oil.fc + (oil.fs - oil.fc) * math.exp(-((v / oil.vs) ** 2))
        bristle_rate = v - abs(v) * oil.s0 / level * z
        dry = oil.s0 * z + oil.s1 * bristle_rate + oil.viscous * v
        wanted = oil.gain * (target - y + yf) + oil.feedforward * speed_of_target
        e = wanted * oil.area / oil.open_flow - oil.pressure_gain * (pressure - slow)
        flow = (
            oil.rated_flow
            * spool
            * math.sqrt(oil.supply - math.copysign(pressure, spool * pressure))
        )
        net = oil.area * pressure - dry
        return [
            vy,
            net / MASS_KG,
            oil.oil_stiffness * (flow - oil.area * v - oil.leakage * pressure),
            oil.pressure_corner * (pressure - slow),
            spool_rate,
            oil.valve**2 * (e - spool) - 2.0 * oil.valve_damping * oil.valve * spool_rate,
            bristle_rate,
            vf,
            -net / oil.frame_mass - oil.frame**2 * yf - 2.0 * oil.frame_damping * oil.frame * vf,
        ]

    solution = solve_ivp(
        derivatives,
        (0.0, times[-1]),
        np.zeros(9),
        "DOP853",
        times,
        rtol=1e-9,
        atol=1e-13,
        max_step=1e-4,
    )
    acceleration = [derivatives(t, s)[1] for t, s in zip(times, solution.y.T, strict=True)]
    return np.array([solution.y[0], acceleration])


def test_agrees_with_an_independent_solution() -> None:
    """5 mm in half a second with friction that sticks; the command as a spline of its samples."""
    plant = build_table()
    times = np.arange(400) / RATE_HZ
    command = 2.5e-3 * (1.0 - np.cos(20.0 * times)) ** 2
    signals = play(plant, command)
    assert plant.oil is not None
    expected = solve_independently(plant.oil, times)
    assert np.abs(expected[0]).max() > 5e-3
    assert np.abs(signals[0] - expected[0]).max() < 1e-6
    assert np.abs(signals[1] - expected[1]).max() < 0.01 * np.abs(expected[1]).max()


def find_linear_response(oil: HydraulicCoefficients, hz: float) -> complex:
    """Return table over command without friction, valve near its centre, by elimination."""
    s = 2j * math.pi * hz
    stroke_per_drive = 1.0 / (MASS_KG * s**2) + 1.0 / (
        oil.frame_mass * (s**2 + 2.0 * oil.frame_damping * oil.frame * s + oil.frame**2)
    )
    # Unknowns: net force d, pressure p, spool x. Valve, oil and force balance.
    valve = oil.valve**2 / (s**2 + 2.0 * oil.valve_damping * oil.valve * s + oil.valve**2)
    k = oil.area / oil.open_flow
    pass_high = s / (s + oil.pressure_corner)
    rows = np.array(
        [
            [1.0 + oil.viscous * s * stroke_per_drive, -oil.area, 0.0],
            [oil.area * s * stroke_per_drive, s / oil.oil_stiffness + oil.leakage, -oil.open_flow],
            [valve * oil.gain * k * stroke_per_drive, valve * oil.pressure_gain * pass_high, 1.0],
        ]
    )
    asked = valve * (oil.gain + oil.feedforward * s) * k * np.exp(-0.002 * s)
    drive = np.linalg.solve(rows, [0.0, 0.0, asked])[0]
    return complex(drive / (MASS_KG * s**2))


@pytest.mark.parametrize("hz", [0.5, 2.0, 6.0, 13.0, 20.0, 27.0, 40.0])
def test_small_response_is_that_of_the_linear_table(hz: float) -> None:
    plant = build_table(fc=0.0, fs=0.0)
    times = np.arange(12_000) / RATE_HZ
    rise = np.clip(times, 0.0, 1.0)
    command = min(0.05 / (math.tau * hz) ** 2, 1e-3) * rise**2 * np.sin(math.tau * hz * times)
    turn = np.exp(-1j * math.tau * hz * times[-4000:])
    position = play(plant, command)[0][-4000:]
    measured = (position * turn).sum() / (command[-4000:] * turn).sum()
    spline = np.sinc(hz / RATE_HZ) ** 3  # of the output stage
    assert plant.oil is not None
    assert abs(measured / spline / find_linear_response(plant.oil, hz) - 1.0) < 3e-3


def test_shut_valve_leaves_the_mass_on_the_oil_column() -> None:
    plant = build_table(
        fc=0.0, fs=0.0, gain=0.0, feedforward=0.0, pressure_gain=0.0, frame_mass=1e9
    )
    state = plant.rest_state()
    state[3] = 0.01  # m/s of the table
    y = play(plant, np.zeros(2000), state)[0]
    crossings = np.flatnonzero(np.diff(np.signbit(y - y[-1])))
    hz = (crossings.size - 1) / 2.0 / ((crossings[-1] - crossings[0]) / RATE_HZ)
    assert CONFIG.hydraulic is not None
    assert hz == pytest.approx(compute_oil_column_hz(CONFIG.hydraulic, MASS_KG), rel=0.01)
    assert hz == pytest.approx(27.0, abs=0.5)


@pytest.mark.parametrize(("share", "is_stuck"), [(0.9, True), (1.2, False)])
def test_table_sticks_below_the_static_friction(share: float, is_stuck: bool) -> None:
    """Under a pressure that the shut valve holds the table rests, or slides on."""
    plant = build_table(gain=0.0, pressure_gain=0.0, feedforward=0.0, leakage=0.0, s1=2e5)
    assert plant.oil is not None
    # So much oil that its pressure does not fall while the table moves.
    oil = plant.oil._replace(oil_stiffness=1e6)
    plant = replace(plant, oil=oil)
    state = plant.rest_state()
    state[P] = share * oil.fs / oil.area
    y = play(plant, np.zeros(2000), state)[0]
    assert (abs(y[-1] - y[-500]) < 1e-6) == is_stuck
    assert abs(state[BRISTLE]) <= 1.001 * oil.fs / oil.s0


def test_open_valve_bounds_the_speed_and_the_supply_the_pressure() -> None:
    plant = build_table(fc=0.0, fs=0.0, viscous=0.0, leakage=0.0, pressure_gain=0.0)
    state = plant.rest_state()
    signals = play(plant, np.full(150, 10.0), state)  # far away: the valve opens
    speed = np.diff(signals[0][-10:]).mean() * RATE_HZ
    assert state[SPOOL] == pytest.approx(1.0, abs=1e-3)
    fastest = 63e-3 / 60.0 * math.sqrt(21.0 / 7.0) / 20e-4
    assert speed < 1.3 * fastest  # the oil column swings about it
    assert plant.oil is not None
    heavy = replace(plant, oil=plant.oil._replace(table_mass=1e5))
    assert np.abs(play(heavy, np.full(150, 10.0))[1]).max() <= 21e6 * 20e-4 / 1e5 * 1.001


@pytest.mark.parametrize("hz", [0.6, 2.0])
@pytest.mark.parametrize(
    "changes",
    [{"friction_slope": slope} for slope in (-1000.0, 60.0, 300.0, 1000.0)]
    + [{"friction_slope": 1000.0, "friction_asymmetry": -0.89}],
)
def test_little_friction_at_an_end_of_the_stroke_is_integrated(
    changes: dict[str, float], hz: float
) -> None:
    """Over +-50 mm, with up to 0.6 m/s, the motion is nearly that of even friction."""
    times = np.arange(3000) / RATE_HZ
    command = 0.05 * np.minimum(times, 1.0) * np.sin(2.0 * math.pi * hz * times)
    even, uneven = play(build_table(), command), play(build_table(**changes), command)
    assert np.abs(even[0]).max() > 0.03
    # Friction of up to twice 500 N on 2000 kg.
    assert np.abs(uneven[1]).max() < np.abs(even[1]).max() + 0.5
    assert np.abs(uneven[0] - even[0]).max() < 2e-3


def test_no_cut_into_blocks_changes_a_bit() -> None:
    plant = build_table()
    rng = np.random.default_rng(2)
    command = 1e-3 * np.cumsum(rng.standard_normal(300)) / 30.0
    whole = play(plant, command)
    padded = np.concatenate([np.zeros(plant.history_samples), command])
    state, done = plant.rest_state(), 0
    for count in (1, 7, 64, 228):
        out = np.empty((len(SIGNALS), count))
        plant.advance(state, padded[done : done + plant.history_samples + count], out)
        np.testing.assert_array_equal(out, whole[:, done : done + count])
        done += count


def test_less_supply_is_less_force() -> None:
    oil = build_table().oil
    assert oil is not None
    assert oil.with_supply(0.25).supply == 0.25 * oil.supply
    assert oil.with_supply(0.25).pressure_gain == oil.pressure_gain


@pytest.mark.parametrize("given", [{"servo_bandwidth_hz": 20.0}, {"hydraulic": None}])
def test_actuator_is_stated_once(given: dict[str, float | None]) -> None:
    with pytest.raises(ValidationError, match="not stated once"):
        SimulatedTableConfig.model_validate(CONFIG.model_dump() | given)
