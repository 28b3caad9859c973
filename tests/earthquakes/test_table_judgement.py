"""Twins of tables that are no rig of ours: planted responses, measured runs, and what is refused.

The planted tables are recursive filters in the time domain; the twin works with spectra.
"""

import gzip
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from table_io.block import Float1D
from table_io.config.channel import read_channels
from table_io.errors import InputError
from tests.command_line import call_main
from twin.earthquakes.drive_computation import compute_command, measure_error
from twin.earthquakes.result import Judgement, load_table_twin
from twin.earthquakes.table_identification import TableRehearsal
from twin.earthquakes.table_judgement import (
    NamedMotion,
    StructureTrial,
    check_motion,
    choose_structure,
    estimate_with_channels,
    find_predictable_band,
    fit_responses,
    judge_fitted_logs,
    judge_other_logs,
    prepare_data,
)
from twin.earthquakes.table_response import Resonance, ResponseData, ResponseModel, find_delay
from twin.earthquakes.task import TableTwinOptions, identify_table
from twin.exchange.import_table import import_table
from twin.recording.reader import read_recording

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "td3_table"
RATE_HZ = 200.0
DELAY_SAMPLES = 3  # samples
RING_HZ, RING_DAMPING = 6.5, 0.02
FRICTION_M_S2 = 0.05
NOISE_M = 2e-6


def make_command(seed: int, seconds: float = 60.0, rms_m: float = 8e-3) -> Float1D:
    """Return a random displacement below some Hz in m, at rest at its ends."""
    rng = np.random.default_rng(seed)
    count = round(seconds * RATE_HZ)
    low = signal.butter(6, (0.3, 4.0), "bandpass", fs=RATE_HZ, output="sos")
    motion = signal.sosfilt(low, rng.standard_normal(count + 400))[400:]
    edge = np.clip(np.minimum(np.arange(count), np.arange(count)[::-1]) / 400.0, 0.0, 1.0)
    shaped: Float1D = motion * rms_m / motion.std() * edge**3 * (10 - 15 * edge + 6 * edge**2)
    return shaped


def play_table(
    command: Float1D, seed: int = 0, friction_m_s2: float = FRICTION_M_S2, noise_m: float = NOISE_M
) -> Float1D:
    """Return the table's displacement in m: late, and rung by the reversals of its friction."""
    late = np.concatenate([np.zeros(DELAY_SAMPLES), command[:-DELAY_SAMPLES]])
    w = math.tau * RING_HZ
    ring = signal.cont2discrete(([1.0], [1.0, 2.0 * RING_DAMPING * w, w**2]), 1.0 / RATE_HZ)
    force = -friction_m_s2 * np.sign(np.gradient(late))
    ringing = signal.lfilter(ring[0].ravel(), ring[1], force)
    noise = noise_m * np.random.default_rng(100 + seed).standard_normal(command.size)
    table: Float1D = late + ringing + noise
    return table


def make_log(seed: int, table: Callable[[Float1D, int], Float1D] = play_table) -> NamedMotion:
    command = make_command(seed)
    return name_motion(command, table(command, seed), f"run{seed}")


def name_motion(command: Float1D, table: Float1D, log: str = "run") -> NamedMotion:
    derived = np.gradient(np.gradient(table)) * RATE_HZ**2
    return NamedMotion(log, TableRehearsal(RATE_HZ, command, table, derived, 0.0 * command, False))


def fit(*logs: NamedMotion, band_hz: tuple[float, float] = (0.3, 10.0)) -> ResponseModel:
    data = prepare_data(logs, band_hz)
    model = choose_structure(fit_responses(data), data).model
    assert isinstance(model, ResponseModel)
    return model


def judge_others(
    chosen: StructureTrial,
    trials: list[StructureTrial],
    logs: list[NamedMotion],
    band_hz: tuple[float, float],
) -> Judgement:
    return judge_other_logs(chosen, trials, logs, prepare_data(logs, band_hz))


@pytest.fixture(scope="module")
def response_fit() -> tuple[list[NamedMotion], ResponseModel]:
    logs = [make_log(seed) for seed in range(3)]
    return logs, fit(*logs)


def test_friction_and_the_resonance_that_it_excites_are_found(
    response_fit: tuple[list[NamedMotion], ResponseModel],
) -> None:
    logs, model = response_fit
    data = prepare_data(logs, (0.3, 10.0))
    trials = fit_responses(data)
    assert choose_structure(trials, data).id == model.structure == "friction_resonance"
    assert isinstance(model.resonance, Resonance)
    assert model.resonance.hz == pytest.approx(RING_HZ, rel=0.01)
    judged = judge_others(choose_structure(trials, data), trials, [make_log(9)], (0.3, 10.0))
    (run,) = judged.runs
    assert run.error.twin < 0.35 * run.error.pure_delay
    assert run.error.twin < 0.5 * run.error.frf
    assert judged.explain_refusal() == ""


def test_a_late_table_with_a_gain_gets_the_simplest_structure() -> None:
    def play(command: Float1D, seed: int) -> Float1D:
        return 0.97 * play_table(command, seed, friction_m_s2=0.0)

    logs = [make_log(seed, play) for seed in (1, 2)]
    data = prepare_data(logs, (0.3, 4.0))
    trials = fit_responses(data)
    chosen = choose_structure(trials, data)
    assert chosen.id == "delay_gain"
    assert isinstance(chosen.model, ResponseModel)
    assert chosen.model.delay_s == pytest.approx(DELAY_SAMPLES / RATE_HZ, abs=2.5e-4)
    gain = np.abs(chosen.model.frequency_response(np.array([2.0])))[0]
    assert gain == pytest.approx(0.97, abs=0.002)
    assert judge_others(chosen, trials, [make_log(3, play)], (0.3, 4.0)).explain_refusal() == ""


def test_a_response_does_not_depend_on_the_rate(
    response_fit: tuple[list[NamedMotion], ResponseModel],
) -> None:
    command = make_command(5, seconds=20.0)
    coarse = response_fit[1].simulate(command, RATE_HZ)[0]
    fine = response_fit[1].simulate(signal.resample(command, 5 * command.size), 5 * RATE_HZ)[0][::5]
    correction = coarse - command
    assert np.std(fine - coarse) < 0.02 * np.std(correction)


def test_the_displacement_and_the_acceleration_of_a_response_are_one_motion(
    response_fit: tuple[list[NamedMotion], ResponseModel],
) -> None:
    displacement, acceleration = response_fit[1].simulate(make_command(6, seconds=20.0), RATE_HZ)
    by_difference = np.diff(displacement, 2) * RATE_HZ**2
    assert np.std(by_difference - acceleration[1:-1]) < 0.03 * np.std(acceleration)


def test_a_drive_on_a_response_is_nearer_to_its_target(
    response_fit: tuple[list[NamedMotion], ResponseModel],
) -> None:
    target, band_hz = np.pad(make_command(7, seconds=20.0), 200), (0.5, 9.0)
    command = compute_command(response_fit[1], target, RATE_HZ, band_hz).command_m
    open_loop, driven = (
        measure_error(play_table(played), target, RATE_HZ, band_hz) for played in (target, command)
    )
    assert driven < 0.5 * open_loop


def test_a_block_left_out_judges_a_single_log() -> None:
    logs = [make_log(4)]
    data = prepare_data(logs, (0.3, 10.0))
    trials = fit_responses(data)
    chosen = choose_structure(trials, data)
    (run,) = judge_fitted_logs(chosen, trials, logs, data).runs
    assert run.error.twin == pytest.approx(chosen.error, rel=1e-4)
    fitted = data[0].measured_rows - data[0].projection.to_rows(
        data[0].projection.transform_motion(
            chosen.model.simulate(logs[0].motion.command_m, RATE_HZ)[0], None
        )
    )
    in_sample = np.linalg.norm(fitted) / np.linalg.norm(data[0].measured_rows)
    assert in_sample < run.error.twin < run.error.pure_delay


@pytest.mark.parametrize(("gains", "chosen"), [((0.4, 0.4, 0.4, 0.1), "frf"),
                                               ((0.4, 0.4, 0.4, 0.0), "pure_delay")])  # fmt: skip
def test_a_structure_that_helps_in_some_parts_only_is_not_chosen(
    gains: tuple[float, ...], chosen: str
) -> None:
    """Three quarters of one log are predicted better by far, which its last quarter does not show.

    What it removes there is within the scatter of the pieces.
    """
    data = prepare_data([make_log(4)], (0.3, 10.0))
    rng = np.random.default_rng(1)
    late = rng.standard_normal(data[0].part.size)
    left = late * (1.0 - np.array(gains))[data[0].part] + 0.02 * rng.standard_normal(late.size)
    model = ResponseModel("pure_delay", 0.015, (0.3, 10.0))
    trials = [
        StructureTrial(name, model, (rest,), float(np.std(rest)))
        for name, rest in (("pure_delay", late), ("frf", left))
    ]
    assert choose_structure(trials, data).id == chosen


def test_a_twin_that_loses_is_refused_with_its_figures() -> None:
    """Fitted on a table with friction, judged on one with the opposite."""
    logs = [make_log(1), make_log(2)]
    opposite = make_log(3, lambda command, seed: play_table(command, seed, -FRICTION_M_S2))
    data = prepare_data(logs, (0.3, 10.0))
    trials = fit_responses(data)
    judged = judge_others(choose_structure(trials, data), trials, [opposite], (0.3, 10.0))
    (run,) = judged.runs
    assert run.error.twin > 1.5 * run.error.pure_delay
    assert f"run3: error {run.error.twin:.3g}" in judged.explain_refusal()


def add_noise(table: Float1D, seed: int) -> Float1D:
    """Return a table that moves at random, whatever its command."""
    return make_command(50 + seed)


def ring_by_itself(table: Float1D, seed: int) -> Float1D:
    """Return a table that a specimen shakes at 7.3 Hz more than its command does."""
    rng = np.random.default_rng(seed)
    low, high = 7.25, 7.35
    ring = signal.sosfilt(
        signal.butter(2, (low, high), "bandpass", fs=RATE_HZ, output="sos"),
        rng.standard_normal(table.size),
    )
    acceleration = np.gradient(np.gradient(table)) * RATE_HZ**2
    moved: Float1D = table + 2.0 * ring / ring.std() * acceleration.std() / (math.tau * 7.3) ** 2
    return moved


def clip(table: Float1D, seed: int) -> Float1D:
    noise = 2e-7 * np.random.default_rng(seed).standard_normal(table.size)
    clipped: Float1D = np.clip(table, -1.2 * table.std(), None) + noise
    return clipped


def hold(table: Float1D, seed: int) -> Float1D:
    return np.full(table.size, 1e-3)


def stick(table: Float1D, seed: int) -> Float1D:
    count = table.size // 2 - 100
    return np.where(np.arange(table.size) > count, table[count], table)


SPOILED: dict[str, tuple[Callable[[Float1D, int], Float1D], str]] = {
    "noise": (add_noise, "mostly noise"),
    "specimen": (ring_by_itself, "shakes the table at 7.3 Hz"),
    "clipped": (clip, "table_disp_m: is clipped"),
    "reversed": (lambda table, seed: -table, "table_disp_m: is reversed"),
    "unit": (lambda table, seed: 1e3 * table, "times the command"),
    "dead": (hold, "table_disp_m: does not change"),
    "stuck": (stick, "table_disp_m: is stuck from 29."),
    "late": (lambda table, seed: np.roll(table, 200), "table_disp_m: is 1.0"),
}


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("name", SPOILED)
def test_a_log_that_says_nothing_of_its_table_is_refused(name: str, seed: int) -> None:
    spoil, words = SPOILED[name]
    command = make_command(seed)
    log = name_motion(command, spoil(play_table(command, seed), seed), "spoiled")

    def check() -> None:
        check_motion(log)
        find_predictable_band([log])

    with pytest.raises(InputError) as error:
        check()
    assert words in str(error.value)
    assert "spoiled" in error.value.where


@pytest.mark.parametrize(
    ("factor", "offset", "words"),
    [(-1.0, 0.0, "is reversed"), (1.0 / 9.81, 0.0, r"is 0\.10\d times"), (1.0, None, "is clipped")],
)
def test_a_spoiled_accelerometer_is_refused(
    factor: float, offset: float | None, words: str
) -> None:
    motion = make_log(1).motion
    acceleration = factor * motion.acceleration_m_s2
    if offset is None:
        acceleration = np.clip(acceleration, None, acceleration.std())
    motion = replace(motion, acceleration_m_s2=acceleration, has_accelerometer=True)
    with pytest.raises(InputError, match=words) as error:
        check_motion(NamedMotion("spoiled", motion))
    assert error.value.key == "table_acc_m_s2"


def test_five_seconds_are_refused_and_a_sound_log_is_not() -> None:
    log = make_log(1)
    with pytest.raises(InputError, match=r"5\.0 s of motion"):
        check_motion(replace(log, motion=log.motion.cut(round(5.0 * RATE_HZ))))
    derived = replace(log.motion, has_accelerometer=True)
    for motion in (log.motion, derived):
        check_motion(NamedMotion("run", motion))


def test_the_peaks_of_a_late_sine_are_no_clipping() -> None:
    """Rounded to 16 bits, a slow sine stays at its extreme value for many samples.

    One that is cut at 0.9 of its peak is refused.
    """
    times = np.arange(round(60.0 * RATE_HZ)) / RATE_HZ
    command, table = (
        np.round(0.02 * np.sin(math.tau * 0.5 * (times - late)) / 3e-6) * 3e-6
        for late in (0.0, 0.06)
    )
    check_motion(name_motion(command, table))
    with pytest.raises(InputError, match="clip"):
        check_motion(name_motion(command, np.clip(table, -0.018, 0.018)))


def test_the_band_ends_where_noise_begins() -> None:
    log = make_log(1, lambda command, seed: play_table(command, seed, 0.0, noise_m=5e-4))
    low_hz, high_hz = find_predictable_band([log])
    assert low_hz < 0.5
    assert 5.0 < high_hz < 10.0  # where the falling command meets the noise: 8.3 Hz


def import_log(folder: Path, name: str, command: Float1D, table: Float1D) -> Path:
    """Import a table of command and displacement, and return its log."""
    file, log = folder / f"{name}.csv", folder / f"{name}.mcap"
    rows = np.array([np.arange(command.size) / RATE_HZ, command, table]).T
    np.savetxt(file, rows, delimiter=",", header="time_s,drive_disp_m,table_disp_m", comments="")
    import_table(file, log)
    return log


def test_the_command_judges_imported_logs_and_writes_what_does_not_lose(tmp_path: Path) -> None:
    logs = []
    for seed in range(3):
        command = make_command(seed)
        logs.append(import_log(tmp_path, f"run{seed}", command, play_table(command, seed)))
    spoiled = import_log(tmp_path, "reversed", make_command(4), -play_table(make_command(4)))
    out = tmp_path / "table.toml"
    result = call_main("table-twin", *logs[:2], "--judge", logs[2], "--json", "--out", out)
    assert result.returncode == 0
    printed = json.loads(result.stdout)
    assert list(printed) == ["written", "reason", "runs"]
    assert (printed["written"], printed["reason"]) == (True, "")
    (run,) = printed["runs"]
    assert list(run) == ["log", "band_hz", "error"]
    assert run["log"] == str(logs[2])
    assert list(run["error"]) == ["twin", "pure_delay", "delay_gain", "frf"]
    assert run["error"]["twin"] < 0.5 * run["error"]["pure_delay"]
    twin = load_table_twin(out)
    assert twin.judgement is not None
    assert [judged.model_dump(mode="json") for judged in twin.judgement.runs] == [run]
    stages: list[str] = []
    again = identify_table(TableTwinOptions(tuple(logs[:2]), judge=(logs[2],)), stages.append)
    assert again.format_toml() == out.read_text()
    assert stages
    command = make_command(8)
    expected = again.model.simulate(command, RATE_HZ)
    np.testing.assert_allclose(twin.build_model().simulate(command, RATE_HZ), expected, rtol=1e-5)
    refused = call_main(
        "table-twin", logs[0], "--judge", logs[2], spoiled, "--json",
        "--out", tmp_path / "other.toml",
    )  # fmt: skip
    assert refused.returncode == 2
    printed = json.loads(refused.stdout)
    assert (printed["written"], printed["runs"]) == (False, [])
    assert "table_disp_m: is reversed" in printed["reason"]
    assert not (tmp_path / "other.toml").exists()
    with pytest.raises(InputError, match="is fitted, and cannot judge"):
        identify_table(TableTwinOptions(tuple(logs), judge=(logs[2],)))


def shake_unknown(seed: int) -> NamedMotion:
    """Return a late table with a motion that no command makes, which another channel measures.

    The channel reads three times its acceleration, 10 ms earlier, and noise.
    """
    command = make_command(seed)
    unknown = 0.1 * make_command(70 + seed)
    log = name_motion(command, play_table(command, seed, 0.0) + unknown, f"run{seed}")
    early = np.roll(np.gradient(np.gradient(unknown)) * RATE_HZ**2, -2)
    noise = 0.01 * early.std() * np.random.default_rng(seed).standard_normal(early.size)
    return replace(log, channels={"specimen_acc_roof_m_s2": 3.0 * early + noise})


def test_an_estimate_with_channels_knows_what_the_command_does_not() -> None:
    logs, band_hz = [shake_unknown(seed) for seed in range(3)], (0.3, 4.0)
    data = prepare_data(logs, band_hz)
    trials = fit_responses(data[:2])
    judged = judge_other_logs(choose_structure(trials, data[:2]), trials, logs[2:], data[2:])
    estimate = estimate_with_channels(data[:2], data[2:])
    assert estimate is not None
    assert estimate.channels == ("specimen_acc_roof_m_s2",)
    (error,) = estimate.errors
    assert error < 0.2 * judged.runs[0].error.twin
    assert estimate_with_channels(prepare_data([make_log(1)], band_hz), []) is None


def test_the_channels_of_a_table_are_known_to_an_import_and_to_the_twin(tmp_path: Path) -> None:
    log = shake_unknown(1)
    motion = log.motion
    names = ("specimen_acc_roof_m_s2", "delta_pressure_pa", "valve_command_v")
    rows = [np.arange(motion.command_m.size) / RATE_HZ, motion.command_m, motion.displacement_m]
    rows += [*log.channels.values(), 1e5 * motion.command_m, motion.command_m]
    file, imported = tmp_path / "run.csv", tmp_path / "run.mcap"
    header = ",".join(("time_s", "drive_disp_m", "table_disp_m", *names))
    np.savetxt(file, np.array(rows).T, delimiter=",", header=header, comments="")
    import_table(file, imported)
    recording = read_recording(imported)
    assert set(names) < set(recording.start.channels)
    units = {
        name: channel.unit for name, channel in read_channels(recording.start.rig_toml).items()
    }
    assert [units[name] for name in names] == ["m/s2", "Pa", "V"]
    estimate = identify_table(TableTwinOptions(imported)).judgement.estimate
    assert estimate is not None
    assert estimate.channels == tuple(sorted(names))
    assert estimate.errors[0] < 0.05


def read_measured_logs() -> list[NamedMotion]:
    """Return the runs of a real servo-hydraulic table with a frame on it."""
    files = sorted(DATA.glob("*.csv.gz"))
    if not files:
        pytest.skip("the measured data of others are not here")
    logs = []
    for file in files:
        with gzip.open(file, "rt") as text:
            rows = np.genfromtxt(text, delimiter=",", skip_header=1)
        table, command = ((1e-3 * (rows[:, k] - rows[0, k])) for k in (1, 8))
        channels = {f"specimen_acc_{k}_m_s2": 1e-3 * rows[:, k] for k in (3, 4, 5)}
        channels["delta_pressure_pa"] = rows[:, 6]
        motion = TableRehearsal(204.8, command, table, 0.0 * table, 0.0 * table, False)
        logs.append(NamedMotion(file.name, motion, channels))
    return logs


def estimate_by(
    kind: str, logs: list[NamedMotion], judge: NamedMotion, band_hz: tuple[float, float]
) -> float:
    """Return the error of the estimate with channels of one kind on a log that was not fitted."""

    def prepare(chosen: list[NamedMotion]) -> list[ResponseData]:
        kept = [
            replace(log, channels={k: row for k, row in log.channels.items() if k.startswith(kind)})
            for log in chosen
        ]
        return prepare_data(kept, band_hz)

    estimate = estimate_with_channels(prepare(logs), prepare([judge]))
    assert estimate is not None
    return estimate.errors[0]


def test_measured_runs_are_predicted_from_their_command_alone() -> None:
    """Each by a twin of the others: the acceleration as issued, the displacement as well."""
    logs, band_hz = read_measured_logs(), (0.3, 10.0)
    ratios, estimates = [], []
    for judge in logs:
        check_motion(judge)
        others = [log for log in logs if log is not judge]
        data = prepare_data(others, band_hz)
        trials = fit_responses(data)
        chosen = choose_structure(trials, data)
        (run,) = judge_others(chosen, trials, [judge], band_hz).runs
        ratios.append(run.error.twin / run.error.pure_delay)
        estimates.append(
            [
                estimate_by(kind, others, judge, band_hz) / run.error.pure_delay
                for kind in ("specimen_acc", "delta_pressure")
            ]
        )
        motion = judge.motion
        predicted = chosen.model.simulate(motion.command_m, motion.rate_hz)[0]
        by_twin, by_command = (
            np.std(motion.displacement_m - row) for row in (predicted, motion.command_m)
        )
        assert by_twin < by_command
    assert np.median(ratios) < 0.85
    assert max(ratios) < 1.0
    # With the accelerations of the floors, or with the pressure difference of the actuator.
    assert (np.median(estimates, axis=0) < 0.45).all()


def test_the_delay_of_measured_runs_lies_within_a_control_period_or_two() -> None:
    data = prepare_data(read_measured_logs(), (0.3, 10.0))
    assert 0.003 < find_delay(data) < 0.012
