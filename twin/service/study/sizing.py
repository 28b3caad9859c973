"""How far an effect must go to leave a residual of a given size: plays it, measures, goes on.

The residual is that of the baseline with refitted parameters, on noise-free signals, each row over
what the sensors' noise would be in it:

    damper        -M a - F_R - F_L = K u + C u'          for as long as the table moves
    right, left    F_R = K_j u + C_j u' - P,  -F_L = -K_j u - C_j u' - P      in contact
                   nothing                             where a bumper pulls
    mass, table    a + w^2 x = 0                          what laser and accelerometer disagree on

M is the believed mass; K, C, K_j, C_j and P = K_j G/2 are refitted: the baseline is linear in them,
so one least squares does it. Displacement is the estimate of least variance from laser and
accelerometer. With d the rms of all rows and noise of rms 1 on top, the size is sqrt(1 + d^2).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from scipy.fft import irfft, rfft, rfftfreq

from table_io.block import Bool2D, Float1D, Float2D
from table_io.card import parse
from twin.model.card import ModelCard
from twin.service.study.bench import CHANNELS, MODEL_TOML, PROFILE, Signals
from twin.service.study.cells import Planted

BAND_HZ = 225.0  # of what is fitted: discovery looks at 500 Hz through a low pass
K = TypeVar("K", float, str)
TRIALS = 8
CLOSE = 0.03  # of d
GROWTH = 10.0  # of an amplitude from one trial to the next, at most
PHASES = ("flight", "contact_right", "contact_left", "contact_both")
NOTABLE = 0.5  # of the largest rms: where a residual stands out


@dataclass(frozen=True, eq=False)
class Residual:
    """What the baseline leaves, over the noise: `d` over all, and rms by frequency and phase."""

    d: float
    by_frequency: Mapping[float, float]
    by_phase: Mapping[str, float]

    @property
    def size(self) -> float:
        return math.hypot(1.0, self.d)

    @property
    def region(self) -> dict[str, object]:
        """Where it stands out: the band of frequencies, and the phases."""
        band = _notable(self.by_frequency)
        return {"frequency_hz": [min(band), max(band)], "phase": _notable(self.by_phase)}


def _notable(rms: Mapping[K, float]) -> list[K]:
    most = max(rms.values())
    return [key for key, value in rms.items() if value >= NOTABLE * most]


def departed(one: Planted, share: float) -> dict[str, float]:
    """Parameters of the truth file: amplitudes `share` times as far as typical, and the shapes.

    A ratio goes by its logarithm, so that either way is as far.
    """
    values = dict(one.shapes)
    for each in one.hidden.kind.parameters:
        if each.vanishing is None:
            if each.default is None:
                values.setdefault(each.name, each.typical)
        elif each.vanishing:
            values[each.name] = each.vanishing * math.exp(
                one.way * share * math.log(each.typical / each.vanishing)
            )
        else:
            values[each.name] = one.way * share * each.typical
    return values


def farthest(one: Planted) -> float:
    """The largest share that the bounds of the amplitudes allow."""
    found = math.inf
    for each in one.hidden.amplitudes:
        absent = each.vanishing or 0.0
        bound = each.high if one.way * (each.typical - absent) > 0 else each.low
        if absent:
            ratio = math.log(bound / absent) / math.log(each.typical / absent)
        else:
            ratio = bound / each.typical
        found = min(found, abs(ratio))
    return found


def sized(
    one: Planted, size: float, residual_at: Callable[[float], Residual]
) -> tuple[float, Residual]:
    """(share, what it leaves) for a size; the nearest that was found where it cannot be reached.

    Power law from trial to trial. A motion that jumps or is chaotic makes it rough, and where d
    falls again (a friction that sticks, a damper that blocks) it is sought before it falls.
    """
    target, limit = math.sqrt(size**2 - 1.0), farthest(one)
    share, slope, fallen = min(1.0, limit), 1.0, math.inf
    tried: list[tuple[float, Residual]] = []
    last = (0.0, 0.0)
    for _ in range(TRIALS):
        tried.append((share, residual_at(share)))
        d = max(tried[-1][1].d, 1e-9)
        if abs(d / target - 1.0) < CLOSE:
            break
        if share > last[0] and d < last[1]:
            fallen, share = share, math.sqrt(share * last[0])
            continue
        if share >= limit and d < target:
            break
        if last[0] and share != last[0]:
            slope = math.log(d / last[1]) / math.log(share / last[0])
        last = share, d
        step = (target / d) ** (1.0 / min(max(slope, 0.4), 2.5))
        step = min(max(step, 1.0 / GROWTH), GROWTH)
        share = min(share * step, limit, math.sqrt(share * fallen))
    return min(tried, key=lambda pair: abs(math.log(max(pair[1].d, 1e-9) / target)))


def read(one: Planted, share: float, signals: Signals) -> Signals:
    """The signals as a wrong sensor reads them; as they are where the effect is no sensor's."""
    if not one.hidden.kind.sensor:
        return signals
    name, values = one.hidden.channel, departed(one, share)
    true = signals.true[name]
    reading = values.get("gain", 1.0) * true + values.get("offset", 0.0)
    if "lag" in values:
        w = 2 * np.pi * rfftfreq(true.size, 1.0 / PROFILE.acquisition.rate_hz)
        reading = irfft(rfft(true) * np.exp(-1j * w * values["lag"]), true.size)
    wrong = reading - true
    right = signals.right + (wrong if name.startswith("force_r") else 0.0)
    left = signals.left - (wrong if name.startswith("force_l") else 0.0)
    readings = {**signals.true, name: reading}
    return Signals(readings, right, left, signals.step, signals.moving)


def residual(read: Signals, truly: Signals, noise: Mapping[str, float]) -> Residual:
    """What the baseline leaves of readings whose channels have this noise, rms in SI."""
    u, v, s_u, s_v, odd = _fused(read, noise)
    base = _nominal()
    keep = math.sqrt(2 * BAND_HZ / PROFILE.acquisition.rate_hz)
    cells = keep * math.sqrt(2.0) * noise["force_r1_n"]
    motion = math.hypot(base["stiffness_n_m"] * s_u, base["damping_n_s_m"] * s_v)
    inertia = PROFILE.specimen.mass_kg * noise["mass_acc_m_s2"] * keep
    bumper = math.hypot(
        cells, base["bumper_stiffness_n_m"] * s_u, base["bumper_damping_n_s_m"] * s_v
    )
    force = -PROFILE.specimen.mass_kg * read.true["mass_acc_m_s2"] - read.right - read.left
    damper = _left(np.stack([u, v]), force, truly.moving) / math.hypot(
        inertia, motion, math.sqrt(2.0) * cells
    )
    on_r, on_l = truly.right > 0.0, truly.left < 0.0
    way = np.where(on_r, 1.0, -1.0)
    columns = np.stack([way * u, way * v, -np.ones_like(u)])
    pushed = np.where(on_r, read.right, -read.left)
    touched = (on_r ^ on_l) & truly.moving  # never both, with a gap
    pulled = (np.minimum(truly.right, -truly.left) < 0.0) & truly.moving  # not in the baseline
    bumpers = _left(columns, pushed, touched) / bumper
    bumpers += np.where(pulled, np.minimum(read.right, -read.left) / bumper, 0.0)
    square = damper**2 + bumpers**2 + sum(one**2 for one in odd) * truly.moving
    entries = 3.0 * truly.moving + (touched | pulled)
    phase = np.where(on_r & on_l, 3, np.where(truly.right != 0.0, 1, 2 * (truly.left != 0.0)))
    steps = PROFILE.sweep.steps
    grid = {
        hz: np.isin(truly.step, [k for k, one in enumerate(steps) if one.frequency_hz == hz])
        for hz in PROFILE.sweep.frequencies_hz
    }

    def rms(where: Bool2D) -> float:
        return math.sqrt(float(square[where].sum()) / max(float(entries[where].sum()), 1.0))

    return Residual(
        rms(truly.moving),
        {hz: rms(where & truly.moving) for hz, where in grid.items()},
        {name: rms((phase == k) & truly.moving) for k, name in enumerate(PHASES)},
    )


def _nominal() -> dict[str, float]:
    found: dict[str, float] = parse(MODEL_TOML, ModelCard, "snm.toml").base.model_dump()
    return found


def _left(columns: Float2D, force: Float1D, where: Bool2D) -> Float1D:
    """(sample,) what least squares on the samples `where` leave of a force, zero elsewhere."""
    found = np.linalg.lstsq(columns[:, where].T, force[where], rcond=None)[0]
    left: Float1D = np.where(where, force - found @ columns, 0.0)
    return left


def _fused(
    read: Signals, noise: Mapping[str, float]
) -> tuple[Float1D, Float1D, float, float, list[Float1D]]:
    """(u, u', their noise, what lasers and accelerometers disagree on over its noise)."""
    count, rate = read.step.size, PROFILE.acquisition.rate_hz
    w = 2 * np.pi * rfftfreq(count, 1.0 / rate)
    inside = w <= 2 * np.pi * BAND_HZ
    u = np.zeros(w.size, dtype=np.complex128)
    variance, odd = np.zeros(w.size), []
    for sign, laser, meter in ((1.0, *CHANNELS[2:4]), (-1.0, *CHANNELS[:2])):
        s_x, s_a = noise[laser], noise[meter]
        both = s_a**2 + w**4 * s_x**2
        x, a = rfft(read.true[laser]), rfft(read.true[meter])
        u += sign * (s_a**2 * x - w**2 * s_x**2 * a) / both
        variance += (s_a * s_x) ** 2 / both
        odd.append(irfft((a + w**2 * x) / np.sqrt(both) * inside, count))
    keep = math.sqrt(float(np.mean(inside)))
    share = inside / w.size
    s_u = math.sqrt(float(np.sum(variance * share)))
    s_v = math.sqrt(float(np.sum(w**2 * variance * share)))
    return (
        irfft(u * inside, count), irfft(1j * w * u * inside, count), s_u, s_v,
        [one / keep for one in odd],
    )  # fmt: skip
