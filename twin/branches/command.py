"""`branches`: follow the periodic motions of a model, stable and unstable, over a parameter."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.table import Table

from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.branches.map_page import format_map_headline, write_map_report
from twin.branches.page import list_bifurcations, write_branch_report
from twin.drawing.attractor_study import study_attractors
from twin.drawing.branch_curves import BranchSet, make_axis
from twin.dynamics.diagram import compute_diagram
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import compute_resonance_map, follow_main_branches
from twin.dynamics.period_map import FREQUENCY, GAP, LEVEL, find_parameter, set_total_gap
from twin.model.model import Model
from twin.setup.folders import make_output_folder
from twin.setup.run_config import RunConfig, make_run_id, read_run_config
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.system.files import count_cores
from twin.system.terminal import announce_if_slow, console, print_line

MAP_VALUES = 41  # of the second parameter, spread evenly over its range
ATTRACTOR_MESSAGE = "following the attractors and their basins; chaos takes half a minute"
FACTORS = {GAP: 1e-3, LEVEL: GRAVITY_M_S2}  # SI of one unit at the command line; 1 for all others


@dataclass(frozen=True, slots=True)
class BranchRequest:
    """Arguments of `branches`; gap in mm, level in g, `low` and `high` in the unit of `over`.

    Over another parameter than the frequency without `at_hz`: a map of the resonance.
    """

    profile: Path
    model: str | None
    gap: float | None
    level: float | None
    over: str
    low: float | None
    high: float | None
    at_hz: float | None
    complete: bool
    attractors: bool
    basins_hz: float | None
    out: Path | None


def show_branches(request: BranchRequest) -> int:
    """Compute the branches, print their bifurcations and write the report; return the exit code."""
    config = read_run_config(request.profile, None, request.model)
    model = config.model
    if request.gap is not None:
        model = set_total_gap(model, request.gap / 1e3)
    level = find_level(config, request)
    limits = find_limits(config, model, request)
    title, toml = config.profile.title, config.model_toml
    frequency_hz = find_frequency(config, request)
    check_attractors(request, frequency_hz)
    folder = make_output_folder(request.out, make_run_id(f"{config.name}-branches"))
    if frequency_hz is None:
        plan = config.profile.plan
        with announce_if_slow(COMPILING_MESSAGE):
            resonance = compute_resonance_map(
                make_period_map(model, plan.low_hz, level),
                request.over,
                np.linspace(*limits, MAP_VALUES),
                (plan.low_hz, plan.high_hz),
            )
        subtitle = f"{plan.low_hz:g} to {plan.high_hz:g} Hz, {level / GRAVITY_M_S2:.4g} g"
        page = write_map_report(folder, resonance, title, subtitle, toml)
        print_line(f"{format_map_headline(resonance)} -> {page}")
        return 0
    branches = compute_branches(model, limits, level, frequency_hz, request)
    attractors = None
    if request.attractors or request.basins_hz is not None:
        period_map = make_period_map(model, frequency_hz, level)
        cores = count_cores()
        with announce_if_slow(ATTRACTOR_MESSAGE), ThreadPoolExecutor(cores) as pool:
            attractors = study_attractors(
                period_map, request.over, limits, request.basins_hz, pool.map
            )
        bands = tuple((band.low, band.high) for band in attractors.bands)
        branches = replace(branches, chaotic=bands)
    place = f", {frequency_hz:g} Hz" if request.over != FREQUENCY else ""
    gap = "" if request.over == GAP else f", total gap {1e3 * find_parameter(model, GAP):.4g} mm"
    drive = "" if request.over == LEVEL else f"{level / GRAVITY_M_S2:.4g} g"
    subtitle = f"{drive}{place}{gap}".lstrip(", ")
    page = write_branch_report(folder, branches, title, subtitle, toml, attractors)
    print_bifurcations(branches)
    count = len(branches.branches)
    print_line(f"{count} branch{'es' if count != 1 else ''} -> {page}")
    return 0


def compute_branches(
    model: Model,
    limits: tuple[float, float],
    level: float,
    frequency_hz: float,
    request: BranchRequest,
) -> BranchSet:
    """Follow the main branches, or search for all of them."""
    if not request.complete:
        with announce_if_slow(COMPILING_MESSAGE):
            period_map = make_period_map(model, frequency_hz, level)
            main = follow_main_branches(period_map, limits, parameter=request.over)
        return BranchSet(main)
    with announce_if_slow("searching for every motion; a range with chaos takes minutes"):
        diagram = compute_diagram(
            model, limits, level, parameter=request.over, frequency_hz=frequency_hz
        )
    bands = tuple((band.low, band.high) for band in diagram.chaotic_bands)
    return BranchSet(diagram.branches, bands)


def find_level(config: RunConfig, request: BranchRequest) -> float:
    """Return the peak table acceleration in m/s2: as asked, or that of the test."""
    if request.level is None:
        return config.profile.plan.level_m_s2
    if not 0 < request.level < float("inf"):
        raise InputError(
            "not a level", key="--level", value=request.level, allowed="above 0 g, finite"
        )
    return request.level * GRAVITY_M_S2


def find_limits(config: RunConfig, model: Model, request: BranchRequest) -> tuple[float, float]:
    """Return the range of the parameter in SI: as asked; for the frequency that of the test."""
    low, high = request.low, request.high
    if request.over == FREQUENCY:
        plan = config.profile.plan
        low = plan.low_hz if low is None else low
        high = plan.high_hz if high is None else high
    elif request.over != LEVEL:
        find_parameter(model, request.over)  # refuses unknown names
    if low is None or high is None:
        raise InputError(
            f"the range of {request.over} is missing",
            key="--from, --to",
            remedy=f"give both, in the unit of the {make_axis(request.over).label}",
        )
    if not low < high or (request.over in (FREQUENCY, LEVEL) and low <= 0):
        raise InputError(
            "not a range",
            key="--from, --to",
            value=f"{low:g} to {high:g}",
            allowed="ascending; above 0 for frequency and level",
        )
    factor = FACTORS.get(request.over, 1.0)
    return low * factor, high * factor


def find_frequency(config: RunConfig, request: BranchRequest) -> float | None:
    """Return the drive frequency in Hz where another parameter varies; None for all of the test."""
    if request.over == FREQUENCY:
        if request.at_hz is not None:
            raise InputError(
                "the branch is followed over the frequency",
                key="--at",
                value=request.at_hz,
                remedy="omit it, or choose another --over",
            )
        return config.profile.plan.low_hz
    if request.at_hz is not None and not request.at_hz > 0:
        raise InputError("not a frequency", key="--at", value=request.at_hz, allowed="above 0 Hz")
    return request.at_hz


def check_attractors(request: BranchRequest, frequency_hz: float | None) -> None:
    """Raise InputError if the attractors cannot be followed as asked."""
    basins_hz = request.basins_hz
    if basins_hz is not None and not 0 < basins_hz < float("inf"):
        raise InputError(
            "not a frequency", key="--basins", value=basins_hz, allowed="above 0 Hz, finite"
        )
    if frequency_hz is None and (request.attractors or basins_hz is not None):
        raise InputError(
            f"the frequency at which {request.over} varies is missing, for the attractors",
            key="--at",
            allowed="above 0 Hz",
        )


def print_bifurcations(branches: BranchSet) -> None:
    """Print a table of the bifurcations."""
    axis, rows = branches.axis, list_bifurcations(branches)
    if not rows:
        print_line("no bifurcation in this range")
        return
    table = Table(box=None, header_style="")
    for header in ("kind", axis.label, "u in mm", "period", "what happens"):
        right = header not in ("kind", "what happens")
        table.add_column(header, justify="right" if right else "left")
    for row in rows:
        table.add_row(row["kind"], row["x"], row["u"], str(row["period"]), row["meaning"])
    console.print(table)
