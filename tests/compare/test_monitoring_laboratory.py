"""Monitoring in an imperfect laboratory: no false warning, and no blinder for the specimen."""

from functools import cache

import numpy as np
import pytest

from table_io.config.base import format_toml
from table_io.records import Agreement, Event
from tests.builders.laboratories import Level, draw_laboratory
from tests.compare.test_monitoring import EFFECT, monitor_session, warnings


@cache
def draw_truth(level: Level, seed: int, only: str | None = None) -> str:
    """Text of a ground-truth file with a random laboratory."""
    entries = draw_laboratory(level, np.random.default_rng(seed), only)
    return format_toml(
        {"imperfections": [entry.model_dump(exclude_none=True) for entry in entries]}
    )


def list_warnings(truth: str) -> list[Event]:
    """Warnings of a session, but for jumps that the model expects."""
    return warnings(monitor_session(truth), "jump")


def test_a_typical_laboratory_raises_no_warning() -> None:
    assert list_warnings(draw_truth("typical", 1)) == []


def test_the_low_cut_of_accelerometers_leaves_the_twin_within_its_band() -> None:
    items = monitor_session(draw_truth("bad", 1, "highpass"))
    agreements = [item for item in items if isinstance(item, Agreement)]
    shares = np.array([np.divide(item.error, item.band) for item in agreements])
    settled = shares[2:]
    assert np.nanmax(shares[0]) > 1.0, "the first cycle shows the low cut"
    assert (np.nanmax(settled, axis=1) < 1.0).mean() > 0.9
    assert list_warnings(draw_truth("bad", 1, "highpass")) == []


@pytest.mark.slow  # 10 s
@pytest.mark.parametrize("only", ["load_sharing", "plate_mass", "laser_nonlinearity"])
def test_a_bad_instrument_is_named_as_such_if_at_all(only: str) -> None:
    assert {warning.kind for warning in list_warnings(draw_truth("bad", 1, only))} <= {"instrument"}


@pytest.mark.slow  # 10 s
@pytest.mark.parametrize(
    ("effect", "kind"),
    [
        (EFFECT.format("stiffness_drift", "", "rate = 1.5e-3"), "drift"),
        ("[base]\nbumper_stiffness_n_m = 700e3\n", "disagreement"),
    ],
)
def test_what_is_wrong_is_seen_in_a_typical_laboratory(effect: str, kind: str) -> None:
    truth = draw_truth("typical", 1) + "\n" + effect
    assert kind in {warning.kind for warning in list_warnings(truth)}
