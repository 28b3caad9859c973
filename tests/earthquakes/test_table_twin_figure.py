"""Frequency response of a rehearsal: a known linear table is recovered, silence is left out."""

import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image
from scipy import signal

from tests.earthquakes.hydraulic_rig import RATE_HZ, make_random_motion
from twin.earthquakes.figures import draw_table_twin, estimate_response, plot_steps
from twin.earthquakes.table_identification import TableRehearsal
from twin.earthquakes.table_model import TableModel, TableParameters

CORNER_HZ, DELAY = 4.0, 12  # of a first-order table, Hz and samples


def make_rehearsal() -> TableRehearsal:
    """Return a rehearsal from 0.3 to 25 Hz of a first-order table with a delay."""
    command = make_random_motion(40.0, (0.3, 25.0), 0.2, seed=4)
    w = math.tau * CORNER_HZ
    late = np.concatenate([np.zeros(DELAY), command[:-DELAY]])
    times = np.arange(command.size) / RATE_HZ
    _, table, _ = signal.lsim(([w], [1.0, w]), late, times)
    acceleration = np.gradient(np.gradient(table)) * RATE_HZ**2
    return TableRehearsal(RATE_HZ, command, table, acceleration, np.zeros(command.size))


def test_the_response_of_a_known_table() -> None:
    rehearsal = make_rehearsal()
    hz, response, coherence = estimate_response(rehearsal, rehearsal.acceleration_m_s2)
    expected = np.exp(-2j * math.pi * hz * DELAY / RATE_HZ) / (1.0 + 1j * hz / CORNER_HZ)
    inside = (hz > 0.6) & (hz < 24.0)
    assert hz[inside].size > 100
    assert np.abs(response / expected - 1.0)[inside].max() < 0.05
    assert coherence[inside].min() > 0.98
    assert hz.max() < 26.0  # nothing was played above


def test_the_figure_is_drawn(tmp_path: Path, full_quality: None) -> None:
    draw_table_twin(TableModel(2000.0), make_rehearsal(), "Table", tmp_path / "table.png")
    pixels = np.asarray(Image.open(tmp_path / "table.png").convert("L"))
    assert pixels.shape[1] > 1000
    assert np.mean(pixels < 128) > 0.003  # lines and text


def test_a_step_is_drawn_with_its_delay() -> None:
    """The curve of a table with 100 ms of delay rests for 100 ms."""
    figure = Figure()
    axis = figure.subplots()
    plot_steps(axis, TableModel(2000.0, TableParameters(delay_s=0.1)))
    time_s, reached = axis.lines[0].get_data()
    assert np.abs(np.asarray(reached)[np.asarray(time_s) < 0.095]).max() < 1e-3
    assert np.asarray(reached)[-1] > 0.8
