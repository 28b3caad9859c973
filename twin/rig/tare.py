"""`shaketwin tare`: measure the zero of every sensor with the bumpers clear of the mass."""

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.backends import MachineLost
from table_io.block import Float2D
from table_io.clock import Clock, ManualClock, RealClock, local_datetime
from table_io.config.calibration import measure_tare_age
from table_io.config.folders import find_config
from table_io.config.rig import RigConfig
from table_io.config.rig_file import load_rig, tares_dir
from table_io.config.tare import TareRecord, format_tare_toml, measure_tare
from table_io.errors import InputError
from twin.rig.calibrate import MAX_RANGE_SHARE, ask_person, choose_record_path, write_record
from twin.rig.check_table import make_machine
from twin.security.access_control import user_name
from twin.system.terminal import console, print_line, print_table

TARE_S = 4.0  # twice as long as the slowest motion of a mass that is still ringing
MAX_TREND_SIGMA = 8.0  # of the difference of two halves, over what noise explains: something moves
MIN_TREND_LSB = 2.0  # and at least so many steps of the converter
PROMPT = (
    "retract the bumpers until both are clear of the mass; table, mass and cells at rest and "
    "untouched"
)


@dataclass(frozen=True, slots=True)
class TareOptions:
    """Rig to tare, and the temperature of the laboratory in degrees C if it is known.

    `out`: file of the record; None: next to the rig file, where runs look for it.
    """

    table: str
    temperature_c: float | None = None
    out: Path | None = None


@dataclass(frozen=True, eq=False)
class TaredRig:
    """Record of a tare and its file, the rig, and the tare before it (None: the first one)."""

    record: TareRecord
    path: Path
    rig: RigConfig
    previous: TareRecord | None


def tare(options: TareOptions, ask: Callable[[str], None]) -> TaredRig:
    """Measure all inputs of a rig at rest and write the record; no output is started.

    `ask` is told what the operator has to prepare, and returns when it is done. InputError if a
    sensor is lost, at its range or not at rest.
    """
    path = find_config(options.table, "rigs", option="--table")
    rig, _ = load_rig(path)
    name = f"{local_datetime():%Y%m%d-%H%M%S}"
    record_path = choose_record_path(path, tares_dir(path), name, options.table, options.out)
    ask(PROMPT)
    clock: Clock = ManualClock() if rig.runs_at_any_speed else RealClock()
    machine = make_machine(rig, clock)
    try:
        machine.open()
        volts = machine.tare(round(TARE_S * machine.rate_hz))
    except MachineLost as error:
        raise InputError(str(error), where=f"rig {rig.name}") from None
    finally:
        machine.close()
    _refuse_faulty_inputs(volts, rig)
    means, noise = measure_tare(volts)
    record = TareRecord(
        rig=rig.name,
        at=local_datetime().isoformat(timespec="seconds"),
        by=user_name(None),
        seconds=TARE_S,
        temperature_c=options.temperature_c,
        channels=rig.channels,
        volts=means,
        noise_v=noise,
    )
    write_record(record_path, format_tare_toml(record))
    return TaredRig(record, record_path, rig, rig.tare)


def _refuse_faulty_inputs(volts: Float2D, rig: RigConfig) -> None:
    """Raise InputError with every sensor that is lost, at its range or not at rest."""
    faults = []
    for sensor, samples in zip(rig.sensors, volts, strict=True):
        known = samples[np.isfinite(samples)]
        if known.size < 2 or known.size < 0.5 * samples.size:
            faults.append((sensor.channel, "no samples arrive", "check its cable and its input"))
            continue
        if np.abs(known).max() >= MAX_RANGE_SHARE * abs(sensor.range * sensor.volts_per_unit):
            faults.append(
                (sensor.channel, "is at its range", "unload it, or balance its amplifier")
            )
            continue
        parts = np.array([part.mean() for part in np.array_split(known, 16)])
        trend_v = abs(parts[:8].mean() - parts[8:].mean())
        noise_v = np.diff(parts).std() / np.sqrt(8.0)  # of the difference of the two means
        lsb_v = sensor.lsb * abs(sensor.volts_per_unit)
        if trend_v > max(MAX_TREND_SIGMA * noise_v, MIN_TREND_LSB * lsb_v):
            text = f"moved by {trend_v / abs(sensor.volts_per_unit):.3g} {sensor.unit} in the tare"
            faults.append((sensor.channel, text, "wait until table and mass are at rest"))
    if faults:
        raise InputError(
            "the rig cannot be tared; nothing was written",
            where=f"rig {rig.name}",
            faults=tuple(
                InputError(text, where=channel, remedy=remedy) for channel, text, remedy in faults
            ),
        )


def print_tare(options: TareOptions, is_prepared: bool) -> int:
    """Tare a rig with the operator; print what each sensor shows and how it changed; return 0."""
    tared = tare(options, _confirm if is_prepared else ask_person)
    record, previous = tared.record, tared.previous
    age = ""
    if previous is not None:
        age_h = measure_tare_age(previous, datetime.fromisoformat(record.at))
        age = f"; the last tare was {age_h:.1f} h ago"
    table = Table(title=f"tare of {tared.rig.title}{age}", box=SIMPLE_HEAD, title_justify="left")
    for header in ("sensor", "at rest", "noise rms", "since the last", "unit"):
        table.add_column(header, justify="left" if header in ("sensor", "unit") else "right")
    for k, sensor in enumerate(tared.rig.sensors):
        before = None if previous is None else previous.mean_v(sensor.channel)
        scale = 1.0 / sensor.volts_per_unit
        table.add_row(
            sensor.channel,
            f"{scale * record.volts[k]:.5g}",
            f"{abs(scale) * record.noise_v[k]:.2g}",
            "-" if before is None else f"{scale * (record.volts[k] - before):+.3g}",
            sensor.unit,
        )
    print_table(console, table)
    print_line(f"recorded: {tared.path}")
    return 0


def _confirm(prompt: str) -> None:
    print_line(f"taken as done: {prompt}")
