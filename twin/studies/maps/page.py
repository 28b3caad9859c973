"""Page of a study: its plan, figures, indices and tables, from the stored results."""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.block import Float2D
from twin.drawing.page import embed_images, write_page
from twin.studies.maps.figures import draw_outcome_figures, group_front, label_variable
from twin.studies.maps.outcomes import OutcomeVariable
from twin.studies.maps.results import (
    SensitivityIndices,
    StudyResults,
    compute_sensitivity,
    format_plain,
    format_unit,
)
from twin.system.files import is_folder_locked

MAX_TABLE_CASES = 200_000  # in cases.csv
MAX_FRONT_ROWS = 12  # of each front on the page
MAX_REASONS = 5
IDEAL_SWEEP = "the model under the ideal stepped sine of “{}”"


def write_map_page(folder: Path) -> Path:
    """Write report.html, its figures and tables to the folder of a study; return the page."""
    results = StudyResults(folder)
    sensitivity = analyse_sensitivity(results)
    pictures = draw_outcome_figures(results, sensitivity, folder / "figures")
    has_table = write_case_table(results, folder / "cases.csv")
    study, manifest = results.study, results.manifest
    config = study.config
    failures = manifest.failures
    return write_page(
        folder,
        Path(__file__).with_name("map.html"),
        config=config,
        state=find_state(results),
        simulated=[
            outcome.test or IDEAL_SWEEP.format(study.profile.title) for outcome in study.outcomes
        ],
        stored=manifest.case_count,
        failures=len(failures),
        reasons=sorted(set(failures.values()))[:MAX_REASONS],
        parameters=[describe_range(results, index) for index in range(len(config.parameters))],
        variables=[_summarise_variable(results, variable) for variable in results.scalars],
        has_table=has_table,
        sensitivity=_list_indices(results, sensitivity),
        front=write_front_table(results, folder / "front.csv"),
        images=embed_images(pictures),
        study_toml=study.study_toml,
        model_toml=study.model_toml,
        profile_toml=study.profile_toml,
    )


def find_state(results: StudyResults) -> str:
    """Return "complete", "running" or "stopped"."""
    if results.manifest.case_count == results.study.config.case_count:
        return "complete"
    return "running" if is_folder_locked(results.folder) else "stopped"


def analyse_sensitivity(results: StudyResults) -> dict[str, SensitivityIndices]:
    """Return the Sobol indices of each outcome; empty unless the study is made for them."""
    config = results.study.config
    if config.sampling != "sensitivity":
        return {}
    return {
        variable.name: compute_sensitivity(
            results.read_by_case(variable.name), len(config.parameters), config.seed
        )
        for variable in results.scalars
    }


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """Name, range and number of values of a parameter, as the page shows them."""

    name: str
    range: str
    values: str


def describe_range(results: StudyResults, index: int) -> ParameterRange:
    """Return range and number of values of a parameter."""
    parameter = results.study.config.parameters[index]
    low, high = parameter.limits
    unit = results.find_unit(parameter.name)
    ends = f"{format_plain(low)} to {format_plain(high)} {format_unit(unit)}"
    values = f"{parameter.grid_size} values" if results.is_grid else "samples"
    scale = ", evenly in the logarithm" if parameter.scale == "log" else ""
    return ParameterRange(parameter.name, ends.replace("-", "−"), values + scale)


@dataclass(frozen=True, slots=True)
class VariableSpread:
    """Smallest, median and largest value of an outcome, and how many cases lack it."""

    title: str
    name: str
    unit: str
    quantiles: list[float | None]
    missing: int


def _summarise_variable(results: StudyResults, variable: OutcomeVariable) -> VariableSpread:
    values = results.read_by_case(variable.name)[results.stored_flags]
    finite = values[np.isfinite(values)]
    quantiles = np.quantile(finite, [0, 0.5, 1]).tolist() if finite.size else [None] * 3
    missing = int(values.size - finite.size)
    unit = format_unit(variable.unit)
    return VariableSpread(variable.title, variable.name, unit, quantiles, missing)


def write_case_table(results: StudyResults, path: Path) -> bool:
    """Write parameters and outcomes of every case as CSV; False where they are too many."""
    config = results.study.config
    if config.case_count > MAX_TABLE_CASES:
        return False
    names = [parameter.name for parameter in config.parameters]
    names += [variable.name for variable in results.scalars]
    columns = [results.read_by_case(name).tolist() for name in names]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["case", *names])
        writer.writerows(zip(range(config.case_count), *columns, strict=True))
    return True


@dataclass(frozen=True, slots=True)
class FrontRows:
    """Cases of a front, thinned out: values of the parameters and of both outcomes."""

    title: str
    rows: list[list[float]]


@dataclass(frozen=True, slots=True)
class LeastCase:
    """Case of a front with the least first outcome within a limit of the second; None without."""

    title: str
    limit: float
    row: list[float] | None


@dataclass(frozen=True, slots=True)
class FrontTable:
    """Fronts of a study as the page shows them, with their heads; outcomes `first`, `second`."""

    heads: list[str]
    least_heads: list[str]
    first: str
    second: str
    groups: list[FrontRows]
    least: list[LeastCase]
    edges: list[str]


def write_front_table(results: StudyResults, path: Path) -> FrontTable | None:
    """Write the cases of every front as CSV; return what the page shows of them."""
    front = results.study.config.front
    if front is None:
        return None
    names = [parameter.name for parameter in results.study.config.parameters]
    columns = {name: results.read_by_case(name) for name in (*names, *front.minimise)}

    def read_row(case: int, without: str = "") -> list[float]:
        return [float(values[case]) for name, values in columns.items() if name != without]

    groups, least, all_rows = [], [], []
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["case", *columns])
        for group in group_front(results):
            cases = group.cases[group.front].tolist()
            rows = [read_row(case) for case in cases]
            writer.writerows([case, *row] for case, row in zip(cases, rows, strict=True))
            all_rows += rows
            thinned = np.unique(
                np.linspace(0, len(cases) - 1, min(len(cases), MAX_FRONT_ROWS)).round().astype(int)
            )
            groups.append(FrontRows(group.title, [rows[index] for index in thinned]))
            for limit in front.limits:
                case = group.find_least(limit)
                row = None if case is None else read_row(case, without=front.each)
                least.append(LeastCase(group.title, limit, row))
    by_name = {variable.name: variable for variable in results.scalars}
    first, second = (label_variable(by_name[name]) for name in front.minimise)
    heads = {name: results.label_parameter(name) for name in names}
    least_heads = [head for name, head in heads.items() if name != front.each]
    return FrontTable(
        [*heads.values(), first, second],
        [*least_heads, first, second],
        first,
        second,
        groups,
        least,
        _describe_edges(results, np.array(all_rows)),
    )


def _describe_edges(results: StudyResults, rows: Float2D) -> list[str]:
    """Return the parameters, and values, of which every front lies at an end of the range."""
    front, edges = results.study.config.front, []
    for column, parameter in enumerate(results.study.config.parameters if rows.size else ()):
        is_free = front is not None and parameter.name != front.each
        for end in parameter.limits if is_free else ():
            if np.isclose(rows[:, column], end, rtol=1e-9).all():
                edges.append(results.describe_value(parameter.name, end))
    return edges


@dataclass(frozen=True, slots=True)
class IndexRow:
    """Sobol indices of an outcome and a parameter with their intervals."""

    outcome: str
    parameter: str
    first: float
    first_interval: list[float]
    total: float
    total_interval: list[float]
    used_share: float


def _list_indices(
    results: StudyResults, sensitivity: dict[str, SensitivityIndices]
) -> list[IndexRow]:
    """Return a row of the page per outcome and parameter."""
    rows = []
    titles = {variable.name: variable.title for variable in results.scalars}
    for name, indices in sensitivity.items():
        for column, parameter in enumerate(results.study.config.parameters):
            rows.append(
                IndexRow(
                    titles[name],
                    parameter.name,
                    float(indices.first[column]),
                    indices.first_interval[:, column].tolist(),
                    float(indices.total[column]),
                    indices.total_interval[:, column].tolist(),
                    indices.used_share,
                )
            )
    return rows
