"""Twin of the table: oil column, valve, stroke loop, delay, friction and frame.

    m a = f - F(v) + R,  v = y' - y_f'          (table: force f of the oil, friction F, specimen R)
    f' = K (u phi - v - l f),  K = m w_o^2,  phi = sqrt(1 - f sign(u) / f_s),  l = 2 z_o w_o / K
    u'' = w_v^2 (e - u) - 2 z_v w_v u'          (valve: speed at no load)
    e = k (s - (y - y_f)) + k_ff s' - g h / m   (stroke loop; h: f above 1 Hz)
    F = z (F_c + (F_s - F_c) exp(-(v / v_s)^2)) + c v + b (1 - z sign(v)) v
    z' = v / d (1 - z sign(v)),  the exponential with a lag over the travel n d
    y_f'' = -r (f - F(v)) / m - w_f (w_f y_f + 2 z_f y_f')

s is the command after a delay. Presliding is Dahl's (1968), with the Stribeck force at low speed;
d is the presliding displacement. z is integrated exactly over a step of constant speed, the rest by
the classical Runge-Kutta method. Equations, friction law and integrator are not those of the
simulated table. Only ratios of force to mass show in a motion: forces are those of the stated mass.

Effects that a table may have in addition, each absent where its parameter is 0; `table_effects.py`
describes them and finds out which one a table has:

    u -> u - d_v sat(u / d_v), u -> u - w_h z_h / 2 with z_h' = 2 u' / w_h (1 - z_h sign(u')),
    u -> u (1 + a_u sign(u))                          (valve: dead band, hysteresis, direction)
    f -> f - K b/2 sat(2 f / (K b))                              (coupling: backlash b)
    z -> +-z_m instead of +-1, z_m = (1 + a_F sign(v)) (1 + g_F (y - y_f))  (friction)
    F -> (1 + d_F t) F                                           (friction that drifts with time t)
    y - y_f -> q_t in e, t_t q_t' = (1 + g_t) (y - y_f) - q_t              (transducer)
    y_f -> y_f + y_2, y_2'' = -r_2 (f - F(v)) / m - w_2 (w_2 y_2 + 2 z_2 y_2')  (second frame mode)

sat(x) is x within -1 .. 1. A lag t_t shorter than a step of the integrator is its first-order term,
q_t = (1 + g_t) (y - y_f - t_t v), which needs no state and differs by t_t^2 only.
"""

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_untyped_kernel

MAX_STEP_S = 2.6e-4  # of the integrator: a tenth of the period of the fastest valve
PRESSURE_CORNER = math.tau * 1.0  # rad/s, below it the load is not fed back
Y, V, OIL, VALVE, VALVE_RATE, LOW_OIL, FRAME, FRAME_SPEED = 0, 1, 2, 3, 4, 5, 6, 7
# States of effects in addition: second mode of the frame, and the stroke as the loop reads it.
FRAME_2, FRAME_2_SPEED, STROKE_READ = 8, 9, 10
AT_REST = (0.0,) * 11
inline_untyped: Any = jit_helper(inlined=True)  # each call copies all parameters otherwise
LEAST_FRICTION_SHARE = 0.05  # of the friction, however it changes along the stroke


class TableParameters(NamedTuple):
    """Parameters of the table's twin, SI; what is 0 is absent.

    `oil_hz` is that of the stated mass on the oil, `static_excess_n` the breakaway force above
    the friction in motion, `frame_ratio` the mass of the table over that of the frame.
    """

    gain_1_s: float = 20.0
    velocity_feedforward: float = 0.0
    delay_s: float = 0.004
    valve_hz: float = 80.0
    valve_damping: float = 0.8
    oil_hz: float = 30.0
    oil_damping: float = 0.05
    pressure_feedback_s: float = 0.0
    friction_n: float = 0.0
    static_excess_n: float = 0.0
    presliding_m: float = 2e-5
    stribeck_speed_m_s: float = 0.01
    stick_damping_n_s_m: float = 0.0
    viscous_n_s_m: float = 0.0
    frame_hz: float = 15.0
    frame_damping: float = 0.05
    frame_ratio: float = 0.0
    stall_force_n: float = math.inf
    dead_band_m_s: float = 0.0
    valve_hysteresis_m_s: float = 0.0
    flow_asymmetry: float = 0.0
    friction_asymmetry: float = 0.0
    friction_slope_1_m: float = 0.0
    backlash_m: float = 0.0
    transducer_gain_error: float = 0.0
    transducer_lag_s: float = 0.0
    second_frame_hz: float = 30.0
    second_frame_damping: float = 0.05
    second_frame_ratio: float = 0.0
    friction_memory: float = 0.0
    friction_drift_1_s: float = 0.0


@inline_untyped
def _find_stroke(s, p):  # type: ignore[no-untyped-def]
    """Return the stroke of the table on its frame in m and its rate in m/s."""
    stroke, v = s[Y] - s[FRAME], s[V] - s[FRAME_SPEED]
    if p.second_frame_ratio != 0.0:
        stroke -= s[FRAME_2]
        v -= s[FRAME_2_SPEED]
    return stroke, v


@inline_untyped
def _find_friction_share(sign, stroke, p):  # type: ignore[no-untyped-def]
    """Return the limit of |z| in this direction, at this stroke in m."""
    along = max(1.0 + p.friction_slope_1_m * stroke, LEAST_FRICTION_SHARE)
    return (1.0 + p.friction_asymmetry * sign) * along


@inline_untyped
def _find_rates(s, z, memory, z_valve, command, command_rate, reaction, t, h, m, p):  # type: ignore[no-untyped-def]
    """Return the time derivative of the state as a tuple; SI.

    `memory` is the exponential of the Stribeck force with its lag, `z_valve` is that of the valve,
    t the time in s and h the step.
    """
    oil = math.tau * p.oil_hz
    stiffness = m * oil * oil
    (stroke, v), force = _find_stroke(s, p), s[OIL]
    if p.backlash_m > 0.0:
        play = 0.5 * stiffness * p.backlash_m
        force -= min(max(force, -play), play)
    if p.friction_memory > 0.0:
        dry = p.friction_n + p.static_excess_n * memory
    else:
        dry = p.friction_n + p.static_excess_n * math.exp(-((v / p.stribeck_speed_m_s) ** 2))
    sticking = 1.0 - z if v > 0.0 else 1.0 + z
    if p.friction_asymmetry != 0.0 or p.friction_slope_1_m != 0.0:
        sign = 1.0 if v > 0.0 else -1.0
        sticking = 1.0 - sign * z / _find_friction_share(sign, stroke, p)
    drive = force - z * dry - (p.viscous_n_s_m + p.stick_damping_n_s_m * sticking) * v
    if p.friction_drift_1_s != 0.0:
        drive = force + (1.0 + p.friction_drift_1_s * t) * (drive - force)
    opening = s[VALVE] - 0.5 * p.valve_hysteresis_m_s * z_valve
    if p.dead_band_m_s > 0.0:
        opening -= min(max(opening, -p.dead_band_m_s), p.dead_band_m_s)
    share = 1.0 - force / p.stall_force_n if opening > 0.0 else 1.0 + force / p.stall_force_n
    flow = opening * math.sqrt(max(share, 0.0))
    if p.flow_asymmetry != 0.0:
        flow += p.flow_asymmetry * abs(flow)
    valve = math.tau * p.valve_hz
    reading, reading_rate = stroke, 0.0
    if p.transducer_gain_error != 0.0:
        reading *= 1.0 + p.transducer_gain_error
    if 0.0 < p.transducer_lag_s < h:
        reading -= (1.0 + p.transducer_gain_error) * p.transducer_lag_s * v
    elif p.transducer_lag_s > 0.0:
        reading_rate = (reading - s[STROKE_READ]) / p.transducer_lag_s
        reading = s[STROKE_READ]
    asked = (
        p.gain_1_s * (command - reading)
        + p.velocity_feedforward * command_rate
        - p.pressure_feedback_s * (force - s[LOW_OIL]) / m
    )
    valve_rate = valve * (asked - s[VALVE]) - 2.0 * p.valve_damping * s[VALVE_RATE]
    frame = math.tau * p.frame_hz
    frame_pull = frame * s[FRAME] + 2.0 * p.frame_damping * s[FRAME_SPEED]
    frame_2_speed, frame_2_rate = 0.0, 0.0
    if p.second_frame_ratio != 0.0:
        second = math.tau * p.second_frame_hz
        pull = second * s[FRAME_2] + 2.0 * p.second_frame_damping * s[FRAME_2_SPEED]
        frame_2_speed = s[FRAME_2_SPEED]
        frame_2_rate = -p.second_frame_ratio * drive / m - second * pull
    return (
        s[V],
        (drive + reaction) / m,
        stiffness * (flow - v) - 2.0 * p.oil_damping * oil * force,
        s[VALVE_RATE],
        valve * valve_rate,
        PRESSURE_CORNER * (force - s[LOW_OIL]),
        s[FRAME_SPEED],
        -p.frame_ratio * drive / m - frame * frame_pull,
        frame_2_speed,
        frame_2_rate,
        reading_rate,
    )


@inline_untyped
def _move(s, share, r):  # type: ignore[no-untyped-def]
    """Return a state as a tuple, moved by a share of its rates."""
    return (
        s[0] + share * r[0], s[1] + share * r[1], s[2] + share * r[2], s[3] + share * r[3],
        s[4] + share * r[4], s[5] + share * r[5], s[6] + share * r[6], s[7] + share * r[7],
        s[8] + share * r[8], s[9] + share * r[9], s[10] + share * r[10],
    )  # fmt: skip


@inline_untyped
def _advance_memories(s, z, memory, z_valve, h, p):  # type: ignore[no-untyped-def]
    """Return z, the lagging Stribeck exponential and z of the valve after half a step h in s."""
    stroke, v = _find_stroke(s, p)
    sign = 1.0 if v > 0.0 else -1.0
    if p.friction_asymmetry != 0.0 or p.friction_slope_1_m != 0.0:
        limit = _find_friction_share(sign, stroke, p)
        travel = abs(v) * 0.5 * h / (p.presliding_m * limit)
        z = sign * limit + (z - sign * limit) * math.exp(-travel)
    else:
        z = sign + (z - sign) * math.exp(-abs(v) * 0.5 * h / p.presliding_m)
    if p.friction_memory > 0.0:
        level = math.exp(-((v / p.stribeck_speed_m_s) ** 2))
        travel = abs(v) * 0.5 * h / (p.friction_memory * p.presliding_m)
        memory = level + (memory - level) * math.exp(-travel)
    if p.valve_hysteresis_m_s > 0.0:
        sign = 1.0 if s[VALVE_RATE] > 0.0 else -1.0
        travel = abs(s[VALVE_RATE]) * h / p.valve_hysteresis_m_s
        z_valve = sign + (z_valve - sign) * math.exp(-travel)
    return z, memory, z_valve


@jit_untyped_kernel
def _simulate(command, reaction, m, rate_hz, steps, p, out):  # type: ignore[no-untyped-def]
    """Simulate from rest; command (sample,) in m, out (2, sample): table in m and m/s2."""
    # As tuples, which stay in registers: an array is written and read back at every stage.
    s = AT_REST
    h, z, memory, z_valve = 1.0 / (rate_hz * steps), 0.0, 1.0, 0.0
    lag = p.delay_s * rate_hz
    count = command.size
    for k in range(count):
        for i in range(steps):
            # Dahl's state over half a step before, and half a step after, the rest.
            for half in range(2):
                z, memory, z_valve = _advance_memories(s, z, memory, z_valve, h, p)
                if half == 1:
                    break
                total, rate = AT_REST, AT_REST
                for j in range(4):
                    share = 0.0 if j == 0 else (1.0 if j == 3 else 0.5)
                    weight = 1.0 if j in (0, 3) else 2.0
                    stage = _move(s, share * h, rate)
                    at = k - 1 + (i + share) / steps - lag
                    # Quadratic B-spline through three samples: continuous speed.
                    nearest = math.floor(at + 0.5)
                    x = at - nearest
                    a = command[min(max(nearest - 1, 0), count - 1)]
                    b = command[min(max(nearest, 0), count - 1)]
                    c = command[min(max(nearest + 1, 0), count - 1)]
                    value = 0.5 * (0.5 - x) ** 2 * a + (0.75 - x * x) * b + 0.5 * (0.5 + x) ** 2 * c
                    slope = ((x - 0.5) * a - 2.0 * x * b + (x + 0.5) * c) * rate_hz
                    at_r = min(max(k - 1 + (i + share) / steps, 0.0), count - 1.0)
                    low = int(at_r)
                    high = min(low + 1, count - 1)
                    force = reaction[low] + (at_r - low) * (reaction[high] - reaction[low])
                    t = (k - 1 + (i + share) / steps) / rate_hz
                    rate = _find_rates(stage, z, memory, z_valve, value, slope, force, t, h, m, p)
                    total = _move(total, weight, rate)
                s = _move(s, h / 6.0, total)
        rate = _find_rates(s, z, memory, z_valve, 0.0, 0.0, reaction[k], k / rate_hz, h, m, p)
        out[0, k], out[1, k] = s[Y], rate[V]


@dataclass(frozen=True)
class TableModel:
    """Table of a stated moving mass in kg with its parameters."""

    mass_kg: float
    parameters: TableParameters = field(default_factory=TableParameters)

    @property
    def delay_s(self) -> float:
        """Delay of the command in s."""
        return self.parameters.delay_s

    def simulate(
        self,
        command_m: Float1D,
        rate_hz: float,
        reaction_n: Float1D | None = None,
        max_step_s: float = MAX_STEP_S,
    ) -> Float2D:
        """Return table displacement in m and acceleration in m/s2, (2, sample), from rest.

        `command_m` and `reaction_n`, the force of the specimen on the table, are (sample,).
        """
        reaction = np.zeros(command_m.size) if reaction_n is None else reaction_n
        out = np.empty((2, command_m.size))
        steps = math.ceil(1.0 / (rate_hz * max_step_s))
        _simulate(
            np.ascontiguousarray(command_m), np.ascontiguousarray(reaction), self.mass_kg,
            rate_hz, steps, self.parameters, out,
        )  # fmt: skip
        return out

    def frequency_response(self, frequency_hz: Float1D) -> npt.NDArray[np.complex128]:
        """Return table displacement over command without friction, (frequency,), complex."""
        p, m, w = self.parameters, self.mass_kg, np.asarray(math.tau * frequency_hz, complex)
        s = 1j * w
        valve, oil, frame = (math.tau * hz for hz in (p.valve_hz, p.oil_hz, p.frame_hz))
        spool = valve**2 / (s**2 + 2 * p.valve_damping * valve * s + valve**2)
        delayed = np.exp(-s * p.delay_s)
        # Table y = d / (m s^2) with drive d; frame y_f = -r d / (m (...)); stroke q = y - y_f.
        safe = np.where(w == 0.0, 1.0, s**2)
        table = 1.0 / (m * safe)
        block = -p.frame_ratio / (m * (s**2 + 2 * p.frame_damping * frame * s + frame**2))
        frame = math.tau * p.second_frame_hz
        block -= p.second_frame_ratio / (
            m * (s**2 + 2 * p.second_frame_damping * frame * s + frame**2)
        )
        reading = (1.0 + p.transducer_gain_error) / (1.0 + p.transducer_lag_s * s)
        stroke = table - block  # per drive; the oil bears drive + c v
        oil_force = 1.0 + p.viscous_n_s_m * s * stroke
        high_pass = s / (s + PRESSURE_CORNER)
        # f' = K (u - v) - 2 z w f
        needed = (oil_force * (s + 2 * p.oil_damping * oil)) / (m * oil**2) + s * stroke
        loop = spool * (
            p.gain_1_s * reading * stroke + p.pressure_feedback_s * high_pass * oil_force / m
        )
        asked = (p.gain_1_s + p.velocity_feedforward * s) * delayed
        response: npt.NDArray[np.complex128] = spool * asked * table / (needed + loop)
        return np.where(w == 0.0, 1.0 / reading, response)
