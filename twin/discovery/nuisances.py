"""Nuisance parameters: the small errors of instruments and set-up that every laboratory has.

A nuisance z is in units of its typical size (its prior is a standard normal distribution) and
enters the residual of a log linearly: r + sum of z x column. What it explains is no evidence for an
effect of the specimen. Kinds, by channel or side:

    gain, lag            of a channel: reading = (1 + gain) x value(t - lag)
    low_cut              of an accelerometer: corner of its high pass of the first order
    resonance            of an accelerometer on its bracket: the inverse square of its frequency
    offset               of a channel, after its tare; constant, and slow with time (offset1, ...)
    chebyshev2 to 7      of a laser, in position: terms of its linearity error, 0 at position 0
    share, share_slope   of the force of a side between its two cells: constant, and with position
    plate                mass in front of the cells of a side, which the table accelerates
    cross                part of the acceleration of the table in the accelerometer of the mass
    gap                  reading of the set-up: right gap against left gap
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Chebyshev
from numpy.polynomial.legendre import legvander

from table_io.block import Bool2D, Float2D, Label
from table_io.channels import CHANNEL_BY_NAME, LEFT_CELLS, RIGHT_CELLS
from twin.compare.spectra import Spectrum
from twin.discovery.least_squares import FitResult, MapFunction
from twin.discovery.parameters import (
    BUMPER_DAMPING,
    BUMPER_STIFFNESS,
    FreeParameter,
    GapKey,
    ParameterSet,
    is_correction,
    size_of_unit,
)
from twin.discovery.residuals import LogResiduals, Nuisance, NuisanceTerms
from twin.discovery.signals import SENSOR_PAIRS, LogSignals, pass_motion, weigh_sensors
from twin.discovery.starting_values import solve_columns

ACCELEROMETERS = ("mass_acc_m_s2", "table_acc_m_s2")
LASERS = ("rel_disp_m", "mass_disp_m", "table_disp_m")
SIDES = {"right": RIGHT_CELLS, "left": LEFT_CELLS}
LINEARITY_DEGREES = range(2, 8)
SLOW_TERMS = 2  # degree of a drift over the length of the record
# Typical sizes (one standard deviation).
TYPICAL_GAIN = 0.005  # calibration and temperature
TYPICAL_LAG_S = 5e-4  # multiplexed channels, different anti-alias filters
TYPICAL_LOW_CUT = 2.0 * math.pi * 0.25  # rad/s, of an IEPE accelerometer: 5 % at 0.8 Hz
RESTORED_FROM_HZ = 0.1  # what a low cut took away
TYPICAL_RESONANCE = (2.0 * math.pi * 400.0) ** -2.0  # s2/rad2, of a bracket of sheet metal
TYPICAL_OFFSET = 0.005  # of the rms of the channel: drift since the tare
TYPICAL_LASER_OFFSET = 0.001
TYPICAL_LINEARITY = 0.002  # of the largest excursion, each term of the error of a laser
# Of the largest excursion: speckle and roughness under the light spot of a laser, which the rest
# does not show, and at low frequency no accelerometer.
TYPICAL_SURFACE = 1e-4
TYPICAL_CORNER_HZ = 1.0  # below it 1/f noise exceeds white noise, which is seen at WHITE_CYCLES
WHITE_CYCLES = 0.05  # per sample
TYPICAL_SHARE, TYPICAL_SHARE_SLOPE = 0.05, 0.02  # of the force; at the largest excursion
TYPICAL_PLATE = 0.005  # of the specimen's mass
TYPICAL_CROSS = 0.01  # cross-axis sensitivity and pitch
TYPICAL_GAP_M = 1e-4  # of the readings of the set-up
MAX_SIZE = 4.0  # typical sizes: a larger error is a fault, or the specimen differs there
SLOPE_STEP = 0.1  # of a typical size, for the finite difference
MIN_COLUMN_NORM = 1.0  # a nuisance that changes the residual by less at its typical size is dropped


def list_nuisances(signals: LogSignals) -> tuple[Nuisance, ...]:
    """Return the nuisances that the channels of a log can have."""
    channels = signals.channels
    # No measurement contradicts the scale of all displacements together, nor their common lag; that
    # of all forces is the mass, or a force sensor of the damper.
    references = ("rel_disp_m", "mass_disp_m", "damper_force_n")
    # Alone, an accelerometer that lags looks like damping: another sensor must see the same motion.
    paired_sensors = {
        channel for pair in SENSOR_PAIRS.values() if {*pair} <= {*channels} for channel in pair
    }
    checkable = [
        channel
        for channel in channels
        if channel not in references
        and (channel not in ACCELEROMETERS or channel in paired_sensors)
    ]
    pairs = {side: cells for side, cells in SIDES.items() if {*cells} <= {*channels}}
    paired = {cell for cells in pairs.values() for cell in cells}
    # The gains of two cells are that of their sum, and their shares.
    scaled = [channel for channel in checkable if channel not in paired] + [*pairs]
    nuisances = [Nuisance("gain", place, TYPICAL_GAIN) for place in scaled]
    nuisances += [Nuisance("lag", channel, TYPICAL_LAG_S, "s") for channel in checkable]
    nuisances += [
        Nuisance(kind, channel, size, unit)
        for kind, size, unit in (
            ("low_cut", TYPICAL_LOW_CUT, "rad/s"),
            ("resonance", TYPICAL_RESONANCE, "s2"),
        )
        for channel in checkable
        if channel in ACCELEROMETERS
    ]
    for channel in channels:
        nuisances += _list_offsets(signals, channel)
    for channel in channels:
        if channel in LASERS:
            nuisances += [
                Nuisance(f"chebyshev{degree}", channel, TYPICAL_LINEARITY)
                for degree in LINEARITY_DEGREES
            ]
    for side in pairs:
        nuisances += [
            Nuisance("share", side, TYPICAL_SHARE),
            Nuisance("share_slope", side, TYPICAL_SHARE_SLOPE),
        ]
        if "table_acc_m_s2" in channels:
            nuisances.append(Nuisance("plate", side, TYPICAL_PLATE * signals.mass_kg, "kg"))
    if {"mass_acc_m_s2", "table_acc_m_s2"} <= {*channels}:
        nuisances.append(Nuisance("cross", "mass_acc_m_s2", TYPICAL_CROSS))
    if any(math.isfinite(gap) for gap in signals.gaps_m):
        nuisances.append(Nuisance("gap", "", TYPICAL_GAP_M, "m"))
    return tuple(nuisances)


def _list_offsets(signals: LogSignals, channel: str) -> list[Nuisance]:
    """Return the slow terms of the zero of a channel, with their size where they show it."""
    share = TYPICAL_LASER_OFFSET if channel in LASERS else TYPICAL_OFFSET
    usual = share * signals.channel_rms(channel)
    readings = signals.grid.to_time_domain(signals.spectra[channel])
    at_zero = _find_zero(signals, channel)
    terms = _list_slow_terms(signals)[: 1 if channel in LASERS else None, at_zero]
    shown = solve_columns(terms, readings[at_zero])
    sizes = np.full(SLOW_TERMS + 1, usual)
    if shown is not None:
        sizes[: shown.size] = np.maximum(usual, np.abs(shown))
    unit = CHANNEL_BY_NAME[channel].unit
    return [
        Nuisance("offset" + (str(term) if term else ""), channel, float(size), unit, usual)
        for term, size in enumerate(sizes)
    ]


def _find_zero(signals: LogSignals, channel: str) -> Bool2D:
    """Return where the true value of a channel is zero, or is on average, (sample,).

    An acceleration is on average; so is, beside bumpers, a motion without a rest, which may have
    any zero. A load cell is while the mass is on the other side.
    """
    moving = signals.label != Label.REST
    if channel in ACCELEROMETERS:
        return moving
    if channel in LASERS:
        is_open = channel not in signals.rest_values and "damper_force_n" not in signals.channels
        return moving & is_open
    u = signals.grid.to_time_domain(signals.relative_spectrum)
    for cells, sign, gap in zip(SIDES.values(), (1.0, -1.0), signals.gaps_m, strict=True):
        if channel in cells and gap > 0:
            return moving & (sign * u < 0)
    return np.zeros_like(moving)


def _list_slow_terms(signals: LogSignals) -> Float2D:
    """Return Legendre polynomials of time, (term, sample); the first is constant."""
    time = np.linspace(-1.0, 1.0, signals.time_s.size)
    return np.asarray(legvander(time, SLOW_TERMS).T)


def correct_signals(signals: LogSignals, nuisance: Nuisance, z: float) -> LogSignals:
    """Return the signals corrected for a nuisance of z typical sizes."""
    amount, place = z * nuisance.size, nuisance.place
    match nuisance.kind:
        case "gap":
            right, left = signals.gaps_m
            return replace(signals, gaps_m=(right + amount, left - amount))
        case _ if place in SIDES:
            return _with_spectra(signals, _correct_cells(signals, nuisance.kind, place, amount))
    spectrum = signals.spectra[place]
    match nuisance.kind:
        case "gain":
            corrected = spectrum / (1.0 + amount)
        case "lag":
            corrected = spectrum * np.exp(1j * signals.omega * amount)
        case "low_cut":
            # not where the mass hardly accelerates: slow noise would grow without limit there
            omega = np.maximum(signals.omega, signals.omega[1])
            is_fast = 1.0 / (1.0 + (2.0 * np.pi * RESTORED_FROM_HZ / omega) ** 8)
            corrected = spectrum * (1.0 - 1j * is_fast * amount / omega)
        case "resonance":
            corrected = spectrum * (1.0 - amount * signals.omega**2)
        case "cross":
            corrected = spectrum - amount * signals.spectra["table_acc_m_s2"]
        case kind if kind.startswith("chebyshev"):
            x = signals.grid.to_time_domain(spectrum)
            largest = float(np.abs(x).max()) or 1.0
            shape = Chebyshev.basis(int(kind.removeprefix("chebyshev")))
            error = amount * largest * (shape(x / largest) - shape(0.0))
            corrected = spectrum - signals.grid.from_time_domain(error)
        case _:  # offset, offset1, ...
            term = int(nuisance.kind.removeprefix("offset") or 0)
            drift = amount * _list_slow_terms(signals)[term]
            corrected = spectrum - signals.grid.from_time_domain(drift)
    return _with_spectra(signals, {place: corrected})


def _correct_cells(signals: LogSignals, kind: str, side: str, amount: float) -> dict[str, Spectrum]:
    """Return the spectra of the two cells of a side, corrected."""
    cells = SIDES[side]
    first, second = (signals.spectra[cell] for cell in cells)
    if kind == "gain":
        return {cell: signals.spectra[cell] / (1.0 + amount) for cell in cells}
    if kind == "plate":
        inertia = 0.5 * amount * signals.spectra["table_acc_m_s2"]
        return dict(zip(cells, (first + inertia, second + inertia), strict=True))
    moved = amount * (first + second)
    if kind == "share_slope":
        u = signals.grid.to_time_domain(signals.relative_spectrum)
        moved = signals.grid.from_time_domain(
            u / float(np.abs(u).max() or 1.0) * signals.grid.to_time_domain(moved)
        )
    return dict(zip(cells, (first - moved, second + moved), strict=True))


def _with_spectra(signals: LogSignals, spectra: Mapping[str, Spectrum]) -> LogSignals:
    return replace(signals, spectra={**signals.spectra, **spectra})


def linearize_nuisances(
    residuals: LogResiduals,
    parameters: ParameterSet,
    calibrate: bool = False,
    mapper: MapFunction = map,
) -> LogResiduals:
    """Return the residuals of a log with its nuisances as linear terms.

    The signals are corrected for the nuisances in `parameters`, about which the terms are linear.
    With `calibrate` the noise of the corrected sensors is taken from their disagreement.
    """
    terms = residuals.nuisances
    raw = residuals.signals if terms is None else terms.raw
    # a copy, so that the series of its fusion are not kept with the terms
    signals = _add_typical_noise(raw)
    nuisances = list_nuisances(raw)
    centre = dict.fromkeys(nuisances, 0.0)
    if terms is not None:
        centre |= dict(zip(terms.nuisances, terms.centre + terms.values(parameters), strict=True))
    for nuisance, z in centre.items():
        signals = correct_signals(signals, nuisance, z) if z else signals
    if calibrate:
        signals = signals.calibrate_noise()
    bare = replace(residuals.with_signals(signals), nuisances=None)
    smooth, measured = _smooth_signals(bare, parameters), bare.motion()
    start = smooth.fuse_motion()
    before = bare.evaluate_rows(parameters, measured)

    def slope(nuisance: Nuisance) -> npt.NDArray[np.float32]:
        # most channels stay as they are; the fusion of the smooth signals has their series
        end = smooth.fuse_corrected(correct_signals(smooth, nuisance, SLOPE_STEP))
        # about the measured motion: only there is it known what touches what
        rows = bare.evaluate_rows(parameters, measured.move(start, end))
        return ((rows - before) / SLOPE_STEP).astype(np.float32)

    kept = [
        (nuisance, column)
        for nuisance, column in zip(nuisances, mapper(slope, nuisances), strict=True)
        if column @ column > MIN_COLUMN_NORM**2 or centre[nuisance]
    ]
    table = np.array([column for _, column in kept], dtype=np.float32).reshape(-1, before.size)
    terms = NuisanceTerms(
        raw, residuals.log_number, tuple(nuisance for nuisance, _ in kept), table,
        np.array([centre[nuisance] for nuisance, _ in kept]),
    )  # fmt: skip
    return replace(bare, nuisances=terms)


def list_sizes(residuals: LogResiduals, parameters: ParameterSet) -> list[tuple[Nuisance, float]]:
    """Return (nuisance, its value in typical sizes) of a log as fitted."""
    terms = residuals.nuisances
    if terms is None:
        return []
    sizes = terms.centre + terms.values(parameters)
    return [*zip(terms.nuisances, sizes.tolist(), strict=True)]


def fix_nuisances(residuals: LogResiduals, parameters: ParameterSet) -> LogResiduals:
    """Return the residuals of signals corrected for the fitted nuisances, without their terms."""
    terms, signals = residuals.nuisances, residuals.signals
    if terms is None:
        return residuals
    for nuisance, z in zip(terms.nuisances, terms.values(parameters), strict=True):
        signals = correct_signals(signals, nuisance, float(z))
    return replace(residuals.with_signals(signals), nuisances=None)


def resolve_samples(residuals: LogResiduals, parameters: ParameterSet) -> LogResiduals:
    """Return the residuals with the samples as entries, less the fitted nuisances."""
    fixed = fix_nuisances(residuals, parameters)
    return replace(fixed.with_signals(fixed.signals.in_whole_band), is_sampled=True)


def _add_typical_noise(signals: LogSignals) -> LogSignals:
    """Return the signals with the noise that a short rest does not show: 1/f, and of surfaces."""
    u = signals.grid.to_time_domain(signals.relative_spectrum)
    hz = signals.omega / (2.0 * np.pi)
    slow = np.sqrt(1.0 + TYPICAL_CORNER_HZ / np.maximum(hz, 0.5 * hz[1]))
    middle = WHITE_CYCLES * signals.grid.rate_hz
    noise = {
        channel: np.maximum(density, np.interp(middle, hz, density) * slow)
        for channel, density in signals.noise.items()
    }
    return replace(signals, noise=noise, surface_noise_m=TYPICAL_SURFACE * float(np.abs(u).max()))


def _smooth_signals(residuals: LogResiduals, parameters: ParameterSet) -> LogSignals:
    """Return the signals without their noise, for slopes.

    Readings of their own would be regressors with errors: where the bumpers always touch, a force
    differs from K_j u + C_j u' by its noise alone, and its gain would be the one that explains this
    noise. So forces and accelerations are those of the model and of the displacements, and these
    are there where they exceed their noise: a resonance of a mounting grows with the square of the
    frequency, as does what a laser adds to an acceleration.
    """
    signals, m = residuals.signals, residuals.motion()
    spectra, grid = dict(signals.spectra), signals.grid
    gain = pass_motion(signals, m.u, signals.motion_density)
    u, v = grid.apply_gain(m.u, gain), grid.apply_gain(m.v, gain)
    for laser in spectra.keys() & {*LASERS}:
        density = signals.noise[laser] / math.sqrt(grid.decimation)
        spectra[laser] = spectra[laser] * pass_motion(
            signals, grid.to_time_domain(spectra[laser]), density
        )
    forces = residuals.expect_forces(parameters, replace(m, u=u, v=v))
    damper, right, left = (grid.from_time_domain(np.nan_to_num(force)) for force in forces)
    if "damper_force_n" in spectra:
        spectra["damper_force_n"] = damper
    for cells, force in ((RIGHT_CELLS, right), (LEFT_CELLS, left)):
        measured = [spectra[cell] for cell in cells if cell in spectra]
        if not measured:
            continue
        total = np.sum(measured, axis=0)
        power = max(float(np.vdot(total, total).real), 1e-300)
        for cell in cells:
            if cell in spectra:
                share = float(np.vdot(total, spectra[cell]).real) / power
                spectra[cell] = share * force
    if "mass_acc_m_s2" in spectra and "damper_force_n" not in spectra:
        total = damper + right - left if m.has_load_cells else damper
        spectra["mass_acc_m_s2"] = -total / m.mass_kg
    if "table_acc_m_s2" in spectra:
        spectra["table_acc_m_s2"] = _smooth_table_acc(signals)
    return replace(signals, spectra=spectra)


def _smooth_table_acc(signals: LogSignals) -> Spectrum:
    """Return the acceleration of the table in m/s2 from its sensors, less their noise."""
    grid, square = signals.grid, -(signals.omega**2)
    acc, density = signals.spectra["table_acc_m_s2"], signals.noise["table_acc_m_s2"]
    if "table_disp_m" in signals.spectra:
        laser_share, acc_share, error_m = weigh_sensors(
            signals.omega, signals.noise["table_disp_m"], density
        )
        acc = square * (laser_share * signals.spectra["table_disp_m"] + acc_share * acc)
        density = np.abs(square) * error_m
    density = density / math.sqrt(grid.decimation)
    return acc * pass_motion(signals, grid.to_time_domain(acc), density)


def sensor_mask(residuals: LogResiduals) -> Bool2D:
    """Return the entries that compare sensors with each other, or with their tare, (entry,)."""
    rows = [
        number
        for number, name in enumerate((*residuals.rows, "rest"))
        if name in SENSOR_PAIRS or name == "rest"
    ]
    mask: Bool2D = np.isin(residuals.entry_row, rows)
    return mask


def list_nuisance_parameters(log_residuals: Sequence[LogResiduals]) -> tuple[FreeParameter, ...]:
    """Return the free parameters of the nuisances of all logs."""
    return tuple(
        FreeParameter(key, -math.inf, math.inf, 1.0, "")
        for residuals in log_residuals
        if residuals.nuisances is not None
        for key in residuals.nuisances.keys
    )


def widen_intervals(fit: FitResult, log_residuals: Sequence[LogResiduals]) -> FitResult:
    """Return a fit with nuisances whose standard deviations hold what these leave open.

    No sensor contradicts the scale of all displacements: a parameter is as uncertain as it depends
    on it, which its unit tells, as forces are masses times accelerations; nor that of a force that
    was measured by itself, in a component test. A bumper meets a part of
    the range of the lasers, with its own slope within their linearity.
    """
    std_errors = dict(fit.std_errors)
    is_component = any("damper_force_n" in r.signals.channels for r in log_residuals)
    for free in fit.free:
        key = free.key
        if is_correction(key):
            continue
        value = fit.values[key]
        size = abs(value)
        if isinstance(key, GapKey):
            size += max(filter(math.isfinite, log_residuals[key.log].signals.gaps_m), default=0.0)
        is_bumper = key in (BUMPER_STIFFNESS, BUMPER_DAMPING)
        std_errors[key] = math.hypot(
            std_errors[key],
            *(TYPICAL_GAIN * power * size for power in _list_exponents(free.unit, is_component)),
            TYPICAL_LINEARITY * size if is_bumper else 0.0,
        )
    return replace(fit, std_errors=std_errors)


def _list_exponents(unit: str, is_component: bool) -> tuple[float, ...]:
    """Return the powers with which a quantity in this unit grows with each unknown scale.

    That of all lengths, forces being masses times accelerations; of a component, whose force is
    measured by itself, those of lengths and of forces.
    """
    scales = ((1.0, math.e), (math.e, 1.0)) if is_component else ((math.e, math.e),)
    ratios = (size_of_unit(unit, force=f, length=x, time=1.0) for f, x in scales)
    return tuple(math.log(ratio) if ratio else 0.0 for ratio in ratios)
