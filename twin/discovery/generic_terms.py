"""Generic basis terms: force shapes that represent any effect outside the library.

A term that explains the measurement much better than every library effect shows that the missing
effect is not in the library, and its shape is evidence of what it is. Generic terms never enter a
model. Each is `force` times a shape of size 1 at the largest measured u, v or depth d (U, V, D);
`width` w is relative to those.
"""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from table_io.block import Float1D, Float2D
from twin.discovery.motion import MeasuredMotion, RecordScale
from twin.discovery.parameters import SLIP_SPEED, FreeParameter, ParameterKey, TermKey

BasisFunction = Callable[[Float1D, Float1D, float], Float1D]
TERM_WIDTHS = (0.03, 0.06, 0.12, 0.25, 0.5)
RESONANCES_HZ = (0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0, 22.0, 32.0)  # Hz
RESONATOR_DAMPING = 0.03

# Functions of u / U and v / V in the damper, and of d / D and d' / V in a bumper.
DAMPER_TERMS: dict[str, BasisFunction] = {
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
DAMPER_WIDTH_TERMS: dict[str, BasisFunction] = {
    "tanh(u/w)": lambda u, v, w: np.tanh(u / w),
    "sign(v) exp(-(v/w)^2)": lambda u, v, w: np.sign(v) * np.exp(-((v / w) ** 2)),
}
BUMPER_TERMS: dict[str, BasisFunction] = {
    "d^3": lambda d, v, w: d**3,
    "d^5": lambda d, v, w: d**5,
    "sqrt(d)": lambda d, v, w: np.sqrt(d),
    "d^2 d'": lambda d, v, w: d**2 * v,
    "d'|d'|": lambda d, v, w: v * np.abs(v),
    "d'^3": lambda d, v, w: v**3,
    "sign(d')": lambda d, v, w: np.sign(v),
    "d sign(d')": lambda d, v, w: d * np.sign(v),
}


def list_terms(has_contact: bool) -> tuple[tuple[str, tuple[float, ...]], ...]:
    """Return (name, trial widths) of each term; no widths for a term without a width."""
    damper_terms: list[tuple[str, tuple[float, ...]]] = [
        (f"damper {name}", ()) for name in DAMPER_TERMS
    ]
    damper_terms += [(f"damper {name}", TERM_WIDTHS) for name in DAMPER_WIDTH_TERMS]
    damper_terms += [("damper resonator", RESONANCES_HZ)]
    return (*damper_terms, *((f"bumper {name}", ()) for name in BUMPER_TERMS if has_contact))


def list_term_parameters(
    name: str, ladder: tuple[float, ...], scale: RecordScale
) -> tuple[FreeParameter, ...]:
    """Return the free parameters of a term: amplitude in N, and width if it has one."""
    force = FreeParameter(TermKey(name, "force"), -np.inf, np.inf, scale.force, "N", vanishing=0.0)
    if not ladder:
        return (force,)
    width = FreeParameter(
        TermKey(name, "width"), 0.3 * ladder[0], 3.0 * ladder[-1], ladder[0], "", logarithmic=True
    )
    return (force, width)


def compute_generic_forces(
    values: Mapping[ParameterKey, float],
    m: MeasuredMotion,
    gaps_m: tuple[float, float],
    touched: npt.NDArray[np.int8],
    scale: RecordScale,
    resonator_force: Callable[[float], Float1D],
) -> Float2D:
    """Return the forces that the generic terms add to D, F_R >= 0, -F_L >= 0, (3, sample) in N.

    `resonator_force` returns that of a resonator of a frequency in Hz: it depends on the history of
    the motion, which `m` may hold in part.
    """
    out = np.zeros((3, m.u.size))
    for key, force in values.items():
        if not (isinstance(key, TermKey) and key.name == "force"):
            continue
        width = values.get(TermKey(key.term, "width"), 1.0)
        location, shape = key.term.split(" ", 1)
        # all dry friction terms share one regularization at zero velocity
        friction_sign = (
            np.tanh(m.v / values[SLIP_SPEED]) * np.where(m.v > 0, 1.0, -1.0)
            if SLIP_SPEED in values
            else 1.0
        )
        if shape == "resonator":
            out[0] += force * resonator_force(width)
        elif location == "damper":
            column = DAMPER_TERMS.get(shape) or DAMPER_WIDTH_TERMS[shape]
            sign_factor = friction_sign if "sign(v)" in shape else 1.0
            out[0] += force * sign_factor * column(m.u / scale.u, m.v / scale.v, width)
        else:
            for side, (side_sign, gap) in enumerate(zip((1.0, -1.0), gaps_m, strict=True)):
                d = np.clip((side_sign * m.u - gap) / scale.depth, 0.0, None)
                push = BUMPER_TERMS[shape](d, side_sign * m.v / scale.v, width)
                out[1 + side] += force * np.where(touched[side] > 0, push, 0.0)
    return out


def compute_resonator_force(m: MeasuredMotion, hz: float) -> Float1D:
    """Return the force of an attached resonator over its largest value, (sample,).

    q'' + 2 z w q' + w^2 q = -a, with a the acceleration of the mass; the force is that of the
    resonator's spring and dashpot, discretized with the Tustin rule (prewarped to w).
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
