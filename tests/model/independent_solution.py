"""The model with force laws written down a second time: scipy's DOP853 with events.

Independent of `twin.model`: z is integrated here, not closed; sides are spelt out.
"""

import math
from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

from twin.model.model import Model

SMALL_STEP_S = 1e-7  # s: a step away from the zero of a guard


class Witness:
    """One run; `effects` as {id: {parameter: value}}."""

    def __init__(self, model: Model, base: Callable[[float], float]) -> None:
        self.p, self.base = model.parameters, base
        self.e = {effect.effect.id: effect.values for effect in model.present_effects}
        self.contact, self.way = [False, False], 1.0

    def get(self, effect: str, name: str) -> float:
        return self.e.get(effect, {}).get(name, 0.0)

    def gap(self, side: int, t: float) -> float:
        return (self.p.gap_r, self.p.gap_l)[side] + self.get("gap_drift", "rate") * t

    def bumper(self, side: int, d: float, dd: float, b: float) -> float:
        k = (self.p.bumper_stiffness_r, self.p.bumper_stiffness_l)[side]
        c = (self.p.bumper_damping_r, self.p.bumper_damping_l)[side]
        k2, ch = self.get("bumper_hardening", "k2"), self.get("hunt_crossley", "ch")
        cubic = self.get("bumper_cubic", "kc") * d**3
        return k * d + c * dd + k2 * d * abs(d) + cubic + ch * abs(d) * dd + b

    def face(self, side: int, t: float, x: np.ndarray) -> tuple[float, float]:
        """(d, d') of a bumper, positive in compression."""
        s = (1.0, -1.0)[side]
        if self.contact[side]:
            return s * x[0] - self.gap(side, t), s * x[1] - self.get("gap_drift", "rate")
        d, b = x[2 + side], x[5 + side]
        damping = (self.p.bumper_damping_r, self.p.bumper_damping_l)[side]
        if damping == 0 and b == 0 and d < 1e-9:
            return d, 0.0  # back at its face
        zero, unit_rate = (self.bumper(side, d, rate, b) for rate in (0.0, 1.0))
        return d, -zero / (unit_rate - zero) if unit_rate > zero else 0.0

    def forces(self, t: float, x: np.ndarray, friction: bool = True) -> float:
        u, v, z = x[0], x[1], x[7]
        total = self.p.stiffness * u + self.p.damping * v + x[4]
        total += self.get("cubic_stiffness", "k3") * u**3
        total += self.get("quadratic_damping", "c2") * v * v * self.way
        total += self.get("bouc_wen", "force") * z
        total += self.get("position_damping", "cu") * u * u * v
        if width := self.get("dead_band", "width"):
            total -= self.p.stiffness * u * (1 + abs(u / width) ** 4) ** -0.25
        total -= self.get("appendage", "mass") * self.rider(x)
        if friction:
            total += self.get("coulomb_friction", "fc") * self.way
            fc, ratio = (self.get("stribeck_friction", name) for name in ("fc", "ratio"))
            speed = self.get("stribeck_friction", "speed") or 1.0
            total += (fc + fc * (ratio - 1) * math.exp(-((v / speed) ** 2))) * self.way
        for side, s in ((0, 1.0), (1, -1.0)):
            if self.contact[side]:
                d, dd = self.face(side, t, x)
                total += s * self.bumper(side, d, dd, x[5 + side])
        return total

    def rider(self, x: np.ndarray) -> float:
        """Acceleration of the attached mass by its spring and dashpot, u - y and their rates."""
        w = 2 * math.pi * self.get("appendage", "frequency")
        v = 0.0 if self.way == 0.0 else x[1]
        return w * w * (x[8] - x[0]) + 2 * self.get("appendage", "damping_ratio") * w * (x[9] - v)

    def rhs(self, t: float, x: np.ndarray) -> list[float]:
        stuck = self.way == 0.0
        v = 0.0 if stuck else x[1]
        dv = 0.0 if stuck else -self.base(t) - self.forces(t, x) / self.p.mass
        tau, tau_b = self.get("maxwell_damper", "tau"), self.get("bumper_maxwell", "tau")
        df = self.get("maxwell_damper", "k1") * v - (x[4] / tau if tau else 0.0)
        out, kb = [v, dv], self.get("bumper_maxwell", "kb")
        rates = [self.face(side, t, x)[1] for side in (0, 1)]
        branch = [kb * rates[s] - (x[5 + s] / tau_b if tau_b else 0.0) for s in (0, 1)]
        z, uy = x[7], self.get("bouc_wen", "yield_displacement")
        dz = (v - 0.5 * (abs(v) * z * abs(z) + v * z * z)) / uy if uy else 0.0
        return [*out, *rates, df, *branch, dz, x[9], -self.base(t) - self.rider(x)]

    def holding_force(self, t: float, x: np.ndarray) -> float:
        """Friction that would hold the mass."""
        way, self.way = self.way, 0.0
        still = np.array(x, dtype=float)
        still[1] = 0.0
        need = -self.p.mass * self.base(t) - self.forces(t, still, friction=False)
        self.way = way
        return need

    def break_away(self) -> float:
        stribeck = self.get("stribeck_friction", "fc") * self.get("stribeck_friction", "ratio")
        return stribeck + self.get("coulomb_friction", "fc")

    def guards(self):
        def side(place: int):
            def event(t, x):
                s = (1.0, -1.0)[place]
                if self.contact[place]:
                    push = self.bumper(place, *self.face(place, t, x), x[5 + place])
                    return push + self.get("adhesion", "force")
                gap = self.gap(place, t)
                return gap + x[2 + place] - s * x[0] if math.isfinite(gap) else 1.0

            return event

        def turn(t, x):
            fc = self.break_away()
            return self.way * x[1] if self.way else fc - abs(self.holding_force(t, x))

        events = [side(0), side(1), turn]
        for event in events:
            event.terminal, event.direction = True, -1
        return events

    def happen(self, which: int, t: float, x: np.ndarray) -> None:
        if which < 2:
            self.contact[which] = not self.contact[which]
            if self.contact[which]:
                x[2 + which] = self.face(which, t, x)[0]
            return
        need, fc = self.holding_force(t, x), self.break_away()
        x[1] = 0.0
        self.way = 0.0 if fc and self.way and abs(need) <= fc else math.copysign(1.0, need)

    def run(self, x0, times: np.ndarray, tolerance: float = 1e-11) -> np.ndarray:
        """(u, v, d_R, d_L, f, b_R, b_L, z, y, y') at `times` (10, n), and the number of events.

        x0 (8,): the attached mass starts at rest relative to the table, its spring relaxed.
        """
        x = np.array([*x0, x0[0], 0.0])
        t = 0.0
        solution = np.full((10, times.size), np.nan)
        self.events = 0
        self.way = math.copysign(1.0, x[1]) if x[1] else self.way
        step = times[1] - times[0]
        while t < times[-1]:
            part = solve_ivp(
                self.rhs, (t, times[-1]), x, method="DOP853", dense_output=True, rtol=tolerance,
                atol=tolerance * 1e-2, max_step=step, events=self.guards(),
            )  # fmt: skip
            inside = (times >= t) & (times <= part.t[-1])
            if inside.any():
                solution[:, inside] = part.sol(times[inside])
            t, x = part.t[-1], part.y[:, -1].copy()
            if t >= times[-1]:
                break
            which = next(i for i in range(3) if part.t_events[i].size)
            self.happen(which, t, x)
            self.events += 1
            k1 = np.array(self.rhs(t, x))
            k2 = np.array(self.rhs(t + SMALL_STEP_S / 2, x + SMALL_STEP_S / 2 * k1))
            t, x = t + SMALL_STEP_S, x + SMALL_STEP_S * k2
        return solution
