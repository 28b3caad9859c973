"""Hydraulic table: servo valve, oil column, leakage, friction with stick, controller and frame.

s is the delayed command, y the table and y_f the frame against the floor, q = y - y_f the stroke,
p the load pressure, x the spool over its full travel, R the force of the specimen on the table:

    m y'' = A p - F(q') + R,  m_f (y_f'' + 2 z_f w_f y_f' + w_f^2 y_f) = F(q') - A p
    p' = 4 B / V (Q - A q' - L p),  Q = Q_r x sqrt((P - p sign x) / P_r)   (square-root flow)
    x'' = w^2 (e - x) - 2 z w x',  |x| <= 1
    e = (k (s - q) + k_ff s') A / Q_0 - k_p (p - p_low) / P,  |e| <= 1     (Q_0: Q at x = 1, p = 0)
    p_low' = (p - p_low) / t_p
    F = s0 z + s1 z' + c q',  z' = q' - s0 |q'| z / g(q'),  g = F_c + (F_s - F_c) exp(-(q'/v_s)^2)

Actuator and valve as in Merritt, Hydraulic Control Systems (1967), chapters 5 and 6; stroke control
with feed-forward and differential pressure, leakage and reaction mass as in Conte and Trombetti,
Earthquake Engng Struct. Dyn. 29 (2000) 1375; friction of Canudas de Wit et al., IEEE Trans. Autom.
Control 40 (1995) 419: below the static friction the table sticks on its bristles, z.

What a worn or badly adjusted table has in addition; each is absent where its key is 0:

    x -> l(x - o) - l(-x - o), l(x) = d ln(1 + exp(x / d)), d = o / 6       overlap o of the spool
    e -> e_h, t e_h' = max(e - e_h - h/2, 0) + min(e - e_h + h/2, 0)       hysteresis h of the valve
    Q -> Q (1 + a tanh(x / x_a))                                           flow gains differ
    g -> g (1 + b) for q' > 0, g (1 - b) for q' < 0                        friction by direction
    g -> g max(1 + tanh(s q), 0.05)                                        friction along the stroke
    F -> F max(1 + r t, 0.05), t from the start of the run    friction that drifts, by warm oil
    m_p y_p'' = A p - N, N = k_p d + c_p d' with d = y_p - y beyond +-j/2  play j of the coupling
    q -> (1 + n) q, then twice 1 / (1 + s t_n / 2), in e                   transducer of the stroke
    m_a y_a'' = k_a (y_f - y_a) + c_a (y_f' - y_a')                      mass attached to the frame

The overlap has rounded edges (Merritt, chapter 5.3); hysteresis is play that a fast lag follows;
with play in the coupling the piston is a mass of its own and hits its stops elastically. Where
friction differs by direction or along the stroke, its bristles relax at the rate s0 |q'| / g, but
not faster than the integrator resolves; the friction in steady motion stays g.
"""

import math
from typing import NamedTuple

from table_io.compilation import inline_jit
from table_io.sim.config import HydraulicTableConfig

# Continues the state of `plant.py`: load pressure in Pa and its slow part, spool and its
# rate in 1/s, bristles in m, frame in m and m/s.
P, P_LOW, SPOOL, SPOOL_RATE, BRISTLE, YF, VYF = 15, 16, 17, 18, 19, 20, 21
HYDRAULIC_STATE_SIZE = 22
# States of a table with play, hysteresis, a lag of its transducer, an attached mass or drift:
# piston and attached mass in m and m/s, two filters of the stroke in m, valve's input, time in s.
YP, VYP, YA, VYA, READ_1, READ_2, INPUT, AGE = 22, 23, 24, 25, 26, 27, 28, 29
EXTENDED_HYDRAULIC_STATE_SIZE = 30
OVERLAP_EDGE_RATIO = 6.0  # of the overlap over the rounding of its edges
HYSTERESIS_LAG_S = 2e-4  # with which play in the valve's input is followed
FLOW_ROUNDING = 1e-4  # opening over which the gain of the flow changes
PISTON_DAMPING = 0.3  # damping ratio of the piston against its stops in the coupling
MAX_HYDRAULIC_SUBSTEP_S = 3.2e-5  # the bristles relax in 40 us at 0.5 m/s; stable below 110 us
LEAST_FRICTION_SHARE = 0.05  # of the friction, however it falls along the stroke or with time
MAX_RELAXATION_1_S = 1.0 / MAX_HYDRAULIC_SUBSTEP_S  # of bristles under little friction


class HydraulicCoefficients(NamedTuple):
    """Coefficients of the equations above in SI."""

    area: float = 0.0
    table_mass: float = 1.0
    oil_stiffness: float = 0.0  # 4 B / V, Pa/m3
    leakage: float = 0.0
    supply: float = 1.0
    rated_flow: float = 0.0  # at 1 Pa of drop
    open_flow: float = 1.0  # Q_0
    valve: float = 0.0  # rad/s
    valve_damping: float = 0.0
    fc: float = 0.0
    fs: float = 0.0
    vs: float = 1.0
    s0: float = 1.0
    s1: float = 0.0
    viscous: float = 0.0
    gain: float = 0.0
    feedforward: float = 0.0
    pressure_gain: float = 0.0  # 1/Pa
    pressure_corner: float = 0.0  # rad/s
    frame_mass: float = 1.0
    frame: float = 0.0  # rad/s
    frame_damping: float = 0.0
    overlap: float = 0.0
    hysteresis: float = 0.0
    flow_asymmetry: float = 0.0
    friction_asymmetry: float = 0.0
    friction_slope: float = 0.0  # 1/m
    friction_drift: float = 0.0  # 1/s
    play: float = 0.0  # m
    piston_mass: float = 1.0
    stop_stiffness: float = 0.0
    reading_gain: float = 0.0
    reading_lag: float = 0.0  # s
    attached_mass: float = 0.0
    attached: float = 0.0  # rad/s
    attached_damping: float = 0.0

    @property
    def state_size(self) -> int:
        """Return the number of states of plant and table."""
        extending = (
            self.hysteresis, self.play, self.reading_lag, self.attached_mass, self.friction_drift,
        )  # fmt: skip
        return EXTENDED_HYDRAULIC_STATE_SIZE if any(extending) else HYDRAULIC_STATE_SIZE

    def with_supply(self, share: float) -> "HydraulicCoefficients":
        """Return the coefficients with this fraction of the supply pressure; gains stay."""
        return self._replace(supply=share * self.supply)


def make_coefficients(config: HydraulicTableConfig, table_mass_kg: float) -> HydraulicCoefficients:
    """Convert the keys of a rig file to SI, for a table of this moving mass in kg."""
    supply = config.supply_pressure_mpa * 1e6
    rated_flow = config.rated_flow_l_min / 60e3 / math.sqrt(config.rated_drop_mpa * 1e6)
    return HydraulicCoefficients(
        area=config.piston_area_cm2 * 1e-4,
        table_mass=table_mass_kg,
        oil_stiffness=4.0 * config.bulk_modulus_mpa * 1e6 / (config.oil_volume_cm3 * 1e-6),
        leakage=config.leakage_l_min_mpa / 60e9,
        supply=supply,
        rated_flow=rated_flow,
        open_flow=rated_flow * math.sqrt(supply),
        valve=math.tau * config.valve_frequency_hz,
        valve_damping=config.valve_damping,
        fc=config.friction_n,
        fs=config.static_friction_n,
        vs=config.stribeck_speed_m_s,
        s0=config.stick_stiffness_n_m,
        s1=config.stick_damping_n_s_m,
        viscous=config.viscous_friction_n_s_m,
        gain=config.gain_1_s,
        feedforward=config.velocity_feedforward,
        pressure_gain=config.pressure_feedback / supply,
        pressure_corner=math.tau * config.pressure_corner_hz,
        frame_mass=config.frame_mass_kg,
        frame=math.tau * config.frame_frequency_hz,
        frame_damping=config.frame_damping,
        overlap=config.valve_overlap_percent * 1e-2,
        hysteresis=config.valve_hysteresis_percent * 1e-2,
        flow_asymmetry=config.flow_asymmetry,
        friction_asymmetry=config.friction_asymmetry,
        friction_slope=config.friction_slope_1_m,
        friction_drift=config.friction_drift_1_s,
        play=config.coupling_play_mm * 1e-3,
        piston_mass=config.piston_mass_kg,
        stop_stiffness=config.coupling_stiffness_n_m,
        reading_gain=config.transducer_gain_error,
        reading_lag=config.transducer_lag_ms * 1e-3,
        attached_mass=config.attached_mass_kg,
        attached=math.tau * config.attached_frequency_hz,
        attached_damping=config.attached_damping,
    )


@inline_jit
def _round_corner(x, width):  # type: ignore[no-untyped-def]
    """Return a smooth max(x, 0) whose corner is rounded over this width."""
    return max(x, 0.0) + width * math.log1p(math.exp(-abs(x) / width))


@inline_jit
def _read_stroke(s, stroke, oil, rate):  # type: ignore[no-untyped-def]
    """Return the stroke in m as the loop reads it; write the rates of its filters."""
    reading = stroke
    if oil.reading_gain != 0.0:
        reading *= 1.0 + oil.reading_gain
    if oil.reading_lag > 0.0:
        rate[READ_1] = (reading - s[READ_1]) / (0.5 * oil.reading_lag)
        rate[READ_2] = (s[READ_1] - s[READ_2]) / (0.5 * oil.reading_lag)
        reading = s[READ_2]
    return reading


@inline_jit
def _press_stops(offset, speed, oil):  # type: ignore[no-untyped-def]
    """Return the force of the piston on the table in N; piston less table in m and m/s."""
    depth = offset - min(max(offset, -0.5 * oil.play), 0.5 * oil.play)
    if depth == 0.0:
        return 0.0
    damping = 2.0 * PISTON_DAMPING * math.sqrt(oil.stop_stiffness * oil.piston_mass)
    push = oil.stop_stiffness * depth + damping * speed
    # A stop only pushes.
    return max(push, 0.0) if depth > 0.0 else min(push, 0.0)


@inline_jit
def _find_sliding_friction(stroke, speed, oil):  # type: ignore[no-untyped-def]
    """Return the friction in steady motion in N, without the viscous one."""
    g = oil.fc + (oil.fs - oil.fc) * math.exp(-((speed / oil.vs) ** 2))
    if oil.friction_asymmetry != 0.0:
        g *= 1.0 + oil.friction_asymmetry if speed > 0.0 else 1.0 - oil.friction_asymmetry
    if oil.friction_slope != 0.0:
        g *= max(1.0 + math.tanh(oil.friction_slope * stroke), LEAST_FRICTION_SHARE)
    return g


@inline_jit
def write_hydraulic_rates(s, y, vy, command, command_rate, oil, rate):  # type: ignore[no-untyped-def]
    """Write the rates of oil, valve, bristles and frame; return the force on the table in N.

    y in m and vy in m/s are those of the table, `command` is in m and `command_rate` in m/s.
    """
    stroke, speed = y - s[YF], vy - s[VYF]
    # Friction. Its force on the table opposes the speed of the piston in the cylinder.
    g = _find_sliding_friction(stroke, speed, oil)
    rate[BRISTLE] = 0.0
    friction = oil.viscous * speed
    if g > 0.0:
        rate[BRISTLE] = speed - oil.s0 * abs(speed) * s[BRISTLE] / g
        if oil.friction_asymmetry != 0.0 or oil.friction_slope != 0.0:
            relaxation = oil.s0 * abs(speed) / g
            if relaxation > MAX_RELAXATION_1_S:
                rate[BRISTLE] *= MAX_RELAXATION_1_S / relaxation
        friction += oil.s0 * s[BRISTLE] + oil.s1 * rate[BRISTLE]
    if oil.friction_drift != 0.0:
        friction *= max(1.0 + oil.friction_drift * s[AGE], LEAST_FRICTION_SHARE)
        rate[AGE] = 1.0
    # Controller: stroke, feed-forward and the fast part of the load pressure.
    velocity = oil.gain * (command - _read_stroke(s, stroke, oil, rate))
    velocity += oil.feedforward * command_rate
    opening = velocity * oil.area / oil.open_flow
    opening -= oil.pressure_gain * (s[P] - s[P_LOW])
    opening = min(max(opening, -1.0), 1.0)
    rate[P_LOW] = oil.pressure_corner * (s[P] - s[P_LOW])
    # Valve.
    if oil.hysteresis > 0.0:
        lag, half = opening - s[INPUT], 0.5 * oil.hysteresis
        rate[INPUT] = (max(lag - half, 0.0) + min(lag + half, 0.0)) / HYSTERESIS_LAG_S
        opening = s[INPUT]
    rate[SPOOL] = s[SPOOL_RATE]
    rate[SPOOL_RATE] = oil.valve * (
        oil.valve * (opening - s[SPOOL]) - 2.0 * oil.valve_damping * s[SPOOL_RATE]
    )
    spool = min(max(s[SPOOL], -1.0), 1.0)
    if oil.overlap > 0.0:
        edge = oil.overlap / OVERLAP_EDGE_RATIO
        spool = _round_corner(spool - oil.overlap, edge) - _round_corner(-spool - oil.overlap, edge)
    drop = oil.supply - s[P] if spool > 0.0 else oil.supply + s[P]
    flow = oil.rated_flow * spool * math.sqrt(max(drop, 0.0))
    if oil.flow_asymmetry != 0.0:
        flow *= 1.0 + oil.flow_asymmetry * math.tanh(spool / FLOW_ROUNDING)
    # Coupling. Without play the piston moves with the table.
    thrust, piston_speed = oil.area * s[P], speed
    if oil.play > 0.0:
        piston_speed = s[VYP] - s[VYF]
        thrust = _press_stops(s[YP] - y, s[VYP] - vy, oil)
        rate[YP], rate[VYP] = s[VYP], (oil.area * s[P] - thrust) / oil.piston_mass
    rate[P] = oil.oil_stiffness * (flow - oil.area * piston_speed - oil.leakage * s[P])
    # Frame. The cylinder bears the oil, the guides bear the friction.
    force = thrust - friction
    reaction = force if oil.play == 0.0 else oil.area * s[P] - friction
    rate[YF] = s[VYF]
    rate[VYF] = -reaction / oil.frame_mass - oil.frame * (
        oil.frame * s[YF] + 2.0 * oil.frame_damping * s[VYF]
    )
    if oil.attached_mass > 0.0:
        pull = oil.attached * (
            oil.attached * (s[YF] - s[YA]) + 2.0 * oil.attached_damping * (s[VYF] - s[VYA])
        )
        rate[YA], rate[VYA] = s[VYA], pull
        rate[VYF] -= pull * oil.attached_mass / oil.frame_mass
    return force
