"""Weak-form equations of the specimen's force laws from one held cycle, scaled by their noise.

With test functions phi (`cycle.weight_functions`), by parts, SI:
    damper   -<phi, M a> = K <phi, u> - C <phi', u> + q_R <phi, F_R> + q_L <phi, F_L>
    bumper    <phi, F_j> + C_j <phi', u_j> = K_j <phi, u_j> - K_j G_j <phi, 1>   over each contact
(u_j = u right, -u left; forces as the load cells read them; q_j = 1 within the load cells' error).
Forces of the model's effects are taken from its own restarted motion. The last columns are
nuisances: plates in front of the load cells, which move with the table, add -m_p A to them; lasers
whose slopes differ by e add e y to u, with the table's displacement y; a low cut w and a lag t of
the accelerometer that are left add -w x' - t a' to a, with the displacement x of the mass.
"""

from functools import lru_cache

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import RIGHT_CELLS, contact_forces, relative_displacement
from twin.compare.monitoring.cycle import (
    ChannelNoise,
    CycleData,
    MonitoringSetup,
    weight_functions,
    weight_norms,
    weighted_sums,
)
from twin.compare.monitoring.low_cut import body_displacement

LAW_NAMES = ("damper", "right", "left")
LOAD_CELL_ERROR = 0.0005  # of a contact force: error of load cells, except gain
CLEAR_GAP_FRACTION = 0.9  # of a gap: motion within it makes no contact
MIN_FLIGHT_SHARE = 0.1  # of a cycle
MIN_CONTACT_SAMPLES = 8  # shorter contacts are ignored

Equations = tuple[Float2D, Float1D]  # (equation, parameter) and (equation,)


def force_equations(
    setup: MonitoringSetup, noise: ChannelNoise, cycle: CycleData
) -> list[Equations | None]:
    """Return the equations of each of `LAW_NAMES`; None if the cycle gives none.

    Parameters: (K, C, q_R, q_L, m_p, K e, w, t), (K_R, K_R G_R, K_R e), (K_L, K_L G_L, K_L e).
    """
    return [_damper_equations(setup, noise, cycle), *_bumper_equations(setup, noise, cycle)]


def _damper_equations(
    setup: MonitoringSetup, noise: ChannelNoise, cycle: CycleData
) -> Equations | None:
    """Return noise-scaled equations of K, C, q_R, q_L and nuisances; None if there are none."""
    p = setup.model.parameters
    u, a = relative_displacement(cycle.corrected), cycle.channel_values("mass_acc_m_s2")
    sides = [
        np.zeros(u.size) if _is_out_of_reach(side * u, force, gap) else force
        for force, gap, side in zip(
            contact_forces(cycle.corrected), setup.gaps_m, (1, -1), strict=True
        )
    ]
    if not np.isfinite(u + a + sides[0] + sides[1]).all():
        return None
    is_flight = (sides[0] <= setup.contact_n) & (-sides[1] <= setup.contact_n)
    if is_flight.mean() < MIN_FLIGHT_SHARE:  # the error of the load cells hides the damper
        return None
    phi, slope, _ = weight_functions(u.size, setup.rate_hz)
    x = body_displacement(cycle.corrected, "mass_acc_m_s2")
    table = [cycle.channel_values(name) for name in ("table_acc_m_s2", "table_disp_m")]
    inertia = p.mass * a + _effect_forces(setup, cycle, "damper")
    by_inertia, by_disp, *others = weighted_sums(phi, [inertia, u, *sides, *np.nan_to_num(table)])
    by_speed, by_low_cut, by_lag = weighted_sums(
        slope, [u, u if x is None else np.nan_to_num(x), a]
    )
    values = -by_inertia
    nuisances = p.mass * by_low_cut, p.mass * by_lag
    rows = np.stack([by_disp, -by_speed, *others, *nuisances], axis=1)
    acc_rms = _finite_or(noise.channel_rms("mass_acc_m_s2"), 1e-3 * float(a.std())) * p.mass
    cell_rms = _finite_or(noise.channel_rms(RIGHT_CELLS[0]), 0.0)
    white_sd = weight_norms(u.size, setup.rate_hz)[0] * np.hypot(acc_rms, 2 * cell_rms)
    sd = np.hypot(
        white_sd, LOAD_CELL_ERROR * weighted_sums(np.abs(phi), np.abs(sides[0]) + np.abs(sides[1]))
    )
    return rows / sd[:, None], values / sd


def _is_out_of_reach(u: Float1D, force: Float1D, gap: float) -> bool:
    """Return whether a bumper is absent, or unmeasured and out of reach."""
    return np.isinf(gap) or bool(np.isnan(force).any() and (u < CLEAR_GAP_FRACTION * gap).all())


def _bumper_equations(
    setup: MonitoringSetup, noise: ChannelNoise, cycle: CycleData
) -> tuple[Equations | None, ...]:
    """Return noise-scaled equations of K_j and K_j G_j over all contacts, right and left."""
    p = setup.model.parameters
    u = relative_displacement(cycle.corrected)
    y = np.nan_to_num(cycle.channel_values("table_disp_m"))
    gap_opening = setup.model.gap_opening_m(cycle.end / setup.rate_hz)
    equations: list[Equations | None] = []
    forces = contact_forces(cycle.corrected)
    damping = p.bumper_damping_r, p.bumper_damping_l
    for law, side, force, c in zip(LAW_NAMES[1:], (1, -1), forces, damping, strict=True):
        push = side * force
        if not np.isfinite(u + push).all():
            equations.append(None)
            continue
        # A sample at an edge of the contact may lie on either side of it, smeared by the filters.
        in_contact = np.concatenate([[False], push > setup.contact_n, [False]])
        edges = np.flatnonzero(np.diff(in_contact.astype(np.int8)))
        effect_force = _effect_forces(setup, cycle, law)
        rms = np.sqrt(2.0) * _finite_or(noise.channel_rms(RIGHT_CELLS[0]), 1e-3 * float(push.max()))
        rms = np.hypot(
            rms, p.bumper_stiffness_r * _finite_or(noise.channel_rms("mass_disp_m"), 0.0)
        )
        contacts = [
            _contact_equations(
                side * u[i:j] - gap_opening,
                push[i:j] - effect_force[i:j],
                side * y[i:j],
                c,
                setup.rate_hz,
                rms,
            )
            for i, j in edges.reshape(-1, 2).tolist()
            if j - i >= MIN_CONTACT_SAMPLES
        ]
        rows, values = ([contact[k] for contact in contacts] for k in range(2))
        equations.append((np.concatenate(rows), np.concatenate(values)) if contacts else None)
    return tuple(equations)


def _contact_equations(
    depth: Float1D, push: Float1D, table: Float1D, damping: float, rate_hz: float, rms: float
) -> tuple[Float2D, Float1D]:
    """Return noise-scaled equations of one contact."""
    phi, slope, size, total, norm = _contact_functions(depth.size, rate_hz)
    by_push, by_depth, by_table = weighted_sums(phi, [push, depth, table])
    values = by_push + damping * weighted_sums(slope, depth)
    rows = np.stack([by_depth, -total, by_table], axis=1)
    sd = np.hypot(norm * rms, LOAD_CELL_ERROR * weighted_sums(size, push))
    return rows / sd[:, None], values / sd


@lru_cache(maxsize=512)
def _contact_functions(samples: int, rate_hz: float) -> tuple[Float2D, ...]:
    """Return phi, phi', |phi|, the sum of phi and its norm, of the two functions of a contact."""
    phi, slope, _ = (each[:2] for each in weight_functions.__wrapped__(samples, rate_hz))
    return phi, slope, np.abs(phi), phi.sum(axis=1), np.sqrt((phi**2).sum(axis=1))


def _effect_forces(setup: MonitoringSetup, cycle: CycleData, law: str) -> Float1D:
    """Return the force in N that effects add to a linear law, by the restarted twin, (sample,)."""
    if not any(
        instance.effect.acts in ("force", "linear") for instance in setup.model.present_effects
    ):
        return np.zeros(len(cycle.measured))
    p, sensors = setup.model.parameters, {sensor.channel: sensor for sensor in setup.model.sensors}

    def true_channel(name: str) -> Float1D:
        """Return a channel of the restarted twin without sensor errors."""
        value = cycle.predicted.channel(f"window/{name}")
        sensor = sensors.get(name)
        return value if sensor is None else (value - sensor.offset) / sensor.gain

    u, v = true_channel("rel_disp_m"), true_channel("rel_vel_m_s")
    if "mass_disp_m" in sensors and "rel_disp_m" not in cycle.measured.channels:
        u = true_channel("mass_disp_m") - cycle.channel_values("table_disp_m")
    right = true_channel("force_r1_n") + true_channel("force_r2_n")
    left = true_channel("force_l1_n") + true_channel("force_l2_n")
    if law == "damper":
        total = -p.mass * true_channel("mass_acc_m_s2") - right + left
        added_force = total - p.stiffness * u - p.damping * v
    else:
        side, push, k, c, gap = (
            (1, right, p.bumper_stiffness_r, p.bumper_damping_r, p.gap_r)
            if law == "right"
            else (-1, left, p.bumper_stiffness_l, p.bumper_damping_l, p.gap_l)
        )
        gap += setup.model.gap_opening_m(cycle.end / setup.rate_hz)
        added_force = np.where(push > 0, push - k * (side * u - gap) - c * side * v, 0.0)
    return np.where(np.isfinite(added_force), added_force, 0.0)


def _finite_or(value: float, default: float) -> float:
    return value if np.isfinite(value) else default
