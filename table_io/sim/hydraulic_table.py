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
"""

import math
from typing import NamedTuple

from numba import njit

from table_io.sim.hydraulic_config import HydraulicTableConfig

# Continues the state of `hidden_plant.py`: load pressure in Pa and its slow part, spool and its
# rate in 1/s, bristles in m, frame in m and m/s.
P, P_LOW, SPOOL, SPOOL_RATE, BRISTLE, YF, VYF = 15, 16, 17, 18, 19, 20, 21
HYDRAULIC_STATE_SIZE = 22
MAX_HYDRAULIC_SUBSTEP_S = 3.2e-5  # the bristles relax in 40 us at 0.5 m/s; stable below 110 us


class HydraulicCoefficients(NamedTuple):
    """Coefficients of the equations above in SI; an area of 0 stands for a table without oil."""

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
    )


@njit(nogil=True, no_cpython_wrapper=True, no_cfunc_wrapper=True)
def _write_hydraulic_rates(s, y, vy, command, command_rate, oil, rate):  # type: ignore[no-untyped-def]
    """Write the rates of oil, valve, bristles and frame; return the force on the table in N.

    y in m and vy in m/s are those of the table, `command` is in m and `command_rate` in m/s.
    """
    stroke, speed = y - s[YF], vy - s[VYF]
    # Friction. Its force on the table opposes the speed of the piston in the cylinder.
    g = oil.fc + (oil.fs - oil.fc) * math.exp(-((speed / oil.vs) ** 2))
    rate[BRISTLE] = 0.0
    friction = oil.viscous * speed
    if g > 0.0:
        rate[BRISTLE] = speed - oil.s0 * abs(speed) * s[BRISTLE] / g
        friction += oil.s0 * s[BRISTLE] + oil.s1 * rate[BRISTLE]
    # Controller: stroke, feed-forward and the fast part of the load pressure.
    velocity = oil.gain * (command - stroke) + oil.feedforward * command_rate
    opening = velocity * oil.area / oil.open_flow
    opening -= oil.pressure_gain * (s[P] - s[P_LOW])
    opening = min(max(opening, -1.0), 1.0)
    rate[P_LOW] = oil.pressure_corner * (s[P] - s[P_LOW])
    # Valve.
    rate[SPOOL] = s[SPOOL_RATE]
    rate[SPOOL_RATE] = oil.valve * (
        oil.valve * (opening - s[SPOOL]) - 2.0 * oil.valve_damping * s[SPOOL_RATE]
    )
    spool = min(max(s[SPOOL], -1.0), 1.0)
    drop = oil.supply - s[P] if spool > 0.0 else oil.supply + s[P]
    flow = oil.rated_flow * spool * math.sqrt(max(drop, 0.0))
    rate[P] = oil.oil_stiffness * (flow - oil.area * speed - oil.leakage * s[P])
    # Frame.
    force = oil.area * s[P] - friction
    rate[YF] = s[VYF]
    rate[VYF] = -force / oil.frame_mass - oil.frame * (
        oil.frame * s[YF] + 2.0 * oil.frame_damping * s[VYF]
    )
    return force
