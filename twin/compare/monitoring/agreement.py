"""Agreement check: is the restarted twin within its tolerance band?

    band = 3 x noise at rest + 5 % of the cycle's amplitude

It covers noise and the error of a good model. For displacements the amplitude is that of u, since
the total one may be small where the mass hardly moves; for forces the first term is at least the
contact threshold. On the simulated rig with the right model the error stays below half of the
band; see the tests.

An Event also allows for what instruments and set-up may contribute: gaps are known to
GAP_ERROR_M only, which a stiff bumper turns into force, lasers have a linearity error, and the two
cells of a side may share their force unequally, so their sum is judged.
"""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Block, Bool1D, Float1D, Float2D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, relative_displacement
from table_io.records import Agreement, Event, Record
from twin.compare import COMPARED_CHANNELS
from twin.compare.monitoring.cycle import ChannelNoise, CycleData, MonitoringSetup
from twin.compare.twins import compared_values
from twin.model.parameters import Parameters

NOISE_FACTOR = 3.0
AMPLITUDE_TOLERANCE = 0.05  # of the amplitude
MAX_AGREEING_SHARE = 0.7  # of the band: below it twin and rig agree again
MIN_CYCLES_OUTSIDE = 2  # consecutive cycles beyond the band before an Event
ALREADY_REPORTED = -1
# Of a gap where it is touched: 0.05 mm of a feeler gauge and as much of the lasers' linearity.
GAP_ERROR_M = 1e-4
LASER_LINEARITY = 0.003  # of the travel of the table: 0.1 % of the range of each laser
PHASE_NAMES = ("in flight", "in contact right", "in contact left")


@dataclass(frozen=True, slots=True)
class AgreementState:
    """Consecutive cycles beyond a band, or `ALREADY_REPORTED` until all channels agree again."""

    cycles: int = 0
    ever_reported: bool = False


def check_agreement(
    setup: MonitoringSetup,
    state: AgreementState,
    noise: ChannelNoise,
    cycle: CycleData,
    is_input_right: bool = True,
) -> tuple[AgreementState, list[Record]]:
    """Return the Agreement of a cycle, and an Event if channels have left their bands.

    The twin is not judged by a cycle in which its input was wrong.
    """
    measured = compared_values(cycle.measured)
    errors = measured - np.array(
        [cycle.predicted.channel(f"window/{name}") for name in COMPARED_CHANNELS]
    )
    squares, phases = errors**2, _phases(setup, cycle)
    half_ranges = [_half_range(values) for values in measured]
    band = [
        _min_band(setup, noise, name)
        + AMPLITUDE_TOLERANCE * (half_ranges[0] if name.endswith("disp_m") else half_range)
        for half_range, name in zip(half_ranges, COMPARED_CHANNELS, strict=True)
    ]
    record = Agreement(
        cycle.end, cycle.step.index, cycle.number, len(cycle.measured), COMPARED_CHANNELS,
        _rms(squares), tuple(band),
        *(_rms(np.compress(phase, squares, axis=1)) for phase in phases),
    )  # fmt: skip
    shares = _judge_errors(setup, cycle, record, errors, phases)
    if not is_input_right or np.isnan(record.error).all():
        return state, [record]
    if state.cycles == ALREADY_REPORTED:
        return AgreementState(ALREADY_REPORTED if max(shares) > MAX_AGREEING_SHARE else 0, True), [
            record
        ]
    cycles = state.cycles + 1 if max(shares) > 1 else 0
    if cycles < MIN_CYCLES_OUTSIDE:
        return AgreementState(cycles, state.ever_reported), [record]
    return AgreementState(ALREADY_REPORTED, True), [
        record,
        Event(cycle.end, "disagreement", _sentence(cycle, record, shares)),
    ]


def _judge_errors(
    setup: MonitoringSetup,
    cycle: CycleData,
    record: Agreement,
    errors: Float2D,
    phases: list[Bool1D],
) -> list[float]:
    """Return the error of each compared channel in units of its band, with allowances."""
    right, left = (float(phase.mean()) for phase in phases[1:])
    travel_m = _half_range(cycle.channel_values("table_disp_m"))
    allowance, forces = set_up_allowances(setup.model.parameters, right, left, travel_m)
    error = dict(zip(COMPARED_CHANNELS, record.error, strict=True))
    band = dict(zip(COMPARED_CHANNELS, record.band, strict=True))
    rows = dict(zip(COMPARED_CHANNELS, errors, strict=True))
    for cells, force in zip((RIGHT_CELLS, LEFT_CELLS), forces, strict=True):
        total: Float1D = np.sum([rows[name] for name in cells], axis=0)
        (side_error,), side_band = _rms(total[None] ** 2), sum(band[name] for name in cells)
        for name in cells:
            allowance[name] = 0.5 * force
            if np.isfinite(side_error):
                error[name], band[name], allowance[name] = side_error, side_band, force
    return [
        error[name] / (band[name] + allowance[name])
        if band[name] > 0 and not np.isnan(error[name])
        else 0.0
        for name in COMPARED_CHANNELS
    ]


def set_up_allowances(
    p: Parameters, right: float, left: float, travel_m: float
) -> tuple[dict[str, float], tuple[float, float]]:
    """Return what gaps and lasers contribute to the rms error of displacements and acceleration.

    By channel, and of the forces (right, left) in N; `right` and `left` are the shares of the time
    in contact, `travel_m` is half the range of the table's displacement, NaN if unknown.
    """
    lasers = LASER_LINEARITY * travel_m if math.isfinite(travel_m) else 0.0
    force_r = p.bumper_stiffness_r * (GAP_ERROR_M + lasers) * math.sqrt(right)
    force_l = p.bumper_stiffness_l * (GAP_ERROR_M + lasers) * math.sqrt(left)
    disp = GAP_ERROR_M * math.sqrt(max(right, left)) + lasers
    allowance = dict.fromkeys(COMPARED_CHANNELS, disp)
    allowance["mass_acc_m_s2"] = math.hypot(force_r, force_l) / p.mass
    return allowance, (force_r, force_l)


def _sentence(cycle: CycleData, record: Agreement, shares: list[float]) -> str:
    worst = int(np.argmax(shares))
    also_outside = [
        COMPARED_CHANNELS[i] for i, share in enumerate(shares) if share > 1 and i != worst
    ]
    phase_errors = [errors[worst] for errors in (record.flight, record.right, record.left)]
    phase = PHASE_NAMES[int(np.nanargmax(phase_errors))]
    return (
        f"{COMPARED_CHANNELS[worst]} differs from the restarted twin by "
        f"{record.error[worst]:.3g} (rms), {shares[worst]:.1f} times the band, at "
        f"{cycle.step.frequency_hz:g} Hz {cycle.step.direction}, most {phase}"
        + (f"; also {', '.join(also_outside)}" if also_outside else "")
    )


def _min_band(setup: MonitoringSetup, noise: ChannelNoise, name: str) -> float:
    """Return the band of a compared channel without motion; NaN if its noise is unknown."""
    is_relative = name == "rel_disp_m"
    rms = noise.relative_displacement_rms if is_relative else noise.channel_rms(name)
    if name.startswith("force"):
        return max(setup.contact_n, NOISE_FACTOR * rms) if rms > 0 else setup.contact_n
    return NOISE_FACTOR * rms if rms > 0 else float("nan")


def _phases(setup: MonitoringSetup, cycle: CycleData) -> list[Bool1D]:
    """Return masks of flight, contact right and contact left: by load cells, else by gaps."""
    right, left = detect_contact(cycle.measured, setup.contact_n, setup.gaps_m)
    return [~(right | left), right, left]


def detect_contact(
    block: Block, contact_n: float, gaps_m: tuple[float, float]
) -> tuple[Bool1D, Bool1D]:
    """Return where the mass touches the right and the left bumper, (sample,): by load cells.

    By the gaps where a load cell has no value.
    """
    u = relative_displacement(block)
    right, left = (
        np.where(~np.isnan(force), side * force > contact_n, side * u > gap)
        for side, force, gap in zip((1, -1), contact_forces(block), gaps_m, strict=True)
    )
    return right, left


def _rms(squares: Float2D) -> tuple[float, ...]:
    """Return the root mean of the known squares of each row; NaN if less than half are known."""
    if squares.size and np.isfinite(squares).all():
        return tuple(np.sqrt(squares.mean(axis=1)).tolist())
    known = [row[~np.isnan(row)] for row in squares]
    return tuple(
        float(np.sqrt(row.mean())) if 2 * row.size > squares.shape[1] else math.nan for row in known
    )


def _half_range(values: Float1D) -> float:
    """Return half of the range of the known values; NaN if none is known."""
    known = values[np.isfinite(values)]
    return 0.5 * float(np.ptp(known)) if known.size else float("nan")
