"""Linear model of what a specimen's model leaves: columns of its base, candidates and stranger."""

import math
from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.discovery.candidates import Candidate
from twin.discovery.least_squares import MapFunction, compute_slopes
from twin.discovery.parameters import FreeParameter, ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.discovery.strangers import compute_stranger_forces
from twin.discovery.units import assign_units
from twin.evidence.linear import LinearEvidence, Variant, absorb_base


def build_evidence(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    library: Sequence[Candidate],
    known_shapes: Mapping[str, tuple[float, ...]],
    rich: Sequence[tuple[str, tuple[float, ...]]] = (),
    mapper: MapFunction = map,
) -> LinearEvidence[Candidate]:
    """Build the linear model about a parameter set."""
    free = parameters.free
    variants: list[Variant[Candidate]] = []
    requests: list[tuple[ParameterSet, FreeParameter, float]] = [(parameters, p, 0.0) for p in free]
    for candidate in library:
        amplitude, vanishing = candidate.amplitude, candidate.vanishing
        sign = int(amplitude.low >= vanishing) - int(amplitude.high <= vanishing)
        known = known_shapes.get(candidate.name)
        shapes = dict.fromkeys((*candidate.shapes, *([known] if known else [])))
        for shape, probe in product(shapes, candidate.probes):
            variants.append(Variant(candidate, shape, sign))
            requests.append((candidate.add_to(parameters, shape), amplitude, probe))

    columns, places = _fill_columns(log_residuals, parameters, requests, len(variants), mapper)
    copies = [residuals.noise_copy for residuals in log_residuals]
    noisy, _ = _fill_columns(copies, parameters, requests, len(variants), mapper)
    noisy -= columns
    held = _list_held(free, parameters, columns[: len(free)] @ columns[-1])
    if held:  # a copy of many samples
        columns, noisy = (np.delete(rows, held, axis=0) for rows in (columns, noisy))
    unit = _number_units(log_residuals)
    rich_columns = [
        k for k, variant in enumerate(variants) if (variant.candidate.name, variant.shape) in rich
    ]
    return absorb_base(
        columns, noisy @ noisy.T, len(free) - len(held), unit, tuple(variants), places,
        _measure_force(log_residuals), rich_columns,
        np.concatenate([residuals.expected_entries for residuals in log_residuals]),
    )  # fmt: skip


def _list_held(
    free: Sequence[FreeParameter], parameters: ParameterSet, slopes: Float1D
) -> list[int]:
    """Return the places of the parameters that the residual presses against a bound.

    `slopes`, (free,), are those of half the residual squares. A parameter may be at a bound because
    an effect, which the set now lacks, stood in for it: that one is free.
    """
    values = [parameters.values[own.keys[0]] for own in free]
    return [
        place
        for place, (own, value, slope) in enumerate(zip(free, values, slopes, strict=True))
        if (value <= own.low and slope >= 0.0) or (value >= own.high and slope <= 0.0)
    ]


def _fill_columns(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    requests: Sequence[tuple[ParameterSet, FreeParameter, float]],
    variant_count: int,
    mapper: MapFunction,
) -> tuple[Float2D, dict[str, Int1D]]:
    """Return (slopes of the requests, columns of the stranger, residual; (column, entry), places).

    The columns of the nuisances have no noise, and are the same in a copy with more of it.
    """
    before = [residuals.evaluate(parameters) for residuals in log_residuals]

    def slopes(request: tuple[ParameterSet, FreeParameter, float]) -> Float1D:
        start, parameter, probe = request
        with np.errstate(all="ignore"):
            column = np.concatenate(compute_slopes(log_residuals, start, parameter, before, probe))
        return column if np.isfinite(column).all() else np.zeros(column.size)

    rows = [*mapper(slopes, requests)]
    places, strangers = _list_strangers(log_residuals, parameters, variant_count)
    return np.array([*rows, *strangers, np.concatenate(before)]), places


def _list_strangers(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet, first: int
) -> tuple[dict[str, Int1D], list[Float1D]]:
    """Return (columns by place, counted from `first`; the columns) of the stranger."""
    entries: dict[str, list[list[Float1D]]] = {}
    by_log = [compute_stranger_forces(residuals, parameters) for residuals in log_residuals]
    common = [place for place in by_log[0] if all(place in forces for forces in by_log)]
    for place in common:
        entries[place] = [
            [
                residuals.enter_forces(force)
                for residuals, force in zip(log_residuals, of_logs, strict=True)
            ]
            for of_logs in zip(*(forces[place] for forces in by_log), strict=True)
        ]
    columns: list[Float1D] = []
    places: dict[str, Int1D] = {}
    for place, parts in entries.items():
        # those without an entry too: a copy of the noise must have the same columns
        own = [np.concatenate(part) for part in parts]
        places[place] = first + len(columns) + np.arange(len(own))
        columns += own
    return places, columns


def _number_units(log_residuals: Sequence[LogResiduals]) -> Int1D:
    """Return the unit of each entry of all logs, (entry,): steps, or blocks outside steps."""
    parts, first = [], 0
    for residuals in log_residuals:
        unit = assign_units(residuals)
        parts.append(first + unit)
        first += int(unit.max()) + 1
    return np.concatenate(parts)


def _measure_force(log_residuals: Sequence[LogResiduals]) -> float:
    """Return the norm of the measured forces over the noise."""
    squares = sum(float(np.sum(residuals.measured_entries**2)) for residuals in log_residuals)
    return math.sqrt(max(squares, 1e-300))
