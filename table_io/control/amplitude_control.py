"""Amplitude control: iterative correction of the command from the tracked table acceleration.

The correction is frozen while a step is measured. An accepted correction is the start value of the
next visit to that frequency, in either direction.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from table_io.config.profile import ControlConfig
from table_io.config.rig import TableResponse
from table_io.control.table_response import evaluate_transfer
from table_io.excitation.trajectory import SineTarget
from table_io.harmonics import HarmonicFit
from table_io.records import FrequencyResponse, Step

CANCELLED_ORDERS = (2, 3, 4, 5)  # harmonic orders of the table acceleration
ACCEPTED_TOLERANCE_SHARE = (
    0.5  # of the tolerance; the rest is left for drift during the measured cycles
)
CANCEL_GAIN = 0.8
CANCELLED_RATIO = 10 ** (-15 / 20)  # of a harmonic at the first evaluation: cancelled


@dataclass(frozen=True)
class Tuning:
    """Tuning state: the table's FRF at low level and the accepted corrections.

    `max_correction` limits a correction and its inverse (`TableResponse.max_correction`), and
    `find_room` returns the largest one at (frequency in Hz, level in m/s2) for which the command
    stays within the limits of the rig.
    """

    response: FrequencyResponse | None = None
    accepted: tuple[SineTarget, ...] = ()
    max_correction: float = TableResponse().max_correction
    find_room: Callable[[float, float], float] | None = None

    def predict_target(self, step: Step) -> SineTarget:
        """Predict the start target of a step from this frequency, else from its neighbor."""
        for target in reversed(self.accepted):
            if target.frequency_hz == step.frequency_hz:
                again = replace(target, level_m_s2=step.acceleration_m_s2)
                return self.correct(again, target.correction)
        correction = self._inverse_gain(step.frequency_hz)
        if self.accepted:
            neighbour = self.accepted[-1]
            correction *= neighbour.correction / self._inverse_gain(neighbour.frequency_hz)
        return self.correct(SineTarget(step.frequency_hz, step.acceleration_m_s2), correction)

    def add_accepted(self, target: SineTarget) -> "Tuning":
        """Return the tuning with one more accepted correction."""
        remaining = tuple(
            accepted for accepted in self.accepted if accepted.frequency_hz != target.frequency_hz
        )
        return replace(self, accepted=(*remaining, target))

    def transfer(self, frequency_hz: float) -> complex:
        """Return the complex FRF, table acceleration over command; 1 if none was identified."""
        return 1.0 + 0j if self.response is None else evaluate_transfer(self.response, frequency_hz)

    def correct(self, target: SineTarget, correction: float) -> SineTarget:
        """Return a target with a correction of its command, within its limits."""
        largest = self.max_correction
        if self.find_room is not None:
            # Never below 1: a command that is not corrected is refused before motion, not lowered.
            room = max(1.0, self.find_room(target.frequency_hz, target.level_m_s2))
            largest = min(largest, room)
        clamped = float(np.clip(correction, 1.0 / self.max_correction, largest))
        return replace(target, correction=clamped)

    def _inverse_gain(self, frequency_hz: float) -> float:
        return 1.0 / abs(self.transfer(frequency_hz))


def update_target(
    target: SineTarget,
    measured: HarmonicFit,
    first: HarmonicFit,
    tuning: Tuning,
    config: ControlConfig,
) -> SineTarget:
    """Return the next target to try, or `target` itself if level and harmonics are good enough.

    `measured` is the table acceleration at `target`, `first` that of the first evaluation of this
    step.
    """
    error = measured.fundamental / target.level_m_s2 - 1.0
    new_target = target
    if abs(error) > ACCEPTED_TOLERANCE_SHARE * config.tolerance:
        max_factor = 10 ** (config.clamp_db / 20)
        factor = float(np.clip((1.0 + error) ** -config.gain, 1.0 / max_factor, max_factor))
        new_target = tuning.correct(target, target.correction * factor)
    if config.harmonics:
        new_target = replace(new_target, shape=_cancel_harmonics(target, measured, first, tuning))
    return new_target


def is_within_tolerance(target: SineTarget, measured: HarmonicFit, config: ControlConfig) -> bool:
    """Return True if the fundamental is within the tolerance of the demanded level."""
    return abs(measured.fundamental / target.level_m_s2 - 1.0) <= config.tolerance


def _cancel_harmonics(
    target: SineTarget, measured: HarmonicFit, first: HarmonicFit, tuning: Tuning
) -> tuple[complex, ...]:
    """Return orders 2 to 5 of the command, relative, that cancel the harmonics of the table.

    A command of order k has the acceleration corrected level * k^2 * shape_k; the table follows it
    with its FRF at k f.
    """
    shape = []
    noise = 3.0 * measured.residual_rms * math.sqrt(2.0 / 1000.0)
    for order in CANCELLED_ORDERS:
        previous = target.shape[order - 2] if order - 2 < len(target.shape) else 0j
        amplitude = measured.amplitudes[order - 1]
        goal = max(CANCELLED_RATIO * abs(first.amplitudes[order - 1]), noise)
        if abs(amplitude) <= goal:
            shape.append(previous)
            continue
        response = tuning.transfer(order * target.frequency_hz) * target.corrected_m_s2 * order**2
        shape.append(previous - CANCEL_GAIN * complex(amplitude) / response)
    return tuple(shape) if any(shape) else ()
