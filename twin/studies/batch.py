"""One sweep of a batch: the task of `simulate`, in a thread or on a worker of a cluster."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain
from typing import Any

from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.records import PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import detect_hysteresis
from twin.model.config import ModelConfig
from twin.model.ideal_response import simulate_sweep
from twin.model.parameters import free_flight_resonance
from twin.model.valid_range import RangeExit, select_first_exits
from twin.results import ideal_points
from twin.results.summary import make_intervals, make_jumps
from twin.studies.cases import StudyCase, build_cases
from twin.studies.result import (
    IMPACT_COLUMNS,
    RATIO_COLUMNS,
    CaseSummary,
    Row,
    SweepPeak,
    SweepPoint,
)


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
                **{name: getattr(point.twin, name) for name in RATIO_COLUMNS},
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
