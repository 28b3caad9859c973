"""Controls that must fail: time reversed, the truth not in the library, truths of other cases."""

import numpy as np
import pytest

from tests.discovery.played import SNM, format_truth, log
from tests.studies.blind.discovery_study import discover_without, reverse_log, summarize_verdict
from tests.studies.blind.page import compute_shuffled_rates
from tests.studies.blind.scoring import score_verdict
from tests.studies.blind.test_scoring import about, verdict

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
