"""A declared channel comes through every kind of hardware as any other one."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import AcquisitionSource, Backend
from table_io.backends.ni.driver import require_ni_wiring
from table_io.backends.udp.backend import UdpBackend
from table_io.clock import RealClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from tests.builders.rigs import DECLARED, EXTRA, TEMPERATURE, make_lab_rig
from tests.input_errors import raises_input_error
from tests.table_io.backends.ni_wire import CARD, Bed
from tests.table_io.backends.udp_bench import SPECIMEN, card, python_target

RATE_HZ = 2000.0
LAST_WIRE = '{ channel = "force_l2_n", physical = "Dev1/ai8" },'
WIRES = [f'{{ channel = "{name}", physical = "Dev1/ai{9 + k}" }},' for k, name in enumerate(EXTRA)]
NI_TEXT = CARD.replace(LAST_WIRE, "\n".join([LAST_WIRE, *WIRES])) + DECLARED


def read_at_rest(source: Backend | AcquisitionSource) -> None:
    """Read some samples at rest and look at those of the thermometer, in V."""
    row = source.channels.index(TEMPERATURE)
    source.open()
    try:
        for volts in (source.tare(400), _start_and_read(source)):
            assert volts.shape[0] == len(make_lab_rig().channels)
            assert volts[row].mean() == pytest.approx(0.05 * (50.0 + 21.5), abs=1e-3)
            assert np.ptp(volts[row]) > 0.0
    finally:
        source.close()


def _start_and_read(source: Backend | AcquisitionSource) -> np.ndarray:
    queue: Callable[[int, np.ndarray], None] | None = getattr(source, "queue", None)
    if queue is not None:
        queue(0, np.zeros(400))
    source.start()
    return source.read(200)


def test_ni_reads_it_at_its_terminals() -> None:
    read_at_rest(Bed(NI_TEXT).backend(RATE_HZ))


def test_ni_needs_its_terminals() -> None:
    rig = parse_toml(NI_TEXT.replace(WIRES[1], ""), RigConfig, "ni")
    with raises_input_error(problem=TEMPERATURE):
        require_ni_wiring(rig)


def test_udp_target_sends_it_in_the_order_of_the_sensors(tmp_path: Path) -> None:
    with python_target(tmp_path, DECLARED) as address:
        rig = parse_toml(card(address, DECLARED), RigConfig, "udp")
        read_at_rest(UdpBackend(rig, SPECIMEN, RATE_HZ, RealClock()))
