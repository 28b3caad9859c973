"""Rigs other than the paper's: one bumper, few contacts, a low rate, load cells on one side."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from tests.recovery.scaled_specimens import (
    C_J,
    GAP,
    K_J,
    C,
    Hidden,
    K,
    prepare,
    record,
    record_block,
    start_model,
)
from twin.discovery.discover import PreparedLog, discover_effects, has_single_frequency
from twin.discovery.identify import IdentificationResult, identify_parameters
from twin.discovery.parameters import (
    BUMPER_DAMPING,
    BUMPER_STIFFNESS,
    DAMPING,
    STIFFNESS,
)
from twin.model.model import Model

TWO_BUMPERS = Hidden(gap=GAP)
ONE_BUMPER = Hidden(gap=GAP, has_left_bumper=False)
FEW_CONTACTS = Hidden(gap=35e-3)  # the motion touches a few times
TRUTH = {STIFFNESS: K, DAMPING: C, BUMPER_STIFFNESS: K_J, BUMPER_DAMPING: C_J}


def identify(
    hidden: Hidden, seed: int = 3, without: tuple[str, ...] = (), model: Model | None = None
) -> IdentificationResult:
    block = record_block(hidden, seed=seed, without=without)
    log = prepare(block, hidden)
    return identify_parameters([log], [(block,)], model or start_model())


@pytest.mark.parametrize("without", [LEFT_CELLS, RIGHT_CELLS])
def test_load_cells_on_one_side_of_two_are_ignored(without: tuple[str, ...]) -> None:
    log = record(TWO_BUMPERS, without=without)
    assert not {*RIGHT_CELLS, *LEFT_CELLS} & {*log.signals.channels}
    result = identify(TWO_BUMPERS, without=without)
    for key in (STIFFNESS, DAMPING, BUMPER_STIFFNESS):
        assert result.fit.values[key] == pytest.approx(TRUTH[key], rel=0.02), key
    assert discover_effects([log], start_model()).verdict.outcome in ("none", "unexplained")


def test_one_bumper_needs_the_cells_of_one_side() -> None:
    result = identify(ONE_BUMPER, without=LEFT_CELLS)
    assert {*RIGHT_CELLS} <= {*result.problem.log_residuals[0].signals.channels}
    for key, value in TRUTH.items():
        assert result.fit.values[key] == pytest.approx(value, rel=0.02), key
    log = record(ONE_BUMPER, without=LEFT_CELLS)
    assert discover_effects([log], start_model()).verdict.outcome == "none"


def test_bumpers_out_of_reach_do_not_ask_for_a_rate() -> None:
    """A default bumper has a contact time that no sample of a slow record resolves."""
    far = Hidden(gap=1.0)
    stiff = start_model().base
    stiff = replace(stiff, bumper_stiffness_r=5e7, bumper_stiffness_l=5e7)
    (windows,) = identify(far, model=Model(stiff)).window_errors
    assert windows is not None
    assert windows[1] < windows[0]


def test_a_rate_too_low_for_the_start_model_costs_a_comparison_alone() -> None:
    stiff = replace(start_model().base, bumper_stiffness_r=5e7, bumper_stiffness_l=5e7)
    result = identify(TWO_BUMPERS, model=Model(stiff))
    assert result.window_errors == (None,)
    assert result.fit.values[BUMPER_STIFFNESS] == pytest.approx(K_J, rel=0.02)


def test_intervals_from_few_contacts_are_honest() -> None:
    """Their scatter vanishes where there are as few as parameters; the interval must not."""
    hits = []
    for seed in range(8):
        fit = (result := identify(FEW_CONTACTS, seed)).fit
        hits.append(
            abs(fit.values[BUMPER_STIFFNESS] - K_J) < 1.96 * fit.std_errors[BUMPER_STIFFNESS]
        )
        assert 1e-3 < fit.std_errors[BUMPER_STIFFNESS] / K_J < 0.2
        assert fit.block_counts[BUMPER_STIFFNESS] < 4.0
        assert any(text.startswith("bumper_stiffness: determined by") for text in result.warnings)
    assert sum(hits) >= 7


def with_drive(values: np.ndarray) -> PreparedLog:
    block = record_block(Hidden())
    rows = block.values.copy()
    rows[block.channels.index("table_acc_m_s2")] = np.where(block.label > 0, values, 0.0)
    return prepare(replace(block, values=rows), Hidden())


def test_one_frequency_is_read_from_the_drive() -> None:
    block = record_block(Hidden())
    time = np.arange(block.values.shape[1]) / block.rate_hz
    noise = 0.01 * np.random.default_rng(0).standard_normal(time.size)
    sine, other = np.sin(2 * math.pi * 1.3 * time), np.sin(2 * math.pi * 2.1 * time)
    slow, fast = with_drive(sine + noise).signals, with_drive(other + noise).signals
    assert has_single_frequency([slow])
    assert has_single_frequency([slow, slow])
    assert not has_single_frequency([slow, fast])
    assert not has_single_frequency([with_drive(np.where(time < 16, sine, other)).signals])
    assert not has_single_frequency([prepare(block, Hidden()).signals])
    assert not has_single_frequency([slow, prepare(block, Hidden()).signals])
