"""Recordings that nothing should be learned from, and what a user is told of them."""

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.records import SampleGap
from tests.builders.profiles import AT_1_KHZ_BY_50, UNCHECKED, format_test
from tests.builders.rigs import RIG_TEXT, read_model_text
from tests.builders.truths import hide_truth
from tests.input_errors import raises_input_error
from twin.discovery import task
from twin.discovery.build_verdict import REFITTED_SUFFIX
from twin.discovery.command import run_discovery, run_identification
from twin.discovery.discover import Discovery, prepare_problem
from twin.discovery.free_running import run_log_free
from twin.discovery.loading import load_logs
from twin.discovery.task import DiscoveredModel, discover
from twin.discovery.words import format_verdict
from twin.evidence.selection import Cancelled
from twin.exchange.import_table import ImportOptions, import_table
from twin.laws.library import EFFECTS
from twin.recording.reader import read_recording
from twin.setup.run_config import read_model_template, read_run_config
from twin.setup.unpaced import play_unpaced
from twin.system.exit_codes import EXIT_INTERRUPTED

TABLES = AT_1_KHZ_BY_50 | UNCHECKED | {"protection": {"sensor": "warn"}}
NOTHING_NAMED = [effect.id for effect in EFFECTS]  # left out: the verdict is quick


@dataclass(frozen=True)
class Made:
    """A log, its profile, and the channels that were recorded."""

    log: Path
    profile: Path


def record_run(
    folder: Path, truth: str = "", gap_mm: float = 4.0, laser_range_mm: float = 100.0
) -> Made:
    folder.mkdir()
    laser = 'channel = "mass_disp_m"\nunit = "mm"\nrange = '
    text = RIG_TEXT.replace(f"{laser}100.0", f"{laser}{laser_range_mm}")
    rig = folder / "rig.toml"
    rig.write_text(hide_truth(text, folder, truth))
    profile, log = folder / "p.toml", folder / f"{folder.name}.mcap"
    profile.write_text(format_test(2.8, 4.4, 0.8, gap_mm, TABLES, rig=rig, measured_cycles=None))
    play_unpaced(read_run_config(profile), folder.name, log, lambda: None, lambda item: None)
    return Made(log, profile)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Made:
    return record_run(tmp_path_factory.mktemp("bad") / "plain")


def change_log(
    source: Made, folder: Path, change: Callable[[str, Float1D], Float1D], trusted: str = ""
) -> Path:
    """The log of a table with other values in it; one channel may be taken as it is."""
    (piece,) = read_recording(source.log).contiguous_blocks("meas")
    columns = [change(name, piece.channel(name)) for name in piece.channels]
    table, log = folder / "table.csv", folder / "changed.mcap"
    rows = np.array([piece.time_s, *columns]).T
    head = ",".join(["time_s", *piece.channels])
    np.savetxt(table, rows, fmt="%.9g", delimiter=",", header=head, comments="")
    column_map = None
    if trusted:
        column_map = folder / "map.toml"
        column_map.write_text(
            f'[columns]\n{trusted} = {{ column = "{trusted}", trusted = true }}\n'
        )
    import_table(table, log, ImportOptions(profile=source.profile, columns=column_map))
    return log


def discover_from(logs: list[Path], model: str = "snm") -> DiscoveredModel:
    return discover(logs, model, NOTHING_NAMED)


@pytest.mark.parametrize("learn", [run_discovery, run_identification])
def test_a_log_counts_once_whatever_its_name(
    plain: Made, tmp_path: Path, learn: Callable[..., object]
) -> None:
    again = tmp_path / "again.mcap"
    shutil.copy(plain.log, again)
    out = tmp_path / ("out.toml" if learn is run_identification else "out")
    with raises_input_error(where=again, problem=plain.log):
        learn([plain.log, again], "snm", out)
    assert not out.exists()


def test_what_is_in_the_way_is_said_before_the_long_work(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("mine")
    with raises_input_error(key="--out", value=str(tmp_path)):
        run_discovery([tmp_path / "no.mcap"], "snm", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["there"]


def test_half_a_force_is_not_believed(plain: Made, tmp_path: Path) -> None:
    def dead(name: str, values: Float1D) -> Float1D:
        return 0.0 * values if name == "force_r1_n" else values

    (log,), notes = load_logs([change_log(plain, tmp_path, dead)])
    assert not {name for name in log.signals.channels if name.startswith("force_")}
    assert [text for text in notes if "force_r1_n is dead" in text and "all load cells" in text]
    (log,), notes = load_logs([plain.log])
    assert {"force_r1_n", "force_l2_n"} <= {*log.signals.channels}
    assert not notes


def test_a_load_cell_of_the_wrong_sign_is_refused(plain: Made, tmp_path: Path) -> None:
    def flip_sign(name: str, values: Float1D) -> Float1D:
        return -values if name == "force_l2_n" else values

    with pytest.raises(InputError, match="force_l2_n reads down to"):
        change_log(plain, tmp_path, flip_sign)
    log = change_log(plain, tmp_path, flip_sign, trusted="force_l2_n")
    with pytest.raises(InputError) as error:
        load_logs([log])
    assert error.value.key == "force_l2_n"


def test_lost_samples_are_counted(plain: Made, tmp_path: Path) -> None:
    def cut_holes(name: str, values: Float1D) -> Float1D:
        values = values.copy()
        values[3000:3070] = np.nan if name == "mass_acc_m_s2" else values[3000:3070]
        return values

    _, notes = load_logs([change_log(plain, tmp_path, cut_holes)])
    assert any("70 samples of mass_acc_m_s2 are lost" in text for text in notes)


def test_samples_beyond_the_range_of_a_sensor_are_not_used(plain: Made, tmp_path: Path) -> None:
    whole = np.abs(read_recording(plain.log).contiguous_blocks("meas")[0].channel("mass_disp_m"))
    range_m = 0.6 * whole.max()
    narrow = record_run(tmp_path / "narrow", laser_range_mm=1e3 * range_m)
    (log,), notes = load_logs([narrow.log])
    recording = read_recording(narrow.log)
    (piece,) = recording.contiguous_blocks("meas")
    # the tare moves the ends of the range by 0.08 mm
    at_end = np.abs(piece.channel("mass_disp_m")) > range_m + 0.7e-4
    assert at_end.sum() > 100
    count = sum(gap.count for gap in recording.records(SampleGap))
    assert any(f"{count} samples of mass_disp_m" in text for text in notes)
    assert not log.signals.good[at_end[:: log.signals.grid.decimation]].any()
    assert 0.2 < log.signals.good.mean() < 1.0


def test_bumpers_that_the_profile_does_not_know(tmp_path: Path) -> None:
    truth = "[base]\ngap_right_m = 0.002\ngap_left_m = 0.002\n"
    (log,), notes = load_logs([record_run(tmp_path / "touching", truth, math.inf).log])
    assert log.signals.gaps_m == pytest.approx((0.002, 0.002), rel=0.05)
    assert sum("the gap is not stated" in text for text in notes) == 1


@pytest.mark.slow  # a minute: every law is tried
def test_time_that_runs_backwards_is_no_model_and_no_crash(plain: Made, tmp_path: Path) -> None:
    log = change_log(plain, tmp_path, lambda _, values: values[::-1])
    result = discover_from([log])
    verdict, discovery = result.verdict, result.discovery
    sheet, steps = discovery.prepared.problem.log_residuals[0], load_logs([log])[0][0].steps
    assert steps
    assert run_log_free(sheet, steps, discovery.selection.null) is None  # no resonance to scale by
    assert verdict.verdict == "unexplained"
    assert any("damping = 0 " in text and "bound" in text for text in verdict.notes)


def test_agreement_with_other_parameters_is_not_agreement(tmp_path: Path) -> None:
    stiff = record_run(tmp_path / "stiff", "[base]\ndamper_stiffness_n_m = 72000.0\n")
    verdict = discover_from([stiff.log]).verdict
    assert verdict.verdict == "none"
    assert verdict.why.endswith(REFITTED_SUFFIX)
    assert "agrees only with other parameters" in format_verdict(verdict)


def test_an_effect_of_the_model_that_is_not_there_is_said(plain: Made, tmp_path: Path) -> None:
    text = read_model_text("snm")
    model = tmp_path / "more.toml"
    model.write_text(f'{text}[[effects]]\nid = "bumper_hardening"\nparameters = {{ k2 = 4e7 }}\n')
    verdict = discover_from([plain.log], str(model)).verdict
    assert verdict.verdict == "none"
    assert abs(verdict.base["bumper_hardening.k2"].value) < 4e6
    assert any("bumper_hardening" in text and "vanishes" in text for text in verdict.notes)
    assert not any("gap" in text for text in verdict.notes)


def test_enough_before_anything_leaves_nothing(
    plain: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(*_: object, **__: object) -> Discovery:
        raise Cancelled

    monkeypatch.setattr(task, "discover_effects", interrupt)
    assert run_discovery([plain.log], "snm", tmp_path / "out") == (None, EXIT_INTERRUPTED)
    assert not (tmp_path / "out").exists()


def test_motion_alone_says_nothing_of_forces(plain: Made, tmp_path: Path) -> None:
    def lose_all_but_displacements(name: str, values: Float1D) -> Float1D:
        return values if name.endswith("disp_m") else values * np.nan

    with pytest.raises(InputError) as error:
        load_logs([change_log(plain, tmp_path, lose_all_but_displacements)])
    assert "mass_acc_m_s2" in error.value.allowed


def test_a_fault_of_a_sensor_is_no_candidate_for_a_force(tmp_path: Path) -> None:
    (log,), _ = load_logs([record_run(tmp_path / "flight", gap_mm=math.inf).log])
    library = prepare_problem([log], read_model_template("snm")[0]).problem.library
    names = {candidate.name for candidate in library}
    assert "cubic_stiffness" in names
    assert not {"bumper_hardening", "mass_error"} & names
    assert not any(name.startswith("sensor_") for name in names)
