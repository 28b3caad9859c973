"""The SNM written down a second time: scipy's DOP853 with events; slow, and independent."""

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from twin.model.parameters import Parameters

G_M_S2 = 9.80665
AG = 0.05 * G_M_S2
SNM = {
    "mass": 550.0, "stiffness": 36e3, "damping": 1100.0,
    "bumper_stiffness_r": 510e3, "bumper_damping_r": 900.0,
    "bumper_stiffness_l": 510e3, "bumper_damping_l": 900.0,
}  # fmt: skip


def snm(gap_m: float = 0.004, **changes: float) -> Parameters:
    """The paper's SNM at a total gap in m, with changes by field name."""
    return Parameters(**{**SNM, "gap_r": gap_m / 2, "gap_l": gap_m / 2, **changes})


def right_hand_side(p: Parameters, contact: list[bool], base: Callable[[float], float]):
    """d/dt of (u, v, u_R, u_L)."""

    def rhs(t, x):
        u, v, ur, ul = x
        fr = p.bumper_damping_r * v + p.bumper_stiffness_r * (u - p.gap_r) if contact[0] else 0.0
        fl = p.bumper_damping_l * v + p.bumper_stiffness_l * (u + p.gap_l) if contact[1] else 0.0
        dv = -base(t) - (p.damping * v + p.stiffness * u + fr + fl) / p.mass
        dr = v if contact[0] else -ur * p.bumper_stiffness_r / p.bumper_damping_r
        dl = v if contact[1] else -ul * p.bumper_stiffness_l / p.bumper_damping_l
        return [v, dv, dr, dl]

    return rhs


def guards(p: Parameters, contact: list[bool]):
    """Clearance or push of both sides as terminal events."""

    def right_event(t, x):
        u, v, ur, _ = x
        if contact[0]:
            return p.bumper_damping_r * v + p.bumper_stiffness_r * (u - p.gap_r)
        return p.gap_r + ur - u if math.isfinite(p.gap_r) else 1.0

    def left_event(t, x):
        u, v, _, ul = x
        if contact[1]:
            return -p.bumper_damping_l * v - p.bumper_stiffness_l * (u + p.gap_l)
        return u - ul + p.gap_l if math.isfinite(p.gap_l) else 1.0

    for event in (right_event, left_event):  # solve_ivp reads attributes of its events
        vars(event).update(terminal=True, direction=-1)
    return right_event, left_event


def linear_between(times, values) -> Callable[[float], float]:
    """The drive that is linear between its values at these times."""
    return lambda t: float(np.interp(t, times, values))


def small_step(p, contact, base, t, x, step=1e-7):
    """One Runge-Kutta step of 1e-7 s, away from the zero of the guard."""
    rhs, x = right_hand_side(p, contact, base), np.array(x)
    k1 = np.array(rhs(t, x))
    k2 = np.array(rhs(t + step / 2, x + step / 2 * k1))
    k3 = np.array(rhs(t + step / 2, x + step / 2 * k2))
    k4 = np.array(rhs(t + step, x + step * k3))
    return t + step, list(x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))


def reference(p, x0, contact, base: Callable[[float], float], knots, tolerance=1e-13, dt=1e-3):
    """(u, v, u_R, u_L) at the knots (4, n) and the events [(t, side, onset)], from x0 at the first.

    No step crosses a knot, where the drive may have a kink, and event times are not those of
    scipy's interpolant, which is less accurate than its steps.
    """
    contact, events, states = list(contact), [], [x0]
    t, x = small_step(p, contact, base, knots[0], x0)  # from a release, as below
    if min(guard(t, x) for guard in guards(p, contact)) < 0:
        t, x = knots[0], list(x0)  # it starts at touch, on the way in
    for end in knots[1:]:
        while t < end:
            rhs, guard = right_hand_side(p, contact, base), guards(p, contact)
            solution = solve_ivp(
                rhs, (t, end), x, method="DOP853", rtol=tolerance, atol=tolerance * 1e-3,
                max_step=dt, events=guard,
            )  # fmt: skip
            if solution.status != 1:
                t, x = end, list(solution.y[:, -1])
                break
            side = 0 if solution.t_events[0].size else 1
            begin, x0 = solution.t[-2], solution.y[:, -2]
            t, x = refine_root(rhs, guard[side], begin, x0, solution.t[-1], tolerance)
            contact[side] = not contact[side]
            x[2 + side] = x[0] - p.gap_r if side == 0 else x[0] + p.gap_l
            events.append((t, side, contact[side]))
            # scipy sees the guard at zero at the start of the phase and would end it there.
            t, x = small_step(p, contact, base, t, x)
        states.append(x)
    return np.array(states).T, np.array(events).reshape(-1, 3)


def refine_root(rhs, guard, begin, x0, t, tolerance) -> tuple[float, list[float]]:
    """(time, state) where the guard is zero, by secants near t; each try is a fresh integration."""

    def at(time):
        return solve_ivp(
            rhs, (begin, time), x0, method="DOP853", rtol=tolerance, atol=tolerance * 1e-3
        ).y[:, -1]

    before = t - 1e-3 * (t - begin)
    g_before, x = guard(before, at(before)), at(t)
    for _ in range(8):
        g = guard(t, x)
        if g == g_before:
            break
        step = -g * (t - before) / (g - g_before)
        before, g_before, t = t, g, t + step
        x = at(t)
        if abs(step) < 1e-15:
            break
    return t, list(x)
