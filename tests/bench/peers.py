"""Other people's solvers on the same sweep, each as well as it can be driven."""

import functools
import math

import numpy as np
from scipy.integrate import solve_ivp

AG = 0.05 * 9.80665
M, K, C, KJ, CJ, GAP = 550.0, 36e3, 1100.0, 510e3, 900.0, 2e-3
RATE = KJ / CJ


def scipy_sweep(frequencies, cycles: int, rtol: float = 1e-6) -> tuple[np.ndarray, int]:
    """(state (u, v, u_r, u_l) at the end of each frequency, onsets) by solve_ivp RK45 with events.

    Plain floats in the right-hand side, one call a phase, no dense output.
    """
    sin, mode, x, count, ends = math.sin, [0], [0.0, 0.0, 0.0, 0.0], 0, []
    w = [0.0]

    def rhs(t, x):
        u, v, ur, ul = x
        force = C * v + K * u
        if mode[0] == 1:
            force += CJ * v + KJ * (u - GAP)
            dr, dl = v, -RATE * ul
        elif mode[0] == 2:
            force += CJ * v + KJ * (u + GAP)
            dr, dl = -RATE * ur, v
        else:
            dr, dl = -RATE * ur, -RATE * ul
        return v, -AG * sin(w[0] * t) - force / M, dr, dl

    def right_event(t, x):
        return CJ * x[1] + KJ * (x[0] - GAP) if mode[0] == 1 else GAP + x[2] - x[0]

    def left_event(t, x):
        return -CJ * x[1] - KJ * (x[0] + GAP) if mode[0] == 2 else GAP + x[0] - x[3]

    for event in (right_event, left_event):  # solve_ivp reads attributes of its events
        vars(event).update(terminal=True, direction=-1)
    for frequency in frequencies:
        w[0], t, end = 2 * math.pi * frequency, 0.0, cycles / frequency
        while t < end:
            piece = solve_ivp(
                rhs, (t, end), x, rtol=rtol, atol=rtol * 1e-3, events=(right_event, left_event)
            )
            t, x = piece.t[-1], list(piece.y[:, -1])
            if piece.status != 1:
                break
            if mode[0]:
                mode[0] = 0
            else:
                mode[0] = 1 if x[0] > 0 else 2
                x[1 + mode[0]] = x[0] - GAP if mode[0] == 1 else x[0] + GAP
                count += 1
            # Away from the zero of the guard, which would end the next phase at once.
            x = [a + 1e-9 * b for a, b in zip(x, rhs(t, x), strict=True)]
            t += 1e-9
        ends.append(x)
    return np.array(ends), count


def diffrax_model():
    """(right-hand side, both guards) in jax; all modes by `where`, as a mode is data here."""
    import jax.numpy as jnp

    def field(t, x, args):
        w, mode, gap = args
        u, v, ur, ul = x
        right, left = mode == 1, mode == 2
        push = CJ * v + KJ * jnp.where(right, u - gap, u + gap)
        force = C * v + K * u + jnp.where(right | left, push, 0.0)
        return (
            v,
            -AG * jnp.sin(w * t) - force / M,
            jnp.where(right, v, -RATE * ur),
            jnp.where(left, v, -RATE * ul),
        )

    def right_guard(t, y, args, **kwargs):
        u, v, ur, _ = y
        _, mode, gap = args
        return jnp.where(mode == 1, CJ * v + KJ * (u - gap), gap + ur - u)

    def left_guard(t, y, args, **kwargs):
        u, v, _, ul = y
        _, mode, gap = args
        return jnp.where(mode == 2, -CJ * v - KJ * (u + gap), gap + u - ul)

    return field, (right_guard, left_guard)


def diffrax_phase(rtol: float, atol: float):
    """A jax function: (t, x, mode, onsets) -> the same at the next event, or at `end`."""
    import diffrax
    import jax
    import jax.numpy as jnp
    import optimistix

    field, guards = diffrax_model()
    term, solver = diffrax.ODETerm(field), diffrax.Tsit5()
    control = diffrax.PIDController(rtol=rtol, atol=atol)
    event = diffrax.Event(guards, optimistix.Newton(1e-10, 1e-10), direction=False)

    def phase(w, end, gap, loop):
        t, x, mode, count = loop
        solution = diffrax.diffeqsolve(
            term, solver, t, end, 1e-3, x, (w, mode, gap), stepsize_controller=control, event=event,
            saveat=diffrax.SaveAt(t1=True), max_steps=4096, throw=False,
        )  # fmt: skip
        t, (u, v, ur, ul) = solution.ts[-1], jax.tree.map(lambda y: y[-1], solution.ys)
        hit = solution.event_mask[0] | solution.event_mask[1]
        onset = hit & (mode == 0)
        new = jnp.where(hit, jnp.where(mode == 0, jnp.where(u > 0, 1, 2), 0), mode)
        ur = jnp.where(onset & (new == 1), u - gap, ur)
        ul = jnp.where(onset & (new == 2), u + gap, ul)
        x, away = (u, v, ur, ul), jnp.where(hit, 1e-9, 0.0)
        x = jax.tree.map(lambda y, d: y + away * d, x, field(t, x, (w, new, gap)))
        return t + away, x, new, count + onset

    return phase


def diffrax_sweep(cycles: int, rtol: float, atol: float):
    """A compiled function: frequencies, gaps a side -> (state at the end of each, onsets).

    Of one gap, or of all of a batch (gap, frequency, 4) by vmap, as the library intends it.

    Tsit5 with a PID controller, float64, the event located by its root finder, phases in a
    while_loop inside a scan over frequencies: one compilation, nothing goes back to Python. Steps
    are not saved. Tried and slower at this tolerance: other adjoints, Dopri8, longer first steps;
    Dopri5 is as fast.
    """
    import jax
    import jax.numpy as jnp

    jax.config.update("jax_enable_x64", True)
    phase = diffrax_phase(rtol, atol)

    def follow_frequency(gap, carry, frequency):
        x, mode, count = carry
        w, end = 2 * jnp.pi * frequency, cycles / frequency
        _, x, mode, count = jax.lax.while_loop(
            lambda loop: loop[0] < end, lambda loop: phase(w, end, gap, loop), (0.0, x, mode, count)
        )
        return (x, mode, count), jnp.stack(x)

    def sweep(frequencies, gap):
        start = ((jnp.float64(0),) * 4, jnp.int64(0), jnp.int64(0))
        step = functools.partial(follow_frequency, gap)
        (_, _, count), ends = jax.lax.scan(step, start, frequencies)
        return ends, count

    single, batch = jax.jit(sweep), jax.jit(jax.vmap(sweep, (None, 0)))

    def run(frequencies, gaps=GAP):
        function = batch if np.ndim(gaps) else single
        return tuple(np.asarray(y) for y in function(jnp.asarray(frequencies), jnp.asarray(gaps)))

    return run
