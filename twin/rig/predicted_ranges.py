"""Predicted peaks of every sensor compared with its range, from a simulation of the test.

A prediction beyond a range gives a warning only, because the model may be wrong: so does a law of
the model that leaves the range in which it was fitted. The demand of the drive on the sensors of
the table is checked in `table_io.safety.preflight`.
"""

import math
from dataclasses import dataclass
from itertools import chain

import numpy as np

from table_io.block import Block, Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.records import Event
from table_io.safety.preflight import CORRECTION_HEADROOM
from twin.compare.extra_channels import PREDICTED_SUMS, select_predicted
from twin.model.ideal_response import simulate_sweep
from twin.model.valid_range import EVENT_KIND, select_first_exits
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import generate_ideal_twin

SETTLING_CYCLES = 30  # at each orbit of a continuation
MAX_RANGE_SHARE = (
    1.0 / CORRECTION_HEADROOM
)  # a larger predicted share gives a warning: the specimen may differ from the model


@dataclass(frozen=True, slots=True)
class PredictedPeak:
    """Predicted peak of a sensor over the test, in the sensor's unit, and the step of the peak.

    In a displacement history the frequency is NaN and `direction` names the window.
    """

    sensor: SensorConfig
    peak: float
    frequency_hz: float
    direction: str

    @property
    def place(self) -> str:
        """Step or window of the peak as text."""
        if math.isnan(self.frequency_hz):
            return self.direction
        return f"{self.frequency_hz:g} Hz {self.direction}"

    @property
    def range_share(self) -> float:
        """Peak as a share of the sensor range."""
        return self.peak / self.sensor.range


@dataclass(frozen=True, slots=True)
class PredictedResponse:
    """Predicted peaks of the sensors that the model covers, and where its laws leave their ranges.

    An exit is a sentence; there is one for each range.
    """

    peaks: tuple[PredictedPeak, ...]
    range_exits: tuple[str, ...] = ()


def predict_response(run_config: RunConfig) -> PredictedResponse:
    """Predict the peak of each sensor of the rig that the model covers, and exits of ranges."""
    predictions = []
    if run_config.steps:
        peaks, range_exits = _compute_peaks(run_config)
        places = [(step.frequency_hz, step.direction) for step in run_config.steps]
    else:
        peaks, range_exits = _simulate_peaks(run_config)
        places = [(math.nan, f"window {k}") for k in range(run_config.profile.plan.windows)]
    for sensor in run_config.rig.sensors:
        if sensor.channel in peaks:
            values = peaks[sensor.channel]
            peak = float(values.max()) / sensor.si_per_unit
            predictions.append(PredictedPeak(sensor, peak, *places[int(np.argmax(values))]))
    return PredictedResponse(tuple(predictions), range_exits)


def _compute_peaks(run_config: RunConfig) -> tuple[dict[str, Float1D], tuple[str, ...]]:
    """Compute the peak of each channel at each step, SI, (step,), and the exits of ranges.

    Total displacement of the mass: upper bound, sum of table and relative displacement.
    """
    profile = run_config.profile
    frequencies = np.array([step.frequency_hz for step in run_config.steps])
    levels = np.array([step.acceleration_m_s2 for step in run_config.steps])
    # Between the orbits of a continuation the motion may fall to any other solution.
    cycles = SETTLING_CYCLES if profile.continuation is not None else profile.sweep.cycles
    # The first step runs twice and the first run is dropped: the real drive has a soft start.
    motion = simulate_sweep(
        run_config.model,
        np.r_[frequencies[:1], frequencies],
        np.r_[levels[:1], levels],
        cycles,
    )
    table = levels / (2 * np.pi * frequencies) ** 2

    def max_magnitude(*names: str) -> Float1D:
        rows = [np.abs(motion.column(name)[1:]).max(axis=1) for name in names]
        peaks: Float1D = np.max(rows, axis=0)
        return peaks

    u, a = max_magnitude("u_max", "u_min"), max_magnitude("a_max", "a_min")
    right, left = max_magnitude("f_r_max"), max_magnitude("f_l_min")
    peaks = {
        "drive_disp_m": table,
        "table_disp_m": table,
        "table_acc_m_s2": levels,
        "mass_disp_m": u + table,
        "mass_acc_m_s2": a,
        "rel_disp_m": u,
        "damper_force_n": run_config.profile.specimen.mass_kg * a + np.maximum(right, left),
    }
    for cells, force in ((RIGHT_CELLS, right), (LEFT_CELLS, left)):
        present = [name for name in cells if name in run_config.rig.channels]
        peaks |= {name: force / len(present) for name in present}
    for channel in select_predicted(run_config.rig.channel_by_name.values()):
        names = PREDICTED_SUMS[channel.quantity, channel.body]
        if channel.name not in peaks and all(name in peaks for name in names):
            peaks[channel.name] = np.sum([peaks[name] for name in names], axis=0)
    exits = select_first_exits(chain.from_iterable(motion.range_exits[1:]))
    return peaks, tuple(map(str, exits))


def _simulate_peaks(run_config: RunConfig) -> tuple[dict[str, Float1D], tuple[str, ...]]:
    """Simulate the model on the ideal history; return peaks by channel and window, SI, and exits.

    Peaks are (window,).
    """
    specimen, windows = run_config.profile.specimen, run_config.profile.plan.windows
    peaks: dict[str, Float1D] = {}
    range_exits = []
    for item in generate_ideal_twin(run_config):
        if isinstance(item, Event) and item.kind == EVENT_KIND:
            range_exits.append(item.text)
        if not isinstance(item, Block):
            continue
        values = {name.removeprefix("free/"): item.channel(name) for name in item.channels}
        if item.stream == "pred":
            right, left = 2 * values["force_r1_n"], 2 * values["force_l1_n"]
            values["damper_force_n"] = np.abs(specimen.mass_kg * values["mass_acc_m_s2"]) + np.abs(
                right + left
            )
            for cells, force in ((RIGHT_CELLS, right), (LEFT_CELLS, left)):
                present = [name for name in cells if name in run_config.rig.channels]
                values |= {name: force / len(present) for name in present}
        for name, samples in values.items():
            peak = peaks.setdefault(name, np.zeros(windows))
            is_played = item.step >= 0
            np.fmax.at(peak, item.step[is_played], np.abs(samples[is_played]))
    return peaks, tuple(range_exits)


def format_clipping_warnings(predictions: tuple[PredictedPeak, ...], rig: RigConfig) -> list[str]:
    """Format a warning for each sensor predicted near or beyond the end of its range."""
    return [
        f"{prediction.sensor.channel}: the model predicts {prediction.peak:.4g} "
        f"{prediction.sensor.unit} at {prediction.place}, "
        f"{100 * prediction.range_share:.0f} % of its range on "
        f"{rig.name!r}; use a sensor with a larger range"
        for prediction in predictions
        if prediction.range_share > MAX_RANGE_SHARE
    ]
