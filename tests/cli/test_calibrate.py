"""`calibrate`: what is applied, what it gives, the record that is left, and where that goes."""

import builtins
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from table_io.backends import MachineLost
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.calibration_fit import MeanVoltage
from table_io.config.calibration_record import CalibrationRecord
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig
from table_io.sim.simulated_table import SimulatedBackend
from tests.input_errors import raises_input_error
from twin.cli import calibrate as command
from twin.cli.main import app
from twin.run.run_config import read_run_config

TEXT = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")
LASER = 'channel = "table_disp_m"\nunit = "mm"\n'
SENSITIVITY, ZERO = 0.1340, 0.2  # V/mm, and in mm what it shows at 0; the card says 2/15 V/mm


class Applied(SimulatedBackend):
    """A table whose laser sees what a person has put before it; nothing may be played."""

    mm = 0.0
    gone = False

    def tare(self, samples: int) -> Float2D:
        if self.gone:
            raise MachineLost("the cable is out; put it in")
        volts = super().tare(samples)
        noise = volts[1] - volts[1].mean()
        volts[1] = np.clip(SENSITIVITY * (Applied.mm + ZERO) + noise, -10.0, 10.0)
        return volts

    def queue(self, index: int, volts: Float1D) -> None:
        raise AssertionError("a calibration plays nothing")

    start = None  # type: ignore[assignment]


Calibrate = Callable[..., tuple[int, str]]


@pytest.fixture
def calibrate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Calibrate]:
    """`calibrate table_disp_m --table mine.toml ...`; the person applies what the prompt says."""
    (tmp_path / "mine.toml").write_text(
        TEXT.replace(LASER, LASER + 'serial = "L 7"\nshunt = 5.0\nshunt_tolerance = 0.05\n')
    )
    monkeypatch.chdir(tmp_path)

    def open_backend(rig: RigConfig, clock: Clock) -> SimulatedBackend:
        return Applied(rig, Specimen(mass_kg=1.0, gap_mm=4.0), 2000.0, clock)

    def person(prompt: str) -> str:
        words = prompt.split()
        Applied.mm = float(words[1]) if words[0] == "apply" else 5.0 * (words[5] == "on,")
        return ""

    monkeypatch.setattr(command, "make_machine", open_backend)
    monkeypatch.setattr(builtins, "input", person)

    def run(*words: str, channel: str = "table_disp_m") -> tuple[int, str]:
        result = CliRunner().invoke(app, ["calibrate", channel, "--table", "mine.toml", *words])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.stdout

    yield run
    Applied.mm, Applied.gone = 0.0, False


def records(folder: Path) -> list[CalibrationRecord]:
    return [
        CalibrationRecord.model_validate(entry)
        for path in sorted((folder / "mine.calibrations").glob("*.toml"))
        for entry in tomllib.loads(path.read_text())["calibrations"]
    ]


def test_two_points_give_sensitivity_offset_and_a_record(
    calibrate: Calibrate, tmp_path: Path
) -> None:
    code, text = calibrate("--points", "0,10")
    (record,) = records(tmp_path)
    assert code == 0
    assert record.passed
    assert record.volts_per_unit == pytest.approx(SENSITIVITY, abs=5 * record.volts_per_unit_sd)
    assert record.offset == pytest.approx(ZERO, abs=5 * record.offset_sd)
    # 0.005 mm of noise, 2000 samples at each of two points 10 mm apart
    expected = SENSITIVITY * 0.005 / np.sqrt(2000) * np.sqrt(2) / 10.0
    assert record.volts_per_unit_sd == pytest.approx(expected, rel=0.6)
    assert record.departure_percent == pytest.approx(100 * (SENSITIVITY * 7.5 - 1), abs=0.01)
    assert (record.serial, record.unit, record.applied) == ("L 7", "mm", (0.0, 10.0))
    assert "pass" in text
    assert f"volts_per_unit = {record.volts_per_unit!r}" in text
    # what is printed for the card is valid there, and edits nothing by itself
    lines = text[text.index("volts_per_unit = ") :].splitlines()
    mended = TEXT.replace("volts_per_unit = 0.13333333333333333", "").replace(
        "offset = 0.12", "\n".join(lines)
    )
    assert (
        parse_toml(mended, RigConfig, "mended").sensors[1].volts_per_unit == record.volts_per_unit
    )
    assert "0.13333333333333333" in (tmp_path / "mine.toml").read_text()


def test_the_record_goes_into_every_recording_from_then_on(
    calibrate: Calibrate, tmp_path: Path
) -> None:
    calibrate("--points", "0,10")
    bundle = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml", "mine.toml")
    (record,) = bundle.rig.calibrations
    assert record == records(tmp_path)[0]
    start = bundle.make_start_factory("run", "table")({}, 0.0)
    assert parse_toml(start.rig_toml, RigConfig, "as recorded").calibrations == (record,)


def test_beyond_the_tolerance_it_fails_and_says_by_how_much(
    calibrate: Calibrate, tmp_path: Path
) -> None:
    code, text = calibrate("--points", "0,10", "--tolerance", "0.3")
    assert code == 2
    assert "+0.5" in text
    assert "FAIL" in text
    assert not records(tmp_path)[0].passed


def test_more_points_tell_linearity_and_an_uncertain_reference_widens(
    calibrate: Calibrate, tmp_path: Path
) -> None:
    calibrate("--points=-10,0,10", "--applied-sd", "0.1")
    (record,) = records(tmp_path)
    assert record.linearity_percent is not None
    assert record.linearity_percent < 0.01
    assert record.volts_per_unit_sd / SENSITIVITY == pytest.approx(0.1 / np.sqrt(200), rel=0.01)


def test_a_shunt_is_two_points_with_the_tolerance_of_its_card(
    calibrate: Calibrate, tmp_path: Path
) -> None:
    code, text = calibrate("--shunt")
    (record,) = records(tmp_path)
    assert (record.method, record.applied) == ("shunt", (0.0, 5.0))
    assert record.tolerance_percent == pytest.approx(1.0)
    assert code == 0, text


def test_a_second_record_lies_beside_the_first(
    calibrate: Calibrate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calibrate("--points", "0,10", "--out", "first.toml")
    with raises_input_error(where="first.toml", remedy="--out"):
        calibrate("--points", "0,10", "--out", "first.toml")
    calibrate("--points", "0,10")
    assert len(records(tmp_path)) == 1
    assert (tmp_path / "first.toml").exists()
    assert load_rig(tmp_path / "mine.toml")[0].calibrations == tuple(records(tmp_path))


@pytest.mark.parametrize(
    ("words", "channel", "fields"),
    [
        ((), "table_disp_m", {"where": "--points", "allowed": "two different numbers in mm"}),
        (("--points", "10"), "table_disp_m", {"where": "--points 10"}),
        (("--points", "10,10"), "table_disp_m", {"where": "--points 10,10"}),
        (("--points", "0,ten"), "table_disp_m", {"where": "--points 0,ten"}),
        (("--points", "0,nan"), "table_disp_m", {"where": "--points 0,nan"}),
        (("--points", "0,76"), "table_disp_m", {"where": "--points 0,76", "allowed": "+-75"}),
        (("--points", "0,10", "--tolerance", "0"), "table_disp_m", {"where": "--tolerance 0"}),
        (("--points", "0,10", "--applied-sd", "nan"), "table_disp_m", {"allowed": "0 to 75 mm"}),
        (("--points", "0,10", "--tolerance", "inf"), "table_disp_m", {"where": "--tolerance inf"}),
        (("--points", "0,10", "--applied-sd", "1e200"), "table_disp_m", {"allowed": "0 to 75 mm"}),
        (("--points", "1.0,1.00000001"), "table_disp_m", {"allowed": "0.075 mm"}),
        (("--shunt", "--tolerance", "1"), "table_disp_m", {"where": "--tolerance"}),
        (("--points", "0,1", "--shunt"), "table_disp_m", {"where": "--points"}),
        (("--shunt",), "mass_disp_m", {"where": "--shunt", "remedy": "shunt_tolerance"}),
        (("--points", "0,10"), "tabel_disp_m", {"remedy": "'table_disp_m'"}),
        (("--points", "0,10", "--out", "/proc/none/x"), "table_disp_m", {"where": "/proc/none/x"}),
        (("--points", "0,74.9"), "table_disp_m", {"allowed": "+-75 mm"}),
        (("--points", "0,10"), "mass_disp_m", {"where": "mass_disp_m"}),
    ],
)
def test_what_cannot_be_is_refused_and_leaves_no_record(
    words: tuple[str, ...],
    channel: str,
    fields: dict[str, str],
    calibrate: Calibrate,
    tmp_path: Path,
) -> None:
    with raises_input_error(**fields):
        calibrate(*words, channel=channel)
    assert records(tmp_path) == []


CARD = parse_toml(TEXT, RigConfig, "card").sensors[2]
ASKED = command.CalibrationRequest(CARD.channel, "simulated", "0,1", False, None, 0.0, True, None)


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_the_departure_in_standard_deviations_has_the_sign_of_that_in_per_cent(
    turned: float,
) -> None:
    sensor = CARD.model_copy(update={"volts_per_unit": turned * CARD.volts_per_unit})
    means = (MeanVoltage(0.0, 1e-3), MeanVoltage(turned * 5.5, 1e-3))
    record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
    assert record.departure_percent == pytest.approx(10.0)
    assert record.departure_sd == pytest.approx(0.5 / (np.sqrt(2) * 1e-3))


def test_a_converter_that_stood_still_is_not_exact() -> None:
    """Each point counts with a step / sqrt(12) at least."""
    sensor = CARD.model_copy(update={"bits": 16})
    step = sensor.lsb * sensor.volts_per_unit
    for sd in (0.0, 1e-9):
        means = (MeanVoltage(0.0, 0.0), MeanVoltage(5.0, sd))
        record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
        assert record.volts_per_unit_sd == pytest.approx(step * np.sqrt(2 / 12), rel=1e-6)
    means = (MeanVoltage(0.0, 0.0), MeanVoltage(5.0, 0.05))
    record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
    assert record.volts_per_unit_sd == pytest.approx(0.05, rel=1e-3)


def test_no_record_is_written_into_the_installed_package(calibrate: Calibrate) -> None:
    folder = PROFILES_DIR / "rigs"
    before = sorted(folder.rglob("*"))
    with raises_input_error(key="--table", value="simulated"):
        calibrate("--points", "0,10", "--table", "simulated")
    assert calibrate("--points", "0,10", "--table", "simulated", "--out", "mine.record")[0] == 0
    assert sorted(folder.rglob("*")) == before


def test_a_machine_that_is_lost_is_said(calibrate: Calibrate) -> None:
    Applied.gone = True
    with raises_input_error(
        where="apply 0 mm to table_disp_m", problem="the cable is out; put it in"
    ):
        calibrate("--points", "0,10")
