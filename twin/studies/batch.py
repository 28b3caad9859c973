"""Sweeps of a batch: every requested model at every requested gap, and the sweep of one."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

from table_io.config.base import parse_toml
from table_io.config.folders import find_config
from table_io.config.profile import Profile, Specimen
from table_io.errors import InputError
from table_io.records import RESPONSE_RATIOS, PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import detect_hysteresis
from twin.dynamics.period_map import set_total_gap
from twin.model.config import ModelConfig
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.model.valid_range import RangeExit, select_first_exits
from twin.results import ideal_points
from twin.results.summary import make_intervals, make_jumps
from twin.setup.law_limits import check_laws
from twin.setup.run_config import read_model
from twin.studies.result import (
    IMPACT_COLUMNS,
    CaseSummary,
    Row,
    SweepPeak,
    SweepPoint,
)

MAX_CASES = 10_000
GAP_HELP = "allowed: a number of mm, inf for no bumpers, or FROM:TO:STEP in mm, as 0:30:2"
GAP_TOLERANCE_MM = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class StudyCase:
    """One model at one total gap; `label` names the model in rows and figures."""

    label: str
    gap_mm: float
    model: Model

    @property
    def name(self) -> str:
        return f"{self.label}, {format_gap_mm(self.gap_mm)}"


def format_gap_mm(gap_mm: float) -> str:
    """Format a total gap in mm for display."""
    return "no bumpers" if math.isinf(gap_mm) else f"G = {gap_mm:g} mm"


def parse_gaps_mm(words: Sequence[str]) -> list[float]:
    """Parse total gaps in mm, with ranges expanded, in the given order.

    Raises InputError for an invalid or repeated gap.
    """
    gaps: dict[float, str] = {}
    for word in words:
        for gap in _parse_range(word) if ":" in word else [_parse_number(word, word)]:
            if math.isnan(gap) or gap == -math.inf:
                raise _make_gap_error(word)
            duplicate = next(
                (
                    known_gap
                    for known_gap in gaps
                    if known_gap == gap or abs(known_gap - gap) < GAP_TOLERANCE_MM
                ),
                None,
            )
            if duplicate is not None:
                raise InputError(
                    f"{gap:g} mm is also in --gap {gaps[duplicate]}",
                    where=f"--gap {word}",
                    remedy="keep one",
                )
            gaps[gap] = word
    return list(gaps)


def _make_gap_error(word: str) -> InputError:
    return InputError("not a gap", where=f"--gap {word}", allowed=GAP_HELP)


def _parse_number(text: str, word: str) -> float:
    try:
        return float(text) + 0.0  # converts -0 to 0
    except ValueError:
        raise _make_gap_error(word) from None


def _parse_range(word: str) -> list[float]:
    """Expand FROM:TO:STEP to gaps in mm, both ends included."""
    ends = [_parse_number(text, word) for text in word.split(":")]
    if len(ends) != 3 or not all(map(math.isfinite, ends)):
        raise _make_gap_error(word)
    start, stop, step = ends
    if step == 0 or (stop - start) * step < 0:
        raise InputError(
            f"step {step:g} does not lead from {start:g} to {stop:g} mm", where=f"--gap {word}"
        )
    if (stop - start) / step > MAX_CASES:
        raise InputError(
            f"more than {MAX_CASES} gaps", where=f"--gap {word}", remedy="use a larger step"
        )
    step_count = round((stop - start) / step)
    if abs(start + step_count * step - stop) > GAP_TOLERANCE_MM:
        nearest_step = (stop - start) / max(step_count, 1)
        raise InputError(
            f"step {step:g} does not divide {start:g} to {stop:g} mm",
            where=f"--gap {word}",
            remedy=f"nearest: {nearest_step:.6g}",
        )
    return [round(start + k * step, 9) + 0.0 for k in range(step_count + 1)]


def read_models(words: Sequence[str], profile: Path) -> dict[str, tuple[ModelConfig, str]]:
    """Read (model config, TOML text) by label; the label of a file is its name without .toml."""
    paths = [find_config(word, "models", profile, "--model").resolve() for word in words]
    configs: dict[str, tuple[ModelConfig, str]] = {}
    for index, (word, path) in enumerate(zip(words, paths, strict=True)):
        if path in paths[:index]:
            raise InputError("given twice", where=f"--model {word}", remedy="keep one")
        has_unique_stem = [other_path.stem for other_path in paths].count(path.stem) == 1
        configs[path.stem if has_unique_stem else word.removesuffix(".toml")] = read_model(
            word, profile
        )
    return configs


def build_cases(
    profile: Profile, configs: Mapping[str, ModelConfig], gaps: Sequence[float], context: str
) -> list[StudyCase]:
    """Build a case per model and gap, models outermost; without `gaps`, at the profile's gap."""
    if len(configs) * max(len(gaps), 1) > MAX_CASES:
        raise InputError(
            f"{len(configs)} models at {len(gaps)} gaps are too many",
            allowed=f"{MAX_CASES} cases",
            remedy="give fewer gaps",
        )
    cases: list[StudyCase] = []
    at_gap: dict[float, list[StudyCase]] = {}
    for label, config in configs.items():
        for gap, model in _models_at_gaps(
            config, profile.specimen, gaps, f"{context}: model {label}"
        ):
            case = StudyCase(label, gap, model)
            for other in at_gap.setdefault(gap, []):
                if other.model == model:
                    raise InputError(
                        f"models {other.label} and {label} are identical",
                        where=context,
                        remedy="keep one",
                    )
            at_gap[gap].append(case)
            _require_simulable(case, profile, context)
            cases.append(case)
    return cases


def _models_at_gaps(
    config: ModelConfig, specimen: Specimen, gaps: Sequence[float], context: str
) -> list[tuple[float, Model]]:
    """Return (total gap in mm, model) for each gap, or for the gap of the specimen."""
    try:
        model = config.build_model(specimen)
        if not gaps:
            return [(round(1e3 * sum(specimen.gaps_m), 9), model)]
        return [(gap, set_total_gap(model, gap / 1e3)) for gap in gaps]
    except InputError as error:
        raise error.add_place(context) from None


def _require_simulable(case: StudyCase, profile: Profile, context: str) -> None:
    """Raise InputError if the sampling rate of the profile, or the sweep, cannot resolve a model.

    One simulated cycle at the lowest frequency also compiles the kernels in advance.
    """
    model, slowest_hz = case.model, profile.sweep.frequencies_hz[0]
    try:
        free_flight_resonance(model.parameters, 1.0)
        model.check_rate(profile.acquisition.rate_hz)
        check_laws(model, profile)
        simulate_sweep(model, [slowest_hz], 0.0, 1)
    except InputError as error:
        raise error.add_place(f"{context}: {case.name}") from None


@dataclass(frozen=True, slots=True)
class Batch:
    """Every model at every gap under the sweep of a test, as texts from which workers build them.

    `models`: (label, TOML text); `gaps_mm`: total gaps, empty for that of the test; `source` is
    named in errors.
    """

    source: str
    profile_toml: str
    models: tuple[tuple[str, str], ...]
    gaps_mm: tuple[float, ...]


@lru_cache(maxsize=1)
def read_batch(batch: Batch) -> tuple[Profile, list[StudyCase]]:
    """Return the test and the cases of a batch, models outermost; InputError without a model."""
    profile = parse_toml(batch.profile_toml, Profile, batch.source)
    configs = {
        label: parse_toml(text, ModelConfig, f"{batch.source}: model {label}")
        for label, text in batch.models
    }
    return profile, build_cases(profile, configs, batch.gaps_mm, batch.source)


@dataclass(frozen=True, slots=True)
class CaseResult:
    """Rows of the table, the entry of summary.json, and where laws leave their fitted ranges."""

    rows: list[Row]
    entry: CaseSummary
    range_exits: list[RangeExit]


def simulate_case(batch: Batch, number: int) -> CaseResult:
    """Simulate the sweep of one case from rest; return its results."""
    profile, cases = read_batch(batch)
    case, sweep = cases[number], profile.sweep
    acceleration = sweep.one_level_g * GRAVITY_M_S2
    frequencies = [step.frequency_hz for step in sweep.steps]
    response = simulate_sweep(case.model, frequencies, acceleration, sweep.cycles)
    points = ideal_points.compute_prc_points(
        case.model, sweep.steps, response, sweep.cycles, sweep.measured_cycles
    )
    exits = list(select_first_exits(chain.from_iterable(response.range_exits)))
    return CaseResult(
        list(_make_rows(case, points)), _summarise_case(case, points, acceleration, exits), exits
    )


def _make_rows(case: StudyCase, points: Sequence[PrcPoint]) -> Iterator[Row]:
    """Yield a row per PRC point; impacts are means per cycle."""
    for point in points:
        if point.twin is not None:
            yield {
                "model": case.label,
                "gap_mm": case.gap_mm,
                "direction": point.direction,
                "frequency_hz": point.frequency_hz,
                **{name: getattr(point.twin, name) for name in RESPONSE_RATIOS},
                **{name: _mean_impacts(getattr(point.twin, name)) for name in IMPACT_COLUMNS},
            }


def _mean_impacts(counts: tuple[int, ...]) -> float:
    return sum(counts) / len(counts) if counts else math.nan


def _summarise_case(
    case: StudyCase,
    points: tuple[PrcPoint, ...],
    acceleration_m_s2: float,
    range_exits: Sequence[RangeExit],
) -> CaseSummary:
    """Return the entry of a case in summary.json."""
    u_star, a_star, peak_hz = free_flight_resonance(case.model.parameters, acceleration_m_s2)
    jumps, intervals = detect_hysteresis(points, "twin")
    bounded, unbounded = [], []
    for point in points:
        place: dict[str, Any] = {"frequency_hz": point.frequency_hz, "direction": point.direction}
        if point.twin and math.isfinite(point.twin.eta_d):
            bounded.append(SweepPeak(**place, eta_d=point.twin.eta_d))
        else:
            unbounded.append(SweepPoint(**place))
    return CaseSummary(
        model=case.label,
        gap_mm=case.gap_mm,
        u_star_m=u_star,
        a_star_m_s2=a_star,
        free_flight_hz=peak_hz,
        peak=max(bounded, key=lambda peak: peak.eta_d, default=None),
        jumps=make_jumps(jumps),
        hysteresis=make_intervals(intervals),
        unbounded_from=next(iter(unbounded), None),
        warnings=tuple(map(str, range_exits)),
    )
