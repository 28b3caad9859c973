"""Removal of the low cut of accelerometers, which a sound IEPE sensor has.

The low cut w_c turns the phase of a motion at w by about w_c / w. It is measured from the
displacement of the same body (`sensor_consistency.py`) and removed, causally, by

    a_0 = a + w_c z,   z = (a + lambda s y) / (s + lambda),   y = s / (s + w_c) x

z is the velocity behind the low cut: from the acceleration above lambda, from the displacement
below it, so that neither noise is differentiated nor an offset integrated. Without a low cut blocks
are unchanged to the bit.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Block, Float1D
from table_io.sensor_errors import filter_first_order, highpass

CROSSOVER_RAD_S = 2 * np.pi * 0.5  # lambda
SETTLING_TIMES = 6.0  # of the slowest filter, after which a repeated cycle is periodic
MAX_REPEATS = 60


@dataclass(frozen=True, slots=True)
class LowCutFilter:
    """Removal of one accelerometer's low cut in rad/s, with the state of its filters.

    Newest input and output of `displacement` (x and y) and `slow` (y and its part above the
    crossover), and the state of the leaky integral `fast` of a.
    """

    low_cut: float = 0.0
    displacement: tuple[float, float] | None = None
    slow: tuple[float, float] | None = None
    fast: float = 0.0

    def apply(self, a: Float1D, x: Float1D, rate_hz: float) -> tuple["LowCutFilter", Float1D]:
        """Return (filter after the samples, acceleration without low cut, (sample,))."""
        y = highpass(x, self.low_cut, rate_hz, self.displacement)
        slow = highpass(y, CROSSOVER_RAD_S, rate_hz, self.slow)
        known = np.nan_to_num(a)
        half = 0.5 * CROSSOVER_RAD_S / rate_hz  # trapezoidal rule
        gain, pole = 0.5 / rate_hz / (1.0 + half), (1.0 - half) / (1.0 + half)
        fast, state = filter_first_order(known, (gain, gain), pole, self.fast)
        finite = x[np.isfinite(x)]
        last_x = float(finite[-1]) if finite.size else (self.displacement or (np.nan, 0.0))[0]
        after = replace(
            self,
            displacement=(last_x, float(y[-1])),
            slow=(float(y[-1]), float(slow[-1])),
            fast=state,
        )
        return after, a + self.low_cut * (fast + CROSSOVER_RAD_S * slow)

    def settle(self, a: Float1D, x: Float1D, rate_hz: float, low_cut: float) -> "LowCutFilter":
        """Return the filter of another low cut, after a cycle (sample,) that repeated itself."""
        if self.low_cut > 0.0 or low_cut == 0.0:
            return replace(self, low_cut=low_cut)
        slowest = min(low_cut, CROSSOVER_RAD_S)
        repeats = min(int(np.ceil(SETTLING_TIMES * rate_hz / slowest / a.size)), MAX_REPEATS)
        periodic = LowCutFilter(low_cut)
        return periodic.apply(np.tile(a, repeats), np.tile(x, repeats), rate_hz)[0]


@dataclass(frozen=True, slots=True)
class LowCutRemoval:
    """Filters of the accelerometers of table and mass, by name of their channel."""

    filters: dict[str, LowCutFilter] = field(default_factory=dict)

    @property
    def is_active(self) -> bool:
        """Whether a low cut is removed."""
        return any(each.low_cut for each in self.filters.values())

    def apply(self, block: Block) -> tuple["LowCutRemoval", Block]:
        """Return (removal after the block, block without low cuts)."""
        if not self.is_active:
            return self, block
        values, filters = block.values.copy(), dict(self.filters)
        for name, each in self.filters.items():
            x = body_displacement(block, name)
            if each.low_cut and x is not None:
                row = block.channels.index(name)
                filters[name], values[row] = each.apply(values[row], x, block.rate_hz)
        return LowCutRemoval(filters), replace(block, values=values)

    def settle(self, recorded: Block, low_cuts: dict[str, float]) -> "LowCutRemoval":
        """Return the removal of these low cuts in rad/s from the next sample on.

        `recorded` is the held cycle before it, with low cuts.
        """
        filters = dict(self.filters)
        for name, low_cut in low_cuts.items():
            x = body_displacement(recorded, name)
            if x is not None and name in recorded.channels:
                a = recorded.channel(name)
                before = filters.get(name, LowCutFilter())
                filters[name] = before.settle(a, x, recorded.rate_hz, low_cut)
        return LowCutRemoval(filters)


def body_displacement(block: Block, acceleration: str) -> Float1D | None:
    """Return the displacement in m, (sample,), of the body of an acceleration; None if unknown."""
    if acceleration == "table_acc_m_s2" and "table_disp_m" in block.channels:
        return block.channel("table_disp_m")
    if acceleration == "mass_acc_m_s2" and "mass_disp_m" in block.channels:
        return block.channel("mass_disp_m")
    if acceleration == "mass_acc_m_s2" and {"rel_disp_m", "table_disp_m"} <= {*block.channels}:
        return block.channel("rel_disp_m") + block.channel("table_disp_m")
    return None
