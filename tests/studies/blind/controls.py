"""Negative controls: verdicts of discovery where no confident name can be correct.

reversed    recording reversed in time: dissipation becomes generation, which no effect does
without     true effect removed from the library: any confident name is wrong
shuffled    verdicts scored against the truths of other cases, see `compute_shuffled_rates`
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from tests.studies.blind.adapter import load_case
from tests.studies.blind.comparison_tables import CONTROL_TITLES
from tests.studies.blind.generation import generate_case
from tests.studies.blind.scoring import format_effect_name
from tests.studies.blind.strata import draw_case
from twin.discovery.build_verdict import build_verdict
from twin.discovery.discover import PreparedLog, discover_effects
from twin.discovery.signals import LogSignals
from twin.model.model import Model

Json = dict[str, Any]
Spectrum = npt.NDArray[np.complex128]
CONTROL_CELLS = "single/*/3/1%"
MIN_FOOLED_CONFIDENCE = 0.5  # a name with a higher confidence counts as confident


def run_controls(root: Path, number: int) -> Json:
    """Return the row of a case with both controls; `sized` is False if it misses its size."""
    case = draw_case(number)
    row: Json = {"number": number, "cell": case.cell.name}
    try:
        paths = generate_case(case, root)
        about = json.loads(paths.about.read_text(encoding="utf-8"))
        row |= {"sized": about["sized"], "ended": about["ended"]}
        if not about["sized"]:
            return row
        row["truth"] = [effect["name"] for effect in about["effects"]]
        logs, _, model = load_case(paths.case_dir)
        ids = [planted.effect.definition.id for planted in case.planted]
        verdicts = (discover_reversed(logs, model), discover_without(logs, model, ids))
        outcomes = {
            control: summarize_verdict(verdict)
            for control, verdict in zip(CONTROL_TITLES, verdicts, strict=True)
        }
    except Exception as error:
        return row | {"failed": f"{type(error).__name__}: {error}"}
    return row | outcomes | {"right": not any(outcome["fooled"] for outcome in outcomes.values())}


def discover_reversed(logs: Sequence[PreparedLog], model: Model) -> Json:
    """Return the verdict on time-reversed recordings."""
    return build_verdict(discover_effects([reverse_log(log) for log in logs], model)).to_plain()


def discover_without(logs: Sequence[PreparedLog], model: Model, effects: Sequence[str]) -> Json:
    """Return the verdict with these effects removed from the library."""
    return build_verdict(discover_effects(logs, model, without=effects)).to_plain()


def summarize_verdict(verdict: Json) -> Json:
    """Return the summary of a verdict; `fooled` is True for a confident name."""
    effects = verdict["effects"] if verdict["verdict"] == "named" else []
    confidence = max((float(effect["confidence"]) for effect in effects), default=None)
    return {
        "said": verdict["verdict"], "named": [format_effect_name(effect) for effect in effects],
        "confidence": confidence,
        "fooled": confidence is not None and confidence > MIN_FOOLED_CONFIDENCE,
    }  # fmt: skip


def reverse_log(log: PreparedLog) -> PreparedLog:
    """Return the log reversed in time: velocities change sign, the other signals do not.

    Sensor noise, readings at rest and step labels are kept.
    """
    signals = log.signals
    reversed_signals = replace(
        signals,
        spectra={
            name: _reverse_spectrum(signals, spectrum) for name, spectrum in signals.spectra.items()
        },
        unit_spectrum=_reverse_spectrum(signals, signals.unit_spectrum),
        step=signals.step[::-1],
        label=signals.label[::-1],
        cycle=signals.cycle[::-1],
        good=signals.good[::-1],
    )
    return replace(log, signals=reversed_signals)


def _reverse_spectrum(signals: LogSignals, spectrum: Spectrum) -> Spectrum:
    """Return the spectrum of x(T - t), with T the time of the last kept sample."""
    last_s = (signals.time_s.size - 1) * signals.grid.decimation / signals.grid.rate_hz
    reversed_spectrum: Spectrum = np.conj(spectrum) * np.exp(-1j * signals.omega * last_s)
    return reversed_spectrum
