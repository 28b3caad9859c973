"""The twins beside a stream: what a restart recovers, where it happens, and what is summed."""

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from itertools import pairwise

import numpy as np
import pytest

from table_io.block import Block, Float1D, Float2D, join_blocks
from table_io.records import Comparison
from tests.builders.blocks import recut_blocks
from twin.compare import COMPARED_CHANNELS, PREDICTED_CHANNELS
from twin.compare.twins import (
    HISTORY_S,
    TwinSetup,
    TwinStates,
    advance_twins,
    estimate_motion,
    start_twins,
)
from twin.model.closed_form import (
    OUTPUT_NAMES,
    advance_state,
    discretized_params,
    rest_state,
    restart_state,
)
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.solver import StateEstimate
from twin.transport.codec import encode_item

RATE_HZ = 2000.0
H = round(HISTORY_S * RATE_HZ)  # samples that a restart needs
LEVEL = 0.05 * 9.80665
G4 = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
FREE = replace(G4, gap_r=math.inf, gap_l=math.inf)
SLOW = replace(G4, bumper_damping_r=51e3, bumper_damping_l=51e3)  # relaxes in 0.1 s
NOISE = (7e-6, 5e-3 * math.sqrt(2), 5e-3, 1.4, 1.4)  # of u, a - A, A, F_R, F_L: the simulated rig's
CHANNELS = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip


def shaken(hz: float = 2.6, seconds: float = 3.0, ramp_s: float = 0.5) -> Float1D:
    """Table acceleration of a sine that comes up smoothly, m/s2."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    return LEVEL * np.minimum(t / ramp_s, 1.0) ** 2 * np.sin(2 * np.pi * hz * t)


def motion(parameters: Parameters, base_acc: Float1D, state: Float1D | None = None) -> Float2D:
    """The solver's rows (7, sample) from rest, or from `state`, which moves on."""
    out = np.empty((len(OUTPUT_NAMES), base_acc.size))
    state = rest_state(parameters) if state is None else state
    advance_state(state, discretized_params(parameters, RATE_HZ), base_acc, out)
    return out


def make_measured_block(
    parameters: Parameters,
    base_acc: Float1D,
    index: int = 0,
    noise: float = 0.0,
    without: Sequence[str] = (),
) -> Block:
    """A measured block of a rig that is the model, with `noise` times the simulated rig's noise."""
    u, _, a, force_r, force_l, *_ = motion(parameters, base_acc)
    table = 1e-3 * np.sin(np.arange(base_acc.size) / 150.0)
    rows = [table, base_acc, table + u, a, *[force_r / 2] * 2, *[-force_l / 2] * 2]
    rms = np.array([5e-6, 5e-3, 5e-6, 5e-3, 1.0, 1.0, 1.0, 1.0])[:, None]
    values = np.array(rows) + noise * rms * np.random.default_rng(7).standard_normal(
        (len(rows), base_acc.size)
    )
    kept = [place for place, name in enumerate(CHANNELS) if name not in without]
    outside = np.full(base_acc.size, -1)
    names = tuple(CHANNELS[place] for place in kept)
    return Block("meas", index, RATE_HZ, names, values[kept], outside, outside, outside)


def spoilt(block: Block, channel: str, first: int, last: int) -> Block:
    """The block with samples first .. last - 1 of a channel lost."""
    values = block.values.copy()
    values[block.channels.index(channel), first - block.index : last - block.index] = np.nan
    return replace(block, values=values)


def twin(parameters: Parameters = G4, window: int = 500, grid: int = 20) -> TwinSetup:
    return TwinSetup(Model(parameters), RATE_HZ, window, grid, 10.0)


def run_twins(
    setup: TwinSetup, blocks: Sequence[Block], tracks: TwinStates | None = None
) -> tuple[Block, list[Comparison]]:
    """(joined predicted block, all comparisons) of consecutive measured blocks."""
    tracks = start_twins(setup, blocks[0].index) if tracks is None else tracks
    predicted, comparisons = [], []
    for block in blocks:
        tracks, predicted_block, made = advance_twins(setup, tracks, block)
        predicted.append(predicted_block)
        comparisons.extend(made)
    return join_blocks(predicted), comparisons


def track(predicted: Block, name: str) -> Float2D:
    """The channels of one track, (PREDICTED_CHANNELS, sample)."""
    return np.array([predicted.channel(f"{name}/{channel}") for channel in PREDICTED_CHANNELS])


def nrmse(measured: Float1D, predicted: Float1D) -> float:
    known = np.isfinite(predicted)
    error = measured[known] - predicted[known]
    return float(np.sqrt(np.sum(error**2) / np.sum(measured[known] ** 2)))


# What a restart takes from the measurement


def swing(hz: float) -> tuple[Float1D, Float1D, float, float]:
    """(u, u'' over the history, true u and u' at its end) of a swing about an offset."""
    t = (np.arange(H) - (H - 1)) / RATE_HZ
    w = 2 * math.pi * hz
    u = 1e-3 + 5e-3 * np.sin(w * t + 0.7)
    return u, -5e-3 * w**2 * np.sin(w * t + 0.7), float(u[-1]), 5e-3 * w * math.cos(0.7)


@pytest.mark.parametrize("hz", [0.5, 3.4, 10.0])
def test_state_of_a_clean_swing(hz: float) -> None:
    """An acceleration that is linear between samples lacks (w h)^2 / 12 of a sine."""
    u, acc, u0, v0 = swing(hz)
    got = estimate_motion(u, acc, RATE_HZ)
    w = 2 * math.pi * hz
    lacking = (w / RATE_HZ) ** 2 / 12
    assert got[0] == pytest.approx(u0, abs=2 * lacking * 5e-3)
    assert got[1] == pytest.approx(v0, abs=2 * lacking * 5e-3 * w)


def test_state_of_a_thrown_body_is_exact() -> None:
    t = (np.arange(H) - (H - 1)) / RATE_HZ
    u = 0.003 - 0.2 * t + 0.5 * 4.0 * t**2
    got = estimate_motion(u, np.full(H, 4.0), RATE_HZ)
    np.testing.assert_allclose(got, (0.003, -0.2), rtol=1e-12)


def test_noise_of_the_laser_costs_what_least_squares_theory_says() -> None:
    """var u0 = 2 (2n - 1) / (n (n + 1)) s^2,  var u0' = 12 / (n (n^2 - 1)) s^2 / h^2."""
    rng, sigma = np.random.default_rng(3), 7e-6
    u, acc, u0, v0 = swing(3.4)
    got = np.array(
        [estimate_motion(u + sigma * rng.standard_normal(H), acc, RATE_HZ) for _ in range(1500)]
    )
    want = (
        sigma * math.sqrt(2 * (2 * H - 1) / (H * (H + 1))),
        sigma * RATE_HZ * math.sqrt(12 / (H * (H**2 - 1))),
    )
    np.testing.assert_allclose(got.std(axis=0), want, rtol=0.08)
    np.testing.assert_allclose(got.mean(axis=0), (u0, v0), atol=4 * max(want) / math.sqrt(1500))
    # a difference of two samples would be 600 times worse
    assert want[1] < sigma * RATE_HZ / 500


def test_noise_of_the_accelerometer_is_integrated_not_amplified() -> None:
    """The estimate is linear, so its spread follows exactly from its answer to unit samples."""
    rng, sigma = np.random.default_rng(4), NOISE[1]
    still = np.zeros(H)
    answers = np.array([estimate_motion(still, eye, RATE_HZ) for eye in np.eye(H)])
    want = sigma * np.sqrt((answers**2).sum(axis=0))
    got = np.array(
        [estimate_motion(still, sigma * rng.standard_normal(H), RATE_HZ) for _ in range(1500)]
    )
    np.testing.assert_allclose(got.std(axis=0), want, rtol=0.08)
    assert want[0] < 2e-6
    assert want[1] < 1e-4


def test_state_across_impacts() -> None:
    """At an onset the force jumps within a sample: u' is off by h C_j u' / 2M at most."""
    base_acc = shaken()
    u, v, a, force_r, force_l, *_ = motion(G4, base_acc)
    ends = np.arange(3000, u.size, 7)
    got = np.array(
        [
            estimate_motion(u[end - H : end], (a - base_acc)[end - H : end], RATE_HZ)
            for end in ends.tolist()
        ]
    )
    touched = (force_r[3000:] > 0).any() and (force_l[3000:] < 0).any()
    assert touched, "the sweep must reach both bumpers"
    jump = G4.bumper_damping_r * abs(v).max() / G4.mass / RATE_HZ / 2
    assert abs(got[:, 0] - u[ends - 1]).max() < jump * HISTORY_S / 2
    assert abs(got[:, 1] - v[ends - 1]).max() < 1.5 * jump


# Where the window track restarts


def reference(setup: TwinSetup, block: Block) -> tuple[Float2D, Float2D]:
    """(free, window) u, v, a in flight, (3, sample) each, spelt out one restart at a time."""
    p = setup.parameters
    u = block.channel("mass_disp_m") - block.channel("table_disp_m")
    base = block.channel("table_acc_m_s2")
    acc = block.channel("mass_acc_m_s2") - base
    free, window = (np.full((3, len(block)), np.nan) for _ in range(2))
    first = True
    for at in range(-block.index % setup.window_samples, len(block), setup.window_samples):
        if at < setup.history_samples - 1:
            continue
        past = slice(at + 1 - H, at + 1)
        u0, v0 = estimate_motion(u[past], acc[past], RATE_HZ)
        state = restart_state(StateEstimate(at, u0, v0), base[at], p)
        if first:
            free[:, at + 1 :] = motion(p, base[at + 1 :].copy(), state.copy())[:3]
            first = False
        end = at + 1 + setup.window_samples
        window[:, at + 1 : end] = motion(p, base[at + 1 : end].copy(), state)[:3]
    return free, window


@pytest.mark.parametrize("index", [0, 137, 500, 3 * 500 - 5])
@pytest.mark.parametrize("samples", [1, 7, 64, 500, 10_000])
def test_restarts_are_at_multiples_of_the_window_and_nowhere_else(index: int, samples: int) -> None:
    """With a wrong model, so that a restart elsewhere would show."""
    setup = twin(replace(FREE, stiffness=33e3))
    block = make_measured_block(FREE, shaken(seconds=1.5), index=index, noise=1.0)
    predicted, _ = run_twins(setup, list(recut_blocks([block], samples)))
    for name, want in zip(("free", "window"), reference(setup, block), strict=True):
        np.testing.assert_array_equal(track(predicted, name)[[0, 1, 3]], want)


def test_predictions_are_causal() -> None:
    block = make_measured_block(G4, shaken(), noise=1.0)
    other = replace(block, values=np.where(np.arange(len(block)) < 4000, block.values, 1.0))
    a, _ = run_twins(twin(), [block])
    b, _ = run_twins(twin(), [other])
    assert a.cut(0, 4000).is_identical(b.cut(0, 4000))
    assert not a.is_identical(b)


def test_a_wrong_model_errs_boundedly_in_windows_and_more_when_free() -> None:
    """10 % off in stiffness, in flight near resonance: the free twin keeps its own amplitude."""
    block = make_measured_block(FREE, shaken(hz=1.25, seconds=8.0), noise=1.0)
    u = block.channel("mass_disp_m") - block.channel("table_disp_m")
    predicted, _ = run_twins(twin(replace(FREE, stiffness=1.1 * 36e3), window=200), [block])
    error = abs(predicted.channel("window/rel_disp_m") - u)[1000:]
    # within a window only the wrong part of the spring force acts: dK u_max / M * t^2 / 2
    bound = 3600 * abs(u).max() / 550 * 0.1**2 / 2
    assert bound / 2 < error.max() < bound + 1e-4
    assert abs(predicted.channel("free/rel_disp_m") - u)[-4000:].max() > 10 * bound


def test_a_right_model_stays_with_the_measurement() -> None:
    block = make_measured_block(G4, shaken(), noise=1.0)
    predicted, _ = run_twins(twin(), [block])
    u = block.channel("mass_disp_m") - block.channel("table_disp_m")
    for name in ("free", "window"):
        assert nrmse(u, predicted.channel(f"{name}/rel_disp_m")) < 0.01
        for cell in ("force_r1_n", "force_l2_n"):
            assert nrmse(block.channel(cell), predicted.channel(f"{name}/{cell}")) < 0.02


def test_mass_displacement_is_that_of_the_measured_table_and_the_predicted_u() -> None:
    block = make_measured_block(G4, shaken(seconds=1.0))
    predicted, _ = run_twins(twin(), [block])
    np.testing.assert_array_equal(
        predicted.channel("window/mass_disp_m"),
        block.channel("table_disp_m") + predicted.channel("window/rel_disp_m"),
    )


# The bumpers at a restart


def restarted_errors(
    model: Parameters, truth: Parameters, window: int, without: Sequence[str] = ()
) -> tuple[float, float]:
    """Window NRMSE of F_R and F_L of a clean measurement with restarts every `window` samples."""
    base_acc = shaken()
    _, _, _, force_r, force_l, *_ = motion(truth, base_acc)
    block = make_measured_block(truth, base_acc, without=without)
    predicted, _ = run_twins(twin(model, window), [block])
    return (
        nrmse(force_r, 2 * predicted.channel("window/force_r1_n")),
        nrmse(-force_l, 2 * predicted.channel("window/force_l1_n")),
    )


@pytest.mark.parametrize("without", [(), CHANNELS[4:], CHANNELS[4:6]])
def test_restart_in_contact(without: Sequence[str]) -> None:
    """Restarts every 5 ms fall into every part of a contact; load cells are not needed for it."""
    assert max(restarted_errors(G4, G4, 10, without)) < 0.01


@pytest.mark.parametrize("without", [(), CHANNELS[4:]])
def test_restart_remembers_a_bumper_that_still_relaxes(without: Sequence[str]) -> None:
    """A bumper that needs 0.1 s to come back is met late; one taken as relaxed is met early.

    Without load cells the displacement alone tells what is left of a contact.
    """
    assert max(restarted_errors(SLOW, SLOW, 100, without)) < 0.02
    base_acc = shaken()
    *_, u_r, u_l = motion(SLOW, base_acc)
    forces = motion(SLOW, base_acc)[3:5]
    flight = (forces[0] == 0) & (forces[1] == 0)
    assert (u_r[flight] - u_l[flight]).max() > 2e-4, "the case must have bumpers that relax"


def test_memory_of_a_slow_bumper_needs_its_history() -> None:
    """History is eight relaxation times: 0.8 s here, so no restart comes before that."""
    setup = twin(SLOW, window=100)
    assert setup.history_samples == 1600
    predicted, _ = run_twins(setup, [make_measured_block(SLOW, shaken())])
    known = np.flatnonzero(np.isfinite(predicted.channel("window/rel_disp_m")))
    assert known[0] == 1601


def test_negative_gap_at_rest_stays_in_both_contacts() -> None:
    """Precompressed by 1 mm a side: 510 N each, and no motion after a restart."""
    pressed = replace(G4, gap_r=-0.001, gap_l=-0.001)
    predicted, _ = run_twins(twin(pressed), [make_measured_block(pressed, np.zeros(2000))])
    window = track(predicted, "window")[:, 501:]
    np.testing.assert_allclose(window[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(2 * window[4:].reshape(4, -1)[[0, 2]], 510.0, rtol=1e-9)


def test_negative_gap_in_motion() -> None:
    pressed = replace(G4, gap_r=-0.001, gap_l=-0.001)
    assert max(restarted_errors(pressed, pressed, 10)) < 0.01


# What is lost


def test_without_an_accelerometer_nothing_is_predicted() -> None:
    block = make_measured_block(G4, shaken(seconds=1.0), without=("mass_acc_m_s2",))
    predicted, comparisons = run_twins(twin(), [block])
    assert np.isnan(predicted.values).all()
    assert len(comparisons) == 100
    place = COMPARED_CHANNELS.index("rel_disp_m")
    for comparison in comparisons:
        assert np.isfinite(comparison.measured_ss[place])
        assert np.isnan([*comparison.free_error_ss, *comparison.window_error_ss]).all()


@pytest.mark.parametrize("samples", [1, 64, 10_000])
@pytest.mark.parametrize("window", [100, 500])
def test_lost_table_acceleration_silences_both_twins_until_a_whole_history(
    window: int, samples: int
) -> None:
    block = spoilt(make_measured_block(G4, shaken(), noise=1.0), "table_acc_m_s2", 3120, 3131)
    predicted, _ = run_twins(twin(window=window), list(recut_blocks([block], samples)))
    again = -(-(3130 + H) // window) * window  # the first restart index with H clean samples
    for name in ("free", "window"):
        silent = np.isnan(predicted.channel(f"{name}/rel_disp_m"))
        assert not silent[window * -(-(H - 1) // window) + 1 : 3120].any()
        assert silent[3120 : again + 1].all()
        assert not silent[again + 1 :].any()


@pytest.mark.parametrize("channel", ["mass_disp_m", "mass_acc_m_s2"])
def test_lost_motion_silences_only_the_windows_that_would_start_from_it(channel: str) -> None:
    block = spoilt(make_measured_block(G4, shaken(), noise=1.0), channel, 3490, 3495)
    predicted, _ = run_twins(twin(), [block])
    silent = np.isnan(predicted.channel("window/rel_disp_m"))
    assert np.flatnonzero(silent[501:]).tolist() == list(range(3000, 3500))
    assert not np.isnan(predicted.channel("free/rel_disp_m")[501:]).any()


def test_lost_load_cell_samples_do_not_stop_a_restart() -> None:
    block = make_measured_block(G4, shaken(), noise=1.0)
    for cell in CHANNELS[4:]:
        block = spoilt(block, cell, 2900, 3600)
    predicted, _ = run_twins(twin(), [block])
    assert np.isfinite(predicted.values[:, 501:]).all()
    u = block.channel("mass_disp_m") - block.channel("table_disp_m")
    assert nrmse(u, predicted.channel("window/rel_disp_m")) < 0.01


def test_missing_samples_are_a_fresh_start() -> None:
    setup, block = twin(), make_measured_block(G4, shaken(), noise=1.0)
    tracks, _, _ = advance_twins(setup, start_twins(setup, 0), block.cut(0, 2713))
    after = block.cut(2750, len(block))
    predicted, comparisons = run_twins(setup, [after], tracks)
    fresh, again = run_twins(setup, [after])
    assert predicted.is_identical(fresh)
    assert [encode_item(comparison, "") for comparison in comparisons] == [
        encode_item(comparison, "") for comparison in again
    ]
    assert np.flatnonzero(np.isfinite(predicted.channel("free/rel_disp_m")))[0] == 3000 + 1 - 2750


def test_a_twin_from_rest_never_restarts() -> None:
    """The model alone: no measurement is read, the free twin runs from rest at once."""
    setup = replace(twin(), from_rest=True)
    block = make_measured_block(G4, shaken(seconds=1.0), without=CHANNELS[2:])
    predicted, _ = run_twins(setup, [block])
    want = motion(G4, block.channel("table_acc_m_s2").copy())
    np.testing.assert_array_equal(predicted.channel("free/rel_disp_m"), want[0])
    assert np.isnan(track(predicted, "window")).all()


# Comparisons


def direct(block: Block, predicted: Block, name: str) -> tuple[Float1D, Float1D, Float1D]:
    """Squares per sample of a channel: measured, free error, window error."""
    if name == "rel_disp_m":
        x = block.channel("mass_disp_m") - block.channel("table_disp_m")
    else:
        x = block.channel(name)
    free, window = (x - predicted.channel(f"{kind}/{name}") for kind in ("free", "window"))
    return x**2, free**2, window**2


@pytest.mark.parametrize("samples", [1, 7, 64, 10_000])
@pytest.mark.parametrize("index", [0, 1013])
def test_one_comparison_per_grid_cell_with_the_sums_of_its_samples(
    index: int, samples: int
) -> None:
    block = make_measured_block(G4, shaken(seconds=1.0), index=index, noise=1.0)
    predicted, comparisons = run_twins(twin(), list(recut_blocks([block], samples)))
    edges = [index, *range(20 * (index // 20 + 1), block.end + 1, 20)]
    assert [
        (comparison.index, comparison.index + comparison.count) for comparison in comparisons
    ] == [*pairwise(edges)]
    for name in COMPARED_CHANNELS:
        sums = direct(block, predicted, name)
        place = COMPARED_CHANNELS.index(name)
        for comparison in comparisons:
            cell = slice(comparison.index - index, comparison.index - index + comparison.count)
            got = (
                comparison.measured_ss[place],
                comparison.free_error_ss[place],
                comparison.window_error_ss[place],
            )
            np.testing.assert_allclose(got, [row[cell].sum() for row in sums], rtol=1e-12)
    assert np.isfinite(comparisons[-1].window_error_ss).all()


def test_a_comparison_of_a_missing_channel_is_nan_and_leaves_the_others() -> None:
    block = make_measured_block(G4, shaken(seconds=1.0), without=("force_l1_n",))
    _, comparisons = run_twins(twin(), [block])
    place = COMPARED_CHANNELS.index("force_l1_n")
    last = asdict(comparisons[-1])
    for sums in ("measured_ss", "free_error_ss", "window_error_ss"):
        unknown = np.isnan(last[sums])
        assert unknown[place]
        assert unknown.sum() == 1


def test_a_comparison_holds_no_wall_clock() -> None:
    """Two runs over the same samples say the same bytes."""
    block = make_measured_block(G4, shaken(seconds=0.6), noise=1.0)
    a, b = (run_twins(twin(), [block])[1] for _ in range(2))
    assert [encode_item(item, "run") for item in a] == [encode_item(item, "run") for item in b]
    assert len(a) == 60
