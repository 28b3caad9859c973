"""Physical effects that a model may have. To add one: a file here and a line in `EFFECTS`.

Other packages add effects through entry points of the group `shaketwin.effects`, each an `Effect`.
"""

import re
from importlib import import_module
from itertools import chain

from table_io.config.plugins import list_entry_points, load_entry, make_plugin_error
from table_io.errors import InputError, suggest
from twin.model.effects.adhesion import ADHESION
from twin.model.effects.appendage import APPENDAGE
from twin.model.effects.bouc_wen import BOUC_WEN
from twin.model.effects.bumper_asymmetry import BUMPER_ASYMMETRY
from twin.model.effects.bumper_cubic import BUMPER_CUBIC
from twin.model.effects.bumper_hardening import BUMPER_HARDENING
from twin.model.effects.bumper_maxwell import BUMPER_MAXWELL
from twin.model.effects.coulomb_friction import COULOMB_FRICTION
from twin.model.effects.cubic_stiffness import CUBIC_STIFFNESS
from twin.model.effects.dead_band import DEAD_BAND
from twin.model.effects.effect import Effect
from twin.model.effects.gap_drift import GAP_DRIFT
from twin.model.effects.gap_offset import GAP_OFFSET
from twin.model.effects.hunt_crossley import HUNT_CROSSLEY
from twin.model.effects.law import find_law_problem
from twin.model.effects.mass_error import MASS_ERROR
from twin.model.effects.maxwell_damper import MAXWELL_DAMPER
from twin.model.effects.position_damping import POSITION_DAMPING
from twin.model.effects.quadratic_damping import QUADRATIC_DAMPING
from twin.model.effects.sensor_gain import SENSOR_GAIN
from twin.model.effects.sensor_lag import SENSOR_LAG
from twin.model.effects.sensor_offset import SENSOR_OFFSET
from twin.model.effects.stribeck_friction import STRIBECK_FRICTION
from twin.model.effects.table_tilt import TABLE_TILT

ENTRY_POINT_GROUP = "shaketwin.effects"

EFFECTS: tuple[Effect, ...] = (
    CUBIC_STIFFNESS,
    QUADRATIC_DAMPING,
    COULOMB_FRICTION,
    BOUC_WEN,
    MAXWELL_DAMPER,
    STRIBECK_FRICTION,
    POSITION_DAMPING,
    DEAD_BAND,
    APPENDAGE,
    BUMPER_HARDENING,
    BUMPER_CUBIC,
    HUNT_CROSSLEY,
    BUMPER_MAXWELL,
    ADHESION,
    BUMPER_ASYMMETRY,
    GAP_OFFSET,
    GAP_DRIFT,
    TABLE_TILT,
    MASS_ERROR,
    SENSOR_GAIN,
    SENSOR_LAG,
    SENSOR_OFFSET,
)


def load_plugins() -> tuple[Effect, ...]:
    """Load the effects that installed packages add; InputError names an unusable one."""
    plugins = []
    for entry in chain.from_iterable(list_entry_points(ENTRY_POINT_GROUP).values()):
        effect = load_entry(entry, ENTRY_POINT_GROUP)
        if not isinstance(effect, Effect):
            problem = f"expected an Effect, got {type(effect).__name__}"
        else:
            problem = _find_plugin_problem(effect)
        if problem:
            raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
        plugins.append(effect)
    return tuple(plugins)


def _find_plugin_problem(effect: Effect) -> str:
    """Return why a plug-in's effect cannot be used, "" if it can."""
    match effect.acts:
        case "parameters" if effect.change is None:
            return "acts on parameters but has no `change` function"
        case "input" if effect.input_acceleration is None:
            return "acts on the input but has no `input_acceleration` function"
        case "parameters" | "input":
            return ""
        case "force":
            return find_law_problem(effect)
        case _:
            return f"acts = {effect.acts!r} is not available to plug-ins: parameters, input, force"


def describe_effect(effect: Effect) -> str:
    """Return an effect in a few words of physics: from its module, of a plug-in its term."""
    if effect not in EFFECTS:
        return effect.term
    text = import_module(f"{__name__}.{effect.id}").__doc__ or effect.term
    return re.split(r"[:,.]", text.replace("\n", " "), maxsplit=1)[0]


def find_effect(name: str) -> Effect:
    """Return the effect with this id, built-in before plug-in; InputError names the nearest."""
    for effect in EFFECTS:
        if effect.id == name:
            return effect
    plugins = load_plugins()
    for effect in plugins:
        if effect.id == name:
            return effect
    ids = [effect.id for effect in (*EFFECTS, *plugins)]
    raise InputError(f"effect {name!r} is unknown", remedy=suggest(name, ids))
