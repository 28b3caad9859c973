"""Sensor consistency: (total) x'' = a holds for each body under any force law.

Per held cycle <phi, a> = <phi'', x> for the mass and for the table (`cycle.weight_functions`), and
the two load cells of a side carry equal shares. A deviation is due to a sensor or its mounting.
"""

from dataclasses import dataclass

import numpy as np

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import Event, Record
from twin.compare.monitoring.cycle import (
    ChannelNoise,
    CycleData,
    MonitoringSetup,
    weight_functions,
    weighted_sums,
)

BODY_SENSORS = (
    ("mass", "mass_acc_m_s2", "mass_disp_m"),
    ("table", "table_acc_m_s2", "table_disp_m"),
)
CELL_PAIRS = (("right", *RIGHT_CELLS), ("left", *LEFT_CELLS))
MAX_ACC_MISMATCH = 0.008  # of the acceleration: error of mounting and calibration
MAX_SHARE_DIFFERENCE = 0.1  # of a side's force: by which its two cells may differ
NOISE_FACTOR = 5.0
MIN_DOUBTFUL_CYCLES = 3  # consecutive cycles before an Event
ALREADY_REPORTED = -1


@dataclass(frozen=True, slots=True)
class ConsistencyState:
    """Consecutive doubtful cycles or `ALREADY_REPORTED`, per body, then per pair of cells."""

    cycles: tuple[int, ...] = (0,) * (len(BODY_SENSORS) + len(CELL_PAIRS))

    @property
    def any(self) -> bool:
        """True while sensors contradict each other."""
        return ALREADY_REPORTED in self.cycles


def check_consistency(
    setup: MonitoringSetup, state: ConsistencyState, noise: ChannelNoise, cycle: CycleData
) -> tuple[ConsistencyState, list[Record]]:
    """Update with one cycle; return an Event for each pair of sensors that does not agree."""
    findings = [_check_body(setup, noise, cycle, *sensors) for sensors in BODY_SENSORS]
    findings += [_check_cells(setup, cycle, *cells) for cells in CELL_PAIRS]
    cycles: list[int] = []
    items: list[Record] = []
    for count, text in zip(state.cycles, findings, strict=True):
        new_count = (
            count
            if text is None or (text and count == ALREADY_REPORTED)
            else count + 1
            if text
            else 0
        )
        if new_count == MIN_DOUBTFUL_CYCLES and text:
            items.append(Event(cycle.end, "instrument", text))
            new_count = ALREADY_REPORTED
        cycles.append(new_count)
    return ConsistencyState(tuple(cycles)), items


def _check_body(
    setup: MonitoringSetup, noise: ChannelNoise, cycle: CycleData, body: str, acc: str, disp: str
) -> str | None:
    """Describe a mismatch of a body's sensors; "" if they agree, None if unknown."""
    a, x = cycle.channel_values(acc), cycle.channel_values(disp)
    rms = noise.channel_rms(acc), noise.channel_rms(disp)
    if not (np.isfinite(a + x).all() and np.isfinite(rms).all()):
        return None
    phi, _, curvature = weight_functions(a.size, setup.rate_hz)
    # The first test function shows a steady offset, which is no motion.
    by_acc, by_disp = weighted_sums(phi, a)[1:], weighted_sums(curvature, x)[1:]
    sd = np.hypot(
        rms[0] * np.sqrt((phi[1:] ** 2).sum(axis=1)),
        rms[1] * np.sqrt((curvature[1:] ** 2).sum(axis=1)),
    )
    mismatch, size = by_acc - by_disp, float(np.sqrt((by_acc**2).sum()))
    share = float(np.sqrt((mismatch**2).sum())) / size if size > 0 else 0.0
    if share <= MAX_ACC_MISMATCH or not (np.abs(mismatch) > NOISE_FACTOR * sd).any():
        return ""
    gain = float((by_acc * by_disp).sum() / (by_disp**2).sum())
    return (
        f"{acc} and {disp} of the {body} do not agree: {100 * share:.1f} % of the acceleration at "
        f"{cycle.step.frequency_hz:g} Hz; the first reads {gain:.3f} times the second derivative "
        "of the second"
    )


def _check_cells(
    setup: MonitoringSetup, cycle: CycleData, side: str, first: str, second: str
) -> str | None:
    first_force, second_force = cycle.channel_values(first), cycle.channel_values(second)
    total_force = first_force + second_force
    in_contact = total_force > 4 * setup.contact_n
    if not (np.isfinite(total_force).all() and in_contact.any()):
        return None
    share = float(
        (first_force[in_contact] - second_force[in_contact]).sum() / total_force[in_contact].sum()
    )
    if abs(share) <= MAX_SHARE_DIFFERENCE:
        return ""
    return (
        f"{first} and {second} share the force on the {side} unequally: "
        f"{100 * (0.5 + 0.5 * share):.0f} to {100 * (0.5 - 0.5 * share):.0f} %"
    )
