"""Noise that residuals show themselves about a fitted model, and what counts as its errors."""

import math
from dataclasses import replace

import numpy as np

from table_io.block import Float1D, Label
from twin.discovery.noise import BAND_COUNT, number_bands
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import CONTACT_ROWS, FORCE_ROWS, LogResiduals
from twin.evidence.linear import UNKNOWN_ERROR_SHARE
from twin.evidence.verdict import MAX_LEVEL

# Of the force of a law, rms: what its form in the library leaves of that of a specimen.
FORM_ERROR_SHARE = 0.02
MIN_CHANGES = 8  # values of a step that show the noise
CHANGE_ORDER = 3.0  # of a law whose force changes with the motion
# Power of a bumper's force over the noise of its row, up to the highest frequency of its facts:
# with less, noise of the motion would shift its slopes by a larger share than the inverse.
MIN_FACT_RATIO = 16.0


def limit_bumper_bands(residuals: LogResiduals, parameters: ParameterSet) -> LogResiduals:
    """Return the residuals up to where the forces of bumpers exceed the noise of their rows.

    It is the noise that they show about a fitted model. Above that frequency these rows are
    noise of the motion, which the parameters of the bumpers scale.
    """
    learned = learn_noise(residuals, parameters)
    measured = learned.measured_entries * learned.entry_weight
    bands = {}
    for name in CONTACT_ROWS:
        row = FORCE_ROWS.index(name)
        basis = residuals.bases[row]
        if basis is None or not basis.size:
            continue
        number = number_bands(basis.frequency_hz)
        squares = measured[learned.entry_row == row] ** 2
        power = np.bincount(number, squares) / np.maximum(np.bincount(number), 1)
        loud = number <= np.flatnonzero(power > MIN_FACT_RATIO).max(initial=0)
        bands[name] = float(basis.frequency_hz[loud].max(initial=0.0))
    return replace(residuals, row_bands=bands)


def learn_noise(
    residuals: LogResiduals, parameters: ParameterSet, base: ParameterSet | None = None
) -> LogResiduals:
    """Return the residuals with the noise that they show themselves about a fitted model.

    What does not repeat between the cycles of a step is noise, also where neither the rest nor
    a quiet band shows it: half the mean square of the difference of successive cycles, less
    what the motion itself did not repeat, the median over the steps. And instruments err by a
    share of the force in ways of which no nuisance is a form, the same in every cycle, as do
    the forms of the laws that the model has beside its `base`, of their own force: the weight
    counts these errors as noise of single steps.
    """
    r = residuals.evaluate(parameters) * residuals.entry_weight
    laws = (
        np.zeros(r.size) if base is None else residuals.evaluate(base) * residuals.entry_weight - r
    )
    # a sensor that others show to be louder is louder in the forces, too
    sensors = [row for row, name in enumerate(residuals.rows) if name not in FORCE_ROWS]
    forces = [row for row, name in enumerate(residuals.rows) if name in FORCE_ROWS]
    learned, louder = replace(residuals, nuisances=None), np.ones(r.size)
    for rows in (sensors, forces):
        scale = dict(learned.noise_scale)
        for row in rows:
            change = np.maximum(_measure_change(learned, row, r / louder), 1.0)
            name = residuals.rows[row]
            scale[name] = scale.get(name, np.ones(BAND_COUNT)) * np.sqrt(change)
        learned = replace(learned, noise_scale=scale)
        louder[: residuals.entry_noise.size] = learned.entry_noise / residuals.entry_noise
    terms = residuals.nuisances
    if terms is not None:
        columns = terms.columns / louder[: terms.columns.shape[1]]
        terms = replace(terms, columns=columns.astype(np.float32))
    weights, expected = _measure_errors(learned, (laws / louder)[: learned.entry_row.size])
    return replace(learned, weights=weights, expected_squares=expected, nuisances=terms)


def _measure_errors(
    residuals: LogResiduals, laws: Float1D
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the weights and the expected mean squares of the rows, by name.

    `laws`, (entry,), are the forces of the laws beside the base, over the noise: the form of
    a bumper's law is no error of the damper's.
    """
    read = (residuals.measured_entries * residuals.entry_weight) ** 2
    unknown = UNKNOWN_ERROR_SHARE**2 * float(read.sum()) / _count_different(residuals, read)
    weights = dict.fromkeys((*residuals.rows, "rest"), math.sqrt(1.0 + unknown))
    expected = dict.fromkeys(residuals.rows, weights["rest"] ** -2)
    for row, name in enumerate(residuals.rows):
        own = residuals.entry_row == row
        if name not in FORCE_ROWS or not own.any():
            continue
        squares, forms = read[own], laws[own] ** 2
        # laws that nearly cancel each other show no more of their form than what they explain
        forms *= min(1.0, float(squares.sum()) / max(float(forms.sum()), 1e-300))
        errors = UNKNOWN_ERROR_SHARE**2 * squares, FORM_ERROR_SHARE**2 * forms
        parts = [float(of.sum()) / _count_different(residuals, of) for of in errors]
        weights[name] = math.sqrt(1.0 + sum(parts))
        # a name must leave no more than instruments do, whatever form its law has
        expected[name] = (1.0 + float(errors[0].mean())) / weights[name] ** 2
    return weights, expected


def weigh_misfit(residuals: LogResiduals, parameters: ParameterSet) -> LogResiduals:
    """Return the residuals with what a fitted model leaves counted as noise of single steps.

    So the priors of the nuisances are not outvoted by a misfit that is no error of theirs. What
    may remain where a residual is said to be noise, up to MAX_LEVEL, is no misfit.
    """
    squares, factors = residuals.evaluate(parameters) ** 2, {}
    for row, name in enumerate(residuals.rows):
        own = squares[residuals.entry_row == row]
        noise = MAX_LEVEL * residuals.expected_squares.get(name, 1.0) * own.size
        excess = max(float(own.sum()) - noise, 0.0)
        factors[name] = math.sqrt(1.0 + excess / _count_different(residuals, own))
    factors["rest"] = max(factors.values())
    weights = {name: factor * residuals.weights.get(name, 1.0) for name, factor in factors.items()}
    return replace(residuals, weights=weights)


def _count_different(residuals: LogResiduals, squares: Float1D) -> float:
    """Return how many different errors entries with these squares are, (entry,).

    As many as there are large ones that do not repeat in each cycle of a step.
    """
    steps = np.unique(residuals.signals.step[residuals.signals.step >= 0]).size
    cycles = np.unique(residuals.sample_block[residuals.row_mask[0]]).size / max(steps, 1)
    large = float(squares.sum() ** 2 / max(squares @ squares, 1e-300))
    return max(large / (cycles if steps else 1.0), 1.0)


def _measure_change(residuals: LogResiduals, row: int, r: Float1D) -> Float1D:
    """Return the mean square over the noise that a row does not repeat, (band,); 1 if unknown.

    Bands with too few components have the value of the whole row.
    A motion that changes from cycle to cycle changes what a missing law leaves, by as large a
    share as the force, or `CHANGE_ORDER` times that for a law of so high an order.
    """
    basis, facts = residuals.bases[row], np.flatnonzero(residuals.entry_row == row)
    if basis is None or not facts.size:
        return np.ones(BAND_COUNT)
    sample, m = residuals.entry_sample[facts], residuals.motion()
    measured = (m.label[sample] == Label.MEASURE) & (m.step[sample] >= 0)
    variances: dict[int | None, list[float]] = {}  # of the steps, by band; None: of all bands
    force = residuals.measured_entries[facts] * residuals.entry_weight[facts]
    for number in np.unique(m.step[sample][measured]):
        chosen = measured & (m.step[sample] == number)
        cycles, index = np.unique(m.cycle[sample][chosen], return_inverse=True)
        order = basis.order[chosen]
        table = np.full((2, cycles.size, int(order.max(initial=0)) + 1), np.nan)
        table[:, index, order] = r[facts[chosen]], force[chosen]
        changes = np.diff(table, axis=1)
        if np.isfinite(changes[0]).sum() < MIN_CHANGES:
            continue
        changed_force = 0.5 * float(np.nanmean(changes[1] ** 2))
        share = changed_force / max(float(np.nanmean(table[1] ** 2)), 1e-300)
        bands = np.zeros(table.shape[2], dtype=np.int64)
        bands[order] = number_bands(basis.frequency_hz[chosen])
        for band in (None, *np.unique(bands[order]).tolist()):
            own = np.ones(bands.size, dtype=bool) if band is None else bands == band
            change = changes[0][:, own]
            if np.isfinite(change).sum() >= MIN_CHANGES:
                square = float(np.nanmean(table[0][:, own] ** 2))
                unsteady = CHANGE_ORDER**2 * share * square
                value = 0.5 * float(np.nanmean(change**2)) - unsteady
                variances.setdefault(band, []).append(value)
    medians = {band: float(np.median(values)) for band, values in variances.items()}
    whole = medians.pop(None, 1.0)
    return np.array([medians.get(band, whole) for band in range(BAND_COUNT)])
