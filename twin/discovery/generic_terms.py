"""Forces of the generic terms of `twin.laws.terms`, which stand for effects outside the library.

Each is an amplitude times a shape of size 1 at the largest measured u, v or depth d.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.signal import lfilter

from table_io.block import Float1D, Float2D
from twin.discovery.motion import MeasuredMotion, RecordScale
from twin.discovery.parameters import SLIP_SPEED, ParameterKey, TermKey
from twin.laws.terms import GENERIC_TERMS, RESONATOR_TERM

RESONATOR_DAMPING = 0.03


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
    if SLIP_SPEED in values:
        # all dry friction terms share one regularization at zero velocity
        slip_share = np.tanh(m.v / values[SLIP_SPEED]) * np.where(m.v > 0, 1.0, -1.0)
    for key, force in values.items():
        if not (isinstance(key, TermKey) and key.name == "force"):
            continue
        width = values.get(TermKey(key.term, "width"), 1.0)
        if key.term == RESONATOR_TERM:
            out[0] += force * resonator_force(width)
            continue
        term = GENERIC_TERMS[key.term]
        given: dict[str, Any] = {"v0": scale.v, "w": width}
        if term.place == "damper":
            is_friction = SLIP_SPEED in values and "sign(v)" in term.force
            size = force * slip_share if is_friction else force
            out[0] += size * term.evaluate({**given, "u": m.u, "v": m.v, "u0": scale.u})
            continue
        for side, (side_sign, gap) in enumerate(zip((1.0, -1.0), gaps_m, strict=True)):
            d = np.clip((side_sign * m.u - gap), 0.0, None)
            push = term.evaluate({**given, "d": d, "v": side_sign * m.v, "d0": scale.depth})
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
