"""Relative displacement by double integration of accelerations in a stated band."""

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.errors import InputError

EDGE_SHARE = 0.25  # of a corner frequency, over which the band fades in and out
MASS_ACC, TABLE_ACC, REL_DISP = "mass_acc_m_s2", "table_acc_m_s2", "rel_disp_m"


def integrate_accelerations(
    channels: dict[str, Float1D], index: Int1D, rate_hz: float, band_hz: tuple[float, float]
) -> tuple[dict[str, Float1D], str]:
    """Return (channels with rel_disp_m, (row,), note): all of them limited to the band.

    The double integral -a / w^2 amplifies what lies below the band, so it is cut there; all other
    channels are cut alike, because a force law relates u and a at the same frequencies. Without
    table_acc_m_s2 the base is fixed. Raise InputError if that cannot be done.
    """
    low_hz, high_hz = band_hz
    duration_s = index.size / rate_hz
    if REL_DISP in channels:
        raise InputError(
            "the file has a relative displacement", key="integrate_hz", remedy="leave it out"
        )
    if MASS_ACC not in channels:
        raise InputError(
            "no acceleration of the mass to integrate", key="integrate_hz", allowed=MASS_ACC
        )
    if low_hz < 2.0 / duration_s or high_hz > 0.5 * rate_hz:
        raise InputError(
            "the band does not fit the record",
            key="integrate_hz",
            value=list(band_hz),
            allowed=f"within {2.0 / duration_s:.3g} to {0.5 * rate_hz:.6g} Hz",
        )
    lost = [name for name, values in channels.items() if np.isnan(values).any()]
    if lost or index[-1] != index.size - 1:
        raise InputError(
            f"samples are lost ({', '.join(lost) or 'gaps'})",
            key="integrate_hz",
            remedy="integrate a part without gaps, --from and --to",
        )
    size = index.size
    frequency = np.fft.rfftfreq(2 * size, 1.0 / rate_hz)  # twice as long: no wrap-around
    band = _fade(frequency, low_hz * (1 - EDGE_SHARE), low_hz) * (
        1.0 - _fade(frequency, high_hz, high_hz * (1 + EDGE_SHARE))
    )
    omega_squared = (2 * np.pi * frequency) ** 2

    def filter_values(values: Float1D, gain: Float1D) -> Float1D:
        mirrored = np.concatenate([values, values[::-1]])
        filtered: Float1D = np.fft.irfft(np.fft.rfft(mirrored) * gain, 2 * size)[:size]
        return filtered

    relative = channels[MASS_ACC] - channels.get(TABLE_ACC, np.zeros(size))
    gain = np.where(band > 0, -band / np.maximum(omega_squared, 1e-300), 0.0)
    limited = {name: filter_values(values, band) for name, values in channels.items()}
    limited[REL_DISP] = filter_values(relative - relative.mean(), gain)
    against = " less table_acc_m_s2" if TABLE_ACC in channels else ", the base at rest"
    note = (
        f"rel_disp_m is the double integral of mass_acc_m_s2{against}; all channels are limited "
        f"to {low_hz:g} to {high_hz:g} Hz"
    )
    return limited, note


def _fade(frequency: Float1D, start_hz: float, end_hz: float) -> Float1D:
    """Return a half cosine from 0 at `start_hz` to 1 at `end_hz`, (frequency,)."""
    share = np.clip((frequency - start_hz) / (end_hz - start_hz), 0.0, 1.0)
    rise: Float1D = 0.5 - 0.5 * np.cos(np.pi * share)
    return rise
