"""What the report shows of a run, looked up in its recording and its summary.

Which steps are looked at closely, what was measured there, how far the twin was from it.
"""

import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import ValidationError
from scipy.signal import savgol_filter

from table_io.block import Block, Float1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, rel_disp
from table_io.profile import ComparisonCard, Specimen
from table_io.records import Comparison, Params
from table_io.units import GRAVITY_M_S2
from twin.model.card import ModelCard
from twin.model.model import Model
from twin.stream.recording import Recording

Summary = dict[str, Any]
Envelope = tuple[Float1D, Float1D, Float1D]
DIRECTIONS = ("forward", "backward")
SIDES = ("impacts_right", "impacts_left")
COMPARED_PARTS: dict[str, tuple[str, ...]] = {
    "u": ("rel_disp_m",),
    "a": ("mass_acc_m_s2",),
    "F_R": RIGHT_CELLS,
    "F_L": LEFT_CELLS,
}
MOST_INTERVALS, SLOPE_S, BINS = 2, 0.020, 1600


@dataclass(frozen=True, slots=True)
class Run:
    """A recording, its summary and what the report looks up in them again and again."""

    recording: Recording
    summary: Summary
    streams: dict[str, tuple[Block, ...]]
    specimen: Specimen | None
    contact_n: float

    @property
    def steps(self) -> list[dict[str, Any]]:
        return self.summary["steps"] or []

    @property
    def who(self) -> str:
        """ "measured", or "twin" where nothing was measured."""
        return "measured" if any(step.get("measured") for step in self.steps) else "twin"

    @property
    def gaps_m(self) -> tuple[float, float] | None:
        """(right, left) initial gap in m; None without bumpers or where it is not known."""
        if self.specimen is None or not all(map(math.isfinite, self.specimen.gaps_m)):
            return None
        return self.specimen.gaps_m

    @property
    def bumpers(self) -> bool:
        return self.specimen is None or self.gaps_m is not None


@dataclass(frozen=True, slots=True)
class Motion:
    """Measured cycles of a step, SI, right positive; NaN where there is no sample, (sample,)."""

    time: Float1D
    cycle: Float1D
    u: Float1D
    v: Float1D
    a: Float1D
    force_r: Float1D
    force_l: Float1D

    def last(self, cycles: int) -> "Motion":
        """The last cycles of these, time from their start."""
        first = int(np.argmax(self.cycle > np.nanmax(self.cycle) - cycles))
        cut = {name: getattr(self, name)[first:] for name in self.__slots__}
        return Motion(**{**cut, "time": cut["time"] - cut["time"][0]})


def gather(recording: Recording, summary: Summary) -> Run:
    """The evidence of a run; an import without a profile has no specimen."""
    profile = cards(recording.start.profile_toml)
    try:
        specimen = Specimen.model_validate(profile.get("specimen"))
    except ValidationError:
        specimen = None
    contact_n = ComparisonCard.model_validate(profile.get("comparison") or {}).contact_n
    streams = {name: recording.pieces(name) for name in ("meas", "pred")}
    return Run(recording, summary, streams, specimen, contact_n)


def cards(text: str) -> dict[str, Any]:
    """The cards of a TOML text by name; none where it is damaged."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def quantity(step: dict[str, Any], who: str, name: str) -> float:
    """A quantity of a step, its mean where it is given per cycle; NaN where there is none."""
    found = (step.get(who) or {}).get(name)
    if isinstance(found, list):
        return float(np.mean(found)) if found else math.nan
    return math.nan if found is None else float(found)


def curve(run: Run, who: str, direction: str, name: str) -> tuple[Float1D, Float1D]:
    """(frequency in Hz, quantity) of one direction, upwards; NaN where there is none."""
    points = sorted(
        (step["frequency_hz"], quantity(step, who, name))
        for step in run.steps
        if step["direction"] == direction
    )
    table = np.array(points, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def prestress(run: Run) -> dict[str, float]:
    """Name -> eta_r, eta_l, r_r, r_l of precompressed bumpers at rest; only what is known.

    At a negative gap a bumper is pressed by p_j = -gap_j: eta_j = p_j / u*, r_j = K_j p_j / (M g),
    and from there its curve starts (Stefani, De Angelis, Andreaus, Fig. 5).
    """
    values, u_star = _model(run), run.summary.get("u_star_m") or math.nan
    weight = values.get("mass", math.nan) * GRAVITY_M_S2
    found = {}
    for side, gap in zip("rl", run.gaps_m or (math.nan, math.nan), strict=True):
        pressed = -values.get(f"gap_{side}", gap)
        found[f"eta_{side}"] = pressed / u_star
        found[f"r_{side}"] = values.get(f"bumper_stiffness_{side}", math.nan) * pressed / weight
    return {name: size for name, size in found.items() if 0 < size < math.inf}


def _model(run: Run) -> dict[str, float]:
    """The model's parameters in SI at the start: as recorded, else by its card; {} if unknown."""
    recorded = run.recording.of(Params)
    if recorded:
        try:
            return Model.from_flat(recorded[0].values).parameters.as_dict()
        except ValueError:
            return recorded[0].values
    try:
        card = ModelCard.model_validate(cards(run.recording.start.model_toml))
        return card.model(run.specimen).parameters.as_dict() if run.specimen else {}
    except ValueError:
        return {}


def chosen(run: Run) -> dict[float, str]:
    """Frequency in Hz -> why, upwards, of the steps to look at closely; at most four.

    The middle of the (two widest) hysteresis intervals, the peak of eta_d, and the step with most
    impacts per cycle. Where nothing was measured the twin decides.
    """
    grid = sorted({step["frequency_hz"] for step in run.steps})
    reasons: dict[float, list[str]] = {}
    intervals = run.summary.get("hysteresis") or []
    widest = sorted(intervals, key=lambda one: one["from_hz"] - one["to_hz"])
    for one in widest[:MOST_INTERVALS] if grid else ():
        middle = (one["from_hz"] + one["to_hz"]) / 2
        near = min(grid, key=lambda hz: abs(hz - middle))
        reasons.setdefault(near, []).append(f"inside the {one['kind']} hysteresis")
    for names, why in ((("eta_d",), "largest excursion"), (SIDES, "most impacts per cycle")):
        sizes = [sum(quantity(step, run.who, name) for name in names) for step in run.steps]
        if np.nanmax([0.0, *sizes]) > 0:
            best = run.steps[int(np.nanargmax(sizes))]["frequency_hz"]
            reasons.setdefault(best, []).append(why)
    return {hz: ", ".join(reasons[hz]) for hz in sorted(reasons)}


def motion(run: Run, stream: str, step: int) -> Motion | None:
    """The measured cycles of a step in "meas", or of the free-running twin in "pred"."""
    parts = []
    for piece in run.streams[stream]:
        held = np.flatnonzero((piece.step == step) & (piece.label == Label.MEASURE)) + piece.index
        if held.size:
            parts.append(piece.cut(int(held[0]), int(held[-1]) + 1))
    if not parts:
        return None
    first, size = parts[0].index, parts[-1].end - parts[0].index
    values = np.full((len(parts[0].channels), size), np.nan)
    cycle = np.full(size, np.nan)
    for part in parts:
        values[:, part.index - first : part.end - first] = part.values
        cycle[part.index - first : part.end - first] = part.cycle
    names = tuple(name.removeprefix("free/") for name in parts[0].channels)
    none = np.full(size, -1, dtype=np.int64)
    whole = Block(stream, first, parts[0].rate_hz, names, values, none, none, none)
    u, lost = rel_disp(whole), np.full(size, np.nan)
    v = whole.channel("rel_vel_m_s") if "rel_vel_m_s" in names else _slope(u, whole.rate_hz)
    a = whole.channel("mass_acc_m_s2") if "mass_acc_m_s2" in names else lost
    return Motion(whole.time_s - whole.time_s[0], cycle, u, v, a, *contact_forces(whole))


def _slope(u: Float1D, rate_hz: float) -> Float1D:
    """u' by a Savitzky-Golay fit over 20 ms, for pictures only; NaN at both ends."""
    half = max(2, round(SLOPE_S * rate_hz / 2))
    v = np.full(u.size, np.nan)
    if u.size > 2 * half:
        fitted = savgol_filter(u, 2 * half + 1, 3, deriv=1, delta=1 / rate_hz, mode="nearest")
        v[half:-half] = fitted[half:-half]
    return v


def pairs(run: Run, hz: float) -> list[tuple[str, Motion | None, Motion | None]]:
    """(direction, measured, twin) of a frequency, for each direction that has cycles there."""
    found = []
    for step in run.steps:
        if step["frequency_hz"] == hz:
            both = motion(run, "meas", step["index"]), motion(run, "pred", step["index"])
            if any(one is not None and np.isfinite(one.u).any() for one in both):
                found.append((step["direction"], *both))
    return found


def envelopes(run: Run) -> tuple[tuple[Block, ...], dict[str, list[Envelope]]]:
    """(the whole run, row of the overview -> its envelopes); no row where nothing was sampled."""
    name, track = ("meas", "") if run.who == "measured" else ("pred", "free/")
    pieces = run.streams[name] or run.streams["meas"]

    def get(block: Block, channel: str) -> Float1D:
        lost = np.full(len(block), np.nan)
        return block.channel(track + channel) if track + channel in block.channels else lost

    rows = {
        "table in mm": lambda block: get(block, "table_disp_m") * 1e3,
        "table in m/s²": lambda block: get(block, "table_acc_m_s2"),
        "$u$ in mm": lambda block: (get(block, "rel_disp_m") if track else rel_disp(block)) * 1e3,
    }
    low_hz = min((step["frequency_hz"] for step in run.steps), default=1.0)
    every = {
        label: [_envelope(piece, of, low_hz) for piece in pieces] for label, of in rows.items()
    }
    return pieces, {
        label: found
        for label, found in every.items()
        if any(np.isfinite(low).any() for _, low, _ in found)
    }


def _envelope(block: Block, of: Callable[[Block], Float1D], low_hz: float) -> Envelope:
    """(time, smallest, largest) of bins that hold a whole cycle; NaN where nothing was sampled."""
    width = max(len(block) // BINS, round(block.rate_hz / low_hz), 1)
    starts = np.arange(0, len(block), width)
    values = of(block)
    middle = block.time_s[np.minimum(starts + width // 2, len(block) - 1)]
    return middle, np.fmin.reduceat(values, starts), np.fmax.reduceat(values, starts)


def step_errors(run: Run) -> dict[str, dict[int, tuple[float, float]]]:
    """Part -> step -> NRMSE of (free, restarted) twin over blocks wholly in its measured cycles.

    Contact forces are left out where there was no contact: noise has no NRMSE worth a picture.
    """
    records = run.recording.of(Comparison)
    owner = np.full(max((piece.end for piece in run.streams["meas"]), default=0), -1)
    for piece in run.streams["meas"]:
        owner[piece.index : piece.end] = np.where(piece.label == Label.MEASURE, piece.step, -1)
    of_step: dict[int, list[Comparison]] = {}
    for one in (one for one in records if one.index + one.count <= owner.size):
        step = int(owner[one.index])
        if step >= 0 and step == owner[one.index + one.count - 1]:
            of_step.setdefault(step, []).append(one)
    errors: dict[str, dict[int, tuple[float, float]]] = {part: {} for part in COMPARED_PARTS}
    for step, ones in of_step.items():
        for part, names in COMPARED_PARTS.items():
            columns = [k for k, name in enumerate(ones[0].channels) if name in names]
            floor = run.contact_n / 2 if part.startswith("F") else 0.0
            if columns:
                errors[part][step] = _nrmse(ones, columns, floor)
    return errors


def _nrmse(ones: list[Comparison], columns: list[int], floor: float) -> tuple[float, float]:
    """(free, restarted): root of error over measured squares; NaN below `floor` r.m.s."""
    measured = np.array([one.measured_ss for one in ones])[:, columns]
    samples = sum(one.count for one in ones)
    both = []
    for sums in ([one.free_error_ss for one in ones], [one.window_error_ss for one in ones]):
        error = np.array(sums)[:, columns]
        good = np.isfinite(error) & np.isfinite(measured)
        size = float(measured[good].sum())
        loud = size > samples * floor**2
        both.append(math.sqrt(float(error[good].sum()) / size) if loud else math.nan)
    return both[0], both[1]
