"""What a study computes: against single sweeps, continuation, closed forms and SALib."""

import itertools
import math
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from SALib.analyze import sobol
from SALib.test_functions import Ishigami

from table_io.config.base import parse_toml
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import read_model_text
from tests.command_line import call_main
from tests.input_errors import raises_input_error
from tests.sweeps.small_study import STUDY, TEST, make_stored_study, write_study
from twin.api import open_study
from twin.compare.curves import detect_hysteresis
from twin.laws.library import find_effect
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.results.ideal_points import compute_prc_points
from twin.studies.maps.cases import list_parameter_names, parameter_unit, sample_parameters
from twin.studies.maps.config import StudyConfig
from twin.studies.maps.figures import FrontGroup
from twin.studies.maps.page import write_map_page
from twin.studies.maps.results import compute_sensitivity, find_front
from twin.studies.maps.store import make_seeds, open_group
from twin.studies.maps.study import Study
from twin.studies.maps.task import compute_outcomes

HEAD = 'title = "T"\nprofile = "g4_ss3"\n'
GAP = '[[parameters]]\nname = "specimen.gap_mm"\n'


@pytest.fixture(scope="module")
def study_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the small study, run as its user would."""
    folder = tmp_path_factory.mktemp("study")
    path = write_study(folder)
    result = call_main("map", path, "--out", folder / "out", "--workers", 1)
    assert result.returncode == 0, result.stderr
    return folder / "out"


def test_every_case_is_the_sweep_of_its_parameters(study_folder: Path) -> None:
    """Curves, jumps and hysteresis as a single sweep and `prc` give them."""
    study = open_study(study_folder)
    profile = Study.read(study_folder.parent / "study.toml").profile
    base = Study.read(study_folder.parent / "study.toml").model_config.build_model(profile.specimen)
    steps = profile.sweep.steps
    hysteretic = 0
    for gap, stiffness in itertools.product([2.0, 9.0], study["base.bumper_stiffness_n_m"].values):
        case = study.sel({"specimen.gap_mm": gap, "base.bumper_stiffness_n_m": stiffness})
        model = Model(
            replace(
                base.base, gap_r=gap / 2e3, gap_l=gap / 2e3, bumper_stiffness_r=float(stiffness),
                bumper_stiffness_l=float(stiffness),
            )
        )  # fmt: skip
        frequencies = [step.frequency_hz for step in steps]
        response = simulate_sweep(model, frequencies, 0.05 * GRAVITY_M_S2, 8)
        points = compute_prc_points(model, steps, response, 8, 3)
        for point in points:
            direction = 1 if point.direction == "forward" else -1
            stored = case.sel(direction=direction, frequency_hz=point.frequency_hz)
            assert point.twin is not None
            for name in ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l"):
                assert float(stored[name]) == pytest.approx(getattr(point.twin, name), rel=1e-6)
            assert float(stored["impacts_right"]) == pytest.approx(
                np.mean(point.twin.impacts_right), rel=1e-6
            )
        jumps, intervals = detect_hysteresis(points, "twin")
        widths = [i.to_hz - i.from_hz for i in intervals if i.kind == "right"]
        assert float(case["right_width_hz"]) == pytest.approx(max(widths, default=0.0))
        assert int(case["jump_count"]) == len(jumps)
        hysteretic += bool(widths)
        u = response.extremes[:, -3:]
        swing = ((u[..., 0] - u[..., 1]) / 2).mean(axis=1)
        assert float(case["peak_disp_m"]) == pytest.approx(swing.max())
        assert float(case["peak_disp_hz"]) == frequencies[int(swing.argmax())]
        largest = np.abs(u[..., 2:4]).max()
        assert float(case["transmitted_force_n"]) == pytest.approx(550.0 * largest)
    assert hysteretic >= 4


def test_results_have_names_units_and_coordinates(study_folder: Path) -> None:
    study = open_study(study_folder)
    assert dict(study.sizes) == {
        "specimen.gap_mm": 4, "base.bumper_stiffness_n_m": 6, "direction": 2, "frequency_hz": 11
    }  # fmt: skip
    assert study["specimen.gap_mm"].attrs["units"] == "mm"
    assert study["peak_disp_m"].attrs["units"] == "m"
    assert study["peak_disp_m"].attrs["long_name"]
    assert study.attrs["title"] == "Gap and stiffness"
    assert study.attrs["cases"] == 24
    assert "numpy" in study.attrs["versions"]
    assert len(np.unique(study["seed"])) == 24
    assert list(open_study(study_folder, ["peak_acc_hz"])) == ["peak_acc_hz"]
    with raises_input_error(key="peak_acc"):
        open_study(study_folder, ["peak_acc"])


def test_the_report_is_written_again_from_the_stored_arrays(study_folder: Path) -> None:
    page = study_folder / "report.html"
    before = page.read_text()
    page.unlink()
    assert call_main("report", study_folder).returncode == 0
    assert page.read_text() == before
    pictures = {path.stem for path in (study_folder / "figures").glob("*.svg")}
    assert {"map_peak_disp_m", "map_down_jump_hz", "map_right_width_hz"} <= pictures
    rows = (study_folder / "cases.csv").read_text().splitlines()
    assert len(rows) == 25
    assert call_main("report", study_folder, "--format", "pdf").returncode == 2


def test_the_page_reads_no_array_again_for_each_chunk_or_figure(
    study_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    group = open_group(study_folder, "r")

    class CountedGroup:
        def __getitem__(self, name: str) -> object:
            read.append(name)
            return group[name]

    monkeypatch.setattr("twin.studies.maps.results.open_group", lambda *_: CountedGroup())
    monkeypatch.setattr("twin.studies.maps.figures.save_figures", lambda drawn, *_, **__: [*drawn])
    monkeypatch.setattr("twin.studies.maps.page.embed_images", lambda _: [])
    write_map_page(study_folder)
    assert {"peak_disp_m", "specimen.gap_mm"} <= {*read}
    # once to compare it with what was stored, once to draw
    assert max(Counter(read).values()) <= 2


def test_a_map_of_the_folds_is_the_continuation_of_each_case(tmp_path: Path) -> None:
    """Published folds of G4 at 0.05 g: 4.027372 and 2.787294 Hz, grazing 2.79359 Hz."""
    text = HEAD + 'outcomes = ["folds"]\n' + GAP + "values = [4.0, 10.0]\n"
    study = Study.read(write_study(tmp_path, text))
    arrays, failures = compute_outcomes(study, np.array([[4.0], [10.0]]), make_seeds(0, range(2)))
    assert not failures
    assert arrays["upper_fold_hz"] == pytest.approx([4.027372, 3.157626], abs=1e-4)
    assert arrays["lower_fold_hz"] == pytest.approx([2.787294, 2.013866], abs=1e-4)
    assert arrays["grazing_hz"] == pytest.approx([2.79359, 2.01441], abs=1e-4)
    assert arrays["stable_disp_hz"] == pytest.approx(arrays["upper_fold_hz"], abs=0.05)


def test_a_map_of_basins_is_that_of_a_finer_grid(tmp_path: Path) -> None:
    """G4 at 3.4 Hz: 87.4 % of 101 x 101 starts end in the motion with impacts; none at 4.5 Hz."""
    text = (
        HEAD + 'outcomes = ["basins"]\n[[parameters]]\nname = "basins.frequency_hz"\n'
        'values = [3.4, 4.5]\n[fixed]\n"basins.starts_per_axis" = 21\n'
    )
    study = Study.read(write_study(tmp_path, text))
    arrays, failures = compute_outcomes(study, np.array([[3.4], [4.5]]), make_seeds(0, range(2)))
    assert not failures
    assert arrays["contact_share"] == pytest.approx([0.874, 0.0], abs=0.03)
    assert arrays["attractor_count"].tolist() == [2.0, 1.0]
    assert arrays["undecided_share"].tolist() == [0.0, 0.0]
    with raises_input_error(key="basins.frequency_hz"):
        Study.read(
            write_study(tmp_path, HEAD + 'outcomes = ["basins"]\n' + GAP + "values = [4, 5]")
        )


@pytest.mark.parametrize("name", list_parameter_names())
def test_every_parameter_can_be_varied_and_changes_the_model(tmp_path: Path, name: str) -> None:
    """Within limits that suit the specimen, and without saying what other effects are."""
    around = {
        "specimen.mass_kg": (500.0, 600.0),
        "specimen.gap_mm": (2.0, 8.0),
        "sweep.acceleration_g": (0.03, 0.06),
    }
    low, high = around.get(name, (1e-3, 2e-3))
    if name.startswith("base."):
        low, high = 1e3, 1e5
    fixed = ""
    if name.startswith("effects."):
        effect = name.split(".")[1]
        others = [
            other
            for other in list_parameter_names()
            if other.startswith(f"effects.{effect}.") and other != name
        ]
        typical = {
            f"effects.{effect}.{parameter.name}": parameter.typical
            for parameter in find_effect(effect).parameters
        }
        fixed = "[fixed]\n" + "".join(f'"{other}" = {typical[other]}\n' for other in others)
        low, high = 0.9 * typical[name], 1.1 * typical[name]
    text = (
        f'{HEAD}outcomes = ["peaks"]\n[[parameters]]\nname = "{name}"\n'
        f"start = {low}\nstop = {high}\ncount = 2\n{fixed}"
    )
    study = Study.read(write_study(tmp_path, text))
    first, second = (study.factory.build([value]) for value in (low, high))
    assert (first.model, first.acceleration_m_s2) != (second.model, second.acceleration_m_s2)
    assert parameter_unit(name) or name.endswith("ratio")


@pytest.mark.parametrize(
    ("line", "fields"),
    [
        ('name = "specimen.gap_m"', {"key": "specimen.gap_m", "remedy": "specimen.gap_mm"}),
        ('name = "effects.coulomb_friction.f"', {"remedy": "effects.coulomb_friction.fc"}),
        ('name = "effects.coulomb.fc"', {"remedy": "coulomb_friction"}),
        ('name = "effects.sensor_gain.gain"', {"key": "effects.sensor_gain.gain"}),
        ('name = "effects.bouc_wen.force"', {"key": "effects.bouc_wen"}),
        ('name = "base.stiffness_n_m"\nstart = -1.0', {"key": "stiffness"}),
        ('name = "effects.coulomb_friction.fc"\nstart = -5.0', {"key": "fc"}),
        ('name = "sweep.acceleration_g"\nstart = -1.0', {"key": "sweep.acceleration_g"}),
        ('name = "base.damping_n_s_m"\nstart = 0.0', {"key": "damping"}),
    ],
)
def test_what_makes_no_model_is_refused(
    tmp_path: Path, line: str, fields: dict[str, object]
) -> None:
    start = "" if "start" in line else "\nstart = 1.0"
    text = f'{HEAD}outcomes = ["peaks"]\n[[parameters]]\n{line}{start}\nstop = 2.0\ncount = 3\n'
    with raises_input_error(**fields):
        Study.read(write_study(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "fields"),
    [
        ('outcomes = ["peak"]\n' + GAP + "values = [1.0, 2.0]", {"key": "outcomes"}),
        ('outcomes = ["peaks", "peaks"]\n' + GAP + "values = [1.0, 2.0]", {"key": "outcomes"}),
        ('outcomes = ["peaks"]\n' + GAP + "start = 1.0\nstop = 2.0", {"key": "specimen.gap_mm"}),
        ('outcomes = ["peaks"]\nsampling = "sobol"\nsamples = 100\n' + GAP
         + "start = 1.0\nstop = 2.0", {"key": "samples", "remedy": "128"}),
        ('outcomes = ["peaks"]\nsampling = "sobol"\n' + GAP + "start = 1.0\nstop = 2.0",
         {"key": "samples"}),
        ('outcomes = ["peaks"]\n' + GAP + "values = [1.0, 2.0]\n[fixed]\n"
         '"specimen.gap_mm" = 3.0', {"key": "specimen.gap_mm"}),
        ('outcomes = ["peaks"]\n' + GAP + "values = [1.0, 2.0]\n[front]\n"
         'minimise = ["peak_disp_m", "peak_acc"]', {"key": "front.minimise"}),
        ('outcomes = ["peaks"]\n' + GAP + "values = [1.0, 2.0]\n[front]\n"
         'minimise = ["peak_disp_m", "peak_acc_m_s2"]\neach = "gap"', {"key": "front.each"}),
        ('outcomes = ["folds"]\n[[parameters]]\nname = "effects.coulomb_friction.fc"\n'
         "values = [1.0, 2.0]", {"key": "outcomes", "value": "folds"}),
        ('outcomes = ["peaks"]\n[[parameters]]\nname = "discovery.noise"\nvalues = [0.1, 0.2]',
         {"key": "discovery.noise"}),
        ('outcomes = ["peaks"]\nseed = 5000000000\n' + GAP + "values = [1.0, 2.0]",
         {"key": "seed"}),
    ],
)  # fmt: skip
def test_a_study_that_asks_for_nothing_possible_is_refused(
    tmp_path: Path, text: str, fields: dict[str, object]
) -> None:
    with raises_input_error(**fields):
        Study.read(write_study(tmp_path, HEAD + text))


@pytest.mark.parametrize(
    "values",
    [
        "start = 2.0\nstop = 1.0\ncount = 3", "values = [2.0, 1.0]", "values = [1.0, 1.0]",
        "start = 0.0\nstop = 1.0\nstep = 0.3", "start = 0.0\nstop = 1.0\nstep = -0.5",
        "start = 0.0\nstop = 1.0\ncount = 3\nscale = 'log'", "start = 1.0\nstop = inf\ncount = 3",
        "values = [1.0, 2.0]\nstart = 1.0\nstop = 2.0", "values = [1.0, 2.0]\ncount = 7",
        "values = [0.0, 2.0]\nscale = 'log'", "start = 0.0\nstop = 1.0\ncount = 1",
    ],
)  # fmt: skip
def test_malformed_step_range_is_refused(values: str) -> None:
    with pytest.raises(InputError):
        parse_toml(f'{HEAD}outcomes = ["peaks"]\n{GAP}{values}\n', StudyConfig, "study")


def make_config(sampling: str, samples: int | None, ranges: int = 3, seed: int = 4) -> StudyConfig:
    names = ("specimen.gap_mm", "specimen.mass_kg", "base.stiffness_n_m")
    lines = [HEAD, f'sampling = "{sampling}"\nseed = {seed}\noutcomes = ["peaks"]\n']
    lines += [f"samples = {samples}\n"] if samples is not None else []
    for name in names[:ranges]:
        lines.append(f'[[parameters]]\nname = "{name}"\nstart = 1.0\nstop = 100.0\n')
        lines.append("count = 5\n" if samples is None else 'scale = "log"\n')
    return parse_toml("".join(lines), StudyConfig, "study")


def test_a_grid_has_all_combinations_the_last_parameter_fastest() -> None:
    axis = [1.0, 25.75, 50.5, 75.25, 100.0]
    expected = np.array(list(itertools.product(axis, repeat=3)))
    assert np.array_equal(sample_parameters(make_config("grid", None)), expected)


@pytest.mark.parametrize("sampling", ["latin_hypercube", "sobol"])
def test_samples_fill_every_range_evenly_on_its_scale(sampling: str) -> None:
    """Each of 64 equal parts of the logarithm has one sample of a Latin hypercube or Sobol set."""
    values = sample_parameters(make_config(sampling, 64))
    assert values.shape == (64, 3)
    parts = np.floor(np.log10(values) / 2 * 64).astype(int)
    assert all(sorted(column) == list(range(64)) for column in parts.T.tolist())
    again = sample_parameters(make_config(sampling, 64))
    other = sample_parameters(make_config(sampling, 64, seed=5))
    assert np.array_equal(values, again)
    assert not np.array_equal(values, other)


def test_sensitivity_agrees_with_salib_and_the_closed_form() -> None:
    """Ishigami's function: first order 0.3139, 0.4424, 0; total 0.5576, 0.4424, 0.2437."""
    count, size = 3, 8192
    values = sample_parameters(make_config("sensitivity", size))
    unit = np.log10(values) / 2  # back to 0 ... 1
    result = Ishigami.evaluate(math.pi * (2 * unit - 1))
    own = compute_sensitivity(result, count, 1)
    assert own.first == pytest.approx([0.3139, 0.4424, 0.0], abs=0.02)
    assert own.total == pytest.approx([0.5576, 0.4424, 0.2437], abs=0.02)
    assert own.used_share == 1.0
    # SALib takes the cases sample by sample: A, then the mixed ones, then B.
    blocks = result.reshape(count + 2, size)
    ordered = blocks[[0, *range(2, count + 2), 1]].T.ravel()
    names = ["a", "b", "c"]
    problem = {"num_vars": count, "names": names, "bounds": [[0.0, 1.0]] * count}
    theirs = sobol.analyze(problem, ordered, calc_second_order=False, seed=1)
    assert own.first == pytest.approx(theirs["S1"], abs=2e-3)
    assert own.total == pytest.approx(theirs["ST"], abs=2e-3)
    half_width = (own.first_interval[1] - own.first_interval[0]) / 2
    assert half_width == pytest.approx(theirs["S1_conf"], rel=0.25)
    truth = [0.3139, 0.4424, 0.0]
    assert all(low - 0.01 < s < high + 0.01 for s, (low, high) in zip(
        truth, own.first_interval.T, strict=True))  # fmt: skip


def test_samples_without_a_value_are_left_out_of_the_indices() -> None:
    values = sample_parameters(make_config("sensitivity", 1024, ranges=2))
    result = np.log10(values[:, 0])  # only the first parameter acts
    result[values[:, 1] > 80.0] = np.nan
    indices = compute_sensitivity(result, 2, 1)
    assert 0.7 < indices.used_share < 0.98
    assert indices.total[0] == pytest.approx(1.0, abs=0.1)
    assert indices.total[1] == 0.0
    constant = compute_sensitivity(np.ones(4 * 1024), 2, 1)
    assert np.isnan(constant.first).all()


def test_the_front_holds_the_cases_that_no_other_betters() -> None:
    rng = np.random.default_rng(8)
    first, second = rng.integers(0, 30, (2, 300)).astype(float)
    first[:20] = np.nan
    front = set(find_front(first, second).tolist())
    points = [(a, b) for a, b in zip(first, second, strict=True) if not math.isnan(a)]
    for index, (a, b) in enumerate(zip(first, second, strict=True)):
        bettered = any(x <= a and y <= b and (x, y) != (a, b) for x, y in points)
        if index in front:
            assert not bettered
        elif not math.isnan(a):
            assert bettered or (a, b) in {(first[k], second[k]) for k in front}


@pytest.mark.parametrize("limit", [-1.0, 3.0, 12.5, 99.0])
def test_the_least_within_a_limit_is_that_of_all_cases(limit: float) -> None:
    rng = np.random.default_rng(9)
    first, second = rng.permutation(300).astype(float), rng.uniform(0.0, 30.0, 300)
    cases = np.arange(700, 1000)
    allowed = [(a, case) for a, b, case in zip(first, second, cases, strict=True) if b <= limit]
    assert FrontGroup("", cases, first, second).find_least(limit) == (
        min(allowed)[1] if allowed else None
    )


def test_seeds_are_of_the_case_and_differ() -> None:
    seeds = make_seeds(3, range(100_000))
    assert len(np.unique(seeds)) == 100_000
    assert np.array_equal(make_seeds(3, range(500, 600)), seeds[500:600])
    assert not np.isin(make_seeds(4, range(1000)), seeds).any()
    bits = np.unpackbits(seeds.view(np.uint8)).mean()
    assert bits == pytest.approx(0.5, abs=0.01)


def test_a_case_that_fails_is_named_and_has_no_result(tmp_path: Path) -> None:
    """Without damping there is no resonance to divide by; a negative one is no model at all."""
    text = (
        HEAD + 'outcomes = ["curves", "peaks", "hysteresis"]\n'
        '[[parameters]]\nname = "base.damping_n_s_m"\nvalues = [900.0, 1000.0]\n'
    )
    study = Study.read(write_study(tmp_path, text))
    arrays, failures = compute_outcomes(
        study, np.array([[900.0], [0.0], [-5.0], [1000.0]]), make_seeds(0, range(4))
    )
    assert set(failures) == {1, 2}
    assert "damping" in failures[1]
    for name, values in arrays.items():
        assert np.isnan(values[2]).all(), name
        assert np.isfinite(values[3]).any(), name
    alone, _ = compute_outcomes(study, np.array([[1000.0]]), make_seeds(0, range(1)))
    assert all(np.array_equal(alone[name][0], values[3], equal_nan=True)
               for name, values in arrays.items())  # fmt: skip


def test_the_shipped_studies_are_valid() -> None:
    for name in ("bumper_design", "fold_sensitivity", "discovery_power"):
        assert Study.read(Path(name)).config.case_count > 90


def test_magnitudes_count_an_offset_and_amplitudes_do_not(tmp_path: Path) -> None:
    """Gaps moved by 2 mm to the right: the mass goes further to that side."""
    text = HEAD + 'outcomes = ["peaks", "forces"]\n[[parameters]]\n' \
        'name = "effects.gap_offset.offset"\nvalues = [0.0, 2e-3]\n'  # fmt: skip
    study = Study.read(write_study(tmp_path, text))
    arrays, _ = compute_outcomes(study, np.array([[0.0], [2e-3]]), make_seeds(0, range(2)))
    ratio = arrays["max_disp_m"] / arrays["peak_disp_m"]
    assert ratio[0] == pytest.approx(1.0, abs=0.02)
    assert ratio[1] > 1.15
    assert arrays["transmitted_force_n"] == pytest.approx(550.0 * arrays["max_acc_m_s2"])


def test_a_model_is_found_beside_the_test_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "tests").mkdir()
    model = read_model_text("snm").replace("36000.0", "37000.0")
    (tmp_path / "tests" / "own.toml").write_text(model)
    (tmp_path / "tests" / "across.toml").write_text('model = "own.toml"\n' + TEST)
    path = tmp_path / "study.toml"
    path.write_text(STUDY.replace("{profile}", "tests/across.toml"))
    assert Study.read(path).factory.model.base.stiffness == 37000.0


PAGES = {
    "line": ('[[parameters]]\nname = "specimen.mass_kg"\nvalues = [500.0, 550.0, 600.0]\n', 3),
    "single": (GAP + "values = [4.0, 5.0]\n[[parameters]]\nname = 'sweep.acceleration_g'\n"
               "values = [0.05]\n", 2),
    "panels": (GAP + "values = [4.0, 5.0]\n[[parameters]]\nname = 'specimen.mass_kg'\n"
               "values = [500.0, 600.0]\nscale = 'log'\n[[parameters]]\n"
               "name = 'sweep.acceleration_g'\nvalues = [0.03, 0.05]\n[front]\n"
               "minimise = ['transmitted_force_n', 'most_impacts']\neach = 'specimen.mass_kg'\n"
               "limits = [-1.0, 1e9]\n",
               8),
    "repeats": ("repeats = 3\n" + GAP + "values = [4.0, 5.0]\n", 6),
    "samples": ("sampling = 'latin_hypercube'\nsamples = 6\n" + GAP
                + "start = 4.0\nstop = 6.0\n", 6),
    "sensitivity": ("sampling = 'sensitivity'\nsamples = 4\n" + GAP + "start = 4.0\nstop = 6.0\n"
                    "[[parameters]]\nname = 'specimen.mass_kg'\nstart = 500.0\nstop = 600.0\n",
                    16),
}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "is_partial"), [*((kind, False) for kind in PAGES), ("panels", True)]
)
def test_every_kind_of_study_has_a_page(tmp_path: Path, kind: str, is_partial: bool) -> None:
    """Also one of which half of the chunks are stored."""
    text, count = PAGES[kind]
    head = 'title = "A page"\nprofile = "{profile}"\nchunk = 1\noutcomes = ["forces"]\n'
    test = TEST.replace("step_hz = 0.2", "step_hz = 1.0").replace("cycles = 8", "cycles = 3")
    path = write_study(tmp_path, head + text, test)
    out = tmp_path / "out"
    stored = count // 2 if is_partial else count
    make_stored_study(path, out, range(stored))
    page = write_map_page(out).read_text()
    assert f"{stored} of {count} cases" in page
    assert ("<b>stopped</b>" in page) == is_partial
    assert not re.search(r">\s*nan\b", page)
    names = {path.stem for path in (out / "figures").glob("*.png")}
    prefix = "samples_" if kind in ("samples", "sensitivity") else "map_"
    prefix = "" if kind in ("line", "repeats") else prefix
    assert {f"{prefix}{name}" for name in ("transmitted_force_n", "most_impacts")} <= names
    assert ("front" in names) == (kind == "panels")
    assert page.count("no case keeps it") == (2 if kind == "panels" else 0)  # a limit below 0
    assert ("sensitivity" in names) == (kind == "sensitivity")
    forces = open_study(out)["transmitted_force_n"]
    assert int(forces.notnull().sum()) == stored
