"""Cases of a batch: every requested model at every requested gap."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from table_io.config.folders import find_config
from table_io.config.profile import Profile, Specimen
from table_io.errors import InputError
from twin.dynamics.period_map import set_total_gap
from twin.model.config import ModelConfig
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.setup.run_config import read_model

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
    profile: Profile,
    configs: Mapping[str, ModelConfig],
    gaps: Sequence[float],
    context: str,
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
        simulate_sweep(model, [slowest_hz], 0.0, 1)
    except InputError as error:
        raise error.add_place(f"{context}: {case.name}") from None
