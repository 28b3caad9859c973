"""Outcomes of a stepped sine sweep: curves, peaks, forces, impacts, jumps, hysteresis."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.records import NormalizedResponse
from twin.compare.curves import FloatND, Hysteresis, PrcJump
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CURVE_DIMS, CaseChunk, Outcome, OutcomeVariable

Arrays = Mapping[str, npt.NDArray[Any]]
CURVE_NAMES = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")


def compute_curves(chunk: CaseChunk) -> Arrays:
    """Return the pseudo-resonance curves, and the mean number of impacts a cycle."""
    arrange = chunk.sweep.arrange
    curves = {name: arrange(chunk.ratios[name]).astype(np.float32) for name in CURVE_NAMES}
    for name, extreme in (("impacts_right", "onsets_r"), ("impacts_left", "onsets_l")):
        curves[name] = arrange(chunk.extreme(extreme).mean(axis=-1)).astype(np.float32)
    return curves


def find_sweep_peaks(chunk: CaseChunk) -> Arrays:
    """Return the largest half swings of the sweep with their frequencies, and magnitudes."""
    disp = (chunk.extreme("u_max") - chunk.extreme("u_min")).mean(axis=-1) / 2
    acc = (chunk.extreme("a_max") - chunk.extreme("a_min")).mean(axis=-1) / 2
    frequencies = chunk.sweep.frequencies_hz
    return {
        "peak_disp_m": disp.max(axis=-1),
        "peak_disp_hz": _take_where_largest(frequencies, disp),
        "peak_acc_m_s2": acc.max(axis=-1),
        "peak_acc_hz": _take_where_largest(frequencies, acc),
        "peak_eta_d": chunk.ratios["eta_d"].max(axis=-1),
        "peak_eta_a": chunk.ratios["eta_a"].max(axis=-1),
        "max_disp_m": _find_magnitude(chunk, "u_max", "u_min"),
        "max_acc_m_s2": _find_magnitude(chunk, "a_max", "a_min"),
    }


def _find_magnitude(chunk: CaseChunk, highest: str, lowest: str) -> FloatND:
    """Return the largest magnitude of the measured cycles, (case,)."""
    magnitude: FloatND = np.maximum(chunk.extreme(highest), -chunk.extreme(lowest)).max(axis=(1, 2))
    return magnitude


def _take_where_largest(frequencies_hz: FloatND, values: FloatND) -> FloatND:
    """Return the frequency at the largest value of each case, NaN where any is unknown."""
    at_largest = frequencies_hz[values.argmax(axis=-1)]
    return np.where(np.isnan(values).any(axis=-1), np.nan, at_largest)


def find_sweep_forces(chunk: CaseChunk) -> Arrays:
    """Return the largest forces of the sweep, and impacts per cycle."""
    masses = np.array([np.nan if case is None else case.model.base.mass for case in chunk.cases])
    impacts = (chunk.extreme("onsets_r") + chunk.extreme("onsets_l")).mean(axis=-1)
    return {
        "transmitted_force_n": masses * _find_magnitude(chunk, "a_max", "a_min"),
        "bumper_force_n": _find_magnitude(chunk, "f_r_max", "f_l_min"),
        "most_impacts": impacts.max(axis=-1),
    }


def find_sweep_hysteresis(chunk: CaseChunk) -> Arrays:
    """Return the widest hysteresis of each kind, and its jumps."""

    is_unknown: list[bool] = np.all(np.isnan(chunk.ratios["eta_d"]), axis=-1).tolist()

    def describe(index: int, _: SampledCase) -> FloatND:
        jumps, intervals = chunk.hysteresis[index]
        right, left = (_find_widest(intervals, kind) for kind in ("right", "left"))
        numbers = [
            right.to_hz - right.from_hz if right else 0.0,
            left.to_hz - left.from_hz if left else 0.0,
            _find_jump(jumps, "forward", right.to_hz) if right else np.nan,
            _find_jump(jumps, "backward", right.from_hz) if right else np.nan,
            float(len(jumps)),
        ]
        return np.full(len(numbers), np.nan) if is_unknown[index] else np.array(numbers)

    return chunk.collect_numbers(HYSTERESIS.variables, describe)


def _find_widest(intervals: list[Hysteresis], kind: str) -> Hysteresis | None:
    own = [interval for interval in intervals if interval.kind == kind]
    return max(own, key=lambda interval: interval.to_hz - interval.from_hz, default=None)


def _find_jump(jumps: list[PrcJump], direction: str, from_hz: float) -> float:
    """Return the middle of the jump in Hz that leaves a grid frequency, NaN without one."""
    for jump in jumps:
        if jump.direction == direction and jump.from_hz == from_hz:
            return (jump.from_hz + jump.to_hz) / 2
    return np.nan


def _curve(name: str, title: str) -> OutcomeVariable:
    assert name in NormalizedResponse.__dataclass_fields__
    return OutcomeVariable(name, "1", title, CURVE_DIMS, "float32")


CURVES = Outcome(
    "curves",
    "pseudo-resonance curves",
    (
        _curve("eta_d", "displacement over free-flight maximum"),
        _curve("eta_a", "acceleration over free-flight maximum"),
        _curve("eta_r", "deformation of the right bumper over free-flight maximum"),
        _curve("eta_l", "deformation of the left bumper over free-flight maximum"),
        _curve("r_r", "force of the right bumper over weight"),
        _curve("r_l", "force of the left bumper over weight"),
        _curve("impacts_right", "impacts a cycle on the right"),
        _curve("impacts_left", "impacts a cycle on the left"),
    ),
    compute_curves,
)
PEAKS = Outcome(
    "peaks",
    "largest amplitudes of the sweep",
    (
        OutcomeVariable("peak_disp_m", "m", "largest amplitude of displacement"),
        OutcomeVariable("peak_disp_hz", "Hz", "frequency of the largest amplitude of displacement"),
        OutcomeVariable("peak_acc_m_s2", "m/s2", "largest amplitude of acceleration"),
        OutcomeVariable("peak_acc_hz", "Hz", "frequency of the largest amplitude of acceleration"),
        OutcomeVariable("peak_eta_d", "1", "largest displacement ratio"),
        OutcomeVariable("peak_eta_a", "1", "largest acceleration ratio"),
        OutcomeVariable("max_disp_m", "m", "largest relative displacement"),
        OutcomeVariable("max_acc_m_s2", "m/s2", "largest total acceleration"),
    ),
    find_sweep_peaks,
)
FORCES = Outcome(
    "forces",
    "largest forces and impacts of the sweep",
    (
        OutcomeVariable("transmitted_force_n", "N", "force transmitted to the mass"),
        OutcomeVariable("bumper_force_n", "N", "force of a bumper"),
        OutcomeVariable("most_impacts", "1", "impacts a cycle, both sides"),
    ),
    find_sweep_forces,
)
HYSTERESIS = Outcome(
    "hysteresis",
    "hysteresis and jumps between the directions of the sweep",
    (
        OutcomeVariable("right_width_hz", "Hz", "width of the right hysteresis"),
        OutcomeVariable("left_width_hz", "Hz", "width of the left hysteresis"),
        OutcomeVariable("down_jump_hz", "Hz", "jump of the forward sweep"),
        OutcomeVariable("up_jump_hz", "Hz", "jump of the backward sweep"),
        OutcomeVariable("jump_count", "1", "number of jumps"),
    ),
    find_sweep_hysteresis,
    needs_both_directions=True,
)
SWEEP_OUTCOMES = (CURVES, PEAKS, FORCES, HYSTERESIS)
