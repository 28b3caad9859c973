"""Built-in outcomes: of the stepped sine sweep, of branches by continuation, and of basins."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from table_io.records import RESPONSE_RATIOS, NormalizedResponse
from twin.compare.curves import FloatND, Hysteresis, PrcJump
from twin.dynamics.basins import StartGrid, compute_basins
from twin.dynamics.continuation import Branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import find_peaks
from twin.studies.maps.cases import SampledCase
from twin.studies.maps.outcomes import CURVE_DIMS, CaseChunk, Outcome, OutcomeVariable

Arrays = Mapping[str, npt.NDArray[Any]]


def compute_curves(chunk: CaseChunk) -> Arrays:
    """Return the pseudo-resonance curves, and the mean number of impacts a cycle."""
    arrange = chunk.sweep.arrange
    curves = {name: arrange(chunk.ratios[name]).astype(np.float32) for name in RESPONSE_RATIOS}
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


SAME_FOLD_DIGITS = 7  # of the frequency in Hz


def find_branch_folds(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return the folds of the primary resonance, its grazing, and the largest stable motion."""
    branches = chunk.branches

    def describe(index: int, _: SampledCase) -> FloatND:
        if not branches[index]:
            return np.full(len(FOLDS.variables), np.nan)
        return np.array([*locate_folds(branches[index]), *find_peaks(branches[index])])

    return chunk.collect_numbers(FOLDS.variables, describe)


def locate_folds(branches: Sequence[Branch]) -> tuple[float, float, float]:
    """Return (upper fold, lower fold, lowest grazing of the same branch) in Hz, NaN without.

    Of the branch with the highest fold: there a forward sweep falls, and at the lower fold a
    backward sweep jumps up.
    """
    nan = float("nan")
    folded = [branch for branch in branches if len(branch.folds) >= 2]
    if not folded:
        return nan, nan, nan
    branch = max(folded, key=lambda branch: max(fold.value for fold in branch.folds))
    # A branch that is followed to and fro has its folds twice, to the tolerance of Newton's method.
    folds = np.unique(np.round([fold.value for fold in branch.folds], SAME_FOLD_DIGITS)).tolist()
    if len(folds) < 2:
        return nan, nan, nan
    grazings = [bifurcation.value for bifurcation in branch.of_kind("grazing")]
    near = [value for value in grazings if value >= folds[-2]]
    return folds[-1], folds[-2], min(near, default=nan)


FOLDS = Outcome(
    "folds",
    "folds and largest stable motion, by continuation",
    (
        OutcomeVariable("upper_fold_hz", "Hz", "upper fold, where a forward sweep falls"),
        OutcomeVariable("lower_fold_hz", "Hz", "lower fold, where a backward sweep jumps up"),
        OutcomeVariable("grazing_hz", "Hz", "grazing between the folds"),
        OutcomeVariable("stable_disp_m", "m", "largest stable amplitude of displacement"),
        OutcomeVariable("stable_disp_hz", "Hz", "its frequency, displacement"),
        OutcomeVariable("stable_acc_m_s2", "m/s2", "largest stable amplitude of acceleration"),
        OutcomeVariable("stable_acc_hz", "Hz", "its frequency, acceleration"),
    ),
    find_branch_folds,
    needs_closed_form=True,
)


def measure_basins(chunk: CaseChunk) -> Mapping[str, npt.NDArray[Any]]:
    """Return which share of the initial states each kind of motion attracts at one frequency."""

    def measure(_: int, case: SampledCase) -> FloatND:
        settings = {**BASIN_DEFAULTS, **case.settings}
        side = round(settings["basins.starts_per_axis"])
        grid = StartGrid.from_limits(
            1e-3 * settings["basins.disp_mm"], settings["basins.vel_m_s"], side, side
        )
        frequency_hz = settings["basins.frequency_hz"]
        period_map = make_period_map(case.model, frequency_hz, case.acceleration_m_s2)
        basins = compute_basins(period_map, grid)
        in_contact = np.array([attractor.has_contact for attractor in basins.attractors])
        shares = basins.fractions
        return np.array(
            [shares[in_contact].sum(), shares.max(), len(basins.attractors), basins.undecided_share]
        )

    return chunk.collect_numbers(BASINS.variables, measure)


BASIN_DEFAULTS = {"basins.disp_mm": 6.0, "basins.vel_m_s": 0.15, "basins.starts_per_axis": 15.0}
BASINS = Outcome(
    "basins",
    "basins of attraction at one frequency",
    (
        OutcomeVariable("contact_share", "1", "share of starts that end in motions with contact"),
        OutcomeVariable("largest_share", "1", "share of the largest basin"),
        OutcomeVariable("attractor_count", "1", "number of attractors"),
        OutcomeVariable("undecided_share", "1", "share of starts that reach no attractor"),
    ),
    measure_basins,
    settings={
        "basins.frequency_hz": "Hz",
        "basins.disp_mm": "mm",
        "basins.vel_m_s": "m/s",
        "basins.starts_per_axis": "1",
    },
    required=("basins.frequency_hz",),
)
BRANCH_OUTCOMES = (FOLDS, BASINS)
