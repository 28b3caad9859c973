"""One HTML file that tells a run, and the evidence its pictures are drawn from.

What the summary states is shown as it stands there; the file refers to nothing outside itself.
"""

import base64
import json
import math
import tomllib
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from pydantic import ValidationError
from scipy.signal import savgol_filter

from table_io.block import Block, Float1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, rel_disp
from table_io.profile import BadInput, ComparisonCard, Specimen
from table_io.records import Comparison, Event, Fault, Gap, Params, Timing
from twin.stream.mcap_log import Recording, read

if TYPE_CHECKING:
    from twin.service.figures import Picture

Summary = dict[str, Any]
DIRECTIONS = ("forward", "backward")
SIDES = ("impacts_right", "impacts_left")
COMPARED_PARTS: dict[str, tuple[str, ...]] = {
    "u": ("rel_disp_m",),
    "a": ("mass_acc_m_s2",),
    "F_R": RIGHT_CELLS,
    "F_L": LEFT_CELLS,
}
MOST_INTERVALS, SLOPE_S, MOST_ROWS = 2, 0.020, 200


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
    cards = _toml(recording.start.profile_toml)
    try:
        specimen = Specimen.model_validate(cards.get("specimen"))
    except ValidationError:
        specimen = None
    contact_n = ComparisonCard.model_validate(cards.get("comparison") or {}).contact_n
    streams = {name: recording.pieces(name) for name in ("meas", "pred")}
    return Run(recording, summary, streams, specimen, contact_n)


def _toml(text: str) -> dict[str, Any]:
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


def write_report(folder: Path) -> Path:
    """Path of folder/report.html, written anew with its figures from run.mcap and summary.json."""
    from twin.service.figures import draw_all  # matplotlib is slow to import

    summary = _summary(folder / "summary.json")
    recording = read(folder / "run.mcap")
    pictures = draw_all(recording, summary, folder / "figures")
    page = folder / "report.html"
    page.write_text(render(gather(recording, summary), pictures), encoding="utf-8")
    return page


def _summary(path: Path) -> Summary:
    """The summary of a run; BadInput where it is missing, damaged or something else."""
    remedy = "give the folder that run, replay or simulate wrote"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        for step in summary["steps"]:
            _ = step["index"], step["frequency_hz"], step["direction"]
        _ = summary["run"].get("name"), summary["verdict"]
    except FileNotFoundError:
        raise BadInput(f"{path}: no such summary; {remedy}") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot read this summary: {error}; {remedy}") from None
    except (KeyError, TypeError, AttributeError) as error:
        raise BadInput(f"{path}: not the summary of a run (missing: {error}); {remedy}") from None
    return dict(summary)


def significant(value: Any, digits: int = 3) -> str:
    """A number with that many significant digits, never in E notation; a dash for none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    if decimals > 9:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10^{int(exponent)}".replace("-", "−")
    return f"{value:.{decimals}f}".replace("-", "−")


def render(run: Run, pictures: "list[Picture]") -> str:
    """The page, with every picture inside it."""
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sig"] = significant
    start, recording = run.recording.start, run.recording
    texts = {name: getattr(start, f"{name}_toml") for name in ("profile", "rig", "model")}
    return environment.get_template("report.html").render(
        run=run,
        summary=run.summary,
        start=start,
        headline=headline(run),
        cards={name: _toml(text) for name, text in texts.items()},
        images=[(one, base64.b64encode(one.path.read_bytes()).decode()) for one in pictures],
        demand={step.index: step.acceleration_m_s2 for step in start.steps},
        texts=[(name, sha256(text.encode()).hexdigest(), text) for name, text in texts.items()],
        timings={one.component: one for one in recording.of(Timing)},
        gaps=recording.of(Gap),
        faults=recording.of(Fault),
        events=recording.of(Event),
        parameters=recording.of(Params),
        most_rows=MOST_ROWS,
        quantity=quantity,
    )


def headline(run: Run) -> str:
    """One sentence: how far it came, what it found."""
    done = sum(1 for step in run.steps if step.get("measured") or step.get("twin"))
    said = [f"{done} of {len(run.recording.start.steps) or len(run.steps)} steps"]
    said += [
        f"{one['kind']} hysteresis {one['from_hz']:g} to {one['to_hz']:g} Hz"
        for one in run.summary.get("hysteresis") or []
    ] or ["no hysteresis"]
    sizes = np.nan_to_num([quantity(step, run.who, "eta_d") for step in run.steps])
    if sizes.any():
        best = run.steps[int(np.argmax(sizes))]
        where = f"{best['frequency_hz']:g} Hz {best['direction']}"
        said.append(f"largest normalised excursion {significant(sizes.max())} at {where}")
    return "; ".join(said) + "."
