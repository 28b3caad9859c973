"""Feedback that holds an unstable periodic orbit, for control-based continuation.

The deviation e = x - x_ref of the mass's displacement in the laboratory frame is fitted by
Re(E exp(i w t)) over a short window, w being the frequency of the drive. The correction of the
command answers it a fixed horizon later, so a sine-like deviation is answered at its true phase:

    c(t) = share Re((g + i w d) E exp(i w (t - horizon)))

Every block gives such a function. It replaces the previous one by a quintic blend, so the command
stays C2, and it fades to zero if no later block replaces it. The amplitude of the correction is
limited, and so is the acceleration of the command with it: what would raise the held command is
cut, what turns or lowers it is not. Whether it comes from a deviation, from the share or from a
fade, the blend to the next function is as long as that needs, and beyond the longest one a block
replaces only a part of the previous function.

Why x and not u = x - y: at frequencies above its resonance the mass stands still, so u = -y returns
the correction at a gain of about -g with the delay of the loop, which is close to instability.
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.config.excitation.continuation import unpack_harmonics
from table_io.config.excitation.waveform import smoothstep
from table_io.excitation.drive import Correction, Drive

# Of the fit. Longer rejects more noise, which a limited acceleration would rectify into a steady
# feedback; shorter follows a faster growth.
WINDOW_S = 0.06
BLEND_S = 0.02  # from the previous function to the next
BLEND_FACTORS = (1.0, 1.5, 2.25, 3.5, 5.0)  # on it: the first that the acceleration allows
PREDICTION_S = 0.05  # after the horizon, until the function fades if no block replaces it
FADE_S = 0.15
MAX_COMMAND_RATIO = 1.125  # acceleration of command and feedback over that of the held command
STEADY_SHARE = 0.98  # of that acceleration for a steady correction: the rest is for its changes


@dataclass(frozen=True, eq=False)
class ReferenceSegment:
    """Reference that blends from `before` to `after` over `count` samples and stays there.

    The references are harmonics of x in m as a real vector, at the phase of the drive. The gains
    and `share`, the part of the feedback that acts, blend alike.
    """

    start: int
    count: int
    before: Float1D
    after: Float1D
    share0: float
    share1: float
    gain: float
    rate_gain_s: float
    limit_m: float  # amplitude of the correction
    max_acceleration_m_s2: float  # of the command as it is written, the correction included

    def share(self, indices: Int1D) -> Float1D:
        """Return the share at sample indices, (sample,)."""
        return self.share0 + (self.share1 - self.share0) * self._blend(indices)

    def displacement(self, indices: Int1D, phase: Float1D) -> Float1D:
        """Return x_ref in m at sample indices, of which `phase` is the drive's in cycles."""
        before, after = evaluate_harmonics(self.before, phase), self.after
        if after is self.before:
            return before
        return before + (evaluate_harmonics(after, phase) - before) * self._blend(indices)

    def _blend(self, indices: Int1D) -> Float1D:
        return smoothstep((indices - self.start) / max(self.count, 1))


def evaluate_harmonics(vector: Float1D, phase: Float1D) -> Float1D:
    """Return Re sum_k X_k exp(2 pi i k phase) of a real vector of harmonics, phase in cycles."""
    rotation = np.exp(2j * math.pi * phase)
    total = np.zeros(phase.size, dtype=np.complex128)
    for coefficient in unpack_harmonics(vector)[::-1]:
        total = total * rotation + coefficient
    return total.real


@dataclass(frozen=True, eq=False)
class FeedbackState:
    """State of the feedback: references by sample, recent deviations and the last function."""

    horizon: int  # samples from the end of a block to the first one that it corrects
    segments: tuple[ReferenceSegment, ...] = ()
    deviation_m: Float1D = field(default_factory=lambda: np.empty(0))
    index: int = 0  # end of the last block that was answered
    saturated_samples: int = 0  # since the limit was last not reached

    def append(self, segment: ReferenceSegment) -> "FeedbackState":
        """Return the state with one more reference, which replaces those that start after it."""
        kept = tuple(earlier for earlier in self.segments if earlier.start < segment.start)
        return replace(self, segments=(*kept, segment))

    def segment_at(self, index: int) -> ReferenceSegment:
        """Return the reference at sample `index`."""
        starts = [segment.start for segment in self.segments]
        return self.segments[max(bisect_right(starts, index) - 1, 0)]

    def reference(self, first: int, phase: Float1D) -> Float1D:
        """Return x_ref in m from sample `first` on at the drive's phase in cycles, (sample,)."""
        indices, values = np.arange(first, first + phase.size), np.empty(phase.size)
        done = 0
        while done < phase.size:
            segment = self.segment_at(first + done)
            later = [s.start for s in self.segments if s.start > first + done]
            end = min(min(later, default=first + phase.size) - first, phase.size)
            values[done:end] = segment.displacement(indices[done:end], phase[done:end])
            done = end
        return values


def advance_feedback(
    state: FeedbackState, drive: Drive, first: int, x_m: Float1D, earliest: int, keep_from: int
) -> tuple[FeedbackState, Correction, int]:
    """Return (state, correction, first changed sample) after measured x in m, (sample,).

    The correction changes from the later of the horizon and `earliest` on. A window with lost
    samples changes nothing: the last function fades.
    """
    rate_hz, end = drive.rate_hz, first + x_m.size
    phase = drive.phase(first, x_m.size)
    window = round(WINDOW_S * rate_hz)
    deviation = np.concatenate([state.deviation_m, x_m - state.reference(first, phase)])[-window:]
    state = replace(state, deviation_m=deviation)
    start = max(end + state.horizon, earliest)
    segment = state.segment_at(start)
    w = 2.0 * math.pi * drive.frequency_hz(end)
    if not w or deviation.size < window or not np.isfinite(deviation).all():
        return state, drive.correction, start
    rotation = np.exp(1j * w * np.arange(-window, 0) / rate_hz)
    count = round((PREDICTION_S + FADE_S) * rate_hz) + max(start - end - state.horizon, 0)
    # Two samples before and after, so that every second difference that changes is among these.
    command = drive.command(start - 2, count + 4)
    previous = drive.correction.displacement(start - 2, count + 4)
    indices = np.arange(start, start + count)
    turns = np.exp(1j * w * (indices - end - state.horizon) / rate_hz)
    sought = complex(segment.gain, w * segment.rate_gain_s) * _fit_phasor(deviation, rotation)
    phasor = sought * min(1.0, segment.limit_m / max(abs(sought), segment.limit_m))
    nominal = _fit_phasor((command - previous)[2 : window + 2], turns[:window])
    radius = STEADY_SHARE * segment.max_acceleration_m_s2 / w**2
    if abs(nominal + phasor) > max(radius, abs(nominal)):
        phasor = (nominal + phasor) * max(radius, abs(nominal)) / abs(nominal + phasor) - nominal
    is_saturated = phasor != sought
    saturated = state.saturated_samples + end - state.index if is_saturated else 0
    state = replace(state, index=end, saturated_samples=saturated)
    values = np.real(phasor * turns) * (
        1.0 - smoothstep((indices - indices[-1]) / (FADE_S * rate_hz) + 1.0)
    )
    values *= segment.share(indices)
    difference = np.pad(values - previous[2:-2], 2)
    limit = segment.max_acceleration_m_s2 / rate_hz**2
    for factor in BLEND_FACTORS:
        blend = smoothstep(np.arange(-2, count + 2) / (factor * BLEND_S * rate_hz))
        share = _limit_change(command, difference * blend, limit)
        if share == 1.0:
            break
    values = (previous + share * difference * blend)[2:-2]
    return state, drive.correction.replace_from(start, values, keep_from), start


def _limit_change(previous: Float1D, change: Float1D, limit: float) -> float:
    """Return the largest part of a change, 0 to 1, that keeps second differences within a limit.

    previous, change: (sample,) in m. Where the previous function is beyond the limit, which has
    fallen, the change may not add to it.
    """
    before, added = np.diff(previous, 2), np.diff(change, 2)
    room = np.maximum(limit, np.abs(before)) - np.sign(added) * before
    size = np.abs(added)
    return float(min(1.0, np.min(room[size > 0.0] / size[size > 0.0], initial=1.0)))


def _fit_phasor(deviation: Float1D, rotation: Float1D) -> complex:
    """Return E of the least-squares fit Re(E rotation) of a deviation, both (sample,)."""
    basis = np.column_stack([rotation.real, -rotation.imag])
    # Not BLAS: on a busy computer its threads can wait seconds for one another.
    normal, rhs = np.einsum("ij,ik->jk", basis, basis), np.einsum("ij,i->j", basis, deviation)
    real, imaginary = np.linalg.solve(normal, rhs)
    return complex(real, imaginary)
