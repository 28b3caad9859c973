"""The plant with one hidden effect, written down anew for an adaptive method of order eight."""

import math
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from table_io.block import Float1D, Float2D
from table_io.sim.ground_truth import EffectDefinition
from table_io.sim.hidden_laws import StrangeLaws
from table_io.units import GRAVITY_M_S2

M, K, C, KJ, CJ, G, MT = 550.0, 36e3, 1100.0, 510e3, 900.0, 2e-3, 2000.0
H = 1.0 / 2000.0

# What each form is said to be, over u, u', (z, f, b_R, b_L) and compression d; N, N and N s/m.
LAWS: dict[str, Any] = {
    "stretched": lambda u, v, q, p: p["k3"] * u**3 / math.hypot(1.0, u / 0.15),
    "rounded": lambda u, v, q, p: p["c2"] * v * math.hypot(v, 1e-3),
    "coulomb_friction tanh": lambda u, v, q, p: p["fc"] * math.tanh(v / p["slip_speed"]),
    "stribeck_friction tanh": lambda u, v, q, p: (
        p["fc"]
        * (1 + (p["ratio"] - 1) * math.exp(-((v / p["speed"]) ** 2)))
        * math.tanh(v / p["slip_speed"])
    ),
    "n": lambda u, v, q, p: p["force"] * q[0],
    "maxwell_damper ode": lambda u, v, q, p: q[0],
    "u5": lambda u, v, q, p: p["k5"] * u**5,
    "u2": lambda u, v, q, p: p["ke"] * u**2,
    "v3": lambda u, v, q, p: p["c3"] * v**3,
    "u2v": lambda u, v, q, p: p["cu"] * u**2 * v,
    "dead_band tanh": lambda u, v, q, p: -K * p["width"] * math.tanh(u / p["width"]),
}
STATIC: dict[str, Any] = {
    "exponential": lambda d, b, p: 0.02 * p["k2"] * (math.exp(d / 0.1) - 1.0 - d / 0.1),
    "d3": lambda d, b, p: p["kc"] * d**3,
    "bumper_maxwell ode": lambda d, b, p: b,
}


def sign(v: float) -> float:
    return math.tanh(v / 1e-3)


# Of the strange laws: over u, u', y, y' of the table, t, (q, q) and the parameters in turn, N.
STRANGE: dict[str, Any] = {
    "exponential_stiffness": lambda u, v, y, w, t, q, k, length: math.copysign(
        k * length * (math.exp(abs(u) / length) - 1 - abs(u) / length), u
    ),
    "saturating_stiffness": lambda u, v, y, w, t, q, k, a: k * a * math.tanh(u / a),
    "slack_stiffness": lambda u, v, y, w, t, q, k, a: (
        k / 2 * (u - a + math.hypot(u - a, 1e-4) - 1e-4)
    ),
    "root_friction": lambda u, v, y, w, t, q, c: c * v * math.hypot(v, 1e-3) ** -0.5,
    "cross_damping": lambda u, v, y, w, t, q, c: c * u * v**2,
    "one_sided_damping": lambda u, v, y, w, t, q, c: c * v**2 if v > 0 else 0.0,
    "position_friction": lambda u, v, y, w, t, q, c: c * abs(u) * sign(v),
    "square_position_friction": lambda u, v, y, w, t, q, c: c * u**2 * sign(v),
    "saturating_damping": lambda u, v, y, w, t, q, f, speed: f * math.tanh(v / speed),
    "damping_drift": lambda u, v, y, w, t, q, rate: C * rate * t * v,
    "warming_friction": lambda u, v, y, w, t, q, f, tau: f * math.exp(-t / tau) * sign(v),
    "cable_drag": lambda u, v, y, w, t, q, c: c * w,
    "cable_stiffness": lambda u, v, y, w, t, q, c: c * y**3,
    "dahl_friction": lambda u, v, y, w, t, q, f, a: f * q[0],
    "cubic_maxwell": lambda u, v, y, w, t, q, k, c: k * q[0] ** 3,
    "two_branch_maxwell": lambda u, v, y, w, t, q, k, tau: k * (q[0] + q[1]),
    "elastoplastic": lambda u, v, y, w, t, q, f, a: f * q[0],
}
# Over depth > 0, side and its q, N; over the closing speed, N.
STRANGE_SPRINGS: dict[str, Any] = {
    "hertz_bumper": lambda d, j, q, c: c * d**1.5,
    "quintic_bumper": lambda d, j, q, c: c * d**5,
    "one_sided_cubic": lambda d, j, q, c: 0.0 if j else c * d**3,
    "softening_bumper": lambda d, j, q, k, tau: -k * q * d,
}
STRANGE_DASHPOTS: dict[str, Any] = {
    "compression_dashpot": lambda w, c: c * w if w > 0 else 0.0,
    "cubic_bumper_damping": lambda w, c: c * w**3,
}
# d/dt of the two q over u', q and contact.
STRANGE_RATES: dict[str, Any] = {
    "dahl_friction": lambda v, q, on, f, a: [v / a * (1 - q[0] * sign(v)), 0.0],
    "cubic_maxwell": lambda v, q, on, k, c: [v - k / c * q[0] ** 3, 0.0],
    "two_branch_maxwell": lambda v, q, on, k, tau: [v - q[0] / tau, v - 10 * q[1] / tau],
    "elastoplastic": lambda v, q, on, f, a: [
        v / a * (1 - q[0] ** 20 * (1 + sign(1e3 * v * q[0])) / 2), 0.0,
    ],
    "softening_bumper": lambda v, q, on, k, tau: [(on[j] - q[j]) / tau for j in (0, 1)],
}  # fmt: skip


class Reference:
    """One effect by another formulation: a list of rates for an adaptive method of order eight."""

    def __init__(self, kind: EffectDefinition, p: dict[str, float]) -> None:
        self.kind, self.p = kind, p
        key = f"{kind.id} {kind.form}"
        form = kind.form if kind.id not in StrangeLaws._fields else ""
        self.law = LAWS.get(key) or LAWS.get(form)
        self.static = STATIC.get(key) or STATIC.get(form)
        self.pole = 2 * math.pi * 20.0 / math.sqrt(math.sqrt(2.0) - 1.0)
        self.m = M / p["ratio"] if kind.id == "mass_error" else M
        ratio = p["ratio"] if kind.id == "bumper_asymmetry" else 1.0
        self.kj = (2 * KJ * ratio / (1 + ratio), 2 * KJ / (1 + ratio))
        offset = p["offset"] if kind.id == "gap_offset" else 0.0
        self.gaps = (G + offset, G - offset)
        self.values = [p[parameter.name] for parameter in kind.parameters]
        self.drift = p["rate"] if kind.id == "gap_drift" else 0.0
        self.pull = p["force"] if kind.id == "adhesion" else 0.0

    def face(self, s: Float1D, j: int, on: list[bool]) -> tuple[float, float]:
        """(N_j, d_j')."""
        d, way = s[4 + j], 1 - 2 * j
        force, dash = self.kj[j] * d, CJ
        force += self.static(d, s[6 + j], self.p) if self.static else 0.0
        if self.kind.id == "hunt_crossley":
            dash += self.p["ch"] * 0.03 * math.tanh(d / 0.03)
        closing = way * (s[1] - s[3]) - self.drift
        if self.kind.id in STRANGE_SPRINGS:
            force += STRANGE_SPRINGS[self.kind.id](max(d, 0.0), j, s[6 + j], *self.values)
        push = force + dash * closing
        if self.kind.id in STRANGE_DASHPOTS:
            push += STRANGE_DASHPOTS[self.kind.id](closing, *self.values)
        if not on[j] and self.kind.id == "cubic_bumper_damping":
            roots = np.roots([self.values[0], 0.0, dash, force])
            return 0.0, float(roots[np.argmin(abs(roots.imag))].real)
        return (push, closing) if on[j] else (0.0, -force / dash)

    def rates(self, t: float, s: Float1D, on: list[bool]) -> list[float]:
        u, v, p = s[0] - s[2], s[1] - s[3], self.p
        (right, right_rate), (left, left_rate) = self.face(s, 0, on), self.face(s, 1, on)
        force = K * u + C * v + right - left
        force += self.law(u, v, s[6:], p) if self.law else 0.0
        force += K * u * p["rate"] * (t - H) if self.kind.id == "stiffness_drift" else 0.0
        if self.kind.id in STRANGE:
            force += STRANGE[self.kind.id](u, v, s[2], s[3], t - H, s[6:], *self.values)
        q, swing, pull = [0.0, 0.0], 0.0, 0.0
        if self.kind.id in STRANGE_RATES:
            q = STRANGE_RATES[self.kind.id](v, s[6:], on, *self.values)
        match self.kind.id:
            case "table_tilt":
                force += M * GRAVITY_M_S2 * math.sin(p["tilt"] * s[2])
            case "bouc_wen":
                speed, z, n = v * math.tanh(v / 1e-3), s[6], p["exponent"]
                loss = p["beta"] * speed * abs(z) ** (n - 1) * z + (1 - p["beta"]) * v * abs(z) ** n
                q[0] = (v - loss) / p["yield_displacement"]
            case "maxwell_damper":
                q[0] = p["k1"] * v - s[6] / p["tau"]
            case "bumper_maxwell":
                q = [p["kb"] * r - b / p["tau"] for r, b in
                     zip((right_rate, left_rate), s[6:], strict=True)]  # fmt: skip
            case "appendage":
                w = 2 * math.pi * p["frequency"]
                swing = -(w**2) * (s[6] - s[0]) - 2 * p["damping_ratio"] * w * (s[7] - s[1])
                q = [s[7], swing]
                pull = -p["mass"] * swing
            case "cubic_appendage":
                pull = p["mass"] * (p["cubic"] * (s[6] - s[0]) ** 3 + p["damping"] * (s[7] - s[1]))
                q = [s[7], -pull / p["mass"]]
            case "table_resonator":
                w, pull = 2 * math.pi * p["frequency"], p["coupling"] * (s[6] - s[0])
                own = -(w**2) * (s[6] - s[2]) - 0.04 * w * (s[7] - s[3])
                q = [s[7], own - pull / p["mass"]]
        table = self.pole * (-self.pole * s[2] - 2 * s[3]) + force / MT
        acc = (pull - force) / self.m
        return [s[1], acc, s[3], table, right_rate, left_rate, *q]

    def margin(self, t: float, s: Float1D, j: int, on: list[bool]) -> float:
        if on[j]:
            return self.face(s, j, on)[0] + self.pull
        return self.gaps[j] + self.drift * (t - H) + s[4 + j] - (1 - 2 * j) * (s[0] - s[2])

    def samples(self, s: Float1D, count: int) -> Float2D:
        """(8, count) states at the samples; the first comes H after the start."""
        at, t, on, solutions = np.arange(1, count + 1) * H, 0.0, [False, False], []
        while at[-1] > t:
            events: list[Any] = [lambda t, s, j=j: self.margin(t, s, j, on) for j in (0, 1)]
            for event in events:
                event.terminal, event.direction = True, -1
            part = solve_ivp(
                lambda t, s: self.rates(t, s, on), (t, at[-1]), s, "DOP853", at[at > t],
                events=events, rtol=1e-10, atol=1e-13, max_step=5e-3,
            )  # fmt: skip
            solutions.append(np.array(part.y).reshape(8, -1))
            if part.status != 1:
                break
            j = 0 if part.t_events[0].size else 1
            t, s, on[j] = part.t_events[j][0], part.y_events[j][0].copy(), not on[j]
        return np.concatenate(solutions, axis=1)
