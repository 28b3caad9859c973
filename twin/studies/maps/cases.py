"""Cases of a study: the model and the level for given values of the varied parameters."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError, suggest
from table_io.units import GRAVITY_M_S2
from twin.laws.library import EFFECTS, find_effect
from twin.model.model import EffectInstance, Model
from twin.model.parameters import free_flight_resonance
from twin.studies.maps.config import StudyConfig, VariedParameter

LEVEL = "sweep.acceleration_g"
# Key -> (unit, fields of `Parameters`, SI value per unit of the key in each)
BASE_KEYS: Mapping[str, tuple[str, tuple[str, ...], float]] = {
    "specimen.mass_kg": ("kg", ("mass",), 1.0),
    "specimen.gap_mm": ("mm", ("gap_r", "gap_l"), 0.5e-3),
    "base.stiffness_n_m": ("N/m", ("stiffness",), 1.0),
    "base.damping_n_s_m": ("N s/m", ("damping",), 1.0),
    "base.bumper_stiffness_n_m": ("N/m", ("bumper_stiffness_r", "bumper_stiffness_l"), 1.0),
    "base.bumper_damping_n_s_m": ("N s/m", ("bumper_damping_r", "bumper_damping_l"), 1.0),
}


@dataclass(frozen=True, slots=True)
class SampledCase:
    """Model and peak table acceleration of one case, and the settings of its outcomes by key."""

    model: Model
    acceleration_m_s2: float
    settings: Mapping[str, float] = field(default_factory=dict)

    def find_resonance(self) -> tuple[float, float, float]:
        """Return `free_flight_resonance`, by which the ratios are scaled; InputError without."""
        return free_flight_resonance(self.model.parameters, self.acceleration_m_s2)


@dataclass(frozen=True, slots=True)
class CaseFactory:
    """Builds cases from values of `names`, the keys of the parameters, and of the fixed keys.

    `settings`: units of the keys of outcomes.
    """

    model: Model
    acceleration_m_s2: float
    fixed: Mapping[str, float]
    names: tuple[str, ...]
    settings: Mapping[str, str]

    def require_keys(self) -> None:
        """Raise InputError for an unknown key, or an effect without values of all parameters."""
        for name in (*self.fixed, *self.names):
            self.find_unit(name)
            if name in self.fixed and name in self.names:
                raise InputError("both fixed and varied", key=name, remedy="keep one")
        _require_whole_effects(self.model, (*self.fixed, *self.names))

    def build(self, values: Sequence[float]) -> SampledCase:
        """Return the case of these values, in the units of their keys.

        InputError if they make no model.
        """
        level, base = self.acceleration_m_s2, dict[str, float]()
        settings: dict[str, float] = {}
        effects: dict[str, dict[str, float]] = {}
        pairs = {**self.fixed, **dict(zip(self.names, values, strict=True))}
        for name, value in pairs.items():
            if name == LEVEL:
                if not value > 0:
                    raise InputError("not a level", key=name, value=value, allowed="above 0 g")
                level = value * GRAVITY_M_S2
            elif name in self.settings:
                settings[name] = value
            elif name in BASE_KEYS:
                _, fields, factor = BASE_KEYS[name]
                base |= dict.fromkeys(fields, value * factor)
            else:
                _, effect, parameter = name.split(".")
                effects.setdefault(effect, {})[parameter] = value
        instances = {instance.name: instance for instance in self.model.effects}
        for effect, own in effects.items():
            present = instances.get(effect)
            known = present.values if present else {}
            definition = present.effect if present else find_effect(effect)
            instances[effect] = EffectInstance.create(definition, {**known, **own})
        model = Model(replace(self.model.base, **base), tuple(instances.values()))
        return SampledCase(model, level, settings)

    def find_unit(self, name: str) -> str:
        """Return the unit of a key that this study may vary; InputError if there is no such key."""
        if name in self.settings:
            return self.settings[name]
        return parameter_unit(name, self.settings)


def parameter_unit(name: str, further_names: Iterable[str] = ()) -> str:
    """Return the unit of a key of tests and models; InputError if there is no such key.

    `further_names`: what else the message may suggest.
    """
    if name in BASE_KEYS:
        return BASE_KEYS[name][0]
    if name == LEVEL:
        return "g"
    if name.startswith("effects."):
        _, effect_id, *rest = name.split(".")
        effect = find_effect(effect_id)
        if effect.acts == "sensor":
            raise InputError(
                "acts on a sensor, and the ideal sweep has none",
                key=name,
                allowed="effects of the specimen and the table",
            )
        units = {parameter.name: parameter.unit for parameter in effect.parameters}
        if len(rest) == 1 and rest[0] in units:
            return units[rest[0]]
        known = [f"effects.{effect_id}.{parameter}" for parameter in units]
    else:
        known = [*list_parameter_names(), *further_names]
    raise InputError("no parameter of a study", key=name or "name", remedy=suggest(name, known))


def list_parameter_names() -> list[str]:
    """List the keys that a study may vary, of built-in effects."""
    return [
        *BASE_KEYS,
        LEVEL,
        *(
            f"effects.{effect.id}.{parameter.name}"
            for effect in EFFECTS
            if effect.acts != "sensor"
            for parameter in effect.parameters
        ),
    ]


def _require_whole_effects(model: Model, names: Sequence[str]) -> None:
    """Raise InputError if an effect that the model lacks has a parameter without a value."""
    present = {instance.name for instance in model.effects}
    for effect_id in dict.fromkeys(n.split(".")[1] for n in names if n.startswith("effects.")):
        missing = [
            f"effects.{effect_id}.{parameter.name}"
            for parameter in find_effect(effect_id).parameters
            if f"effects.{effect_id}.{parameter.name}" not in names
        ]
        if missing and effect_id not in present:
            raise InputError(
                f"the model has no {effect_id}, so that it has no value of {', '.join(missing)}",
                key=f"effects.{effect_id}",
                remedy="add it to [fixed] or to the parameters",
            )


def grid_axes(config: StudyConfig) -> tuple[Float1D, ...]:
    """Return the values of each parameter of a grid, in the units of their keys."""
    return tuple(_grid_values(parameter) for parameter in config.parameters)


def _grid_values(parameter: VariedParameter) -> Float1D:
    if parameter.values:
        return np.array(parameter.values)
    start, stop = parameter.limits
    if parameter.scale == "log":
        return np.geomspace(start, stop, parameter.grid_size)
    # A step of 0.1 gives 0.3, not 0.30000000000000004: the values are labels too.
    return np.linspace(start, stop, parameter.grid_size).round(12)


def sample_parameters(config: StudyConfig) -> Float2D:
    """Return the values of the parameters in every case, (case, parameter), by the seed alone.

    Of a grid the last parameter varies fastest, but for repeated cases. Of a sensitivity design,
    with n base samples and d parameters: A (n cases), B (n), then for each parameter A with its
    column from B (n each).
    """
    if config.sampling == "grid":
        axes = np.meshgrid(*grid_axes(config), indexing="ij")
        cells = np.stack([axis.ravel() for axis in axes], axis=1)
        return np.repeat(cells, config.repeats, axis=0)
    from scipy.stats import qmc

    assert config.samples is not None
    count, size = len(config.parameters), config.samples
    if config.sampling == "latin_hypercube":
        unit = qmc.LatinHypercube(count, rng=config.seed).random(size)
    elif config.sampling == "sobol":
        unit = qmc.Sobol(count, rng=config.seed).random(size)
    else:
        base = qmc.Sobol(2 * count, rng=config.seed).random(size)
        a, b = base[:, :count], base[:, count:]
        mixed = np.repeat(a[None], count, axis=0)
        for column in range(count):
            mixed[column, :, column] = b[:, column]
        unit = np.concatenate([a, b, mixed.reshape(-1, count)])
    columns = zip(unit.T, config.parameters, strict=True)
    return np.stack([_scale_unit(values, parameter) for values, parameter in columns], axis=1)


def _scale_unit(unit: Float1D, parameter: VariedParameter) -> Float1D:
    """Map numbers from 0 to 1 to the range of a parameter."""
    start, stop = parameter.limits
    if parameter.scale == "log":
        return start * (stop / start) ** unit
    return start + (stop - start) * unit
