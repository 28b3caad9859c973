"""Where the cases of a study lie: grids, Latin hypercubes, Sobol points, sensitivity designs."""

import numpy as np

from table_io.block import Float1D, Float2D
from twin.studies.maps.config import StudyConfig, VariedParameter


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
