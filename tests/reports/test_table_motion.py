"""Motion of the table against its target: from a recorded run to summary, last line and report."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import join_blocks
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.config.tracking import TrackingConfig
from table_io.units import GRAVITY_M_S2
from tests.builders.blocks import select_blocks
from tests.builders.rigs import RIG_TEXT
from tests.setup.test_record import NO_CHECK, Run, play_run
from twin.drawing.table_motion_figures import MOTION_FIGURES
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.report.report import write_report
from twin.results.spectra import compute_response_spectrum
from twin.results.summary import format_summary
from twin.results.table_motion import (
    find_table_motion,
    format_tracking,
    list_required_frequencies,
    summarise_tracking,
)
from twin.results.tracking import judge_tracking


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A record of 8 s and its blends, at the levels of which the bumpers are hit."""
    return play_run(tmp_path_factory.mktemp("record"), NO_CHECK)


def read_profile(recording: Recording, **tracking: Any) -> Profile:
    profile = parse_toml(recording.start.profile_toml, Profile, "recorded")
    return profile.model_copy(update={"tracking": TrackingConfig(**tracking)})


def write_spectrum(recording: Recording, factor: float) -> dict[str, Any]:
    """A required spectrum: that of the table itself times a factor, from 1 to 8 Hz."""
    motion = find_table_motion(recording, read_profile(recording))
    assert motion is not None
    hz = 2.0 ** (np.arange(19) / 6)
    spectrum = compute_response_spectrum(motion.achieved_acc_m_s2, motion.rate_hz, hz)
    sa_g = factor * spectrum / GRAVITY_M_S2
    rows = "".join(f"{f!r},{sa!r}\n" for f, sa in zip(hz.tolist(), sa_g.tolist(), strict=True))
    return {"required_spectrum": "rrs.csv", "files": {"rrs.csv": "frequency_hz,sa_g\n" + rows}}


def test_the_target_is_the_command_where_the_windows_begin(run: Run) -> None:
    config, recording, summary = run
    motion = find_table_motion(recording, config.profile)
    assert motion is not None
    block = join_blocks(recording.contiguous_blocks("meas"))
    part = block.cut(motion.first, motion.first + motion.target_disp_m.size)
    assert np.abs(part.channel("drive_disp_m") - motion.target_disp_m).max() < 2e-6
    assert np.array_equal(motion.achieved_acc_m_s2, part.channel("table_acc_m_s2"))
    windows = summary.windows
    assert (motion.start, motion.end) == (
        round(windows[0].from_s * motion.rate_hz),
        round(windows[-1].to_s * motion.rate_hz),
    )
    assert motion.first < motion.start  # with rest before and after
    assert motion.first + motion.target_disp_m.size > motion.end


def test_the_summary_has_the_error_of_the_recorded_motion(run: Run) -> None:
    _, recording, summary = run
    tracking = summary.tracking
    block = join_blocks(recording.contiguous_blocks("meas"))
    first, end = (round(at_s * block.rate_hz) for at_s in (tracking.from_s, tracking.to_s))
    command = read_profile(recording).plan.history_m
    assert command.size == end - first
    achieved = block.channel("table_disp_m")[first:end]
    # An independent formula of the lag and the error: the best shift of an interpolated command.
    index = np.arange(command.size)
    errors = {
        lag: np.sqrt(np.mean((achieved - np.interp(index - lag, index, command)) ** 2))
        for lag in np.arange(20.0, 45.0, 0.25)
    }
    lag = min(errors, key=lambda shift: errors[shift])
    assert tracking.lag_s == pytest.approx(lag / block.rate_hz, abs=1e-3)
    lag = tracking.lag_s * block.rate_hz  # that of the acceleration
    error = np.sum((achieved - np.interp(index - lag, index, command)) ** 2)
    expected = np.sqrt(error / np.sum(command**2))
    assert tracking.disp_rms_error_full == pytest.approx(expected, rel=0.05)
    acceleration = block.channel("table_acc_m_s2")[first:end]
    target = np.diff(command, 2) * block.rate_hz**2
    ratio = np.abs(acceleration).max() / np.abs(target).max()
    assert tracking.pga_ratio_full == pytest.approx(ratio, rel=1e-3)
    assert tracking.acc_rms_error_band < tracking.acc_rms_error_full < 0.2
    assert tracking.sa_share == 1.0
    assert tracking.required_spectrum is None


def test_band_and_damping_are_those_of_the_profile(run: Run) -> None:
    _, recording, _ = run
    profile = read_profile(recording, band_hz=(0.5, 5.0), damping=0.02)
    tracking, motion = summarise_tracking(recording, profile), find_table_motion(recording, profile)
    assert tracking is not None
    assert motion is not None
    assert (tracking.band_hz, tracking.damping) == ((0.5, 5.0), 0.02)
    error = judge_tracking(
        motion.target_acc_m_s2, motion.achieved_acc_m_s2, motion.rate_hz, (0.5, 5.0), damping=0.02
    )
    assert tracking.sa_worst_ratio == error.sa_worst_ratio
    assert tracking.sa_count == error.sa_count == 20


@pytest.mark.parametrize(
    ("factor", "outside", "passed"),
    [(1.0, 0, True), (1.09, 0, True), (1.2, 19, False), (0.7, 19, False)],
)
def test_a_required_spectrum_is_checked(
    run: Run, factor: float, outside: int, passed: bool
) -> None:
    _, recording, _ = run
    profile = read_profile(recording, **write_spectrum(recording, factor))
    tracking = summarise_tracking(recording, profile)
    assert tracking is not None
    required: Any = tracking.required_spectrum
    assert (required.count, required.outside, required.passed) == (19, outside, passed)
    for ratio in (required.lowest_ratio, required.highest_ratio):
        assert ratio == pytest.approx(1 / factor, rel=1e-6)
    word = "met" if passed else "missed at 19 of 19 ordinates"
    assert format_tracking(tracking).endswith(f"required spectrum {word}")


def test_a_spectrum_beyond_the_sampling_rate_is_checked_as_far_as_it_goes(run: Run) -> None:
    _, recording, _ = run
    text = "frequency_hz,sa_g\n50,1\n5000,1\n"
    profile = read_profile(recording, required_spectrum="x", files={"x": text})
    assert profile.tracking.spectrum is not None
    hz = list_required_frequencies(profile.tracking.spectrum, recording.start.rate_hz)
    assert 50.0 < hz[0] < hz[-1] <= recording.start.rate_hz / 10
    profile = read_profile(
        recording, required_spectrum="x", files={"x": text.replace("50,", "4e3,")}
    )
    tracking = summarise_tracking(recording, profile)
    assert tracking is not None
    assert tracking.required_spectrum is not None
    assert tracking.required_spectrum.count == 0
    assert not tracking.required_spectrum.passed
    assert "not checked" in format_tracking(tracking)


def test_the_last_line_states_rms_pga_and_spectrum(run: Run) -> None:
    *_, summary = run
    line = format_summary(summary, 0)
    assert re.search(r"acceleration [\d.]+ % RMS off its target in [\d.]+ to [\d.]+ Hz", line)
    assert re.search(r"PGA [\d.]+ % of it", line)
    assert f"{summary.tracking.sa_count} SA within 10 %" in line
    assert re.search(r"lag 1\d\.\d ms", line)


def test_a_test_that_was_stopped_is_judged_as_far_as_it_went(tmp_path: Path) -> None:
    _, _, summary = play_run(tmp_path, NO_CHECK, stop_at=round(4.56 * 2000))
    tracking = summary.tracking
    assert summary.verdict == "stopped"
    assert tracking.to_s == summary.windows[-1].to_s
    assert tracking.to_s < 5.5
    assert tracking.acc_rms_error_full < 0.2
    assert tracking.pga_ratio_full == pytest.approx(1.0, abs=0.1)


def test_lost_samples_are_stated_and_the_spectra_are_not(tmp_path: Path) -> None:
    rig = f'{RIG_TEXT}\n[[simulated.faults]]\nat_s = 4.0\nfor_s = 0.005\nkind = "dropped"\n'
    _, recording, summary = play_run(tmp_path, NO_CHECK, rig)
    tracking = summary.tracking
    assert summary.verdict == "complete"
    assert tracking.lost_samples == 10
    assert tracking.acc_rms_error_full < 0.2
    assert np.isnan(tracking.sa_share)
    assert json.loads(summary.to_json())["tracking"]["sa_share"] is None
    assert "10 samples lost" in format_tracking(tracking)
    profile = read_profile(recording, required_spectrum="x", files={
        "x": "frequency_hz,sa_g\n1,1\n8,1\n"
    })  # fmt: skip
    again = summarise_tracking(recording, profile)
    assert again is not None
    assert again.required_spectrum is not None
    assert not again.required_spectrum.passed
    summary.write(tmp_path / "summary.json")
    page = write_report(tmp_path, recording).read_text()
    assert "10 samples of the table" in page
    names = {name for name in MOTION_FIGURES if f'<figure id="{name}">' in page}
    assert names == {"table_acceleration", "table_displacement"}


def test_a_recording_without_its_begin_has_no_target(run: Run, tmp_path: Path) -> None:
    """The windows that are left do not say where the history began."""
    _, recording, summary = run
    first = round(summary.tracking.from_s * recording.start.rate_hz)
    blocks = [
        block for block in select_blocks(recording.items, "meas") if block.index > first + 500
    ]
    write_items(tmp_path / "run.mcap", list(blocks), recording.start)
    late = read_recording(tmp_path / "run.mcap")
    assert len(select_blocks(late.items, "meas")) == len(blocks)
    assert summarise_tracking(late, read_profile(recording)) is None


def test_the_report_has_a_section_with_its_figures(run: Run) -> None:
    _, recording, summary = run
    table = write_spectrum(recording, 1.2) | {"required_upper": np.inf, "damping": 0.025}
    profile = read_profile(recording, **table)
    folder = recording.path.parent
    tracking = summarise_tracking(recording, profile)
    summary.model_copy(update={"tracking": tracking}).write(folder / "summary.json")
    page = write_report(folder, recording).read_text()
    section = page[page.index('<section id="table_motion">') :]
    section = section[: section.index("</section>")]
    positions = [section.index(f'<figure id="{name}">') for name in MOTION_FIGURES]
    assert positions == sorted(positions)
    assert all(page.count(f'id="{name}"') == 1 for name in MOTION_FIGURES)
    numbers = [int(number) for number in re.findall(r"Figure (\d+)\.", page)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert "Required spectrum missed at 1" in section
    assert "allowed at least 0.9." in section
    assert "at 2.5 % damping" in section
    assert f"{summary.tracking.sa_count} ordinates" in section
