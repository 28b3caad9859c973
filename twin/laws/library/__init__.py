"""Physical effects that a model may have. To add one: a file here and its name in `NAMES`.

Other packages add effects through entry points of the group `shaketwin.effects`, each an `Effect`
that is written as those here.
"""

from importlib import import_module
from itertools import chain

from table_io.config.plugins import list_entry_points, load_entry, make_plugin_error
from table_io.errors import InputError, suggest
from twin.laws.checks import check_effect
from twin.laws.effect import Effect

ENTRY_POINT_GROUP = "shaketwin.effects"

NAMES = (
    "cubic_stiffness",
    "quadratic_damping",
    "coulomb_friction",
    "bouc_wen",
    "maxwell_damper",
    "stribeck_friction",
    "position_damping",
    "dead_band",
    "appendage",
    "bumper_hardening",
    "bumper_cubic",
    "hunt_crossley",
    "bumper_maxwell",
    "adhesion",
    "bumper_asymmetry",
    "gap_offset",
    "gap_drift",
    "table_tilt",
    "mass_error",
    "sensor_gain",
    "sensor_lag",
    "sensor_offset",
)
EFFECTS: tuple[Effect, ...] = tuple(import_module(f"{__name__}.{name}").EFFECT for name in NAMES)


def load_plugins() -> tuple[Effect, ...]:
    """Load the effects that installed packages add; InputError names an unusable one."""
    plugins = []
    for entry in chain.from_iterable(list_entry_points(ENTRY_POINT_GROUP).values()):
        effect = load_entry(entry, ENTRY_POINT_GROUP)
        if not isinstance(effect, Effect):
            problem = f"expected an Effect, got {type(effect).__name__}"
            raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
        if effect.compiled or effect.place == "sensor":
            problem = "`compiled` and sensors are not available to plug-ins"
            raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
        try:
            check_effect(effect)
        except InputError as error:
            raise make_plugin_error(entry, ENTRY_POINT_GROUP, str(error)) from None
        plugins.append(effect)
    return tuple(plugins)


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


def check_new_effect(effect: Effect) -> None:
    """Raise InputError unless an effect that is not in the library can be used."""
    if effect.id in NAMES:
        raise InputError("an effect of the library", key="id", value=effect.id, remedy="rename")
    check_effect(effect)
