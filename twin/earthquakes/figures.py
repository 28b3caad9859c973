"""Figure of a table's twin: frequency response against the rehearsal, and step responses."""

import math
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter
from scipy import signal

from table_io.block import Float1D
from twin.drawing.pictures import RC_PARAMS
from twin.drawing.plot_style import GUIDE_COLOUR, measured_style, twin_style
from twin.earthquakes.table_identification import HIGHEST_HZ, LOWEST_HZ, TableRehearsal
from twin.earthquakes.table_response import PredictiveModel

SEGMENT_S = 5.0  # of the estimate of the frequency response
EXCITED_SHARE = 0.01  # of the largest power of the command: less says nothing of the table
STEPS_MM = 0.1, 1.0, 5.0
STEP_S, STEP_RATE_HZ = 1.0, 2000.0
REST_S = 0.01  # before a step, besides the delay


def draw_table_twin(
    model: PredictiveModel, rehearsal: TableRehearsal, title: str, out: Path
) -> None:
    """Draw gain, phase and coherence of a rehearsal and its twin, and steps of the twin."""
    played = model.simulate(rehearsal.command_m, rehearsal.rate_hz, rehearsal.reaction_n)
    measured = estimate_response(rehearsal, rehearsal.acceleration_m_s2)
    expected = estimate_response(rehearsal, played[1])
    with rc_context(RC_PARAMS):
        figure = Figure(figsize=(10.0, 7.0))
        FigureCanvasAgg(figure)
        (gain, step), (phase, coherence) = figure.subplots(2, 2, width_ratios=(1.25, 1.0))
        for (hz, response, shared), style, label in (
            (measured, measured_style("forward"), "measured"),
            (expected, twin_style("forward"), "twin"),
        ):
            gain.plot(hz, np.abs(response), **style, label=label)
            phase.plot(hz, np.degrees(np.unwrap(np.angle(response))), **style)
            coherence.plot(hz, shared, **style)
        linear = model.frequency_response(measured[0])
        style = {"color": GUIDE_COLOUR, "ls": (0, (4, 2)), "lw": 0.9}
        gain.plot(measured[0], np.abs(linear), **style, label="twin without friction")
        phase.plot(measured[0], np.degrees(np.unwrap(np.angle(linear))), **style)
        gain.set_yscale("log")
        gain.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 4.0, 6.0)))
        gain.yaxis.set_major_formatter(FuncFormatter(lambda ratio, _: f"{ratio:g}"))
        gain.yaxis.set_minor_formatter(NullFormatter())
        phase.yaxis.set_major_locator(MultipleLocator(45.0))
        gain.legend(loc="lower left")
        for axis, text in ((gain, "gain"), (phase, "phase in degrees"), (coherence, "coherence")):
            _arrange_frequencies(axis)
            axis.set_title(f"{text}, table over command, by the rehearsal")
        coherence.set_ylim(0.0, 1.05)
        coherence.set_title("coherence: what is missing to 1 is nonlinear, or noise")
        plot_steps(step, model)
        figure.suptitle(title, x=0.01, ha="left", fontsize=10)
        figure.savefig(out)


def estimate_response(
    rehearsal: TableRehearsal, acceleration_m_s2: Float1D
) -> tuple[Float1D, Float1D, Float1D]:
    """Return (frequency in Hz, table over command, coherence) of an acceleration, (k,) each.

    The estimate H1 = S_xy / S_xx over half overlapping segments, x being the acceleration of the
    command; complex. It is what a laboratory draws: friction is in it at the level of the test.
    """
    rate_hz = rehearsal.rate_hz
    command_acc = np.gradient(np.gradient(rehearsal.command_m)) * rate_hz**2
    length = min(round(SEGMENT_S * rate_hz), command_acc.size)
    hz, cross = signal.csd(command_acc, acceleration_m_s2, rate_hz, nperseg=length)
    _, power = signal.welch(command_acc, rate_hz, nperseg=length)
    _, shared = signal.coherence(command_acc, acceleration_m_s2, rate_hz, nperseg=length)
    inside = (hz >= LOWEST_HZ) & (hz <= HIGHEST_HZ) & (power > EXCITED_SHARE * power.max())
    return hz[inside], cross[inside] / power[inside], shared[inside]


def plot_steps(axis: Axes, model: PredictiveModel) -> None:
    """Plot responses of the twin to steps of several sizes, each over its size."""
    time_s = np.arange(round(STEP_S * STEP_RATE_HZ)) / STEP_RATE_HZ
    rest = math.ceil((max(model.delay_s, 0.0) + REST_S) * STEP_RATE_HZ)
    for step_mm, shade in zip(STEPS_MM, (0.35, 0.65, 1.0), strict=True):
        command = np.concatenate([np.zeros(rest), np.full(time_s.size, 1e-3 * step_mm)])
        reached = model.simulate(command, STEP_RATE_HZ)[0][rest:] / command[-1]
        axis.plot(time_s, reached, color="#1559b0", alpha=shade, lw=1.3, label=f"{step_mm:g} mm")
    axis.axhline(1.0, color=GUIDE_COLOUR, lw=0.6)
    axis.set_title("steps of the twin: friction holds small ones back")
    axis.set_xlabel("time in s")
    axis.set_xlim(0.0, STEP_S)
    axis.set_ylim(bottom=0.0)
    axis.legend(loc="lower right")


def _arrange_frequencies(axis: Axes) -> None:
    axis.set_xscale("log")
    axis.set_xlim(LOWEST_HZ, HIGHEST_HZ)
    axis.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda hz, _: f"{hz:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())
    axis.set_xlabel("frequency in Hz")
