"""Verdict on a specimen: what beside its evidence qualifies it, and the next test."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace

from twin.discovery.cross_checks import is_of_contact
from twin.discovery.hidden_effects import (
    FORCE_LAWS,
    MAX_HIDDEN_SHARE,
    UndetectedEffect,
    find_blind_spots,
)
from twin.discovery.parameters import (
    ParameterKey,
    is_correction,
)
from twin.discovery.selection import MIN_VISIBLE_EXCESS, FittedSet, SelectionResult
from twin.evidence.verdict import SelectionVerdict
from twin.laws.library import EFFECTS, load_plugins


@dataclass(frozen=True, eq=False)
class DiscoveryVerdict(SelectionVerdict[FittedSet]):
    """Verdict on a specimen, with the numbers behind it (mean squares over the noise)."""

    floor: float
    # force laws that could be there without a trace, where nothing is named
    blind_to: tuple[UndetectedEffect, ...] = ()
    # standard deviations that an inexact form of the named laws may cause unseen
    form_errors: Mapping[ParameterKey, float] = field(default_factory=dict)

    @classmethod
    def of(cls, verdict: SelectionVerdict[FittedSet], floor: float) -> "DiscoveryVerdict":
        """Return a verdict with the mean square that noise alone leaves, over the noise."""
        own = {each.name: getattr(verdict, each.name) for each in fields(verdict)}
        return cls(**own, floor=floor)

    @property
    def is_decided(self) -> bool:
        """True if the effects are named, or none, and nothing remains or could hide at its size."""
        is_closed = self.outcome in ("none", "named") and not self.has_remainder
        return is_closed and not self.blind_to


def widen_for_form(verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict with the error of an inexact form of the named force laws.

    What such a form leaves of the residual squares it has also put into the parameters of the same
    place, damper or bumpers: as much, in equal parts in each direction. The intervals hold it where
    it is visible; what is too little to be seen is stated, but widens nothing.
    """
    best = verdict.best
    laws = [each.effect for each in best.effects if each.effect.acts in FORCE_LAWS]
    is_bumper = {law.is_in_bumpers for law in laws}
    if verdict.outcome != "named" or not is_bumper:
        return verdict
    fit = best.fit
    keys = [
        free.key
        for free in fit.free
        if not is_correction(free.key) and is_of_contact(free.key, fit.parameters) in is_bumper
    ]
    per_direction = sum(values.size for values in best.held_out) / len(keys)
    visible = max(best.cost - (1 + MIN_VISIBLE_EXCESS) * verdict.floor, 0.0)
    hidden = max(best.cost / verdict.floor - 1, MIN_VISIBLE_EXCESS) * verdict.floor
    std_errors = dict(fit.std_errors)
    for key in keys:
        form_error = math.sqrt(visible * per_direction) * fit.white_errors[key]
        std_errors[key] = math.hypot(std_errors[key], form_error)
    form_errors = {key: math.sqrt(hidden * per_direction) * fit.white_errors[key] for key in keys}
    widened = replace(best, fit=replace(fit, std_errors=std_errors))
    return replace(verdict, best=widened, form_errors=form_errors)


def qualify_none(selection: SelectionResult, verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict "none" with the force laws to which the recordings are blind, if any.

    They do not exclude these, so its confidence is at most that of a guess.
    """
    if verdict.outcome != "none":
        return verdict
    blind = find_blind_spots(selection.evidence, verdict.best)
    if not blind:
        return verdict
    names = ", ".join(effect.candidate.name for effect in blind)
    reason = (
        f"{verdict.reason}, but the recordings cannot show {names}: other parameters imitate "
        f"{'them' if len(blind) > 1 else 'it'}, even as large as {100 * MAX_HIDDEN_SHARE:.0f} % of "
        "the measured force"
    )
    return replace(verdict, reason=reason, blind_to=blind)


def closed_fraction(before: float, after: float, floor: float) -> float:
    """Return the share of a misfit over its floor that is closed; rms values."""
    return (before - after) / (before - floor) if before > floor else 0.0


def suggest_next_run(
    outcome: str,
    best: Sequence[str],
    alternatives: Sequence[Sequence[str]],
    blind_to: Sequence[str] = (),
) -> str:
    """Suggest the test that would distinguish, confirm or show the effects."""
    if blind_to:
        return f"a sweep over other frequencies and levels, to show {', '.join(blind_to)}"
    names = {name.split(".")[0] for names in (best, *alternatives) for name in names}
    if outcome == "none":
        return "no further test is needed; a sweep at another amplitude would confirm the result"
    effects = [effect for effect in (*EFFECTS, *load_plugins()) if effect.id in names]
    in_damper = [effect for effect in effects if effect.place == "damper"]
    if any(effect.dissipates and not effect.has_resonance for effect in in_damper):
        return (
            "the same sweep at half and at twice the amplitude: hysteresis and friction change "
            "with amplitude, relaxation only with frequency"
        )
    if any(effect.acts == "sensor" for effect in effects):
        return "a calibration of the channels named, then the same sweep"
    in_bumpers = [effect for effect in effects if effect.is_in_bumpers]
    if any(effect.changes or effect.gap_rate for effect in in_bumpers):
        return "the same sweep again with the set-up unchanged, then with another gap"
    if in_bumpers:
        return "a sweep at twice the amplitude: deeper contact at higher speed"
    return "the same sweep at another amplitude and, where there are bumpers, another gap"
