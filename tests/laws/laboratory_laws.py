"""What a laboratory writes: effects in a package of its own, as those of `twin/laws/library`.

Installed as a package by `test_plugins`. Some repeat a law of the library for which the solver has
a form of its own: here it has only the expression.
"""

from dataclasses import replace

from twin.laws.effect import Effect, EffectParameter, State
from twin.laws.library import find_effect

CUBIC_BUMPER = replace(find_effect("bumper_cubic"), id="cubic_bumper")
ZENER_DAMPER = replace(
    find_effect("maxwell_damper"), id="zener_damper", compiled={}, is_linear=False
)
ZENER_BUMPER = replace(
    find_effect("bumper_maxwell"), id="zener_bumper", compiled={}, is_linear=False
)
SLIP_DAMPER = replace(find_effect("bouc_wen"), id="slip_damper", compiled={})
HARD_RIGHT = replace(
    find_effect("bumper_hardening"), id="hard_right", place="right_bumper", compiled={}
)
HARD_LEFT = replace(HARD_RIGHT, id="hard_left", place="left_bumper")
STICKY_BUMPER = replace(find_effect("adhesion"), id="sticky_bumper")
DRY_FRICTION = replace(find_effect("coulomb_friction"), id="dry_friction")
OPENING_GAPS = replace(find_effect("gap_drift"), id="opening_gaps")
MISPLACED_MASS = replace(find_effect("gap_offset"), id="misplaced_mass")
ROCKING = replace(find_effect("table_tilt"), id="rocking")
CARRIED_MASS = Effect(
    id="carried_mass",
    description="A mass that does not move with the specimen: on the floor beside it.",
    term="m A on the left side",
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
    CUBIC_BUMPER, ZENER_DAMPER, ZENER_BUMPER, SLIP_DAMPER, HARD_RIGHT, HARD_LEFT, STICKY_BUMPER,
    DRY_FRICTION, OPENING_GAPS, MISPLACED_MASS, ROCKING, CARRIED_MASS, PULLING_CABLE,
    DRAGGED_FLOOR, AGEING_BUMPER,
)  # fmt: skip
