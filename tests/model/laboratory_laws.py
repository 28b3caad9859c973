"""What a laboratory writes: effects in a package of its own, as in `twin/laws/library`.

Installed as a package by `test_added_laws`; nothing else imports it.
"""

from twin.laws.effect import Effect, EffectParameter, State

CUBIC_BUMPER = Effect(
    id="cubic_bumper",
    description="A bumper that is squeezed against its plate: laboratory sheet 12.",
    term="k3 u_j^3 in each bumper",
    force="k3 * d * d * d",
    parameters=(EffectParameter("k3", "N/m3", 0.0, 1e13, 0.0, 2e9, "Coefficient of depth cubed."),),
    place="bumpers",
    residual="In contact only: the force grows with the cube of the depth.",
    confused_with=("bumper_hardening",),
)
BRANCH_PARAMETERS = (
    EffectParameter("stiffness", "N/m", 0.0, 1e7, 0.0, 8e3, "Spring of the branch."),
    EffectParameter("relaxation_time", "s", 1e-4, 100.0, None, 0.05, "Dashpot over spring."),
)
ZENER_DAMPER = Effect(
    id="zener_damper",
    term="f in the damper, f' = k u' - f / tau",
    force="f",
    states={"f": State("N", "stiffness * v - f / relaxation_time")},
    parameters=BRANCH_PARAMETERS,
    residual="Stiffness that rises with frequency, loss near 1 / tau.",
    confused_with=("bouc_wen",),
)
ZENER_BUMPER = Effect(
    id="zener_bumper",
    term="b_j in each bumper, b_j' = k u_j' - b_j / tau",
    force="b",
    states={"b": State("N", "stiffness * v - b / relaxation_time")},
    parameters=BRANCH_PARAMETERS,
    place="bumpers",
    residual="In contact only: stiffer at first, softer later.",
    confused_with=("bumper_hardening",),
)
SLIP_DAMPER = Effect(
    id="slip_damper",
    term="Fy z with uy z' = u' - (|u'| z |z| + u' z^2) / 2",
    force="force * z",
    states={"z": State("", "(v - 0.5 * (abs(v) * z * abs(z) + v * z * z)) / yield_displacement")},
    parameters=(
        EffectParameter("force", "N", 0.0, 1e4, 0.0, 150.0, "Fy."),
        EffectParameter("yield_displacement", "m", 1e-5, 0.1, None, 3e-3, "uy."),
    ),
    residual="Hysteresis that does not depend on frequency.",
    confused_with=("coulomb_friction",),
)


def _one_side(place, effect_id):
    return Effect(
        id=effect_id,
        term="k2 u_j |u_j| in one bumper",
        force="k2 * d * abs(d)",
        parameters=(EffectParameter("k2", "N/m2", 0.0, 1e10, 0.0, 1e8, "Depth squared."),),
        place=place,
        residual="In contact on one side only.",
        confused_with=("bumper_asymmetry",),
    )


HARD_RIGHT = _one_side("right_bumper", "hard_right")
HARD_LEFT = _one_side("left_bumper", "hard_left")
DEEP_DASHPOT = Effect(
    id="deep_dashpot",
    term="c |u_j| u_j' in each bumper",
    force="c * abs(d) * v",
    parameters=(EffectParameter("c", "N s/m2", 0.0, 1e9, 0.0, 5e5, "Damping per depth."),),
    place="bumpers",
    residual="In contact only: loss that grows with depth.",
    confused_with=("bumper_hardening",),
)
ROCKING = Effect(
    id="rocking",
    term="the table rocks",
    constants={"lean": "g * tilt"},
    force="lean * y",
    parameters=(EffectParameter("tilt", "rad/m", -10.0, 10.0, 0.0, 0.1, "Rotation."),),
    place="input",
    residual="Force in phase with the table's displacement.",
    confused_with=("sensor_gain",),
)
SMOOTH_FRICTION = Effect(
    id="smooth_friction",
    term="F tanh(u' / v0)",
    force="force * tanh(v / speed)",
    parameters=(
        EffectParameter("force", "N", 0.0, 1e3, 0.0, 20.0, "Far from rest."),
        EffectParameter("speed", "m/s", 1e-5, 1.0, None, 0.01, "Of the transition."),
    ),
    residual="A step of the force where the motion turns.",
    confused_with=("coulomb_friction",),
)
DRY_FRICTION = Effect(
    id="dry_friction",
    term="level sign(u')",
    break_away="level",
    parameters=(EffectParameter("level", "N", 0.0, 1e6, 0.0, 50.0, "Friction during slip."),),
    residual="At small motion the mass does not move at all.",
    confused_with=("coulomb_friction",),
)
STICKY_BUMPER = Effect(
    id="sticky_bumper",
    term="contact ends at F_j = -tension",
    pull_off="tension",
    parameters=(EffectParameter("tension", "N", 0.0, 1e9, 0.0, 100.0, "At the release."),),
    place="bumpers",
    residual="Tension before each release.",
    confused_with=("adhesion",),
)
OPENING_GAPS = Effect(
    id="opening_gaps",
    term="both gaps grow by pace x time",
    gap_rate="pace",
    parameters=(EffectParameter("pace", "m/s", -1.0, 1.0, 0.0, 5e-6, "Of each side."),),
    place="bumpers",
    residual="Onset and release move with time.",
    confused_with=("gap_drift",),
)
MISPLACED_MASS = Effect(
    id="misplaced_mass",
    term="contact earlier on the right",
    changes={"gap_r": "gap_r + shift", "gap_l": "gap_l - shift"},
    parameters=(EffectParameter("shift", "m", -1.0, 1.0, 0.0, 3e-4, "To the left."),),
    place="bumpers",
    residual="Contact begins early on one side.",
    confused_with=("gap_offset",),
)
CARRIED_MASS = Effect(
    id="carried_mass",
    term="m A on the left side, m a mass that does not move with the specimen",
    force="mass * a",
    parameters=(EffectParameter("mass", "kg", 0.0, 1e3, 0.0, 50.0, "m."),),
    residual="Force in phase with the table's acceleration.",
    confused_with=("mass_error",),
)
PULLING_CABLE = Effect(
    id="pulling_cable",
    term="F' t",
    force="rate * t",
    parameters=(EffectParameter("rate", "N/s", -1e3, 1e3, 0.0, 40.0, "F'."),),
    residual="A static force that grows.",
    confused_with=("sensor_offset",),
)
DRAGGED_FLOOR = Effect(
    id="dragged_floor",
    term="c times the velocity of the table",
    force="damping * table_velocity",
    states={"table_velocity": State("m/s", "a")},
    parameters=(EffectParameter("damping", "N s/m", 0.0, 1e5, 0.0, 900.0, "c."),),
    residual="Force in phase with the table's velocity.",
    confused_with=("table_tilt",),
)
AGEING_BUMPER = Effect(
    id="ageing_bumper",
    term="k' t u_j in each bumper",
    force="rate * t * d",
    parameters=(EffectParameter("rate", "N/m s", 0.0, 1e7, 0.0, 1e5, "k'."),),
    place="bumpers",
    residual="In contact only: a stiffness that grows with time.",
    confused_with=("gap_drift",),
)
EFFECTS = (
    CUBIC_BUMPER, ZENER_DAMPER, ZENER_BUMPER, SLIP_DAMPER, HARD_RIGHT, HARD_LEFT, DEEP_DASHPOT,
    ROCKING, SMOOTH_FRICTION, DRY_FRICTION, STICKY_BUMPER, OPENING_GAPS, MISPLACED_MASS,
    CARRIED_MASS, PULLING_CABLE, DRAGGED_FLOOR, AGEING_BUMPER,
)  # fmt: skip
