"""Sensor consistency: (total) x'' = a holds for each body under any force law.

Per held cycle <phi, a> = <phi'', x> for the mass and for the table (`cycle.weight_functions`), but
for the low cut of a sound accelerometer (`table_io.sensor_errors`), which is estimated; and
the two load cells of a side carry equal shares. A deviation is due to a sensor or its mounting.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Block, Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import Event, Record
from table_io.sensor_errors import FIT_ERROR_RATIO, PairErrorEstimate, highpass
from twin.compare.monitoring.cycle import (
    ChannelNoise,
    CycleData,
    MonitoringSetup,
    weight_functions,
    weight_norms,
    weighted_sums,
)

BODY_SENSORS = (
    ("mass", "mass_acc_m_s2", "mass_disp_m"),
    ("table", "table_acc_m_s2", "table_disp_m"),
)
CELL_PAIRS = (("right", *RIGHT_CELLS), ("left", *LEFT_CELLS))
MAX_ACC_MISMATCH = 0.008  # of the acceleration: error of mounting and calibration
# The linearity error of a laser, up to 0.2 % of full scale, ripples about seven times over the
# range, so small motions are measured with a slope that is off by 1.4 %; an uneven surface adds
# some um, different in every cycle, at each harmonic. Neither shows at rest.
MAX_LASER_SLOPE_ERROR, MAX_LASER_PROFILE_M = 0.014, 4.5e-6
MIN_LOW_CUT_RAD_S = 2 * np.pi * 0.02  # below it turns the phase by 2 degrees at 0.5 Hz
MAX_LEFT_PHASE_RAD = 0.01  # of a low cut that is not removed: below it the twin's input is right
MAX_SHARE_DIFFERENCE = 0.1  # of a side's force: by which its two cells may differ
MAX_CELL_ZERO_RATIO = 0.125  # of the contact threshold: by which the zero of a cell may be off
NOISE_FACTOR = 5.0
MIN_DOUBTFUL_CYCLES = 3  # consecutive cycles before an Event
ALREADY_REPORTED = -1


@dataclass(frozen=True, slots=True)
class ConsistencyState:
    """Consecutive doubtful cycles or `ALREADY_REPORTED`, per body, then per pair of cells.

    `estimates`: errors of the sensors of each body. `is_settled`: the low cuts that were removed
    from the last cycle are those that it shows.
    """

    cycles: tuple[int, ...] = (0,) * (len(BODY_SENSORS) + len(CELL_PAIRS))
    estimates: tuple[PairErrorEstimate, ...] = field(
        default_factory=lambda: (PairErrorEstimate(),) * len(BODY_SENSORS)
    )
    is_settled: bool = True

    @property
    def any(self) -> bool:
        """True while sensors contradict each other."""
        return ALREADY_REPORTED in self.cycles

    @property
    def low_cuts(self) -> dict[str, float]:
        """Low cuts of accelerometers in rad/s by channel; 0 unless proven.

        Delay and low cut are hardly told apart at one frequency, and both turn its phase: more than
        one standard deviation is enough.
        """
        return {
            acc: estimate.errors.low_cut
            if MIN_LOW_CUT_RAD_S < estimate.errors.low_cut > estimate.low_cut_sd
            else 0.0
            for (_, acc, _), estimate in zip(BODY_SENSORS, self.estimates, strict=True)
        }


def check_consistency(
    setup: MonitoringSetup, state: ConsistencyState, noise: ChannelNoise, cycle: CycleData
) -> tuple[ConsistencyState, list[Record]]:
    """Update with one cycle; return an Event for each pair of sensors that does not agree."""
    bodies = [
        _check_body(setup, noise, cycle, estimate, *sensors)
        for sensors, estimate in zip(BODY_SENSORS, state.estimates, strict=True)
    ]
    findings = [text for text, _ in bodies]
    findings += [_check_cells(setup, cycle, *cells) for cells in CELL_PAIRS]
    cycles: list[int] = []
    items: list[Record] = []
    for count, text in zip(state.cycles, findings, strict=True):
        is_kept = text is None or (text and count == ALREADY_REPORTED)
        new_count = count if is_kept else count + 1 if text else 0
        if new_count == MIN_DOUBTFUL_CYCLES and text:
            items.append(Event(cycle.end, "instrument", text))
            new_count = ALREADY_REPORTED
        cycles.append(new_count)
    after = ConsistencyState(tuple(cycles), tuple(estimate for _, estimate in bodies))
    omega, removed = 2 * np.pi * cycle.step.frequency_hz, state.low_cuts
    is_settled = all(
        abs(low_cut - removed[name]) <= MAX_LEFT_PHASE_RAD * omega
        for name, low_cut in after.low_cuts.items()
    )
    return replace(after, is_settled=is_settled), items


def _check_body(
    setup: MonitoringSetup,
    noise: ChannelNoise,
    cycle: CycleData,
    estimate: PairErrorEstimate,
    body: str,
    acc: str,
    disp: str,
) -> tuple[str | None, PairErrorEstimate]:
    """Return (description, estimate with this cycle) of a mismatch of a body's sensors.

    The description is "" if they agree and None if unknown.
    """
    block: Block = cycle.recorded or cycle.corrected
    if not {acc, disp} <= {*block.channels}:
        return None, estimate
    a, x = block.channel(acc), block.channel(disp)
    rms = noise.channel_rms(acc), noise.channel_rms(disp)
    if not (np.isfinite(a + x).all() and np.isfinite(rms).all()):
        return None, estimate
    # The first test function shows a steady offset, which is no motion.
    phi, slope, curvature = (each[1:] for each in weight_functions(a.size, setup.rate_hz))
    phi_norm, curvature_norm = (each[1:] for each in weight_norms(a.size, setup.rate_hz))
    by_acc, by_disp = weighted_sums(phi, a), weighted_sums(curvature, x)
    by_low_cut, by_delay = weighted_sums(slope, [x, a])
    sd = np.hypot(rms[0] * phi_norm, rms[1] * curvature_norm)
    size = float(np.sqrt((by_acc**2).sum()))
    if size == 0:
        return "", estimate
    low_cut = estimate.errors.low_cut
    if low_cut:
        by_low_cut += low_cut * weighted_sums(phi, _highpass_cycle(x, low_cut, setup.rate_hz))
    profile_share = MAX_LASER_PROFILE_M / max(0.5 * float(np.ptp(x)), MAX_LASER_PROFILE_M)
    weight = 1.0 / np.hypot((FIT_ERROR_RATIO + profile_share) * size, sd)
    rows = weight * np.array([by_disp, by_low_cut, by_delay])
    omega = 2 * np.pi * cycle.step.frequency_hz
    estimate = estimate.update((rows @ rows.T, rows @ (weight * by_acc)), omega)
    errors = estimate.errors
    # A delay is told apart from a low cut, but it is not removed from the twin's input: it counts.
    expected = by_disp + errors.low_cut * by_low_cut
    mismatch = by_acc - expected
    share = float(np.sqrt((mismatch**2).sum())) / size
    if share <= MAX_ACC_MISMATCH:
        return "", estimate
    # cosine and sine of each harmonic together: independent of the phase
    profile = MAX_LASER_PROFILE_M * np.sqrt(0.5 * a.size) * np.linalg.norm(curvature[::2], axis=1)
    allowed = (MAX_ACC_MISMATCH + MAX_LASER_SLOPE_ERROR) * size + profile
    allowed = np.maximum(allowed, NOISE_FACTOR * np.hypot(sd[::2], sd[1::2]))
    if not (np.hypot(mismatch[::2], mismatch[1::2]) > allowed).any():
        return None, estimate
    gain = float((by_acc * expected).sum() / (expected**2).sum())
    return (
        f"{acc} and {disp} of the {body} do not agree: {100 * share:.1f} % of the acceleration at "
        f"{cycle.step.frequency_hz:g} Hz; the first reads {gain:.3f} times the second derivative "
        "of the second",
        estimate,
    )


def _highpass_cycle(x: Float1D, low_cut: float, rate_hz: float) -> Float1D:
    """Return a displacement, (sample,), behind a high-pass of `low_cut` rad/s, as if it repeated.

    The response of the high-pass to its state decays exponentially; the state is such that the
    output of a motion that repeats itself has no mean.
    """
    y = highpass(x, low_cut, rate_hz)
    decay = np.exp(-low_cut * np.arange(x.size) / rate_hz)
    return np.asarray(y - y.mean() / decay.mean() * decay)


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
    zeros = 2.0 * MAX_CELL_ZERO_RATIO * setup.contact_n / float(total_force[in_contact].mean())
    if abs(share) <= MAX_SHARE_DIFFERENCE + zeros:
        return None
    return (
        f"{first} and {second} share the force on the {side} unequally: "
        f"{100 * (0.5 + 0.5 * share):.0f} to {100 * (0.5 - 0.5 * share):.0f} %"
    )
