"""Result of `branches` as classes: the content of branches.json, in the order of its keys.

All values in SI; `value` is that of the parameter.
"""

from twin.drawing.branch_curves import BranchSet, count_impacts
from twin.dynamics.bifurcations import Bifurcation
from twin.dynamics.continuation import BranchEnd, BranchPoint
from twin.results.contract import Contract, Real


class OrbitEntry(Contract):
    """Periodic motion at a point of a branch; the largest Floquet multiplier comes first."""

    value: float
    u_max_m: Real
    u_min_m: Real
    a_max_m_s2: Real
    a_min_m_s2: Real
    force_r_n: Real
    force_l_n: Real
    impacts_right: int
    impacts_left: int
    stable: bool
    multipliers: list[tuple[Real, Real]]  # real and imaginary parts

    @classmethod
    def from_point(cls, point: BranchPoint) -> "OrbitEntry":
        """Return the motion of a point of a branch."""
        orbit = point.orbit
        right, left = count_impacts(orbit)
        return cls(
            value=point.value,
            u_max_m=orbit.extreme("u_max"),
            u_min_m=orbit.extreme("u_min"),
            a_max_m_s2=orbit.extreme("a_max"),
            a_min_m_s2=orbit.extreme("a_min"),
            force_r_n=orbit.extreme("f_r_max"),
            force_l_n=orbit.extreme("f_l_min"),
            impacts_right=right,
            impacts_left=left,
            stable=orbit.stable,
            multipliers=[(value.real, value.imag) for value in orbit.multipliers.tolist()],
        )


class EndEntry(Contract):
    """Why a branch ends, and where; the residual where no motion was found."""

    reason: str
    value: float
    residual: Real

    @classmethod
    def from_end(cls, end: BranchEnd) -> "EndEntry":
        """Return an end of a branch."""
        return cls(reason=end.reason, value=end.value, residual=end.residual)


class BifurcationEntry(Contract):
    """Bifurcation of a branch after its point `index`."""

    kind: str
    value: float
    index: int
    frequency_hz: float
    level_m_s2: float
    side: str
    turns_back: bool

    @classmethod
    def from_bifurcation(cls, bifurcation: Bifurcation) -> "BifurcationEntry":
        """Return a bifurcation of a branch."""
        return cls(
            kind=bifurcation.kind,
            value=bifurcation.value,
            index=bifurcation.index,
            frequency_hz=bifurcation.orbit.frequency_hz,
            level_m_s2=bifurcation.orbit.acceleration_m_s2,
            side=bifurcation.side,
            turns_back=bifurcation.turns_back,
        )


class BranchEntry(Contract):
    """Branch of motions that repeat after `periods` of the table."""

    periods: int
    ends: list[EndEntry]
    bifurcations: list[BifurcationEntry]
    points: list[OrbitEntry]


class BranchDiagram(Contract):
    """Every branch, bifurcation and chaotic range over a parameter."""

    title: str
    parameter: str
    branches: list[BranchEntry]
    chaotic: list[tuple[float, float]]

    @classmethod
    def from_branches(cls, branches: BranchSet, title: str) -> "BranchDiagram":
        """Return the diagram of branches over one parameter."""
        return cls(
            title=title,
            parameter=branches.axis.name,
            branches=[
                BranchEntry(
                    periods=branch.points[0].orbit.periods,
                    ends=[EndEntry.from_end(end) for end in branch.ends],
                    bifurcations=[
                        BifurcationEntry.from_bifurcation(item) for item in branch.bifurcations
                    ],
                    points=[OrbitEntry.from_point(point) for point in branch.points],
                )
                for branch in branches.branches
            ],
            chaotic=list(branches.chaotic),
        )
