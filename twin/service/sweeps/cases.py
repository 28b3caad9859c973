"""The cases of a batch: every model that is asked for, at every gap that is asked for."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from table_io.card import BadInput, find
from table_io.profile import Profile, Specimen
from twin.model.card import ModelCard
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.parameters import resonance
from twin.service.batch import at_gaps
from twin.service.bundle import read_model

MOST = 10_000
GAP_ALLOWED = "allowed: a number of mm, inf for no bumpers, or FROM:TO:STEP in mm, as 0:30:2"
SAME_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One model at one total gap; `label` is the model's name in every row and picture."""

    label: str
    gap_mm: float
    model: Model

    @property
    def name(self) -> str:
        return f"{self.label}, {gap_name(self.gap_mm)}"


def gap_name(gap_mm: float) -> str:
    """The gap as a person writes it."""
    return "no bumpers" if math.isinf(gap_mm) else f"G = {gap_mm:g} mm"


def gaps_mm(words: Sequence[str]) -> list[float]:
    """Total gaps in mm in the order of the words, ranges written out; BadInput where one is none
    or comes twice."""
    found: dict[float, str] = {}
    for word in words:
        for gap in _range(word) if ":" in word else [_number(word, word)]:
            if math.isnan(gap) or gap == -math.inf:
                raise BadInput(f"--gap {word}: {GAP_ALLOWED}")
            twin = next((one for one in found if one == gap or abs(one - gap) < SAME_MM), None)
            if twin is not None:
                raise BadInput(f"--gap {word}: {gap:g} mm is also in --gap {found[twin]}; keep one")
            found[gap] = word
    return list(found)


def _number(text: str, word: str) -> float:
    try:
        return float(text) + 0.0  # no -0
    except ValueError:
        raise BadInput(f"--gap {word}: {GAP_ALLOWED}") from None


def _range(word: str) -> list[float]:
    """Both ends of FROM:TO:STEP and what lies between, in mm."""
    ends = [_number(text, word) for text in word.split(":")]
    if len(ends) != 3 or not all(map(math.isfinite, ends)):
        raise BadInput(f"--gap {word}: {GAP_ALLOWED}")
    start, stop, step = ends
    if step == 0 or (stop - start) * step < 0:
        raise BadInput(f"--gap {word}: step {step:g} does not lead from {start:g} to {stop:g} mm")
    if (stop - start) / step > MOST:
        raise BadInput(f"--gap {word}: more than {MOST} gaps; give a longer step")
    whole = round((stop - start) / step)
    if abs(start + whole * step - stop) > SAME_MM:
        near = (stop - start) / max(whole, 1)
        raise BadInput(
            f"--gap {word}: step {step:g} does not divide {start:g} to {stop:g} mm; "
            f"nearest: {near:.6g}"
        )
    return [round(start + k * step, 9) + 0.0 for k in range(whole + 1)]


def models(words: Sequence[str], profile: Path) -> dict[str, tuple[ModelCard, str]]:
    """Label -> (card, its text) of each model; a file's label is its name without .toml."""
    paths = [find(word, "models", profile).resolve() for word in words]
    found: dict[str, tuple[ModelCard, str]] = {}
    for place, (word, path) in enumerate(zip(words, paths, strict=True)):
        if path in paths[:place]:
            raise BadInput(f"--model {word}: given twice; keep one")
        alone = [one.stem for one in paths].count(path.stem) == 1
        found[path.stem if alone else word.removesuffix(".toml")] = read_model(word, profile)
    return found


def cases(
    profile: Profile, cards: dict[str, tuple[ModelCard, str]], gaps: Sequence[float], where: str
) -> list[Case]:
    """The product: models in their order, each at every gap, or at the profile's without any."""
    if len(cards) * max(len(gaps), 1) > MOST:
        raise BadInput(
            f"{len(cards)} models at {len(gaps)} gaps: allowed: {MOST} cases; give fewer gaps"
        )
    found: list[Case] = []
    at_gap: dict[float, list[Case]] = {}
    for label, (card, _) in cards.items():
        for gap, model in _at(card, profile.specimen, gaps, f"{where}: model {label}"):
            case = Case(label, gap, model)
            for other in at_gap.setdefault(gap, []):
                if other.model == model:
                    raise BadInput(
                        f"{where}: models {other.label} and {label} are the same in every number; "
                        "keep one"
                    )
            at_gap[gap].append(case)
            _follows(case, profile, where)
            found.append(case)
    return found


def _at(
    card: ModelCard, specimen: Specimen, gaps: Sequence[float], where: str
) -> list[tuple[float, Model]]:
    """(total gap in mm, the model there) for each gap, or for the specimen's own."""
    try:
        own = card.model(specimen)
        if not gaps:
            return [(round(1e3 * sum(specimen.gaps_m), 9), own)]
        return list(zip(gaps, at_gaps(own, [gap / 1e3 for gap in gaps]), strict=True))
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


def _follows(case: Case, profile: Profile, where: str) -> None:
    """BadInput where the profile's sampling, or the sweep, cannot follow this model.

    A cycle at the slowest frequency is played: what must be compiled is compiled now.
    """
    model, slowest = case.model, profile.sweep.frequencies_hz[0]
    try:
        resonance(model.parameters, 1.0)
        model.fits(profile.acquisition.rate_hz)
        swept(model, [slowest], 0.0, 1)
    except BadInput as error:
        raise BadInput(f"{where}: {case.name}: {error}") from None
