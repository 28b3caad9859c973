"""The watch on real sessions of the simulated table: silent where the model is right, clear where
something was planted; and each of its parts alone where a session would not show it."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from table_io.block import Block, Float1D, join_blocks
from table_io.config.base import PROFILES_DIR, format_toml
from table_io.records import (
    Agreement,
    Estimate,
    Event,
    JumpForecast,
    NormalizedResponse,
    PrcPoint,
    Record,
    Step,
)
from tests.builders.laboratories import Level, draw_laboratory
from tests.builders.profiles import AT_1_KHZ, NO_LOOP_CHECK, format_test
from tests.builders.rigs import RIG_TEXT, read_model_text
from tests.builders.truths import hide_truth
from twin.compare import COMPARED_CHANNELS, pipeline
from twin.compare.monitoring import EVENT_KINDS, jumps
from twin.compare.monitoring.attractor_change import AttractorState, detect_attractor_change
from twin.compare.monitoring.cycle import ChannelNoise, CycleData, weight_functions, weighted_sums
from twin.compare.monitoring.jumps import (
    ExpectedJump,
    JumpTracking,
    measure_separation,
    predict_jumps,
    track_jumps,
)
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import settle_to_orbit
from twin.model.ideal_response import simulate_sweep
from twin.setup.run_config import RunConfig, from_texts
from twin.setup.unpaced import iter_simulated_session
from twin.transport.codec import encode_item

# Slow enough for many cycles of contact, short enough for a test; no loop check, no tuning.
SWEEP = partial(format_test, 2.4, 4.4, tables=AT_1_KHZ | NO_LOOP_CHECK, cycles=8, measured_cycles=4)
EFFECT = '[[effects]]\nid = "{}"\n{}\nparameters = {{ {} }}\n'
STIFFNESS, GAP = 36e3, 2e-3
STEP_HZ = 0.1  # of the sweeps of points


@cache
def session(truth: str = "", gap: float = 4.0) -> tuple[RunConfig, Block]:
    """(the bundle that a person knows of, every measured sample of the rig with that truth)."""
    with TemporaryDirectory() as folder:
        rig = hide_truth(RIG_TEXT, Path(folder), truth)
        bundle = from_texts("x", SWEEP(0.5, float(gap)), rig, read_model_text("snm"), "x")
        items = iter_simulated_session(bundle, "r")
        return bundle, join_blocks([item for item in items if isinstance(item, Block)])


@cache
def monitor_session(truth: str = "", gap: float = 4.0) -> tuple[Record, ...]:
    """What the twin says about such a session."""
    return run_twin(*session(truth, gap))


def run_twin(bundle: RunConfig, measured: Block) -> tuple[Record, ...]:
    """Everything that the twin of a configuration says about samples, but its predictions."""
    setup = bundle.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, items = pipeline.step(setup, state, measured)
    return tuple(item for item in items if not isinstance(item, Block))


def change_channels(measured: Block, names: Sequence[str], samples: slice, value: float) -> Block:
    """Return the samples with another value in some of some channels."""
    values = measured.values.copy()
    for name in names:
        if name in measured.channels:
            values[measured.channels.index(name), samples] = value
    return replace(measured, values=values)


def warnings(items: Sequence[Record], *but: str) -> list[Event]:
    return [item for item in items if isinstance(item, Event) and item.kind not in but]


def estimates(items: Sequence[Record], name: str) -> list[tuple[float, float, float, float]]:
    """(value, sd, drift, sd of the drift) of a parameter, each time it was told."""
    return [
        tuple(getattr(item, field)[item.names.index(name)] for field in
              ("values", "sd", "drift", "drift_sd"))
        for item in items if isinstance(item, Estimate) and name in item.names
    ]  # fmt: skip


@pytest.mark.parametrize("gap", [4.0, math.inf, -2.0])
def test_with_the_right_model_there_is_nothing_to_say_but_the_jumps_it_expects(gap: float) -> None:
    items = monitor_session("", gap)
    assert {event.kind for event in warnings(items)} <= {"jump"}
    agreed = [item for item in items if isinstance(item, Agreement)]
    assert len(agreed) == 2 * 5 * 8, "one for every held cycle"
    shares = np.array([agreement.error for agreement in agreed]) / np.array(
        [agreement.band for agreement in agreed]
    )
    assert np.nanmax(shares) < 0.8


@pytest.mark.parametrize("gap", [4.0, math.inf])
def test_the_specimen_is_identified_within_its_spread(gap: float) -> None:
    truths = {"stiffness": STIFFNESS, "damping": 1100.0}
    if math.isfinite(gap):
        truths |= {"bumper_stiffness_r": 510e3, "bumper_stiffness_l": 510e3}
        truths |= {"gap_r": GAP, "gap_l": GAP}
    for name, truth in truths.items():
        value, sd, *_ = estimates(monitor_session("", gap), name)[-1]
        assert 0 < sd < 0.02 * truth
        assert abs(value - truth) < 5 * sd, name
    if math.isinf(gap):
        assert not estimates(monitor_session("", gap), "gap_r")


@pytest.mark.parametrize("rate", [1.5e-3, pytest.param(-1.5e-3, marks=pytest.mark.slow)])
def test_a_stiffness_that_drifts_is_seen_and_measured(rate: float) -> None:
    truth = EFFECT.format("stiffness_drift", "", f"rate = {rate}")
    items = monitor_session(truth)
    drifts = [warning for warning in warnings(items) if warning.kind == "drift"]
    assert [drift.text.split()[0] for drift in drifts] == ["stiffness"]
    _, measured = session(truth)
    held = np.flatnonzero(measured.cycle >= 0) / measured.rate_hz
    value, _, drift, sd = estimates(items, "stiffness")[-1]
    true = STIFFNESS * rate * float(np.ptp(held))
    assert abs(drift - true) < 0.15 * abs(true)
    assert abs(drift) > 4 * sd
    assert abs(value - STIFFNESS * (1 + rate * held[-1])) < 0.03 * STIFFNESS


def test_gaps_that_open_are_seen_on_both_sides_and_the_stiffness_is_left_alone() -> None:
    items = monitor_session(EFFECT.format("gap_drift", "", "rate = 3e-6"))
    drifting = {warning.text.split()[0] for warning in warnings(items) if warning.kind == "drift"}
    assert drifting == {"gap_r", "gap_l"}
    drift = estimates(items, "gap_r")[-1][2]
    assert 0.5 * 3e-6 * 20 < drift < 3e-6 * 60


@pytest.mark.parametrize(
    "channel, gain, named, number",
    [
        pytest.param(
            "mass_acc_m_s2", 1.1, "mass_acc_m_s2 and mass_disp_m", 1.1, marks=pytest.mark.slow
        ),
        pytest.param(
            "mass_disp_m", 0.9, "mass_acc_m_s2 and mass_disp_m", 1 / 0.9, marks=pytest.mark.slow
        ),
        ("table_acc_m_s2", 1.1, "table_acc_m_s2 and table_disp_m", 1.1),
        ("force_l1_n", 0.5, "force_l1_n and force_l2_n", 33),
    ],
)
def test_sensors_that_contradict_each_other_are_named(
    channel: str, gain: float, named: str, number: float
) -> None:
    items = monitor_session(
        EFFECT.format("sensor_gain", f'channel = "{channel}"', f"gain = {gain}")
    )
    (event,) = (warning for warning in warnings(items) if warning.kind == "instrument")
    assert named in event.text
    numbers = [float(number) for number in re.findall(r"\b\d+\.?\d*\b", event.text)]
    assert any(abs(value - number) < 0.02 * number for value in numbers), event.text


def test_a_model_that_is_wrong_disagrees_where_it_is_wrong() -> None:
    items = monitor_session("[base]\nbumper_stiffness_n_m = 700e3\n")
    disagreements = [warning for warning in warnings(items) if warning.kind == "disagreement"]
    assert disagreements
    assert "force" in disagreements[0].text
    assert "in contact" in disagreements[0].text
    assert "Hz forward" in disagreements[0].text
    assert len(disagreements) < 10, "said once, and again only after they have agreed"


def test_warnings_are_of_the_kinds_that_a_replay_says_anew() -> None:
    truths = (
        "[base]\nbumper_stiffness_n_m = 700e3\n",
        "",
        EFFECT.format("gap_drift", "", "rate = 3e-6"),
    )
    assert {
        warning.kind for truth in truths for warning in warnings(monitor_session(truth))
    } <= set(EVENT_KINDS)


# Jumps


def make_bundle(sweep_keys: str, model: str = "", step_hz: float = 0.1) -> RunConfig:
    """The test at 4 mm with further keys of its sweep, and effects appended to the model."""
    rig, snm = (PROFILES_DIR / name for name in ("rigs/simulated.toml", "models/snm.toml"))
    text = SWEEP(0.5).replace("step_hz = 0.5", f"step_hz = {step_hz}\n{sweep_keys}")
    return from_texts("x", text, rig.read_text(), f"{snm.read_text()}\n{model}", "x")


def list_places(bundle: RunConfig, offset: int = 0) -> list[tuple[int, float, str]]:
    expected = predict_jumps(bundle.profile, bundle.model, bundle.steps)
    return [(jump.after.index + offset, jump.at_hz, jump.kind) for jump in expected]


def test_jumps_at_constant_break_points_are_those_without_them() -> None:
    assert list_places(make_bundle("level_points = [[2.4, 0.05], [4.4, 0.05]]")) == list_places(
        make_bundle("")
    )


def test_the_jumps_of_a_schedule_are_those_of_its_levels() -> None:
    constant, half = make_bundle(""), list_places(make_bundle("acceleration_g = 0.04"))
    scheduled = list_places(make_bundle(f"schedule_db = [{20 * math.log10(0.8)}, 0.0]"))
    assert len(half) == 2
    assert [(index, kind) for index, _, kind in scheduled[:2]] == [
        (index, kind) for index, _, kind in half
    ]
    assert [kind for *_, kind in scheduled[2:]] == [kind for *_, kind in list_places(constant)]


def test_the_twin_jumps_past_the_folds_of_the_branches() -> None:
    """By continuation of the stable motions; slow passage leaves a branch behind its fold.

    Or just before, where the motion grazes.
    """
    bundle = make_bundle("")
    expected = predict_jumps(bundle.profile, bundle.model, bundle.steps)
    assert [(jump.after.direction, jump.kind) for jump in expected] == [
        ("forward", "down"), ("backward", "up"),
    ]  # fmt: skip
    level = bundle.steps[0].acceleration_m_s2
    for jump, from_hz, direction in ((expected[0], 3.0, 1), (expected[1], 4.4, -1)):
        start = settle_to_orbit(make_period_map(bundle.model, from_hz, level))
        assert start is not None
        fold = continue_branch(start, "frequency", (2.4, 4.4), direction).folds[0].value
        assert -0.1 <= direction * (jump.after.frequency_hz - fold) <= 0.3


def point(index: int, eta: float, twin_eta: float, direction: str = "forward") -> PrcPoint:
    n = math.nan
    own, twin = (
        NormalizedResponse(value, n, n, n, n, n, (), (), 0.0, 0.0) for value in (eta, twin_eta)
    )
    return PrcPoint(1000 * index, index, direction, 3.0 + STEP_HZ * index, own, twin, n, n, n)


def track_sweep(
    etas: Sequence[float], twin_etas: Sequence[float], expected: tuple[ExpectedJump, ...] = ()
) -> list[Record]:
    """Records of a forward sweep of specimen and twin."""
    steps = [Step(i, "forward", 3.0 + STEP_HZ * i, 0.5) for i in range(len(etas))]
    jumps_of_twin = tuple(
        ExpectedJump(*pair, "down")
        for pair, (eta, next_eta) in zip(pairwise(steps), pairwise(twin_etas), strict=True)
        if next_eta < 0.5 * eta
    )
    tracking, items = JumpTracking(expected or jumps_of_twin), list[Record]()
    for place, (eta, twin_eta) in enumerate(zip(etas, twin_etas, strict=True)):
        sweep_point = point(place, eta, twin_eta)
        is_apart = measure_separation(sweep_point, ChannelNoise(), 1.0) > 1
        tracking, new_items = track_jumps(tracking, sweep_point, is_apart)
        items.extend(new_items)
    return items


@pytest.mark.parametrize(
    ("etas", "twin_etas", "kinds"),
    [
        ([5, 5, 1, 1, 1], [5, 5, 1, 1, 1], ["jump"]),
        ([5, 5, 1, 1, 1], [5, 5, 5, 5, 5], ["unexpected jump"]),
        ([5, 5, 5, 5, 5], [5, 5, 1, 1, 1], ["no jump"]),
        ([5, 5, 1, 1, 1], [5, 5, 5, 1, 1], ["unexpected jump"]),
        ([5, 5, 4, 4, 3], [5, 5, 4, 4, 3], []),
        ([5, 5, 9, 9, 9], [5, 5, 9, 9, 9], []),  # a flank, of which the model expects no jump
        ([5, 5, 4, 4, 3], [5, 5, 5, 5, 5], []),  # another amplitude, but no jump
    ],
)
def test_a_jump_comes_with_that_of_the_twin_or_is_a_warning(
    etas: list[float], twin_etas: list[float], kinds: list[str]
) -> None:
    assert [event.kind for event in warnings(track_sweep(etas, twin_etas))] == kinds


@pytest.mark.parametrize(
    ("noise_m", "impacts", "is_apart"), [(0.0, 0, True), (4e-5, 0, False), (0.0, 1, False)]
)
def test_noise_and_gap_errors_belong_to_the_tolerance_of_a_branch(
    noise_m: float, impacts: int, is_apart: bool
) -> None:
    """Of two amplitudes of 0.30 and 0.36 mm."""
    sweep_point = point(0, 0.010, 0.012)
    assert sweep_point.measured is not None
    measured = replace(sweep_point.measured, impacts_right=(impacts,))
    noise = ChannelNoise(("rel_disp_m",), np.array([noise_m]))
    share = measure_separation(replace(sweep_point, measured=measured), noise, 0.03)
    assert (share > 1) == is_apart


@pytest.mark.parametrize(("twin_step", "is_reported"), [(2, False), (3, False), (5, True)])
def test_a_jump_one_step_of_a_fine_grid_early_is_that_of_the_twin(
    twin_step: int, is_reported: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "STEP_HZ", 0.02)
    twin_etas = [5.0 if place < twin_step else 1.0 for place in range(6)]
    events = warnings(track_sweep([5, 5, 1, 1, 1, 1], twin_etas))
    assert any(event.kind == "unexpected jump" for event in events) == is_reported


@pytest.mark.parametrize(
    "model",
    [
        '[[effects]]\nid = "coulomb_friction"\nparameters = { fc = 300.0 }\n',  # sticks: no motion
        '[[effects]]\nid = "cubic_stiffness"\nparameters = { k3 = 1e8 }\n',
    ],
)
def test_the_cycles_of_a_forecast_are_bounded_however_long_the_test(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bundle = make_bundle("", model, step_hz=0.01)
    cycles = []

    def simulate(*given: Any) -> Any:
        cycles.append(len(given[1]) * given[3])
        return simulate_sweep(*given)

    monkeypatch.setattr(jumps, "simulate_sweep", simulate)
    predict_jumps(bundle.profile, bundle.model, bundle.steps)
    assert len(bundle.steps) * 12 > jumps.MAX_FORECAST_CYCLES
    assert cycles[0] <= jumps.MAX_FORECAST_CYCLES


def test_the_next_jump_is_ahead_until_it_is_passed() -> None:
    steps = [Step(i, "forward", 3.0 + STEP_HZ * i, 0.5) for i in range(5)]
    items = track_sweep([5] * 5, [5] * 5, (ExpectedJump(steps[2], steps[3], "down"),))
    ahead = [item for item in items if isinstance(item, JumpForecast)]
    assert [forecast.kind for forecast in ahead] == ["down", "down", "down", "", ""]
    assert ahead[0].jump_hz == pytest.approx(3.25)
    assert (ahead[0].low_hz, ahead[0].high_hz) == (pytest.approx(3.2), pytest.approx(3.3))
    assert math.isnan(ahead[-1].jump_hz)


# A motion that becomes another one


def cycles(amplitudes: Sequence[float]) -> list[Record]:
    """What is said about cycles of these amplitudes at one step."""
    was, items = AttractorState(), list[Record]()
    step = Step(3, "forward", 2.5, 0.5)
    for number, amplitude in enumerate(amplitudes):
        u = amplitude * np.sin(2 * np.pi * np.arange(400) / 400)
        labels = (np.full(400, 3), np.full(400, 2), np.full(400, number))
        block = Block("meas", 400 * number, 1000.0, ("rel_disp_m",), u[None], *labels)
        was, new_items = detect_attractor_change(was, CycleData(step, number, block, block, block))
        items.extend(new_items)
    return items


@pytest.mark.parametrize(
    "amplitudes, count",
    [
        ([1.0] * 8, 0),
        ([0.2, 0.5, 0.8, 0.9, 0.97, 1.0, 1.0, 1.0, 1.0], 0),  # a transient
        ([1.0] * 5 + [2.0] + [1.0] * 3, 0),  # a stumble
        ([1.0] * 5 + [1.6, 2.4, 2.5, 2.5, 2.5, 2.5], 1),
        ([1.0] * 5 + [0.3] * 6 + [1.0] * 3, 2),
        ([1.0, 2.0] * 6, 0),  # was never steady
    ],
)
def test_a_change_of_attractor_is_said_once(amplitudes: list[float], count: int) -> None:
    events = warnings(cycles([1e-3 * amplitude for amplitude in amplitudes]))
    assert [event.kind for event in events] == ["attractor"] * count


def test_visits_to_one_frequency_are_one_motion() -> None:
    """A dwell comes back with a step of its own each time, of few cycles."""
    was, items = AttractorState(), list[Record]()
    for number, amplitude in enumerate([1e-3] * 6 + [3e-3] * 6):
        step = Step(number // 3, "forward", 2.5, 0.5)
        u = amplitude * np.sin(2 * np.pi * np.arange(400) / 400)
        labels = (np.full(400, step.index), np.full(400, 2), np.full(400, number % 3))
        block = Block("meas", 400 * number, 1000.0, ("rel_disp_m",), u[None], *labels)
        was, new_items = detect_attractor_change(was, CycleData(step, number, block, block, block))
        items.extend(new_items)
    (event,) = items
    assert isinstance(event, Event)
    assert event.kind == "attractor"


# Where it begins late, without rest, with a model that has more


def test_a_twin_that_begins_in_motion_says_nothing_wrong_and_the_same_however_cut() -> None:
    """It knows no noise; the run's last rest comes after its last cycle and must not reach back."""
    bundle, measured = session()
    setup, begins = bundle.prepare_twin(), int(0.5 * len(measured))
    encoded = []
    for samples in (len(measured), 1000, 20):
        state, _ = pipeline.start_pipeline(setup, begins)
        items: list[Record] = []
        for first in range(begins, measured.end, samples):
            cut = measured.cut(first, min(first + samples, measured.end))
            state, made = pipeline.step(setup, state, cut)
            items += [item for item in made if not isinstance(item, Block)]
        encoded.append(sorted(encode_item(item, "") for item in items))
        assert {warning.kind for warning in warnings(items)} <= {"jump"}
    assert encoded[0] == encoded[1] == encoded[2]


@pytest.mark.parametrize(
    "truth, expected",
    [
        ("cubic_stiffness k3=1e8; sensor_offset.mass_disp_m offset=1e-3", {"gap_r": GAP}),
        pytest.param(
            "cubic_stiffness k3=1e8; sensor_gain.mass_disp_m gain=1.1", {"stiffness": STIFFNESS},
            marks=pytest.mark.slow,
        ),
        ("cubic_stiffness k3=1e8; sensor_gain.force_r1_n gain=0.8",
         {"bumper_stiffness_r": 510e3}),
        ("gap_drift rate=3e-6", {"gap_r": GAP, "gap_l": GAP}),
    ],
)  # fmt: skip
def test_what_the_model_has_is_not_found_again(truth: str, expected: dict[str, float]) -> None:
    """Plant and model have the same effects and sensors: what is identified is the base."""
    text = "".join(
        EFFECT.format(
            name.partition(".")[0],
            f'channel = "{name.partition(".")[2]}"' if "." in name else "",
            number.replace("=", " = "),
        )
        for name, number in (line.split() for line in truth.split("; "))
    )
    bundle, measured = session(text)
    effect_tables = re.sub(
        r'channel = ("\w+")\nparameters = \{', r"parameters = { channel = \1,", text
    )
    card = read_model_text("snm") + "\n" + effect_tables
    items = run_twin(from_texts("x", bundle.profile_toml, bundle.rig_toml, card, "x"), measured)
    for name, value in expected.items():
        estimate, sd, *_ = estimates(items, name)[-1]
        assert abs(estimate - value) < 0.02 * value + 5 * sd, (name, estimate)
    assert "drift" not in {warning.kind for warning in warnings(items)}


def test_a_bumper_where_none_should_be_is_no_crash() -> None:
    """The wrong set: the profile's gap is never reached, and the cells feel contact."""
    _, measured = session()
    bundle, _ = session("", 30.0)
    assert "disagreement" in {event.kind for event in warnings(run_twin(bundle, measured))}


def test_cells_that_read_nothing_in_contact_are_beyond_their_band() -> None:
    bundle, measured = session()
    dead = change_channels(measured, ("force_r1_n", "force_r2_n"), slice(None), 0.0)
    disagreements = [
        event for event in warnings(run_twin(bundle, dead)) if event.kind == "disagreement"
    ]
    assert disagreements
    assert "force_r" in disagreements[0].text


def test_a_lost_sample_now_and_then_hides_no_disagreement_and_repeats_none() -> None:
    truth = "[base]\nbumper_stiffness_n_m = 700e3\n"
    bundle, measured = session(truth)
    whole = [
        warning for warning in warnings(monitor_session(truth)) if warning.kind == "disagreement"
    ]
    holed = change_channels(measured, ("mass_disp_m",), slice(None, None, 1000), math.nan)
    disagreements = [
        event for event in warnings(run_twin(bundle, holed)) if event.kind == "disagreement"
    ]
    assert 1 <= len(disagreements) <= len(whole) + 1


# What stands below


def test_the_test_functions_take_derivatives_by_parts() -> None:
    rate, n = 1000.0, 437
    t = (np.arange(n) + 0.5) / rate

    def shapes(k: int) -> tuple[Float1D, Float1D, Float1D]:
        w = 7.0 + k
        return np.sin(w * t), w * np.cos(w * t), -w * w * np.sin(w * t)

    phi, slope, bend = weight_functions(n, rate)
    for k in range(4):
        x, v, a = shapes(k)
        size = np.abs(weighted_sums(phi, a)).max()
        assert np.abs(weighted_sums(phi, a) - weighted_sums(bend, x)).max() < 1e-4 * size
        assert np.abs(weighted_sums(phi, a) + weighted_sums(slope, v)).max() < 1e-4 * size


@pytest.mark.parametrize("samples", [1, 7, 130])
def test_noise_is_that_of_the_first_samples_at_rest_however_they_are_cut(samples: int) -> None:
    _, measured = session()
    whole = ChannelNoise().add_block(measured)
    noise = ChannelNoise()
    for first in range(0, 400, samples):
        noise = noise.add_block(measured.cut(first, first + samples))
    assert noise.channel_rms("mass_acc_m_s2") == whole.channel_rms("mass_acc_m_s2") > 0
    assert math.isnan(ChannelNoise().channel_rms("mass_acc_m_s2"))


def test_without_sensors_it_says_less_and_nothing_wrong() -> None:
    """Each channel lost in turn, and all load cells: no warning appears that was not there."""
    bundle, measured = session()
    cells = tuple(name for name in measured.channels if name.startswith("force"))
    for lost in (("mass_acc_m_s2",), ("table_disp_m",), cells, COMPARED_CHANNELS):
        records = run_twin(bundle, change_channels(measured, lost, slice(None), math.nan))
        assert {event.kind for event in warnings(records)} <= {"jump"}, lost


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
