"""Amplitude control: how the command is corrected, from what was tracked at a step.

Between measured cycles only: a correction is frozen while a step is measured, and what was accepted
at a frequency is where the next visit begins, also on the way back.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from table_io.course import Aim
from table_io.loop_check import transfer_at
from table_io.profile import Control
from table_io.records import Response, Step
from table_io.tracking import Tracked

CANCELLED = (2, 3, 4, 5)  # orders of the table's harmonics
INNER = 0.5  # of the tolerance: what is accepted drifts a little while it is measured
MOST = 2.0  # the correction and its inverse; more is a fault, not a roll-off
CANCEL_GAIN = 0.8
ENOUGH = 10 ** (-15 / 20)  # of a harmonic at the first look: cancelled well enough


@dataclass(frozen=True)
class Tuning:
    """What is known of the table so far: its response at low level, and what was accepted."""

    response: Response | None = None
    accepted: tuple[Aim, ...] = ()

    def predicted(self, step: Step) -> Aim:
        """Where tuning begins at a step: as before at this frequency, else from its neighbour."""
        for aim in reversed(self.accepted):
            if aim.frequency_hz == step.frequency_hz:
                return replace(aim, level_m_s2=step.acceleration_m_s2)
        correction = self._inverse(step.frequency_hz)
        if self.accepted:
            near = self.accepted[-1]
            correction *= near.correction / self._inverse(near.frequency_hz)
        return Aim(step.frequency_hz, step.acceleration_m_s2, _bounded(correction))

    def learnt(self, aim: Aim) -> "Tuning":
        """With one more accepted correction."""
        others = tuple(one for one in self.accepted if one.frequency_hz != aim.frequency_hz)
        return replace(self, accepted=(*others, aim))

    def transfer(self, frequency_hz: float) -> complex:
        """Table acceleration over command, complex; 1 where nothing was identified."""
        return 1.0 + 0j if self.response is None else transfer_at(self.response, frequency_hz)

    def _inverse(self, frequency_hz: float) -> float:
        return 1.0 / abs(self.transfer(frequency_hz))


def updated(aim: Aim, seen: Tracked, first: Tracked, tuning: Tuning, card: Control) -> Aim:
    """The aim to try next; `aim` itself where the level, and the harmonics, are good enough.

    `seen` is the table's acceleration at `aim`, `first` at the first look at this step.
    """
    error = seen.fundamental / aim.level_m_s2 - 1.0
    new = aim
    if abs(error) > INNER * card.tolerance:
        most = 10 ** (card.clamp_db / 20)
        factor = float(np.clip((1.0 + error) ** -card.gain, 1.0 / most, most))
        new = replace(new, correction=_bounded(aim.correction * factor))
    if card.harmonics:
        new = replace(new, shape=_cancelling(aim, seen, first, tuning))
    return new


def within(aim: Aim, seen: Tracked, card: Control) -> bool:
    """True where the fundamental is within the tolerance of the demanded level."""
    return abs(seen.fundamental / aim.level_m_s2 - 1.0) <= card.tolerance


def _cancelling(aim: Aim, seen: Tracked, first: Tracked, tuning: Tuning) -> tuple[complex, ...]:
    """Orders 2 to 5 of the command that take the table's harmonics away.

    A command of relative order k has the acceleration level k^2 shape_k; the table follows it with
    its response at k f.
    """
    shape = []
    noise = 3.0 * seen.residual_rms * math.sqrt(2.0 / 1000.0)
    for order in CANCELLED:
        before = aim.shape[order - 2] if order - 2 < len(aim.shape) else 0j
        left = seen.amplitudes[order - 1]
        enough = max(ENOUGH * abs(first.amplitudes[order - 1]), noise)
        if abs(left) <= enough:
            shape.append(before)
            continue
        follows = tuning.transfer(order * aim.frequency_hz) * aim.corrected_m_s2 * order**2
        shape.append(before - CANCEL_GAIN * complex(left) / follows)
    return tuple(shape) if any(shape) else ()


def _bounded(correction: float) -> float:
    return float(np.clip(correction, 1.0 / MOST, MOST))
