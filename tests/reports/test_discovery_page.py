"""What a person is shown of a discovery: the page, its figures, for each of the four verdicts."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from table_io.config.base import parse_toml
from tests.builders.profiles import AT_1_KHZ_BY_50, UNCHECKED, format_test
from tests.builders.rigs import RIG_TEXT
from tests.builders.truths import hide_truth
from tests.discovery.played import prepare_bare_log
from tests.recovery.scaled_specimens import Hidden, prepare, record_block, simulate, start_model
from tests.reports.folders import draw_in_full_quality
from twin.discovery.build_verdict import build_verdict
from twin.discovery.discover import Discovery, PreparedLog, discover_effects
from twin.discovery.figure_data import (
    DiscoveryView,
    check_instruments,
    entries_to_samples,
    measured_forces,
)
from twin.discovery.free_running import compute_misfits, run_log_free, run_logs_free
from twin.discovery.least_squares import FitResult
from twin.discovery.loading import load_logs, name_logs
from twin.discovery.model_file import format_fitted_model
from twin.discovery.page import format_with_interval, write_discovery_page
from twin.discovery.parameters import INPUT_GAIN, INPUT_OFFSET, EffectKey, GapKey
from twin.discovery.result import EffectResult, Interval, Verdict
from twin.discovery.task import collect_result
from twin.discovery.words import format_verdict
from twin.drawing.page import format_significant
from twin.laws.typesetting import typeset_law
from twin.model.config import ModelConfig
from twin.model.inverse_dynamics import forces_along
from twin.setup.run_config import list_model_warnings, read_model_template, read_run_config
from twin.setup.unpaced import play_unpaced

HARDENING_N_M2 = 4.0e7  # N/m2
AWAY = (
    "sensor_gain", "sensor_lag", "sensor_offset", "table_tilt", "bumper_maxwell", "hunt_crossley",
    "mass_error", "maxwell_damper", "bouc_wen", "adhesion", "appendage", "dead_band", "gap_drift",
    "position_damping", "stribeck_friction",
)  # fmt: skip
WITHOUT = (*AWAY, "bumper_hardening", "bumper_cubic")
VERDICTS = ("none", "named", "ambiguous", "unexplained")
FIGURES = {
    "staircase", "map_0", "candidates", "damper_force", "bumper_force", "histories", "prc",
    "impacts", "motion", "time_0",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class DiscoveryOutput:
    """A discovery and what was left of it in a folder."""

    discovery: Discovery
    logs: Sequence[PreparedLog]
    verdict: Verdict
    folder: Path

    @property
    def page(self) -> str:
        return (self.folder / "report.html").read_text(encoding="utf-8")


def record_run(folder: Path) -> Path:
    """The log of a short unpaced run, of a rig whose bumpers harden."""
    card = folder / "rig.toml"
    text = f'[[effects]]\nid = "bumper_hardening"\nparameters = {{ k2 = {HARDENING_N_M2} }}\n'
    card.write_text(hide_truth(RIG_TEXT, folder, text))
    (folder / "p.toml").write_text(
        format_test(
            2.8, 4.4, 0.4, tables=AT_1_KHZ_BY_50 | UNCHECKED, rig=card, measured_cycles=None
        )
    )
    log = folder / "hard.mcap"
    play_unpaced(read_run_config(folder / "p.toml"), "hard", log, lambda: None, lambda item: None)
    return log


def write_output(
    folder: Path, logs: Sequence[PreparedLog], discovery: Discovery
) -> DiscoveryOutput:
    folder.mkdir()
    verdict = build_verdict(discovery, 1.5, ["<b>said</b>"])
    result = collect_result(discovery, logs, read_model_template("snm")[1], verdict)
    result.write(folder)
    write_discovery_page(folder, result)
    return DiscoveryOutput(discovery, logs, result.verdict, folder)


@pytest.fixture(scope="module")
def every(tmp_path_factory: pytest.TempPathFactory) -> dict[str, DiscoveryOutput]:
    """A discovery of each verdict, all of one recording; one page laid out as a user gets it.

    None: with the model that the one before found. Unexplained: the truth is left out of the
    library. Ambiguous: another set is said to be as good, and the recording has no steps.
    """
    root, model = tmp_path_factory.mktemp("pages"), read_model_template("snm")[0]
    logs, _ = load_logs([record_run(root)])
    known = discover_effects(logs, model, without=AWAY)
    problem, parameters = known.prepared.problem, known.prepared.parameters
    other = next(each for each in problem.library if each.name == "cubic_stiffness")
    rival = problem.fit_effects(other.add_to(parameters, (), other.amplitude.scale), (other,))
    unsure = replace(
        known, verdict=replace(known.verdict, outcome="ambiguous", alternatives=(rival,))
    )
    stepless = [replace(log, steps=()) for log in logs]
    with draw_in_full_quality():
        out = {"named": write_output(root / "named", logs, known)}
    out["ambiguous"] = write_output(root / "ambiguous", stepless, unsure)
    whole = read_model_template(str(root / "named" / "model.toml"))[0]
    out["none"] = write_output(root / "none", logs, discover_effects(logs, whole, without=AWAY))
    out["unexplained"] = write_output(
        root / "unexplained", logs, discover_effects(logs, model, without=WITHOUT)
    )
    return out


@pytest.fixture(params=VERDICTS)
def output(request: pytest.FixtureRequest, every: dict[str, DiscoveryOutput]) -> DiscoveryOutput:
    return every[request.param]


def test_each_verdict_is_the_one_meant(every: dict[str, DiscoveryOutput]) -> None:
    assert {word: left.verdict.verdict for word, left in every.items()} == {w: w for w in VERDICTS}


def test_the_page_needs_nothing_else(output: DiscoveryOutput, tmp_path: Path) -> None:
    page = output.page
    assert not re.search(r"(src|href)=[\"'](?!data:)|url\(|@import|<script", page)
    assert page.count("data:image/png;base64,") == len(list((output.folder / "figures").iterdir()))
    assert "&lt;b&gt;said&lt;/b&gt;" in page
    assert "<b>said" not in page
    assert not re.search(r"\bnan\b|\bNone\b</|\{\{|Undefined", page)


def test_the_page_says_the_verdict_the_gap_and_what_to_do(output: DiscoveryOutput) -> None:
    page, gap = output.page, output.verdict.gap
    assert f'<p class="verdict {output.verdict.verdict}">' in page
    assert output.verdict.why in page.replace("&#39;", "'")
    assert output.verdict.next_run[1:] in page
    for misfit in (gap.held_out_before, gap.held_out_after, gap.noise_floor):
        assert f"{misfit:.3g}" in page
    for effect in output.verdict.effects:
        assert effect.id in page
        for name, value in effect.parameters.items():
            cells = "".join(f"<td>{text}</td>" for text in format_with_interval(value))
            assert f'<td class="text">{name}</td>{cells}' in page


def test_the_first_sentence(every: dict[str, DiscoveryOutput]) -> None:
    heads = {word: re.search("<h1>(.*)</h1>", left.page)[1] for word, left in every.items()}  # type: ignore[index]
    assert "agree to within the noise" in heads["none"]
    assert heads["named"] == "The model lacks bumper hardening."
    assert "do not determine which" in heads["ambiguous"]
    for names in every["ambiguous"].verdict.ambiguous:
        assert " with ".join(names) in heads["ambiguous"]
    assert "lacks an effect that is not in the library" in heads["unexplained"]


def test_a_sensor_that_errs_is_not_laid_to_the_model(
    every: dict[str, DiscoveryOutput],
) -> None:
    effect = EffectResult(id="sensor_gain", channel="mass_acc_m_s2", confidence=0.9, parameters={})
    verdict = every["named"].verdict.model_copy(update={"effects": [effect]})
    sentence = format_verdict(verdict)
    assert "sensor gain error of mass_acc_m_s2" in sentence
    assert "model lacks" not in sentence


def test_what_fell_away_is_said_with_its_reason(every: dict[str, DiscoveryOutput]) -> None:
    page = every["unexplained"].page
    assert "Effects that were not tested" in page
    assert page.count("left out of the library") == len(WITHOUT)


def test_every_figure_is_there_and_not_empty(output: DiscoveryOutput) -> None:
    files = {path.stem: path for path in (output.folder / "figures").glob("*.png")}
    stepped = any(log.steps for log in output.logs)
    laws = {"laws"} if output.discovery.verdict.best.effects else set()
    assert files.keys() == laws | (
        FIGURES if stepped else FIGURES - {"map_0", "prc", "impacts", "motion"}
    )
    assert ("No map over frequency" in output.page) != stepped
    for name, path in files.items():
        pixels = imread(path)[..., :3]
        assert (pixels.min(axis=2) < 0.9).mean() > 0.01, name


def test_what_no_effect_explains_is_drawn_without_a_law(every: dict[str, DiscoveryOutput]) -> None:
    output = every["unexplained"]
    shown = DiscoveryView(output.discovery, output.logs)
    assert shown.law is None
    assert shown.forces_of_each == ()
    assert "no effect was found that explains it" in output.page


def test_the_law_drawn_is_the_force_that_is_missing(every: dict[str, DiscoveryOutput]) -> None:
    shown = DiscoveryView(every["named"].discovery, every["named"].logs)
    assert shown.law is not None
    assert shown.law_forces is not None
    sheet, guess = shown.log_residuals[0], shown.law.fit.parameters
    forces = shown.law_forces
    wanted, law, after = forces.required[1], forces.law[1], forces.remaining[1]
    touching = np.isfinite(law)
    depth = sheet.motion().u[touching] - sheet.motion().gaps_m[0] - guess.values[GapKey(0)]
    assert law[touching] == pytest.approx(HARDENING_N_M2 * depth**2, rel=0.1, abs=5.0)
    assert np.nanstd(after) < 0.1 * np.nanstd(wanted)
    assert np.nanmax(np.abs(forces.law[0])) < 1e-6
    assert [own.label for own in shown.forces_of_each] == ["bumper_hardening"]


def test_the_model_that_is_left_says_how_well_its_numbers_are_known(
    every: dict[str, DiscoveryOutput],
) -> None:
    card = parse_toml((every["named"].folder / "model.toml").read_text(), ModelConfig, "model.toml")
    low, high = card.intervals["bumper_hardening.k2"]
    value = float(card.effects[0].parameters["k2"])
    assert low < value < high
    assert high - low < 0.1 * value
    low, high = card.intervals["stiffness"]
    assert low < card.base.stiffness_n_m < high


def test_logs_of_the_same_name_are_distinguished(tmp_path: Path) -> None:
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "log.mcap").touch()
    for folder in ("a/run", "b/run"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "run.mcap").touch()
    alike = [tmp_path / "a/run", tmp_path / "b/run/run.mcap"]
    assert name_logs(alike) == ["a/run", "b/run"]
    assert name_logs([alike[0], tmp_path / "c/log.mcap"]) == ["run", "log"]
    assert name_logs([alike[0], alike[0]])[0] == str(alike[0].resolve() / "run.mcap")
    assert name_logs([]) == []


def test_measured_less_what_is_left_is_the_models_force(every: dict[str, DiscoveryOutput]) -> None:
    output = every["named"]
    sheet = DiscoveryView(output.discovery, output.logs).log_residuals[0]
    guess = output.discovery.verdict.best.fit.parameters
    m = sheet.motion()
    model_at_log = guess.model_for_log(0, m)
    damper, right, left = forces_along(
        model_at_log, m.u, m.v, m.table_acc, m.time_s, sheet.contact_state
    )
    measured = measured_forces(sheet, guess)
    for row, model in enumerate((damper, right, -left)):
        away = entries_to_samples(sheet, row, sheet.evaluate(guess), guess)
        used = np.isfinite(away)
        assert used.any()
        assert (measured[row] - away)[used] == pytest.approx(model[used], abs=5.0)  # of a tare


def test_the_twin_comes_nearer_when_it_runs_free(every: dict[str, DiscoveryOutput]) -> None:
    output = every["named"]
    shown = DiscoveryView(output.discovery, output.logs)
    errors = []
    for explained in shown.before_after:
        run = run_log_free(shown.log_residuals[0], shown.sweep_steps(0), explained)
        assert run is not None
        points = run.points
        assert len(points) == len(output.logs[0].steps)
        forward = [
            (p.measured, p.twin)
            for p in points
            if p.direction == "forward" and p.measured is not None and p.twin is not None
        ]
        assert 0.05 < forward[0][0].eta_d < 0.5
        errors.append(sum((twin.eta_a - rig.eta_a) ** 2 for rig, twin in forward))
    assert errors[1] < 0.25 * errors[0]


def test_the_table_of_the_curves_says_how_much_nearer(every: dict[str, DiscoveryOutput]) -> None:
    output = every["named"]
    shown = DiscoveryView(output.discovery, output.logs)
    runs = run_logs_free(shown)
    (row,) = compute_misfits(shown, runs)
    measured = max(p.measured.eta_d for p in runs[0][0].points if p.measured is not None)
    assert row.measured.eta_d == measured
    given, refitted, final = row.models
    assert final.error < 0.25 * refitted.error
    for model in row.models:
        assert f"<b>{format_significant(100 * model.error)} %</b>" in output.page
    assert given.error > final.error
    assert final.jumps == row.measured.jumps
    same = replace(
        output.discovery.selection, null=output.discovery.verdict.best
    )  # nothing before but what is after
    (row,) = compute_misfits(
        again := DiscoveryView(replace(output.discovery, selection=same), output.logs),
        run_logs_free(again),
    )
    _, refitted, final = row.models
    assert refitted == replace(final, label=refitted.label)


def test_the_staircase_falls_from_the_model_as_given_to_the_noise(
    every: dict[str, DiscoveryOutput],
) -> None:
    output = every["named"]
    stairs, gap = output.verdict.staircase, output.verdict.gap
    sizes = [step.misfit for step in stairs]
    assert len(sizes) == 4
    assert sizes == sorted(sizes, reverse=True)
    assert sizes == [
        gap.given,
        gap.held_out_before,
        gap.held_out_after,
        gap.noise_floor,
    ]
    assert "bumper_hardening" in stairs[2].label


def test_what_is_not_named_has_a_largest_size(every: dict[str, DiscoveryOutput]) -> None:
    excluded = every["named"].verdict.excludes
    assert {size.id for size in excluded} >= {"cubic_stiffness", "coulomb_friction"}
    assert all(size.force_share < 0.1 for size in excluded if size.id == "cubic_stiffness")
    assert "bumper_hardening" not in {size.id for size in excluded}
    assert every["none"].verdict.excluded == []


def test_only_a_model_that_is_not_sure_is_provisional(every: dict[str, DiscoveryOutput]) -> None:
    for word, output in every.items():
        text = (output.folder / "model.toml").read_text()
        model = parse_toml(text, ModelConfig, "model.toml")
        assert bool(model.provisional) == (word in ("ambiguous", "unexplained"))
        assert len(list_model_warnings(text)) == bool(model.provisional)


@pytest.mark.parametrize(
    ("term", "typeset"),
    [
        ("Fc sign(u')", "F<sub>c</sub> sign(u′)"),
        ("k3 u^3 in the damper", "k<sub>3</sub> u<sup>3</sup> in the damper"),
        ("ch |u_j| u_j'", "c<sub>h</sub> |u<sub>j</sub>| u<sub>j</sub>′"),
        ("-M g tilt x", "−M g tilt x"),
        ("a < b by rate", "a &lt; b by rate"),
        ("(1 + (w2 / a)^4)^(1/4)", "(1 + (w<sub>2</sub> / a)<sup>4</sup>)<sup>1/4</sup>"),
    ],
)
def test_laws_are_typeset(term: str, typeset: str) -> None:
    assert typeset_law(term) == typeset


@pytest.mark.parametrize(
    ("value", "half", "texts"),
    [(12345.678, 0.05, ["12\u2009345.678", "12\u2009345.628", "12\u2009345.728"]),
     (510000.0, 300.0, ["510\u2009000", "509\u2009700", "510\u2009300"]),
     (1500.4, 0.45, ["1500.40", "1499.95", "1500.85"]), (0.4, 0.2, ["0.40", "0.20", "0.60"]),
     (3.8e-4, 3.7e-4, ["0.00038", "0.00001", "0.00075"]), (-2.0, 30.0, ["−2", "−32", "28"]),
     (-0.2, 30.0, ["0", "−30", "30"]),
     (2e300, 1e299, ["2.000·10^300", "1.900·10^300", "2.100·10^300"]),
     (3.0, 0.0, ["3.000", "3.000", "3.000"])],
)  # fmt: skip
def test_interval_can_be_distinguished_from_its_value(
    value: float, half: float, texts: list[str]
) -> None:
    interval = Interval(value=value, low=value - half, high=value + half, unit="")
    assert format_with_interval(interval) == texts


def test_the_gates_pass_where_no_sensor_errs_and_fail_where_one_does(
    every: dict[str, DiscoveryOutput],
) -> None:
    output = every["none"]
    shown = DiscoveryView(output.discovery, output.logs)
    assert {gate.passed for gate in check_instruments(shown)} == {True}
    assert ">FAIL<" not in output.page
    sheet = output.discovery.prepared.problem.log_residuals[0]
    null = output.discovery.selection.null
    mass = sheet.entry_row == sheet.rows.index("mass")
    at_rest = sheet.entry_row == len(sheet.rows)
    wrong = np.where(mass, 2.0, np.where(at_rest, 9.0, null.held_out[0]))
    broken = replace(
        output.discovery.selection, null=replace(null, fit=replace(null.fit, held_out=(wrong,)))
    )
    broken_view = DiscoveryView(replace(output.discovery, selection=broken), output.logs)
    failed = [gate.label for gate in check_instruments(broken_view) if not gate.passed]
    assert failed[0].startswith("mass: ")
    assert len(failed) == 1 + len(sheet.rest_channels)


CUBIC = Hidden("cubic_stiffness", 3e6)


@cache
def without_accelerometer() -> tuple[Discovery, PreparedLog]:
    """A record whose force of inertia is a second derivative: its balance is whitened in a fit."""
    block = record_block(CUBIC, noise=2e-4)
    kept = [k for k, name in enumerate(block.channels) if name != "mass_acc_m_s2"]
    bare = replace(
        block, channels=tuple(block.channels[k] for k in kept), values=block.values[kept]
    )
    log = prepare(bare, CUBIC)
    return discover_effects([log], start_model()), log


def test_the_law_is_that_of_the_effect_over_its_displacement() -> None:
    discovery, log = without_accelerometer()
    assert discovery.verdict.best.names == ("cubic_stiffness",)
    (forces,) = DiscoveryView(discovery, [log]).forces_of_each
    u = simulate(CUBIC)[0]
    law = CUBIC.a * u**3
    k3 = discovery.verdict.best.fit.values[EffectKey("cubic_stiffness", "k3")]
    assert k3 == pytest.approx(CUBIC.a, rel=0.02)
    used = np.isfinite(forces.law[0])
    assert used.sum() > 0.8 * u.size
    largest = float(np.abs(law).max())
    assert forces.law[0][used] == pytest.approx(law[used], abs=0.03 * largest)
    required = forces.required[0][used]
    assert np.corrcoef(required, law[used])[0, 1] > 0.95
    assert np.isnan(forces.law[1:]).all()


@pytest.fixture(scope="module")
def fit() -> FitResult:
    return prepare_bare_log().first_fit


@pytest.mark.parametrize(
    ("gain", "std_error", "named", "faulty"),
    [
        (1.0001, 5e-5, [], []),
        (1.012, 5e-5, [], []),  # as in any laboratory
        (1.05, 5e-5, [], ["sensor_gain"]),
        (1.021, 0.01, [], []),  # not known that well
        (1.012, 5e-5, ["sensor_gain.table_acc_m_s2"], ["sensor_gain"]),
        (1.0, 5e-5, ["sensor_offset.table_acc_m_s2"], ["sensor_offset"]),
    ],
)
def test_a_sound_sensor_of_the_table_is_not_to_be_repaired(
    gain: float, std_error: float, named: list[str], faulty: list[str], fit: FitResult
) -> None:
    """Without an accelerometer on the specimen that of the table is fitted in every recording.

    What a discovery names it says, however small.
    """
    parameters = fit.parameters.with_values({INPUT_GAIN: gain, INPUT_OFFSET: 1e-3})
    std_errors = {**fit.std_errors, INPUT_GAIN: std_error, INPUT_OFFSET: 1e-4}
    fitted = replace(fit, parameters=parameters, std_errors=std_errors)
    text, notes = format_fitted_model(fitted, "specimen", "", "a log", named=named)
    assert "sensor" not in text
    assert [note.partition(".")[0] for note in notes] == faulty
