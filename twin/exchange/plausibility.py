"""Plausibility of imported numbers: ranges of quantities, and displacement against acceleration."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.units import UNITS

RELATIVE_ACC = "mass_acc_m_s2 - table_acc_m_s2"
CHECKED_PAIRS = (
    ("table_disp_m", "table_acc_m_s2"),
    ("mass_disp_m", "mass_acc_m_s2"),
    ("rel_disp_m", RELATIVE_ACC),
)
# peak to peak, of tests on shaking tables and of their components, in SI
PLAUSIBLE_RANGES = {"m": (2e-5, 2.5), "m/s2": (0.05, 300.0)}
PAIR_UNITS = {"m": ("m", "mm", "cm", "in"), "m/s2": ("m/s2", "g", "cm/s2", "mm/s2")}
MIN_ACC_RANGE_M_S2 = 0.5  # of an acceleration that no displacement confirms
MAX_LOG_RATIO = 0.15  # of the second derivative of a displacement over the acceleration
MIN_LINE_SHARE = 0.1  # of the largest product of the two spectra: lines that are compared


@dataclass(frozen=True)
class Implausible:
    """Channels whose numbers are absurd in SI, and why; `is_possible`: or only unusual."""

    channels: tuple[str, ...]
    problem: str
    is_possible: bool = False


def find_plausible_units(si_unit: str, values: Float1D, allowed: Mapping[str, float]) -> list[str]:
    """Return the common units in which the range of the values, (row,), is plausible."""
    low, high = PLAUSIBLE_RANGES[si_unit]
    reach = float(np.nanmax(values) - np.nanmin(values))
    return [
        unit
        for unit in PAIR_UNITS[si_unit]
        if unit in allowed and low <= reach * allowed[unit] <= high
    ]


def compare_derivative(disp: Float1D, acc: Float1D, rate_hz: float) -> float:
    """Return the rms of the second derivative of `disp` over that of `acc`, (row,) each.

    Only spectral lines count at which both are large. NaN if one of them is zero.
    """
    x, a = (np.nan_to_num(values - np.nanmean(values)) for values in (disp, acc))
    window = np.hanning(x.size)
    spectrum_x, spectrum_a = np.fft.rfft(x * window), np.fft.rfft(a * window)
    omega_squared = (2 * np.pi * rate_hz * np.fft.rfftfreq(x.size)) ** 2
    product = np.abs(spectrum_x * spectrum_a)  # the hum of a second derivative would be loud
    is_loud = product >= MIN_LINE_SHARE * product.max()
    total = float(np.sum(np.abs(spectrum_a[is_loud]) ** 2))
    if not total:
        return float("nan")
    return float(np.sqrt(np.sum(np.abs(omega_squared * spectrum_x)[is_loud] ** 2) / total))


def match_unit_pairs(disp: Float1D, acc: Float1D, rate_hz: float) -> list[tuple[str, str]]:
    """Return the (unit of displacement, unit of acceleration) with which both tell one motion."""
    ratio = compare_derivative(disp, acc, rate_hz)
    return [
        (disp_unit, acc_unit)
        for disp_unit in PAIR_UNITS["m"]
        for acc_unit in PAIR_UNITS["m/s2"]
        if ratio > 0
        and abs(np.log(ratio * UNITS[disp_unit][1] / UNITS[acc_unit][1])) < MAX_LOG_RATIO
    ]


def list_implausible(
    channels: Mapping[str, Float1D], units: Mapping[str, str], rate_hz: float
) -> list[Implausible]:
    """Return what is absurd of channels in SI, (row,) each; `units` are the recorded ones."""
    problems = []
    finite = {name: values for name, values in channels.items() if np.isfinite(values).any()}
    for name, values in finite.items():
        _, high = PLAUSIBLE_RANGES.get(units.get(name, ""), (0.0, np.inf))
        reach = float(np.nanmax(values) - np.nanmin(values))
        if reach > high:
            text = f"{name} has a range of {reach:.4g} {units[name]}, more than {high:g}"
            problems.append(Implausible((name,), text))
    if {"mass_acc_m_s2", "table_acc_m_s2"} <= finite.keys():
        finite[RELATIVE_ACC] = finite["mass_acc_m_s2"] - finite["table_acc_m_s2"]
    compared: set[str] = set()
    for disp, acc in CHECKED_PAIRS:
        if not {disp, acc} <= finite.keys():
            continue
        accelerations = tuple(acc.split(" - "))
        compared |= {*accelerations}
        pairs = match_unit_pairs(finite[disp], finite[acc], rate_hz)
        if pairs and ("m", "m/s2") not in pairs:
            fitting = " or ".join(f"{d} and {a}" for d, a in pairs)
            ratio = compare_derivative(finite[disp], finite[acc], rate_hz)
            text = (
                f"the second derivative of {disp} is {ratio:.4g} times {acc}, as if they were in "
                f"{fitting}"
            )
            problems.append(Implausible((disp, *accelerations), text))
    for name in ("mass_acc_m_s2", "table_acc_m_s2"):
        reach = float(np.ptp(finite[name][np.isfinite(finite[name])])) if name in finite else 0.0
        if name not in compared and 0 < reach < MIN_ACC_RANGE_M_S2:
            text = f"{name} has a range of {reach:.4g} m/s2 only, as if it were in g"
            problems.append(Implausible((name,), text, is_possible=True))
    return problems
