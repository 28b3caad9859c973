"""Kind record: its file is read, scaled, resampled and attached, and every fault of it is named."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.config.base import parse_toml
from table_io.config.excitation.record import RecordedHistory, SeriesRequest, read_series, resample
from table_io.config.profile import MAX_FILE_BYTES, Profile, load_profile
from table_io.errors import InputError
from table_io.excitation.trajectory import plan_excitation
from table_io.safety.preflight import check_limits, compute_demands
from tests.builders.profiles import RECORD_TOML
from tests.builders.rigs import RIG
from tests.input_errors import raises_input_error

RATE_HZ = 100.0
DURATION_S = 8.0


def motion_mm(time_s: Float1D) -> Float1D:
    """5 mm at 1 Hz and 1 mm at 4 Hz in a sin^2 envelope."""
    envelope = np.where((time_s > 0) & (time_s < DURATION_S), np.sin(np.pi * time_s / 8) ** 2, 0.0)
    waves = 5 * np.sin(2 * np.pi * time_s) + np.sin(2 * np.pi * 4 * time_s)
    return np.asarray(envelope * waves)


def csv(
    rate_hz: float = RATE_HZ,
    header: str = "time_s,disp_mm",
    motion: Callable[[Float1D], Float1D] = motion_mm,
) -> str:
    t = np.arange(round(DURATION_S * rate_hz) + 1) / rate_hz
    rows = zip(t.tolist(), motion(t).tolist(), strict=True)
    return "\n".join(["# a comment", header, *(f"{s:.9f},{d:.9f}" for s, d in rows), ""])


def write(folder: Path, text: str, more: str = "", file: str = "motion.csv") -> Path:
    (folder / file).write_text(text)
    (folder / "test.toml").write_text(RECORD_TOML + more)
    return folder / "test.toml"


def history(path: Path) -> tuple[Float1D, Float1D, Profile]:
    """Time in the file and displacement, without the blends and the padding on either side."""
    profile, _ = load_profile(path)
    excitation = profile.excitation
    assert isinstance(excitation, RecordedHistory)
    rate_hz = profile.acquisition.rate_hz
    lead_s = excitation.blend_s + 32 / excitation.samples[1]
    played = profile.plan.history_m
    time_s = np.arange(played.size) / rate_hz - lead_s
    inside = (time_s >= 0) & (time_s < DURATION_S)
    return time_s[inside], played[inside], profile


@pytest.mark.parametrize("file_hz", [64.0, 100.0, 128.0, 500.0, 2000.0, 5000.0])
@pytest.mark.parametrize("rig_hz", [1000.0, 2000.0])
def test_history_is_that_of_the_file_at_the_rate_of_the_rig(
    file_hz: float, rig_hz: float, tmp_path: Path
) -> None:
    path = write(tmp_path, csv(file_hz), f"[acquisition]\nrate_hz = {rig_hz}\n")
    t, played, _ = history(path)
    assert t.size == pytest.approx(DURATION_S * rig_hz, abs=1)
    assert np.abs(1e3 * played - motion_mm(t)).max() < 1e-4


def test_falling_rate_leaves_no_alias() -> None:
    t = np.arange(4000) / 1000.0
    envelope = np.sin(np.pi * t / 4) ** 4
    assert np.abs(resample(envelope * np.sin(2 * np.pi * 80 * t), 1000.0, 100.0)).max() < 1e-5
    kept = resample(envelope * np.sin(2 * np.pi * 30 * t), 1000.0, 100.0)
    assert np.abs(kept - (envelope * np.sin(2 * np.pi * 30 * t))[::10]).max() < 1e-5


@pytest.mark.parametrize(
    ("header", "keys", "factor"),
    [
        ("time_s,disp_mm", "", 1.0),
        ("time_s, d_m", "scale = 1e-3", 1.0),
        ("time_s,x", 'unit = "cm"\nscale = -0.1', -1.0),
        ("time_s,x_in", "scale = 0.1", 2.54),
        ("time_s,drive_disp_mm", 'unit = "mm"\nscale = 2.0', 2.0),
    ],
)
def test_unit_and_scale_are_applied(header: str, keys: str, factor: float, tmp_path: Path) -> None:
    t, played, _ = history(write(tmp_path, csv(header=header), keys))
    assert np.abs(1e3 * played - factor * motion_mm(t)).max() < 1e-3 * abs(factor)


def test_record_in_motion_at_its_ends_is_blended_in_and_out(tmp_path: Path) -> None:
    def cosine(t: Float1D) -> Float1D:
        return 3.0 + np.cos(2 * np.pi * 0.5 * t + 0.3)

    path = write(tmp_path, csv(motion=cosine), "blend_s = 2.0\n")
    t, played, profile = history(path)
    middle = slice(2000, -2000)
    assert np.abs(1e3 * played - cosine(t))[middle].max() < 1e-3
    drive = plan_excitation(profile)
    command = drive.command(0, drive.planned_end + 100)
    assert np.abs(np.diff(command)).max() * 2000.0 < 0.01  # m/s: 4 mm in 2 s, no jump
    assert np.abs(np.diff(command, 2)).max() * 2000.0**2 < 0.2


def faulty(line: int, text: str) -> str:
    lines = csv().splitlines()
    lines[line - 1] = text
    return "\n".join(lines)


@pytest.mark.parametrize(
    ("text", "more", "key", "words"),
    [
        (faulty(40, "0.37,nan"), "", "excitation.file", ("motion.csv: row 40",)),
        (faulty(40, "0.3745,1.0"), "", "excitation.file", ("motion.csv: row 40", "0.01 s")),
        (faulty(2, "time_s,disp"), "", "excitation.file", ("motion.csv", "'disp'")),
        (csv(), 'unit = "km"', "excitation.unit", ("'km'", "'mm'")),
        (csv(), "scale = 0.0", "excitation.scale", ()),
        (csv(), "blend_s = 0.0", "excitation.blend_s", ("0.1",)),
        (csv(), "windows = 0", "excitation.windows", ()),
        (csv(), "scal = 2.0", "excitation.scal", ("'scale'",)),
        (csv(), "[dwell]\ncycles = 3", "dwell", ("'record'",)),
        (csv(), "[control]\ngain = 0.5", "control", ("'record'",)),
        (csv(), '[resume]\nfirst_step = 0\nof = "x"', "resume", ("'record'",)),
        (csv(), "[sweep]\nstart_hz = 1.0", "file", ("[sweep]", "[excitation]")),
    ],
)
def test_fault_of_the_profile_or_its_file_is_named(
    text: str, more: str, key: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    with raises_input_error(where=str(tmp_path / "test.toml")) as refusal:
        load_profile(write(tmp_path, text, more))
    (fault,) = refusal.value.faults
    assert fault.key == key
    assert all(word in str(fault) for word in words), fault


@pytest.mark.parametrize("name", ["recrod", 3, [1.0]])
def test_unknown_kind_is_refused_with_the_known_ones(name: object, tmp_path: Path) -> None:
    path = write(tmp_path, csv())
    path.write_text(path.read_text().replace('"record"', repr(name)))
    with pytest.raises(InputError) as refusal:
        load_profile(path)
    (fault,) = refusal.value.faults
    assert "record" in fault.remedy
    assert (fault.remedy == "did you mean 'record'?") == (name == "recrod")


def test_missing_file_is_named(tmp_path: Path) -> None:
    path = write(tmp_path, csv(), file="other.csv")
    with raises_input_error(key="excitation.file", value="motion.csv", where=str(path)):
        load_profile(path)


def test_file_too_large_to_travel_with_the_profile_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, csv() + "#" * MAX_FILE_BYTES)
    with raises_input_error(where=str(tmp_path / "motion.csv"), allowed="2 MB"):
        load_profile(path)


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ('[excitation]\nkind = "record"\nfile = "motion.csv"', "[x]\n", csv()),
        ("", "", csv() + "# '''"),
    ],
)
def test_file_that_cannot_be_attached_is_refused(
    old: str, new: str, text: str, tmp_path: Path
) -> None:
    path = write(tmp_path, text)
    inline = 'excitation = {kind = "record", file = "motion.csv"}\n'
    if old:
        path.write_text(inline + path.read_text().replace(old, ""))
    with raises_input_error(where=str(path), key="excitation"):
        load_profile(path)


def test_text_of_a_profile_holds_its_file(tmp_path: Path) -> None:
    path = write(tmp_path, csv())
    profile, text = load_profile(path)
    (tmp_path / "motion.csv").unlink()
    again = parse_toml(text, Profile, "recorded")
    assert again == profile
    assert again.plan.history_m.tobytes() == profile.plan.history_m.tobytes()
    path.write_text(text)
    assert load_profile(path) == (profile, text)


def test_text_without_its_file_is_refused() -> None:
    with pytest.raises(InputError) as refusal:
        parse_toml(RECORD_TOML, Profile, "some/test.toml")
    assert [fault.key for fault in refusal.value.faults] == ["excitation.file"]


def test_band_beyond_that_of_the_rig_is_refused(tmp_path: Path) -> None:
    text = csv(motion=lambda t: motion_mm(t) * np.sin(2 * np.pi * 25 * t))
    profile, _ = load_profile(write(tmp_path, text, "scale = 0.01\n"))
    rows = compute_demands(plan_excitation(profile), profile, RIG)
    with pytest.raises(InputError) as refusal:
        check_limits(rows, profile, RIG, "test")
    allowed = {fault.key: fault.allowed for fault in refusal.value.faults}
    assert allowed["upper end of the excitation's band"] == "at most 20"


def test_drive_file_of_this_program_is_a_record() -> None:
    series = read_series(
        "# shaketwin drive of x\n# unit mm\ntime_s,drive_disp_mm\n"
        + "".join(f"{k / 2000:.7f},{k:.9f}\n" for k in range(20)),
        "x.csv",
        SeriesRequest(),
    )
    assert series.rate_hz == pytest.approx(2000.0, rel=1e-6)
    assert series.values.tolist() == pytest.approx([k * 1e-3 for k in range(20)])


def test_other_parts_ask_for_a_sweep_in_one_message(tmp_path: Path) -> None:
    profile, _ = load_profile(write(tmp_path, csv()))
    with raises_input_error(key="excitation.kind", value="record", allowed="stepped_sine"):
        _ = profile.sweep
