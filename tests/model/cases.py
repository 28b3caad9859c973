"""Every effect of the table with values that show, and drives, for laws over all of them."""

import math

import numpy as np

from tests.model.reference import AG, snm
from twin.laws.library import EFFECTS
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import StateEstimate

RATE_HZ = 2000.0
FORCES = [e for e in EFFECTS if e.acts in ("force", "linear")]


def typical(effect) -> dict[str, float]:
    return {parameter.name: parameter.typical for parameter in effect.parameters}


def vanishing(effect) -> dict[str, float]:
    return {
        p.name: p.typical if p.vanishing is None else p.vanishing for p in effect.parameters
    }  # fmt: skip


def channel(effect) -> str:
    return "mass_acc_m_s2" if effect.acts == "sensor" else ""


def having(*effects, base=None, values=typical) -> Model:
    """The SNM at G4 (or `base`) with these effects."""
    model = Model(snm() if base is None else base)
    for effect in effects:
        model = model.with_effect(effect.id, channel(effect), **values(effect))
    return model


def everything(base=None) -> Model:
    return having(*[e for e in EFFECTS if e.acts != "sensor"], base=base)


def noisy(seconds: float, seed: int = 3, rate: float = RATE_HZ, peak: float = 4 * AG) -> np.ndarray:
    """A random drive with a few Hz in it that makes contacts and reversals."""
    n, random = round(seconds * rate), np.random.default_rng(seed)
    t = np.arange(1, n + 1) / rate
    parts = zip(random.uniform(0.5, 6, 6), random.uniform(0, 2 * math.pi, 6), strict=True)
    return peak / 6 * sum(np.sin(2 * math.pi * f * t + phase) for f, phase in parts)


def drive(
    model: Model, base: np.ndarray, start: StateEstimate | None = None, rate: float = RATE_HZ
):
    """(state, out) after the samples."""
    solver = prepare_solver(model, rate)
    state = solver.rest_state() if start is None else solver.restart_state(start)
    out = np.empty((7, base.size))
    solver.advance(state, base, 0.01 * base, out)
    return state, out
