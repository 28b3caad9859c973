"""Drives the model over samples, for the tests."""

import math

import numpy as np

from tests.model.reference import AG
from twin.model import closed_form
from twin.model.parameters import Parameters
from twin.model.solver import StateEstimate

U, V, A, F_R, F_L, U_R, U_L = range(7)


def run(
    p: Parameters, rate: float, base: np.ndarray, state: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(state, out, events) after the samples `base` from `state` or from rest."""
    state = closed_form.rest_state(p) if state is None else state.copy()
    out, events = np.empty((7, base.size)), np.zeros((4 * base.size + 10, 5))
    count = closed_form.advance_state(
        state, closed_form.discretized_params(p, rate), base, out, events
    )
    return state, out, events[:count]


def sine(frequency: float, rate: float, seconds: float, peak: float = AG) -> np.ndarray:
    """A at samples 1 .. n."""
    return peak * np.sin(2 * math.pi * frequency * np.arange(1, round(seconds * rate) + 1) / rate)


def kick(p: Parameters, speed: float) -> np.ndarray:
    """Rest, hit by a hammer: contacts that would pull then are released."""
    u, _, ur, ul, right, left, *_ = closed_form.rest_state(p)
    return restart(p, u, speed, ur, ul, right > 0, left > 0)


def restart(p: Parameters, *estimate, base: float = 0.0) -> np.ndarray:
    """The state at an estimate (u, v, u_r, u_l, contacts) with A = base."""
    return closed_form.restart_state(StateEstimate(0, *estimate), base, p)
