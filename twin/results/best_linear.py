"""Best linear approximation of table and specimen from a periodic multisine.

    G = E[Y R*] / E[U R*],   e_mp = Y_mp - G U_mp
    noise^2 = var over the periods p of e_mp,   distortion^2 = var over m of e_m - noise^2 / periods

R is the spectrum of the command, U and Y are those of input and output in period p of realisation
m. What comes on even lines, which are not excited, is distortion of even parity, on odd lines that
were left out that of odd parity; what U brings there itself is taken off. Source: Pintelon and
Schoukens, System Identification, 2nd ed. 2012, sections 3.4 and 4.3.1 (robust method).
"""

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Int1D
from table_io.config.excitation.synthetic import PeriodicMultisine
from table_io.config.profile import Profile
from twin.recording.reader import Recording
from twin.results.contracts import BestLinearResult
from twin.results.table_motion import extract_channel, find_table_motion

COMMAND = "command"
# Input and output: the table on its command, the specimen on the table.
PAIRS = (COMMAND, "table_acc_m_s2"), ("table_acc_m_s2", "mass_acc_m_s2")
CONFIDENCE_LEVEL = 0.95  # of the circle about the response
MAX_NOISE_SHARE = 0.5  # of the power of the output in a band, beyond which nothing is promised
THIRDS_PER_OCTAVE = 3.0
Spectra = npt.NDArray[np.complex128]  # (realisation, period, line)


def estimate_best_linear(recording: Recording, profile: Profile) -> list[BestLinearResult]:
    """Return the approximation of each pair of PAIRS that was measured without a loss.

    Empty of other excitations, and if the test did not play every period.
    """
    excitation = profile.excitation
    if not isinstance(excitation, PeriodicMultisine):
        return []
    motion = find_table_motion(recording, profile)
    if motion is None:
        return []
    rate_hz = motion.rate_hz
    starts = motion.start - motion.first + excitation.list_starts(rate_hz)
    count = round(excitation.duration_s * rate_hz)
    if int(starts[-1, -1]) + count > motion.end - motion.first:
        return []
    lines = excitation.list_lines(rate_hz)
    shown = np.arange(lines[0], lines[-1] + 1)
    blocks = recording.contiguous_blocks("meas")
    rows = {
        COMMAND: motion.target_acc_m_s2,
        "table_acc_m_s2": motion.achieved_acc_m_s2,
        "mass_acc_m_s2": extract_channel(blocks, "mass_acc_m_s2", motion.first, motion.end),
    }
    spectra: dict[str, Spectra] = {}
    for name, row in rows.items():
        parts = row[starts[..., None] + np.arange(count)]
        if np.isfinite(parts).all():
            spectra[name] = np.fft.rfft(parts)[..., shown] * (2.0 / count)
    return [
        approximate(
            pair,
            spectra[COMMAND],
            spectra[pair[0]],
            spectra[pair[1]],
            shown,
            lines,
            rate_hz / count,
        )
        for pair in PAIRS
        if set(pair) <= spectra.keys()
    ]


def approximate(
    pair: tuple[str, str],
    command: Spectra,
    inputs: Spectra,
    outputs: Spectra,
    shown: Int1D,
    lines: Int1D,
    step_hz: float,
) -> BestLinearResult:
    """Return the approximation of a pair; the spectra hold the lines `shown`.

    `lines` are the excited ones; neighbouring lines are `step_hz` apart.
    """
    from scipy.interpolate import CubicSpline  # slow to import, and few tests are multisines
    from scipy.special import fdtri

    realisations, periods, _ = outputs.shape
    excited = np.isin(shown, lines)
    turn = np.conj(command[..., excited])
    known = (outputs[..., excited] * turn).mean((0, 1)) / (inputs[..., excited] * turn).mean((0, 1))
    # Its inverse has no resonances, between whose lines a spline would miss.
    response = 1.0 / CubicSpline(lines, 1.0 / known)(shown)
    left = outputs - response * inputs
    by_realisation = left.mean(axis=1)
    noise = (np.abs(left - by_realisation[:, None]) ** 2).sum((0, 1))
    noise /= realisations * (periods - 1)
    scatter = (np.abs(by_realisation) ** 2).sum(0) / (realisations - excited)
    distortion = np.maximum(scatter - noise / periods, 0.0)
    power = (np.abs(outputs.mean(axis=1)) ** 2).mean(0)
    size = (np.abs(inputs.mean(axis=1)) ** 2).mean(0)
    ratio = fdtri(2, 2 * (realisations - 1), CONFIDENCE_LEVEL)
    radius = np.sqrt(ratio * scatter / realisations / size)
    even = (shown % 2 == 0) & ~excited
    odd = (shown % 2 == 1) & ~excited
    level = float(np.sqrt(power[excited].mean()))
    hz = np.asarray(step_hz * shown, np.float64)
    left_out = {
        name: float(np.sqrt(distortion[which].mean())) / level if which.any() else None
        for name, which in (("even", even), ("odd", odd))
    }
    return BestLinearResult(
        input=pair[0],
        output=pair[1],
        band_hz=_find_band(hz[excited], noise[excited], power[excited]),
        distortion_ratio=float(np.sqrt(distortion[excited].sum() / power[excited].sum())),
        noise_ratio=float(np.sqrt(noise[excited].sum() / power[excited].sum())),
        even_ratio=left_out["even"],
        odd_ratio=left_out["odd"],
        frequency_hz=hz[excited].tolist(),
        gain=np.abs(known).tolist(),
        phase_deg=np.degrees(np.angle(known)).tolist(),
        half_width=radius[excited].tolist(),
        level_m_s2=np.sqrt(power[excited]).tolist(),
        distortion_m_s2=np.sqrt(distortion[excited]).tolist(),
        noise_m_s2=np.sqrt(noise[excited]).tolist(),
    )


def _find_band(hz: Float1D, noise: Float1D, power: Float1D) -> tuple[float, float] | None:
    """Return the band in Hz round the loudest third octave in which little of a period is noise."""
    third = np.floor(THIRDS_PER_OCTAVE * np.log2(hz / hz[0])).astype(int)
    third = np.unique(third, return_inverse=True)[1]
    sums = np.bincount(third, power)
    repeats = np.bincount(third, noise) <= MAX_NOISE_SHARE * sums
    first = last = int(np.argmax(sums))
    if not repeats[first]:
        return None
    while first > 0 and repeats[first - 1]:
        first -= 1
    while last + 1 < repeats.size and repeats[last + 1]:
        last += 1
    inside = hz[(third >= first) & (third <= last)]
    return float(inside[0]), float(inside[-1])


def format_best_linear(result: BestLinearResult) -> str:
    """Format an approximation in one sentence: who, distortion with its parity, noise, band."""
    name = "table" if result.input == COMMAND else "specimen"
    parities = [
        f"{100 * ratio:.2g} % {parity}"
        for parity, ratio in (("odd", result.odd_ratio), ("even", result.even_ratio))
        if ratio is not None
    ]
    parity = f" ({', '.join(parities)})" if parities else ""
    band = "nothing can be promised of it"
    if result.band_hz is not None:
        band = f"what repeats is above the noise in {result.band_hz[0]:.3g} to "
        band += f"{result.band_hz[1]:.3g} Hz"
    return (
        f"{name}: {100 * result.distortion_ratio:.2g} % nonlinear distortion{parity}, "
        f"{100 * result.noise_ratio:.2g} % noise of its acceleration, {band}"
    )
