"""`python opendaq_far_side.py CARD UNIT`: an openDAQ device whose table plays what it is told.

A line of JSON on standard input is volts to play, from the first sample of a new life on; the
answer is the time stamp of that sample. UNIT is V, or `card`: each signal in its sensor's unit.
"""

import json
import select
import sys
from pathlib import Path

import numpy as np

from table_io.block import Float2D
from table_io.clock import RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.machine.table import MachineSession
from table_io.sim.opendaq import NS_PER_S, TICK_S, OpenDaqServer
from tests.builders.profiles import SPECIMEN

RATE_HZ = 2000.0


class InUnits(OpenDaqServer):
    """Its signals are in the units of the card's sensors."""

    def __init__(self, rig: RigConfig, rate_hz: float) -> None:
        self._per_unit = np.array([[sensor.volts_per_unit] for sensor in rig.sensors])
        super().__init__(rig, rate_hz)

    def unit(self, sensor: SensorConfig) -> str:
        return sensor.unit

    def send(self, index: int, volts: Float2D) -> None:
        super().send(index, volts / self._per_unit)


def main(path: str, unit: str) -> None:
    rig = parse_toml(Path(path).read_text(), RigConfig, path)
    table = rig.get_section(SimulatedTableConfig)
    assert table is not None
    quiet = rig.model_copy(update={"simulated": table.model_copy(update={"faults": ()})})
    device, clock = (OpenDaqServer if unit == "V" else InUnits)(rig, RATE_HZ), RealClock()
    life, base = MachineSession(quiet, SPECIMEN, RATE_HZ, None), 0
    life.start(clock.now())
    print("waiting", flush=True)
    while True:
        now_s = clock.now()
        if select.select([sys.stdin], [], [], TICK_S)[0]:
            line = sys.stdin.readline()
            if not line:
                return
            base += life.taken
            life = MachineSession(rig, SPECIMEN, RATE_HZ, None)
            life.queue(0, np.array(json.loads(line)), now_s)
            life.start(clock.now())
            print(device._start_ns + base * round(NS_PER_S / RATE_HZ), flush=True)
        life.play(clock.now())
        for message in life.pop_arrived(clock.now()):
            volts = message.values.reshape(-1, len(rig.channels)).T
            device.send(base + message.index, volts)


if __name__ == "__main__":
    main(*sys.argv[1:])
