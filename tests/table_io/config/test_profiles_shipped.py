"""The tests of the paper, as shipped: the sweeps of its Section 2 and 4.3, within the machine."""

import math
from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.folders import find_config
from table_io.config.profile import Profile, load_profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import plan_excitation
from table_io.safety.preflight import check_limits, compute_demands, list_drive_warnings

SHIPPED = sorted((PROFILES_DIR / "tests").glob("*.toml"))
WIDE, TALL = (0.5, 5.0, 0.1, 10), (0.5, 10.0, 0.1, 10)  # start, stop, step in Hz; held cycles
PAPER = {
    "ginf": (math.inf, WIDE),
    "g30": (30.0, WIDE),
    "g16": (16.0, WIDE),
    "g10": (10.0, WIDE),
    "g4_ss1": (4.0, (0.5, 0.8, 0.03, 20)),
    "g4_ss2": (4.0, (0.8, 1.6, 0.05, 30)),
    "g4_ss3": (4.0, WIDE),
    "g0": (0.0, TALL),
    "gm1": (-1.0, TALL),
    "gm2": (-2.0, TALL),
    "gm10": (-10.0, TALL),
}
TOOLS = {"dwell", "track", "refine_g4"}
PLANNED_BY_TWIN = {
    "g4_unstable",
    "g4_backbone",
}  # without a drive before the twin has made its orbit plan


def read(path: Path) -> Profile:
    return load_profile(path)[0]


@pytest.mark.parametrize("name", PAPER)
def test_test_of_the_paper_is_driven_as_in_the_paper(name: str) -> None:
    gap_mm, grid = PAPER[name]
    profile = read(PROFILES_DIR / "tests" / f"{name}.toml")
    sweep = profile.sweep
    assert (sweep.start_hz, sweep.stop_hz, sweep.step_hz, sweep.cycles) == grid
    assert sweep.directions == ("forward", "backward")
    assert sweep.acceleration_g == 0.05
    assert (profile.specimen.mass_kg, profile.specimen.gap_mm) == (550.0, gap_mm)
    assert profile.specimen.gap_right_mm is None
    assert "Stefani" in profile.citation


def test_quickstart_covers_the_primary_resonance_of_g4_both_ways() -> None:
    profile = read(PROFILES_DIR / "tests" / "quickstart.toml")
    assert profile.specimen.gap_mm == 4.0
    assert {"forward", "backward"} == set(profile.sweep.directions)
    # Folds of SNM at 2.787 and 4.027 Hz; the jumps must lie inside the grid.
    assert profile.sweep.start_hz < 2.787
    assert profile.sweep.stop_hz > 4.027 + profile.sweep.step_hz


@pytest.mark.parametrize(
    "name",
    [
        *(f"tests/{name}" for name in [*PAPER, "quickstart"]),
        "models/snm",
        "rigs/simulated",
        "campaigns/paper",
    ],
)
def test_files_that_users_script_against_are_there(name: str) -> None:
    assert (PROFILES_DIR / f"{name}.toml").is_file()


def test_list_of_shipped_tests_is_complete() -> None:
    assert {path.stem for path in SHIPPED} == {
        *PAPER, "demo", "quickstart", "record_example", "el_centro", "rehearsal", "multisine",
        "swept_sine",
        *TOOLS, *PLANNED_BY_TWIN,
    }  # fmt: skip


@pytest.mark.parametrize(
    "path",
    [path for path in SHIPPED if path.stem not in PLANNED_BY_TWIN],
    ids=lambda path: path.stem,
)
def test_shipped_test_passes_its_pre_flight_without_a_warning(path: Path) -> None:
    profile = read(path)
    rig = load_config(find_config(profile.rig, "rigs", path), RigConfig, "machine card")[0]
    assert find_config(profile.model, "models", path).is_file()
    rows = compute_demands(plan_excitation(profile), profile, rig)
    check_limits(rows, profile, rig, path.name)
    assert list_drive_warnings(rows, rig) == []
    # A stop of a history is a row of its own.
    windows = profile.plan.windows + (profile.swept_sine is None)
    assert len(rows) == (len(profile.steps) or windows)
