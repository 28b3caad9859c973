"""Simulated table: backend with converters and sensors around the plant, paced by any clock.

Samples depend neither on the clock nor on the division of reads: a run is bit-identical in real
time and as fast as possible. Injected faults are in `faults.py`.

A ground truth changes the plant and distorts the readings of sensors, with the parameters and signs
of `ground_truth.DEFINITION_BY_ID`, in SI.
"""

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from table_io.backends import SAMPLE_TIMEOUT_S, MachineLost
from table_io.backends.command_buffer import find_newest_sample, refuse_late_command
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.channel import CONSTANT
from table_io.config.profile import Specimen
from table_io.config.rig import OutputConfig, RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.faults import build_faults
from table_io.sim.ground_truth import GroundTruth, parse_ground_truth
from table_io.sim.hidden_laws import StrangeLaws
from table_io.sim.hydraulic_table import make_coefficients
from table_io.sim.imperfections import Imperfection, resolve_sides
from table_io.sim.laboratory import FractionalDelay, Laboratory
from table_io.sim.plant import RECORDED_SIGNALS, SIGNALS, HiddenCoefficients, Plant

# Parameters whose coefficient has a different name.
COEFFICIENT_NAMES = {
    "coulomb_friction": {"slip_speed": "v0"},
    "bouc_wen": {"force": "fy", "yield_displacement": "uy", "exponent": "n"},
    "bumper_maxwell": {"tau": "tau_b"},
    "gap_drift": {"rate": "gap_rate"},
    "stiffness_drift": {"rate": "stiffness_rate"},
    "dead_band": {"width": "dead_width"},
    "adhesion": {"force": "pull"},
    "appendage": {"mass": "m2", "frequency": "w2", "damping_ratio": "z2"},
}


def hide_laws(plant: Plant, truth: GroundTruth) -> Plant:
    """Return the nominal plant with the true parameters and the hidden effects of a truth."""
    parameters = {
        name: getattr(plant, name) for name in ("mass_kg", "gap_right_m", "gap_left_m", "rate_hz")
    }
    parameters |= truth.base.model_dump(exclude_none=True)
    coefficients: dict[str, Any] = {}
    strange: dict[str, Any] = {}  # parameters of each law in turn
    for effect in truth.effects:
        p = effect.parameters
        match effect.id:
            case "mass_error":
                parameters["mass_kg"] /= p["ratio"]
            case "gap_offset":
                parameters["gap_right_m"] += p["offset"]
                parameters["gap_left_m"] -= p["offset"]
            case "bumper_asymmetry":
                coefficients["stiffness_ratio"] = (
                    2 * p["ratio"] / (1 + p["ratio"]),
                    2 / (1 + p["ratio"]),
                )
            case "stribeck_friction":
                coefficients["fs"] = p["fc"] * p["ratio"]
                coefficients |= {"fc": p["fc"], "vs": p["speed"], "v0": p["slip_speed"]}
            case name if name in StrangeLaws._fields:
                strange[name] = tuple(p[q.name] for q in effect.definition.parameters)
            case _ if not effect.definition.is_sensor_effect:
                names = COEFFICIENT_NAMES.get(effect.id, {})
                coefficients |= {names.get(key, key): value for key, value in p.items()}
    _apply_imperfections(truth.imperfections, parameters, coefficients)
    if "fc" in coefficients:
        coefficients.setdefault("fs", coefficients["fc"])
    if "w2" in coefficients:
        coefficients["w2"] *= 2 * math.pi
    hidden = HiddenCoefficients(
        **coefficients, is_strange=bool(strange), strange=StrangeLaws(**strange)
    )
    return replace(plant, **parameters, hidden=hidden)


def _apply_imperfections(
    imperfections: Sequence[Imperfection],
    parameters: dict[str, Any],
    coefficients: dict[str, Any],
) -> None:
    """Change the parameters and coefficients of a plant by the imperfections of the set-up."""
    for imperfection in imperfections:
        p = imperfection.parameters
        match imperfection.id:
            case "mass_reading":
                parameters["mass_kg"] *= p["ratio"]
            case "table_pitch":
                coefficients["tilt"] = coefficients.get("tilt", 0.0) + p["per_travel"]
                coefficients["pitch"] = p["per_acceleration"]
            case "time_base":
                parameters["rate_hz"] *= 1.0 + 1e-6 * p["deviation"]
    for side, p in resolve_sides(imperfections, "gap_reading").items():
        parameters[f"gap_{side}_m"] += p["offset"]


class SensorDistortion:
    """Distortion of sensor readings by gain, lag and offset; samples must come in order."""

    def __init__(self, truth: GroundTruth, channels: tuple[str, ...], rate_hz: float) -> None:
        for effect in truth.effects:
            effect.check_channel(channels, "the rig has no sensor of this channel")
        self._errors = [
            (effect.id, channels.index(str(effect.channel)), next(iter(effect.parameters.values())))
            for effect in sorted(truth.effects, key=lambda effect: effect.id == "sensor_offset")
            if effect.definition.is_sensor_effect
        ]
        self._delays = {
            row: FractionalDelay(size * rate_hz)
            for effect_id, row, size in self._errors
            if effect_id == "sensor_lag"
        }

    def apply(self, values: Float2D) -> Float2D:
        """Return distorted readings without noise from true values, (channel, sample) each."""
        values = values.copy()
        for effect_id, row, size in self._errors:
            match effect_id:
                case "sensor_gain":
                    values[row] *= size
                case "sensor_offset":
                    values[row] += size
                case "sensor_lag":
                    values[row] = self._delays[row].apply(values[row])
        return values


MIN_REPLACE_AHEAD_S = 0.02


def build_plant(table: SimulatedTableConfig, specimen: Specimen, rate_hz: float) -> Plant:
    """Build the nominal plant of a simulated table and a specimen."""
    right, left = specimen.gaps_m
    oil = None
    if table.hydraulic is not None:
        oil = make_coefficients(table.hydraulic, table.moving_mass_kg)
    return Plant(
        mass_kg=specimen.mass_kg,
        damper_stiffness_n_m=table.damper_stiffness_n_m,
        damper_damping_n_s_m=table.damper_damping_n_s_m,
        bumper_stiffness_n_m=table.bumper_stiffness_n_m,
        bumper_damping_n_s_m=table.bumper_damping_n_s_m,
        gap_right_m=right,
        gap_left_m=left,
        table_mass_kg=table.moving_mass_kg,
        servo_bandwidth_hz=table.servo_bandwidth_hz or math.inf,
        servo_delay_s=table.servo_delay_ms * 1e-3,
        payload_reaction=table.payload_reaction,
        rate_hz=rate_hz,
        hidden=None if oil is None else HiddenCoefficients(),
        oil=oil,
    )


def load_ground_truth(table: SimulatedTableConfig) -> GroundTruth | None:
    """Return the ground truth of a simulated table; None without one; InputError if unreadable."""
    if table.truth is None:
        return table.hidden
    try:
        raw = Path(table.truth).read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read the ground-truth file: {error}",
            key="simulated.truth",
            value=table.truth,
            remedy="give its path, absolute or relative to the working directory",
        ) from None
    return parse_ground_truth(raw, str(table.truth_sha256), table.truth)


def quantize_command(volts: Float1D, output: OutputConfig) -> Float1D:
    """Quantize a command as the converter plays it: m, (sample,), whole steps, clipped."""
    step = 2 * output.span_v / 2**output.bits
    max_code = 2 ** (output.bits - 1)
    codes = np.clip(np.rint(volts / step), -max_code, max_code - 1)
    metres: Float1D = codes * (step / output.volts_per_m)
    return metres


class Digitizer:
    """Digitizer: adds offset and noise to sensor values, clips and quantizes them to volts."""

    def __init__(self, sensors: tuple[SensorConfig, ...]) -> None:
        def column(values: list[float]) -> Float2D:
            return np.array(values, dtype=np.float64)[:, None]

        self._gain = column([s.volts_per_si for s in sensors])
        # The command read back has no sensor and is never tared: no offset.
        wired = [s.channel == "drive_disp_m" for s in sensors]
        offsets = [
            0.0 if w else s.offset * s.si_per_unit for s, w in zip(sensors, wired, strict=True)
        ]
        self._offset = column(offsets)
        self._noise = column([s.noise_si for s in sensors])
        self._half = column([2.0 ** (s.bits - 1) for s in sensors])
        self._step = column([abs(s.range * s.volts_per_unit) for s in sensors]) / self._half

    def digitize(
        self, values: Float2D, noise: np.random.Generator, laboratory: Laboratory
    ) -> Float2D:
        """Return volts, (channel, sample), from SI values of the same shape.

        Noise is drawn sample by sample, so it does not depend on the division into calls; it passes
        the filters of the laboratory.
        """
        samples = noise.standard_normal(values.shape[::-1]).T
        analog = laboratory.condition(values + self._offset, self._noise * samples)
        codes = np.rint(analog * self._gain / self._step)
        digitised: Float2D = np.clip(codes, -self._half, self._half - 1) * self._step
        return digitised


class SimulatedBackend:
    """Backend of the simulated table; sample i is taken at start + i / rate_hz."""

    def __init__(self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        table = rig.require_section("simulated", SimulatedTableConfig)
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = round(MIN_REPLACE_AHEAD_S * rate_hz)
        self._rig = rig
        self._clock = clock
        self._tares_as_set_up = table.tares_as_set_up
        self._plant = build_plant(table, specimen, rate_hz)
        self._distortion: SensorDistortion | None = None
        self._imperfections: tuple[Imperfection, ...] = ()
        if truth := load_ground_truth(table):
            self._plant = hide_laws(self._plant, truth)
            self._distortion = SensorDistortion(truth, rig.channels, self._plant.rate_hz)
            self._imperfections = truth.imperfections
        self._plant_with_share = lru_cache(2)(self._plant.with_servo_share)
        self._faults = build_faults(table.faults, rig, rate_hz, table.seed)
        self._state = self._plant.rest_state()
        self._seed = table.seed
        self._laboratory = self._build_laboratory(np.random.default_rng([table.seed, 4]), 0)
        self._digitizer = Digitizer(self._laboratory.sensors)
        self._noise = np.random.default_rng([table.seed, 0])
        self._tare_noise = np.random.default_rng([table.seed, 1])
        self._tare_laboratory_noise = np.random.default_rng([table.seed, 5])
        # Played command in m from sample `_origin` on; the output is at 0 V before sample 0.
        self._history = self._plant.history_samples + self._faults.history_samples
        self._command = np.zeros(self._history)
        self._origin = -self._history
        self._next = 0
        self._epoch: float | None = None
        self._is_open = False
        # Called with the true values of samples taken: (first sample, command in m,
        # RECORDED_SIGNALS in SI).
        self.observer: Callable[[int, Float1D, Float2D], None] | None = None

    def open(self) -> None:
        """Check the rate and compile the plant, so that the first read is not late."""
        self._rig.check_rate(self.rate_hz)
        no_samples = np.empty((len(SIGNALS), 0))
        self._plant.advance(
            self._plant.rest_state(), np.zeros(self._plant.history_samples), no_samples
        )
        self._is_open = True

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample), just before sample 0 (`tares_as_set_up`)."""
        self._require(self._is_open, "open() comes first")
        laboratory = self._build_laboratory(self._tare_laboratory_noise, -samples)
        signals = np.zeros((len(SIGNALS), samples))
        if self._tares_as_set_up:
            at_zero = np.zeros(self._plant.history_samples + samples)
            self._plant.advance(self._plant.rest_state(), at_zero, signals)
        at_rest = laboratory.measure(self._true_values(np.zeros(samples), signals), signals)
        return self._digitizer.digitize(at_rest, self._tare_noise, laboratory)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, in V, (sample,); the last value is held."""
        self._require(self._is_open, "open() comes first")
        earliest = 0 if self._epoch is None else self._newest_sample() + self.replace_after
        refuse_late_command(index, earliest, self.replace_after, "device")
        if not np.isfinite(volts).all():
            raise ValueError(
                f"the command from sample {index} on contains NaN or inf; send finite volts"
            )
        oldest = self._next - self._history
        played = self._command_between(oldest, index)
        self._command = np.concatenate([played, quantize_command(volts, self._rig.output)])
        self._origin = oldest

    def start(self) -> None:
        """Start output and input at sample 0, now."""
        self._require(self._is_open, "open() comes first")
        self._require(self._epoch is None, "start() was called already; call it once")
        self._epoch = self._clock.now()

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""
        self._require(self._is_open, "the backend is closed")
        self._wait_for_samples(self._next, self._next + samples)
        return self.take(samples)

    def lateness_s(self, first: int, last: int) -> float:
        """Return the delay of samples first .. last - 1 after their schedule, s; inf: never."""
        return self._faults.lateness_s(first, last)

    def take(self, samples: int) -> Float2D:
        """Return volts of the next samples as `read` does, but without waiting."""
        first = self._next
        queued = self._command_between(first - self._history, first + samples)
        drive = self._faults.apply_to_output(first - self._history, queued)[
            self._faults.history_samples :
        ]
        command = self._faults.apply_to_servo(first - self._plant.history_samples, drive)
        signals = np.empty((len(SIGNALS), samples))
        done = 0
        for count, share in self._faults.bandwidth_shares(first, samples):
            end = done + count
            span = command[done : self._plant.history_samples + end]
            self._plant_with_share(share).advance(self._state, span, signals[:, done:end])
            done = end
        self._next += samples
        played_m = drive[self._plant.history_samples :]
        if self.observer is not None:
            self.observer(first, played_m, signals[: len(RECORDED_SIGNALS)])
        values = self._laboratory.measure(self._true_values(played_m, signals), signals)
        if self._distortion is not None:
            values = self._distortion.apply(values)
        volts = self._digitizer.digitize(values, self._noise, self._laboratory)
        return self._faults.apply_to_inputs(first, volts)

    def take_back(self) -> Callable[[], None]:
        """Return what takes the table back to its present sample, with the command then queued."""
        parts = (self._distortion, self._faults, self._state, self._laboratory, self._noise)
        kept, first = copy.deepcopy(parts), self._next

        def restore() -> None:
            self._distortion, self._faults, self._state, self._laboratory, self._noise = kept
            self._next = first

        return restore

    def scheduled_time_s(self, index: int) -> float:
        """Return the time on the session's clock at which sample `index` is taken, in s."""
        if self._epoch is None:
            raise RuntimeError("simulated table: start() comes first")
        return self._epoch + index / self.rate_hz

    def close(self) -> None:
        """Release the machine; safe to call twice."""
        self._is_open = False

    def _wait_for_samples(self, first: int, last: int) -> None:
        """Wait for samples first .. last - 1; MachineLost after SAMPLE_TIMEOUT_S."""
        due_s, late_s = self.scheduled_time_s(last - 1), self.lateness_s(first, last)
        self._clock.wait_until(due_s + min(late_s, SAMPLE_TIMEOUT_S))
        if late_s > SAMPLE_TIMEOUT_S:
            raise MachineLost(
                f"the simulated table has not sent the samples up to {last - 1}, "
                f"{SAMPLE_TIMEOUT_S:g} s after their schedule; the queued command brings the table "
                "to rest. Check the table, then start again"
            )

    def _newest_sample(self) -> int:
        """Return the index of the newest sample taken so far, read or not."""
        elapsed_s = self._clock.now() - self.scheduled_time_s(0)
        return find_newest_sample(self._next, elapsed_s, self.rate_hz)

    def _build_laboratory(self, noise: np.random.Generator, first: int) -> Laboratory:
        """Return the laboratory at rest, its next sample being `first`."""
        rate_hz = self._plant.rate_hz
        return Laboratory(self._imperfections, self._rig, rate_hz, self._seed, noise, first)

    def _require(self, condition: bool, remedy: str) -> None:
        if not condition:
            raise RuntimeError(f"simulated table: {remedy}")

    def _command_between(self, first: int, last: int) -> Float1D:
        """Return the played command of samples first .. last - 1, m; the last value is held."""
        start, stop = first - self._origin, last - self._origin
        size = self._command.size
        if stop <= size:
            return self._command[start:stop]
        tail = np.full(stop - max(start, size), self._command[-1])
        return np.concatenate([self._command[start:], tail])

    def _true_values(self, drive: Float1D, signals: Float2D) -> Float2D:
        """Return true values in SI, (channel, sample); the cells of a side share its force.

        A declared channel is the sum of those above that the rig file states for it.
        """
        y, y_acc, x, x_acc, _, _, damper = signals
        true = {
            "drive_disp_m": drive,
            "table_disp_m": y,
            "table_acc_m_s2": y_acc,
            "mass_disp_m": x,
            "mass_acc_m_s2": x_acc,
            **self._laboratory.cell_forces(signals),
            "damper_force_n": damper,
            "rel_disp_m": x - y,
            CONSTANT: np.ones(drive.size),
        }
        for channel in self._rig.extra_channels:
            factors = channel.simulated or {}
            true[channel.name] = sum(
                (factor * true[name] for name, factor in factors.items()), np.zeros(drive.size)
            )
        return np.array([true[name] for name in self.channels])
