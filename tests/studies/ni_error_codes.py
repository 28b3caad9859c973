"""Every error that NI's driver has a code for, on every call of a run: what is said, what happens.

    python -m tests.studies.ni_error_codes [STEP]    every code, or every STEP-th

In one process, on a clock that jumps: each life drives the table, meets the error in motion, and is
followed to its rest by the black box.
"""

import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from nidaqmx.error_codes import DAQmxErrors

from table_io.backends import MachineLost
from table_io.backends.ni.config import NiFault
from table_io.block import Float1D
from table_io.sim.machine.flight_recorder import FlightRecorder
from tests.builders.flight_records import RecordedSession, read_flight_record
from tests.table_io.backends.ni_wire import Bed

CALLS: tuple[Any, ...] = ("read", "write", "start", "heartbeat", "output")
RATE_HZ = 2000.0
AT_S = 0.45  # of the error, from sample 0: in motion
LATEST_REST_S = 8.0
MOST_ACC = 5.0  # m/s2, of the table: a voltage that freezes in motion is a jolt, not a blow


def motion() -> Float1D:
    """1 V (6 mm) at 1 Hz, faded in and out over a cycle, in V, (sample,)."""
    t = np.arange(round(2.0 * RATE_HZ)) / RATE_HZ
    fade = np.clip(np.minimum(t, 2.0 - t - 2 / RATE_HZ), 0.0, 1.0)
    return np.sin(2 * np.pi * t) * fade**3 * (10 - 15 * fade + 6 * fade**2)


def meet_fault(bed: Bed, fault: NiFault, box: Path) -> tuple[str, RecordedSession]:
    """(what is said of an error, the life that met it)."""
    backend = bed.backend()
    backend.open()
    bed.table.set_recorder(FlightRecorder(box, print))
    bed.device.faults.append(fault)
    text = ""
    try:
        backend.queue(0, motion())
        backend.start()
        for _ in range(120):
            backend.read(20)
            if fault.call == "write":
                newest = int((bed.clock.now() - backend.scheduled_time_s(0)) * RATE_HZ)
                at = newest + backend.replace_after + 10
                backend.queue(at, motion()[at:])
    except MachineLost as error:
        text = str(error)
    backend.close()
    bed.rest()
    bed.device.faults.clear()
    lives = read_flight_record(box)
    box.unlink()
    return text, lives[-1]


def judge_ending(text: str, life: RecordedSession, fault: NiFault) -> str:
    """What is wrong with the end of a life; empty: it was stated, and it is safe."""
    if f"error {fault.code} (" not in text:
        return f"not stated: {text!r}"
    if fault.call == "start":
        return "" if not life.samples.shape[1] else "it moved before its start"
    table, command = life.row("table_disp"), life.row("command_m")
    if abs(command[-1]) > 1e-6 or np.abs(table[-200:]).max() > 1e-4:
        return f"no rest: command {command[-1]:.6f} m, table {table[-1]:.6f} m"
    if life.notes[-1][1] != "at rest" or table.size > LATEST_REST_S * RATE_HZ:
        return f"rest too late: {table.size / RATE_HZ:.1f} s, {life.notes[-1:]}"
    if np.abs(life.row("table_acc")).max() > MOST_ACC:
        return f"a blow: {np.abs(life.row('table_acc')).max():.1f} m/s2"
    return ""


def main(step: int) -> None:
    bed, ends, wrong = Bed(), Counter[str](), []
    rest_s: dict[str, list[float]] = {call: [] for call in CALLS}
    with tempfile.TemporaryDirectory() as folder:
        for code in list(DAQmxErrors)[::step]:
            if code >= 0:
                continue
            for call in CALLS:
                fault = NiFault(call=call, code=int(code), at_s=AT_S)
                text, life = meet_fault(bed, fault, Path(folder) / "box")
                fault_of = judge_ending(text, life, fault)
                ends[f"{call}: {'safe' if not fault_of else 'WRONG'}"] += 1
                if life.samples.shape[1]:
                    driven = np.flatnonzero(np.abs(life.row("table_disp")) > 5e-5)
                    rest_s[call].append((driven[-1] / RATE_HZ) - AT_S)
                if fault_of:
                    wrong.append(f"{call} {code}: {fault_of}")
    print(dict(ends))
    for call, seconds in rest_s.items():
        if seconds:
            print(
                f"{call}: table at rest {min(seconds):.2f} to {max(seconds):.2f} s after the error"
            )
    print(f"{len(wrong)} wrong", *wrong[:20], sep="\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
