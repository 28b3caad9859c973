"""The simulated machine: converters and sensors round the plant, paced by any clock.

Nothing in the samples depends on the clock or on how reads are cut: real time, as fast as possible
and a test see the same run to the bit. What is planted to go wrong is in `faults.py`.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from table_io.backends import PATIENCE_S, MachineLost
from table_io.backends.faults import planted
from table_io.backends.plant import SIGNALS, Plant
from table_io.backends.truth import Truth, unsealed
from table_io.backends.truth_applied import Misread, hidden_plant
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.profile import Specimen
from table_io.rig import Output, Rig, SimulatedTable
from table_io.sensor import Sensor

REPLACE_AFTER_S = 0.02


def plant_on(table: SimulatedTable, specimen: Specimen, rate_hz: float) -> Plant:
    """The plant that a machine card and a specimen describe."""
    right, left = specimen.gaps_m
    return Plant(
        mass_kg=specimen.mass_kg,
        damper_stiffness_n_m=table.damper_stiffness_n_m,
        damper_damping_n_s_m=table.damper_damping_n_s_m,
        bumper_stiffness_n_m=table.bumper_stiffness_n_m,
        bumper_damping_n_s_m=table.bumper_damping_n_s_m,
        gap_right_m=right,
        gap_left_m=left,
        table_mass_kg=table.moving_mass_kg,
        servo_bandwidth_hz=table.servo_bandwidth_hz,
        servo_delay_s=table.servo_delay_ms * 1e-3,
        payload_reaction=table.payload_reaction,
        rate_hz=rate_hz,
    )


def truth_of(table: SimulatedTable) -> Truth | None:
    """What a machine card hides, None where it says nothing of a truth; BadInput tells why not."""
    if table.truth is None:
        return None
    try:
        raw = Path(table.truth).read_bytes()
    except OSError as error:
        raise BadInput(
            f"simulated.truth = {table.truth!r}: cannot read this sealed truth: {error}; give its "
            "path, absolute or from the working directory"
        ) from None
    return unsealed(raw, str(table.truth_sha256), table.truth)


def played(volts: Float1D, output: Output) -> Float1D:
    """Command in m, (sample,), as the converter plays it: whole steps, held at the rails."""
    step = 2 * output.span_v / 2**output.bits
    half = 2 ** (output.bits - 1)
    codes = np.clip(np.rint(volts / step), -half, half - 1)
    metres: Float1D = codes * (step / output.volts_per_m)
    return metres


class Digitiser:
    """Volts of all sensors from true values: offset, noise, range and steps of the card."""

    def __init__(self, sensors: tuple[Sensor, ...]) -> None:
        def column(values: list[float]) -> Float2D:
            return np.array(values, dtype=np.float64)[:, None]

        self._gain = column([s.volts_per_si for s in sensors])
        # The command wired back has no sensor, and it is never tared: no offset.
        wired = [s.channel == "drive_disp_m" for s in sensors]
        offsets = [
            0.0 if w else s.offset * s.si_per_unit for s, w in zip(sensors, wired, strict=True)
        ]
        self._offset = column(offsets)
        self._noise = column([s.noise_rms * s.si_per_unit for s in sensors])
        self._half = column([2.0 ** (s.bits - 1) for s in sensors])
        self._step = column([abs(s.range * s.volts_per_unit) for s in sensors]) / self._half

    def volts(self, values: Float2D, noise: np.random.Generator) -> Float2D:
        """Volts, (channel, sample), from SI values of the same shape.

        Noise is drawn sample by sample, so the cut of the samples into calls does not change it.
        """
        draw = noise.standard_normal(values.shape[::-1]).T
        codes = np.rint((values + self._offset + self._noise * draw) * self._gain / self._step)
        digitised: Float2D = np.clip(codes, -self._half, self._half - 1) * self._step
        return digitised


class SimulatedBackend:
    """The Backend contract on a simulated machine; sample i is taken at start + i / rate_hz."""

    def __init__(self, rig: Rig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        if rig.simulated is None:
            raise BadInput(f"rig {rig.name}: no [simulated] table; add it, or name another backend")
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = round(REPLACE_AFTER_S * rate_hz)
        self._rig = rig
        self._clock = clock
        self._plant = plant_on(rig.simulated, specimen, rate_hz)
        self._misread: Misread | None = None
        if truth := truth_of(rig.simulated):
            self._plant = hidden_plant(self._plant, truth)
            self._misread = Misread(truth, rig.channels, rate_hz)
        self._softened = lru_cache(2)(self._soften)
        self._faults = planted(rig.simulated.faults, rig, rate_hz, rig.simulated.seed)
        self._state = self._plant.rest()
        self._digitiser = Digitiser(rig.sensors)
        self._noise = np.random.default_rng([rig.simulated.seed, 0])
        self._tare_noise = np.random.default_rng([rig.simulated.seed, 1])
        # Played command in m from sample `_origin` on; before sample 0 the output stands at 0 V.
        self._past = self._plant.history + self._faults.reach
        self._command = np.zeros(self._past)
        self._origin = -self._past
        self._next = 0
        self._epoch: float | None = None
        self._is_open = False
        # Told the truth of what is taken: (first sample, command in m, SIGNALS in SI).
        self.witness: Callable[[int, Float1D, Float2D], None] | None = None

    def open(self) -> None:
        """Checks the rate and compiles the plant, so that the first read is not late."""
        self._rig.refuse_rate(self.rate_hz)
        nothing = np.empty((len(self._plant.signals), 0))
        self._plant.advance(self._plant.rest(), np.zeros(self._plant.history), nothing)
        self._is_open = True

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample)."""
        self._demand(self._is_open, "open() comes first")
        return self._digitiser.volts(np.zeros((len(self.channels), samples)), self._tare_noise)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, (sample,); the last value is held."""
        self._demand(self._is_open, "open() comes first")
        earliest = 0 if self._epoch is None else self._newest() + self.replace_after
        if index < earliest:
            raise ValueError(
                f"the command from sample {index} on is already in the device; allowed: from "
                f"{earliest} on ({self.replace_after} after the newest sample taken)"
            )
        if not np.isfinite(volts).all():
            raise ValueError(f"the command from sample {index} on holds NaN or inf; send volts")
        oldest = self._next - self._past
        kept = self._commanded(oldest, index)
        self._command = np.concatenate([kept, played(volts, self._rig.output)])
        self._origin = oldest

    def start(self) -> None:
        """Start output and input at sample 0, now."""
        self._demand(self._is_open, "open() comes first")
        self._demand(self._epoch is None, "it runs already; one start() a life")
        self._epoch = self._clock.now()

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""
        self._demand(self._is_open, "it is closed")
        self._wait(self._next, self._next + samples)
        return self.take(samples)

    def late_s(self, first: int, last: int) -> float:
        """How long after their schedule samples first .. last - 1 are handed over; inf: never."""
        return self._faults.late_s(first, last)

    def take(self, samples: int) -> Float2D:
        """The same without waiting: for a machine that keeps its own time."""
        first = self._next
        known = self._commanded(first - self._past, first + samples)
        drive = self._faults.output(first - self._past, known)[self._faults.reach :]
        command = self._faults.servo(first - self._plant.history, drive)
        signals = np.empty((len(self._plant.signals), samples))
        done = 0
        for count, share in self._faults.bandwidth(first, samples):
            until = done + count
            span = command[done : self._plant.history + until]
            self._softened(share).advance(self._state, span, signals[:, done:until])
            done = until
        self._next += samples
        played_m = drive[self._plant.history :]
        if self.witness is not None:
            self.witness(first, played_m, signals[: len(SIGNALS)])
        values = self._values(played_m, signals)
        if self._misread is not None:
            values = self._misread.of(values)
        return self._faults.inputs(first, self._digitiser.volts(values, self._noise))

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` is taken, in s."""
        if self._epoch is None:
            raise RuntimeError("simulated table: start() comes first")
        return self._epoch + index / self.rate_hz

    def close(self) -> None:
        """Release the machine; safe to call twice."""
        self._is_open = False

    def _wait(self, first: int, last: int) -> None:
        """Until samples first .. last - 1 have come; MachineLost where they do not in time."""
        due, late_s = self.scheduled(last - 1), self.late_s(first, last)
        self._clock.wait_until(due + min(late_s, PATIENCE_S))
        if late_s > PATIENCE_S:
            raise MachineLost(
                f"the simulated table has not sent the samples up to {last - 1}, {PATIENCE_S:g} s "
                "after their schedule; what is queued plays to rest. Look after the machine, then "
                "start anew"
            )

    def _newest(self) -> int:
        """The newest sample that the machine has taken by now, read or not."""
        since = self._clock.now() - self.scheduled(0)
        return max(self._next - 1, math.floor(since * self.rate_hz + 1e-6))

    def _soften(self, share: float) -> Plant:
        """The plant with this share of its servo's bandwidth."""
        bandwidth = share * self._plant.servo_bandwidth_hz
        return self._plant if share == 1.0 else replace(self._plant, servo_bandwidth_hz=bandwidth)

    def _demand(self, condition: bool, remedy: str) -> None:
        if not condition:
            raise RuntimeError(f"simulated table: {remedy}")

    def _commanded(self, first: int, last: int) -> Float1D:
        """Played command in m of samples first .. last - 1; beyond the queue its last value."""
        start, stop = first - self._origin, last - self._origin
        size = self._command.size
        if stop <= size:
            return self._command[start:stop]
        held = np.full(stop - max(start, size), self._command[-1])
        return np.concatenate([self._command[start:], held])

    def _values(self, drive: Float1D, signals: Float2D) -> Float2D:
        """True values in SI, (channel, sample); the two cells of a side share its force."""
        y, y_acc, x, x_acc, right, left, *hidden = signals
        balance = -self._plant.mass_kg * x_acc - right - left
        true = {
            "drive_disp_m": drive,
            "table_disp_m": y,
            "table_acc_m_s2": y_acc,
            "mass_disp_m": x,
            "mass_acc_m_s2": x_acc,
            "force_r1_n": 0.5 * right,
            "force_r2_n": 0.5 * right,
            "force_l1_n": -0.5 * left,
            "force_l2_n": -0.5 * left,
            "damper_force_n": hidden[0] if hidden else balance,
            "rel_disp_m": x - y,
        }
        return np.array([true[name] for name in self.channels])
