"""Swept sine: one sine whose frequency rises and falls by octaves a minute, at a controlled level.

The level is the peak acceleration of the fundamental, in g, below its crossover the displacement
amplitude, in mm, or follows break points over frequency. It is measured on one channel or several
and corrected while the frequency moves (`table_io/sequencer/swept_sine.py`). A limit of the profile
with action "notch" reduces it. After the passes the table may dwell at the resonances found.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float2D
from table_io.config.base import Count, NonNegative, Number, Positive, find_attached_text
from table_io.config.excitation import Excitation, ExcitationPlan, register_excitation
from table_io.config.excitation.waveform import LevelPoints, check_points_in_band, interpolate_level
from table_io.errors import InputError
from table_io.records import SweepLevel
from table_io.units import GRAVITY_M_S2

TABLE_ACCELERATION = "table_acc_m_s2"
CONTROL_UNITS = ("_m_s2", "_m")  # ends of the names of channels that measure a level
WINDOWS_PER_OCTAVE = 3  # parts of a pass, for the results
MAX_DWELLS = 4
MAX_PASSES_H = 24.0  # of all passes: the plan of a test is held in memory
UPDATE_CYCLES, MIN_UPDATE_S = 1.0, 0.1  # between two corrections of the level
TRACKED_CYCLES, MIN_TRACKED_S = 2.0, 0.1  # from which a level is measured


@register_excitation("swept_sine")
class SweptSine(Excitation):
    """Logarithmic sine sweep at a controlled level, then dwells at the resonances found."""

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("prediction",)
    LEVEL_KEY: ClassVar[str] = "scale"
    MIN_SAMPLES_PER_CYCLE: ClassVar[float] = 20.0

    start_hz: Positive = Field(ge=0.1, description="Lowest frequency.")
    stop_hz: Positive = Field(description="Highest frequency.")
    octaves_per_min: Number = Field(1.0, gt=0, le=10, description="Sweep rate, octaves a minute.")
    directions: tuple[Literal["forward", "backward"], ...] = Field(
        ("forward", "backward"), min_length=1, max_length=2, description="Order of the passes."
    )
    repeats: Count = Field(
        1, ge=1, le=100, validate_default=True, description="Of all passes, one after another."
    )
    acceleration_g: Positive = Field(0.05, description="Level: peak acceleration.")
    displacement_mm: Positive | None = Field(
        None, description="Largest displacement amplitude: it sets the level below the crossover."
    )
    level_points: LevelPoints = Field(
        (),
        max_length=100,
        description="Instead of acceleration_g: [[frequency in Hz, level in g], ...], "
        "interpolated in logarithms.",
    )
    scale: Positive = Field(1.0, description="Factor on the whole level.")
    control_channels: tuple[str, ...] = Field(
        (TABLE_ACCELERATION,),
        min_length=1,
        max_length=8,
        description="Accelerations or displacements on which the level is measured.",
    )
    strategy: Literal["average", "maximum"] = Field(
        "average", description="Of several control channels: their mean, or the largest."
    )
    compression: Number = Field(
        0.7, gt=0, le=1.0, description="Share of an error of the level corrected in an update."
    )
    clamp_db: Number = Field(1.5, gt=0, le=3.0, description="Largest change per update.")
    response_channel: str = Field(
        "mass_acc_m_s2", description="Whose ratio to the level shows the resonances."
    )
    min_amplification: Number = Field(
        2.0, gt=1.0, le=100, description="Least peak of that ratio that counts as a resonance."
    )
    dwell_s: NonNegative = Field(
        0.0, le=7200, description="Endurance at each resonance found, the largest four at most."
    )
    files: dict[str, str] = Field({}, description="Texts of files by name; loading attaches them.")
    prediction: str | None = Field(
        None,
        description="CSV of the level and the responses by the specimen's twin; it is computed "
        "and attached where the test has a notch.",
    )

    @field_validator("stop_hz")
    @classmethod
    def _check_band(cls, stop: float, info: ValidationInfo) -> float:
        start = info.data.get("start_hz", 0.0)
        if stop < 1.1 * start:
            raise InputError(
                f"stop_hz {stop:g} is not above start_hz {start:g}",
                allowed=f"at least {1.1 * start:g}",
                remedy="give the band in ascending order and the passes in `directions`",
            )
        return stop

    @field_validator("repeats")
    @classmethod
    def _check_duration(cls, repeats: int, info: ValidationInfo) -> int:
        keys = "start_hz", "stop_hz", "octaves_per_min", "directions"
        if not info.data.keys() >= {*keys}:
            return repeats
        start, stop, rate, directions = (info.data[key] for key in keys)
        hours = repeats * len(directions) * math.log2(stop / start) / rate / 60.0
        if hours > MAX_PASSES_H:
            raise InputError(
                f"the passes take {hours:.4g} h",
                allowed=f"at most {MAX_PASSES_H:g} h",
                remedy="raise octaves_per_min, or divide the test into several",
            )
        return repeats

    _check_level_points = field_validator("level_points")(check_points_in_band)

    @field_validator("control_channels")
    @classmethod
    def _check_control(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        wrong = [name for name in names if not name.endswith(CONTROL_UNITS)]
        if wrong or len(set(names)) < len(names):
            raise InputError(
                f"control_channels contains {wrong[0] if wrong else 'one twice'}",
                allowed="accelerations (_m_s2) and displacements (_m), each once",
            )
        return names

    @field_validator("prediction")
    @classmethod
    def _check_prediction(cls, name: str | None, info: ValidationInfo) -> str | None:
        text = find_attached_text(name, info)
        if text is not None:
            PredictedSweep.from_csv(text, str(name))
        return name

    @cached_property
    def predicted_sweep(self) -> "PredictedSweep | None":
        """Level and responses by the specimen's twin; None if none are attached."""
        if self.prediction is None or self.prediction not in self.files:
            return None
        return PredictedSweep.from_csv(self.files[self.prediction], self.prediction)

    @property
    def passes(self) -> int:
        """Number of passes over the band."""
        return len(self.directions) * self.repeats

    @property
    def octaves(self) -> float:
        """Width of the band in octaves."""
        return math.log2(self.stop_hz / self.start_hz)

    @property
    def windows_per_pass(self) -> int:
        """Number of parts of a pass, about a third of an octave each."""
        return max(1, round(WINDOWS_PER_OCTAVE * self.octaves))

    @property
    def crossover_hz(self) -> float | None:
        """Frequency in Hz below which the displacement sets the level; None where it never does."""
        if self.displacement_mm is None or self.level_points:
            return None
        ratio = self.acceleration_g * GRAVITY_M_S2 / (1e-3 * self.displacement_mm)
        hz = math.sqrt(ratio) / math.tau
        return hz if hz > self.start_hz else None

    def ends_hz(self, sweep: int) -> tuple[float, float]:
        """Return (first, last) frequency of a pass in Hz."""
        ends = self.start_hz, self.stop_hz
        return ends if self.direction(sweep) == "forward" else ends[::-1]

    def direction(self, sweep: int) -> str:
        """Return the direction of a pass."""
        return self.directions[sweep % len(self.directions)]

    def log_rate_1_s(self, sweep: int) -> float:
        """Return the slope of ln f of a pass in 1/s."""
        sign = 1.0 if self.direction(sweep) == "forward" else -1.0
        return sign * math.log(2.0) * self.octaves_per_min / 60.0

    def find_pass(self, window: int) -> int:
        """Return the pass of a part of the test; a dwell counts as a pass of its own."""
        return min(window // self.windows_per_pass, self.passes) + max(
            window - self.passes * self.windows_per_pass, 0
        )

    def find_window(self, sweep: int, frequency_hz: float) -> int:
        """Return the number of the part of the test that contains a frequency of a pass."""
        if sweep >= self.passes:
            return self.passes * self.windows_per_pass + sweep - self.passes
        first, last = self.ends_hz(sweep)
        share = math.log(frequency_hz / first) / math.log(last / first)
        inside = math.floor(share * self.windows_per_pass + 1e-9)
        return sweep * self.windows_per_pass + min(max(inside, 0), self.windows_per_pass - 1)

    def level_m_s2(self, frequency_hz: float) -> float:
        """Return the demanded peak acceleration in m/s2 at a frequency."""
        if self.level_points:
            level_g = float(interpolate_level(self.level_points, np.array([frequency_hz]))[0])
        else:
            level_g = self.acceleration_g
        level = self.scale * level_g * GRAVITY_M_S2
        if self.displacement_mm is None:
            return level
        amplitude_m = self.scale * 1e-3 * self.displacement_mm
        return min(level, amplitude_m * (math.tau * frequency_hz) ** 2)

    def update_s(self, frequency_hz: float) -> float:
        """Return the time between two corrections of the level at a frequency."""
        return max(UPDATE_CYCLES / frequency_hz, MIN_UPDATE_S)

    def tracked_s(self, frequency_hz: float) -> float:
        """Return the time over which the level is measured at a frequency, in whole cycles."""
        cycles = max(TRACKED_CYCLES, math.ceil(MIN_TRACKED_S * frequency_hz))
        return cycles / frequency_hz

    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return level, band and parts of the test; the sequencer plays it update by update."""
        grid = np.geomspace(self.start_hz, self.stop_hz, 200)
        levels = np.array([self.level_m_s2(f) for f in grid.tolist()])
        return ExcitationPlan(
            float(levels.max()),
            self.start_hz,
            self.stop_hz,
            windows=self.passes * self.windows_per_pass + (MAX_DWELLS if self.dwell_s else 0),
            swept_disp_m=float((levels / (math.tau * grid) ** 2).max()),
        )


MIN_AMPLITUDE = 1e-12  # SI, of a channel that does not move
PREDICTION_COLUMNS = ("sweep", "frequency_hz", "level_m_s2")


@dataclass(frozen=True, eq=False)
class PredictedSweep:
    """Swept sine on the twin of the specimen: `table` is (point, column), in order of time.

    Its columns are PREDICTION_COLUMNS and then the fundamentals of `channels`, SI.
    """

    channels: tuple[str, ...]
    table: Float2D

    @classmethod
    def from_levels(
        cls, config: SweptSine, levels: Sequence[SweepLevel], per_octave: float = math.inf
    ) -> "PredictedSweep":
        """Return the prediction of simulated levels, thinned to so many points an octave.

        A frequency that stands still, in a dwell, has the first level only.
        """
        rows: list[tuple[float, ...]] = []
        for level in levels:
            sweep = config.find_pass(level.step)
            octaves = abs(math.log2(level.frequency_hz / rows[-1][1])) if rows else math.inf
            if not rows or sweep != rows[-1][0] or octaves > 1.0 / per_octave:
                rows.append((sweep, level.frequency_hz, level.demanded_m_s2, *level.amplitudes))
        channels = levels[0].channels if levels else ()
        return cls(channels, np.array(rows).reshape(-1, len(PREDICTION_COLUMNS) + len(channels)))

    @classmethod
    def from_csv(cls, text: str, name: str) -> "PredictedSweep":
        """Parse the text of a prediction; InputError if it is none."""
        header, *lines = text.strip().split("\n")
        columns = tuple(header.split(","))
        try:
            if columns[: len(PREDICTION_COLUMNS)] != PREDICTION_COLUMNS:
                raise ValueError(header)
            table = np.array([[float(cell) for cell in line.split(",")] for line in lines])
            return cls(columns[len(PREDICTION_COLUMNS) :], table.reshape(-1, len(columns)))
        except ValueError:
            raise InputError(
                f"{name} is no prediction of a swept sine",
                allowed=f"the columns {', '.join(PREDICTION_COLUMNS)} and channels",
                remedy="remove `prediction`: it is computed again",
            ) from None

    def to_csv(self) -> str:
        """Return the text of the file."""
        rows = (",".join(f"{cell:.6g}" for cell in row) for row in self.table.tolist())
        return "\n".join([",".join((*PREDICTION_COLUMNS, *self.channels)), *rows]) + "\n"

    @cached_property
    def _curves(self) -> dict[int, Float2D]:
        """Logarithms of the columns from frequency on, by pass, f ascending, (column, point)."""
        curves = {}
        for sweep in np.unique(self.table[:, 0]).tolist():
            rows = self.table[self.table[:, 0] == sweep]
            columns = np.maximum(rows[np.argsort(rows[:, 1]), 1:], MIN_AMPLITUDE)
            curves[int(sweep)] = np.log(columns).T
        return curves

    def level_m_s2(self, sweep: int, frequency_hz: float) -> float:
        """Return the predicted level in m/s2 of a pass at a frequency; NaN outside it."""
        ln_f = math.log(frequency_hz)
        curve = self._curves.get(sweep)
        if curve is None or not curve[0, 0] <= ln_f <= curve[0, -1]:
            return math.nan
        return float(np.exp(np.interp(ln_f, curve[0], curve[1])))

    def log_ratio(self, sweep: int, channel: str, ln_f: float) -> float:
        """Return ln of a channel's amplitude over the level of a pass at ln f; NaN if unknown."""
        curve = self._curves.get(sweep)
        if curve is None or channel not in self.channels:
            return math.nan
        row = 2 + self.channels.index(channel)
        return float(np.interp(ln_f, curve[0], curve[row] - curve[1]))
