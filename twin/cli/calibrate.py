"""`shaketwin calibrate`: measure a sensor's sensitivity and compare it with its config.

The inputs are read as for a tare; no command is queued and no output is started.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.backends import MachineLost
from table_io.block import Float1D
from table_io.clock import RealClock, local_datetime
from table_io.config.base import find_config
from table_io.config.calibration_fit import MeanVoltage, fit_calibration, mean_voltage
from table_io.config.calibration_record import CalibrationRecord, format_calibration_toml
from table_io.config.rig import RigConfig
from table_io.config.rig_file import calibrations_dir, load_rig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from twin.cli.check_table import EXIT_FAILED, make_machine
from twin.run.terminal import print_line
from twin.security.credentials import user_name

MEASURING_S, PAUSE_S = 1.0, 5.0
MAX_RANGE_SHARE = 0.999  # of the range; above it a reading counts as clipped
DEFAULT_TOLERANCE_PERCENT = 1.0  # of the departure in sensitivity
MIN_SPAN_SHARE = 1e-3  # of the range, to be spanned by the applied values
MIN_SPAN_SIGMA = 10.0  # standard errors, to be spanned by the readings


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """Options of the command."""

    channel: str
    table: str
    points: str
    shunt: bool
    tolerance_percent: float | None  # None: the default, or that of the shunt
    applied_sd: float
    unattended: bool
    out: Path | None

    @property
    def tolerance(self) -> float:
        """Allowed departure of the sensitivity in per cent, for a calibration by points."""
        return (
            DEFAULT_TOLERANCE_PERCENT if self.tolerance_percent is None else self.tolerance_percent
        )


def calibrate_sensor(request: CalibrationRequest) -> int:
    """Measure each point and write the record; return 0, or 2 if out of tolerance."""
    path = find_config(request.table, "rigs")
    rig, _ = load_rig(path)
    sensor = next(
        (candidate for candidate in rig.sensors if candidate.channel == request.channel), None
    )
    if sensor is None:
        raise InputError(
            f"{request.channel}: rig {rig.name} has no such sensor; it has: "
            f"{', '.join(rig.channels)}"
        )
    applied, prompts = _plan_points(request, sensor)
    timestamp = f"{local_datetime():%Y%m%d-%H%M%S}"
    record_path = request.out or calibrations_dir(path) / f"{timestamp}-{sensor.channel}.toml"
    if record_path.exists():
        raise InputError(f"{record_path}: exists; nothing is overwritten, give another --out")
    means = []
    for prompt in prompts:
        _wait_for_person(prompt, request.unattended)
        means.append(_measure_mean(rig, sensor, prompt))
        print_line(f"  {means[-1].volts:.6g} V +- {means[-1].sd:.2g} V")
    record = make_calibration(sensor, request, applied, tuple(means))
    _write_record(record_path, record)
    _print_record(record, sensor, record_path)
    return 0 if record.passed else EXIT_FAILED


def _plan_points(
    request: CalibrationRequest, sensor: SensorConfig
) -> tuple[tuple[float, ...], list[str]]:
    """Return (applied values in the sensor's unit, prompts to the operator), by point."""
    if not (0 < request.tolerance < math.inf and 0 <= request.applied_sd <= sensor.range):
        raise InputError(
            "--tolerance and --applied-sd: allowed: above 0 %, and 0 to the range, "
            f"{sensor.range:g} {sensor.unit}"
        )
    if request.shunt:
        if request.tolerance_percent is not None:
            raise InputError(
                "--shunt: what it may depart is shunt_tolerance on the sensor card; no --tolerance"
            )
        if request.points or sensor.shunt is None:
            raise InputError(
                f"--shunt: {sensor.channel} needs shunt and shunt_tolerance on its sensor card, "
                "and no --points"
            )
        prompts = [f"switch the shunt of {sensor.channel} {state}" for state in ("off", "on")]
        _check_span((0.0, sensor.shunt), sensor, "shunt")
        return (0.0, sensor.shunt), prompts
    try:
        applied = tuple(float(text) for text in request.points.split(","))
    except ValueError:
        applied = ()
    if len(set(applied)) < 2 or not all(abs(value) <= sensor.range for value in applied):
        raise InputError(
            f"--points {request.points!r}: allowed: at least two numbers in {sensor.unit}, within "
            f"+-{sensor.range:g}, as 0,{0.5 * sensor.range:g}; or --shunt"
        )
    _check_span(applied, sensor, "--points")
    return applied, [f"apply {value:g} {sensor.unit} to {sensor.channel}" for value in applied]


def _check_span(applied: tuple[float, ...], sensor: SensorConfig, option: str) -> None:
    """Raise InputError if the applied values are too close together for a sensitivity."""
    min_span = MIN_SPAN_SHARE * sensor.range
    if max(applied) - min(applied) < min_span:
        raise InputError(
            f"{option}: too near together; allowed: at least {min_span:g} {sensor.unit} from the "
            "smallest to the largest"
        )


def _wait_for_person(prompt: str, unattended: bool) -> None:
    """Prompt the operator and wait for Enter, or `PAUSE_S` if unattended."""
    if unattended:
        print_line(f"{prompt}: measured in {PAUSE_S:g} s")
        clock = RealClock()
        clock.wait_until(clock.now() + PAUSE_S)
        return
    try:
        input(f"{prompt}, press Enter ")
    except EOFError:
        raise InputError("nobody presses Enter; use a terminal, or --unattended") from None


def _measure_mean(rig: RigConfig, sensor: SensorConfig, prompt: str) -> MeanVoltage:
    """Return the mean voltage over `MEASURING_S`.

    The machine is opened for each point, because the operator may take any time between points.
    """
    machine = make_machine(rig, RealClock())
    try:
        machine.open()
        volts = machine.tare(round(MEASURING_S * machine.rate_hz))
    except MachineLost as error:
        raise InputError(f"{prompt}: {error}") from None
    finally:
        machine.close()
    channel_volts: Float1D = volts[rig.channels.index(sensor.channel)]
    mean = mean_voltage(channel_volts)
    if math.isnan(mean.volts):
        raise InputError(
            f"{prompt}: no sample of {sensor.channel} comes; look at its cable, its card"
        )
    if np.nanmax(np.abs(channel_volts)) >= MAX_RANGE_SHARE * abs(
        sensor.range * sensor.volts_per_unit
    ):
        raise InputError(f"{prompt}: it is at the end of its range; apply less, or mend its card")
    return mean


def make_calibration(
    sensor: SensorConfig,
    request: CalibrationRequest,
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
            f"{sensor.channel}: {span_v:.3g} V between the points, {noise_v:.2g} V of doubt: it "
            "did not follow what was applied; look at its cable, and that all was applied to this "
            "one"
        )
    min_sd_v = lsb_v / math.sqrt(12.0)  # quantization error of each point
    weighted_means = tuple(MeanVoltage(mean.volts, max(mean.sd, min_sd_v)) for mean in means)
    fit = fit_calibration(applied, request.applied_sd, weighted_means)
    nominal = sensor.volts_per_unit
    departure_percent = 100.0 * (fit.volts_per_unit / nominal - 1.0)
    sd = fit.volts_per_unit_sd
    tolerance_percent = request.tolerance
    if request.shunt and sensor.shunt is not None and sensor.shunt_tolerance is not None:
        tolerance_percent = 100.0 * sensor.shunt_tolerance / abs(sensor.shunt)
    return CalibrationRecord(
        channel=sensor.channel,
        unit=sensor.unit,
        serial=sensor.serial,
        at=local_datetime().isoformat(timespec="seconds"),
        by=user_name(None),
        method="shunt" if request.shunt else "points",
        applied=applied,
        applied_sd=request.applied_sd,
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


def _write_record(path: Path, record: CalibrationRecord) -> None:
    """Write the record to a new file, creating its folder if needed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("x", encoding="utf-8") as stream:
            stream.write(format_calibration_toml(record))
    except OSError as error:
        raise InputError(f"{path}: cannot write it: {error.strerror}; give another --out") from None


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
        f"{record.departure_percent:+.3g} % from its card ({record.card_volts_per_unit:.6g} "
        f"V/{unit}){sigma_text}; allowed: {record.tolerance_percent:.3g} %: "
        f"{'pass' if record.passed else 'FAIL: mend the sensor, its supply, or its card'}"
    )
    print_line(f"recorded: {path}")
    print_line(f"for the sensor card of {sensor.channel}, if this is to hold from now on:")
    day = record.at[:10]
    for line in (
        f"volts_per_unit = {record.volts_per_unit!r}",
        f"offset = {record.offset:.6g}",
        f'calibrated = "{day}"',
        f'calibrated_by = "{record.by}"',
        f'certificate = "{path.name}"',
    ):
        print_line(f"  {line}")
