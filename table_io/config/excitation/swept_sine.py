"""Swept sine: one sine whose frequency rises and falls by octaves a minute, at a controlled level.

The level is the peak acceleration of the fundamental, in g, below its crossover the displacement
amplitude, in mm, or follows break points over frequency. It is measured on one channel or several
and corrected while the frequency moves (`table_io/sequencer/swept_sine.py`). A limit of the profile
with action "notch" reduces it. After the passes the table may dwell at the resonances found.
"""

import math
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import Count, NonNegative, Number, Positive
from table_io.config.excitation import Excitation, ExcitationPlan, register_excitation
from table_io.config.excitation.waveform import (
    LevelPoints,
    check_level_points,
    interpolate_level,
)
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

TABLE_ACCELERATION = "table_acc_m_s2"
CONTROL_UNITS = ("_m_s2", "_m")  # ends of the names of channels that measure a level
MIN_SAMPLES_PER_CYCLE = 20.0  # at the highest frequency
WINDOWS_PER_OCTAVE = 3  # parts of a pass, for the results
MAX_DWELLS = 4
UPDATE_CYCLES, MIN_UPDATE_S = 1.0, 0.1  # between two corrections of the level
TRACKED_CYCLES, MIN_TRACKED_S = 2.0, 0.1  # from which a level is measured


@register_excitation("swept_sine")
class SweptSine(Excitation):
    """Logarithmic sine sweep at a controlled level, then dwells at the resonances found."""

    LEVEL_KEY: ClassVar[str] = "scale"

    start_hz: Positive = Field(ge=0.1, description="Lowest frequency.")
    stop_hz: Positive = Field(description="Highest frequency.")
    octaves_per_min: Number = Field(1.0, gt=0, le=10, description="Sweep rate.")
    directions: tuple[Literal["forward", "backward"], ...] = Field(
        ("forward", "backward"), min_length=1, max_length=2, description="Order of the passes."
    )
    repeats: Count = Field(1, ge=1, le=100, description="Of all passes, one after another.")
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

    @field_validator("level_points")
    @classmethod
    def _check_level_points(cls, points: LevelPoints, info: ValidationInfo) -> LevelPoints:
        if points and {"start_hz", "stop_hz"} <= info.data.keys():
            check_level_points(points, (info.data["start_hz"], info.data["stop_hz"]))
        return points

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
        if rate_hz < MIN_SAMPLES_PER_CYCLE * self.stop_hz:
            raise InputError(
                f"{rate_hz:g} Hz gives fewer than {MIN_SAMPLES_PER_CYCLE:g} samples per cycle at "
                f"stop_hz {self.stop_hz:g}",
                where=f"excitation {self.kind!r}",
                allowed=f"acquisition.rate_hz from {MIN_SAMPLES_PER_CYCLE * self.stop_hz:g}",
            )
        grid = np.geomspace(self.start_hz, self.stop_hz, 200)
        levels = np.array([self.level_m_s2(f) for f in grid.tolist()])
        return ExcitationPlan(
            float(levels.max()),
            self.start_hz,
            self.stop_hz,
            windows=self.passes * self.windows_per_pass + (MAX_DWELLS if self.dwell_s else 0),
            swept_disp_m=float((levels / (math.tau * grid) ** 2).max()),
        )
