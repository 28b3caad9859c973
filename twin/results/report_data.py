"""Report data: PRCs, step motions, envelopes and twin errors from a recording and its summary.

Also selects the steps that are shown in detail.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from pydantic import ValidationError

from table_io.block import Block, Float1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, relative_displacement
from table_io.config.profile import ComparisonConfig, Specimen
from table_io.records import Params, PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.recording.columns import PIECE_SAMPLES, ComparisonTable
from twin.recording.reader import Recording
from twin.results.contracts import OrbitResult, RunSummary, StepEntry, WindowResult
from twin.results.players import SystemMotion
from twin.results.rerun import Predictions
from twin.results.summary import parse_toml_tables
from twin.results.windows import cut_blocks

Curve = tuple[Float1D, Float1D]  # frequency in Hz, ascending, and quantity
CurvePoint = PrcPoint | StepEntry  # as recorded or simulated, or of a summary
Envelope = tuple[Float1D, Float1D, Float1D]
DIRECTIONS = ("forward", "backward")
IMPACT_KEYS = ("impacts_right", "impacts_left")
COMPARED_CHANNELS: dict[str, tuple[str, ...]] = {
    "u": ("rel_disp_m",),
    "a": ("mass_acc_m_s2",),
    "F_R": RIGHT_CELLS,
    "F_L": LEFT_CELLS,
}
MAX_INTERVALS, SLOPE_WINDOW_S, MAX_ENVELOPE_BINS = 2, 0.020, 1600


class Stretch(NamedTuple):
    """Samples first .. end - 1 of a stream, which have the same step and label and no gap."""

    step: int
    label: int
    first: int
    end: int


def list_stretches(recording: Recording, stream: str) -> list[Stretch]:
    """Return the stretches of a stream in order."""
    stretches: list[Stretch] = []
    for block in recording.iter_pieces(stream):
        changes = np.flatnonzero(np.diff(block.step) | np.diff(block.label)) + 1
        for first, end in pairwise([0, *changes.tolist(), len(block)]):
            state = int(block.step[first]), int(block.label[first])
            begin = block.index + first
            if stretches and (*stretches[-1][:2], stretches[-1].end) == (*state, begin):
                begin = stretches.pop().first
            stretches.append(Stretch(*state, begin, block.index + end))
    return stretches


@dataclass(frozen=True)
class ReportData:
    """Recording and summary of a run, with the specimen that every figure needs."""

    recording: Recording
    summary: RunSummary
    specimen: Specimen | None
    contact_n: float

    @property
    def measured_blocks(self) -> tuple[Block, ...]:
        """Measured stream, joined between gaps; of a simulation the motion of the table."""
        return self.recording.contiguous_blocks("meas")

    @property
    def shown_stream(self) -> str:
        """Stream of an overview: "meas", or "pred" if nothing was measured."""
        has_twin = self.source == "twin" and self.recording.contiguous_blocks("pred")
        return "pred" if has_twin else "meas"

    def read_stream(self, stream: str, first: int, end: int) -> list[Block]:
        """Return samples first .. end - 1 of "meas" or "pred"; unrecorded ones are recomputed."""
        if stream == "meas":
            return cut_blocks(self.measured_blocks, first, end)
        return cut_blocks(self._predictions.read(first, end), first, end)

    @cached_property
    def measured_stretches(self) -> list[Stretch]:
        """Stretches of the measured stream, in order."""
        return list_stretches(self.recording, "meas")

    def list_step_spans(self) -> list[tuple[int, float, float]]:
        """Return (step, first and last time in s) of the stretches of a step that is shown."""
        is_measured = self.shown_stream == "meas"
        stretches = (
            self.measured_stretches if is_measured else list_stretches(self.recording, "pred")
        )
        spans: list[tuple[int, int, int]] = []
        for step, _, first, end in stretches:
            is_next = spans and spans[-1][::2] == (step, first)
            spans.append((step, spans.pop()[1] if is_next else first, end))
        rate_hz = self.recording.start.rate_hz
        return [(step, first / rate_hz, (end - 1) / rate_hz) for step, first, end in spans]

    @cached_property
    def _predictions(self) -> Predictions:
        return Predictions(self.recording)

    @property
    def steps(self) -> Sequence[StepEntry]:
        return self.summary.steps

    @property
    def source(self) -> str:
        """Source of the results: "measured", or "twin" if nothing was measured."""
        results: list[StepEntry | WindowResult] = [*self.steps, *self.windows]
        is_measured = self.orbits or any(result.measured for result in results)
        return "measured" if is_measured else "twin"

    @property
    def orbits(self) -> list[OrbitResult]:
        """Measured periodic orbits of a continuation; none in other tests."""
        return self.summary.orbits or []

    @property
    def windows(self) -> list[WindowResult]:
        """Windows of a displacement history; none in a stepped sine."""
        return self.summary.windows or []

    @property
    def gaps_m(self) -> tuple[float, float] | None:
        """Initial gaps (right, left) in m; None without bumpers or if unknown."""
        if self.specimen is None or not all(map(math.isfinite, self.specimen.gaps_m)):
            return None
        return self.specimen.gaps_m

    @property
    def has_bumpers(self) -> bool:
        return self.specimen is None or self.gaps_m is not None


@dataclass(frozen=True, slots=True, eq=False)
class StepMotion(SystemMotion):
    """Motion over the measured cycles of a step; NaN where a sample is missing."""

    cycle: Float1D

    def select_last(self, cycles: int) -> "StepMotion":
        """Return the last `cycles` cycles, with time counted from their start."""
        first = int(np.argmax(self.cycle > np.nanmax(self.cycle) - cycles))
        arrays = {field.name: getattr(self, field.name)[first:] for field in fields(self)}
        return StepMotion(**{**arrays, "time": arrays["time"] - arrays["time"][0]})


def build_report_data(recording: Recording, summary: RunSummary) -> ReportData:
    """Build the report data of a run; an imported run without a profile has no specimen."""
    profile = parse_toml_tables(recording.start.profile_toml)
    try:
        specimen = Specimen.model_validate(profile.get("specimen"))
    except ValidationError:
        specimen = None
    contact_n = ComparisonConfig.model_validate(profile.get("comparison") or {}).contact_n
    return ReportData(recording, summary, specimen, contact_n)


def step_quantity(step: CurvePoint, source: str, name: str) -> float:
    """Return a quantity of a step, averaged if given per cycle; NaN if absent."""
    response = getattr(step, source)
    value = math.nan if response is None else getattr(response, name)
    return float(np.mean(value)) if np.size(value) else math.nan


def extract_prc(points: Sequence[CurvePoint], source: str, direction: str, name: str) -> Curve:
    """Return (frequency in Hz, quantity), (point,) each, of one direction in ascending frequency.

    `source` is "twin" or "measured". Impacts are means per cycle. NaN where there is no value, and
    between the sweeps of a test that goes through the same frequencies at several levels.
    """
    sweeps: list[dict[float, float]] = []
    for point in points:
        if point.direction != direction:
            continue
        sweep = next((known for known in sweeps if point.frequency_hz not in known), None)
        if sweep is None:
            sweeps.append(sweep := {})
        sweep[point.frequency_hz] = step_quantity(point, source, name)
    rows: list[tuple[float, float]] = []
    for sweep in sweeps:
        rows += [(math.nan, math.nan)] if rows else []
        rows += sorted(sweep.items())
    table = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def compute_prestress(run: ReportData) -> dict[str, float]:
    """Return eta_r, eta_l, r_r, r_l of precompressed bumpers at rest by name, if known.

    A negative gap compresses a bumper by p_j = -gap_j: eta_j = p_j / u*, r_j = K_j p_j / (M g);
    its curve starts there (Stefani, De Angelis, Andreaus, Fig. 5).
    """
    values, u_star = _read_model_values(run), run.summary.u_star_m or math.nan
    weight = values.get("mass", math.nan) * GRAVITY_M_S2
    ratios = {}
    for side, gap in zip("rl", run.gaps_m or (math.nan, math.nan), strict=True):
        precompression = -values.get(f"gap_{side}", gap)
        ratios[f"eta_{side}"] = precompression / u_star
        ratios[f"r_{side}"] = (
            values.get(f"bumper_stiffness_{side}", math.nan) * precompression / weight
        )
    return {name: size for name, size in ratios.items() if 0 < size < math.inf}


def read_initial_model(run: ReportData) -> Model | None:
    """Return the initial model: as recorded, else from the model file; None if it is unknown."""
    recorded = run.recording.records(Params)
    try:
        config = ModelConfig.model_validate(parse_toml_tables(run.recording.start.model_toml))
        if recorded:
            known = [entry.effect for entry in config.effects]
            return Model.from_flat(recorded[0].values, known)
        return config.build_model(run.specimen) if run.specimen else None
    except ValueError:
        return None


def _read_model_values(run: ReportData) -> dict[str, float]:
    """Return the initial model parameters in SI; of an unknown model as far as recorded."""
    model, recorded = read_initial_model(run), run.recording.records(Params)
    if model is not None:
        return model.parameters.as_dict()
    return recorded[0].values if recorded else {}


def select_frequencies(run: ReportData) -> dict[float, str]:
    """Select at most four frequencies in Hz to show in detail, ascending, each with the reason.

    The middles of the two widest hysteresis intervals, the peak of eta_d, and the step with most
    impacts per cycle; from the twin if nothing was measured.
    """
    grid = sorted({step.frequency_hz for step in run.steps})
    reasons: dict[float, list[str]] = {}
    intervals = run.summary.hysteresis
    widest = sorted(intervals, key=lambda interval: interval.from_hz - interval.to_hz)
    for interval in widest[:MAX_INTERVALS] if grid else ():
        middle = (interval.from_hz + interval.to_hz) / 2
        nearest_hz = min(grid, key=lambda hz: abs(hz - middle))
        reasons.setdefault(nearest_hz, []).append(f"inside the {interval.kind} hysteresis")
    for names, reason in (
        (("eta_d",), "largest excursion"),
        (IMPACT_KEYS, "most impacts per cycle"),
    ):
        values = [
            sum(step_quantity(step, run.source, name) for name in names) for step in run.steps
        ]
        if np.nanmax([0.0, *values]) > 0:
            peak_hz = run.steps[int(np.nanargmax(values))].frequency_hz
            reasons.setdefault(peak_hz, []).append(reason)
    return {hz: ", ".join(reasons[hz]) for hz in sorted(reasons)}


def extract_step_motion(run: ReportData, stream: str, step: int) -> StepMotion | None:
    """Return the measured cycles of a step from "meas", or the free-running twin from "pred"."""
    blocks: list[Block] = []
    measured = [each for each in run.measured_stretches if each[:2] == (step, Label.MEASURE)]
    for block in run.measured_blocks:
        if inside := [each for each in measured if block.index <= each.first < block.end]:
            blocks += run.read_stream(stream, inside[0].first, inside[-1].end)
    if not blocks:
        return None
    first, size = blocks[0].index, blocks[-1].end - blocks[0].index
    values = np.full((len(blocks[0].channels), size), np.nan)
    cycle = np.full(size, np.nan)
    for chunk in blocks:
        values[:, chunk.index - first : chunk.end - first] = chunk.values
        cycle[chunk.index - first : chunk.end - first] = chunk.cycle
    names = tuple(name.removeprefix("free/") for name in blocks[0].channels)
    no_label = np.full(size, -1, dtype=np.int64)
    step_block = Block(
        stream, first, blocks[0].rate_hz, names, values, no_label, no_label, no_label
    )
    u, missing = relative_displacement(step_block), np.full(size, np.nan)
    v = (
        step_block.channel("rel_vel_m_s")
        if "rel_vel_m_s" in names
        else differentiate(u, step_block.rate_hz)
    )
    a = step_block.channel("mass_acc_m_s2") if "mass_acc_m_s2" in names else missing
    force_r, force_l = contact_forces(step_block)
    v_r, v_l = (np.where(force > run.contact_n, u, np.nan) for force in (force_r, -force_l))
    time_s = step_block.time_s - step_block.time_s[0]
    return StepMotion(time_s, u, v, a, force_r, force_l, v_r, v_l, cycle)


def differentiate(u: Float1D, rate_hz: float) -> Float1D:
    """Differentiate u by a Savitzky-Golay filter over 20 ms; for figures only, NaN at both ends.

    The slope is that of the cubic fitted to the window. scipy.signal takes a second to import.
    """
    half = max(2, round(SLOPE_WINDOW_S * rate_hz / 2))
    v = np.full(u.size, np.nan)
    if u.size > 2 * half:
        time_s = np.arange(-half, half + 1) / rate_hz
        slope_weights = np.linalg.pinv(np.vander(time_s / time_s[-1], 4))[2] / time_s[-1]
        v[half:-half] = np.correlate(u, slope_weights, "valid")
    return v


def pair_motions(
    run: ReportData, hz: float
) -> list[tuple[str, StepMotion | None, StepMotion | None]]:
    """Return (direction, measured, twin) at a frequency for each direction that has cycles."""
    pairs: list[tuple[str, StepMotion | None, StepMotion | None]] = []
    for step in run.steps:
        if step.frequency_hz == hz:
            motions = (
                extract_step_motion(run, "meas", step.index),
                extract_step_motion(run, "pred", step.index),
            )
            if any(motion is not None and np.isfinite(motion.u).any() for motion in motions):
                pairs.append((step.direction, *motions))
    return pairs


def compute_envelopes(run: ReportData) -> dict[str, list[Envelope]]:
    """Return the envelopes of the shown stream by row of the overview, without rows of no data."""
    prefix = "" if run.source == "measured" else "free/"

    def get_channel(block: Block, channel: str) -> Float1D:
        missing = np.full(len(block), np.nan)
        return block.channel(prefix + channel) if prefix + channel in block.channels else missing

    rows: dict[str, Callable[[Block], Float1D]] = {
        "table in mm": lambda block: get_channel(block, "table_disp_m") * 1e3,
        "table in m/s²": lambda block: get_channel(block, "table_acc_m_s2"),
        "$u$ in mm": lambda block: (
            (get_channel(block, "rel_disp_m") if prefix else relative_displacement(block)) * 1e3
        ),
    }
    envelopes: dict[str, list[Envelope]] = {label: [] for label in rows}
    low_hz = min((step.frequency_hz for step in run.steps), default=1.0)
    for block in run.recording.contiguous_blocks(run.shown_stream):
        # Bins of at least one cycle, as many in each piece as it holds.
        width = max(len(block) // MAX_ENVELOPE_BINS, round(block.rate_hz / low_hz), 1)
        samples = width * max(PIECE_SAMPLES // width, 1)
        pieces = [
            [_compute_envelope(piece, get_values(piece), width) for get_values in rows.values()]
            for piece in run.recording.cut_block(block, samples)
        ]
        for label, parts in zip(rows, zip(*pieces, strict=True), strict=True):
            time_s, low, high = map(np.concatenate, zip(*parts, strict=True))
            envelopes[label].append((time_s, low, high))
    return {
        label: row_envelopes
        for label, row_envelopes in envelopes.items()
        if any(np.isfinite(low).any() for _, low, _ in row_envelopes)
    }


def _compute_envelope(block: Block, values: Float1D, width: int) -> Envelope:
    """Return (time in s, minimum, maximum) of bins of `width` samples; NaN without samples."""
    starts = np.arange(0, len(block), width)
    middle_s = block.time_s[np.minimum(starts + width // 2, len(block) - 1)]
    return middle_s, np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)


def compute_step_errors(run: ReportData) -> dict[str, dict[int, tuple[float, float]]]:
    """Return the NRMSE of the (free, restarted) twin by quantity and step.

    Only blocks entirely within measured cycles count. Contact forces without contact are NaN:
    they are noise.
    """
    compared = run.recording.comparisons
    steps = np.full(len(compared), -1)
    for step, label, first, end in run.measured_stretches:
        if step >= 0 and label == Label.MEASURE:
            steps[(compared.index >= first) & (compared.index + compared.count <= end)] = step
    errors: dict[str, dict[int, tuple[float, float]]] = {part: {} for part in COMPARED_CHANNELS}
    for step in dict.fromkeys(steps[steps >= 0].tolist()):
        comparisons = compared.select(steps == step)
        for part, names in COMPARED_CHANNELS.items():
            columns = [k for k, name in enumerate(compared.channels) if name in names]
            floor = run.contact_n / 2 if part.startswith("F") else 0.0
            if columns:
                errors[part][step] = _compute_nrmse(comparisons, columns, floor)
    return errors


def _compute_nrmse(
    comparisons: ComparisonTable, columns: list[int], floor: float
) -> tuple[float, float]:
    """Return the NRMSE of the (free, restarted) twin; NaN if the signal is below `floor` RMS."""
    measured = comparisons.measured_ss[:, columns]
    samples = int(comparisons.count.sum())
    values = []
    for sums in (comparisons.free_error_ss, comparisons.window_error_ss):
        error = sums[:, columns]
        is_valid = np.isfinite(error) & np.isfinite(measured)
        signal_ss = float(measured[is_valid].sum())
        exceeds_floor = signal_ss > samples * floor**2
        values.append(
            math.sqrt(float(error[is_valid].sum()) / signal_ss) if exceeds_floor else math.nan
        )
    return values[0], values[1]
