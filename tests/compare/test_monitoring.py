"""The watch on real sessions of the simulated table: silent where the model is right, clear where
something was planted; and each of its parts alone where a session would not show it."""

import hashlib
import math
import re
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import run_session
from table_io.backends import open_backend
from table_io.block import Block, Float1D, join_blocks
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
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
from twin.compare import COMPARED_CHANNELS, pipeline
from twin.compare.monitoring import EVENT_KINDS, jumps
from twin.compare.monitoring.attractor_change import AttractorState, detect_attractor_change
from twin.compare.monitoring.cycle import ChannelNoise, CycleData, weight_functions, weighted_sums
from twin.compare.monitoring.jumps import (
    MAX_STEP_HZ,
    ExpectedJump,
    JumpPrediction,
    JumpTracking,
    predict_jumps,
    track_jumps,
)
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import settle_to_orbit
from twin.model.ideal_response import simulate_sweep
from twin.setup.run_config import RunConfig, from_texts
from twin.transport.codec import encode_item

# Slow enough for many cycles of contact, short enough for a test; no loop check, no tuning.
PROFILE = """
title = "Through the resonance and back"
[specimen]
mass_kg = 550.0
gap_mm = {gap}
[sweep]
start_hz = 2.4
stop_hz = 4.4
step_hz = 0.5
cycles = 8
measured_cycles = 4
[acquisition]
rate_hz = 1000.0
[loop_check]
enabled = false
"""
EFFECT = '[[effects]]\nid = "{}"\n{}\nparameters = {{ {} }}\n'
STIFFNESS, GAP = 36e3, 2e-3


@cache
def session(truth: str = "", gap: float = 4.0) -> tuple[RunConfig, Block]:
    """(the bundle that a person knows of, every measured sample of the rig with that truth)."""
    with TemporaryDirectory() as folder:
        rig = (PROFILES_DIR / "rigs/simulated.toml").read_text()
        sealed = Path(folder) / "truth.toml"
        sealed.write_text(truth)
        sealed_lines = (
            f'truth = "{sealed}"\ntruth_sha256 = "{hashlib.sha256(truth.encode()).hexdigest()}"'
        )
        if truth:
            rig = rig.replace("[simulated]", f"[simulated]\n{sealed_lines}")
        bundle = from_texts(
            "x", PROFILE.format(gap=gap), rig, (PROFILES_DIR / "models/snm.toml").read_text(), "x"
        )
        clock = ManualClock()
        backend = open_backend(bundle.rig, bundle.profile, clock)
        items = run_session(
            bundle.session_setup,
            backend,
            clock,
            bundle.make_start_factory("r", "table"),
            lambda: None,
        )
        return bundle, join_blocks([item for item in items if isinstance(item, Block)])


@cache
def monitor_session(truth: str = "", gap: float = 4.0) -> tuple[Record, ...]:
    """What the twin says about such a session."""
    bundle, measured = session(truth, gap)
    setup = bundle.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, items = pipeline.step(setup, state, measured)
    return tuple(item for item in items if not isinstance(item, Block))


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
    assert all("where the model expects it" in warning.text for warning in warnings(items))
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
        ("mass_acc_m_s2", 1.1, "mass_acc_m_s2 and mass_disp_m", 1.1),
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


@pytest.mark.parametrize("keys", ["level_points = [[2.4, 0.05], [4.4, 0.05]]", ""])
def test_jumps_of_a_varying_level_are_those_of_each_level(keys: str) -> None:
    """At constant break points as without them; of a schedule as of sweeps of its levels."""
    rig, model = (PROFILES_DIR / name for name in ("rigs/simulated.toml", "models/snm.toml"))

    def predict(more: str) -> JumpPrediction:
        text = PROFILE.format(gap=4.0).replace("step_hz = 0.5", f"step_hz = 0.1\n{more}")
        bundle = from_texts("x", text, rig.read_text(), model.read_text(), "x")
        return predict_jumps(bundle.profile, bundle.model, bundle.steps, 0.03)

    def list_places(prediction: JumpPrediction, offset: int = 0) -> list[Any]:
        return [(jump.after.index + offset, pytest.approx(jump.at_hz)) for jump in prediction.jumps]

    constant = predict("")
    if keys:
        assert list_places(predict(keys)) == list_places(constant)
        assert predict(keys).log_amplitudes == pytest.approx(dict(constant.log_amplitudes))
        return
    half = predict("acceleration_g = 0.04")
    scheduled = predict(f"schedule_db = [{20 * math.log10(0.8)}, 0.0]")
    count = len(constant.log_amplitudes)
    assert len(half.jumps) == len(constant.jumps) == 2
    assert list_places(scheduled) == list_places(half) + list_places(constant, count)
    shifted = {index + count: value for index, value in constant.log_amplitudes.items()}
    assert scheduled.log_amplitudes == pytest.approx({**half.log_amplitudes, **shifted})


def test_the_jumps_of_the_model_lie_at_the_folds_of_its_branches() -> None:
    """By continuation of the stable motions, another way than the slow drive that finds them."""
    text = PROFILE.format(gap=4.0).replace("step_hz = 0.5", "step_hz = 0.1")
    rig, model = (PROFILES_DIR / name for name in ("rigs/simulated.toml", "models/snm.toml"))
    bundle = from_texts("x", text, rig.read_text(), model.read_text(), "x")
    jumps = predict_jumps(bundle.profile, bundle.model, bundle.steps, 0.03).jumps
    assert [(jump.after.direction, jump.kind) for jump in jumps] == [
        ("forward", "down"), ("backward", "up"),
    ]  # fmt: skip
    level = bundle.steps[0].acceleration_m_s2
    for jump, from_hz, direction in ((jumps[0], 3.0, 1), (jumps[1], 4.4, -1)):
        start = settle_to_orbit(make_period_map(bundle.model, from_hz, level))
        assert start is not None
        fold = continue_branch(start, "frequency", (2.4, 4.4), direction).folds[0].value
        assert abs(jump.at_hz - fold) < 1.5 * MAX_STEP_HZ
        ends = sorted((jump.before.frequency_hz, jump.after.frequency_hz))
        assert ends[0] <= fold <= ends[1]


def point(index: int, eta: float, direction: str = "forward") -> PrcPoint:
    n = math.nan
    own = NormalizedResponse(eta, n, n, n, n, n, (), (), 0.0, 0.0)
    return PrcPoint(1000 * index, index, direction, 3.0 + 0.1 * index, own, None, n, n, n)


def track_sweep(
    etas: Sequence[float | None], jump_after: int | None, model_etas: Sequence[float] = ()
) -> list[Record]:
    """What is said about a forward sweep; the model jumps down into step `jump_after`."""
    steps = [Step(i, "forward", 3.0 + 0.1 * i, 0.5) for i in range(len(etas))]
    jumps: tuple[ExpectedJump, ...] = ()
    if jump_after is not None:
        before, after = steps[jump_after - 1], steps[jump_after]
        at_hz = 0.5 * (before.frequency_hz + after.frequency_hz)
        jumps = (ExpectedJump(before, after, -1.5, at_hz),)
    expected = {index: math.log(eta) for index, eta in enumerate(model_etas)}
    passing, items = JumpTracking(expected, jumps), list[Record]()
    for place, eta in enumerate(etas):
        if eta is not None:
            passing, new_items = track_jumps(passing, point(place, eta))
            items.extend(new_items)
    return items


@pytest.mark.parametrize(
    "etas, jump, kinds, words",
    [
        ([5, 5, 5, 1, 1, 1], 3, ["jump"], "where the model expects it"),
        ([5, 5, 5, 2, 1, 1], 3, ["jump"], "where the model expects it"),  # goes on a step longer
        ([5, 5, 5, 5, 1, 1], 3, ["jump"], "one step after"),
        ([5, 5, 5, 5, 5, 5], 3, ["no jump"], "did not come"),
        ([5, 5, 5, 5, 5, 1], 3, ["no jump", "unexpected jump"], "2 steps later"),
        ([5, 5, 1, 1, 1, 1], 4, ["unexpected jump"], "2 steps earlier"),
        ([5, 5, 1, 1, 1, 1], None, ["unexpected jump"], "expects none here"),
        ([5, 5, 4, 4, 3, 3], None, [], ""),
        ([5, 5, None, 1, 1, 1], 2, ["jump"], "where the model expects it"),  # a step without point
    ],
)
def test_a_jump_comes_or_not(
    etas: list[float | None], jump: int | None, kinds: list[str], words: str
) -> None:
    events = warnings(track_sweep(etas, jump))
    assert [event.kind for event in events] == kinds
    assert not events or words in events[-1].text


@pytest.mark.parametrize("eta, kinds", [(1.3, []), (4.0, ["no jump"])])
def test_no_jump_is_missed_where_the_specimen_already_moves_as_the_model_after_it(
    eta: float, kinds: list[str]
) -> None:
    items = track_sweep([eta] * 6, 3, model_etas=[5, 5, 5, 1.1, 1.1, 1.1])
    assert [event.kind for event in warnings(items)] == kinds


@pytest.mark.parametrize(
    "model",
    [
        '[[effects]]\nid = "coulomb_friction"\nparameters = { fc = 300.0 }\n',  # sticks: no motion
        '[[effects]]\nid = "cubic_stiffness"\nparameters = { k3 = 1e8 }\n',
    ],
)
def test_a_model_with_effects_foresees_in_a_bounded_time(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However fine and long the test: by the cycles that are computed, not by a clock."""
    texts = [
        (PROFILES_DIR / name).read_text() for name in ("rigs/simulated.toml", "models/snm.toml")
    ]
    long = PROFILE.format(gap=4.0).replace("step_hz = 0.5", "step_hz = 0.01")
    bundle = from_texts("x", long, texts[0], texts[1] + "\n" + model, "x")
    cycles = []

    def simulate(*given: Any) -> Any:
        cycles.append(len(given[1]) * given[3])
        return simulate_sweep(*given)

    monkeypatch.setattr(jumps, "simulate_sweep", simulate)
    predict_jumps(bundle.profile, bundle.model, bundle.steps, 0.03)
    assert len(bundle.steps) * 8 > 3000
    assert cycles[0] <= jumps.MAX_CYCLES + 2 * jumps.CYCLES_PER_STEP


def test_the_next_jump_is_ahead_until_it_is_passed() -> None:
    ahead = [item for item in track_sweep([5, 5, 5, 1, 1], 3) if isinstance(item, JumpForecast)]
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


@pytest.mark.parametrize("part", [0.2, 0.5])
def test_a_twin_that_begins_in_motion_says_nothing_wrong_and_the_same_however_cut(
    part: float,
) -> None:
    """It knows no noise; the run's last rest comes after its last cycle and must not reach back."""
    bundle, measured = session()
    setup, begins = bundle.prepare_twin(), int(part * len(measured))
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
        ("cubic_stiffness k3=1e8; sensor_gain.mass_disp_m gain=1.1", {"stiffness": STIFFNESS}),
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
    card = (PROFILES_DIR / "models/snm.toml").read_text() + "\n" + effect_tables
    same = from_texts("x", bundle.profile_toml, bundle.rig_toml, card, "x")
    setup = same.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, made = pipeline.step(setup, state, measured)
    items = [item for item in made if not isinstance(item, Block)]
    for name, value in expected.items():
        estimate, sd, *_ = estimates(items, name)[-1]
        assert abs(estimate - value) < 0.02 * value + 5 * sd, (name, estimate)
    assert "drift" not in {warning.kind for warning in warnings(items)}


def test_a_bumper_where_none_should_be_is_no_crash() -> None:
    """The wrong set: the profile's gap is never reached, and the cells feel contact."""
    _, measured = session()
    bundle, _ = session("", 30.0)
    setup = bundle.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, made = pipeline.step(setup, state, measured)
    assert "disagreement" in {item.kind for item in made if isinstance(item, Event)}


def test_cells_that_read_nothing_in_contact_are_beyond_their_band() -> None:
    bundle, measured = session()
    values = measured.values.copy()
    for name in ("force_r1_n", "force_r2_n"):
        values[measured.channels.index(name)] = 0.0
    labels = measured.step, measured.label, measured.cycle
    block = Block("meas", 0, measured.rate_hz, measured.channels, values, *labels)
    setup = bundle.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, made = pipeline.step(setup, state, block)
    disagreements = [
        item for item in made if isinstance(item, Event) and item.kind == "disagreement"
    ]
    assert disagreements
    assert "force_r" in disagreements[0].text


def test_a_lost_sample_now_and_then_hides_no_disagreement_and_repeats_none() -> None:
    truth = "[base]\nbumper_stiffness_n_m = 700e3\n"
    bundle, measured = session(truth)
    whole = [
        warning for warning in warnings(monitor_session(truth)) if warning.kind == "disagreement"
    ]
    values = measured.values.copy()
    values[measured.channels.index("mass_disp_m"), ::1000] = np.nan
    labels = measured.step, measured.label, measured.cycle
    block = Block("meas", 0, measured.rate_hz, measured.channels, values, *labels)
    setup = bundle.prepare_twin()
    state, _ = pipeline.start_pipeline(setup)
    _, made = pipeline.step(setup, state, block)
    disagreements = [
        item for item in made if isinstance(item, Event) and item.kind == "disagreement"
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
    setup = bundle.prepare_twin()
    cells = tuple(name for name in measured.channels if name.startswith("force"))
    for lost in (("mass_acc_m_s2",), ("table_disp_m",), cells, COMPARED_CHANNELS):
        values = measured.values.copy()
        for name in lost:
            if name in measured.channels:
                values[measured.channels.index(name)] = np.nan
        labels = measured.step, measured.label, measured.cycle
        block = Block("meas", 0, measured.rate_hz, measured.channels, values, *labels)
        state, _ = pipeline.start_pipeline(setup)
        _, items = pipeline.step(setup, state, block)
        records = [item for item in items if not isinstance(item, Block)]
        assert all("where the model expects" in warning.text for warning in warnings(records)), lost
