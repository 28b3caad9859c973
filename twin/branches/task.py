"""Task: follow the periodic motions of a model, stable and unstable, over a parameter."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.branches.page import write_branch_report
from twin.branches.resonance_map import write_map_report
from twin.drawing.basin_figures import AttractorStudy, study_attractors
from twin.drawing.branch_curves import BranchSet, make_axis
from twin.dynamics.diagram import compute_diagram
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import ResonanceMap, compute_resonance_map, follow_main_branches
from twin.dynamics.period_map import FREQUENCY, GAP, LEVEL, find_parameter, set_total_gap
from twin.model.model import Model
from twin.setup.folders import make_output_folder
from twin.setup.run_config import RunConfig, make_run_id, read_run_config
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.system.process_pool import map_in_threads
from twin.system.progress import OpenStage, open_silently

MAP_VALUES = 41  # of the second parameter, spread evenly over its range
ATTRACTOR_MESSAGE = "following the attractors and their basins; chaos takes half a minute"
FACTORS = {GAP: 1e-3, LEVEL: GRAVITY_M_S2}  # SI of one unit at the command line; 1 for all others


@dataclass(frozen=True, slots=True)
class BranchOptions:
    """Test and model whose branches are followed; `low` and `high` in the unit of `over`.

    The unit is that of the command line: Hz, mm of total gap, g, or SI of a parameter. Over another
    parameter than the frequency without `at_hz`: a map of the resonance. `complete` searches for
    every motion; `attractors` simulates, too; `basins_hz`: at this frequency with the basins.
    """

    profile: str | Path
    model: str | None = None
    gap_mm: float | None = None
    level_g: float | None = None
    over: str = FREQUENCY
    low: float | None = None
    high: float | None = None
    at_hz: float | None = None
    complete: bool = False
    attractors: bool = False
    basins_hz: float | None = None
    out: Path | None = None


@dataclass(frozen=True, eq=False)
class FollowedBranches:
    """Page of a report, and the branches and attractors in it, or the map of the resonance."""

    page: Path
    branches: BranchSet | None = None
    attractors: AttractorStudy | None = None
    resonance: ResonanceMap | None = None


def follow_branches(
    options: BranchOptions, open_stage: OpenStage = open_silently
) -> FollowedBranches:
    """Follow the periodic motions of a model over a parameter; write the report of what is found.

    `open_stage` is entered with a sentence while a stage that may take long is computed. InputError
    for a faulty file, and a parameter or range that the model does not have.
    """
    config = read_run_config(Path(options.profile), None, options.model)
    model = config.model
    if options.gap_mm is not None:
        model = set_total_gap(model, options.gap_mm / 1e3)
    level = find_level(config, options)
    limits = find_limits(config, model, options)
    title, toml = config.profile.title, config.model_toml
    frequency_hz = find_frequency(config, options)
    check_attractors(options, frequency_hz)
    folder = make_output_folder(options.out, make_run_id(f"{config.name}-branches"))
    if frequency_hz is None:
        plan = config.profile.plan
        with open_stage(COMPILING_MESSAGE):
            resonance = compute_resonance_map(
                make_period_map(model, plan.low_hz, level),
                options.over,
                np.linspace(*limits, MAP_VALUES),
                (plan.low_hz, plan.high_hz),
            )
        subtitle = f"{plan.low_hz:g} to {plan.high_hz:g} Hz, {level / GRAVITY_M_S2:.4g} g"
        page = write_map_report(folder, resonance, title, subtitle, toml)
        return FollowedBranches(page, resonance=resonance)
    branches = compute_branches(model, limits, level, frequency_hz, options, open_stage)
    attractors = None
    if options.attractors or options.basins_hz is not None:
        period_map = make_period_map(model, frequency_hz, level)
        with open_stage(ATTRACTOR_MESSAGE):
            attractors = study_attractors(
                period_map, options.over, limits, options.basins_hz, map_in_threads
            )
        bands = tuple((band.low, band.high) for band in attractors.bands)
        branches = replace(branches, chaotic=bands)
    place = f", {frequency_hz:g} Hz" if options.over != FREQUENCY else ""
    gap = "" if options.over == GAP else f", total gap {1e3 * find_parameter(model, GAP):.4g} mm"
    drive = "" if options.over == LEVEL else f"{level / GRAVITY_M_S2:.4g} g"
    subtitle = f"{drive}{place}{gap}".lstrip(", ")
    page = write_branch_report(folder, branches, title, subtitle, toml, attractors)
    return FollowedBranches(page, branches, attractors)


def compute_branches(
    model: Model,
    limits: tuple[float, float],
    level: float,
    frequency_hz: float,
    options: BranchOptions,
    open_stage: OpenStage,
) -> BranchSet:
    """Follow the main branches, or search for all of them."""
    if not options.complete:
        with open_stage(COMPILING_MESSAGE):
            period_map = make_period_map(model, frequency_hz, level)
            main = follow_main_branches(period_map, limits, parameter=options.over)
        return BranchSet(main)
    with open_stage("searching for every motion; a range with chaos takes minutes"):
        diagram = compute_diagram(
            model, limits, level, parameter=options.over, frequency_hz=frequency_hz
        )
    bands = tuple((band.low, band.high) for band in diagram.chaotic_bands)
    return BranchSet(diagram.branches, bands)


def find_level(config: RunConfig, options: BranchOptions) -> float:
    """Return the peak table acceleration in m/s2: as asked, or that of the test."""
    if options.level_g is None:
        return config.profile.plan.level_m_s2
    if not 0 < options.level_g < float("inf"):
        raise InputError(
            "not a level", key="--level", value=options.level_g, allowed="above 0 g, finite"
        )
    return options.level_g * GRAVITY_M_S2


def find_limits(config: RunConfig, model: Model, options: BranchOptions) -> tuple[float, float]:
    """Return the range of the parameter in SI: as asked; for the frequency that of the test."""
    low, high = options.low, options.high
    if options.over == FREQUENCY:
        plan = config.profile.plan
        low = plan.low_hz if low is None else low
        high = plan.high_hz if high is None else high
    elif options.over != LEVEL:
        find_parameter(model, options.over)  # refuses unknown names
    if low is None or high is None:
        raise InputError(
            f"the range of {options.over} is missing",
            key="--from, --to",
            remedy=f"give both, in the unit of the {make_axis(options.over).label}",
        )
    if not low < high or (options.over in (FREQUENCY, LEVEL) and low <= 0):
        raise InputError(
            "not a range",
            key="--from, --to",
            value=f"{low:g} to {high:g}",
            allowed="ascending; above 0 for frequency and level",
        )
    factor = FACTORS.get(options.over, 1.0)
    return low * factor, high * factor


def find_frequency(config: RunConfig, options: BranchOptions) -> float | None:
    """Return the drive frequency in Hz where another parameter varies; None for all of the test."""
    if options.over == FREQUENCY:
        if options.at_hz is not None:
            raise InputError(
                "the branch is followed over the frequency",
                key="--at",
                value=options.at_hz,
                remedy="omit it, or choose another --over",
            )
        return config.profile.plan.low_hz
    if options.at_hz is not None and not options.at_hz > 0:
        raise InputError("not a frequency", key="--at", value=options.at_hz, allowed="above 0 Hz")
    return options.at_hz


def check_attractors(options: BranchOptions, frequency_hz: float | None) -> None:
    """Raise InputError if the attractors cannot be followed as asked."""
    basins_hz = options.basins_hz
    if basins_hz is not None and not 0 < basins_hz < float("inf"):
        raise InputError(
            "not a frequency", key="--basins", value=basins_hz, allowed="above 0 Hz, finite"
        )
    if frequency_hz is None and (options.attractors or basins_hz is not None):
        raise InputError(
            f"the frequency at which {options.over} varies is missing, for the attractors",
            key="--at",
            allowed="above 0 Hz",
        )
