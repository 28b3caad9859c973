"""What a laboratory writes: effects in a package of its own, as in `twin/model/effects`.

Installed as a package by `test_added_laws`; nothing else imports it.
"""

from math import tanh

from twin.model.effects.effect import Effect, EffectParameter


def cubic_push(q, w, c):
    return c[0] * q * q * q


CUBIC_BUMPER = Effect(
    id="cubic_bumper",
    term="k3 u_j^3 in each bumper",
    parameters=(EffectParameter("k3", "N/m3", 0.0, 1e13, 0.0, 2e9, "Coefficient of depth cubed."),),
    acts="force",
    place="bumpers",
    residual="In contact only: the force grows with the cube of the depth.",
    confused_with=("bumper_hardening",),
    force=cubic_push,
)


def branch_force(q, w, s, c):
    return s[0]


def branch_rates(q, w, s, c):
    return (c[0] * w - s[0] / c[1],)


BRANCH_PARAMETERS = (
    EffectParameter("stiffness", "N/m", 0.0, 1e7, 0.0, 8e3, "Spring of the branch."),
    EffectParameter("relaxation_time", "s", 1e-4, 100.0, None, 0.05, "Dashpot over spring."),
)
ZENER_DAMPER = Effect(
    id="zener_damper",
    term="f in the damper, f' = k u' - f / tau",
    parameters=BRANCH_PARAMETERS,
    acts="force",
    residual="Stiffness that rises with frequency, loss near 1 / tau.",
    confused_with=("bouc_wen",),
    states=("f",),
    force=branch_force,
    rates=branch_rates,
)
ZENER_BUMPER = Effect(
    id="zener_bumper",
    term="b_j in each bumper, b_j' = k u_j' - b_j / tau",
    parameters=BRANCH_PARAMETERS,
    acts="force",
    place="bumpers",
    residual="In contact only: stiffer at first, softer later.",
    confused_with=("bumper_hardening",),
    states=("b",),
    force=branch_force,
    rates=branch_rates,
)


def slip_force(q, w, s, c):
    return c[0] * s[0]


def slip_rates(q, w, s, c):
    z = s[0]
    return ((w - 0.5 * (abs(w) * z * abs(z) + w * z * z)) / c[1],)


SLIP_DAMPER = Effect(
    id="slip_damper",
    term="Fy z with uy z' = u' - (|u'| z |z| + u' z^2) / 2",
    parameters=(
        EffectParameter("force", "N", 0.0, 1e4, 0.0, 150.0, "Fy."),
        EffectParameter("yield_displacement", "m", 1e-5, 0.1, None, 3e-3, "uy."),
    ),
    acts="force",
    residual="Hysteresis that does not depend on frequency.",
    confused_with=("coulomb_friction",),
    states=("z",),
    force=slip_force,
    rates=slip_rates,
)


def hardening_push(q, w, c):
    return c[0] * q * abs(q)


def deep_dashpot_push(q, w, c):
    return c[0] * abs(q) * w


def _one_side(place, effect_id):
    return Effect(
        id=effect_id,
        term="k2 u_j |u_j| in one bumper",
        parameters=(EffectParameter("k2", "N/m2", 0.0, 1e10, 0.0, 1e8, "Depth squared."),),
        acts="force",
        place=place,
        residual="In contact on one side only.",
        confused_with=("bumper_asymmetry",),
        force=hardening_push,
    )


HARD_RIGHT = _one_side("right_bumper", "hard_right")
HARD_LEFT = _one_side("left_bumper", "hard_left")
DEEP_DASHPOT = Effect(
    id="deep_dashpot",
    term="c |u_j| u_j' in each bumper",
    parameters=(EffectParameter("c", "N s/m2", 0.0, 1e9, 0.0, 5e5, "Damping per depth."),),
    acts="force",
    place="bumpers",
    residual="In contact only: loss that grows with depth.",
    confused_with=("bumper_hardening",),
    force=deep_dashpot_push,
)


def _rocking(table_disp, values):
    return 9.80665 * values["tilt"] * table_disp


ROCKING = Effect(
    id="rocking",
    term="the table rocks",
    parameters=(EffectParameter("tilt", "rad/m", -10.0, 10.0, 0.0, 0.1, "Rotation."),),
    acts="input",
    place="input",
    residual="Force in phase with the table's displacement.",
    confused_with=("sensor_gain",),
    input_acceleration=_rocking,
)


def smooth_friction(q, w, c):
    return c[0] * tanh(w / c[1])


SMOOTH_FRICTION = Effect(
    id="smooth_friction",
    term="F tanh(u' / v0)",
    parameters=(
        EffectParameter("force", "N", 0.0, 1e3, 0.0, 20.0, "Far from rest."),
        EffectParameter("speed", "m/s", 1e-5, 1.0, None, 0.01, "Of the transition."),
    ),
    acts="force",
    residual="A step of the force where the motion turns.",
    confused_with=("coulomb_friction",),
    force=smooth_friction,
)


def carried_force(a, c):
    return c[0] * a


CARRIED_MASS = Effect(
    id="carried_mass",
    term="m A on the left side, m a mass that does not move with the specimen",
    parameters=(EffectParameter("mass", "kg", 0.0, 1e3, 0.0, 50.0, "m."),),
    acts="force",
    residual="Force in phase with the table's acceleration.",
    confused_with=("mass_error",),
    force=carried_force,
)


def pulling_force(t, c):
    return c[0] * t


PULLING_CABLE = Effect(
    id="pulling_cable",
    term="F' t",
    parameters=(EffectParameter("rate", "N/s", -1e3, 1e3, 0.0, 40.0, "F'."),),
    acts="force",
    residual="A static force that grows.",
    confused_with=("sensor_offset",),
    force=pulling_force,
)


def dragged_force(s, c):
    return c[0] * s[0]


def table_rate(a):
    return (a,)


DRAGGED_FLOOR = Effect(
    id="dragged_floor",
    term="c times the velocity of the table",
    parameters=(EffectParameter("damping", "N s/m", 0.0, 1e5, 0.0, 900.0, "c."),),
    acts="force",
    residual="Force in phase with the table's velocity.",
    confused_with=("table_tilt",),
    states=("table_velocity",),
    force=dragged_force,
    rates=table_rate,
)


def ageing_push(q, t, c):
    return c[0] * t * q


AGEING_BUMPER = Effect(
    id="ageing_bumper",
    term="k' t u_j in each bumper",
    parameters=(EffectParameter("rate", "N/m/s", 0.0, 1e7, 0.0, 1e5, "k'."),),
    acts="force",
    place="bumpers",
    residual="In contact only: a stiffness that grows with time.",
    confused_with=("gap_drift",),
    force=ageing_push,
)
EFFECTS = (
    CUBIC_BUMPER, ZENER_DAMPER, ZENER_BUMPER, SLIP_DAMPER, HARD_RIGHT, HARD_LEFT, DEEP_DASHPOT,
    ROCKING, SMOOTH_FRICTION, CARRIED_MASS, PULLING_CABLE, DRAGGED_FLOOR, AGEING_BUMPER,
)  # fmt: skip
