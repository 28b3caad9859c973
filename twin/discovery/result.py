"""Results of discovery as classes: the contents of verdict.json, identify.json, features.json.

Each is computed, drawn, printed and written as it is; a key is written here only.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Literal

from pydantic import Field

from twin.results.contract import (
    Contract,
    Hertz,
    Minutes,
    Number,
    Ratio,
    Real,
    Seconds,
    declare_unit,
)

REFITTED_BASE = "the refitted base"
Misfit = Annotated[Real, declare_unit("1")]  # or another ratio that is always computed


class Interval(Contract):
    """Fitted value with its 95 % interval; null without one, as where too few cycles tell."""

    value: Real = Field(description="estimate, in `unit`")
    low: Number = Field(description="lower end, in `unit`")
    high: Number = Field(description="upper end, in `unit`")
    unit: str = Field(description="unit of the three numbers; empty for a ratio")

    @property
    def half_width(self) -> float | None:
        """Half of the interval, in `unit`; None without one."""
        return None if self.low is None or self.high is None else 0.5 * (self.high - self.low)


class EffectResult(Contract):
    """Effect that the model lacks."""

    id: str = Field(description="id in the library of effects")
    channel: str | None = Field(None, description="of a sensor effect; absent for others")
    confidence: Misfit = Field(
        description="probability that the effects are all that the model lacks, 0 to 1"
    )
    parameters: dict[str, Interval] = Field(description="fitted parameters")
    slip_speed: Interval | None = Field(None, description="only of Coulomb friction")

    @property
    def name(self) -> str:
        """Name among the candidates: the id, with the channel of a sensor effect."""
        return ".".join(filter(None, (self.id, self.channel)))


class CandidateResult(Contract):
    """Set of effects that was refitted."""

    id: str = Field(description="its effects, joined by +, or `nothing added`")
    held_out_error: Misfit = Field(description="rms cross-validation residual over the noise")
    converged: bool = Field(description="whether the fit converged")
    at_bound: list[str] = Field([], description="parameters at a bound; absent if none")


class Location(Contract):
    """Where model and measurement disagree; empty or null if nowhere."""

    frequency_hz: Annotated[list[Hertz], Field(min_length=2, max_length=2)] | None = Field(
        description="lowest and highest frequency"
    )
    direction: str = Field(description="forward, backward or both")
    phase: str = Field(description="flight, contact_right, contact_left, contact_both or all")
    channels: list[str] = Field(description="residual rows")
    harmonics: list[int] = Field(description="orders of the forcing frequency")


class Gap(Contract):
    """Misfit of model and measurement: rms residual over the sensor noise."""

    metric: str = Field(description="definition of the numbers")
    given: Misfit = Field(
        math.nan, description="of the model as given, without any fit; null in old files"
    )
    before: Misfit = Field(description="of the model, on all data")
    after: Misfit = Field(description="with the effects added, on all data")
    noise_floor: Misfit = Field(description="residual that noise alone leaves")
    held_out_before: Misfit = Field(description="of the model, cross-validation")
    held_out_after: Misfit = Field(description="with the effects added, cross-validation")
    closed_fraction: Misfit = Field(
        description="share of the misfit above the noise that the effects remove"
    )


class MisfitStep(Contract):
    """Step of the staircase from the model as given to the noise floor."""

    label: str = Field(description="what was changed last")
    misfit: Misfit = Field(description="rms residual over the noise, held out where it was fitted")


class ExcludedSet(Contract):
    """Effects that were fitted in place of those of the verdict, and fit worse."""

    id: str = Field(description="its effects, joined by +")
    held_out_error: Misfit = Field(description="rms cross-validation residual over the noise")
    sigma: Misfit = Field(description="standard errors by which it is worse")


class Remainder(Contract):
    """Part of the misfit that remains."""

    unexplained: bool = Field(description="whether it exceeds an inexact force law")


class ExplanationResult(Contract):
    """Explanation of the recordings with its probability."""

    effects: list[str] = Field(description="its effects; empty for none")
    stranger: str = Field(description="place of an unknown force beside them; empty without one")
    probability: Misfit = Field(description="of this explanation among all that were compared")


class ExcludedSize(Contract):
    """Largest effect that the recordings exclude beyond: the end of its 95 % interval."""

    id: str = Field(description="the effect")
    parameter: str = Field(description="its amplitude")
    value: Real = Field(description="largest deviation from no effect, in `unit`")
    unit: str = Field(description="unit of the value")
    force_share: Misfit = Field(description="rms force of it over that of the record")


class FittedNuisance(Contract):
    """Error of an instrument or of the set-up that was fitted beside the model."""

    log: str = Field(description="name of the log")
    kind: str = Field(description="its form")
    place: str = Field(description="its channel or side")
    value: Real = Field(description="size in its unit")
    unit: str = Field(description="SI unit of the value")
    typical: Misfit = Field(description="size over that of an ordinary laboratory")


class HeldOutLog(Contract):
    """Errors of the damper force on a log that was held out entirely."""

    log: str = Field(description="name of the log")
    nrmse_given: Ratio = Field(None, description="of the model as given, not fitted")
    nrmse_before: Misfit = Field(description="of the model, refitted to the other logs")
    nrmse_after: Misfit = Field(description="with what was found: effects, or the proposed law")
    noise_floor: Misfit = Field(
        math.nan, description="what the noise of the sensors alone would leave"
    )


class SensorCheckResult(Contract):
    """Checked quantity of an instrument, see `twin.discovery.sensor_checks`."""

    log: str = Field(description="name of the log")
    kind: str = Field(description="checked quantity")
    channels: list[str] = Field(description="its channels, or the side of a gap")
    value: Real = Field(description="estimate, in `unit`")
    low: Real = Field(description="lower end of its 95 % interval, in `unit`")
    high: Real = Field(description="upper end of its 95 % interval, in `unit`")
    unit: str = Field(description="unit of the numbers; empty for a ratio")
    limit: Number | None = Field(description="size that is allowed; null if there is no limit")
    healthy: bool = Field(description="whether the interval reaches the allowed sizes")


class Sensors(Contract):
    """Verdict on the instruments, apart from the physics of the specimen."""

    state: Literal["healthy", "to be mended"] = Field(description="of all instruments together")
    checks: list[SensorCheckResult] = Field(description="what was checked")


class LawTerm(Contract):
    """Term of a proposed law: an effect file next to the model file."""

    id: str = Field(description="name of the effect and of its file")
    title: str = Field(description="the law in words")
    place: str = Field(description="where it acts")
    force: str = Field(description="expression of the force in N, or acceleration in m/s2")
    states: dict[str, str] = Field(description="expressions of the rates of internal states")
    parameters: dict[str, Interval] = Field(description="fitted parameters and references")
    range: dict[str, tuple[Real, Real]] = Field(description="measured range of the variables, SI")


class LawClass(Contract):
    """Best law of a class."""

    law_class: str = Field(description="class of laws")
    id: str = Field(description="best law of the class")
    held_out_error: Misfit = Field(description="rms over the noise, on held-out steps")


class ProposedLaw(Contract):
    """Law for what no effect of the library explains."""

    terms: list[LawTerm] = Field(description="terms of the law, added up")
    with_effects: list[str] = Field(description="effects of the library that it needs")
    base: dict[str, Interval] = Field(description="refitted parameters of the model with it")
    law_class: str = Field(description="class of the law")
    held_out_before: Misfit = Field(description="misfit without the law, on held-out steps")
    held_out_after: Misfit = Field(description="misfit with it")
    noise_floor: Misfit = Field(description="misfit that noise alone leaves")
    closed_fraction: Misfit = Field(description="share of the misfit over the floor that it closes")
    sufficient: bool = Field(description="whether it leaves hardly more than the floor")
    nearest: str = Field(description="best single effect of the library")
    classes: list[LawClass] = Field(description="best law of each class, best first")


class ExpectedPeak(Contract):
    """Predicted peak of the relative displacement in a step or window of a test."""

    frequency_hz: Annotated[Number, declare_unit("Hz")] = Field(
        description="of the step; null in a displacement history"
    )
    direction: str = Field(description="of the step, or the window of a history")
    peak_disp_m: Annotated[Real, declare_unit("m")] = Field(
        description="largest displacement of the mass against the table"
    )


class RivalPrediction(Contract):
    """Explanation that the recordings leave open, with what a test is expected to show of it."""

    id: str = Field(description="its effects, joined by +")
    misfit: Ratio = Field(description="rms residual over the noise if another is true; or null")
    sigma: Ratio = Field(description="standard errors by which the rest is worse if true; or null")
    peaks: list[ExpectedPeak] = Field(description="if it is true; empty if it is no whole model")


class OtherTest(Contract):
    """Test that was compared with the proposed one."""

    title: str = Field(description="what is played")
    minutes: Minutes = Field(description="expected duration in min")
    sigma: Misfit = Field(description="expected separation in standard errors")
    probability: Misfit = Field(description="that it decides")


class DecisiveTest(Contract):
    """Test proposed by `discover --decide`, with what is expected of it."""

    title: str = Field(description="what is played")
    purpose: str = Field(description="what it decides")
    profile: str = Field(description="file of its profile")
    set_up: str = Field(description="change by hand before it; empty for none")
    confirmation: bool = Field(description="whether nothing is open and it looks for more effects")
    minutes: Minutes = Field(description="expected duration in min")
    sigma: Misfit = Field(description="expected separation in standard errors")
    probability: Misfit = Field(description="that it decides; of a confirmation per hidden effect")
    separation_per_min: Misfit = Field(description="expected log likelihood ratio a minute")
    count: int = Field(description="tests that were compared")
    rivals: list[RivalPrediction] = Field(description="explanations, that of the verdict first")
    others: list[OtherTest] = Field(description="the next best tests")


class ChainLink(Contract):
    """Verdict in a chain of tests, and the test that was played before it."""

    played: str = Field(description="test that was played for it; empty for the first")
    minutes: Minutes = Field(description="duration of that test in min")
    probability: Ratio = Field(description="that was stated for a decision; null for the first")
    log: str = Field(description="recording of that test; empty for the first")
    verdict: str = Field("", description="none, named, ambiguous or unexplained")
    effects: list[str] = Field([], description="effects of the verdict")
    confidence: Ratio = Field(None, description="of its effects; null without any")


class Verdict(Contract):
    """verdict.json of a discovery."""

    verdict: Literal["none", "named", "ambiguous", "unexplained"] = Field(
        description="whether the missing effects could be named"
    )
    why: str = Field(description="reason of the verdict")
    confidence: Ratio = Field(None, description="probability of the verdict; absent in old files")
    effects: list[EffectResult] = Field(description="effects added to the model")
    ambiguous: list[list[str]] = Field(description="sets of effects that fit as well")
    candidates: list[CandidateResult] = Field(description="every refitted set, best first")
    where: Location = Field(description="where model and measurement disagree")
    gap: Gap = Field(description="misfit before and after")
    staircase: list[MisfitStep] = Field(
        [], description="misfit from the model as given to the noise floor; absent in old files"
    )
    probability: list[ExplanationResult] = Field(
        [], description="explanations, the most probable first; absent in old files"
    )
    excludes: list[ExcludedSize] = Field(
        [], description="how large each other effect can be at most; absent in old files"
    )
    nuisances: list[FittedNuisance] = Field(
        [], description="errors of instruments beyond their typical size; absent in old files"
    )
    excluded: list[ExcludedSet] = Field(
        [], description="rivals of the effects, best first; absent in old files"
    )
    remainder: Remainder = Field(description="part of the misfit that remains")
    law: ProposedLaw | None = Field(
        None, description="law for what no effect explains; absent in old files"
    )
    sensors: Sensors = Field(
        Sensors(state="healthy", checks=[]), description="on the instruments; absent in old files"
    )
    base: dict[str, Interval] = Field(description="refitted parameters of the given model")
    fell_away: dict[str, str] = Field(description="reason of each effect that was not tested")
    notes: list[str] = Field(description="notes to the user")
    blind_to: list[str] = Field(
        [], description="effects that could be there without a trace; absent in old files"
    )
    form_errors: dict[str, Real] = Field(
        {},
        description="half of the 95 % interval of each parameter, in its SI unit, for a law that "
        "has another form than in the library, unseen; absent in old files",
    )
    next_run: str = Field(description="test that would decide or confirm")
    seconds: Seconds = Field(description="computing time")
    held_out_logs: list[HeldOutLog] = Field(description="of the logs given to judge the result")
    decide: DecisiveTest | None = Field(
        None, description="test of `--decide`; null where none separates, absent without the option"
    )
    chain: list[ChainLink] | None = Field(
        None, description="verdicts so far, this one last; absent without `--run`"
    )


class EstimatedParameter(Interval):
    """Identified parameter of the specimen, compared with the start model."""

    cycles: Annotated[Real, declare_unit("1")] | None = Field(
        None, description="cycles or contacts that determine it; absent where all samples do"
    )
    start: Real | None = Field(None, description="value of the start model, in `unit`")
    deviations: Ratio = Field(None, description="difference from it in standard deviations")


class IdentifiedGap(Contract):
    """Total gap of a log: stated, and of each side; with its interval where contacts tell."""

    stated: Real | None = Field(
        description="in the test profile, in `unit`; null where load cells show it"
    )
    unit: str = Field(description="unit of the numbers")
    right: Real = Field(description="gap of the right side, in `unit`")
    left: Real = Field(description="gap of the left side, in `unit`")
    value: Real | None = Field(None, description="fitted total gap, in `unit`")
    low: Number = Field(None, description="lower end of its 95 % interval, in `unit`")
    high: Number = Field(None, description="upper end of its 95 % interval, in `unit`")

    @property
    def interval(self) -> Interval | None:
        """The fitted gap; None without contact."""
        if self.value is None:
            return None
        return Interval(value=self.value, low=self.low, high=self.high, unit=self.unit)


class CorrelatedPair(Contract):
    """Two strongly correlated parameters."""

    of: list[str] = Field(description="their names")
    value: Misfit = Field(description="correlation")


class SubsetParameters(Contract):
    """Estimates from a subset of the samples."""

    source: str = Field(description="the subset")
    entries: int = Field(description="number of its residuals")
    converged: bool = Field(description="whether the fit converged")
    parameters: dict[str, Interval] = Field(description="by parameter")


class ContactGap(Interval):
    """Gap of a side from the positions of its contacts."""

    log: str = Field(description="name of the log")
    side: str = Field(description="right or left")
    kind: str = Field(description="onset or release")
    scatter: Real = Field(description="standard deviation of a contact, in `unit`")
    count: int = Field(description="contacts")
    correction: Real = Field(description="mean compression at the threshold, in `unit`")


class WindowMisfit(Contract):
    """Error of u over windows restarted from the measured state, over its rms."""

    log: str = Field(description="name of the log")
    window_s: Seconds = Field(description="length of a window")
    nrmse_start: Misfit = Field(description="of the start model")
    nrmse_identified: Misfit = Field(description="of the identified model")
    noise_floor: Misfit = Field(description="that noise alone leaves")


class IdentificationReport(Contract):
    """identify.json of an identification, in SI units."""

    method: str = Field(description="how the values were found")
    logs: list[str] = Field(description="names of the logs")
    parameters: dict[str, EstimatedParameter] = Field(description="of the specimen, by name")
    gaps: dict[str, IdentifiedGap] = Field(description="by log")
    zeros: dict[str, Interval] = Field(description="errors of the tare of each log")
    gap_offset: Interval | None = Field(description="right gap less left, half; null if unknown")
    correlations: list[CorrelatedPair] = Field(description="strongly correlated parameters")
    rms_over_noise: Misfit = Field(description="misfit in multiples of the noise")
    converged: bool = Field(description="whether the fit converged")
    at_bound: list[str] = Field(description="parameters at a bound")
    not_determined: list[str] = Field(description="parameters kept as in the start model")
    sources: list[SubsetParameters] = Field(description="estimates from subsets of the samples")
    contacts: list[ContactGap] = Field(description="gaps from single contacts")
    windows: list[WindowMisfit] = Field(description="misfit of u by log")
    sensors: Sensors = Field(description="on the instruments")
    warnings: list[str] = Field(description="disagreements of the estimates")
    notes: list[str] = Field(description="notes to the user")
    start: str = Field(description="name of the start model")
    seconds: Seconds = Field(description="computing time")


class PredictedFeatureResult(Contract):
    """What a model predicts for a feature."""

    text: str = Field(description="prediction in words")
    distance: Ratio = Field(description="distance from the feature in tolerances; null: none such")
    explained: bool = Field(description="whether the distance is at most 1")
    method: str = Field(description="continuation, stepped sweeps or simulation")


class FeatureResult(Contract):
    """A published feature, and what each model predicts for it."""

    kind: str = Field(description="kind of the feature, as in the features file")
    gap_m: Annotated[Number, declare_unit("m")] = Field(
        description="total gap; null without bumpers, and of permanent contact"
    )
    published: str = Field(description="feature in words")
    place: str = Field(description="where it is published")
    given: PredictedFeatureResult = Field(description="of the model as given")
    refitted: PredictedFeatureResult = Field(description="of the refitted base")
    best: PredictedFeatureResult = Field(description="of the best model")


class FeatureFitResult(Contract):
    """A fit of effects to the features."""

    effects: list[str] = Field(description="its added effects; empty: the base")
    explained: int = Field(description="number of features that it explains")
    gained: list[int] = Field(
        description="features that it explains and the refitted base does not"
    )
    lost: list[int] = Field(description="features that only the refitted base explains: the price")
    misfit: Misfit = Field(description="sum of log(1 + squared distance) of all features")
    parameters: dict[str, Interval] = Field(description="fitted parameters, base and effects")


class FeatureVerdict(Contract):
    """features.json of a discovery from features; features are numbered from 0."""

    verdict: Literal["none needed", "named", "ambiguous"] = Field(
        description="whether an effect explains more features than the refitted base, and one only"
    )
    why: str = Field(description="reason of the verdict")
    title: str = Field(description="title of the features file")
    citation: str = Field(description="source of the features")
    model: str = Field(description="title of the model")
    features: list[FeatureResult] = Field(description="every feature, in the file's order")
    given: FeatureFitResult = Field(description="model as given")
    refitted: FeatureFitResult = Field(description="its base refitted, without any effect")
    fits: list[FeatureFitResult] = Field(description="effects and pairs, best first")
    best: list[str] = Field(description="effects of the best model; empty: the refitted base")
    unexplained: list[int] = Field(description="features that the best model does not explain")
    next_run: str = Field(description="test that would decide between the best two")
    fell_away: dict[str, str] = Field(description="reason of each effect that was not tested")
    notes: list[str] = Field(description="notes to the user")
    seconds: Seconds = Field(description="computing time")

    @property
    def best_fit(self) -> FeatureFitResult | None:
        """The fit of the best effects; None if the refitted base is best."""
        return next((fit for fit in self.fits if fit.effects == self.best), None)


def name_fit(names: Sequence[str]) -> str:
    """Return the name of a fit: its effects, or that of the base."""
    return " + ".join(names) or REFITTED_BASE


def label_feature(entry: FeatureResult) -> str:
    """Return a feature of features.json with its gap."""
    gap_m = entry.gap_m
    if entry.kind == "permanent_contact_gap":
        return entry.published
    gap = "G∞" if gap_m is None else f"G{1e3 * gap_m:g}"
    return f"{gap}: {entry.published}"


def describe_fit(entry: FeatureFitResult, count: int) -> str:
    """Return a fit in a line: its effects, what it explains, and the price."""
    return (
        f"{name_fit(entry.effects)}: {entry.explained} of {count}, gains "
        f"{len(entry.gained)}, loses {len(entry.lost)}; misfit {entry.misfit:.2f}"
    )
