"""Effects that may be present although recordings do not show them: hidden by noise or by the base.

Each as large as its 95 % interval in the linear model about a fitted set allows. A law that K, C
and the other free parameters imitate, as they do any law at one frequency and one amplitude, has an
interval without end: the recordings are blind to it, and that the residual is noise says nothing
about it.
"""

import math
from dataclasses import dataclass, replace

from twin.discovery.candidates import Candidate
from twin.discovery.selection import FittedSet
from twin.evidence.linear import LinearEvidence

FORCE_LAWS = ("force", "linear")  # by `Effect.acts`: what has a form and a size
# Largest force of an effect that recordings may hide, of that of the record (rms). At 5 % of noise
# a sweep hides 2 % at most, one frequency 6 to 8 %.
MAX_HIDDEN_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class UndetectedEffect:
    """Effect as large as the recordings may hide it: the end of the 95 % interval of its amplitude.

    `deviation` from no effect is in the unit of the amplitude; `share` is the rms of its force over
    that of the record.
    """

    candidate: Candidate
    shape: tuple[float, ...]
    deviation: float
    share: float

    @property
    def amplitude(self) -> float:
        """Amplitude within its bounds."""
        free = self.candidate.amplitude
        return min(max(self.candidate.vanishing + self.deviation, free.low), free.high)

    def limit(self, share: float) -> "UndetectedEffect":
        """Return the effect with at most this share of the record's force."""
        factor = min(share / self.share, 1.0)
        return replace(self, deviation=factor * self.deviation, share=factor * self.share)


def bound_effects(
    linear: LinearEvidence[Candidate] | None, best: FittedSet
) -> list[list[UndetectedEffect]]:
    """Return each effect that is not in a set in all its forms, the one that shows best first.

    `linear` is about that set.
    """
    if linear is None:
        return []
    kept = [linear.find_column(effect, best.find_shape(effect)) for effect in best.effects]
    beside = [column for column in kept if column is not None]
    forms: dict[str, list[UndetectedEffect]] = {}
    for column, variant in enumerate(linear.variants):
        if variant.candidate.name in best.names or not linear.scale[column] > 0:
            continue
        end, share = linear.bound_amplitude(column, beside)
        forms.setdefault(variant.candidate.name, []).append(
            UndetectedEffect(variant.candidate, variant.shape, end, share)
        )
    return [sorted(each, key=lambda form: form.share) for each in forms.values()]


def find_hidden_effects(
    linear: LinearEvidence[Candidate] | None, best: FittedSet
) -> tuple[UndetectedEffect, ...]:
    """Return each further force law as large as the noise may hide it, where it is not blind."""
    clearest = [forms[0] for forms in bound_effects(linear, best)]
    return tuple(
        each for each in clearest if math.isfinite(each.share) and not each.candidate.channel
    )


def find_blind_spots(
    linear: LinearEvidence[Candidate] | None, best: FittedSet
) -> tuple[UndetectedEffect, ...]:
    """Return the force laws that could be large in any form without leaving more than noise.

    Each as large as `MAX_HIDDEN_SHARE` of the record, in the form that the recordings show best.
    """
    clearest = [forms[0] for forms in bound_effects(linear, best)]
    return tuple(
        each.limit(MAX_HIDDEN_SHARE)
        for each in clearest
        if each.candidate.effect.acts in FORCE_LAWS and each.share > MAX_HIDDEN_SHARE
    )
