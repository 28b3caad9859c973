"""Rows, curves and words of records, for every surface: terminal, web page and Rerun view.

What a record says is worked out here once; the surfaces lay it out. Values are in SI; `size` is the
SI value of the unit in which a row is shown.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from table_io.config.excitation.continuation import OrbitPlan
from table_io.records import Agreement, Estimate, NormalizedResponse, OrbitPoint, PrcPoint

MIN_DRIFT_SIGMA = 3.0  # standard deviations beyond which a drift is marked
DISPLAY_NAMES = {
    "drive_disp_m": "drive", "table_disp_m": "table disp", "table_acc_m_s2": "table acc",
    "mass_disp_m": "mass disp", "mass_acc_m_s2": "mass acc", "rel_disp_m": "u rel",
    "force_r1_n": "force R1", "force_r2_n": "force R2",
    "force_l1_n": "force L1", "force_l2_n": "force L2", "damper_force_n": "damper",
    "stiffness": "stiffness", "damping": "damping", "gap_r": "gap R", "gap_l": "gap L",
    "bumper_stiffness_r": "bumper R", "bumper_stiffness_l": "bumper L",
}  # fmt: skip
# By the end of a channel's name; the last one is that of all other names.
DISPLAY_UNITS = (
    ("_m_s2", "m/s²", 1.0), ("_m_s", "mm/s", 1e-3), ("_m", "mm", 1e-3), ("_n", "N", 1.0),
    ("_degc", "°C", 1.0), ("_pa", "kPa", 1e3), ("", "", 1.0),
)  # fmt: skip
PARAMETER_UNITS = {
    "stiffness": ("kN/m", 1e3), "damping": ("kNs/m", 1e3), "gap_r": ("mm", 1e-3),
    "gap_l": ("mm", 1e-3), "bumper_stiffness_r": ("kN/m", 1e3), "bumper_stiffness_l": ("kN/m", 1e3),
}  # fmt: skip

ResponseQuantity = Callable[[NormalizedResponse], float]


class DisplayName(NamedTuple):
    """Name of a quantity as shown, its unit, and the SI value of that unit."""

    label: str
    unit: str
    size: float


def describe_channel(name: str) -> DisplayName:
    """Return how a channel is shown; the label has at most ten characters."""
    suffix, unit, size = next(entry for entry in DISPLAY_UNITS if name.endswith(entry[0]))
    label = name.removesuffix(suffix).replace("_", " ")
    return DisplayName(DISPLAY_NAMES.get(name, label)[:10], unit, size)


def label_parameter(name: str) -> DisplayName:
    """Return how an identified parameter is shown; the label has at most nine characters."""
    return DisplayName(DISPLAY_NAMES.get(name, name)[:9], *PARAMETER_UNITS.get(name, ("", 1.0)))


class TwinErrors(NamedTuple):
    """RMS of a channel over the last second, and of the errors of the restarted and free twin."""

    rms: float = math.nan
    error: float = math.nan
    free: float = math.nan


@dataclass(frozen=True, slots=True)
class TwinRow:
    """Error of the restarted twin in a channel against its band; NaN where nothing is known.

    The error is that of the last cycle where there is an `Agreement`, with its parts in flight and
    in contact right and left, otherwise that of the last second.
    """

    channel: str
    rms: float
    error: float
    band: float
    free: float
    phases: tuple[float, float, float]

    @property
    def exceeds(self) -> bool:
        return math.isfinite(self.band) and self.error > self.band

    @property
    def share_of_band(self) -> float:
        return self.error / self.band if self.band > 0 else math.nan

    @property
    def share_of_rms(self) -> float:
        return self.error / (self.rms or math.nan)


def list_twin_rows(
    agreement: Agreement | None, errors: Mapping[str, TwinErrors] | None = None
) -> list[TwinRow]:
    """Return a row for each channel with errors of the last second or of the last cycle."""
    errors = errors or {}
    cycle = {}
    if agreement is not None:
        columns = (
            agreement.error, agreement.band, agreement.flight, agreement.right, agreement.left,
        )  # fmt: skip
        cycle = dict(zip(agreement.channels, zip(*columns, strict=True), strict=True))
    rows = []
    for name in dict.fromkeys((*errors, *cycle)):
        last_second = errors.get(name, TwinErrors())
        error, band, *phases = cycle.get(name, (last_second.error, *(math.nan,) * 4))
        flight, right, left = phases
        rows.append(
            TwinRow(name, last_second.rms, error, band, last_second.free, (flight, right, left))
        )
    return rows


@dataclass(frozen=True, slots=True)
class ParameterRow:
    """Identified parameter with its standard deviation and its drift since the start of the test.

    The drift is relative to the value at the start; NaN where no trend is fitted.
    """

    name: str
    value: float
    sd: float
    drift: float
    drift_sd: float

    @property
    def drift_size(self) -> float:
        """Value at the start, of which drifts are shares; NaN if it is 0."""
        return abs(self.value - self.drift) or math.nan

    @property
    def has_drifted(self) -> bool:
        return abs(self.drift) > MIN_DRIFT_SIGMA * self.drift_sd

    @property
    def is_length(self) -> bool:
        """True for a gap, whose value at the start may be 0."""
        return self.name.startswith("gap")


def list_drift_rows(estimate: Estimate | None) -> list[ParameterRow]:
    """Return the identified parameters, those that have drifted first."""
    if estimate is None:
        return []
    columns = estimate.names, estimate.values, estimate.sd, estimate.drift, estimate.drift_sd
    rows = [ParameterRow(*values) for values in zip(*columns, strict=True)]
    return sorted(rows, key=lambda row: not row.has_drifted)


@dataclass(frozen=True, slots=True)
class FrequencyCurve:
    """Curve over the frequency in Hz of the "twin", of the "measured" points, or of an "orbit".

    Orbits that are not accepted have the direction "backward".
    """

    source: str
    direction: str
    points: tuple[tuple[float, float], ...]


def impacts_per_cycle(quantities: NormalizedResponse) -> float:
    """Return mean impacts per measured cycle, both sides; NaN if the cells of a side are lost."""
    cycles = min(len(quantities.impacts_right), len(quantities.impacts_left))
    impacts = sum(quantities.impacts_right) + sum(quantities.impacts_left)
    return impacts / cycles if cycles else math.nan


def list_prc_curves(points: Iterable[PrcPoint], value: ResponseQuantity) -> list[FrequencyCurve]:
    """Return the curves of a quantity, twin before measured, forward before backward.

    The points are in order of frequency; of points at one frequency the last counts.
    """
    points = list(points)
    curves = []
    for source in ("twin", "measured"):
        for direction in ("forward", "backward"):
            values = {
                point.frequency_hz: value(quantities)
                for point in points
                if point.direction == direction
                and (quantities := getattr(point, source)) is not None
            }
            if values:
                curves.append(FrequencyCurve(source, direction, tuple(sorted(values.items()))))
    return curves


def list_orbit_curves(plan: OrbitPlan, orbits: Iterable[OrbitPoint]) -> list[FrequencyCurve]:
    """Return the planned amplitudes in mm, and the measured orbits: accepted ones, then others."""
    measured = list(orbits)
    selections = (
        ("twin", "forward", plan.points),
        ("orbit", "forward", [orbit for orbit in measured if orbit.accepted]),
        ("orbit", "backward", [orbit for orbit in measured if not orbit.accepted]),
    )
    return [
        FrequencyCurve(
            source,
            direction,
            tuple((orbit.frequency_hz, 1e3 * orbit.amplitude_m) for orbit in selected),
        )
        for source, direction, selected in selections
    ]
