"""Laws of a model at its own values, over the motion that a test foresees.

The check of a law on its own (`twin.laws.checks`) knows neither the values of a model nor the test.
"""

import math

import numpy as np

from table_io.block import Float1D
from table_io.config.profile import Profile
from table_io.errors import InputError
from twin.laws.checks import DEFAULT_DURATION_S, DEFAULT_RANGE
from twin.laws.effect import PLACES
from twin.model.model import MIN_SAMPLES_PER_CONTACT, EffectInstance, Model
from twin.model.parameters import Parameters, free_flight_resonance
from twin.model.valid_range import VARIABLE_NAMES

PROBED_POSITIONS = 81  # over the foreseen displacements or compressions
PROBED_SHARES = (-1.0, -0.5, 0.0, 0.5, 1.0)  # of the largest velocity
MAX_RELAXATIONS_PER_SAMPLE = 1.0  # of the velocity by the damping of a law


def check_laws(model: Model, profile: Profile) -> None:
    """Raise InputError where a law of the model is not finite or too steep for this test.

    Its slopes are those over a fortieth of the displacements, or half of the velocity: a steep part
    inside is bounded.
    """
    parameters, rate_hz = model.parameters, profile.acquisition.rate_hz
    reach = _foresee_motion(parameters, profile.plan.level_m_s2)
    max_angular_frequency = math.pi * rate_hz / MIN_SAMPLES_PER_CONTACT
    limits = {
        "u": ("stiffness", parameters.mass * max_angular_frequency**2, "N/m"),
        "v": ("damping", parameters.mass * MAX_RELAXATIONS_PER_SAMPLE * rate_hz, "N s/m"),
    }
    limits["d"] = limits["u"]
    for instance in model.present_effects:
        if not instance.effect.force:
            continue
        grid, forces = _evaluate_law(instance, parameters, reach)
        _require_finite(instance, grid, forces)
        for axis, (name, values) in enumerate(grid.items()):
            if name not in limits or instance.effect.place not in PLACES or values[-1] == 0.0:
                continue
            what, limit, unit = limits[name]
            step = np.diff(values).reshape([-1 if k == axis else 1 for k in range(forces.ndim)])
            slope = float(np.abs(np.diff(forces, axis=axis) / step).max())
            if slope > limit:
                raise InputError(
                    f"its {what} reaches {slope:.3g} {unit}, too much for {rate_hz:g} Hz",
                    where=f"effect {instance.name!r}", key="force", value=instance.effect.force,
                    allowed=f"up to {limit:.3g} {unit} at this rate",
                    remedy="look for a wrong power of ten in its parameters, or raise rate_hz",
                )  # fmt: skip


def _foresee_motion(parameters: Parameters, level_m_s2: float) -> dict[str, float]:
    """Return the largest displacement, compression, velocity and drive of a test, SI, by variable.

    u is that of the free-flight resonance, or of a mass that meets a bumper at the speed of it.
    """
    w0 = math.sqrt(parameters.stiffness / parameters.mass)
    free_m = DEFAULT_RANGE["u"]
    if parameters.damping > 0.0:
        free_m, _, _ = free_flight_resonance(parameters, level_m_s2)
    sides = (
        (parameters.gap_r, parameters.bumper_stiffness_r),
        (parameters.gap_l, parameters.bumper_stiffness_l),
    )
    depths = [free_m * math.sqrt(parameters.stiffness / stiffness) for _, stiffness in sides]
    pressed = [
        0.0 if free_m <= gap else min(depth + max(-gap, 0.0), free_m - gap)
        for (gap, _), depth in zip(sides, depths, strict=True)
    ]
    reached = [
        min(free_m, max(gap, 0.0) + depth) for (gap, _), depth in zip(sides, depths, strict=True)
    ]
    return {
        "u": max(reached), "d": max(pressed), "v": w0 * free_m, "a": level_m_s2,
        "y": DEFAULT_RANGE["y"], "t": DEFAULT_DURATION_S,
    }  # fmt: skip


def _evaluate_law(
    instance: EffectInstance, parameters: Parameters, reach: dict[str, float]
) -> tuple[dict[str, Float1D], np.ndarray[tuple[int, ...], np.dtype[np.float64]]]:
    """Return the probed values of each variable, and the force there, one axis for each."""
    effect = instance.effect
    grid = {}
    for name in effect.variables:
        size = reach[name]
        if name in ("u", "y"):
            grid[name] = np.linspace(-size, size, PROBED_POSITIONS)
        elif name == "d":
            grid[name] = np.linspace(0.0, size, PROBED_POSITIONS)
        elif name == "t":
            grid[name] = np.array([0.0, size])
        else:
            grid[name] = size * np.array(PROBED_SHARES)
    points = dict(zip(grid, np.meshgrid(*grid.values(), indexing="ij"), strict=True))
    given = points | dict.fromkeys(effect.states, 0.0)
    with np.errstate(all="ignore"):
        given |= effect.work_out_constants(parameters.as_dict(), instance.values)
        forces = effect.parsed_force.evaluate(given)
    shape = tuple(values.size for values in grid.values())
    return grid, np.broadcast_to(np.asarray(forces, dtype=np.float64), shape)


def _require_finite(
    instance: EffectInstance,
    grid: dict[str, Float1D],
    forces: np.ndarray[tuple[int, ...], np.dtype[np.float64]],
) -> None:
    """Raise InputError if a force is not finite; it names the place nearest to rest."""
    bad = np.argwhere(~np.isfinite(forces))
    if not bad.size:
        return
    scales = [max(np.abs(values).max(), 1e-300) for values in grid.values()]
    places = [
        [values[index] for values, index in zip(grid.values(), place, strict=True)]
        for place in bad.tolist()
    ]
    nearest = min(
        places, key=lambda place: sum(abs(x) / s for x, s in zip(place, scales, strict=True))
    )
    units = instance.effect.variables
    where = ", ".join(
        f"{VARIABLE_NAMES[name]} {value:.3g} {units[name]}"
        for name, value in zip(grid, nearest, strict=True)
        if value != 0.0
    )
    ends = ", ".join(
        f"{VARIABLE_NAMES[name]} up to {values[-1]:.3g} {units[name]}"
        for name, values in grid.items()
        if name in ("u", "d", "y")
    )
    raise InputError(
        f"not finite at {where or 'rest'} with the values of this model; this test foresees {ends}",
        where=f"effect {instance.name!r}", key="force", value=instance.effect.force,
        remedy="use a law that is finite there, or a test with a lower level",
    )  # fmt: skip
