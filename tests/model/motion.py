"""Drives the model over samples, for the tests."""

import math

import numpy as np

from twin.model import exact
from twin.model.parameters import Parameters

from .reference import AG

U, V, A, F_R, F_L, U_R, U_L = range(7)


def run(p: Parameters, rate: float, base: np.ndarray, state: np.ndarray | None = None):
    """(state, out, events) after the samples `base` from `state` or from rest."""
    state = exact.rest(p) if state is None else state.copy()
    out, events = np.empty((7, base.size)), np.zeros((4 * base.size + 10, 5))
    count = exact.advance_logged(state, exact.constants(p, rate), base, out, events)
    return state, out, events[:count]


def sine(frequency: float, rate: float, seconds: float, peak: float = AG) -> np.ndarray:
    """A at samples 1 .. n."""
    return peak * np.sin(2 * math.pi * frequency * np.arange(1, round(seconds * rate) + 1) / rate)


def kicked(p: Parameters, speed: float) -> np.ndarray:
    """Rest, hit by a hammer: contacts that would pull then are released."""
    u, _, ur, ul, right, left, *_ = exact.rest(p)
    return exact.restart(u, speed, ur, ul, right > 0, left > 0, 0.0, p)
