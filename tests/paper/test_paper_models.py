"""`shaketwin paper --model`: another model through the same figures, integrated or not."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.input_errors import raises_input_error
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.paper import command, findings, study
from twin.paper.slow_passage import COARSE_EFFORT, SlowSweep
from twin.paper.table import DEPARTS, make_comparison_table
from twin.results.paper_cases import load_paper_cases
from twin.results.players import ClosedFormSimulator, NumericalSimulator, make_simulator
from twin.setup.run_config import read_model

AG = 0.05 * 9.80665
G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)
PRESSED = replace(G4, gap_r=-1e-3, gap_l=-1e-3)
HARD = Model(G4).with_effect("bumper_hardening", k2=6e7)


def card(folder: Path, effect: str, numbers: str) -> str:
    """The paper's model with an effect, as a file."""
    path = folder / "other.toml"
    text = read_model("snm")[1]
    path.write_text(f'{text}[[effects]]\nid = "{effect}"\nparameters = {{ {numbers} }}\n')
    return str(path)


def test_make_simulator_is_exact_for_piecewise_linear_models() -> None:
    assert make_simulator(Model(G4)).is_exact
    assert make_simulator(Model(G4).with_effect("gap_offset", offset=2e-4)).is_exact
    assert not make_simulator(HARD).is_exact
    assert not make_simulator(Model(G4).with_effect("table_tilt", tilt=1e-3)).is_exact


@pytest.mark.parametrize("hz", [2.0, 3.4])
def test_closed_form_and_numerical_simulators_agree(hz: float) -> None:
    exact, sampled = ClosedFormSimulator(Model(G4)), NumericalSimulator(Model(G4))
    exact_sweep, other = (who.sweep([hz, hz + 0.1], AG, 30) for who in (exact, sampled))
    np.testing.assert_allclose(other.extremes, exact_sweep.extremes, rtol=5e-4, atol=1e-12)
    state = exact_sweep.states[-1]
    motions = (
        exact.simulate_motion(hz + 0.1, AG, state, 2),
        sampled.simulate_motion(hz + 0.1, AG, state, 2),
    )
    for name in ("time", "u", "v", "a", "force_r", "force_l", "v_r", "v_l"):
        a, b = (getattr(motion, name) for motion in motions)
        np.testing.assert_allclose(b, a, rtol=1e-5, atol=2e-5 * np.abs(a).max())
    for a, b in zip(*(who.find_onsets(hz + 0.1, AG, state, 250)[:2] for who in (exact, sampled)),
                    strict=True):  # fmt: skip
        np.testing.assert_allclose(b, a, atol=1.1 / 300)
        assert a.size == 250


def test_a_state_is_carried_on_and_left_as_it_is() -> None:
    who = NumericalSimulator(HARD)
    whole = who.sweep([2.0, 2.5], AG, 6)
    first = who.sweep([2.0], AG, 6)
    before = first.states[-1].copy()
    second = who.sweep([2.5], AG, 6, first.states[-1])
    assert second.extremes.tobytes() == whole.extremes[1:].tobytes()
    who.sample(2.5, AG, first.states[-1], 1)
    who.find_onsets(2.5, AG, first.states[-1], 3)
    who.lyapunov_exponent(2.5, AG, first.states[-1], 3)
    assert first.states[-1].tobytes() == before.tobytes()


@pytest.mark.parametrize(("hz", "chaotic"), [(0.53, True), (0.71, True), (2.0, False)])
def test_exponents_of_both_players_tell_the_same(hz: float, chaotic: bool) -> None:
    exact, sampled = ClosedFormSimulator(Model(G4)), NumericalSimulator(Model(G4))
    state = exact.sweep([hz], AG, 150).states[0]
    want, _ = exact.lyapunov_exponent(hz, AG, state, 1500)
    got, _ = sampled.lyapunov_exponent(hz, AG, sampled.sweep([hz], AG, 150).states[0], 400)
    assert (want > study.MIN_CHAOTIC_EXPONENT, got > study.MIN_CHAOTIC_EXPONENT) == (
        chaotic,
        chaotic,
    )
    assert got == pytest.approx(want, abs=0.15)


def test_bumpers_at_rest_carry_what_precompression_gives_them() -> None:
    still = ClosedFormSimulator(Model(PRESSED)).bumper_preload()
    assert still == pytest.approx({"u_r": 1e-3, "u_l": 1e-3, "f_r": 510.0, "f_l": 510.0})
    hard = NumericalSimulator(
        Model(PRESSED).with_effect("bumper_hardening", k2=1e8)
    ).bumper_preload()
    assert hard["f_r"] == pytest.approx(510.0 + 100.0)
    uneven = ClosedFormSimulator(
        Model(PRESSED).with_effect("bumper_asymmetry", ratio=1.5)
    ).bumper_preload()
    assert uneven["f_r"] > uneven["f_l"]
    assert not any(ClosedFormSimulator(Model(G4)).bumper_preload().values())


def test_the_other_model_is_in_every_case(tmp_path: Path) -> None:
    cases = load_paper_cases(card(tmp_path, "gap_offset", "offset = 3e-4"), (0.02, 1.5))
    assert {case.scale for case in cases.values()} == {(0.02, 1.5)}
    p = cases["G4"].parameters
    assert (p.gap_r, p.gap_l) == (pytest.approx(2.3e-3), pytest.approx(1.7e-3))
    own = load_paper_cases()["G4"]
    assert own.scale == pytest.approx((30.537e-3, 2.057), rel=2e-4)


def test_uneven_bumpers_let_go_where_a_sweep_says_so(tmp_path: Path) -> None:
    case = load_paper_cases(card(tmp_path, "bumper_asymmetry", "ratio = 1.3"))["G-10"]
    gap = findings.find_permanent_contact_mm(case)
    assert -8 < gap < -4.3
    assert findings.detaches(case, gap + 0.05)
    assert not findings.detaches(case, gap - 0.02)


def test_a_model_whose_gaps_move_has_no_steady_motion(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command, "write_comparison", lambda *_: None)
    with raises_input_error(remedy="effect", where="effect 'gap_drift'"):
        command.compare_with_paper(tmp_path / "out", [], card(tmp_path, "gap_drift", "rate = 1e-6"))
    assert not (tmp_path / "out").exists()
    with raises_input_error(where="--model snn", remedy="'snm'"):
        command.compare_with_paper(tmp_path / "out", [], "snn")


def test_hysteresis_of_an_integrated_model_is_that_of_slow_passage(tmp_path: Path) -> None:
    case = load_paper_cases(card(tmp_path, "bumper_hardening", "k2 = 6e7"))["G4"]
    f = np.arange(0.5, 5.0, COARSE_EFFORT.fine_hz)
    flight = np.full(f.size, 0.05)
    hit = np.where((f > 2.495) & (f < 3.505), 0.2, flight)
    back = np.where((f > 2.495) & (f < 2.995), 0.2, flight)
    touched = {"forward": hit > 0.1, "backward": back > 0.1}
    states = {direction: np.zeros((f.size, 14)) for direction in ("forward", "backward")}
    eta = {"forward": hit, "backward": back}
    sweep = SlowSweep(f, states, eta, eta, touched)
    fold = findings.find_folds(case, sweep)
    assert fold is not None
    assert (fold.kind, fold.method) == ("right", "slow passage")
    assert (fold.backward_hz, fold.forward_hz) == (pytest.approx(3.0), pytest.approx(3.5))
    assert findings.find_graze_hz(case, sweep) == pytest.approx(2.98)


@pytest.mark.slow
def test_every_figure_of_an_integrated_model(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command.compare_with_paper(out, [], card(tmp_path, "bumper_hardening", "k2 = 6e7"))
    results = json.loads((out / "paper.json").read_text())
    assert results["model"]["name"] == "other"
    assert "bumper_hardening" in results["model"]["toml"]
    assert len(results["figures"]) == len(list((out / "figures").iterdir())) >= 12
    html = (out / "report.html").read_text()
    assert "<th>other gives</th>" in html
    assert "No parameter was changed to agree" not in html
    assert "nan" not in re.sub(r"base64,[^\"]*", "", html).replace("resonance", "")


@pytest.mark.slow
def test_the_paper_s_model_integrated_finds_what_closed_form_finds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Every statement but those that only the one-period map can make."""
    want = {row.key: row for row in make_comparison_table(study.run_paper_study())}
    monkeypatch.setattr("twin.results.paper_cases.make_simulator", NumericalSimulator)
    got = {row.key: row for row in make_comparison_table(study.run_paper_study())}
    assert got.keys() == want.keys()
    assert {key: row.verdict for key, row in got.items()} == {
        key: row.verdict for key, row in want.items()
    }
    for key, name, near in (
        ("g30", "down_hz", 0.05), ("g10", "down_hz", 0.05), ("g4", "fold_down_hz", 0.1),
        ("g4", "graze_hz", 0.05), ("g0", "resonance_hz", 0.03), ("gm10", "resonance_hz", 0.03),
        ("g4_coexisting", "impacting_mm", 0.002), ("g4_coexisting", "flight_mm", 0.002),
        ("permanent_contact", "gap_mm", 0.05),
    ):  # fmt: skip
        assert got[key].values[name] == pytest.approx(want[key].values[name], abs=near)
    assert got["gm2"].verdict == DEPARTS
