"""`calibrate`: what is applied, what it gives, the record that is left, and where that goes."""

import builtins
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import MachineLost
from table_io.block import Float1D, Float2D
from table_io.clock import Clock, ManualClock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.calibration import MeanVoltage, mean_voltage
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig
from table_io.config.sensor import CalibrationRecord
from table_io.errors import InputError
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import RIG_TEXT
from tests.command_line import invoke
from tests.input_errors import raises_input_error
from twin.rig import calibrate as command
from twin.setup.run_config import read_run_config

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
        RIG_TEXT.replace(LASER, LASER + 'serial = "L 7"\nshunt = 5.0\nshunt_tolerance = 0.05\n')
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
        return invoke("calibrate", channel, "--table", "mine.toml", *words)

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
    mended = RIG_TEXT.replace("volts_per_unit = 0.13333333333333333", "").replace(
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


CARD = parse_toml(RIG_TEXT, RigConfig, "card").sensors[2]
ASKED = command.CalibrationOptions(CARD.channel, "simulated", "0,1")


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_the_departure_in_standard_deviations_has_the_sign_of_that_in_per_cent(
    turned: float,
) -> None:
    sensor = CARD.model_copy(update={"volts_per_unit": turned * CARD.volts_per_unit})
    means = (MeanVoltage(0.0, 1e-3), MeanVoltage(turned * 5.5, 1e-3))
    record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
    assert record.departure_percent == pytest.approx(10.0)
    assert record.departure_sd == pytest.approx(0.5 / (np.sqrt(2) * 1e-3))


@pytest.mark.parametrize("turned", [1.0, -1.0])
def test_a_converter_that_stood_still_is_not_exact(turned: float) -> None:
    """Each point counts with a step / sqrt(12) at least."""
    sensor = CARD.model_copy(update={"bits": 16, "volts_per_unit": turned * CARD.volts_per_unit})
    step = sensor.lsb * CARD.volts_per_unit
    for sd in (0.0, 1e-9):
        means = (MeanVoltage(0.0, 0.0), MeanVoltage(5.0 * turned, sd))
        record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
        assert record.volts_per_unit_sd == pytest.approx(step * np.sqrt(2 / 12), rel=1e-6)
    means = (MeanVoltage(0.0, 0.0), MeanVoltage(5.0 * turned, 0.05))
    record = command.make_calibration(sensor, ASKED, (0.0, 1.0), means)
    assert record.volts_per_unit_sd == pytest.approx(0.05, rel=1e-3)


@pytest.mark.parametrize("turned", [1.0, -1.0])
@pytest.mark.parametrize("departure", [-2.1, -1.9, -0.1, 0.0, 0.1, 1.9, 2.1])
@pytest.mark.parametrize("shunt", [None, 1.5, -1.5])
def test_a_departure_to_either_side_is_compared_with_the_tolerance(
    shunt: float | None, departure: float, turned: float
) -> None:
    """2 per cent: asked for, or the tolerance of the shunt over its size."""
    nominal = turned * CARD.volts_per_unit
    changes = {"volts_per_unit": nominal, "shunt": shunt, "shunt_tolerance": 0.03}
    request = replace(ASKED, shunt=shunt is not None, tolerance_percent=2.0, applied_sd=1e-6)
    applied = (0.0, shunt or 1.0)
    means = tuple(MeanVoltage(nominal * (1 + departure / 100) * (x + 0.1), 1e-4) for x in applied)
    record = command.make_calibration(CARD.model_copy(update=changes), request, applied, means)
    assert record.tolerance_percent == pytest.approx(2.0)
    assert record.passed == (abs(departure) < 2.0)
    assert record.departure_percent == pytest.approx(departure, abs=1e-9)
    expected_sd = departure / 100 * abs(nominal) / record.volts_per_unit_sd
    assert record.departure_sd == pytest.approx(expected_sd, abs=1e-6)
    assert record.offset == pytest.approx(0.1)
    assert (record.applied, record.applied_sd) == (applied, 1e-6)
    assert record.volts == tuple(mean.volts for mean in means)
    assert record.volts_sd == (1e-4, 1e-4)
    assert (record.card_volts_per_unit, record.serial) == (nominal, CARD.serial)
    assert record.method == ("points" if shunt is None else "shunt")


@pytest.mark.parametrize("turned", [1.0, -1.0])
@pytest.mark.parametrize("applied", [(0.0, 1.0, 0.5), (0.5, 1.0, 0.0), (1.0, 0.5, 0.0)])
@pytest.mark.parametrize("largest_error", ["noise", "converter"])
def test_readings_must_differ_by_ten_errors(
    largest_error: str, applied: tuple[float, ...], turned: float
) -> None:
    """From the smallest to the largest applied value, in the largest error of any point."""
    sensor = CARD.model_copy(update={"volts_per_unit": turned * CARD.volts_per_unit, "bits": 8})
    step = 2.0 * CARD.range * CARD.volts_per_unit / 256.0
    error = 2.0 * step if largest_error == "noise" else step
    for ratio in (-10.001, -9.999, 9.999, 10.001):
        means = tuple(
            MeanVoltage(3.0 + ratio * error * x, error if place == 1 and error > step else 0.0)
            for place, x in enumerate(applied)
        )
        if abs(ratio) > 10.0:
            command.make_calibration(sensor, ASKED, applied, means)
            continue
        with raises_input_error(where=CARD.channel):
            command.make_calibration(sensor, ASKED, applied, means)


def test_readings_that_differ_by_exactly_ten_errors_are_refused() -> None:
    means = (MeanVoltage(0.0, 0.25), MeanVoltage(2.5, 0.25))
    with raises_input_error(where=CARD.channel):
        command.make_calibration(CARD, ASKED, (0.0, 1.0), means)


@dataclass
class Inputs:
    """A machine that only reads: `volts` of one channel, the others are large."""

    channel: str
    volts: Float1D
    rate_hz: float = 500.0
    calls: list[object] = field(default_factory=list)

    def open(self) -> None:
        self.calls.append("open")

    def tare(self, samples: int) -> Float2D:
        self.calls.append(samples)
        rig = parse_toml(RIG_TEXT, RigConfig, "card")
        rows = [self.volts if name == self.channel else self.volts + 1e3 for name in rig.channels]
        return np.array(rows)

    def close(self) -> None:
        self.calls.append("close")


@pytest.mark.parametrize("turned", [1.0, -1.0])
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("share", [0.5, 0.9985, 0.9995, 1.2])
def test_one_clipped_sample_is_refused_on_either_side(
    share: float, sign: float, turned: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = parse_toml(RIG_TEXT, RigConfig, "card")
    sensor = CARD.model_copy(update={"volts_per_unit": turned * CARD.volts_per_unit})
    volts = np.full(500, 0.1)
    volts[:5] = np.nan
    volts[77] = sign * share * CARD.range * CARD.volts_per_unit
    machine = Inputs(CARD.channel, volts)
    monkeypatch.setattr(command, "make_machine", lambda *_: machine)
    if share < 0.999:
        mean = command._measure_mean(rig, sensor, "applied")
        assert mean == mean_voltage(volts)
    else:
        with raises_input_error(where="applied", allowed=f"{CARD.range:g}"):
            command._measure_mean(rig, sensor, "applied")
    assert machine.calls == ["open", 500, "close"]


@pytest.mark.parametrize("unattended", [True, False])
def test_a_person_presses_enter_and_an_unattended_table_waits(
    unattended: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = ManualClock(3.0)
    prompts: list[str] = []
    monkeypatch.setattr(command, "RealClock", lambda: clock)
    monkeypatch.setattr(builtins, "input", prompts.append)
    (command.wait_for_table if unattended else command.ask_person)("apply 1 g")
    assert clock.now() == (8.0 if unattended else 3.0)
    assert len(prompts) == (0 if unattended else 1)


def test_without_a_terminal_nobody_can_be_prompted(monkeypatch: pytest.MonkeyPatch) -> None:
    def end(_: str) -> str:
        raise EOFError

    monkeypatch.setattr(builtins, "input", end)
    with raises_input_error(remedy="--unattended"):
        command.ask_person("apply 1 g")


@pytest.mark.parametrize(
    ("changes", "applied"),
    [
        ({"points": "-2,2"}, (-2.0, 2.0)),  # the whole range
        ({"points": "2,-2,0,0"}, (2.0, -2.0, 0.0, 0.0)),
        ({"points": "1,1.004"}, (1.0, 1.004)),  # a thousandth of 2 g is the least
        ({"points": "1,1.0019"}, None),
        ({"points": "0,2.001"}, None),
        ({"points": "-2.001,0"}, None),
        ({"points": "1,1"}, None),
        ({"points": "0,1", "applied_sd": 2.0}, (0.0, 1.0)),
        ({"points": "0,1", "applied_sd": 2.1}, None),
        ({"points": "0,1", "applied_sd": -1e-9}, None),
        ({"points": "0,1", "tolerance_percent": 1e-6}, (0.0, 1.0)),
        ({"points": "0,1", "tolerance_percent": 0.0}, None),
        ({"points": "0,1", "tolerance_percent": -1.0}, None),
        ({"points": "", "shunt": True}, (0.0, -1.5)),
        ({"points": "0,1", "shunt": True}, None),
        ({"points": "", "shunt": True, "tolerance_percent": 1.0}, None),
    ],
)
def test_points_are_planned_within_their_bounds(
    changes: dict[str, object], applied: tuple[float, ...] | None
) -> None:
    sensor = CARD.model_copy(update={"shunt": -1.5, "shunt_tolerance": 0.03, "range": 2.0})
    request = replace(ASKED, **changes)  # type: ignore[arg-type]
    if applied is None:
        with pytest.raises(InputError):
            command._plan_points(request, sensor)
        return
    planned, prompts = command._plan_points(request, sensor)
    assert planned == applied
    assert len(prompts) == len(applied)


def test_the_least_span_is_a_thousandth_of_the_range() -> None:
    sensor = CARD.model_copy(update={"range": 1024.0})  # a thousandth, exactly as computed
    least = 1e-3 * 1024.0
    command._check_span((0.0, least), sensor, "--points")
    with raises_input_error(where="--points", allowed="1.024"):
        command._check_span((0.0, np.nextafter(least, 0.0)), sensor, "--points")


def test_the_tolerance_is_one_per_cent_unless_asked_for() -> None:
    assert ASKED.tolerance == 1.0
    assert replace(ASKED, tolerance_percent=0.3).tolerance == 0.3


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
