"""Scoring of verdicts made by hand, the counting of them, and a study that goes on."""

import json
from pathlib import Path
from typing import Any

import pytest
from scipy.optimize import brentq

from tests.studies.blind.harness import RESULTS_FILE
from tests.studies.blind.metrics import (
    Rate,
    compute_calibration,
    compute_metrics,
    select_usable,
)
from tests.studies.blind.page import format_table, write_study_pages
from tests.studies.blind.scoring import format_effect_name, score_verdict, select_worst_misses

Json = dict[str, Any]
REGION = {"frequency_hz": [2.0, 3.2], "phase": ["contact_right", "contact_left"]}
TRUE: Json = {"name": "bumper_hardening", "parameters": {"k2": 1e8}, "vanishing": {"k2": 0.0}}
LAG: Json = {
    "name": "sensor_lag.mass_disp_m",
    "parameters": {"lag": 1e-3},
    "vanishing": {"lag": 0.0},
}
OTHER: Json = {"name": "table_tilt", "parameters": {"tilt": 0.1}, "vanishing": {"tilt": 0.0}}


def about(kind: str = "single", *effects: Json, **more: Any) -> Json:
    return {
        "number": 7, "cell": kind, "kind": kind, "noise": 0.01, "size": 3.0, "reached": 3.1,
        "region": REGION, "ended": "complete", "sized": True, "effects": list(effects),
    } | more  # fmt: skip


def verdict(kind: str, *names: str, **more: Any) -> Json:
    value = {"value": 1.02e8, "low": 0.99e8, "high": 1.05e8, "unit": "N/m2"}
    effects = [
        {"id": name, "confidence": 0.9 - 0.1 * k, "parameters": {"k2": value}}
        for k, name in enumerate(names)
    ]
    where = {"frequency_hz": [3.0, 4.0], "direction": "both", "phase": "contact_right"}
    gap = {"held_out_before": 3.0, "held_out_after": 1.05, "noise_floor": 1.0}
    return {
        "verdict": kind, "effects": effects, "ambiguous": [], "where": where, "gap": gap,
        "candidates": [
            {"id": "gap_offset", "held_out_error": 1.4, "converged": True},
            {"id": "hunt_crossley", "held_out_error": 1.2, "converged": True},
            {"id": "bumper_hardening", "held_out_error": 1.05, "converged": True},
            {"id": "table_tilt", "held_out_error": 0.5, "converged": False},
            {"id": "gap_drift + bumper_hardening", "held_out_error": 0.9, "converged": True},
            {"id": "general.u^2", "held_out_error": 0.8, "converged": True},
            {"id": "nothing added", "held_out_error": 0.7, "converged": True},
        ], "seconds": 4.0,
    } | more  # fmt: skip


def test_score_verdict_of_the_true_effect() -> None:
    row = score_verdict(verdict("named", "bumper_hardening"), about("single", TRUE), oracle=1.04)
    assert (row["top1"], row["exact"], row["two"], row["right"], row["region"]) == (True,) * 5
    assert row["confidence"] == 0.9
    assert row["after_floor"] == 1.05
    assert row["after_oracle"] == pytest.approx(1.05 / 1.04)
    assert row["closed"] == pytest.approx(0.975)
    assert row["parameters"] == [
        {
            "name": "bumper_hardening.k2",
            "error": pytest.approx(0.02),
            "covered": True,
            "alike": False,
        }
    ]


def test_a_wrong_name_and_the_right_one_as_second_best() -> None:
    row = score_verdict(verdict("named", "hunt_crossley"), about("single", TRUE))
    assert (row["top1"], row["two"], row["right"], row["parameters"]) == (False, True, False, [])
    far = score_verdict(verdict("named", "gap_drift", candidates=[]), about("single", TRUE))
    assert not far["two"]
    more = score_verdict(verdict("named", "bumper_hardening", "gap_drift"), about("single", TRUE))
    assert (more["top1"], more["exact"]) == (True, False)


def test_an_ambiguous_verdict_counts_by_its_two() -> None:
    both = [["hunt_crossley", "bumper_hardening"]]
    row = score_verdict(verdict("ambiguous", ambiguous=both), about("single", TRUE))
    assert (row["top1"], row["two"], row["confidence"]) == (False, True, None)
    three = [["hunt_crossley", "gap_offset", "bumper_hardening"]]
    assert not score_verdict(verdict("ambiguous", ambiguous=three), about("single", TRUE))["two"]
    sets = [["hunt_crossley"], ["bumper_hardening"], ["gap_offset"]]
    assert score_verdict(verdict("ambiguous", ambiguous=sets), about("single", TRUE))["two"]
    assert not score_verdict(verdict("ambiguous", ambiguous=sets[::2]), about("single", TRUE))[
        "two"
    ]


def test_what_all_sets_of_an_ambiguous_verdict_have_is_named() -> None:
    sets = [["table_tilt", "gap_drift"], ["gap_offset", "table_tilt"]]
    row = score_verdict(verdict("ambiguous", ambiguous=sets), about("pair", TRUE, OTHER))
    assert (row["named"], row["one"], row["both"]) == (["table_tilt"], True, False)
    alone = score_verdict(
        verdict("ambiguous", ambiguous=[["table_tilt"]]), about("pair", TRUE, OTHER)
    )
    assert alone["named"] == []


def test_score_verdict_of_false_alarms_and_misses() -> None:
    assert score_verdict(verdict("none"), about("none", region=None))["false_alarm"] is False
    for kind in ("named", "ambiguous", "unexplained", "failed"):
        score = score_verdict(verdict(kind, "table_tilt"), about("none", region=None))
        assert score["false_alarm"] is True
        assert not score["right"]
    missed = score_verdict(verdict("none"), about("single", TRUE))
    assert (missed["top1"], missed["two"], missed["region"]) == (False, False, False)


def test_score_verdict_of_an_effect_outside_the_library() -> None:
    unknown = about("unknown", {**TRUE, "name": "adhesion"})
    row = score_verdict(verdict("unexplained"), unknown)
    assert (row["unexplained"], row["wrong_name"], row["region"]) == (True, False, True)
    row = score_verdict(verdict("named", "hunt_crossley"), unknown)
    assert (row["unexplained"], row["wrong_name"], row["right"]) == (False, True, False)


def test_score_verdict_of_a_pair_counts_both_or_either() -> None:
    pair = about("pair", TRUE, OTHER)
    for names, both, either in (
        (("table_tilt", "bumper_hardening"), True, True),
        (("table_tilt", "gap_drift"), False, True),
        (("gap_drift",), False, False),
    ):
        row = score_verdict(verdict("named", *names), pair)
        assert (row["both"], row["one"], row["right"]) == (both, either, both), names
    assert score_verdict(verdict("unexplained", "table_tilt"), pair)["one"]


def test_a_sensor_is_named_with_its_channel() -> None:
    for effect in (
        {"id": "sensor_lag.mass_disp_m"},
        {"id": "sensor_lag", "channel": "mass_disp_m"},
        {"id": "sensor_lag", "parameters": {"channel": "mass_disp_m"}},
    ):
        assert format_effect_name(effect) == "sensor_lag.mass_disp_m"
    assert not score_verdict(verdict("named", "sensor_lag.mass_acc_m_s2"), about("sensor", LAG))[
        "top1"
    ]
    assert score_verdict(verdict("named", "sensor_lag.mass_disp_m"), about("sensor", LAG))["top1"]


@pytest.mark.parametrize(
    ("band", "phase", "right"),
    [
        ([3.2, 4.4], "contact_left", True),
        ([2.4, 2.8], "contact_both", True),
        ([3.6, 4.4], "contact_left", False),
        ([2.0, 3.2], "flight", False),
        ([2.0, 3.2], "all", False),
    ],
)
def test_a_region_is_right_where_band_and_phase_overlap(
    band: list[float], phase: str, right: bool
) -> None:
    where = {"frequency_hz": band, "direction": "both", "phase": phase}
    score = score_verdict(verdict("unexplained", where=where), about("unknown", TRUE))
    assert score["region"] is right
    everywhere = about("unknown", TRUE, region={**REGION, "phase": ["flight", "contact_left"]})
    all_over = {**where, "frequency_hz": [2.0, 3.0], "phase": "all"}
    assert score_verdict(verdict("unexplained", where=all_over), everywhere)["region"]


def test_errors_are_relative_to_what_an_effect_departs() -> None:
    gain = {"name": "sensor_gain.mass_acc_m_s2", "parameters": {"gain": 1.05},
            "vanishing": {"gain": 1.0}}  # fmt: skip
    values = verdict("named")
    values["effects"] = [
        {"id": "sensor_gain", "channel": "mass_acc_m_s2", "confidence": 1.0,
         "parameters": {"gain": {"value": 1.06, "low": 1.055, "high": 1.065, "unit": ""}}}
    ]  # fmt: skip
    (score,) = score_verdict(values, about("sensor", gain))["parameters"]
    assert score["error"] == pytest.approx(0.2)
    assert score["covered"] is False


@pytest.mark.parametrize(("hits", "count"), [(0, 10), (1, 150), (9, 10), (57, 60), (10, 10)])
def test_wilson_intervals_are_where_the_score_test_just_rejects(hits: int, count: int) -> None:
    """Closed form against the definition: |p - p0| = z sqrt(p0 (1 - p0) / n)."""
    p, (low, high) = hits / count, Rate(hits, count).interval

    def test(p0: float) -> float:
        return (p - p0) ** 2 - 1.959963984540054**2 * p0 * (1 - p0) / count

    assert low == pytest.approx(0.0 if not hits else brentq(test, 1e-12, p - 1e-12), abs=1e-9)
    assert high == pytest.approx(1.0 if hits == count else brentq(test, p + 1e-12, 1.0), abs=1e-9)


def test_rate_of_no_cases_is_undetermined() -> None:
    assert Rate(0, 0).interval == (0.0, 1.0)
    assert str(Rate(0, 0)) == "-"
    assert all(metric.is_reached is None for metric in compute_metrics([]))


def rows() -> list[Json]:
    """Ten right, two wrong, one that misses its size, one without a verdict, clean ones."""
    right = [score_verdict(verdict("named", "bumper_hardening"), about("single", TRUE, number=k))
             for k in range(10)]  # fmt: skip
    wrong = [score_verdict(verdict("named", "hunt_crossley"), about("single", TRUE, number=10 + k))
             for k in range(2)]  # fmt: skip
    small = {"number": 12, "cell": "single", "sized": False, "ended": "not played: the effect ..."}
    dead = score_verdict(verdict("failed"), about("single", TRUE, number=13)) | {
        "failed": "no",
        "label": "",
    }
    clean = [
        score_verdict(verdict("none" if k else "ambiguous"), about("none", number=20 + k, size=0.0))
        for k in range(4)
    ]
    return [*right, *wrong, small, dead, *clean]


def test_figures_count_what_has_its_size_and_failures_as_misses() -> None:
    metrics = {metric.name: metric for metric in compute_metrics(rows())}
    top = metrics["top-1, size >= 3, noise <= 1 %"]
    assert top.value.startswith("76.9 % (10/13;")
    assert top.is_reached is False
    assert metrics["nothing hidden: false alarm"].value.startswith("25.0 % (1/4;")
    assert metrics["held-out after / floor, named correctly"].is_reached is True
    assert metrics["parameters within 5 %, noise 1 %, all forms"].value.startswith(
        "100.0 % (10/10;"
    )
    assert metrics["parameters within 5 %, noise 1 %, the library's form"].value == "-"
    # stated 0.9, ten of twelve there: 0.9 - 0.8333
    assert metrics["stated confidence against hit rate"].value.startswith("6.7 points")
    again = [
        *rows(),
        score_verdict(verdict("named", "bumper_hardening"), about("single", TRUE, number=13)),
    ]
    assert len(select_usable(again)) == len(select_usable(rows()))
    assert {metric.name: metric for metric in compute_metrics(again)}[top.name].value.startswith(
        "84.6 % (11/13;"
    )


def test_one_effect_is_counted_by_its_size_and_the_noise() -> None:
    def row(number: int, noise: float, size: float, name: str = "bumper_hardening") -> Json:
        case = about("single", TRUE, number=number, noise=noise, size=size)
        return score_verdict(verdict("named", name), case)

    rows = [row(1, 0.01, 3.0), row(2, 0.01, 1.5, "gap_drift"), row(3, 0.002, 1.5)]
    rows += [row(4, 0.05, 10.0), row(5, 0.05, 1.5), row(6, 0.05, 1.5, "gap_drift")]
    values = {metric.name: metric.value for metric in compute_metrics(rows)}
    assert values["top-1, size >= 3, noise <= 1 %"].startswith("100.0 % (1/1;")
    assert values["top-1, size 1.5, noise <= 1 %"].startswith("50.0 % (1/2;")
    assert values["top-1, noise 5 %"].startswith("66.7 % (2/3;")
    assert values["gap closed >= 0.95, size >= 3"].endswith("(2/2; 34.2 to 100.0)")


def test_two_effects_are_counted_whole_and_where_both_leave_a_mark() -> None:
    def pair(number: int, mark: float | None, *names: str) -> Json:
        answer = verdict("named", *names) if names else verdict("failed")
        return score_verdict(answer, about("pair", TRUE, OTHER, number=number)) | {"mark": mark}

    both = (TRUE["name"], OTHER["name"])
    some = [pair(1, 2.0, *both), pair(2, 1.01, both[0]), pair(3, 1.3), pair(4, None, both[1])]
    values = {metric.name: metric.value for metric in compute_metrics(some)}
    assert values["two effects: both"].startswith("25.0 % (1/4;")
    assert values["two effects: at least one"].startswith("75.0 % (3/4;")
    assert values["two effects, both identifiable: both"].startswith("50.0 % (1/2;")
    assert values["two effects, both identifiable: at least one"].startswith("50.0 % (1/2;")


def test_calibration_is_in_bins_of_what_was_stated() -> None:
    ((stated, rate),) = compute_calibration(select_usable(rows()))
    assert stated == pytest.approx(0.9)
    assert (rate.hits, rate.count) == (10, 12)


def test_a_table_counts_each_truth_by_what_was_said() -> None:
    usable = select_usable(rows())
    lines = list(format_table("Named", [row for row in usable if row["kind"] == "single"], "top1"))
    assert "| hidden | 1 %, size 3 | all | verdicts |" in lines
    (line,) = [line for line in lines if line.startswith("| bumper_hardening |")]
    assert line.startswith("| bumper_hardening | 10/13 | 76.9 %")
    assert line.endswith("| bumper_hardening 10, hunt_crossley 2, failed 1 |")
    false = format_table("Alarms", [row for row in usable if row["kind"] == "none"], "false_alarm")
    assert any("| (nothing) | 1/4 |" in line and "none 3, ambiguous 1" in line for line in false)


def test_the_page_has_counts_misses_and_a_picture(tmp_path: Path) -> None:
    (tmp_path / RESULTS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows()))
    text = write_study_pages(tmp_path).read_text()
    assert "| top-1, size >= 3, noise <= 1 % | >= 95 % | 76.9 % (10/13;" in text
    assert "| bumper_hardening | 10/13 | 76.9 %" in text
    assert "1 without a verdict" in text
    assert "not played 1 (" in text
    assert [miss["number"] for miss in select_worst_misses(select_usable(rows()))][:2] == [10, 11]
    assert "| 10 | single | bumper_hardening | hunt_crossley | 0.90 |" in text
