"""Outcome `discovery` of a parameter study: how surely discovery finds an effect in a test.

Each case is the test of the study, played once on the simulated table. It states the mass, the gap
and the level of the case. The base parameters and the effects of the case are hidden in the plant,
in its own forms of the laws; discovery starts from the model of the study.
"""

import hashlib
import math
import tempfile
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.config.base import PROFILES_DIR, format_toml, parse_toml
from table_io.config.profile import Specimen
from table_io.errors import InputError
from table_io.records import RunStart, RunStop
from table_io.sim.ground_truth import EFFECT_DEFINITIONS
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import FloatND
from twin.discovery.build_verdict import build_verdict
from twin.discovery.discover import discover_effects
from twin.discovery.loading import load_logs
from twin.model.config import ModelConfig
from twin.model.model import EffectInstance, Model
from twin.recording.mcap_log import write_items
from twin.setup.run_config import from_texts
from twin.setup.unpaced import iter_simulated_session
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CaseChunk, Outcome, OutcomeVariable

Table = dict[str, Any]  # of a TOML file
NOISE_FACTOR = "discovery.noise_factor"  # of the noise of each sensor of the rig
# With more noise than the rig has, the checks before and during a run would end the test.
UNCHECKED = {"loop_check": {"enabled": False}, "control": {"enabled": False}}


def judge_chunk(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return how discovery judges the recording of each case, (case,) by variable."""

    def judge(index: int, case: SampledCase) -> FloatND:
        return judge_case(case, chunk.profile_toml, chunk.model_toml, chunk.seeds[index])

    return chunk.collect_numbers(DISCOVERY.variables, judge)


def judge_case(case: SampledCase, profile_toml: str, model_toml: str, seed: int) -> FloatND:
    """Return (named right, named wrong, share of the gap closed, held-out rms over the noise)."""
    with tempfile.TemporaryDirectory() as folder:
        truth = Path(folder) / "truth.toml"
        truth.write_text(format_toml(describe_truth(case.model)), encoding="utf-8")
        log = Path(folder) / "log.mcap"
        profile = format_toml(state_case(case, tomllib.loads(profile_toml)))
        rig = make_rig_toml(case.settings.get(NOISE_FACTOR, 1.0), seed % 2**31, truth)
        play_test(profile, rig, model_toml, log)
        logs, _ = load_logs([log])
        config = parse_toml(model_toml, ModelConfig, "the model of the study")
        start = config.build_model(Specimen(mass_kg=1.0, gap_mm=math.inf))  # both are in the log
        verdict = build_verdict(discover_effects(logs, start))
    known = {instance.effect.id for instance in start.present_effects}
    hidden = {instance.effect.id for instance in case.model.present_effects} - known
    named = {effect.id for effect in verdict.effects}
    gap = verdict.gap
    numbers = (named == hidden, bool(named - hidden), gap.closed_fraction, gap.held_out_after)
    return np.array([math.nan if number is None else float(number) for number in numbers])


def state_case(case: SampledCase, profile: Table) -> Table:
    """Return the test of a study with the mass, the gap and the level of a case."""
    base = case.model.base
    sweep = "sweep" if "sweep" in profile else "excitation"
    return {
        **profile,
        **UNCHECKED,
        "specimen": {"mass_kg": base.mass, "gap_mm": 1e3 * (base.gap_r + base.gap_l)},
        sweep: profile[sweep] | {"acceleration_g": case.acceleration_m_s2 / GRAVITY_M_S2},
        "protection": profile.get("protection", {}) | {"sensor": "warn"},
    }


def describe_truth(model: Model) -> Table:
    """Return the base parameters and the effects of a model as the simulated plant hides them."""
    base = model.base
    truth: Table = {
        "base": {
            "damper_stiffness_n_m": base.stiffness,
            "damper_damping_n_s_m": base.damping,
            "bumper_stiffness_n_m": base.bumper_stiffness_r,
            "bumper_damping_n_s_m": base.bumper_damping_r,
        }
    }
    effects = [_describe_effect(instance) for instance in model.present_effects]
    return truth | ({"effects": effects} if effects else {})


def _describe_effect(instance: EffectInstance) -> Table:
    """Return an effect in the first form that the plant has of it."""
    forms = [entry for entry in EFFECT_DEFINITIONS if entry.id == instance.effect.id]
    if not forms:
        raise InputError(
            "the simulated table cannot hide this effect", key=f"effects.{instance.effect.id}"
        )
    definition = forms[0]
    parameters = {
        parameter.name: instance.values.get(parameter.name, parameter.typical)
        for parameter in definition.parameters
    }
    return {"id": definition.id, "form": definition.form, "parameters": parameters}


def make_rig_toml(noise_factor: float, seed: int, truth: Path) -> str:
    """Return the simulated rig with its noise times a factor, and a hidden truth."""
    rig = tomllib.loads((PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8"))
    for sensor in rig["sensors"]:
        sensor["noise_rms"] = sensor.get("noise_rms", 0.0) * noise_factor
    digest = hashlib.sha256(truth.read_bytes()).hexdigest()
    rig["simulated"] |= {"seed": seed, "truth": str(truth), "truth_sha256": digest}
    return format_toml(rig)


def play_test(profile_toml: str, rig_toml: str, model_toml: str, log: Path) -> None:
    """Record a test on the simulated table; InputError if it is not played to its end."""
    config = from_texts("case", profile_toml, rig_toml, model_toml, "the study")
    start, *items = iter_simulated_session(config, "case")
    stop = items[-1] if items else start
    if isinstance(stop, RunStop) and stop.verdict != "complete":
        raise InputError(f"the test does not reach its end: {stop.reason}")
    assert isinstance(start, RunStart)
    write_items(log, [start, *items], start)


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
    settings={NOISE_FACTOR: "1"},
    test="recordings of the test on the simulated table",
)
