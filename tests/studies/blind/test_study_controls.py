"""Controls that must fail: time reversed, the truth not in the library, truths of other cases."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.discovery.played import SNM, format_truth, log
from tests.studies.blind import study_work
from tests.studies.blind.command import run_cases
from tests.studies.blind.comparison_tables import compute_shuffled_rates
from tests.studies.blind.controls import discover_without, reverse_log, summarize_verdict
from tests.studies.blind.report import CONTROLS_FILE, RESULTS_FILE, TABLE_FILE, write_study_pages
from tests.studies.blind.scoring import score_verdict
from tests.studies.blind.test_study_scores import about, verdict
from twin.system.process_pool import Workers

QUADRATIC = format_truth("quadratic_damping", c2=6e3)
# Left out of every run of the test, for its length; the study itself leaves out nothing.
LONG = (
    "bouc_wen",
    "maxwell_damper",
    "bumper_maxwell",
    "sensor_gain",
    "sensor_lag",
    "sensor_offset",
)
EFFECTS = ("bumper_hardening", "table_tilt", "gap_drift")


def test_a_log_backwards_is_the_same_motion_with_its_velocity_turned() -> None:
    played = log()
    forward, back = played.signals.fuse_motion(), reverse_log(played).signals.fuse_motion()
    for name, sign in (("u", 1), ("v", -1), ("acc", 1), ("table_disp", 1), ("right", 1)):
        was, reversed_ = getattr(forward, name), getattr(back, name)
        np.testing.assert_allclose(reversed_, sign * was[::-1], atol=1e-9 * np.abs(was).max())
    np.testing.assert_array_equal(back.step, forward.step[::-1])
    again = reverse_log(reverse_log(played)).signals.fuse_motion()
    np.testing.assert_allclose(again.u, forward.u, atol=1e-12)


@pytest.mark.slow  # 5 s
def test_no_control_is_given_a_confident_name() -> None:
    """The same log and library name the truth when it runs forwards and the truth is in it."""
    logs = [log(QUADRATIC)]
    right = summarize_verdict(discover_without(logs, SNM, LONG))
    assert (right["named"], right["fooled"]) == (["quadratic_damping"], True)
    assert not summarize_verdict(discover_without(logs, SNM, [*LONG, "quadratic_damping"]))[
        "fooled"
    ]
    assert not summarize_verdict(discover_without([reverse_log(logs[0])], SNM, LONG))["fooled"]


@pytest.mark.parametrize(
    "word, confidence, fooled",
    [("named", 0.51, True), ("named", 0.5, False), ("unexplained", 0.9, False)],
)
def test_who_is_fooled(word: str, confidence: float, fooled: bool) -> None:
    effects = [{"id": "table_tilt", "confidence": confidence}]
    assert summarize_verdict({"verdict": word, "effects": effects})["fooled"] is fooled


def test_shuffled_truths_fall_to_chance() -> None:
    """All right on their own truth; on others' as often as two cases share one by chance."""
    rows = [
        score_verdict(
            verdict("named", name),
            about("single", {"name": name, "parameters": {}, "vanishing": {}}),
        )
        for name in EFFECTS * 2
    ]
    own, others, guess = compute_shuffled_rates(rows)
    assert (own, guess) == (1.0, pytest.approx(1 / 3))
    assert others == pytest.approx(6 / 30), "each case has one other of five with its truth"
    unnamed = [row | {"said": "none"} for row in rows]
    assert compute_shuffled_rates(unnamed)[:2] == (0.0, 0.0)


def test_the_page_has_the_controls_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    good: dict[str, Any] = {"said": "unexplained", "named": [], "confidence": None, "fooled": False}
    bad = {"said": "named", "named": ["table_tilt"], "confidence": 0.9, "fooled": True}
    rows: list[dict[str, Any]] = [
        {"number": 7000, "reversed": good, "without": bad, "right": False},
        {"number": 16000, "reversed": good, "without": good, "right": True},
        {"number": 25000, "failed": "why"},
    ]
    (tmp_path / CONTROLS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    lines = write_study_pages(tmp_path).read_text().splitlines()
    assert any("time reversed" in line and "(0/2;" in line for line in lines)
    assert any("not in the library: confident" in line and "(1/2;" in line for line in lines)
    assert run_cases(tmp_path, [7000, 16000], Workers(1), study_work.fine, CONTROLS_FILE) == 0
    assert (tmp_path / CONTROLS_FILE).read_text().count("\n") == 3
    assert not (tmp_path / RESULTS_FILE).exists()
    assert (tmp_path / TABLE_FILE).is_file()
