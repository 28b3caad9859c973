"""Branches of the model in the PRC plot, and how far the motion is from the end of its own."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float2D
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.records import PrcPoint, RunStart
from twin.dynamics.attractors import Attractor
from twin.dynamics.basins import StartGrid, compute_basins
from twin.dynamics.continuation import Branch, split_by_stability
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.main_branches import follow_sweep_branches
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.model.stepped_sine import EXTREME_NAMES
from twin.viewer.plots import GREY, Rgb

MAX_MISMATCH = 0.3  # of the amplitude: farther from the measured motion a branch is another one
DASH_SHARE = 0.012  # of the height of the plot: length of the dashes of an unstable branch
BASIN_STARTS = 41  # in u and in v
BASIN_RANGE = 1.5  # of the largest amplitudes: range of the starts


@dataclass(frozen=True, slots=True)
class FoldAhead:
    """The fold at which the motion's branch ends in the direction of travel.

    `basin_share` of the starts within +-`u_limit` m and +-`v_limit` m/s lead to this motion.
    """

    fold_hz: float
    distance_hz: float
    basin_share: float
    u_limit: float
    v_limit: float


@dataclass(frozen=True, eq=False)
class ModelBranches:
    """Main branches of a run's model over its sweep; without any for models with force laws."""

    model: Model
    level_m_s2: float
    branches: tuple[Branch, ...]

    @classmethod
    def from_start(cls, start: RunStart) -> "ModelBranches | None":
        """Follow the branches of the model of a run; None without a model or a sweep."""
        try:
            profile = parse_toml(start.profile_toml, Profile, "profile")
            config = parse_toml(start.model_toml, ModelConfig, "model")
            model = config.build_model(profile.specimen)
        except ValueError:
            return None
        levels = [step.acceleration_m_s2 for step in start.steps]
        branches = follow_sweep_branches(model, (step.frequency_hz for step in start.steps), levels)
        return cls(model, levels[0], branches) if branches else None

    @cached_property
    def u_star_m(self) -> float:
        """Free-flight maximum by which eta_d is normalized."""
        return free_flight_resonance(self.model.parameters, self.level_m_s2)[0]

    def eta_d(self, branch: Branch) -> np.ndarray:
        """Return eta_d along a branch, (points,)."""
        return (branch.extreme("u_max") - branch.extreme("u_min")) / (2 * self.u_star_m)

    def draw(self) -> list[tuple[Rgb, Float2D]]:
        """Return (color, (point, 2) in Hz and eta_d): stable lines, unstable dashes."""
        strips: list[tuple[Rgb, Float2D]] = []
        for branch in self.branches:
            points = np.column_stack((branch.values, self.eta_d(branch)))
            for first, last, is_stable in split_by_stability(branch.stable.tolist()):
                piece = points[first : last + 1]
                pieces = [piece] if is_stable else _cut_into_dashes(piece)
                strips += [(GREY, part) for part in pieces]
        return strips

    def find_fold(self, point: PrcPoint) -> FoldAhead | None:
        """Return the fold ahead on the branch of the measured motion; None without one."""
        if point.measured is None or not math.isfinite(point.measured.eta_d):
            return None
        nearest, mismatch = None, MAX_MISMATCH
        for branch in self.branches:
            eta_d, values = self.eta_d(branch), branch.values
            for index in np.flatnonzero(branch.stable[:-1] & branch.stable[1:]):
                ends = values[index : index + 2]
                if not ends.min() <= point.frequency_hz <= ends.max() or ends[0] == ends[1]:
                    continue
                share = (point.frequency_hz - ends[0]) / (ends[1] - ends[0])
                eta = eta_d[index] + share * (eta_d[index + 1] - eta_d[index])
                if abs(eta / point.measured.eta_d - 1) < mismatch:
                    nearest, mismatch = (branch, int(index)), abs(eta / point.measured.eta_d - 1)
        if nearest is None:
            return None
        fold_hz = _walk_to_fold(*nearest, 1.0 if point.direction == "forward" else -1.0)
        if fold_hz is None:
            return None
        amplitude = point.measured.eta_d * self.u_star_m
        share, grid = self._measure_basin(point.frequency_hz, amplitude)
        return FoldAhead(
            fold_hz, abs(fold_hz - point.frequency_hz), share, float(grid.u[-1]), float(grid.v[-1])
        )

    def _measure_basin(self, frequency_hz: float, amplitude: float) -> tuple[float, StartGrid]:
        """Return (share of the starts that lead to the motion of this amplitude in m, starts)."""
        largest = max(
            float((branch.extreme("u_max") - branch.extreme("u_min")).max()) / 2
            for branch in self.branches
        )
        u_limit = BASIN_RANGE * largest
        grid = StartGrid.from_limits(
            u_limit, u_limit * 2 * math.pi * frequency_hz, BASIN_STARTS, BASIN_STARTS
        )
        basins = compute_basins(make_period_map(self.model, frequency_hz, self.level_m_s2), grid)
        shares = [
            share
            for attractor, share in zip(basins.attractors, basins.fractions, strict=True)
            if abs(_amplitude(attractor) / amplitude - 1) < MAX_MISMATCH
        ]
        return float(sum(shares)), grid


def _walk_to_fold(branch: Branch, index: int, sign: float) -> float | None:
    """Return the frequency at which a branch turns back, from a segment in the direction `sign`."""
    values = branch.values
    step = 1 if (values[index + 1] - values[index]) * sign > 0 else -1
    position = index if step < 0 else index + 1
    while 0 <= position + step < values.size:
        if (values[position + step] - values[position]) * sign < 0:
            return float(values[position])
        position += step
    return None


def _cut_into_dashes(line: Float2D) -> list[Float2D]:
    """Cut a line into dashes whose length and spacing are `DASH_SHARE` of its extent."""
    extent = np.maximum(np.ptp(line, axis=0), 1e-12)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*(np.diff(line, axis=0) / extent).T))])
    edges = np.arange(0.0, length[-1], 2 * DASH_SHARE)
    return [
        np.column_stack([np.interp([edge, edge + DASH_SHARE], length, column) for column in line.T])
        for edge in edges
    ]


def _amplitude(attractor: Attractor) -> float:
    """Return half of the swing of u in m of an attractor."""
    lowest = attractor.extremes[:, EXTREME_NAMES.index("u_min")].min()
    return float(attractor.u_max - lowest) / 2
