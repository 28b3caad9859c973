"""The hydraulic table against a published servo-hydraulic actuator, identified on a real one.

Transfer system of the benchmark of Silva, Gomez, Maghareh, Dyke and Spencer (Mechanical Systems and
Signal Processing 135, 2020, 106381), identified in the laboratory at Purdue: servo valve of second
order, actuator with natural velocity feedback and leakage, and a frame as specimen,

    G_s = a1b0 / (s^2 + b1 s + b2),  G_a = 1 / (s + a3),  G_e = 1 / (m s^2 + c s + k),
    G_0 = G_a G_e / (1 + a2 s G_a G_e),  G = G_s G_0 / (1 + G_s G_0).

Nominal values also in FermandoisLab/RobustAMBCvRTHS. a2 is the stiffness of the oil, a3 its leakage
over the compressibility, b2 and b1 state the valve, a1b0 / (a2 b2) is the gain of the stroke loop.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from table_io.sim.plant import Plant
from tests.earthquakes.hydraulic_rig import build_rig, play

A1B0, A2, A3, B1, B2 = 2.13e13, 4.23e6, 3.3, 425.0, 1e5
SPECIMEN_KG, SPECIMEN_N_S_M, SPECIMEN_N_M = 29.1, 114.6, 1.19e6
RATE_HZ = 8000.0
OUTPUT_DELAY_S = 0.5 / RATE_HZ  # least delay of the simulated output stage


def build_published_table() -> Plant:
    """Return the simulated table as the published one: linear, on a frame that does not move."""
    area_m2, supply_pa, open_flow = 1e-3, 1e15, 1.0
    plant = build_rig()
    assert plant.oil is not None
    oil = plant.oil._replace(
        area=area_m2,
        table_mass=SPECIMEN_KG,
        oil_stiffness=A2 / area_m2**2,
        leakage=A3 * area_m2**2 / A2,
        supply=supply_pa,
        open_flow=open_flow,
        rated_flow=open_flow / math.sqrt(supply_pa),
        valve=math.sqrt(B2),
        valve_damping=B1 / (2.0 * math.sqrt(B2)),
        fc=0.0,
        fs=0.0,
        viscous=0.0,
        gain=A1B0 / (A2 * B2),
        feedforward=0.0,
        pressure_gain=0.0,
        frame_mass=1e15,
    )
    # The frame of the specimen stands on the ground: the spring of a mass that does not move.
    return replace(
        plant,
        oil=oil,
        rate_hz=RATE_HZ,
        mass_kg=1e15,
        damper_stiffness_n_m=SPECIMEN_N_M,
        damper_damping_n_s_m=SPECIMEN_N_S_M,
        table_mass_kg=SPECIMEN_KG,
        servo_delay_s=0.0,
        gap_left_m=math.inf,
        gap_right_m=math.inf,
        payload_reaction=True,
    )


def build_published_system() -> signal.TransferFunction:
    """Return the published transfer function from command to actuator."""
    stroke = np.polyadd(
        np.polymul([1.0, A3], [SPECIMEN_KG, SPECIMEN_N_S_M, SPECIMEN_N_M]), [A2, 0.0]
    )
    closed = np.polyadd(np.polymul([1.0, B1, B2], stroke), [A1B0])
    return signal.TransferFunction([A1B0], closed)


@pytest.mark.parametrize("hz", [0.5, 2.0, 5.0, 10.0, 20.0, 40.0, 60.0, 80.0])
def test_frequency_response_is_the_published_one(hz: float) -> None:
    times = np.arange(round(RATE_HZ * max(2.0, 4.0 / hz))) / RATE_HZ
    command = 1e-3 * np.clip(times / 0.5, 0.0, 1.0) * np.sin(math.tau * hz * times)
    tail = slice(-round(RATE_HZ * max(1.0, 2.0 / hz)), None)
    turn = np.exp(-1j * math.tau * hz * times[tail])
    position = play(build_published_table(), command)[0]
    measured = (position[tail] * turn).sum() / (command[tail] * turn).sum()
    _, expected = build_published_system().freqresp([math.tau * hz])
    delay = np.exp(-1j * math.tau * hz * OUTPUT_DELAY_S)
    assert abs(measured / (expected[0] * delay) - 1.0) < 1e-3


def test_step_response_is_the_published_one() -> None:
    times = np.arange(round(0.5 * RATE_HZ)) / RATE_HZ
    position = play(build_published_table(), np.full(times.size, 1e-3))[0]
    _, expected = signal.step(build_published_system(), T=times)
    late = np.interp(times - OUTPUT_DELAY_S, times, expected)
    assert np.abs(1e3 * position - late).max() < 0.005
    reached = times[np.argmax(1e3 * position > 0.5 * expected[-1])]
    assert reached == pytest.approx(times[np.argmax(expected > 0.5 * expected[-1])], abs=2e-4)
