"""Evidence of sets of effects: one linear Gaussian model of what a fitted model leaves.

About a fit the residual r is linear in the parameters of the base and the nuisances A, in the
amplitudes of every candidate B, and in a smooth unknown force T by place, the stranger, which
always competes. With Gaussian priors of the amplitudes the evidence of a set S is

    log E = 1/2 g (I + P)^-1 g - 1/2 log det(1 + P^-1 I),   I = S C^-1 S,   g = S C^-1 h,

S the products of its columns and h those with the residual, both after A has been absorbed, C the
covariance of h, P the precisions of the priors. The measured motion is noisy: what its noise adds
to S and h on average, from copies of the noise, is taken off, but it stays in C. Residuals that are
correlated, or louder than expected, count less: C is multiplied by their variance inflation, from
the scatter of the scores between units (steps) in the richest model.

MacKay, Information Theory, Inference, and Learning Algorithms, 2003, chapter 28; for errors in the
regressors Fuller, Measurement Error Models, 1987; for the inflation Kent, Biometrika 69, 1982.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.sparse import csr_array

from table_io.block import Float1D, Float2D, Int1D

INTERVAL_SIGMA = 1.96  # standard deviations either side: 95 %
UNKNOWN_ERROR_SHARE = 0.002  # of the force, rms: errors of instruments of no form that is known
EFFECT_SHARE = 0.1  # standard deviation of an effect's force over that of the record, before a test
STRANGER_SHARES = (0.003, 0.01, 0.03, 0.1)  # the same for the stranger, each as likely
# Probabilities before a test: of no effect, one, two and three, and of a stranger beside them.
SET_PRIORS = (0.5, 0.3, 0.15, 0.05)
STRANGER_PRIOR = 0.2
HATS, CROSSED_HATS = 9, 5  # of a stranger over one quantity, and where it has a product
PAIR_STARTS, TRIPLE_STARTS, STRANGER_STARTS = 40, 12, 12  # sets that are extended
RICHEST_EFFECTS = 3  # beside the stranger, in the model that shows the noise
MIN_BASE_SHARE = 1e-12  # of the curvature of the base: directions with less are left out
MIN_INFORMATION_SHARE = 1e-9  # of a column's norm: with less left, other parameters imitate it


class NamedCandidate(Protocol):
    """What a model may lack: an amplitude, with trial shapes of its other parameters."""

    @property
    def name(self) -> str: ...

    @property
    def shapes(self) -> tuple[tuple[float, ...], ...]: ...

    @property
    def used_keys(self) -> frozenset[object]:
        """What it changes of a model: candidates that share a key are never tried together."""
        ...


C = TypeVar("C", bound=NamedCandidate)


@dataclass(frozen=True)
class Variant(Generic[C]):
    """Candidate with one of its trial shapes."""

    candidate: C
    shape: tuple[float, ...]
    sign: int  # of the amplitudes allowed: +1, -1, or 0 for both


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Explanation: variants of candidates, by column, and the place of a stranger or ""."""

    columns: tuple[int, ...]
    place: str
    log_evidence: float


@dataclass(frozen=True, eq=False)
class LinearEvidence(Generic[C]):
    """Linear model about a fit: products after the base has been absorbed.

    `products` (column, column) and `scores` (column,) of candidates and stranger, over the noise,
    and the `covariance` of the scores; `scale` are the norms of the columns as they are.
    """

    variants: tuple[Variant[C], ...]
    places: Mapping[str, Int1D]  # columns of the stranger by place
    products: Float2D
    covariance: Float2D
    scores: Float1D
    scale: Float1D  # norm of each column before the base was absorbed
    force: float  # norm of the measured forces
    inflation: float  # of the covariance of the scores, which holds it
    level: float  # mean square over noise and unknown errors that the richest model leaves

    @cached_property
    def _precision(self) -> Float1D:
        """Precision of the prior of each column, (column,)."""
        return (self.scale / (EFFECT_SHARE * self.force)) ** 2

    def measure_set(self, columns: Sequence[int], place: str = "") -> float:
        """Return the log evidence of a set and a stranger against none, without prior odds."""
        chosen = [*columns]
        if not place:
            return self._measure(chosen, self._precision[chosen])
        extra = self.places[place]
        both = [*chosen, *extra.tolist()]
        precision, is_extra = self._precision[both], np.arange(len(both)) >= len(chosen)
        evidences = [
            self._measure(both, np.where(is_extra, (EFFECT_SHARE / share) ** 2, 1.0) * precision)
            for share in STRANGER_SHARES
        ]
        return float(np.logaddexp.reduce(evidences)) - math.log(len(evidences))

    def _inform(self, sets: Int1D) -> tuple[Float2D, Float2D]:
        """Return (information I (set, column, column), g (set, column)) of sets of columns."""
        rows, columns = sets[:, :, None], sets[:, None, :]
        s, c, h = self.products[rows, columns], self.covariance[rows, columns], self.scores[sets]
        solved = np.linalg.solve(c, np.concatenate([s, h[:, :, None]], axis=2))
        return s @ solved[:, :, :-1], (s @ solved[:, :, -1:])[:, :, 0]

    def _weigh(self, sets: Int1D, precision: Float2D) -> tuple[Float1D, Float2D, Float2D]:
        """Return (log evidence, amplitudes, standard deviations) of sets with their priors."""
        size = np.sqrt(precision)
        information, g = self._inform(sets)
        information /= size[:, :, None] * size[:, None, :]
        information += np.eye(sets.shape[1])
        g /= size
        solved = np.linalg.solve(information, g[:, :, None])[:, :, 0]
        _, determinant = np.linalg.slogdet(information)
        evidence = 0.5 * np.einsum("ni,ni->n", g, solved) - 0.5 * determinant
        variances = np.einsum("nii->ni", np.linalg.inv(information))
        return evidence, solved / size, np.sqrt(np.maximum(variances, 0.0)) / size

    def _measure(self, columns: Sequence[int], precision: Float1D) -> float:
        if not columns:
            return 0.0
        return float(self._weigh(np.array([columns]), precision[None, :])[0][0])

    def estimate(self, columns: Sequence[int]) -> tuple[Float1D, Float1D]:
        """Return (amplitudes, their standard deviations) of a set, (column,) each."""
        sets = np.array([columns])
        _, (amplitudes,), (deviations,) = self._weigh(sets, self._precision[sets])
        return amplitudes, deviations

    def find_column(self, candidate: C, shape: tuple[float, ...]) -> int | None:
        """Return the column of a candidate with a shape, or the nearest that is known."""
        own = [k for k, v in enumerate(self.variants) if v.candidate.name == candidate.name]
        exact = [k for k in own if self.variants[k].shape == shape]
        return next(iter(exact or own), None)

    def bound_amplitude(self, column: int, beside: Sequence[int]) -> tuple[float, float]:
        """Return (end of the 95 % interval of an amplitude, its force over that of the record).

        The end on the side of the estimate, or of the sign allowed. Beside the columns of other
        effects, and with no prior: what the recordings alone say.
        """
        chosen = [column, *(k for k in beside if k != column)]
        (information,), (g,) = self._inform(np.array([chosen]))
        size = np.sqrt(np.maximum(np.diag(information), 1e-300))
        covariance = np.linalg.pinv(information / np.outer(size, size), hermitian=True)
        covariance /= np.outer(size, size)
        amplitude = float(covariance[0] @ g)
        end = abs(amplitude) + INTERVAL_SIGMA * math.sqrt(max(float(covariance[0, 0]), 0.0))
        sign = self.variants[column].sign or math.copysign(1.0, amplitude)
        return sign * end, end * float(self.scale[column]) / self.force

    def measure_gain(self, columns: Sequence[int]) -> float:
        """Return the residual squares, over the inflation, that a set removes at its maximum."""
        (information,), (g,) = self._inform(np.array([columns]))
        return float(g @ np.linalg.lstsq(information, g, rcond=1e-12)[0])

    def names(self, state: Hypothesis) -> frozenset[str]:
        """Return the names of the effects of a state."""
        return frozenset(self.variants[c].candidate.name for c in state.columns)

    def log_prior(self, size: int, with_stranger: bool) -> float:
        """Return the log of the prior odds of a set of so many effects, against none."""
        count = len({variant.candidate.name for variant in self.variants})
        sets = math.log(max(math.comb(count, size), 1)) if size else 0.0
        odds = math.log(SET_PRIORS[min(size, len(SET_PRIORS) - 1)] / SET_PRIORS[0]) - sets
        if with_stranger:
            odds += math.log(STRANGER_PRIOR / (1 - STRANGER_PRIOR) / max(len(self.places), 1))
        return odds

    def rank_states(self, max_effects: int) -> list[Hypothesis]:
        """Return the explanations, the most probable first: sets, with and without a stranger."""
        columns = [k for k, _ in enumerate(self.variants) if self.scale[k] > 0]
        states = [Hypothesis((), "", 0.0)]
        layer = self._rank([(c,) for c in columns])
        states += layer
        for size in range(2, max_effects + 1):
            starts = PAIR_STARTS if size == 2 else TRIPLE_STARTS
            layer = self._rank(
                sorted(
                    {
                        tuple(sorted((*state.columns, c)))
                        for state in self._distinct(layer)[:starts]
                        for c in columns
                        if self.variants[c].candidate.name not in self.names(state)
                        and self._is_separate(state.columns, c)
                    }
                )
            )
            states += layer
        states = self._distinct(sorted(states, key=lambda state: -state.log_evidence))
        with_stranger = [
            Hypothesis(
                state.columns, place,
                self.measure_set(state.columns, place)
                - self._shape_count(state.columns)
                + self.log_prior(len(state.columns), True),
            )
            for state in states[:STRANGER_STARTS]
            for place in self.places
        ]  # fmt: skip
        return sorted((*states, *with_stranger), key=lambda state: -state.log_evidence)

    def _is_separate(self, columns: Sequence[int], column: int) -> bool:
        """Return True if the candidates share no parameter, and no coefficient of the solver."""
        own = self.variants[column].candidate.used_keys
        return all(own.isdisjoint(self.variants[c].candidate.used_keys) for c in columns)

    def _shape_count(self, columns: Sequence[int]) -> float:
        return sum(math.log(len(self.variants[c].candidate.shapes)) for c in columns)

    def _rank(self, sets: Sequence[tuple[int, ...]]) -> list[Hypothesis]:
        if not sets:
            return []
        table = np.array(sets)
        evidence, amplitudes, deviations = self._weigh(table, self._precision[table])
        signs = np.array([variant.sign for variant in self.variants])[table]
        allowed = (signs * amplitudes >= -deviations).all(axis=1)
        prior = self.log_prior(table.shape[1], False)
        order = np.argsort(-evidence)
        return [
            Hypothesis(tuple(table[k].tolist()), "", float(evidence[k])
                  - self._shape_count(table[k].tolist()) + prior)
            for k in order
            if allowed[k]
        ]  # fmt: skip

    def _distinct(self, states: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return the best state of each set of names and place, in the same order."""
        best: dict[tuple[frozenset[str], str], Hypothesis] = {}
        for state in states:
            best.setdefault((self.names(state), state.place), state)
        return [*best.values()]


def absorb_base(
    columns: Float2D, noise: Float2D, base: int, unit: Int1D, variants: tuple[Variant[C], ...],
    places: dict[str, Int1D], force: float, rich: Sequence[int], expected: Float1D,
    unknown_share: float = 0.0,
) -> LinearEvidence[C]:  # fmt: skip
    """Return the linear model; `columns` are those of base, candidates, stranger, and the residual.

    `noise` are the products of the noise in the columns, which the measured products contain too:
    a column that is left with noise alone would explain the noise of the residual.
    """
    scale = np.sqrt(np.einsum("ij,ij->i", columns, columns))
    scale[-1] = 1.0
    columns = columns / np.maximum(scale, 1e-300)[:, None]
    sizes = np.outer(scale, scale)
    noise = np.divide(noise, sizes, out=np.zeros_like(noise), where=sizes > 0)
    raw = columns @ columns.T
    gram = raw - noise
    u, s, _ = np.linalg.svd(gram[:base, :base], hermitian=True)
    kept = s > MIN_BASE_SHARE * max(float(s.max(initial=0.0)), 1e-300)
    inverse = (u[:, kept] / s[kept]) @ u[:, kept].T
    absorbed = inverse @ gram[:base, base:]
    reduced = gram[base:, base:] - gram[base:, :base] @ absorbed
    rest = columns[base:] - absorbed.T @ columns[:base]
    own_scale, count = scale[base:-1], len(variants)
    products = reduced[:-1, :-1] * np.outer(own_scale, own_scale)
    scores = -reduced[:-1, -1] * own_scale
    # columns that are noise, or that the base imitates, have nothing left
    is_left = np.diag(reduced)[:-1] > MIN_INFORMATION_SHARE
    for of_place in places.values():  # a hat without samples is rounding alone
        own = own_scale[of_place]
        is_left[of_place] &= own**2 > MIN_INFORMATION_SHARE * own.max(initial=0.0) ** 2
    products[~is_left], products[:, ~is_left], scores[~is_left] = 0.0, 0.0, 0.0
    rest[:-1] *= is_left[:, None]
    usable = np.where(is_left, own_scale, 0.0)
    kept_share = np.append(is_left, True)
    raw, chance = (
        _absorb(of, absorbed, base) * np.outer(kept_share, kept_share) for of in (raw, noise)
    )
    inflation, level = _measure_inflation(rest, raw, unit, count, rich, expected)
    covariance = inflation * (raw + chance)[:-1, :-1] * np.outer(own_scale, own_scale)
    covariance += np.diag(np.where(is_left, MIN_INFORMATION_SHARE * own_scale**2, 1.0))
    covariance += cover_unknown_errors(variants, products, usable, force, unknown_share)
    places = {
        place: columns_of[is_left[columns_of]]
        for place, columns_of in places.items()
        if is_left[columns_of].any()
    }
    return LinearEvidence(
        variants, places, _make_positive(products), covariance, scores, usable, force, inflation,
        level,
    )  # fmt: skip


def cover_unknown_errors(
    variants: Sequence[Variant[C]], products: Float2D, scale: Float1D, force: float, share: float
) -> Float2D:
    """Return the covariance of the scores if errors of no known form imitate every effect.

    Each candidate by `share` of the force of the record, rms, whichever explanation is right.
    """
    names = [variant.candidate.name for variant in variants]
    count = np.array([names.count(name) for name in names])
    amplitude = np.zeros(scale.size)
    own = scale[: count.size]
    amplitude[: count.size] = np.divide(
        share * force, own * np.sqrt(count), out=np.zeros(own.size), where=own > 0
    )
    imitated = products * amplitude
    return imitated @ imitated.T


def _absorb(products: Float2D, absorbed: Float2D, base: int) -> Float2D:
    """Return the products of columns, less those of the base that they contain."""
    mixed = absorbed.T @ products[:base, base:]
    return products[base:, base:] - mixed - mixed.T + absorbed.T @ products[:base, :base] @ absorbed


def _make_positive(products: Float2D) -> Float2D:
    """Return the nearest products without negative curvature, which chance may leave."""
    size = np.sqrt(np.maximum(np.diag(products), 1e-300))
    values, vectors = np.linalg.eigh(products / np.outer(size, size))
    positive = (vectors * np.maximum(values, 0.0)) @ vectors.T
    return positive * np.outer(size, size)


def _measure_inflation(
    rest: Float2D, products: Float2D, unit: Int1D, count: int, rich: Sequence[int],
    expected: Float1D,
) -> tuple[float, float]:  # fmt: skip
    """Return (variance inflation of scores, level) of what the richest model leaves.

    That model has the stranger at every place, the columns `rich`, and the candidates that explain
    most beside them, because no smooth force has the jump of a friction: what is left scatters
    between the units (steps) more than its samples say where these are correlated. `rest` are the
    `count` candidates, the stranger and the residual, (column, entry), `products` those of its
    rows.
    """
    chosen = [*rich, *range(count, len(rest) - 1)]
    for added in range(RICHEST_EFFECTS + 1):
        known = products[chosen]
        solution = np.linalg.lstsq(known[:, chosen], known, rcond=1e-8)[0]
        if added == RICHEST_EFFECTS:
            break
        unexplained = products[:count, -1] - known[:, :count].T @ solution[:, -1]
        square = np.diag(products)[:count] - (known * solution).sum(axis=0)[:count]
        gain = np.where(square > MIN_INFORMATION_SHARE, unexplained**2, 0.0)
        chosen += np.argsort(-gain / np.maximum(square, MIN_INFORMATION_SHARE))[:1].tolist()
    left = rest[-1] - solution[:, -1] @ rest[chosen]
    level = float(np.mean(left**2 / expected))
    columns = rest[:count][rest[:count].any(axis=1)]
    by_unit = csr_array((np.ones(unit.size), (unit, np.arange(unit.size))))
    own, sums = by_unit @ (columns**2).T, by_unit @ (columns * left).T
    whole = own.sum(axis=0)
    sums -= own * sums.sum(axis=0) / whole
    effective = whole**2 / (own**2).sum(axis=0)
    scatter = (sums**2).sum(axis=0) * effective / np.maximum(effective - 1.0, 1.0)
    ratios = scatter / np.maximum(columns**2 @ left**2, 1e-300)
    correlated = float(np.median(ratios)) if ratios.size else 1.0
    return max(1.0, correlated) * max(1.0, level), level


def softmax(states: Sequence[Hypothesis]) -> Float1D:
    """Return the probability of each state, (state,)."""
    logs = np.array([state.log_evidence for state in states])
    return np.exp(logs - np.logaddexp.reduce(logs))


def list_hats(x: Float1D, count: int) -> list[Float1D]:
    """Return hat functions over -1 to 1 of a series, (sample,) each."""
    knots = np.linspace(-1.0, 1.0, count)
    width = knots[1] - knots[0]
    return [
        np.clip(1.0 - np.abs(np.clip(x, -1.0, 1.0) - knot) / width, 0.0, None) for knot in knots
    ]
