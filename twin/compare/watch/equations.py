"""Linear equations of the specimen's laws from one held cycle, each over its own noise.

With test functions phi (`held.functions`), by parts, SI:
    damper   -<phi, M a> = K <phi, u> - C <phi', u> + q_R <phi, F_R> + q_L <phi, F_L>
    bumper    <phi, F_j> + C_j <phi', u_j> = K_j <phi, u_j> - K_j G_j <phi, 1>   over each contact
(u_j = u right, -u left; forces as the load cells read them; q_j = 1 within what cells may be off).
What the model's effects add is taken from its own restarted motion.
"""

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import RIGHT_CELLS, contact_forces, rel_disp
from twin.compare.watch.held import Held, Noise, WatchSetup, against, functions

LAWS = ("damper", "right", "left")
UNEVEN = 0.0005  # of a contact force: what load cells may be off, but for their gain
CLEAR = 0.9  # of a gap: what stays within it touches nothing
SHORTEST = 8  # samples of a contact

Equations = tuple[Float2D, Float1D]  # (equation, number) and (equation,)


def equations(setup: WatchSetup, noise: Noise, held: Held) -> list[Equations | None]:
    """Of each of `LAWS`: (K, C, q_R, q_L), (K_R, K_R G_R), (K_L, K_L G_L); None: it cannot tell."""
    return [_damper(setup, noise, held), *_bumpers(setup, noise, held)]


def _damper(setup: WatchSetup, noise: Noise, held: Held) -> Equations | None:
    """Weighed equations of K, C, q_R and q_L; None where the cycle cannot tell."""
    p = setup.model.parameters
    u, a = rel_disp(held.true), held.column("mass_acc_m_s2")
    sides = [
        np.zeros(u.size) if _apart(side * u, force, gap) else force
        for force, gap, side in zip(contact_forces(held.true), setup.gaps_m, (1, -1), strict=True)
    ]
    if not np.isfinite(u + a + sides[0] + sides[1]).all():
        return None
    phi, slope, _ = functions(u.size, setup.rate_hz)
    values = -against(phi, p.mass * a + _added(setup, held, "damper"))
    by_force = [against(phi, one) for one in sides]
    rows = np.stack([against(phi, u), -against(slope, u), *by_force], axis=1)
    rms = _some(noise.of("mass_acc_m_s2"), 1e-3 * float(a.std())) * p.mass
    cell = _some(noise.of(RIGHT_CELLS[0]), 0.0)
    white = np.sqrt((phi**2).sum(axis=1)) * np.hypot(rms, 2 * cell)
    sd = np.hypot(white, UNEVEN * against(np.abs(phi), np.abs(sides[0]) + np.abs(sides[1])))
    return rows / sd[:, None], values / sd


def _apart(u: Float1D, force: Float1D, gap: float) -> bool:
    """True where a bumper is not there, or nobody measures it and it is out of reach."""
    return np.isinf(gap) or bool(np.isnan(force).any() and (u < CLEAR * gap).all())


def _bumpers(setup: WatchSetup, noise: Noise, held: Held) -> tuple[Equations | None, ...]:
    """Weighed equations of K_j and K_j G_j over the contacts of the cycle, right and left."""
    p = setup.model.parameters
    u = rel_disp(held.true)
    drifted = setup.model.opened(held.end / setup.rate_hz)
    found: list[Equations | None] = []
    forces = contact_forces(held.true)
    damping = p.bumper_damping_r, p.bumper_damping_l
    for law, side, force, c in zip(LAWS[1:], (1, -1), forces, damping, strict=True):
        push = side * force
        if not np.isfinite(u + push).all():
            found.append(None)
            continue
        # A sample at an edge of the contact may lie on either side of it, smeared by the filters.
        touching = np.concatenate([[False], push > setup.contact_n, [False]])
        edges = np.flatnonzero(np.diff(touching.astype(np.int8)))
        added = _added(setup, held, law)
        rms = np.sqrt(2.0) * _some(noise.of(RIGHT_CELLS[0]), 1e-3 * float(push.max()))
        rms = np.hypot(rms, p.bumper_stiffness_r * _some(noise.of("mass_disp_m"), 0.0))
        parts = [
            _contact(side * u[i:j] - drifted, push[i:j] - added[i:j], c, setup.rate_hz, rms)
            for i, j in edges.reshape(-1, 2).tolist()
            if j - i >= SHORTEST
        ]
        rows, values = ([one[k] for one in parts] for k in range(2))
        found.append((np.concatenate(rows), np.concatenate(values)) if parts else None)
    return tuple(found)


def _contact(
    depth: Float1D, push: Float1D, damping: float, rate_hz: float, rms: float
) -> tuple[Float2D, Float1D]:
    """Weighed equations of one contact."""
    phi, slope, _ = (one[:2] for one in functions(depth.size, rate_hz))
    values = against(phi, push) + damping * against(slope, depth)
    rows = np.stack([against(phi, depth), -phi.sum(axis=1)], axis=1)
    sd = np.hypot(np.sqrt((phi**2).sum(axis=1)) * rms, UNEVEN * against(np.abs(phi), push))
    return rows / sd[:, None], values / sd


def _added(setup: WatchSetup, held: Held, law: str) -> Float1D:
    """N that the model's effects add to a linear law, from its own restarted motion, (sample,)."""
    if not any(one.effect.acts in ("force", "linear") for one in setup.model.present):
        return np.zeros(len(held.measured))
    p, sensors = setup.model.parameters, {one.channel: one for one in setup.model.sensors}

    def moved(name: str) -> Float1D:
        """The restarted twin's own, without what its sensors make of it."""
        value = held.predicted.channel(f"window/{name}")
        one = sensors.get(name)
        return value if one is None else (value - one.offset) / one.gain

    u, v = moved("rel_disp_m"), moved("rel_vel_m_s")
    if "mass_disp_m" in sensors and "rel_disp_m" not in held.measured.channels:
        u = moved("mass_disp_m") - held.column("table_disp_m")
    right = moved("force_r1_n") + moved("force_r2_n")
    left = moved("force_l1_n") + moved("force_l2_n")
    if law == "damper":
        total = -p.mass * moved("mass_acc_m_s2") - right + left
        more = total - p.stiffness * u - p.damping * v
    else:
        side, push, k, c, gap = (
            (1, right, p.bumper_stiffness_r, p.bumper_damping_r, p.gap_r)
            if law == "right"
            else (-1, left, p.bumper_stiffness_l, p.bumper_damping_l, p.gap_l)
        )
        gap += setup.model.opened(held.end / setup.rate_hz)
        more = np.where(push > 0, push - k * (side * u - gap) - c * side * v, 0.0)
    return np.where(np.isfinite(more), more, 0.0)


def _some(value: float, instead: float) -> float:
    return value if np.isfinite(value) else instead
