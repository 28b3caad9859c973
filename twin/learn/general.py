"""General terms: forces without a name, that stand for all that the library does not hold.

A term that explains the measurement much better than every named effect says "not in the library",
and its shape is evidence of what is missing. They never enter a model. Each is `force` x a shape of
size 1 at the largest u, v or depth d that was measured (U, V, D); `width` w is in parts of those.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from table_io.block import Float1D, Float2D
from twin.learn.guess import SLIP, Free
from twin.learn.motion import Motion

GENERAL = "general"
Column = Callable[[Float1D, Float1D, float], Float1D]
WIDTHS = (0.03, 0.06, 0.12, 0.25, 0.5)
RESONANCES = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0, 32.0)  # Hz
RESONATOR_DAMPING = 0.03

# Of u / U and v / V in the damper, and of d / D and d' / V in a bumper.
DAMPER: dict[str, Column] = {
    "u|u|": lambda u, v, w: u * np.abs(u),
    "u^2": lambda u, v, w: u**2,
    "u^5": lambda u, v, w: u**5,
    "u^9": lambda u, v, w: u**9,
    "v^2": lambda u, v, w: v**2,
    "v^3": lambda u, v, w: v**3,
    "v^5": lambda u, v, w: v**5,
    "u v": lambda u, v, w: u * v,
    "|u| v": lambda u, v, w: np.abs(u) * v,
    "u^2 v": lambda u, v, w: u**2 * v,
    "u v^2": lambda u, v, w: u * v**2,
    "|u| sign(v)": lambda u, v, w: np.abs(u) * np.sign(v),
}
DAMPER_WIDE: dict[str, Column] = {
    "tanh(u/w)": lambda u, v, w: np.tanh(u / w),
    "sign(v) exp(-(v/w)^2)": lambda u, v, w: np.sign(v) * np.exp(-((v / w) ** 2)),
}
BUMPERS: dict[str, Column] = {
    "d^3": lambda d, v, w: d**3,
    "d^5": lambda d, v, w: d**5,
    "sqrt(d)": lambda d, v, w: np.sqrt(d),
    "d^2 d'": lambda d, v, w: d**2 * v,
    "d'|d'|": lambda d, v, w: v * np.abs(v),
    "d'^3": lambda d, v, w: v**3,
    "sign(d')": lambda d, v, w: np.sign(v),
    "d sign(d')": lambda d, v, w: d * np.sign(v),
}


@dataclass(frozen=True, slots=True)
class Scale:
    """The largest displacement in m, velocity in m/s, depth in m of all logs."""

    u: float
    v: float
    d: float


def terms(touched: bool) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """(name, its ladder of widths; empty: it has none) of each term."""
    plain: list[tuple[str, tuple[float, ...]]] = [(f"damper {name}", ()) for name in DAMPER]
    plain += [(f"damper {name}", WIDTHS) for name in DAMPER_WIDE]
    plain += [("damper resonator", RESONANCES)]
    return (*plain, *((f"bumper {name}", ()) for name in BUMPERS if touched))


def free_of(name: str, ladder: tuple[float, ...]) -> tuple[Free, ...]:
    """The amplitude in N, and the width where the term has one."""
    force = Free(*_named(name, "force"), -np.inf, np.inf, 1.0, "N", vanishing=0.0)
    if not ladder:
        return (force,)
    width = Free(
        *_named(name, "width"), 0.3 * ladder[0], 3.0 * ladder[-1], ladder[0], "", logarithmic=True
    )
    return (force, width)


def _named(name: str, parameter: str) -> tuple[str, tuple[str, ...]]:
    key = f"{GENERAL}.{name}.{parameter}"
    return key, (key,)


def forces(
    values: Mapping[str, float],
    m: Motion,
    gaps_m: tuple[float, float],
    touched: npt.NDArray[np.int8],
    scale: Scale,
) -> Float2D:
    """(3, sample) what the terms of a guess add to D, F_R >= 0 and -F_L >= 0, in N."""
    out = np.zeros((3, m.u.size))
    for key, force in values.items():
        if not (key.startswith(GENERAL) and key.endswith(".force")):
            continue
        name = key[len(GENERAL) + 1 : -len(".force")]
        width = values.get(f"{GENERAL}.{name}.width", 1.0)
        place, shape = name.split(" ", 1)
        # dry friction passes through a standstill in one way, whatever its law above it
        way = np.tanh(m.v / values[SLIP]) * np.where(m.v > 0, 1.0, -1.0) if SLIP in values else 1.0
        if shape == "resonator":
            out[0] += force * _resonator(m, width)
        elif place == "damper":
            column = DAMPER.get(shape) or DAMPER_WIDE[shape]
            dry = way if "sign(v)" in shape else 1.0
            out[0] += force * dry * column(m.u / scale.u, m.v / scale.v, width)
        else:
            for side, (right, gap) in enumerate(zip((1.0, -1.0), gaps_m, strict=True)):
                d = np.clip((right * m.u - gap) / scale.d, 0.0, None)
                push = BUMPERS[shape](d, right * m.v / scale.v, width)
                out[1 + side] += force * np.where(touched[side] > 0, push, 0.0)
    return out


def _resonator(m: Motion, hz: float) -> Float1D:
    """Force of a sprung mass on the specimen that feels its acceleration, over its largest value.

    q'' + 2 z w q' + w^2 q = -a; the force on the mass is that of spring and dashpot, in steps of a
    sample (Tustin, warped to w).
    """
    w = 2 * np.pi * min(hz, 0.4 * m.rate_hz)
    k = w / np.tan(0.5 * w / m.rate_hz)
    z = RESONATOR_DAMPING
    b = np.array([2 * z * w * k + w * w, 2 * w * w, w * w - 2 * z * w * k])
    a = np.array(
        [k * k + 2 * z * w * k + w * w, 2 * (w * w - k * k), k * k - 2 * z * w * k + w * w]
    )
    force = lfilter(b / a[0], a / a[0], np.nan_to_num(m.acc))
    return force / max(float(np.abs(force).max()), 1e-300)
