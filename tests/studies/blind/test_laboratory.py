"""The study in imperfect laboratories: its cases, true errors of instruments, and scores."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import run_session
from table_io.backends import Backend, open_backend
from table_io.block import Block, Label
from table_io.clock import ManualClock
from table_io.config.base import parse_toml
from table_io.errors import InputError
from table_io.records import RunStart, RunStop
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.ground_truth import GroundTruth, HiddenEffect
from table_io.sim.imperfections import IMPERFECTION_IDS, Imperfection
from table_io.sim.simulated_table import build_plant, hide_laws
from tests.studies.blind.cases import (
    CELLS,
    NUMBERS_PER_CELL,
    Case,
    draw_case,
    list_case_numbers,
)
from tests.studies.blind.harness import RESULTS_FILE
from tests.studies.blind.laboratory_truth import (
    compute_setup_errors,
    list_affected_channels,
    measure_reading_errors,
    measure_visible_size,
)
from tests.studies.blind.metrics import compute_laboratory_metrics
from tests.studies.blind.page import write_study_pages
from tests.studies.blind.plant import generate_case, play_unprotected
from tests.studies.blind.rig import (
    MODEL_TOML,
    PROFILE,
    PROFILE_TOML,
    SIGNAL_CHANNELS,
    StudySignals,
    compute_noise_rms,
    make_rig_toml,
    simulate_readings,
)
from tests.studies.blind.scoring import (
    classify_finding,
    score_base,
    score_identification,
    score_laboratory,
    score_verdict,
)
from tests.studies.blind.test_scoring import OTHER, TRUE, about, verdict
from twin.recording.reader import read_recording
from twin.setup.run_config import from_texts

Json = dict[str, Any]
ERRORS = {
    "sensor_gain.force_r1_n": {"gain": [1.2]},
    "sensor_gain.force_l1_n": {"gain": [1.0]},
    "sensor_lag.mass_acc_m_s2": {"lag": [1e-4, -2e-3]},
    "gap_offset": {"offset": [-4e-5]},
}
BASE = {
    "damper_stiffness_n_m": 36000.0, "damper_damping_n_s_m": 1000.0,
    "bumper_stiffness_n_m": 5e5, "bumper_damping_n_s_m": 900.0,
    "gap_right_m": 2.2e-3, "gap_left_m": 1.9e-3, "stated_gap_m": 2e-3,
}  # fmt: skip


def case_in(cell: str, place: int = 0) -> Case:
    return draw_case(NUMBERS_PER_CELL * [c.name for c in CELLS].index(cell) + place)


def make_about(kind: str = "none", *effects: Json, level: str = "typical", **more: Any) -> Json:
    laboratory = {
        "level": level, "imperfection": more.pop("imperfection", ""), "errors": ERRORS,
        "size": more.pop("imperfection_size", 3.0),
        "channels": ["force_r1_n", "force_r2_n"],
    }  # fmt: skip
    return about(kind, *effects, laboratory=laboratory, base=BASE, **more)


def make_named_verdict(name: str, key: str, value: float, half: float = 0.0) -> Json:
    """A verdict that names one effect with one parameter."""
    effect = {
        "id": name, "confidence": 0.9,
        "parameters": {key: {"value": value, "low": value - half, "high": value + half}},
    }  # fmt: skip
    return verdict("named") | {"effects": [effect], "why": "the residual is noise"}


def score_case(outcome: Json, case: Json) -> Json:
    row = score_verdict(outcome, case)
    return row | score_laboratory(row, outcome, case)


def test_every_imperfection_has_its_cells_and_the_ideal_ones_are_as_before() -> None:
    for level in ("typical", "bad"):
        alone = {cell.imperfection for cell in CELLS if cell.laboratory == level} - {""}
        assert alone == {*IMPERFECTION_IDS}
    kinds = {cell.kind for cell in CELLS if cell.laboratory == "typical" and not cell.imperfection}
    assert kinds == {"none", "single", "sensor", "pair", "unknown", "identify"}
    ideal = list_case_numbers(1)
    assert all(CELLS[number // NUMBERS_PER_CELL].laboratory == "none" for number in ideal)
    assert {*range(297)} <= {number // NUMBERS_PER_CELL for number in ideal}
    assert CELLS[296].name == "pair/10/5%"
    assert not case_in("none/1%").imperfections
    clean = list_case_numbers(6, ["none/*"], "typical")
    assert len(clean) == 2 * 6 * len(IMPERFECTION_IDS) + 2 * 5 * 6
    with pytest.raises(InputError) as error:
        list_case_numbers(1, ["single/*"], "bad")
    assert (error.value.key, error.value.value) == ("--cells", "single/*")


def test_the_laboratory_of_a_case_is_drawn_from_its_number() -> None:
    case = case_in("bad/none/load_sharing/1%", 3)
    assert {entry.id for entry in case.imperfections} == {"load_sharing"}
    assert {entry.side for entry in case.imperfections} == {"right", "left"}
    assert draw_case(case.number).imperfections == case.imperfections
    other = case_in("bad/none/load_sharing/1%", 4)
    assert other.imperfections != case.imperfections
    everything = case_in("typical/single/cubic_stiffness/3/1%").imperfections
    assert {entry.id for entry in everything} == {*IMPERFECTION_IDS}


def make_signals() -> StudySignals:
    rate, still = PROFILE.acquisition.rate_hz, 1000
    time = np.arange(20_000) / rate
    moving = time >= still / rate
    draw = np.random.default_rng(3)
    channels = {
        name: np.where(moving, sum(np.sin(2 * np.pi * hz * time + p) for hz, p in tones), 0.0)
        for name in SIGNAL_CHANNELS
        for tones in [[(hz, draw.uniform(0, 6)) for hz in (0.8, 1.7, 3.1)]]
    }
    nothing = np.zeros(time.size)
    label = np.where(moving, Label.MEASURE, Label.REST)
    return StudySignals(channels, nothing, nothing, np.zeros(time.size, int), label)


def test_the_errors_of_channels_are_measured() -> None:
    """One lag of all is not observable; the offset is that since the tare."""
    signals = make_signals()
    readings = {}
    for name, value in signals.channels.items():
        lag = 5 if name == "mass_acc_m_s2" else 2  # samples
        readings[name] = np.concatenate([np.zeros(lag), value[:-lag]]) + 0.3
    readings["force_r1_n"] = 1.1 * readings["force_r1_n"]
    readings["force_l2_n"] = readings["force_l2_n"] + 0.2 * signals.moving
    errors = measure_reading_errors(signals, readings)
    assert errors["force_r1_n"].gain == pytest.approx(1.1, abs=1e-3)
    assert errors["force_l2_n"].gain == pytest.approx(1.0, abs=1e-3)
    assert errors["mass_acc_m_s2"].lags == pytest.approx((3e-3, 3e-3), rel=0.02)
    assert errors["mass_disp_m"].lags == pytest.approx((0.0, 0.0), abs=1e-4)
    assert errors["force_l2_n"].offset == pytest.approx(0.2, rel=0.02)
    assert abs(errors["mass_disp_m"].offset) < 2e-3


def test_errors_of_the_set_up_are_those_of_the_plant() -> None:
    """Readings of gaps and mass move the plant as the effects that a verdict names for them."""
    entries = (
        Imperfection(id="gap_reading", side="right", parameters={"offset": 3e-4}),
        Imperfection(id="gap_reading", side="left", parameters={"offset": -1e-4}),
        Imperfection(id="mass_reading", parameters={"ratio": 1.01}),
        Imperfection(id="table_pitch", parameters={"per_travel": 0.01}),
    )
    effects = tuple(
        HiddenEffect(id=name, parameters=parameters)
        for name, parameters in compute_setup_errors(entries).items()
    )
    rig = from_texts("x", PROFILE_TOML, make_rig_toml(0.0), MODEL_TOML, "x").rig
    table = rig.require_section("simulated", SimulatedTableConfig)
    nominal = build_plant(table, PROFILE.specimen, 1000.0)
    by_laboratory = hide_laws(nominal, GroundTruth(imperfections=entries))
    by_effects = hide_laws(nominal, GroundTruth(effects=effects))
    assert by_effects.mass_kg == pytest.approx(by_laboratory.mass_kg)
    assert by_effects.hidden is not None
    assert by_laboratory.hidden is not None
    assert by_effects.hidden.tilt == pytest.approx(by_laboratory.hidden.tilt)
    mean = 0.5 * (3e-4 - 1e-4)  # is no asymmetry: a gap is fitted
    assert by_effects.gap_right_m + mean == pytest.approx(by_laboratory.gap_right_m)
    assert by_effects.gap_left_m + mean == pytest.approx(by_laboratory.gap_left_m)


def test_the_channels_on_which_an_imperfection_acts() -> None:
    def list_channels(*entries: Imperfection) -> list[str]:
        return list_affected_channels(entries, SIGNAL_CHANNELS)

    sharing = Imperfection(id="load_sharing", side="left", parameters={"share": 0.6})
    assert list_channels(sharing) == ["force_l1_n", "force_l2_n"]
    hum = Imperfection(id="hum", channel="mass_disp_m", parameters={"rms": 1e-5})
    assert list_channels(hum, sharing) == ["mass_disp_m", "force_l1_n", "force_l2_n"]
    skew = Imperfection(id="channel_skew", parameters={"skew": 2e-5})
    assert list_channels(skew) == list(SIGNAL_CHANNELS[:-1])
    assert list_channels(Imperfection(id="mass_reading", parameters={"ratio": 1.01})) == []


@pytest.mark.parametrize(
    ("name", "key", "value", "half", "expected"),
    [
        ("sensor_gain.force_r1_n", "gain", 1.15, 0.0, "instrument"),
        ("sensor_gain.force_r1_n", "gain", 1.05, 0.0, "false"),  # a quarter of its size
        ("sensor_gain.force_r1_n", "gain", 1.05, 0.16, "instrument"),  # but in its interval
        ("sensor_gain.force_r1_n", "gain", 0.8, 0.0, "false"),  # the other sign
        ("sensor_gain.force_l1_n", "gain", 1.2, 0.0, "false"),  # the other side
        ("sensor_gain.table_disp_m", "gain", 1.2, 0.0, "false"),
        ("sensor_lag.mass_acc_m_s2", "lag", 1.5e-4, 0.0, "instrument"),
        ("sensor_lag.mass_acc_m_s2", "lag", -3e-3, 0.0, "instrument"),  # behind the lasers
        ("gap_offset", "offset", -5e-5, 0.0, "instrument"),
        ("gap_offset", "offset", 5e-5, 0.0, "false"),
        ("mass_error", "ratio", 1.01, 0.0, "false"),
        ("cubic_stiffness", "k3", 1e7, 0.0, "physics"),
        ("bumper_asymmetry", "ratio", 1.1, 0.0, "physics"),
    ],
)
def test_what_a_verdict_names_has_a_class(
    name: str, key: str, value: float, half: float, expected: str
) -> None:
    effect = make_named_verdict(name, key, value, half)["effects"][0]
    assert classify_finding(name, effect, make_about()) == expected
    row = score_case(make_named_verdict(name, key, value, half), make_about())
    assert [finding["class"] for finding in row["findings"]] == [expected]
    assert row["healthy"] == row["right"] == (expected == "instrument")
    assert row["physics"] == (expected == "physics")
    assert row["wrong_name"] == (expected != "instrument")


def test_score_case_of_a_clean_recording() -> None:
    healthy = score_case(verdict("none"), make_about())
    assert (healthy["healthy"], healthy["right"]) == (True, True)
    for word in ("unexplained", "ambiguous", "failed"):
        row = score_case(verdict(word, "cubic_stiffness"), make_about())
        assert (row["healthy"], row["physics"], row["wrong_name"]) == (False, False, False), word


def test_a_bad_instrument_is_named_on_its_channel() -> None:
    bad = make_about(level="bad", imperfection="load_sharing")
    exact = score_case(make_named_verdict("sensor_gain.force_r1_n", "gain", 1.21), bad)
    assert (exact["on_channel"], exact["instrument"], exact["right"]) == (True, True, True)
    kind = score_case(make_named_verdict("sensor_lag.force_r2_n", "lag", 1e-3), bad)
    assert (kind["on_channel"], kind["instrument"], kind["right"]) == (True, False, True)
    elsewhere = score_case(make_named_verdict("sensor_gain.mass_disp_m", "gain", 1.1), bad)
    assert (elsewhere["on_channel"], elsewhere["right"]) == (False, False)
    assert not score_case(verdict("none"), bad)["right"]
    assert score_case(make_named_verdict("cubic_stiffness", "k3", 1e7), bad)["physics"]


def test_instruments_called_to_be_mended_count_where_they_are_bad_only() -> None:
    def mend(kind: str, *channels: str) -> dict[str, object]:
        check = {"kind": kind, "channels": channels, "healthy": False}
        return {**verdict("none"), "sensors": {"state": "to be mended", "checks": [check]}}

    typical = score_case(mend("share", "force_r1_n", "force_r2_n"), make_about())
    assert (typical["healthy"], typical["right"]) == (False, False)
    bad = make_about(level="bad", imperfection="load_sharing")
    for faults, is_found in (
        (mend("share", "force_r1_n", "force_r2_n"), True),
        (mend("gain", "table_disp_m", "table_acc_m_s2"), False),
    ):
        row = score_case(faults, bad)
        assert (row["on_channel"], row["right"], row["physics"]) == (is_found, is_found, False)


def test_an_effect_is_named_and_nothing_false() -> None:
    gain = make_named_verdict("sensor_gain.force_r1_n", "gain", 1.2)["effects"]
    right = verdict("named", TRUE["name"])
    with_gain = right | {"effects": [*gain, *right["effects"]]}
    for outcome, expected in ((right, True), (with_gain, True)):
        row = score_case(outcome, make_about("single", TRUE))
        assert (row["hit"], row["wrong_name"], row["right"]) == (expected, False, expected)
    extra = score_case(verdict("named", TRUE["name"], "gap_drift"), make_about("single", TRUE))
    assert (extra["hit"], extra["wrong_name"], extra["right"]) == (True, True, False)
    pair = make_about("pair", TRUE, OTHER)
    assert score_case(verdict("named", TRUE["name"], OTHER["name"]), pair)["right"]
    assert not score_case(right, pair)["right"]
    unknown = make_about("unknown", {**TRUE, "name": "adhesion"})
    assert score_case(verdict("unexplained"), unknown)["right"]
    assert score_case(verdict("named", "hunt_crossley"), unknown)["wrong_name"]


def test_base_parameters_of_a_verdict() -> None:
    """Gaps of 2.2 and 1.9 mm, stated as 2 mm: each side 0.05 mm wider on average."""
    estimates = {
        "stiffness": {"value": 36360.0, "low": 35000.0, "high": 37000.0},
        "bumper_damping": {"value": 990.0, "low": 950.0, "high": 1000.0},
        "gap0": {"value": 5.2e-5, "low": 4e-5, "high": 6e-5},
    }
    by_name = {row["name"]: row for row in score_base(estimates, BASE)}
    assert by_name["stiffness"] == {
        "name": "stiffness", "error": pytest.approx(0.01), "covered": True,
    }  # fmt: skip
    assert by_name["bumper_damping"]["error"] == pytest.approx(0.1)
    assert not by_name["bumper_damping"]["covered"]
    assert by_name["gap"]["error"] == pytest.approx(2e-6 / 2.05e-3)
    assert by_name["gap"]["covered"]


def test_an_identification_is_right_within_one_per_cent() -> None:
    parameters = {
        name: {"value": BASE[key], "low": 0.99 * BASE[key], "high": 1.01 * BASE[key]}
        for name, key in (
            ("stiffness", "damper_stiffness_n_m"),
            ("damping", "damper_damping_n_s_m"),
        )
    }
    parameters["gap"] = {"value": 4.11e-3, "low": 4.0e-3, "high": 4.105e-3}
    parameters["gap_right"] = {"value": 2.21e-3}
    row = score_identification(
        {"verdict": "identified", "parameters": parameters}, make_about("identify")
    )
    assert row["right"]
    assert [e["covered"] for e in row["estimates"]] == [True, True, True, None]
    parameters["gap_left"] = {"value": 1.93e-3}
    assert not score_identification(
        {"verdict": "identified", "parameters": parameters}, make_about("identify")
    )["right"]
    assert not score_identification({"verdict": "failed"}, make_about("identify"))["right"]


def test_metrics_count_each_kind_once(tmp_path: Path) -> None:
    bad = make_about(level="bad", imperfection="load_sharing")
    cases = [
        (verdict("none"), make_about()),
        (verdict("none"), make_about(imperfection="hum")),
        (make_named_verdict("cubic_stiffness", "k3", 1e7), make_about()),
        (make_named_verdict("sensor_gain.force_r1_n", "gain", 1.2), bad),
        (verdict("none"), bad),
        (verdict("none"), make_about(level="bad", imperfection="drift", imperfection_size=1.1)),
        (verdict("named", TRUE["name"]), make_about("single", TRUE)),
        (verdict("named", "gap_drift"), make_about("single", TRUE)),
        (verdict("none"), make_about("sensor", {**TRUE, "name": "sensor_gain.mass_disp_m"})),
        (verdict("named", TRUE["name"]), make_about("pair", TRUE, OTHER)),
        (verdict("unexplained"), make_about("unknown", {**TRUE, "name": "adhesion"})),
    ]
    rows = [
        score_case(outcome, case | {"number": number})
        for number, (outcome, case) in enumerate(cases)
    ]
    metrics = {metric.name: metric for metric in compute_laboratory_metrics(rows)}

    def counts(name: str) -> tuple[int, int]:
        rate = metrics[name].rate
        assert rate is not None
        return rate.hits, rate.count

    assert counts("typical, clean: none or true instrument") == (2, 3)
    assert counts("typical, clean, one imperfection") == (1, 1)
    assert counts("typical, clean: a physical effect named") == (1, 3)
    assert counts("bad, clean: named as the instrument's") == (1, 3)
    assert counts("bad, clean, visible: named as the instrument's") == (1, 2)
    assert counts("one effect: named") == (1, 2)
    assert counts("one effect: wrong name") == (1, 2)
    assert counts("one planted error of a sensor or the set-up: named") == (0, 1)
    assert counts("two effects in a laboratory: both") == (0, 1)
    assert counts("two effects in a laboratory: at least one") == (1, 1)
    assert counts("not in the library, in a laboratory: unexplained") == (1, 1)
    (tmp_path / RESULTS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    page = write_study_pages(tmp_path).read_text()
    assert "| one effect: named | >= 95 % | 50.0 % (1/2; 9.5 to 90.5) | MISSED |" in page
    assert "top-1, size" not in page, "the ideal study has no case here"
    assert "cubic_stiffness (physics)" in page


def test_a_recording_without_protection_is_that_of_a_session() -> None:
    config = from_texts("x", PROFILE_TOML, make_rig_toml(0.01, 5), MODEL_TOML, "x")
    describe = config.make_start_factory("x", "table")

    def open_table() -> Backend:
        return open_backend(config.rig, config.profile, ManualClock())

    ours = [*play_unprotected(config, open_table(), describe)]
    session = run_session(config.session_setup, open_table(), ManualClock(), describe, lambda: None)
    theirs = [*session]
    pairs = [[item for item in items if isinstance(item, Block)] for items in (ours, theirs)]
    assert all(a.is_identical(b) for a, b in zip(*pairs, strict=True))
    assert sum(map(len, pairs[0])) > config.drive.planned_end
    assert isinstance(ours[0], RunStart)
    assert isinstance(theirs[0], RunStart)
    assert (ours[0].tare, ours[0].rig_toml) == (theirs[0].tare, theirs[0].rig_toml)
    assert isinstance(ours[-1], RunStop)
    assert isinstance(theirs[-1], RunStop)
    assert (ours[-1].index, ours[-1].verdict) == (theirs[-1].index, "complete")


def test_generate_case_seals_its_laboratory(tmp_path: Path) -> None:
    """Its sealed truth states the laboratory; what is shown does not; the errors are measured."""
    case = case_in("bad/none/load_sharing/1%")
    paths = generate_case(case, tmp_path)
    sealed = json.loads(paths.about.read_text())
    truth = parse_toml((paths.sealed_dir / "truth.toml").read_text(), GroundTruth, "truth")
    assert [entry.id for entry in truth.imperfections] == ["load_sharing", "load_sharing"]
    right = next(entry for entry in truth.imperfections if entry.side == "right")
    errors = sealed["laboratory"]["errors"]
    (gain,) = errors["sensor_gain.force_r1_n"]["gain"]
    assert gain == pytest.approx(2 * right.parameters["share"], abs=0.02)
    assert errors["sensor_gain.mass_acc_m_s2"]["gain"] == pytest.approx([1.0], abs=1e-3)
    assert sealed["sized"]
    assert sealed["laboratory"]["size"] > 10.0
    signals, readings = simulate_readings(make_rig_toml(0.0))
    assert measure_visible_size(signals, readings, compute_noise_rms(0.01)) < 1.1
    start = read_recording(paths.log).start
    for text in (start.rig_toml, start.profile_toml, start.model_toml, start.run):
        assert "load_sharing" not in text
        assert "bad" not in text
