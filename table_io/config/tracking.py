"""Tracking: how the motion of the table is judged against the history that it should follow.

A required response spectrum (RRS) is a CSV file with the headers `frequency_hz,sa_g`, ascending,
and comments after #. Between its points it is straight over the logarithms of both.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import ConfigModel, Number, Positive, find_attached_text
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2

REQUIRED_COLUMNS = "frequency_hz,sa_g"
MAX_SPECTRUM_POINTS = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class RequiredSpectrum:
    """Required response spectrum: frequency in Hz, ascending, and SA in m/s2, (point,) each."""

    frequencies_hz: Float1D
    sa_m_s2: Float1D

    def interpolate(self, frequencies_hz: Float1D) -> Float1D:
        """Return the SA in m/s2 at frequencies in Hz, (frequency,); NaN outside its range."""
        logarithms = np.interp(
            np.log(frequencies_hz), np.log(self.frequencies_hz), np.log(self.sa_m_s2)
        )
        low, high = self.frequencies_hz[[0, -1]] * (1 - 1e-9, 1 + 1e-9)
        inside = (low <= frequencies_hz) & (frequencies_hz <= high)
        return np.where(inside, np.exp(logarithms), np.nan)


class TrackingConfig(ConfigModel):
    """How the motion of the table is judged against its target, a displacement history.

    The tolerance of a required spectrum is that of usual seismic qualification (ICC-ES AC156): not
    more than 10 % below it, and not more than 30 % above.
    """

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("required_spectrum",)

    band_hz: tuple[Positive, Positive] | None = Field(
        None,
        description="Lowest and highest frequency of interest; omitted: an octave more on either "
        "side than 5 to 95 % of the energy of the target's acceleration.",
    )
    damping: Number = Field(0.05, gt=0, le=0.5, description="Ratio, of the response spectra.")
    files: dict[str, str] = Field({}, description="Texts of files by name; loading attaches them.")
    required_spectrum: str | None = Field(
        None, description="CSV file next to the profile with `frequency_hz` and `sa_g`."
    )
    required_lower: Number = Field(
        0.9, gt=0, le=1.0, description="Least allowed share of the required spectrum."
    )
    required_upper: Number = Field(
        1.3, ge=1.0, description="Largest allowed share of the required spectrum; inf: no limit."
    )

    @field_validator("band_hz")
    @classmethod
    def _check_band(cls, band: tuple[float, float] | None) -> tuple[float, float] | None:
        if band is not None and band[0] >= band[1]:
            raise InputError(
                f"the band goes from {band[0]:g} to {band[1]:g} Hz", remedy="exchange them"
            )
        return band

    @field_validator("required_spectrum")
    @classmethod
    def _check_spectrum(cls, name: str | None, info: ValidationInfo) -> str | None:
        text = find_attached_text(name, info)
        if text is not None:
            parse_required_spectrum(text, str(name))
        return name

    @cached_property
    def spectrum(self) -> RequiredSpectrum | None:
        """Required response spectrum; None if the profile names none."""
        if self.required_spectrum is None:
            return None
        return parse_required_spectrum(self.files[self.required_spectrum], self.required_spectrum)


def parse_required_spectrum(text: str, name: str) -> RequiredSpectrum:
    """Parse the CSV text of a required response spectrum; InputError names the line at fault."""
    rows = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    header = ",".join(column.strip() for column in rows[0][1].split(",")) if rows else ""
    if header != REQUIRED_COLUMNS:
        raise InputError(f"{name}: the headers are {header or 'missing'}", allowed=REQUIRED_COLUMNS)
    if not 2 <= len(rows) - 1 <= MAX_SPECTRUM_POINTS:
        raise InputError(f"{name}: {len(rows) - 1} points", allowed=f"2 to {MAX_SPECTRUM_POINTS}")
    points: list[tuple[float, float]] = []
    for number, line in rows[1:]:
        try:
            hz, sa_g = map(float, line.split(","))
        except ValueError:
            raise InputError(f"{name} line {number}: {line[:40]!r} is not two numbers") from None
        if not (0.0 < hz < math.inf and 0.0 < sa_g < math.inf):
            raise InputError(
                f"{name} line {number}: {line[:40]!r}", allowed="positive numbers, finite"
            )
        if points and hz <= points[-1][0]:
            raise InputError(
                f"{name} line {number}: frequency_hz does not increase", remedy="sort the lines"
            )
        points.append((hz, sa_g))
    hz_column, sa_column = np.array(points).T
    return RequiredSpectrum(hz_column.copy(), sa_column * GRAVITY_M_S2)
