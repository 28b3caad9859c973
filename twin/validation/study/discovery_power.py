"""Outcome `discovery` of a parameter study: is an effect of this size found at this noise?

Each case is a blind recording of the simulated table, whose plant has the effects of the case's
model with its own laws; discovery starts from the plain model. The test is that of the blind study.
"""

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.config.toml_text import format_toml
from table_io.errors import InputError
from table_io.sim.ground_truth import EFFECT_DEFINITIONS, EffectDefinition
from twin.compare.curves import FloatND
from twin.model.model import EffectInstance
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CaseChunk, Outcome, OutcomeVariable
from twin.validation.study.adapter import discover_in_case
from twin.validation.study.generation import hash_truth, record_test
from twin.validation.study.rig_setup import MODEL_TOML, make_rig_toml

NOISE = "discovery.noise"
DEFAULT_NOISE = 0.01  # of the rms of each channel


def judge_chunk(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return how discovery judges the recording of each case."""

    def judge(index: int, case: SampledCase) -> FloatND:
        return judge_case(case, chunk.seeds[index])

    return chunk.collect_numbers(DISCOVERY.variables, judge)


def judge_case(case: SampledCase, seed: int) -> FloatND:
    """Return (named right, named wrong, share of the gap closed, held-out rms over the noise)."""
    truth = [instance.effect.id for instance in case.model.present_effects]
    with tempfile.TemporaryDirectory() as folder:
        record_case(case, seed, Path(folder))
        verdict = discover_in_case(Path(folder))
    named = [effect["id"] for effect in verdict["effects"]]
    is_right = sorted(named) == sorted(truth)
    gap = verdict.get("gap") or {}
    numbers = [
        float(is_right),
        float(bool(set(named) - set(truth))),
        gap.get("closed_fraction"),
        gap.get("held_out_after"),
    ]
    return np.array([math.nan if number is None else number for number in numbers])


def record_case(case: SampledCase, seed: int, folder: Path) -> None:
    """Write the recording of a case, log.mcap, and the start model, model.toml, to a folder."""
    p = case.model.base
    base = {
        "damper_stiffness_n_m": p.stiffness,
        "damper_damping_n_s_m": p.damping,
        "bumper_stiffness_n_m": p.bumper_stiffness_r,
        "bumper_damping_n_s_m": p.bumper_damping_r,
        "gap_right_m": p.gap_r,
        "gap_left_m": p.gap_l,
    }
    effects = [_describe_hidden(instance) for instance in case.model.present_effects]
    text = format_toml({"base": base} | ({"effects": effects} if effects else {}))
    truth = folder / "truth.toml"
    truth.write_text(text, encoding="utf-8")
    noise = case.settings.get(NOISE, DEFAULT_NOISE)
    rig = make_rig_toml(noise, seed % 2**31, str(truth), hash_truth(text))
    record_test(rig, "case", folder / "log.mcap", is_protected=False)
    (folder / "model.toml").write_text(MODEL_TOML, encoding="utf-8")


def _describe_hidden(instance: EffectInstance) -> dict[str, Any]:
    """Return an effect as the simulated plant hides it, in the first form that it has there."""
    definition = _find_definition(instance.effect.id)
    parameters = {
        parameter.name: instance.values.get(parameter.name, parameter.typical)
        for parameter in definition.parameters
    }
    return {"id": definition.id, "form": definition.form, "parameters": parameters}


def _find_definition(effect: str) -> EffectDefinition:
    for definition in EFFECT_DEFINITIONS:
        if definition.id == effect:
            return definition
    raise InputError("the simulated table cannot hide this effect", key=f"effects.{effect}")


DISCOVERY = Outcome(
    "discovery",
    "verdicts of discovery",
    (
        OutcomeVariable("named_right", "1", "effects named right"),
        OutcomeVariable("named_wrong", "1", "an effect named that is not there"),
        OutcomeVariable("gap_closed", "1", "share of the gap that the model closes"),
        OutcomeVariable("held_out_rms", "1", "held-out residual over the noise"),
    ),
    judge_chunk,
    settings={NOISE: "1"},
    keys=("base.", "specimen.gap_mm", "effects.", "discovery."),
    test="blind recordings of the simulated table in the test of the blind study",
)
