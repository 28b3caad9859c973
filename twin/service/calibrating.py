"""`shaketwin calibrate`: what a sensor gives for what is applied to it, beside its card.

The inputs are taken as at a tare: nothing is queued, nothing is started.
"""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.backends import MachineLost
from table_io.block import Float1D
from table_io.calibration_fit import Mean, fitted, mean_of
from table_io.calibration_record import Calibration, toml_of
from table_io.card import BadInput, find
from table_io.clock import RealClock, today
from table_io.rig import Rig
from table_io.rig_file import calibrations_of, load_rig
from table_io.sensor import Sensor
from twin.service.tell import person
from twin.service.terminal import say
from twin.service.wiring_check import EXIT_FAILED, machine_of

MEASURED_S, PAUSE_S = 1.0, 5.0
RAIL = 0.999  # of the range
USUAL_PERCENT = 1.0  # that a sensitivity may depart
LEAST_APART = 1e-3  # of the range, that what is applied must span
FOLLOWS = 10.0  # standard errors, that the readings must at least lie apart


@dataclass(frozen=True, slots=True)
class Asked:
    """What was asked for."""

    channel: str
    table: str
    points: str
    shunt: bool
    tolerance_percent: float | None  # None: the usual one, or that of the shunt
    applied_sd: float
    unattended: bool
    out: Path | None


def calibrate(asked: Asked) -> int:
    """Measures each point, says what follows, leaves the record; 0, or 2 beyond the tolerance."""
    path = find(asked.table, "rigs")
    rig, _ = load_rig(path)
    sensor = next((one for one in rig.sensors if one.channel == asked.channel), None)
    if sensor is None:
        raise BadInput(
            f"{asked.channel}: rig {rig.name} has no such sensor; it has: {', '.join(rig.channels)}"
        )
    applied, prompts = _wanted(asked, sensor)
    at = f"{today():%Y%m%d-%H%M%S}"
    file = asked.out or calibrations_of(path) / f"{at}-{sensor.channel}.toml"
    if file.exists():
        raise BadInput(f"{file}: exists; nothing is overwritten, give another --out")
    means = []
    for prompt in prompts:
        _wait(prompt, asked.unattended)
        means.append(_measured(rig, sensor, prompt))
        say(f"  {means[-1].volts:.6g} V +- {means[-1].sd:.2g} V")
    record = recorded(sensor, asked, applied, tuple(means))
    _write(file, record)
    _tell(record, sensor, file)
    return 0 if record.passed else EXIT_FAILED


def _wanted(asked: Asked, sensor: Sensor) -> tuple[tuple[float, ...], list[str]]:
    """(what is applied, how a person is asked for it), point by point."""
    tolerance = USUAL_PERCENT if asked.tolerance_percent is None else asked.tolerance_percent
    if not (0 < tolerance < math.inf and 0 <= asked.applied_sd <= sensor.range):
        raise BadInput(
            "--tolerance and --applied-sd: allowed: above 0 %, and 0 to the range, "
            f"{sensor.range:g} {sensor.unit}"
        )
    if asked.shunt:
        if asked.tolerance_percent is not None:
            raise BadInput(
                "--shunt: what it may depart is shunt_tolerance on the sensor card; no --tolerance"
            )
        if asked.points or sensor.shunt is None:
            raise BadInput(
                f"--shunt: {sensor.channel} needs shunt and shunt_tolerance on its sensor card, "
                "and no --points"
            )
        switched = [f"switch the shunt of {sensor.channel} {state}" for state in ("off", "on")]
        _apart((0.0, sensor.shunt), sensor, "shunt")
        return (0.0, sensor.shunt), switched
    try:
        applied = tuple(float(one) for one in asked.points.split(","))
    except ValueError:
        applied = ()
    if len(set(applied)) < 2 or not all(abs(one) <= sensor.range for one in applied):
        raise BadInput(
            f"--points {asked.points!r}: allowed: at least two numbers in {sensor.unit}, within "
            f"+-{sensor.range:g}, as 0,{0.5 * sensor.range:g}; or --shunt"
        )
    _apart(applied, sensor, "--points")
    return applied, [f"apply {one:g} {sensor.unit} to {sensor.channel}" for one in applied]


def _apart(applied: tuple[float, ...], sensor: Sensor, what: str) -> None:
    """BadInput where what is applied lies too near together to tell a sensitivity."""
    least = LEAST_APART * sensor.range
    if max(applied) - min(applied) < least:
        raise BadInput(
            f"{what}: too near together; allowed: at least {least:g} {sensor.unit} from the "
            "smallest to the largest"
        )


def _wait(prompt: str, unattended: bool) -> None:
    """Until a person has done so."""
    if unattended:
        say(f"{prompt}: measured in {PAUSE_S:g} s")
        clock = RealClock()
        clock.wait_until(clock.now() + PAUSE_S)
        return
    try:
        input(f"{prompt}, press Enter ")
    except EOFError:
        raise BadInput("nobody presses Enter; use a terminal, or --unattended") from None


def _measured(rig: Rig, sensor: Sensor, what: str) -> Mean:
    """Mean of a second; the machine is opened anew: nobody knows how long a person takes."""
    machine = machine_of(rig, RealClock())
    try:
        machine.open()
        volts = machine.tare(round(MEASURED_S * machine.rate_hz))
    except MachineLost as error:
        raise BadInput(f"{what}: {error}") from None
    finally:
        machine.close()
    own: Float1D = volts[rig.channels.index(sensor.channel)]
    mean = mean_of(own)
    if math.isnan(mean.volts):
        raise BadInput(f"{what}: no sample of {sensor.channel} comes; look at its cable, its card")
    if np.nanmax(np.abs(own)) >= RAIL * abs(sensor.range * sensor.volts_per_unit):
        raise BadInput(f"{what}: it is at the end of its range; apply less, or mend its card")
    return mean


def recorded(
    sensor: Sensor, asked: Asked, applied: tuple[float, ...], means: tuple[Mean, ...]
) -> Calibration:
    """The record; BadInput where the readings did not follow what was applied."""
    apart = abs(means[applied.index(max(applied))].volts - means[applied.index(min(applied))].volts)
    noise = max(one.sd for one in means)
    least = sensor.lsb * abs(sensor.volts_per_unit)
    if apart <= FOLLOWS * max(noise, least):
        raise BadInput(
            f"{sensor.channel}: {apart:.3g} V between the points, {noise:.2g} V of doubt: it did "
            "not follow what was applied; look at its cable, and that all was applied to this one"
        )
    floor = least / math.sqrt(12.0)  # of each point: what one step of the converter leaves open
    doubts = tuple(Mean(one.volts, max(one.sd, floor)) for one in means)
    fit = fitted(applied, asked.applied_sd, doubts)
    card = sensor.volts_per_unit
    departure = 100.0 * (fit.volts_per_unit / card - 1.0)
    sd = fit.volts_per_unit_sd
    allowed = USUAL_PERCENT if asked.tolerance_percent is None else asked.tolerance_percent
    if asked.shunt and sensor.shunt is not None and sensor.shunt_tolerance is not None:
        allowed = 100.0 * sensor.shunt_tolerance / abs(sensor.shunt)
    return Calibration(
        channel=sensor.channel,
        unit=sensor.unit,
        serial=sensor.serial,
        at=today().isoformat(timespec="seconds"),
        by=person(None),
        method="shunt" if asked.shunt else "points",
        applied=applied,
        applied_sd=asked.applied_sd,
        volts=tuple(one.volts for one in means),
        volts_sd=tuple(one.sd for one in means),
        volts_per_unit=fit.volts_per_unit,
        volts_per_unit_sd=sd,
        offset=fit.offset,
        offset_sd=fit.offset_sd,
        linearity_percent=fit.linearity_percent,
        card_volts_per_unit=card,
        departure_percent=departure,
        departure_sd=(fit.volts_per_unit - card) / math.copysign(sd, card) if sd else None,
        tolerance_percent=allowed,
        passed=abs(departure) <= allowed,
    )


def _write(file: Path, record: Calibration) -> None:
    """A new file, in a folder that is made where there is none."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("x", encoding="utf-8") as stream:
            stream.write(toml_of(record))
    except OSError as error:
        raise BadInput(f"{file}: cannot write it: {error.strerror}; give another --out") from None


def _tell(record: Calibration, sensor: Sensor, file: Path) -> None:
    unit, linear = sensor.unit, record.linearity_percent
    say(
        f"sensitivity {record.volts_per_unit:.6g} V/{unit} +- {record.volts_per_unit_sd:.2g} "
        f"(1 sd), offset {record.offset:.4g} {unit} +- {record.offset_sd:.2g}"
        + (f", linear to {linear:.2g} % of the span" if linear is not None else "")
    )
    far = "" if record.departure_sd is None else f", {record.departure_sd:.1f} sd"
    say(
        f"{record.departure_percent:+.3g} % from its card ({record.card_volts_per_unit:.6g} "
        f"V/{unit}){far}; allowed: {record.tolerance_percent:.3g} %: "
        f"{'pass' if record.passed else 'FAIL: mend the sensor, its supply, or its card'}"
    )
    say(f"recorded: {file}")
    say(f"for the sensor card of {sensor.channel}, if this is to hold from now on:")
    day = record.at[:10]
    for line in (
        f"volts_per_unit = {record.volts_per_unit!r}",
        f"offset = {record.offset:.6g}",
        f'calibrated = "{day}"',
        f'calibrated_by = "{record.by}"',
        f'certificate = "{file.name}"',
    ):
        say(f"  {line}")
