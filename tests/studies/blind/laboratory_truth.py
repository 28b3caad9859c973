"""True instrument errors of a laboratory, in the terms of the library: gain, lag and offset.

An imperfection is no effect of the library: a load 52 : 48 off its two cells reads as two gains, an
anti-alias filter as a lag. What a verdict may name truly is therefore measured. The case is played
once more without noise, and each channel is compared with the true value of its quantity,

    reading = gain x value - lag x rate of value + offset,      least squares while the table moves,

offset after the tare. A lag common to all channels is not observable: see `lag` of `ReadingError`.
Errors of the set-up are stated by the laboratory: `gap_offset` (half the right minus the left error
of the gaps' readings), `mass_error` (stated over true mass), `table_tilt` (pitch per travel).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.sim.imperfections import Imperfection, resolve_sides
from tests.studies.blind.rig import PROFILE, StudySignals
from tests.studies.blind.sizes import evaluate_residual


@dataclass(frozen=True, slots=True)
class ReadingError:
    """Error of a channel over the moving part of a test, SI: see the module.

    `lags` in s: the lag behind the median of the other channels, and behind the lasers.
    """

    gain: float
    lags: tuple[float, float]
    offset: float


def measure_reading_errors(
    signals: StudySignals, readings: Mapping[str, Float1D]
) -> dict[str, ReadingError]:
    """Return the error of each channel; `readings` (sample,) are noise-free, in SI."""
    moving = signals.moving
    rest = slice(0, int(np.flatnonzero(moving)[0]))
    rate_hz = PROFILE.acquisition.rate_hz
    fits: dict[str, tuple[float, float, float]] = {}
    for name, value in signals.channels.items():
        rates = np.gradient(value) * rate_hz
        columns = np.stack([value, -rates, np.ones_like(value)])[:, moving]
        reading = readings[name] - readings[name][rest].mean()
        gain, delay, offset = np.linalg.lstsq(columns.T, reading[moving], rcond=None)[0]
        fits[name] = float(gain), float(delay / gain), float(offset)
    lasers = [name for name in fits if name.endswith("_disp_m")]
    errors = {}
    for name, (gain, delay, offset) in fits.items():
        others = np.median([fits[other][1] for other in fits if other != name])
        behind = np.mean([fits[other][1] for other in lasers if other != name])
        errors[name] = ReadingError(gain, (float(delay - others), float(delay - behind)), offset)
    return errors


def measure_visible_size(
    signals: StudySignals, readings: Mapping[str, Float1D], noise: Mapping[str, float]
) -> float:
    """Return the size of the laboratory, as that of an effect, from noise-free readings in SI.

    It is that of the residual of the refitted base model, or of the difference of the two cells of
    a side while they bear a load, if that is larger. `noise` is the rms per channel.
    """
    rest = slice(0, int(np.flatnonzero(signals.moving)[0]))
    tared = {name: values - values[rest].mean() for name, values in readings.items()}
    errors = {name: tared[name] - value for name, value in signals.channels.items()}
    right, left = (sum(errors[cell] for cell in cells) for cells in (RIGHT_CELLS, LEFT_CELLS))
    shown = replace(signals, channels=tared, right=signals.right + right, left=signals.left - left)
    differences = [evaluate_residual(shown, signals, noise).rms]
    for (first, second), force in ((RIGHT_CELLS, signals.right), (LEFT_CELLS, signals.left)):
        if (loaded := signals.moving & (force != 0.0)).any():
            difference = (tared[first] - tared[second])[loaded]
            sigma = np.hypot(noise[first], noise[second])
            differences.append(float(np.sqrt(np.mean(difference**2)) / sigma))
    return math.hypot(1.0, max(differences))


def compute_setup_errors(imperfections: Sequence[Imperfection]) -> dict[str, dict[str, float]]:
    """Return the parameters of the errors of the set-up, by effect of the library."""
    gaps = resolve_sides(imperfections, "gap_reading")
    errors: dict[str, dict[str, float]] = {}
    if gaps:
        right, left = (gaps.get(side, {}).get("offset", 0.0) for side in ("right", "left"))
        errors["gap_offset"] = {"offset": 0.5 * (right - left)}
    for entry in imperfections:
        match entry.id:
            case "mass_reading":
                errors["mass_error"] = {"ratio": 1.0 / entry.parameters["ratio"]}
            case "table_pitch":
                errors["table_tilt"] = {"tilt": entry.parameters["per_travel"]}
    return errors


def list_true_errors(
    imperfections: Sequence[Imperfection],
    signals: StudySignals,
    readings: Mapping[str, Float1D],
) -> dict[str, dict[str, list[float]]]:
    """Return the true parameters of each instrument error, by its name in a verdict.

    Of each parameter the values that hold, of a lag by two references.
    """
    true: dict[str, dict[str, list[float]]] = {
        name: {key: [value] for key, value in parameters.items()}
        for name, parameters in compute_setup_errors(imperfections).items()
    }
    for channel, error in measure_reading_errors(signals, readings).items():
        true[f"sensor_gain.{channel}"] = {"gain": [error.gain]}
        true[f"sensor_lag.{channel}"] = {"lag": [*error.lags]}
        true[f"sensor_offset.{channel}"] = {"offset": [error.offset]}
    return true


def list_affected_channels(
    imperfections: Sequence[Imperfection], channels: Sequence[str]
) -> list[str]:
    """Return the channels on which an imperfection of a laboratory acts."""
    affected = set()
    for entry in imperfections:
        affected |= {name for name in channels if _acts_on_channel(entry, name, channels)}
    return [name for name in channels if name in affected]


def _acts_on_channel(entry: Imperfection, name: str, channels: Sequence[str]) -> bool:
    if entry.channel is not None:
        return name == entry.channel
    if entry.id in ("load_sharing", "plate_mass"):
        sides = {"right": "force_r", "left": "force_l"}
        return any(name.startswith(sides[side]) for side in (entry.side,) if side)
    if entry.id == "channel_skew":
        return name != channels[-1]
    return entry.id == "table_pitch" and name.endswith("_acc_m_s2")
