"""The campaign's file, and every run of it checked before anything moves."""

import difflib
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, ValidationError, field_validator

from table_io.card import PROFILES, BadInput, Card, Count, find, parse, read_text
from table_io.limits import warnings as coarse
from twin.service.bundle import Bundle, read_bundle

Mode = Literal["direction", "step", "run"]
Allowed = Callable[[Bundle, Path], None]  # BadInput where a bundle cannot be played as asked


class RunCard(Card):
    """One entry of the list: a test, and what the operator does before it."""

    profile: str = Field(description="Name of a test, or path of a .toml file from this file.")
    label: str = Field("", pattern=r"^([A-Za-z0-9][A-Za-z0-9_.-]*)?$")
    prompt: str = Field("", description="The set-up change before it; none: it follows at once.")
    notes: str = ""
    repeat: Count = Field(1, ge=1, le=50)

    @property
    def labels(self) -> tuple[str, ...]:
        """One a repetition: label, label-rep2, ...; by default the profile's name."""
        label = self.label or Path(self.profile).stem
        return (label, *(f"{label}-rep{k}" for k in range(2, self.repeat + 1)))


class CampaignCard(Card):
    """A campaign: its runs in order, and from where an interrupted one goes on."""

    title: str
    citation: str = ""
    notes: str = ""
    resume: Mode = Field("direction", description="Begin anew: the direction, the step, the run.")
    runs: tuple[RunCard, ...] = Field((), validate_default=True)

    @field_validator("runs")
    @classmethod
    def _some(cls, runs: tuple[RunCard, ...]) -> tuple[RunCard, ...]:
        if not runs:
            raise ValueError('no run in it; add at least one [[runs]] with profile = "..."')
        return runs


@dataclass(frozen=True)
class Planned:
    """A run of a campaign, ready to be played; `prompt` is empty where nothing is changed."""

    number: int
    label: str
    prompt: str
    notes: str
    bundle: Bundle

    @property
    def name(self) -> str:
        """NN-label: its folder."""
        return f"{self.number:02d}-{self.label}"


@dataclass(frozen=True)
class Plan:
    """A whole campaign, checked."""

    path: Path
    card: CampaignCard
    text: str
    runs: tuple[Planned, ...]

    @property
    def seconds(self) -> float:
        """Duration of all drives."""
        return sum(one.bundle.drive.planned_end / one.bundle.drive.rate_hz for one in self.runs)


def read_plan(path: Path, table: str | None, model: str | None, allowed: Allowed) -> Plan:
    """The plan in a campaign's file; BadInput with every fault of it and of every profile."""
    text = read_text(path, "campaign")
    faults: dict[str, list[str]] = {}
    bundles: dict[str, Bundle] = {}
    entries = _entries(text)
    for name in dict.fromkeys(run.profile for run in entries):
        place = path
        try:
            place = _place(name, path)
            bundles[name] = read_bundle(place, table, model)
            _free_of_ours(bundles[name])
            allowed(bundles[name], place)
        except BadInput as error:
            faults.setdefault(str(error).removeprefix(f"{place}: "), []).append(name)
    labels = [label for run in entries for label in run.labels]
    if twice := sorted({label for label in labels if labels.count(label) > 1}):
        faults[f"label {', '.join(map(repr, twice))} stands twice; give each its own"] = ["runs"]
    try:
        card = parse(text, CampaignCard, str(path))
    except BadInput as error:
        raise BadInput("\n".join([str(error), *_told(faults)])) from None
    if faults:
        raise BadInput("\n".join([f"{path}: nothing was started:", *_told(faults)]))
    runs = [
        (label, run.prompt if k == 0 else "", run.notes, bundles[run.profile])
        for run in card.runs
        for k, label in enumerate(run.labels)
    ]
    return Plan(path, card, text, tuple(Planned(n, *one) for n, one in enumerate(runs, 1)))


def _entries(text: str) -> list[RunCard]:
    """The runs that a campaign's text lists, unchecked, as far as it can be read at all."""
    try:
        runs: Any = tomllib.loads(text).get("runs")
    except tomllib.TOMLDecodeError:
        return []
    found = []
    for one in runs if isinstance(runs, list) else []:
        try:
            known = {name: one[name] for name in ("profile", "label", "repeat") if name in one}
            found.append(RunCard.model_validate(known))
        except (ValidationError, TypeError):
            continue  # the card says what is wrong
    return found


def _place(name: str, path: Path) -> Path:
    """The path of a run's profile; BadInput names the nearest one where it is missing."""
    place = find(name, "tests", path)
    if place.is_file():
        return place
    beside = path.parent / name
    there = {one.name: one for one in beside.parent.glob("*.toml")}
    near = difflib.get_close_matches(beside.name, there, 1, 0.4)
    ours = sorted(one.stem for one in (PROFILES / "tests").glob("*.toml"))
    hint = f"did you mean {near[0]!r}?" if near else f"ours, by name: {', '.join(ours)}"
    raise BadInput(f"{name}: no such test profile in {beside.parent}; {hint}")


def _free_of_ours(bundle: Bundle) -> None:
    for name in ("resume", "set_up"):
        if getattr(bundle.profile, name) is not None:
            raise BadInput(f"[{name}]: a campaign writes it itself; take it out of the profile")


def _told(faults: dict[str, list[str]]) -> list[str]:
    """Lines with every fault; what several profiles have in common is said once."""
    lines = []
    for message, names in faults.items():
        lines += [f"  {', '.join(names)}:", *(f"    {line}" for line in message.splitlines())]
    return lines


def free_flight(bundle: Bundle) -> bool:
    """True where the specimen has no bumpers."""
    return bundle.profile.specimen.gap_mm == float("inf")


def doubts(plan: Plan) -> list[str]:
    """Sentences about what is allowed but deserves a look."""
    said = [
        f"{run.label}: {sentence}"
        for run in plan.runs
        for sentence in coarse(run.bundle.margins, run.bundle.rig)
    ]
    free = [run for run in plan.runs if free_flight(run.bundle)]
    if not free:
        return [*said, "no free flight in this campaign: its curves are divided by the model's "
                "u* and a*, not by measured ones"]  # fmt: skip
    if free[0].number != 1:
        said.append(
            f"free flight ({free[0].label}) is not the first run: u* and a*, by which every curve "
            "is divided, are not known before it"
        )
    level = free[0].bundle.profile.sweep.acceleration_g
    others = [run for run in plan.runs if run.bundle.profile.sweep.acceleration_g != level]
    if others:
        said.append(
            f"{', '.join(run.label for run in others)}: another level than the free flight's "
            f"{level:g} g, by whose u* and a* the curves are divided"
        )
    return said
