"""Localization of the discrepancy: residual map over steps, contact phases and rows.

The excess of a cell is its mean square over the noise, less the floor; its significance comes from
the scatter of the blocks in it. The floor is the variance between repeated periods, at least that
of the noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import welch

from table_io.block import Float1D, Int1D
from table_io.records import Step
from twin.discovery.residuals import PULL_ROWS, LogResiduals

PHASES = ("flight", "contact_right", "contact_left", "contact_both")
MAIN_SHARE = 0.8  # of the excess that a reported band, direction or phase must contain
MIN_MENTIONED_SHARE = 0.15  # of the excess: rows and harmonics with less are not reported
HARMONIC_COUNT = 7
NO_STEP = -1
MIN_STEPPED_SHARE = 0.4  # of the moving time that steps cover in a stepped sine
SEGMENT_S = 20.0  # Welch segment for motions without steps
MIN_LINE_POWER_RATIO = 3.0  # over the noise power: weaker spectral lines may be noise
MIN_PULL_MEAN_SQUARE = 3.0  # mean square over the noise above which tension is reported
ROW_CHANNELS = {
    "damper": ("mass_acc_m_s2",), "damper itself": ("damper_force_n",),
    "right": ("force_r1_n", "force_r2_n"), "left": ("force_l1_n", "force_l2_n"),
    "mass": ("mass_disp_m", "mass_acc_m_s2"),
    "table": ("table_disp_m", "table_acc_m_s2"),
    "mass against table": ("rel_disp_m", "mass_acc_m_s2", "table_acc_m_s2"),
    "right cells": ("force_r1_n", "force_r2_n"), "left cells": ("force_l1_n", "force_l2_n"),
    "right pull": ("force_r1_n", "force_r2_n"), "left pull": ("force_l1_n", "force_l2_n"),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ResidualCell:
    """Cell of the residual map: log, step, contact phase and row, with its mean square."""

    log: int
    step: int
    phase: str
    row: str
    count: int
    mean_square: float
    excess: float  # mean square less the floor
    significance: float  # excess in standard errors


@dataclass(frozen=True, slots=True)
class Localization:
    """Location of most of the excess; empty or None if there is none."""

    frequency_hz: tuple[float, float] | None
    direction: str
    phase: str
    channels: tuple[str, ...]
    harmonics: tuple[int, ...]


def classify_phases(residuals: LogResiduals) -> Int1D:
    """Return the index into `PHASES` of each entry, (entry,); tension counts as contact."""
    in_contact = (residuals.contact_state > 0).astype(np.int64)
    phases: Int1D = (in_contact[0] + 2 * in_contact[1])[residuals.entry_sample]
    for side, name in enumerate(PULL_ROWS):
        if name in residuals.rows:
            phases[residuals.entry_row == residuals.rows.index(name)] |= 1 + side
    return phases


def is_stepped_sine(residuals: LogResiduals) -> bool:
    """Return False if steps cover too little of the motion for a stepped sine."""
    moving = residuals.motion().moving
    return bool((moving & (residuals.signals.step >= 0)).sum() > MIN_STEPPED_SHARE * moving.sum())


def build_cells(
    log_residuals: Sequence[LogResiduals], held_out: Sequence[Float1D], floor: float
) -> tuple[ResidualCell, ...]:
    """Build the residual map from residuals over the noise, (entry,) per log.

    `floor` is a mean square. A log that is no stepped sine is a single step, `NO_STEP`.
    """
    cells = []
    for residuals, r in zip(log_residuals, held_out, strict=True):
        is_stepped = is_stepped_sine(residuals)
        step = np.where(is_stepped, residuals.signals.step, NO_STEP)[residuals.entry_sample]
        places = np.flatnonzero(
            ((step >= 0) | (not is_stepped)) & (residuals.entry_row < len(residuals.rows))
        )
        keys = np.stack([residuals.entry_row, step, classify_phases(residuals)])[:, places]
        order = np.lexsort(keys[::-1])
        keys = keys[:, order]
        is_new = np.diff(keys, axis=1, prepend=-1).any(axis=0)
        groups = np.split(places[order], np.flatnonzero(is_new)[1:]) if places.size else []
        for (row, step_number, phase), places_in_cell in zip(
            keys[:, is_new].T.tolist(), groups, strict=True
        ):
            cells.append(
                _build_cell(
                    residuals,
                    r,
                    places_in_cell,
                    step_number,
                    PHASES[phase],
                    residuals.rows[row],
                    floor,
                )
            )
    return tuple(cells)


def _build_cell(
    residuals: LogResiduals,
    r: Float1D,
    places: Int1D,
    step: int,
    phase: str,
    row: str,
    floor: float,
) -> ResidualCell:
    """Build the cell of the entries at the indices `places`."""
    squares = r[places] ** 2
    blocks = np.unique(residuals.entry_block[places], return_inverse=True)[1]
    sums = np.bincount(blocks, weights=squares - floor)
    # at least the variance for white noise; differences between blocks increase it
    variance = max(2.0 * floor**2 * squares.size, float(((sums - sums.mean()) ** 2).sum()))
    excess = float(sums.sum())
    return ResidualCell(
        residuals.log_number, step, phase, row, squares.size, float(squares.mean()),
        excess / squares.size, excess / math.sqrt(variance),
    )  # fmt: skip


def find_pulling_bumpers(
    log_residuals: Sequence[LogResiduals], held_out: Sequence[Float1D]
) -> tuple[str, ...]:
    """Return a message per bumper that pulls; compression-only bumper laws cannot explain it."""
    messages = []
    for residuals, r in zip(log_residuals, held_out, strict=True):
        for name in PULL_ROWS:
            mask = (
                residuals.entry_row == residuals.rows.index(name)
                if name in residuals.rows
                else None
            )
            if mask is None or not mask.any():
                continue
            # of the noise of the sensors, whatever else the weight of a log counts
            if np.mean((residuals.entry_weight * r)[mask] ** 2) > MIN_PULL_MEAN_SQUARE:
                side = name.split()[0]
                messages.append(
                    f"{residuals.signals.name}: the {side} bumper pulls after release, as if it "
                    "adhered to the mass: no law in compression alone does this"
                )
    return tuple(messages)


def localize_excess(
    log_residuals: Sequence[LogResiduals],
    held_out: Sequence[Float1D],
    cells: Sequence[ResidualCell],
    steps: Sequence[Sequence[Step]],
) -> Localization:
    """Return the frequencies, direction, phase, channels and harmonics with most of the excess.

    `held_out` are residuals over the noise, (entry,) per log, `cells` their map.
    """
    significant = [cell for cell in cells if cell.significance > 3.0 and cell.excess > 0]
    total = sum(cell.excess * cell.count for cell in significant)
    if total <= 0:
        return Localization(None, "both", "all", (), ())

    def shares(keys: Sequence[object]) -> dict[object, float]:
        sums: dict[object, float] = {}
        for key, cell in zip(keys, significant, strict=True):
            sums[key] = sums.get(key, 0.0) + cell.excess * cell.count / total
        return sums

    step_by_index = [{step.index: step for step in log} for log in steps]
    cell_steps = [step_by_index[cell.log].get(cell.step) for cell in significant]
    frequency = shares([step.frequency_hz if step else None for step in cell_steps])
    direction = shares([step.direction if step else None for step in cell_steps])
    phase = shares([cell.phase for cell in significant])
    rows = shares([_name_row(log_residuals[cell.log], cell.row) for cell in significant])
    channels = [
        c
        for row, s in rows.items()
        if s > MIN_MENTIONED_SHARE
        for c in ROW_CHANNELS.get(str(row), ())
    ]
    unstepped = {
        cell.log
        for cell, step in zip(significant, cell_steps, strict=True)
        if not step and cell.row == "damper"
    }
    return Localization(
        _main_band(frequency) or _spectral_band(log_residuals, held_out, unstepped),
        next((str(k) for k, s in direction.items() if s > MAIN_SHARE and k), "both"),
        _main_phase(phase),
        tuple(dict.fromkeys(channels)),
        _main_harmonics(log_residuals, held_out, steps),
    )


def _name_row(residuals: LogResiduals, row: str) -> str:
    """Return the name of the row; "damper itself" if the damper force was measured directly."""
    is_measured = row == "damper" and "damper_force_n" in residuals.signals.channels
    return "damper itself" if is_measured else row


def _main_band(shares: dict[object, float]) -> tuple[float, float] | None:
    """Return the band in Hz of the steps with most of the excess; None if most is outside steps."""
    ranked = sorted(((s, k) for k, s in shares.items() if isinstance(k, float)), reverse=True)
    total = sum(share for share, _ in ranked)
    if total < 0.5:
        return None
    total_chosen, chosen = 0.0, []
    for share, hz in ranked:
        chosen.append(hz)
        total_chosen += share
        if total_chosen > MAIN_SHARE * total:
            break
    return (min(chosen), max(chosen)) if chosen else None


def _spectral_band(
    log_residuals: Sequence[LogResiduals], held_out: Sequence[Float1D], logs: set[int]
) -> tuple[float, float] | None:
    """Return the band in Hz with most power of the damper residual above the noise.

    Only these logs count; None without any.
    """
    spectra = []
    for number in sorted(logs):
        residuals, r = log_residuals[number], held_out[number]
        mask, rate_hz = residuals.entry_row == 0, residuals.signals.fuse_motion().rate_hz
        series = np.zeros(residuals.signals.time_s.size)
        series[residuals.entry_sample[mask]] = r[mask]
        hz, power = welch(series, rate_hz, nperseg=min(series.size, round(SEGMENT_S * rate_hz)))
        noise = float(np.median(power))  # most of the band contains only noise
        spectra.append(
            (hz, np.where(power > MIN_LINE_POWER_RATIO * noise, power - noise, 0.0) * mask.sum())
        )
    hz = max(
        (spectrum for spectrum, _ in spectra),
        key=lambda spectrum: spectrum[-1],
        default=np.zeros(0),
    )
    power = np.sum([np.interp(hz, *spectrum, right=0.0) for spectrum in spectra], axis=0)
    if not np.sum(power) > 0:
        return None
    cumulative = np.cumsum(power) / power.sum()
    low, high = np.searchsorted(cumulative, (0.5 * (1 - MAIN_SHARE), 1 - 0.5 * (1 - MAIN_SHARE)))
    return float(hz[low]), float(hz[high])


def _main_phase(shares: dict[object, float]) -> str:
    right, left = shares.get("contact_right", 0.0), shares.get("contact_left", 0.0)
    both = right + left + shares.get("contact_both", 0.0)
    if shares.get("flight", 0.0) > MAIN_SHARE:
        return "flight"
    for name, share in (("contact_right", right), ("contact_left", left), ("contact_both", both)):
        if share > MAIN_SHARE:
            return name
    return "all"


def _main_harmonics(
    log_residuals: Sequence[LogResiduals],
    held_out: Sequence[Float1D],
    steps: Sequence[Sequence[Step]],
) -> tuple[int, ...]:
    """Return the main harmonics of the drive in the damper residual; 0 is its mean."""
    power = np.zeros(HARMONIC_COUNT + 1)
    for residuals, r, log_steps in zip(log_residuals, held_out, steps, strict=True):
        mask = residuals.entry_row == 0
        samples, values = residuals.entry_sample[mask], r[mask]
        for step in log_steps:
            in_step = (residuals.signals.step[samples] == step.index) & (
                residuals.signals.cycle[samples] >= 0
            )
            if in_step.sum() < 4 * HARMONIC_COUNT:
                continue
            t = residuals.signals.time_s[samples[in_step]]
            angle = 2 * np.pi * step.frequency_hz * t[:, None] * np.arange(1, HARMONIC_COUNT + 1)
            design = np.hstack([np.ones((t.size, 1)), np.cos(angle), np.sin(angle)])
            x = np.linalg.lstsq(design, values[in_step], rcond=None)[0]
            power[0] += x[0] ** 2 * t.size
            power[1:] += (
                0.5 * (x[1 : HARMONIC_COUNT + 1] ** 2 + x[HARMONIC_COUNT + 1 :] ** 2) * t.size
            )
            power -= 3.0  # generous estimate of the noise contribution
    power = np.maximum(power, 0.0)
    total = power.sum()
    return (
        tuple(int(k) for k in np.flatnonzero(power > MIN_MENTIONED_SHARE * total))
        if total > 0
        else ()
    )
