"""Comparison of two runs: curves, jumps, parameters and misfit, before and after a change.

Two tests on the table, or two replays of one recording with different models.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from twin.laws.library import find_effect
from twin.recording.reader import Recording
from twin.results.summary import Json
from twin.results.twin_verdict import format_misfit

RESPONSES = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
BASE_UNITS = {
    "mass": "kg", "stiffness": "N/m", "damping": "N s/m", "bumper_stiffness_r": "N/m",
    "bumper_damping_r": "N s/m", "bumper_stiffness_l": "N/m", "bumper_damping_l": "N s/m",
    "gap_r": "m", "gap_l": "m",
}  # fmt: skip
MIN_CHANGE_SIGMA = 3.0  # standard deviations beyond which an estimate has changed


@dataclass(frozen=True, slots=True)
class ComparedRun:
    """A run to compare: its folder, summary, and the flat parameters of its model in SI."""

    folder: Path
    recording: Recording
    summary: Json
    parameters: Mapping[str, float]


def compare_summaries(first: ComparedRun, second: ComparedRun) -> Json:
    """Return the comparison of two runs; pairs are (first, second), None where one has no value."""
    runs = (first, second)
    return {
        "runs": [_describe_run(run) for run in runs],
        "steps": _pair_steps(first.summary["steps"], second.summary["steps"]),
        "jumps": {
            source: _pair_jumps(*(run.summary.get(f"{prefix}jumps") or [] for run in runs))
            for source, prefix in (("measured", ""), ("twin", "twin_"))
        },
        "misfit": {
            channel: {
                key: [_channel_error(run, channel, key) for run in runs]
                for key in ("nrmse", "noise_floor")
            }
            for channel in dict.fromkeys(
                name for run in runs for name in run.summary.get("comparison") or {}
            )
        },
        "estimates": _pair_estimates(
            *(run.summary.get("estimates") or {} for run in runs),
            is_one_model=first.parameters == second.parameters,
        ),
        "model": [
            {
                "name": name,
                "unit": find_parameter_unit(name),
                "values": [_finite(run.parameters.get(name)) for run in runs],
            }
            for name in dict.fromkeys(name for run in runs for name in run.parameters)
        ],
    }


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def _describe_run(run: ComparedRun) -> Json:
    twin = run.summary.get("twin_verdict") or {}
    info = run.summary["run"]
    return {
        "folder": str(run.folder),
        **{key: info.get(key) for key in ("id", "title", "started_at", "gap_m", "model")},
        "verdict": run.summary["verdict"],
        "twin_verdict": twin.get("verdict"),
        "excitation_verdict": (run.summary.get("excitation_verdict") or {}).get("verdict"),
        "misfit": format_misfit(twin),
        "warnings": len(run.summary.get("warnings") or ()),
        "steps": len(run.summary["steps"]),
    }


def _pair_steps(first: Sequence[Json], second: Sequence[Json]) -> list[Json]:
    """Return the responses of the steps that both runs have: same direction and frequency."""
    others = {(step["direction"], round(step["frequency_hz"], 6)): step for step in second}
    pairs = [
        (step, other)
        for step in first
        if (other := others.get((step["direction"], round(step["frequency_hz"], 6))))
    ]
    return [
        {
            "direction": step["direction"],
            "frequency_hz": step["frequency_hz"],
            **{
                source: {
                    name: [(entry.get(source) or {}).get(name) for entry in (step, other)]
                    for name in RESPONSES
                }
                for source in ("measured", "twin")
            },
        }
        for step, other in pairs
    ]


def _pair_jumps(first: Sequence[Json], second: Sequence[Json]) -> list[Json]:
    """Return jumps of the same direction and kind in pairs, in order; None where one is alone."""
    kinds = dict.fromkeys((jump["direction"], jump["kind"]) for jump in (*first, *second))
    pairs = []
    for direction, kind in kinds:
        of_kind = [
            [
                [jump["from_hz"], jump["to_hz"]]
                for jump in jumps
                if (jump["direction"], jump["kind"]) == (direction, kind)
            ]
            for jumps in (first, second)
        ]
        for number in range(max(map(len, of_kind))):
            places = [jumps[number] if number < len(jumps) else None for jumps in of_kind]
            shift = 0.5 * (sum(places[1]) - sum(places[0])) if places[0] and places[1] else None
            pairs.append(
                {"direction": direction, "kind": kind, "between_hz": places, "shift_hz": shift}
            )
    return pairs


def _channel_error(run: ComparedRun, channel: str, key: str) -> float | None:
    error = (run.summary.get("comparison") or {}).get(channel) or {}
    return error.get(key)


def _pair_estimates(
    first: Mapping[str, Json], second: Mapping[str, Json], *, is_one_model: bool
) -> list[Json]:
    """Return the parameters estimated in both runs, their change and its standard deviations.

    An estimate holds beside the effects of its own model, so a change between two models is none of
    the specimen: it has no standard deviations.
    """
    pairs = []
    for name in first:
        if name not in second:
            continue
        a, b = first[name], second[name]
        change = b["value"] - a["value"]
        sd = math.hypot(a["sd"] or 0.0, b["sd"] or 0.0)
        sigma = abs(change) / sd if sd and is_one_model else None
        pairs.append(
            {
                "name": name,
                "unit": find_parameter_unit(name),
                "values": [a["value"], b["value"]],
                "sd": [a["sd"], b["sd"]],
                "change": change,
                "sigma": sigma,
                "changed": sigma is not None and sigma > MIN_CHANGE_SIGMA,
            }
        )
    return pairs


def find_parameter_unit(name: str) -> str:
    """Return the SI unit of a flat parameter name of a model; empty for a ratio."""
    if "." not in name:
        return BASE_UNITS.get(name, "")
    parameters = find_effect(name.split(".", maxsplit=1)[0]).parameters
    return next((p.unit for p in parameters if p.name == name.rsplit(".", 1)[1]), "")
