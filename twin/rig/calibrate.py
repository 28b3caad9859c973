"""`shaketwin calibrate`: measure a sensor's sensitivity and compare it with its config.

The inputs are read as for a tare; no command is queued and no output is started.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.backends import MachineLost
from table_io.block import Float1D
from table_io.clock import RealClock, local_datetime
from table_io.config.base import PROFILES_DIR
from table_io.config.calibration import MeanVoltage, fit_calibration, mean_voltage
from table_io.config.folders import find_config
from table_io.config.rig import RigConfig
from table_io.config.rig_file import calibrations_dir, load_rig
from table_io.config.sensor import CalibrationRecord, SensorConfig, format_calibration_toml
from table_io.errors import InputError, suggest
from twin.rig.check_table import make_machine
from twin.security.access_control import user_name
from twin.system.exit_codes import EXIT_FAILED
from twin.system.terminal import print_line

MEASURING_S, PAUSE_S = 1.0, 5.0
MAX_RANGE_SHARE = 0.999  # of the range; above it a reading counts as clipped
DEFAULT_TOLERANCE_PERCENT = 1.0  # of the departure in sensitivity
MIN_SPAN_SHARE = 1e-3  # of the range, to be spanned by the applied values
MIN_SPAN_SIGMA = 10.0  # standard errors, to be spanned by the readings


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """Channel and rig of a sensor, and how it is calibrated: by applied values or its shunt.

    `points`: applied values in the unit of the channel, separated by commas, and `applied_sd` their
    standard uncertainty. `tolerance_percent`: of the sensitivity; None: the default, or that of the
    shunt. `out`: the record; None: next to the rig file.
    """

    channel: str
    table: str
    points: str = ""
    shunt: bool = False
    tolerance_percent: float | None = None
    applied_sd: float = 0.0
    out: Path | None = None

    @property
    def tolerance(self) -> float:
        """Allowed departure of the sensitivity in per cent, for a calibration by points."""
        return (
            DEFAULT_TOLERANCE_PERCENT if self.tolerance_percent is None else self.tolerance_percent
        )


@dataclass(frozen=True, eq=False)
class CalibratedSensor:
    """Record of a calibration, its file, and the sensor as the rig file states it."""

    record: CalibrationRecord
    path: Path
    sensor: SensorConfig


def calibrate(
    options: CalibrationOptions,
    ask: Callable[[str], None],
    tell: Callable[[str], None] = lambda sentence: None,
) -> CalibratedSensor:
    """Measure the sensitivity of a sensor; write the record and compare it with the rig file.

    `ask` is told what to apply, and returns when it is applied; `tell` gets each reading. No output
    is started. InputError if the sensor does not respond to what is applied.
    """
    path = find_config(options.table, "rigs", option="--table")
    rig, _ = load_rig(path)
    sensor = next(
        (candidate for candidate in rig.sensors if candidate.channel == options.channel), None
    )
    if sensor is None:
        raise InputError(
            f"rig {rig.name} has no sensor of this channel",
            where=options.channel,
            remedy=suggest(options.channel, rig.channels),
        )
    applied, prompts = _plan_points(options, sensor)
    name = f"{local_datetime():%Y%m%d-%H%M%S}-{sensor.channel}"
    record_path = choose_record_path(path, calibrations_dir(path), name, options.table, options.out)
    means = []
    for prompt in prompts:
        ask(prompt)
        means.append(_measure_mean(rig, sensor, prompt))
        tell(f"  {means[-1].volts:.6g} V +- {means[-1].sd:.2g} V")
    record = make_calibration(sensor, options, applied, tuple(means))
    write_record(record_path, format_calibration_toml(record))
    return CalibratedSensor(record, record_path, sensor)


def choose_record_path(
    rig_path: Path, folder: Path, name: str, table: str, out: Path | None
) -> Path:
    """Return the file of a new record of a rig: `out`, or `name`.toml in a folder next to the rig.

    InputError if it exists, or if the rig file is one that comes with shaketwin.
    """
    if out is None and rig_path.resolve().is_relative_to(PROFILES_DIR):
        raise InputError(
            "this rig file comes with shaketwin; records are kept next to a rig file of your own",
            key="--table",
            value=table,
            remedy="make one with `shaketwin new rig FILE`, or name a file with --out",
        )
    record_path = out or folder / f"{name}.toml"
    if record_path.exists():
        raise InputError(
            "exists; records are never overwritten",
            where=record_path,
            remedy="give the name of a new file with --out",
        )
    return record_path


def print_calibration(options: CalibrationOptions, unattended: bool) -> int:
    """Calibrate a sensor and print the record; return 0, or 2 if out of tolerance."""
    ask = wait_for_table if unattended else ask_person
    calibrated = calibrate(options, ask, print_line)
    _print_record(calibrated.record, calibrated.sensor, calibrated.path)
    return 0 if calibrated.record.passed else EXIT_FAILED


def _plan_points(
    options: CalibrationOptions, sensor: SensorConfig
) -> tuple[tuple[float, ...], list[str]]:
    """Return (applied values in the sensor's unit, prompts to the operator), by point."""
    if not 0 < options.tolerance < math.inf:
        raise InputError(
            "out of range", where=f"--tolerance {options.tolerance:g}", allowed="above 0 %"
        )
    if not 0 <= options.applied_sd <= sensor.range:
        raise InputError(
            "out of range",
            where=f"--applied-sd {options.applied_sd:g}",
            allowed=f"0 to {sensor.range:g} {sensor.unit}, the range of the sensor",
        )
    if options.shunt:
        if options.tolerance_percent is not None:
            raise InputError(
                "does not apply to a shunt calibration",
                where="--tolerance",
                remedy="omit it: shunt_tolerance in the [[sensors]] table of the rig file applies",
            )
        if options.points:
            raise InputError(
                "does not apply to a shunt calibration",
                where="--points",
                remedy="give either --points or --shunt",
            )
        if sensor.shunt is None:
            raise InputError(
                f"the rig file states no shunt of {sensor.channel}",
                where="--shunt",
                remedy="add shunt and shunt_tolerance to its [[sensors]] table, or use --points",
            )
        prompts = [f"switch the shunt of {sensor.channel} {state}" for state in ("off", "on")]
        _check_span((0.0, sensor.shunt), sensor, "shunt")
        return (0.0, sensor.shunt), prompts
    try:
        applied = tuple(float(text) for text in options.points.split(","))
    except ValueError:
        applied = ()
    if len(set(applied)) < 2 or not all(abs(value) <= sensor.range for value in applied):
        raise InputError(
            "not a list of applied values",
            where=f"--points {options.points}".rstrip(),
            allowed=f"at least two different numbers in {sensor.unit}, within "
            f"+-{sensor.range:g}, such as 0,{0.5 * sensor.range:g}",
            remedy="or calibrate by the shunt with --shunt",
        )
    _check_span(applied, sensor, "--points")
    return applied, [f"apply {value:g} {sensor.unit} to {sensor.channel}" for value in applied]


def _check_span(applied: tuple[float, ...], sensor: SensorConfig, option: str) -> None:
    """Raise InputError if the applied values are too close together for a sensitivity."""
    min_span = MIN_SPAN_SHARE * sensor.range
    if max(applied) - min(applied) < min_span:
        raise InputError(
            "the applied values are too close together",
            where=option,
            allowed=f"at least {min_span:g} {sensor.unit} from the smallest to the largest",
        )


def wait_for_table(prompt: str) -> None:
    """Print what is to be applied and wait `PAUSE_S` for it."""
    print_line(f"{prompt}: measured in {PAUSE_S:g} s")
    clock = RealClock()
    clock.wait_until(clock.now() + PAUSE_S)


def ask_person(prompt: str) -> None:
    """Prompt the operator and wait for Enter."""
    try:
        input(f"{prompt}, press Enter ")
    except EOFError:
        raise InputError(
            "no terminal to prompt the operator", remedy="use a terminal, or give --unattended"
        ) from None


def _measure_mean(rig: RigConfig, sensor: SensorConfig, prompt: str) -> MeanVoltage:
    """Return the mean voltage over `MEASURING_S`.

    The machine is opened for each point, because the operator may take any time between points.
    """
    machine = make_machine(rig, RealClock())
    try:
        machine.open()
        volts = machine.tare(round(MEASURING_S * machine.rate_hz))
    except MachineLost as error:
        raise InputError(str(error), where=prompt) from None
    finally:
        machine.close()
    channel_volts: Float1D = volts[rig.channels.index(sensor.channel)]
    mean = mean_voltage(channel_volts)
    if math.isnan(mean.volts):
        raise InputError(
            f"no samples of {sensor.channel} arrive",
            where=prompt,
            remedy="check its cable, its [[sensors]] table and its input in the rig file",
        )
    if np.nanmax(np.abs(channel_volts)) >= MAX_RANGE_SHARE * abs(
        sensor.range * sensor.volts_per_unit
    ):
        raise InputError(
            f"{sensor.channel} saturates",
            where=prompt,
            allowed=f"below +-{sensor.range:g} {sensor.unit}",
            remedy="apply less, or correct range or volts_per_unit in its [[sensors]] table",
        )
    return mean


def make_calibration(
    sensor: SensorConfig,
    options: CalibrationOptions,
    applied: tuple[float, ...],
    means: tuple[MeanVoltage, ...],
) -> CalibrationRecord:
    """Fit a calibration; InputError if the readings did not follow the applied values."""
    span_v = abs(
        means[applied.index(max(applied))].volts - means[applied.index(min(applied))].volts
    )
    noise_v = max(mean.sd for mean in means)
    lsb_v = sensor.lsb * abs(sensor.volts_per_unit)
    if span_v <= MIN_SPAN_SIGMA * max(noise_v, lsb_v):
        raise InputError(
            f"the readings differ by {span_v:.3g} V between the points, with {noise_v:.2g} V of "
            "uncertainty: the sensor did not respond to the applied values",
            where=sensor.channel,
            remedy="check its cable, and that the values were applied to this sensor",
        )
    min_sd_v = lsb_v / math.sqrt(12.0)  # quantization error of each point
    weighted_means = tuple(MeanVoltage(mean.volts, max(mean.sd, min_sd_v)) for mean in means)
    fit = fit_calibration(applied, options.applied_sd, weighted_means)
    nominal = sensor.volts_per_unit
    departure_percent = 100.0 * (fit.volts_per_unit / nominal - 1.0)
    sd = fit.volts_per_unit_sd
    tolerance_percent = options.tolerance
    if options.shunt and sensor.shunt is not None and sensor.shunt_tolerance is not None:
        tolerance_percent = 100.0 * sensor.shunt_tolerance / abs(sensor.shunt)
    return CalibrationRecord(
        channel=sensor.channel,
        unit=sensor.unit,
        serial=sensor.serial,
        at=local_datetime().isoformat(timespec="seconds"),
        by=user_name(None),
        method="shunt" if options.shunt else "points",
        applied=applied,
        applied_sd=options.applied_sd,
        volts=tuple(mean.volts for mean in means),
        volts_sd=tuple(mean.sd for mean in means),
        volts_per_unit=fit.volts_per_unit,
        volts_per_unit_sd=sd,
        offset=fit.offset,
        offset_sd=fit.offset_sd,
        linearity_percent=fit.linearity_percent,
        card_volts_per_unit=nominal,
        departure_percent=departure_percent,
        departure_sd=(fit.volts_per_unit - nominal) / math.copysign(sd, nominal) if sd else None,
        tolerance_percent=tolerance_percent,
        passed=abs(departure_percent) <= tolerance_percent,
    )


def write_record(path: Path, text: str) -> None:
    """Write the text of a record to a new file, creating its folder if needed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as stream:
            stream.write(text)
    except OSError as error:
        raise InputError(
            f"cannot write: {error.strerror}", where=path, remedy="give another file with --out"
        ) from None


def _print_record(record: CalibrationRecord, sensor: SensorConfig, path: Path) -> None:
    unit, linearity_percent = sensor.unit, record.linearity_percent
    print_line(
        f"sensitivity {record.volts_per_unit:.6g} V/{unit} +- {record.volts_per_unit_sd:.2g} "
        f"(1 sd), offset {record.offset:.4g} {unit} +- {record.offset_sd:.2g}"
        + (
            f", linear to {linearity_percent:.2g} % of the span"
            if linearity_percent is not None
            else ""
        )
    )
    sigma_text = "" if record.departure_sd is None else f", {record.departure_sd:.1f} sd"
    print_line(
        f"{record.departure_percent:+.3g} % from the rig file ({record.card_volts_per_unit:.6g} "
        f"V/{unit}){sigma_text}; allowed: {record.tolerance_percent:.3g} %: "
        f"{'pass' if record.passed else 'FAIL: check the sensor, its supply and the rig file'}"
    )
    print_line(f"recorded: {path}")
    print_line(f"to use it from now on, put into the [[sensors]] table of {sensor.channel}:")
    day = record.at[:10]
    for line in (
        f"volts_per_unit = {record.volts_per_unit!r}",
        f"offset = {record.offset:.6g}",
        f'calibrated = "{day}"',
        f'calibrated_by = "{record.by}"',
        f'certificate = "{path.name}"',
    ):
        print_line(f"  {line}")
