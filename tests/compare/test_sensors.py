"""Sensors between prediction and comparison; twins with hidden states; the cut changes no bit."""

from dataclasses import replace

import numpy as np
import pytest

from tests.builders.blocks import recut_blocks
from tests.compare.test_twins import G4, RATE_HZ, make_measured_block, run_twins, shaken, track
from twin.compare.sensors import delay_signal
from twin.compare.twins import TwinSetup, advance_twins
from twin.laws.library import find_effect
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.transport.codec import encode_item

EVERYTHING = ("bouc_wen", "maxwell_damper", "bumper_hardening", "bumper_maxwell", "gap_drift",
              "table_tilt", "coulomb_friction")  # fmt: skip


def model(*ids: str) -> Model:
    built = Model(G4)
    for name in ids:
        effect = find_effect(name)
        built = built.with_effect(name, "", **{p.name: p.typical for p in effect.parameters})
    return built


def setup(model: Model) -> TwinSetup:
    return TwinSetup(model, RATE_HZ, 500, 20, 10.0)


@pytest.mark.parametrize("samples", [0.0, 0.3, 1.0, 2.0, 2.7, 40.5])
def test_a_cubic_is_delayed_exactly(samples: float) -> None:
    t = np.arange(100.0)
    wave = 1e-4 * t**3 - 0.01 * t**2 + t
    late = delay_signal(wave, samples)
    known = np.isfinite(late)
    at = t - samples
    want = 1e-4 * at**3 - 0.01 * at**2 + at
    assert known.sum() >= 100 - samples - 3
    assert not known[: int(samples)].any()
    np.testing.assert_allclose(late[known], want[known], atol=1e-9)


@pytest.mark.parametrize("samples", [1, 7, 64, 500])
def test_the_cut_changes_no_bit_with_effects_and_sensors(samples: int) -> None:
    full_model = model(*EVERYTHING).with_effect("sensor_lag", "mass_acc_m_s2", lag=1.3e-3)
    full_model = full_model.with_effect("sensor_gain", "mass_disp_m", gain=1.02)
    block = make_measured_block(G4, shaken(seconds=1.2), noise=1.0)
    whole, comparisons = run_twins(setup(full_model), [block])
    cut, others = run_twins(setup(full_model), list(recut_blocks([block], samples)))
    assert cut.is_identical(whole)
    assert [encode_item(c, "r") for c in comparisons] == [encode_item(c, "r") for c in others]


def test_sensors_change_the_reading_and_nothing_else() -> None:
    block = make_measured_block(G4, shaken(seconds=1.0))
    plain = run_twins(setup(Model(G4)), [block])[0]
    bent = Model(G4).with_effect("sensor_gain", "force_r1_n", gain=1.1)
    bent = bent.with_effect("sensor_lag", "mass_acc_m_s2", lag=2 / RATE_HZ)
    got = run_twins(setup(bent), [block])[0]
    a, b = (plain.channel("free/mass_acc_m_s2"), got.channel("free/mass_acc_m_s2"))
    # the lag stays in what a restart sees, and so the free twin starts a little off
    np.testing.assert_allclose(b[600:], a[598:-2], atol=2e-2 * np.nanmax(a))
    np.testing.assert_array_equal(got.channel("free/force_l1_n"), plain.channel("free/force_l1_n"))


def test_an_offset_is_taken_out_of_the_restart_and_put_into_the_reading() -> None:
    """A displacement sensor off by 0.5 mm, and a model that knows: as good as none."""
    block = make_measured_block(G4, shaken(seconds=1.5))
    values = block.values.copy()
    values[block.channels.index("mass_disp_m")] += 5e-4
    off = replace(block, values=values)
    knows = Model(G4).with_effect("sensor_offset", "mass_disp_m", offset=5e-4)
    good = run_twins(setup(Model(G4)), [block])[0]
    got = run_twins(setup(knows), [off])[0]
    names = ("rel_disp_m", "mass_disp_m")
    for name in names:
        shift = got.channel(f"window/{name}") - good.channel(f"window/{name}")
        np.testing.assert_allclose(shift[600:], 5e-4, atol=1e-9)


def test_hidden_states_go_on_over_a_restart() -> None:
    """With the right model the windowed twin stays on the measured motion, memory included."""
    memory_model = model("bouc_wen", "maxwell_damper")
    solver, base = prepare_solver(memory_model, RATE_HZ), shaken(seconds=2.5)
    out, state = np.empty((7, base.size)), solver.rest_state()
    solver.advance(state, base, base, out)
    block = make_measured_block(G4, base)
    rows = block.values.copy()
    for name, row in (("mass_disp_m", out[0] + rows[0]), ("mass_acc_m_s2", out[2]),
                      ("force_r1_n", out[3] / 2), ("force_r2_n", out[3] / 2),
                      ("force_l1_n", -out[4] / 2), ("force_l2_n", -out[4] / 2)):  # fmt: skip
        rows[block.channels.index(name)] = row
    block = replace(block, values=rows)
    predicted, _ = run_twins(setup(memory_model), [block])
    u = track(predicted, "window")[0]
    error = np.abs(u - out[0])
    assert np.abs(out[0]).max() > 4e-3
    assert np.nanmax(error[501:1000]) > 1e-4  # the first window knows of no past
    assert np.nanmax(error[1001:]) < 2e-6


def test_tracks_of_a_model_with_effects_are_values() -> None:
    twin_setup = setup(model("bouc_wen"))
    from twin.compare.twins import start_twins

    block = make_measured_block(G4, shaken(seconds=0.8))
    tracks = start_twins(twin_setup, 0)
    first = advance_twins(twin_setup, tracks, block)[1]
    assert advance_twins(twin_setup, tracks, block)[1].is_identical(first)
