"""Declared channels next to the twins: with their sign, and without touching the canonical ones."""

from dataclasses import astuple, replace

import numpy as np
import pytest

from table_io.block import Block, Float1D
from table_io.channels import CHANNELS, Channel
from tests.builders.blocks import recut_blocks
from tests.compare.test_twins import G4, make_measured_block, run_twins, shaken, twin
from twin.compare import COMPARED_CHANNELS
from twin.compare.extra_channels import select_predicted
from twin.compare.twins import TwinSetup
from twin.model.model import Model

ACC = Channel("mass_acc_2_m_s2", "m/s2", "left", "", "acceleration", "mass")
LASER = Channel("table_disp_2_m", "m", "right", "", "displacement", "table")
TOTAL = Channel("wall_force_n", "N", "tension", "", "force", "right_bumper")
SPEED = Channel("gap_speed_m_s", "m/s", "right", "", "relative_velocity", "mass")
PREDICTED = (ACC, LASER, TOTAL, SPEED)


def setup(*channels: Channel, model: Model | None = None) -> TwinSetup:
    return replace(twin(), extra_channels=channels, model=model or Model(G4))


def with_rows(block: Block, **rows: Float1D) -> Block:
    values = np.vstack([block.values, *rows.values()])
    return replace(block, values=values, channels=(*block.channels, *rows))


def lab_block(noise: float = 0.0) -> Block:
    """A block with a row for each declared channel, exact but for the noise of the others."""
    block = make_measured_block(G4, shaken(seconds=1.5), noise=noise)
    exact = make_measured_block(G4, shaken(seconds=1.5))
    speed = run_twins(setup(), [exact])[0].channel("free/rel_vel_m_s")
    force = exact.channel("force_r1_n") + exact.channel("force_r2_n")
    assert force.max() > 100.0
    return with_rows(
        block,
        mass_acc_2_m_s2=-exact.channel("mass_acc_m_s2"),
        table_disp_2_m=exact.channel("table_disp_m"),
        wall_force_n=-force,
        gap_speed_m_s=speed,
    )


def test_only_what_the_model_predicts_is_selected() -> None:
    others = (
        replace(ACC, positive="up"),
        replace(ACC, body="ground"),
        replace(LASER, quantity="rotation"),
        Channel("air_temp_degc", "degC", "", "", "temperature", "other"),
        Channel("damper_2_n", "N", "compression", "", "force", "damper"),
    )
    assert select_predicted((*others, *PREDICTED)) == PREDICTED
    compared = {channel.name for channel in select_predicted(CHANNELS)}
    assert compared == {*COMPARED_CHANNELS, "table_disp_m", "table_acc_m_s2"}


def test_extra_channels_are_compared_with_their_sign() -> None:
    block = lab_block()
    _, comparisons = run_twins(setup(*PREDICTED), [block])
    assert comparisons[0].channels == (*COMPARED_CHANNELS, *(c.name for c in PREDICTED))
    late = comparisons[-40:]
    for column in range(len(COMPARED_CHANNELS), len(comparisons[0].channels)):
        signal = sum(comparison.measured_ss[column] for comparison in late)
        for errors in ("free_error_ss", "window_error_ss"):
            error = sum(getattr(comparison, errors)[column] for comparison in late)
            assert error < 1e-4 * signal, (comparisons[0].channels[column], errors)
    wrong = replace(ACC, positive="right")
    _, comparisons = run_twins(setup(wrong), [block])
    last = comparisons[-1]
    assert last.window_error_ss[-1] == pytest.approx(4 * last.measured_ss[-1], rel=0.05)


def test_each_twin_is_compared_with_its_own_prediction() -> None:
    block = make_measured_block(G4, shaken(seconds=1.5), noise=1.0)
    block = with_rows(block, mass_acc_2_m_s2=-block.channel("mass_acc_m_s2"))
    _, comparisons = run_twins(setup(ACC), [block])
    column, last = COMPARED_CHANNELS.index("mass_acc_m_s2"), comparisons[-1]
    assert last.free_error_ss[-1] == last.free_error_ss[column]
    assert last.window_error_ss[-1] == last.window_error_ss[column] != last.free_error_ss[column]


def test_the_canonical_comparison_keeps_its_bits() -> None:
    block = lab_block(noise=1.0)
    plain = run_twins(setup(), [block])
    extra = run_twins(setup(*PREDICTED), [block])
    assert extra[0].is_identical(plain[0])
    count = len(COMPARED_CHANNELS)
    for ours, theirs in zip(plain[1], extra[1], strict=True):
        cut = [field[:count] if isinstance(field, tuple) else field for field in astuple(theirs)]
        assert repr(cut) == repr([*astuple(ours)])


@pytest.mark.parametrize("samples", [1, 7, 64, 500])
def test_the_cut_changes_no_bit(samples: int) -> None:
    block = lab_block(noise=1.0)
    model = Model(G4).with_effect("sensor_lag", "mass_acc_m_s2", lag=1.3e-3)
    _, whole = run_twins(setup(*PREDICTED, model=model), [block])
    _, cut = run_twins(setup(*PREDICTED, model=model), [*recut_blocks([block], samples)])
    assert repr(cut) == repr(whole)


def test_an_error_of_a_canonical_sensor_is_not_that_of_another_on_the_same_body() -> None:
    block = lab_block()
    model = Model(G4).with_effect("sensor_gain", "mass_acc_m_s2", gain=2.0)
    values = block.values.copy()
    values[block.channels.index("mass_acc_m_s2")] *= 2.0
    _, comparisons = run_twins(setup(ACC, model=model), [replace(block, values=values)])
    last = comparisons[-1]
    assert last.window_error_ss[-1] < 1e-4 * last.measured_ss[-1]


def test_a_missing_channel_is_unknown() -> None:
    block = make_measured_block(G4, shaken(seconds=1.0))
    _, comparisons = run_twins(setup(ACC, LASER), [block])
    assert np.isnan([comparison.window_error_ss[-2:] for comparison in comparisons]).all()
