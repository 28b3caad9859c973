"""The simulated hydraulic table as a laboratory: another code than its twin."""

import math
from dataclasses import replace

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.profile import Specimen
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.plant import SIGNALS, Plant
from table_io.sim.simulated_table import build_plant
from tests.builders.rigs import read_rig
from twin.earthquakes.table_identification import (
    RehearsalProblem,
    TableIdentification,
    TableRehearsal,
    fit_basic_twin,
)

RATE_HZ = 1000.0
RIG = read_rig("hydraulic")
TABLE = RIG.require_section("simulated", SimulatedTableConfig)
SPECIMEN_KG = 550.0
STALL_N = 42_000.0


def build_rig(friction_n: float = 500.0, gap_mm: float = math.inf) -> Plant:
    """Return the shipped table with this friction, and a specimen on it."""
    plant = build_plant(TABLE, Specimen(mass_kg=SPECIMEN_KG, gap_mm=gap_mm), RATE_HZ)
    assert plant.oil is not None
    return replace(plant, oil=plant.oil._replace(fc=friction_n, fs=1.3 * friction_n))


def play(plant: Plant, command: Float1D) -> Float2D:
    """Return the true signals, (7, sample), for a command in m."""
    out = np.empty((len(SIGNALS), command.size))
    before = np.zeros(plant.history_samples)
    plant.advance(plant.rest_state(), np.concatenate([before, command]), out)
    return out


def make_random_motion(
    seconds: float, band_hz: tuple[float, float], rms_m_s2: float, seed: int
) -> Float1D:
    """Return a displacement in m with flat random acceleration in a band, at rest at its ends."""
    count = round(seconds * RATE_HZ)
    hz = np.fft.rfftfreq(count, 1.0 / RATE_HZ)
    inside = (hz > band_hz[0]) & (hz < band_hz[1])
    phase = np.exp(2j * math.pi * np.random.default_rng(seed).random(hz.size))
    spectrum = np.where(inside, phase / np.where(hz > 0.0, hz, 1.0) ** 2, 0.0)
    edge = np.clip(np.minimum(np.arange(count), np.arange(count)[::-1]) / (3.0 * RATE_HZ), 0.0, 1.0)
    motion = np.fft.irfft(spectrum, count) * edge**2 * (3.0 - 2.0 * edge)
    acceleration = np.gradient(np.gradient(motion)) * RATE_HZ**2
    scaled: Float1D = motion * rms_m_s2 / acceleration.std()
    return scaled


def identify(rehearsal: TableRehearsal) -> TableIdentification:
    """Return the hydraulic twin of a rehearsal, without further effects."""
    problem = RehearsalProblem.from_rehearsal(rehearsal, TABLE.moving_mass_kg, STALL_N)
    return fit_basic_twin(problem).to_identification()
