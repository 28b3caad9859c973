"""The measured motion as one smooth whole: displacement, velocity, forces, and their noise.

Displacement comes from lasers, acceleration from accelerometers; each knows what the other does
not. Per frequency, with white noise s_u and s_a and w the angular frequency, the estimate of least
variance is
    U = (s_a^2 U_laser - w^2 s_u^2 A_acc) / (s_a^2 + w^4 s_u^2),   V = i w U
so noise is neither differentiated nor integrated without bound, and nothing is delayed.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft, rfftfreq

from table_io.block import Block, Bool2D, Float1D, Int1D, Label, join
from table_io.card import BadInput
from table_io.channels import contact_forces, rel_disp

RATE_HZ = 500.0  # contacts last 0.1 s: fifty samples; noise beyond is thrown away
ROLL_OFF = 0.8  # of the new Nyquist frequency: from here on the low pass falls
PAD_S = 2.0
LEAST_NOISE = 1e-4  # of a channel's rms: no sensor is better
EDGE_S = 0.02  # next to a lost sample nothing is believed


@dataclass(frozen=True, slots=True)
class Noise:
    """rms of the noise of one sample, SI, at the motion's rate."""

    u: float
    acc: float  # total acceleration of the mass
    right: float
    left: float
    force: float  # of the damper force, directly measured or from the balance


@dataclass(frozen=True, eq=False)
class Motion:
    """Samples of a test at `rate_hz`, SI, right positive, (sample,) each.

    `right` = F_R >= 0 and `left` = -F_L >= 0; NaN where nobody measured. `damper` is the damper's
    force where it was measured itself (component tests), else None. `good` is False where a
    channel was lost.
    """

    name: str
    rate_hz: float
    mass_kg: float
    gaps_m: tuple[float, float]
    time_s: Float1D
    u: Float1D
    v: Float1D
    acc: Float1D
    table_acc: Float1D
    table_disp: Float1D
    right: Float1D
    left: Float1D
    step: Int1D
    label: Int1D
    cycle: Int1D
    good: Bool2D
    noise: Noise
    damper: Float1D | None = None
    missing: tuple[str, ...] = field(default=())

    @property
    def cells(self) -> bool:
        """True where bumper forces were measured."""
        return bool(np.isfinite(self.right).any())

    @property
    def moving(self) -> Bool2D:
        """Samples at which the drive moved and every channel can be believed."""
        moved: Bool2D = self.good & (self.label != Label.REST)
        return moved


def motion_of(
    blocks: tuple[Block, ...], name: str, mass_kg: float, gaps_m: tuple[float, float]
) -> Motion:
    """The motion in measured blocks; BadInput where displacement or acceleration is missing."""
    whole = _filled(blocks, name)
    rate = whole.rate_hz
    u, acc = rel_disp(whole), _column(whole, "mass_acc_m_s2")
    table_acc, damper = _column(whole, "table_acc_m_s2"), _column(whole, "damper_force_n")
    if not np.isfinite(u).any():
        raise BadInput(f"{name}: no displacement of the mass against the table; nothing to learn")
    right, left = contact_forces(whole)
    channels = {
        "table_acc_m_s2": table_acc, "mass_acc_m_s2": acc,
        "table_disp_m": _column(whole, "table_disp_m"), "right": right, "left": -left,
        "damper_force_n": damper,
    }  # fmt: skip
    missing = tuple(key for key, values in channels.items() if not np.isfinite(values).any())
    rest = _at_rest(whole)
    relative = acc - table_acc
    good = np.isfinite(u)
    for key, values in channels.items():
        if key not in missing:
            good &= np.isfinite(values)
    every = max(int(rate // RATE_HZ), 1)
    spectra = _Spectra(u.size, rate, every)
    noise_u, noise_a = _rms(u, rest), _rms(relative, rest)
    fused = "mass_acc_m_s2" not in missing and "table_acc_m_s2" not in missing
    displacement, velocity = spectra.fused(u, relative if fused else None, noise_u, noise_a)
    low = {key: spectra.low(values) for key, values in channels.items() if key not in missing}
    size = displacement.size
    nothing = np.full(size, np.nan)
    keep = np.sqrt(spectra.share)  # of white noise that the low pass leaves
    noise = Noise(
        noise_u * keep,
        _rms(acc, rest) * keep,
        _rms(right, rest) * keep,
        _rms(left, rest) * keep,
        _rms(damper, rest) * keep,
    )
    return Motion(
        name,
        rate / every,
        mass_kg,
        gaps_m,
        (whole.index + every * np.arange(size)) / rate,
        displacement,
        velocity,
        low.get("mass_acc_m_s2", nothing),
        low.get("table_acc_m_s2", nothing),
        low.get("table_disp_m", nothing),
        low.get("right", nothing),
        low.get("left", nothing),
        whole.step[::every],
        whole.label[::every],
        whole.cycle[::every],
        _believed(good, round(EDGE_S * rate))[::every],
        noise,
        low.get("damper_force_n"),
        missing,
    )


class _Spectra:
    """Low pass and fusion by one pair of transforms a channel."""

    def __init__(self, size: int, rate_hz: float, every: int) -> None:
        self.size, self.every = size, every
        pad = round(PAD_S * rate_hz)
        self._full = every * next_fast_len(-(-(size + pad) // every), real=True)
        f = rfftfreq(self._full, 1.0 / rate_hz)
        nyquist = 0.5 * rate_hz / every
        x = np.clip((f / nyquist - ROLL_OFF) / (1.0 - ROLL_OFF), 0.0, 1.0)
        low = 0.5 * (1.0 + np.cos(np.pi * x)) if every > 1 else np.ones_like(f)
        self._kept = self._full // every // 2 + 1
        self._low = low[: self._kept]
        self._w = 2 * np.pi * f[: self._kept]
        self.share = float(np.mean(low**2))

    def _spectrum(self, values: Float1D) -> Float1D:
        return rfft(_whole(values), self._full)[: self._kept]

    def _back(self, spectrum: Float1D) -> Float1D:
        count = -(-self.size // self.every)
        back: Float1D = irfft(spectrum, self._full // self.every)[:count] / self.every
        return back

    def low(self, values: Float1D) -> Float1D:
        """The channel at the new rate."""
        return self._back(self._spectrum(values) * self._low)

    def fused(
        self, u: Float1D, relative_acc: Float1D | None, noise_u: float, noise_a: float
    ) -> tuple[Float1D, Float1D]:
        """(displacement in m, velocity in m/s) at the new rate."""
        spectrum = self._spectrum(u)
        if relative_acc is not None:
            a2, u2 = noise_a**2, noise_u**2
            other = self._spectrum(relative_acc)
            spectrum = (a2 * spectrum - self._w**2 * u2 * other) / (a2 + self._w**4 * u2)
        spectrum = spectrum * self._low
        return self._back(spectrum), self._back(1j * self._w * spectrum)


def _filled(blocks: tuple[Block, ...], name: str) -> Block:
    """One block from pieces; samples that are missing between them are NaN."""
    if not blocks:
        raise BadInput(f"{name}: holds no measured samples")
    parts: list[Block] = []
    for block in blocks:
        if parts and parts[-1].end < block.index:
            parts.append(_nothing(parts[-1], block.index))
        parts.append(block)
    return join(parts)


def _nothing(before: Block, until: int) -> Block:
    count = until - before.end
    outside = np.full(count, -1, dtype=np.int64)
    values = np.full((len(before.channels), count), np.nan)
    label = np.zeros(count, dtype=np.int64)
    return Block(
        before.stream, before.end, before.rate_hz, before.channels, values, outside, label, outside
    )


def _column(block: Block, name: str) -> Float1D:
    return block.channel(name) if name in block.channels else np.full(len(block), np.nan)


def _at_rest(block: Block) -> Bool2D:
    """Samples of the rest before anything moved: there all that is measured is noise."""
    moved = np.flatnonzero(block.label != Label.REST)
    rest = np.zeros(len(block), dtype=bool)
    rest[: moved[0] if moved.size else 0] = True
    return rest


def _rms(values: Float1D, rest: Bool2D) -> float:
    """Noise of a channel: its scatter at rest, else what its second differences leave."""
    known = values[rest & np.isfinite(values)]
    every = values[np.isfinite(values)]
    if not every.size:
        return float("nan")
    if known.size >= 100:
        found = float(known.std())
    else:
        # white noise has second differences of variance 6; a smooth motion has hardly any
        found = float(np.median(np.abs(np.diff(every, 2))) / 0.6745 / np.sqrt(6.0))
    return max(found, LEAST_NOISE * float(every.std()), 1e-300)


def _whole(values: Float1D) -> Float1D:
    """The channel with lost samples bridged by straight lines; what they say is not believed."""
    known = np.isfinite(values)
    if known.all():
        return values
    places = np.arange(values.size)
    return np.interp(places, places[known], values[known])


def _believed(good: Bool2D, margin: int) -> Bool2D:
    """Good samples that have no lost one within `margin`."""
    if good.all():
        return good
    spread = np.convolve(~good, np.ones(2 * margin + 1), "same") > 0
    believed: Bool2D = ~spread
    return believed
