"""Effects that may be present although recordings do not show them: hidden by noise or by the base.

From the linear screening about a fitted set. A law that K, C and the other free parameters imitate,
as they do any law at one frequency and one amplitude, has an interval without end: the recordings
are blind to it, and that the residual is noise says nothing about it.
"""

import math
from dataclasses import dataclass

import numpy as np

from twin.discovery.candidates import Candidate
from twin.discovery.least_squares import INTERVAL_SIGMA
from twin.discovery.parameters import STIFFNESS
from twin.discovery.screening import NormalEquations, Variant, build_normal_equations
from twin.discovery.selection import FittedSet, SelectionProblem

FORCE_LAWS = ("force", "linear")  # by `Effect.acts`: what has a form and a size
# of an amplitude's curvature: with less left by the base, the recordings do not show it
MIN_INFORMATION_SHARE = 1e-6
# Largest force of an effect that recordings may hide, of that of the spring of the damper (rms). At
# 5 % of noise a sweep hides 2 % at most, one frequency 6 to 8 %.
MAX_HIDDEN_SHARE = 0.05


@dataclass(frozen=True, eq=False)
class UndetectedEffect:
    """Effect as large as the recordings may hide it: the end of the 95 % interval of its amplitude.

    Or as large as asked for, if the interval has no end before that.
    """

    candidate: Candidate
    shape: tuple[float, ...]
    amplitude: float  # in the unit of the candidate's


@dataclass(frozen=True, eq=False)
class _AmplitudeEstimate:
    """Estimate of the amplitude of a variant, in columns of norm 1, refitted with the base."""

    variant: Variant
    amplitude: float
    information: float  # of the amplitude, of 1 without the base

    @property
    def gain(self) -> float:
        """Residual squares that the variant would remove."""
        return self.amplitude**2 * self.information

    @property
    def half_interval(self) -> float:
        if self.information < MIN_INFORMATION_SHARE:
            return math.inf
        return INTERVAL_SIGMA / math.sqrt(self.information)


def find_hidden_effects(problem: SelectionProblem, best: FittedSet) -> tuple[UndetectedEffect, ...]:
    """Return each further force law as large as the noise may hide it, where it is not blind."""
    equations, estimates = _estimate_amplitudes(problem, best)
    hidden = []
    for variants in estimates.values():
        visible = [each for each in variants if each.information >= MIN_INFORMATION_SHARE]
        if visible:
            best_fit = max(visible, key=lambda each: each.gain)
            hidden.append(_bound_effect(equations, best_fit, math.inf))
    return tuple(hidden)


def find_blind_spots(problem: SelectionProblem, best: FittedSet) -> tuple[UndetectedEffect, ...]:
    """Return the force laws that could be large in any form without leaving more than noise.

    Each as large as `MAX_HIDDEN_SHARE` of the spring, in the form that the recordings show best.
    """
    equations, estimates = _estimate_amplitudes(problem, best)
    spring = _measure_spring(equations, best)
    blind = []
    for variants in estimates.values():
        effect = variants[0].variant.candidate.effect
        if effect is None or effect.acts not in FORCE_LAWS:
            continue  # an error of the set-up, which has no size to compare
        clearest = min(variants, key=lambda each: each.half_interval)
        if clearest.half_interval > MAX_HIDDEN_SHARE * spring:
            blind.append(_bound_effect(equations, clearest, MAX_HIDDEN_SHARE * spring))
    return tuple(blind)


def _estimate_amplitudes(
    problem: SelectionProblem, best: FittedSet
) -> tuple[NormalEquations, dict[str, list[_AmplitudeEstimate]]]:
    """Return the normal equations about a set, and the estimates of every further force law."""
    library = [
        candidate
        for candidate in problem.library
        if not candidate.channel and candidate.name not in best.names
    ]
    equations = build_normal_equations(
        problem.log_residuals, best.fit.parameters, library, problem.mapper
    )
    hessian, gradient = equations.hessian.sum(axis=0), equations.gradient.sum(axis=0)
    base = slice(0, equations.base_count)
    estimates: dict[str, list[_AmplitudeEstimate]] = {}
    for variant in equations.variants:
        k = variant.column
        if not hessian[k, k] > 0:
            continue  # it changes no force in these recordings
        absorbed = np.linalg.lstsq(hessian[base, base], hessian[base, k], rcond=1e-12)[0]
        information = float(hessian[k, k] - hessian[base, k] @ absorbed)
        slope = float(gradient[k] - gradient[base] @ absorbed)
        amplitude = -slope / information if information >= MIN_INFORMATION_SHARE else 0.0
        estimates.setdefault(variant.candidate.name, []).append(
            _AmplitudeEstimate(variant, amplitude, information)
        )
    return equations, estimates


def _measure_spring(equations: NormalEquations, best: FittedSet) -> float:
    """Return the norm of the force of the damper's spring in residuals over the noise; inf without.

    Without a free stiffness no effect can be compared with it.
    """
    for column, free in enumerate(best.fit.parameters.free):
        if free.key == STIFFNESS:
            return abs(best.fit.parameters.values[free.key]) * float(equations.scale[column])
    return math.inf


def _bound_effect(
    equations: NormalEquations, estimate: _AmplitudeEstimate, limit: float
) -> UndetectedEffect:
    """Return the effect at the end of its interval on the side of the estimate, up to a limit."""
    variant, candidate = estimate.variant, estimate.variant.candidate
    end = min(abs(estimate.amplitude) + estimate.half_interval, limit)
    sign = variant.sign or math.copysign(1.0, estimate.amplitude)
    free = candidate.amplitude
    value = candidate.vanishing + sign * end / float(equations.scale[variant.column])
    return UndetectedEffect(candidate, variant.shape, min(max(value, free.low), free.high))
