"""The physical effects a model may have. Adding one: a file here and a line in `EFFECTS`.

Other packages add theirs by an entry point of the group `shaketwin.effects` that is an `Effect`.
"""

import difflib
from importlib import metadata

from table_io.card import BadInput
from twin.model.effects.bouc_wen import BOUC_WEN
from twin.model.effects.bumper_asymmetry import BUMPER_ASYMMETRY
from twin.model.effects.bumper_hardening import BUMPER_HARDENING
from twin.model.effects.bumper_maxwell import BUMPER_MAXWELL
from twin.model.effects.coulomb_friction import COULOMB_FRICTION
from twin.model.effects.cubic_stiffness import CUBIC_STIFFNESS
from twin.model.effects.effect import Effect
from twin.model.effects.gap_drift import GAP_DRIFT
from twin.model.effects.gap_offset import GAP_OFFSET
from twin.model.effects.hunt_crossley import HUNT_CROSSLEY
from twin.model.effects.mass_error import MASS_ERROR
from twin.model.effects.maxwell_damper import MAXWELL_DAMPER
from twin.model.effects.quadratic_damping import QUADRATIC_DAMPING
from twin.model.effects.sensor_gain import SENSOR_GAIN
from twin.model.effects.sensor_lag import SENSOR_LAG
from twin.model.effects.sensor_offset import SENSOR_OFFSET
from twin.model.effects.table_tilt import TABLE_TILT

GROUP = "shaketwin.effects"

EFFECTS: tuple[Effect, ...] = (
    CUBIC_STIFFNESS,
    QUADRATIC_DAMPING,
    COULOMB_FRICTION,
    BOUC_WEN,
    MAXWELL_DAMPER,
    BUMPER_HARDENING,
    HUNT_CROSSLEY,
    BUMPER_MAXWELL,
    BUMPER_ASYMMETRY,
    GAP_OFFSET,
    GAP_DRIFT,
    TABLE_TILT,
    MASS_ERROR,
    SENSOR_GAIN,
    SENSOR_LAG,
    SENSOR_OFFSET,
)


def plugins() -> tuple[Effect, ...]:
    """The effects that installed packages add; BadInput names one that cannot be taken."""
    found = []
    for entry in metadata.entry_points(group=GROUP):
        where = f"plug-in {entry.value} of {GROUP}"
        try:
            effect = entry.load()
        except Exception as error:  # whatever a foreign module raises
            raise BadInput(f"{where}: cannot load: {error}; mend or remove the package") from error
        if not isinstance(effect, Effect):
            raise BadInput(f"{where}: is no Effect but {type(effect).__name__}; mend the package")
        if effect.acts == "parameters" and effect.change is None:
            raise BadInput(f"{where}: acts on parameters but has no change; mend the package")
        if effect.acts == "force" and effect.force is None:
            raise BadInput(f"{where}: acts as a force but has none; mend the package")
        if effect.acts not in ("parameters", "force"):
            raise BadInput(f"{where}: acts as {effect.acts!r}; a plug-in: parameters or force")
        found.append(effect)
    return tuple(found)


def find_effect(name: str) -> Effect:
    """The effect of this id, ours before a plug-in's; BadInput names the nearest."""
    for effect in EFFECTS:
        if effect.id == name:
            return effect
    others = plugins()
    for effect in others:
        if effect.id == name:
            return effect
    ids = [effect.id for effect in (*EFFECTS, *others)]
    near = difflib.get_close_matches(name, ids, 1, 0.4)
    hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(ids)}"
    raise BadInput(f"effect {name!r} is unknown; {hint}")
