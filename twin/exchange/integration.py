"""Channels that were not measured, from those that were, in the terms of a shaking table.

The relative displacement by double integration of accelerations in a stated band; a force on the
mass as a motion of the table that does the same.
"""

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.errors import InputError

EXTERNAL_FORCE = "external_force_n"  # column of a map, no channel
EDGE_SHARE = 0.25  # of a corner frequency, over which the band fades in and out
MIN_PERIODS = 2.0  # of the lowest frequency in the record
MASS_ACC, TABLE_ACC, REL_DISP = "mass_acc_m_s2", "table_acc_m_s2", "rel_disp_m"


def integrate_accelerations(
    channels: dict[str, Float1D], index: Int1D, rate_hz: float, band_hz: tuple[float, float]
) -> tuple[dict[str, Float1D], str]:
    """Return (channels with rel_disp_m, (row,), note): all of them limited to the band.

    The double integral -a / w^2 amplifies what lies below the band, so it is cut there; all other
    channels are cut alike, because a force law relates u and a at the same frequencies. Without
    table_acc_m_s2 the base is fixed. Raise InputError if that cannot be done.
    """
    if REL_DISP in channels:
        raise InputError(
            "the file has a relative displacement", key="integrate_hz", remedy="leave it out"
        )
    if MASS_ACC not in channels:
        raise InputError(
            "no acceleration of the mass to integrate", key="integrate_hz", allowed=MASS_ACC
        )
    _check_band(channels, index, rate_hz, band_hz)
    size = index.size
    frequency: Float1D = np.linspace(0.0, 0.5 * rate_hz, size + 1)
    low_hz, high_hz = band_hz
    band = _fade(frequency, low_hz * (1 - EDGE_SHARE), low_hz) * (
        1.0 - _fade(frequency, high_hz, high_hz * (1 + EDGE_SHARE))
    )
    omega = 2 * np.pi * np.maximum(frequency, frequency[1])

    def limit(values: Float1D, gain: Float1D) -> Float1D:
        # mirrored, so that the ends do not meet with a step
        mirrored = np.concatenate([values, values[::-1]]) - values.mean()
        limited: Float1D = np.fft.irfft(np.fft.rfft(mirrored) * gain, 2 * size)
        return limited[:size]

    relative = channels[MASS_ACC] - channels.get(TABLE_ACC, np.zeros(size))
    limited = {name: limit(values, band) for name, values in channels.items()}
    limited[REL_DISP] = limit(relative, -band / omega**2)
    against = " less table_acc_m_s2" if TABLE_ACC in channels else ", the base at rest"
    return limited, (
        f"rel_disp_m is the double integral of mass_acc_m_s2{against}; all channels are limited "
        f"to {band_hz[0]:g} to {band_hz[1]:g} Hz"
    )


def convert_external_force(
    channels: dict[str, Float1D], force: Float1D, mass_kg: float | None
) -> dict[str, Float1D]:
    """Return the accelerations, (row,), that replace a force in N on a mass with its base at rest.

    M u'' + ... = F is the motion on a table with the acceleration -F / M, and the total
    acceleration there is that of the mass less F / M.
    """
    if mass_kg is None:
        raise InputError(
            "the force accelerates a mass that is not stated",
            key=EXTERNAL_FORCE,
            remedy="state mass_kg in the map, or --mass KG",
        )
    if TABLE_ACC in channels:
        raise InputError(
            "is for a base at rest, and the file has table_acc_m_s2",
            key=EXTERNAL_FORCE,
            remedy="leave one out",
        )
    converted = {TABLE_ACC: -force / mass_kg}
    if MASS_ACC in channels:
        converted[MASS_ACC] = channels[MASS_ACC] - force / mass_kg
    return converted


def _check_band(
    channels: dict[str, Float1D], index: Int1D, rate_hz: float, band_hz: tuple[float, float]
) -> None:
    """Raise InputError if the record is too short for the band, or has gaps."""
    lowest_hz = MIN_PERIODS * rate_hz / index.size
    if band_hz[0] < lowest_hz or band_hz[1] > 0.5 * rate_hz:
        raise InputError(
            "the band does not fit the record",
            key="integrate_hz",
            value=list(band_hz),
            allowed=f"within {lowest_hz:.3g} to {0.5 * rate_hz:.6g} Hz",
        )
    lost = [name for name, values in channels.items() if np.isnan(values).any()]
    if lost or index[-1] != index.size - 1:
        raise InputError(
            f"samples are lost ({', '.join(lost) or 'gaps'})",
            key="integrate_hz",
            remedy="take a part without gaps, --from and --to",
        )


def _fade(frequency: Float1D, start_hz: float, end_hz: float) -> Float1D:
    """Return a half cosine from 0 at `start_hz` to 1 at `end_hz`, (frequency,)."""
    share = np.clip((frequency - start_hz) / (end_hz - start_hz), 0.0, 1.0)
    rise: Float1D = 0.5 - 0.5 * np.cos(np.pi * share)
    return rise
