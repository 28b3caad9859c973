"""`shaketwin paper`: every number of the table, the departures too, and what the folder holds.

The numbers are those of the project's physics page, computed there with another exact solver.
Chaos is compared by statistics only.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tests.input_errors import raises_input_error
from twin.cli.table import app
from twin.paper import command
from twin.paper.findings import count_onsets_per_cycle, find_bands
from twin.paper.study import CHAOS_SCAN_HZ, PaperStudy, run_paper_study
from twin.paper.table import (
    ComparisonRow,
    count_causes,
    format_uncertain,
    make_comparison_table,
)
from twin.results.measured_campaign import load_measured_campaign
from twin.results.report_data import extract_prc


@pytest.fixture(scope="module")
def study() -> PaperStudy:
    return run_paper_study()


@pytest.fixture(scope="module")
def rows(study: PaperStudy) -> dict[str, ComparisonRow]:
    return {row.key: row for row in make_comparison_table(study)}


NUMBERS = [
    ("free_flight", "resonance_hz", 1.268, 5e-4),
    ("free_flight", "u_star_mm", 30.537, 1e-3),
    ("free_flight", "a_star_m_s2", 2.057, 5e-4),
    ("free_flight", "grid_u_max_mm", 29.95, 0.015),  # ten cycles leave a little of a transient
    ("free_flight", "grid_hz", 1.3, 1e-9),
    ("g30", "down_hz", 1.948, 6e-4),
    ("g30", "up_hz", 1.52, 0.007),
    ("g16", "down_hz", 2.634, 6e-4),
    ("g16", "up_hz", 1.76, 0.005),
    ("g10", "down_hz", 3.158, 6e-4),
    ("g10", "up_hz", 2.01, 0.005),
    ("g4", "fold_down_hz", 4.027, 6e-4),
    ("g4", "graze_hz", 2.794, 6e-4),
    ("g4", "fold_up_hz", 2.787, 6e-4),
    ("g4", "passage_from_hz", 4.15, 0.1),  # 4.1 to 4.3 Hz: passage is later than the fold
    ("g4_coexisting", "impacting_mm", 5.123, 5e-4),
    ("g4_coexisting", "flight_mm", 1.247, 5e-4),
    ("g4_coexisting", "unstable_mm", 3.297, 5e-4),
    ("g4_coexisting", "multiplier_1", 3.115, 5e-4),
    ("g4_coexisting", "multiplier_2", 0.138, 5e-4),
    ("g4_11", "two_two_gap_mm", 3.0, 0.15),
    ("g4_11", "own_hz", 1.0099, 0.0015),
    ("g4_11", "own_two_share", 1.0, 1e-9),
    ("second_impact", "force_ratio", 0.53, 0.02),
    ("second_impact", "duration_ratio", 0.88, 0.02),
    ("g4_14", "twice_once_share", 0.70, 0.08),
    ("g0_flight", "share", 0.017, 0.001),
    ("g0_flight", "elastic_share", 0.0017, 1e-4),
    ("g0_release", "remaining", 0.055, 0.003),
    ("no_impact", "largest", 0.0, 0.0),
    ("shift", "difference", 1.05, 0.03),
    ("g0", "resonance_hz", 5.00, 0.02),
    ("gm1", "from_hz", 5.23, 0.005),
    ("gm1", "to_hz", 5.26, 0.005),
    ("gm2", "from_hz", 5.81, 0.005),
    ("gm2", "to_hz", 6.15, 0.005),
    ("gm10", "resonance_hz", 6.95, 0.02),
    ("permanent_contact", "gap_mm", -4.265, 5e-4),
]
VERDICTS = {
    "eta_definition": "no number to compare", "free_flight": "no number to compare",
    "g30": "agrees", "g16": "agrees", "g10": "agrees", "g4": "agrees",
    "displacement_trend": "agrees", "acceleration_trend": "agrees", "bumper_trend": "agrees",
    "no_impact": "agrees", "always_contact": "agrees", "offset": "agrees", "shift": "departs",
    "g4_coexisting": "agrees", "left_hystereses": "agrees", "secondary_number": "agrees",
    "secondary_positions": "agrees in kind", "g4_053": "agrees", "g4_071": "agrees",
    "g4_11": "agrees", "second_impact": "agrees", "three_impacts": "agrees",
    "superimposed": "departs", "g4_14": "agrees", "g4_irregular": "agrees",
    "g4_chaos": "agrees in kind", "g4_growth": "departs", "g0": "agrees", "g0_flight": "agrees",
    "g0_release": "agrees", "gm1": "agrees in kind",
    "gm1_forward": "departs", "gm2": "departs", "gm10": "agrees in kind", "overlap": "departs",
    "permanent_contact": "departs", "transition_trend": "agrees", "bumpers_alike": "agrees",
    "g4_quantities": "agrees", "loops_growth": "agrees", "loops_left": "agrees in kind",
    "loops_third": "agrees", "g4_14_loop": "agrees", "gm1_backward": "agrees",
    "gm1_quantities": "agrees",
}  # fmt: skip


@pytest.mark.parametrize("key, name, want, tolerance", NUMBERS)
def test_value_of_a_paper_row_is_within_its_tolerance(rows, key, name, want, tolerance):
    assert rows[key].values[name] == pytest.approx(want, abs=tolerance)


def test_verdicts_of_the_paper_rows_include_departures(rows):
    assert {key: row.verdict for key, row in rows.items()} == VERDICTS


def test_departures_say_what_the_model_does_instead(rows):
    assert rows["g4_11"].values["two_two_share"] < 0.05
    assert rows["g4_11"].values["one_one_share"] > 0.6
    assert rows["gm2"].values["detaches"] is True
    assert "left hysteresis" in rows["gm2"].model
    assert rows["permanent_contact"].values["confirmed"] is True
    assert rows["gm1_forward"].values["amplitude_mm"] > 0.5
    assert "−13 %" in rows["gm1"].model
    assert rows["g0"].values["hysteresis"] is False


@pytest.mark.parametrize("key, usual", [("g4_053", 0.4), ("g4_071", 0.4)])
def test_impacts_as_distributions(rows, key, usual):
    assert rows[key].values["usual_share"] > usual
    assert 0.05 < rows[key].values["sometimes_share"] < 0.6


def test_chaotic_bands_and_exponents(study, rows):
    for low, high in ((0.5, 0.545), (0.645, 0.765), (1.07, 1.17), (1.23, 1.41)):
        near = [
            band
            for band in find_bands(CHAOS_SCAN_HZ, study.exponents)
            if abs(band[0] - low) < 0.008
        ]
        assert near
        assert near[0][1] == pytest.approx(high, abs=0.008)


def test_exponents_lie_within_their_errors(rows):
    """Reference: 0.6099(12), 0.7365(9), 0.6110(25), 0.3276(3) per cycle, by another code."""
    values = rows["g4_chaos"].values
    assert values["exponents"] == pytest.approx([0.6099, 0.7365, 0.6110, 0.3276], abs=0.011)
    assert all(2e-4 < error < 4e-3 for error in values["errors"])


def test_an_error_has_two_digits():
    assert format_uncertain(0.60991, 0.00124) == "+0.6099(12)"
    assert format_uncertain(-0.3276, 0.034) == "−0.328(34)"


def test_left_hystereses_and_their_number(rows):
    """References: G4 0.6023-0.6482, 0.9018-1.0099, 1.5185-1.5512 Hz; G10 0.6690-0.6884 Hz."""
    g4, g10 = (rows["left_hystereses"].values[name] for name in ("g4_hz", "g10_hz"))
    within = [ends for ends in g4 if ends[0] > 0.5]  # the range of the tests
    assert np.array(within) == pytest.approx(
        np.array([[0.6023, 0.6482], [0.9018, 1.0099], [1.5185, 1.5512]]), abs=0.0015
    )
    assert np.array(g10) == pytest.approx(np.array([[0.6690, 0.6884]]), abs=0.0015)
    assert rows["secondary_number"].values["counts"] == [0, 0, 1, 4]


def test_positions_of_the_secondary_resonances(rows):
    values = rows["secondary_positions"].values
    assert values["own_hz"] == pytest.approx([0.496, 0.648, 1.010], abs=0.0015)
    assert values["errors"] == pytest.approx([-0.06, -0.09, -0.08], abs=0.01)


def test_bumper_ratios_follow_the_acceleration(rows):
    names = ["G30", "G16", "G10", "G4", "G0", "G-1"]
    assert names[int(np.argmax(rows["acceleration_trend"].values["eta_a"]))] == "G16"
    for ratio in ("eta_j", "r_j"):
        assert names[int(np.argmax(rows["bumper_trend"].values[ratio]))] == "G10"
    assert rows["offset"].values["offsets"] == pytest.approx(
        np.array([0.5, 1.0, 5.0]) / 30.537, rel=1e-3
    )
    assert min(rows["offset"].values["smallest_above"]) > 0.005


def test_eq_1_over_all_cycles_is_more_in_chaos_only(study, rows):
    values = rows["eta_definition"].values
    assert 0.01 < values["largest_excess"] < 0.1
    assert study.is_chaotic(values["at_hz"])


def test_later_impacts_are_weaker(rows):
    peaks = rows["three_impacts"].values["peaks_n"]
    assert peaks == pytest.approx([590, 533, 334], rel=0.03)


def test_quasi_periodicity_does_not_grow(rows):
    assert rows["g4_growth"].values["scatters"] == pytest.approx([0.010, 0.019, 0.010], abs=0.002)


def test_forward_and_backward_differ_at_the_secondary_resonances(rows):
    differences = rows["superimposed"].values["differences"]
    assert max(differences) == pytest.approx(0.28, abs=0.02)
    assert min(differences) > 0.1


def test_internal_loops_on_the_motion(rows):
    """2 on one side and up to 3 on the other at 0.53 Hz; at 1.4 Hz one side only."""
    assert rows["loops_growth"].values["loops"] == pytest.approx([2.4, 1.5, 0.8], abs=0.1)
    fewer, more = sorted(rows["loops_left"].values["loops"][0])
    assert fewer == pytest.approx(2.0, abs=0.01)
    assert more == pytest.approx(2.75, abs=0.1)
    assert rows["g4_14_loop"].values["loops"] == pytest.approx([0.0, 0.91], abs=0.03)


def test_contact_in_the_softening_motion(rows):
    """One bumper at a time but for a tenth of the cycle, and never none."""
    both, single, none = rows["gm1_backward"].values["shares"]
    assert (both, single) == pytest.approx((0.091, 0.909), abs=0.002)
    assert none == 0.0


def test_departures_have_three_causes(rows):
    assert list(count_causes(list(rows.values())).values()) == [5, 1, 1]


def test_every_quote_has_its_place_and_no_other_words_stand_in_quotation_marks(rows):
    for row in rows.values():
        assert row.quotes or row.paper_note
        for quote in row.quotes:
            assert re.match(r"Sect\. [1-6](\.[1-3])?", quote.place)
            assert f"“{quote.text}” ({quote.place})" in row.paper
        assert '"' not in row.paper + row.model + row.rule
    assert rows["free_flight"].paper == "no number in the text"


def test_curves_are_on_the_grids_of_the_tests(study):
    f, y = extract_prc(study.cases["G4"].points, "twin", "forward", "eta_d")
    assert {0.53, 0.71, 1.1, 1.4, 3.4} <= set(f)
    assert (np.diff(f) > 0).all()
    assert f[0] == 0.5
    assert f[-1] == 5.0
    assert y.max() == pytest.approx(0.214, abs=0.002)
    f, _ = extract_prc(study.cases["G-10"].points, "twin", "backward", "eta_d")
    assert f.size == 96


def test_impacts_are_cut_where_they_are_rare():
    times = np.array([0.98, 1.01, 1.02, 1.99, 2.0, 2.03, 2.97, 3.01, 3.02, 3.98])
    assert count_onsets_per_cycle(times, 4).tolist() == [3, 3, 3]


@pytest.fixture
def known_study(monkeypatch: pytest.MonkeyPatch, study: PaperStudy) -> None:
    """The command shows the study of this module."""
    monkeypatch.setattr(command, "run_paper_study", lambda *_: study)


def test_the_command_leaves_figures_page_and_json(known_study, tmp_path: Path):
    out = tmp_path / "paper"
    result = CliRunner().invoke(app, ["paper", "--out", str(out)])
    assert result.exit_code == 0, result.output
    results = json.loads((out / "paper.json").read_text())
    numbers = {re.match(r"fig(\d+)_", Path(name).name) for name in results["figures"]} - {None}
    assert sorted(int(match[1]) for match in numbers if match) == [
        2, 3, 5, 6, 7, 8, 9, 9, 11, 11, 12,
    ]  # fmt: skip
    for name in results["figures"]:
        assert (out / name).read_bytes().startswith(b"\x89PNG")
    assert {row["key"]: row["verdict"] for row in results["table"]} == VERDICTS
    assert all(row["paper"] for row in results["table"])
    assert [interval["from_hz"] for interval in results["secondary_hysteresis"]["G10"]] == [0.67]
    assert results["lyapunov"]["0.53"]["error"] < 4e-3
    assert set(results["prc"]) == {"G∞", "G30", "G16", "G10", "G4", "G0", "G-1", "G-2", "G-10"}
    html = (out / "report.html").read_text()
    assert html.count("data:image/png;base64,") == len(results["figures"])
    assert not re.search(r"(?:src|href)=[\"'](?!data:)", html)
    for row in results["table"]:
        assert f'id="{row["key"]}"' in html
    assert "depart" in result.output


def test_an_existing_folder_with_content_is_refused(tmp_path: Path):
    (tmp_path / "mine").write_text("x")
    with raises_input_error(key="--out", value=str(tmp_path)):
        command.compare_with_paper(tmp_path, [], None)


def test_a_campaign_without_recordings_is_refused(tmp_path: Path):
    with raises_input_error(where=f"--campaign {tmp_path}", problem="run.mcap"):
        load_measured_campaign([tmp_path])


@pytest.mark.slow
def test_a_campaign_adds_the_measured_points(known_study, tmp_path: Path):
    """The simulated rig in the place of the experiment, quickstart."""
    run = CliRunner().invoke(
        app,
        ["run", "profiles/tests/quickstart.toml", "--speed", "max", "--out", str(tmp_path / "r")],
    )
    assert run.exit_code == 0, run.output
    out = tmp_path / "paper"
    result = CliRunner().invoke(app, ["paper", "--out", str(out), "--campaign", str(tmp_path)])
    assert result.exit_code == 0, result.output
    names = {path.name for path in (out / "figures").glob("rig_*.png")}
    assert names == {
        "rig_fig02_prc.png", "rig_fig05_prc.png", "rig_fig11_g4.png", "rig_fig12_histories.png",
    }  # fmt: skip
