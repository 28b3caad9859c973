"""Recordings of a small independent simulation, of specimens of any size.

A mass on a spring and a dashpot between two bumpers, with one further law; nothing of `twin` is in
it. The accelerometer follows from the force balance, so the recording obeys its law exactly but for
the noise.
"""

import math
from collections.abc import Container
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from table_io.block import Block, Float2D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from twin.discovery.discover import PreparedLog
from twin.discovery.signals import build_signals
from twin.model.model import Model
from twin.model.parameters import Parameters

RATE_HZ, REST_S, SECONDS, PARTS = 200.0, 3.0, 24.0, 8
MASS, K, C, K_J, C_J, GAP = 550.0, 36e3, 1.1e3, 120e3, 900.0, 6e-3
MOTION = ("rel_disp_m", "mass_acc_m_s2", "table_acc_m_s2")
CHANNELS = (*MOTION, *RIGHT_CELLS, *LEFT_CELLS)


@dataclass(frozen=True)
class Hidden:
    """A law that the start model lacks: its name and coefficients; a gap without bumper is inf."""

    name: str = ""
    a: float = 0.0
    b: float = 1.0
    gap: float = math.inf
    has_left_bumper: bool = True

    @property
    def gaps_m(self) -> tuple[float, float]:
        """Right and left gap."""
        return self.gap, self.gap if self.has_left_bumper else math.inf


@cache
def simulate(hidden: Hidden) -> Float2D:
    """Return the true (channel, sample) in SI: a rest, then a band-limited motion of the table."""
    random = np.random.default_rng(7)
    time = np.arange(round(SECONDS * RATE_HZ * PARTS)) / (RATE_HZ * PARTS)
    hz = np.arange(0.5, 4.0, 1.0 / SECONDS)
    phases = random.uniform(0, 2 * np.pi, hz.size)
    table_acc = np.zeros(time.size)
    for f, phase in zip(hz, phases, strict=True):
        table_acc += np.cos(2 * np.pi * f * time + phase)
    table_acc *= 0.6 / table_acc.std() * np.sin(0.5 * np.pi * np.minimum(time, 1.0)) ** 2
    h, u, v_half, relative_acc, z, right, left = float(time[1]), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    out = np.empty((len(CHANNELS), time.size // PARTS))
    name, a, b, (gap_r, gap_l) = hidden.name, hidden.a, hidden.b, hidden.gaps_m
    for k, acc in enumerate(table_acc.tolist()):
        v = v_half + 0.5 * h * relative_acc  # leapfrog: the velocity is known half a step before
        force = K * u + C * v
        if name == "cubic_stiffness":
            force += a * u**3
        elif name == "quadratic_damping":
            force += a * v * abs(v)
        elif name == "coulomb_friction":
            force += a * math.tanh(v / 2e-3)
        elif name == "bouc_wen":
            force += a * z
        bumpers = []
        for sign, face, gap in ((1.0, right, gap_r), (-1.0, left, gap_l)):
            depth = sign * u - gap
            push = 0.0
            if depth >= face:
                push = K_J * depth + C_J * sign * v
                push += a * depth**2 if name == "bumper_hardening" else 0.0
                push += a * depth * sign * v if name == "hunt_crossley" else 0.0
            bumpers.append(max(push, 0.0))
        push_r, push_l = bumpers
        cells = (0.5 * push_r, 0.5 * push_r, 0.5 * push_l, 0.5 * push_l)
        if k % PARTS == 0:
            out[:, k // PARTS] = (u, -(force + push_r - push_l) / MASS, acc, *cells)
        relative_acc = -(force + push_r - push_l) / MASS - acc
        v_half += h * relative_acc
        u += h * v_half
        z += h * (v_half - 0.5 * (abs(v_half) * z * abs(z) + v_half * z * z)) / b
        right = u - gap_r if push_r > 0 else right * math.exp(-h * K_J / C_J)
        left = -u - gap_l if push_l > 0 else left * math.exp(-h * K_J / C_J)
    return np.concatenate([np.zeros((len(CHANNELS), round(REST_S * RATE_HZ))), out], axis=1)


def record(
    hidden: Hidden, force: float = 1.0, length: float = 1.0, noise: float = 0.003, seed: int = 3,
    without: Container[str] = (),
) -> PreparedLog:  # fmt: skip
    """Return the noisy recording, with mass and forces, or all lengths, multiplied by a factor."""
    return prepare(record_block(hidden, force, length, noise, seed, without), hidden, force, length)


def record_block(
    hidden: Hidden, force: float = 1.0, length: float = 1.0, noise: float = 0.003, seed: int = 3,
    without: Container[str] = (),
) -> Block:  # fmt: skip
    """Return the measured block of `record`, without some channels."""
    true = simulate(hidden)
    channels = CHANNELS if math.isfinite(hidden.gap) else MOTION
    true = true[: len(channels)]
    draw = np.random.default_rng(seed).standard_normal(true.shape)
    rms = true.std(axis=1, keepdims=True)
    rms[len(MOTION) :] = np.maximum(rms[len(MOTION) :], 10.0)  # idle load cells are noisy too
    values = true + noise * rms * draw
    values[: len(MOTION)] *= length
    values[len(MOTION) :] *= force * length
    label = np.full(values.shape[1], int(Label.SETTLE), dtype=np.int64)
    label[: round(REST_S * RATE_HZ)] = int(Label.REST)
    outside = np.full(values.shape[1], -1, dtype=np.int64)
    kept = [k for k, name in enumerate(channels) if name not in without]
    names = tuple(channels[k] for k in kept)
    return Block("meas", 0, RATE_HZ, names, values[kept], outside, label, outside.copy())


def prepare(block: Block, hidden: Hidden, force: float = 1.0, length: float = 1.0) -> PreparedLog:
    """Return the log of a block, with the mass and the gaps of the specimen."""
    right, left = (length * gap for gap in hidden.gaps_m)
    return PreparedLog(build_signals((block,), "short", force * MASS, (right, left)), 0.0)


def start_model(force: float = 1.0) -> Model:
    """Return a model to start from, without the hidden law, of a specimen of this size."""
    base = Parameters(MASS, 30e3, 900.0, 150e3, 700.0, 150e3, 700.0, math.inf, math.inf)
    scaled = {key: force * value for key, value in base.as_dict().items()}
    return Model(replace(base, **scaled))
