"""Comparison of two runs: curves, jumps, parameters and misfit, before and after a change.

Two tests on the table, or two replays of one recording with different models.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from table_io.records import RESPONSE_RATIOS
from twin.laws.library import find_effect
from twin.recording.reader import Recording
from twin.results.contracts import (
    ChannelError,
    Jump,
    ParameterEstimate,
    Response,
    RunSummary,
    StepEntry,
)
from twin.results.twin_verdict import format_misfit

BASE_UNITS = {
    "mass": "kg", "stiffness": "N/m", "damping": "N s/m", "bumper_stiffness_r": "N/m",
    "bumper_damping_r": "N s/m", "bumper_stiffness_l": "N/m", "bumper_damping_l": "N s/m",
    "gap_r": "m", "gap_l": "m",
}  # fmt: skip
MIN_CHANGE_SIGMA = 3.0  # standard deviations beyond which an estimate has changed


Pair = list[float | None]  # value of the first and of the second run


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """A run to compare: its folder, summary, and the flat parameters of its model in SI."""

    folder: Path
    recording: Recording
    summary: RunSummary
    parameters: Mapping[str, float]

    def find_error(self, channel: str) -> ChannelError:
        """Return the error of the twin in a channel."""
        return self.summary.comparison.get(channel, ChannelError())


@dataclass(frozen=True, slots=True)
class RunOverview:
    """What was run, when, and how it ended; None is what the summary does not state."""

    folder: str
    id: str | None
    title: str | None
    started_at: str | None
    gap_m: float | None
    model: str | None
    verdict: str
    twin_verdict: str | None
    excitation_verdict: str | None
    misfit: str
    warnings: int
    steps: int


@dataclass(frozen=True, slots=True)
class StepPair:
    """Responses by name at a step that both runs have: same direction and frequency."""

    direction: str
    frequency_hz: float
    measured: dict[str, Pair]
    twin: dict[str, Pair]


@dataclass(frozen=True, slots=True)
class JumpPair:
    """Jump of one direction and kind in both runs; None where one lacks it."""

    direction: str
    kind: str
    between_hz: list[list[float] | None]
    shift_hz: float | None


@dataclass(frozen=True, slots=True)
class MisfitPair:
    """NRMSE of the restarted twin in a channel, and the part of noise."""

    nrmse: Pair
    noise_floor: Pair


@dataclass(frozen=True, slots=True)
class EstimatePair:
    """Parameter estimated in both runs, SI; its change also in standard deviations.

    An estimate holds beside the effects of its own model, so a change between two models is none of
    the specimen: it has no standard deviations.
    """

    name: str
    unit: str
    values: list[float]
    sd: list[float]
    change: float
    sigma: float | None
    changed: bool


@dataclass(frozen=True, slots=True)
class ParameterPair:
    """Parameter of the twin's model in SI."""

    name: str
    unit: str
    values: Pair


@dataclass(frozen=True, slots=True)
class RunComparison:
    """Comparison of two runs, the content of comparison.json; pairs are (first, second)."""

    runs: list[RunOverview]
    steps: list[StepPair]
    jumps: dict[str, list[JumpPair]]
    misfit: dict[str, MisfitPair]
    estimates: list[EstimatePair]
    model: list[ParameterPair]


def compare_summaries(first: ComparedRun, second: ComparedRun) -> RunComparison:
    """Return the comparison of two runs."""
    runs = (first, second)
    return RunComparison(
        runs=[_describe_run(run) for run in runs],
        steps=_pair_steps(first.summary.steps, second.summary.steps),
        jumps={
            "measured": _pair_jumps(first.summary.jumps, second.summary.jumps),
            "twin": _pair_jumps(first.summary.twin_jumps, second.summary.twin_jumps),
        },
        misfit={
            channel: MisfitPair(
                [run.find_error(channel).nrmse for run in runs],
                [run.find_error(channel).noise_floor for run in runs],
            )
            for channel in dict.fromkeys(name for run in runs for name in run.summary.comparison)
        },
        estimates=_pair_estimates(
            first.summary.estimates,
            second.summary.estimates,
            is_one_model=first.parameters == second.parameters,
        ),
        model=[
            ParameterPair(
                name, find_parameter_unit(name), [run.parameters.get(name) for run in runs]
            )
            for name in dict.fromkeys(name for run in runs for name in run.parameters)
        ],
    )


def _describe_run(run: ComparedRun) -> RunOverview:
    summary, info = run.summary, run.summary.run
    return RunOverview(
        folder=str(run.folder),
        id=info.id or None,
        title=info.title or None,
        started_at=info.started_at or None,
        gap_m=info.gap_m,
        model=info.model,
        verdict=summary.verdict,
        twin_verdict=summary.twin_verdict.verdict if summary.twin_verdict else None,
        excitation_verdict=summary.excitation_verdict.verdict
        if summary.excitation_verdict
        else None,
        misfit=format_misfit(summary.twin_verdict),
        warnings=len(summary.warnings),
        steps=len(summary.steps),
    )


def _pair_steps(first: Sequence[StepEntry], second: Sequence[StepEntry]) -> list[StepPair]:
    """Return the responses of the steps that both runs have."""
    others = {(step.direction, round(step.frequency_hz, 6)): step for step in second}
    return [
        StepPair(
            step.direction,
            step.frequency_hz,
            _pair_responses(step.measured, other.measured),
            _pair_responses(step.twin, other.twin),
        )
        for step in first
        if (other := others.get((step.direction, round(step.frequency_hz, 6))))
    ]


def _pair_responses(first: Response | None, second: Response | None) -> dict[str, Pair]:
    return {
        name: [getattr(entry, name, None) for entry in (first, second)] for name in RESPONSE_RATIOS
    }


def _pair_jumps(first: Sequence[Jump], second: Sequence[Jump]) -> list[JumpPair]:
    """Return jumps of the same direction and kind in pairs, in order."""
    kinds = dict.fromkeys((jump.direction, jump.kind) for jump in (*first, *second))
    return [
        JumpPair(
            direction,
            kind,
            [[jump.from_hz, jump.to_hz] if jump else None for jump in pair],
            0.5 * (pair[1].from_hz + pair[1].to_hz - (pair[0].from_hz + pair[0].to_hz))
            if pair[0] and pair[1]
            else None,
        )
        for direction, kind in kinds
        for pair in zip_longest(
            *(
                [jump for jump in jumps if (jump.direction, jump.kind) == (direction, kind)]
                for jumps in (first, second)
            )
        )
    ]


def _pair_estimates(
    first: Mapping[str, ParameterEstimate],
    second: Mapping[str, ParameterEstimate],
    *,
    is_one_model: bool,
) -> list[EstimatePair]:
    """Return the parameters estimated in both runs."""
    pairs = []
    for name, a in first.items():
        if name not in second:
            continue
        b = second[name]
        change = b.value - a.value
        sd = math.hypot(*(value for value in (a.sd, b.sd) if math.isfinite(value)))
        sigma = abs(change) / sd if sd and is_one_model else None
        pairs.append(
            EstimatePair(
                name,
                find_parameter_unit(name),
                [a.value, b.value],
                [a.sd, b.sd],
                change,
                sigma,
                sigma is not None and sigma > MIN_CHANGE_SIGMA,
            )
        )
    return pairs


def find_parameter_unit(name: str) -> str:
    """Return the SI unit of a flat parameter name of a model; empty for a ratio."""
    if "." not in name:
        return BASE_UNITS.get(name, "")
    parameters = find_effect(name.split(".", maxsplit=1)[0]).parameters
    return next((p.unit for p in parameters if p.name == name.rsplit(".", 1)[1]), "")
