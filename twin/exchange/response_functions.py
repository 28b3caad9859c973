"""Spectra of a log: frequency responses of a stepped sine, and spectrograms of all channels.

A frequency response is each channel over the acceleration of the table, by step.

The fundamentals are those of order tracking over the measured cycles of a step. A specimen with
contacts is not linear: the ratio holds at the level and in the direction of its sweep.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D, Label
from table_io.channels import TIME_COLUMN
from table_io.harmonics import Complex1D, track_harmonics
from twin.exchange.columns import is_added_column
from twin.recording.tabular import DIRECTION_SIGNS, LogTable

REFERENCE = "table_acc_m_s2"
SPECTRUM_WINDOW_S = 4.0  # of a spectrogram: lines 0.25 Hz apart


@dataclass(frozen=True, slots=True, eq=False)
class SweepResponse:
    """Complex ratio of each channel to the table's acceleration, (step,), of one direction."""

    direction: str
    frequency_hz: Float1D
    ratios: dict[str, Complex1D]


def list_measured_channels(rows: LogTable) -> list[str]:
    """Return the columns that were measured, without time and labels."""
    return [name for name in rows.units if name != TIME_COLUMN and not is_added_column(name)]


def compute_spectrograms(
    rows: LogTable,
) -> tuple[Float1D, Float1D, Iterator[tuple[str, Float2D]]] | None:
    """Return (times in s of the windows, frequencies in Hz, power density of each channel).

    A density is one-sided, (window, frequency), in unit^2/Hz, of windows of SPECTRUM_WINDOW_S that
    overlap by half, without their means (Hann; Welch 1967); NaN where samples are lost. None for a
    log that is shorter than a window.
    """
    rate_hz = rows.start.rate_hz
    index = rows.index
    index -= index[0]
    size = round(SPECTRUM_WINDOW_S * rate_hz)
    if size < 2 or index[-1] < size:
        return None
    from scipy.signal import spectrogram  # slow to import

    first_s = float(rows.read_columns(slice(0, 1), TIME_COLUMN)[TIME_COLUMN][0])

    def compute(name: str) -> tuple[Float1D, Float1D, Float2D]:
        values = np.full(int(index[-1]) + 1, np.nan)
        values[index] = rows.read_columns(slice(None), name)[name]
        hz, time_s, density = spectrogram(values, rate_hz, "hann", size, size // 2)
        return hz, time_s + first_s, np.ascontiguousarray(density.T)

    names = list_measured_channels(rows)
    frequency_hz, time_s, _ = compute(names[0])
    return time_s, frequency_hz, ((name, compute(name)[2]) for name in names)


def compute_sweep_responses(rows: LogTable) -> list[SweepResponse]:
    """Return the responses of the directions of a log; [] without steps or table acceleration."""
    if REFERENCE not in rows.units:
        return []
    channels = list_measured_channels(rows)
    step, label, time_s = (
        rows.read_columns(slice(None), name)[name] for name in ("step", "label", TIME_COLUMN)
    )
    values = np.array([rows.read_columns(slice(None), name)[name] for name in channels])
    is_measured = label == int(Label.MEASURE)
    responses = []
    for direction in DIRECTION_SIGNS:
        steps = [
            entry
            for entry in rows.steps.values()
            if entry.direction == direction and (is_measured & (step == entry.index)).any()
        ]
        if not steps:
            continue
        ratios = np.empty((len(channels), len(steps)), dtype=np.complex128)
        for k, entry in enumerate(steps):
            samples = np.flatnonzero(is_measured & (step == entry.index))
            phase = entry.frequency_hz * time_s[samples]
            fundamentals = np.array([_fit_fundamental(row[samples], phase) for row in values])
            ratios[:, k] = fundamentals / fundamentals[channels.index(REFERENCE)]
        order = np.argsort([entry.frequency_hz for entry in steps], kind="stable")
        frequency_hz = np.array([steps[k].frequency_hz for k in order])
        named = dict(zip(channels, ratios[:, order], strict=True))
        responses.append(SweepResponse(direction, frequency_hz, named))
    return responses


def _fit_fundamental(values: Float1D, phase: Float1D) -> complex:
    """Return the fundamental of the samples that are known; NaN if they are too few."""
    known = np.isfinite(values)
    return complex(track_harmonics(values[known], phase[known]).amplitudes[0])
