"""Branches as curves for figures, tables and the page: quantities, markers, descriptions."""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D
from table_io.units import GRAVITY_M_S2
from twin.drawing.panels import Canvas, Key
from twin.drawing.plot_style import GUIDE_COLOUR, LineStyle
from twin.dynamics.bifurcations import Bifurcation
from twin.dynamics.continuation import Branch, split_by_stability
from twin.dynamics.orbits import Orbit
from twin.dynamics.period_map import FREQUENCY, GAP, LEVEL

PERIOD_COLOURS = {
    1: "#111111", 2: "#1559b0", 3: "#2e9e5b", 4: "#7a3b9b", 5: "#c4161c", 6: "#b3730f",
}  # fmt: skip
LONG_PERIOD_COLOUR = "#6b7480"
CHAOS_COLOUR = "#f3d9e6"
BIFURCATION_MARKERS: dict[str, LineStyle] = {
    "fold": {"marker": "s", "mfc": "#c4161c"},
    "period doubling": {"marker": "^", "mfc": "#1559b0"},
    "pitchfork": {"marker": "D", "mfc": "#2e9e5b"},
    "Neimark-Sacker": {"marker": "*", "mfc": "#7a3b9b"},
    "grazing": {"marker": "o", "mfc": "white"},
}
MARKER_SIZE = {"s": 5.5, "^": 6.0, "D": 5.0, "*": 8.5, "o": 5.0}
Band = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Axis:
    """Name, label and unit factor (displayed = SI x factor) of a parameter at the human edge."""

    name: str
    label: str
    factor: float = 1.0


def make_axis(parameter: str) -> Axis:
    """Return the axis of a parameter: Hz, total gap in mm, level in g; SI for all others."""
    known = {
        FREQUENCY: Axis(FREQUENCY, "frequency in Hz"),
        GAP: Axis(GAP, "total gap in mm", 1e3),
        LEVEL: Axis(LEVEL, "peak table acceleration in g", 1 / GRAVITY_M_S2),
    }
    return known.get(parameter, Axis(parameter, f"{parameter} in SI units"))


@dataclass(frozen=True, slots=True)
class BranchQuantity:
    """A quantity of an orbit, in the unit of its label, which is `si` in SI."""

    key: str
    label: str
    si: float = 1.0

    def of(self, orbit: Orbit) -> float:
        """Return the value for an orbit."""
        match self.key:
            case "u_mm":
                return 1e3 * (orbit.extreme("u_max") - orbit.extreme("u_min")) / 2
            case "a_m_s2":
                return (orbit.extreme("a_max") - orbit.extreme("a_min")) / 2
            case "f_r_kn":
                return 1e-3 * orbit.extreme("f_r_max")
            case "f_l_kn":
                return -1e-3 * orbit.extreme("f_l_min")
            case _:
                raise ValueError(self.key)


QUANTITIES = (
    BranchQuantity("u_mm", "amplitude of u in mm", 1e-3),
    BranchQuantity("a_m_s2", "amplitude of total acceleration in m/s²"),
    BranchQuantity("f_r_kn", "right contact force in kN", 1e3),
    BranchQuantity("f_l_kn", "left contact force in kN", 1e3),
)
FREE_QUANTITIES = QUANTITIES[:2]


@dataclass(frozen=True, slots=True)
class MeasuredCurve:
    """Measured points over the parameter: label, color, x, and y by key of `QUANTITIES`."""

    label: str
    colour: str
    x: Float1D
    values: dict[str, Float1D]


@dataclass(frozen=True, eq=False)
class BranchSet:
    """Branches over one parameter, with the ranges of it in which motion is chaotic."""

    branches: tuple[Branch, ...]
    chaotic: tuple[Band, ...] = ()
    measured: tuple[MeasuredCurve, ...] = ()

    @cached_property
    def axis(self) -> Axis:
        return make_axis(self.branches[0].parameter if self.branches else FREQUENCY)

    @cached_property
    def has_contact(self) -> bool:
        """Whether any orbit touches a bumper."""
        return any(
            orbit.extreme("f_r_max") > 0 or orbit.extreme("f_l_min") < 0
            for branch in self.branches
            for orbit in (point.orbit for point in branch.points)
        )

    @property
    def quantities(self) -> tuple[BranchQuantity, ...]:
        return QUANTITIES if self.has_contact else FREE_QUANTITIES

    def x(self, branch: Branch) -> Float1D:
        """Return the displayed values of the parameter along a branch, (points,)."""
        return branch.values * self.axis.factor

    def y(self, branch: Branch, quantity: BranchQuantity) -> Float1D:
        """Return a quantity along a branch, (points,)."""
        return np.array([quantity.of(point.orbit) for point in branch.points])

    @property
    def bifurcations(self) -> list[tuple[Branch, Bifurcation]]:
        """All bifurcations with their branches, in order of the parameter."""
        pairs = [(branch, item) for branch in self.branches for item in branch.bifurcations]
        return sorted(pairs, key=lambda pair: pair[1].value)


def describe_bifurcation(bifurcation: Bifurcation) -> str:
    """Describe in a sentence what happens at a bifurcation."""
    match bifurcation.kind:
        case "fold":
            return "a stable and an unstable motion meet and vanish: a jump"
        case "period doubling":
            return "the motion repeats only after twice the period"
        case "pitchfork":
            return "the motion loses or regains its symmetry"
        case "Neimark-Sacker":
            return "a second frequency appears: quasi-periodic motion"
        case _:
            where = {"both": "both bumpers", "": "a bumper"}.get(
                bifurcation.side, f"the {bifurcation.side} bumper"
            )
            event = (
                "a contact parts in two on"
                if bifurcation.guard == "push"
                else "a contact appears or vanishes on"
            )
            turn = ", and the branch turns back: a jump" if bifurcation.turns_back else ""
            return f"{event} {where}{turn}"


def format_multiplier(value: complex) -> str:
    """Format a Floquet multiplier, real or complex."""
    if abs(value.imag) < 1e-12 * max(1.0, abs(value)):
        return f"{value.real:.4g}"
    sign = "+" if value.imag >= 0 else "−"
    return f"{value.real:.3g} {sign} {abs(value.imag):.3g}i"


def count_impacts(orbit: Orbit) -> tuple[int, int]:
    """Return the contact onsets (right, left) of an orbit over all its periods."""
    return round(orbit.extreme("onsets_r")), round(orbit.extreme("onsets_l"))


def round_to(values: Float1D, digits: int = 5) -> list[float | None]:
    """Return the values with `digits` significant digits; None for those that are not finite."""
    return [
        float(f"{value:.{digits}g}") if math.isfinite(value) else None for value in values.tolist()
    ]


def period_colour(periods: int) -> str:
    """Return the color of the branches that repeat after `periods` periods of the drive."""
    return PERIOD_COLOURS.get(periods, LONG_PERIOD_COLOUR)


def plot_branches(
    ax: Canvas, branches: BranchSet, quantity: BranchQuantity, scale: float = 1.0
) -> None:
    """Draw `scale` times a quantity of the branches into `ax`, measured points, chaotic bands."""
    for low, high in branches.chaotic:
        factor = branches.axis.factor
        ax.axvspan(factor * low, factor * high, color=CHAOS_COLOUR, lw=0, zorder=0.4)
    for curve in branches.measured:
        ax.plot(
            curve.x, scale * curve.values[quantity.key], marker="o", ls="", color=curve.colour,
            ms=5.5, alpha=0.55, mec="none", zorder=1.5,
        )  # fmt: skip
    for branch in branches.branches:
        x, y = branches.x(branch), scale * branches.y(branch, quantity)
        colour = period_colour(branch.points[0].orbit.periods)
        for first, last, stable in split_by_stability(branch.stable.tolist()):
            piece = slice(first, last + 1)
            style: LineStyle = {"ls": "-", "lw": 1.5} if stable else {"ls": (0, (4, 2.2))}
            ax.plot(x[piece], y[piece], color=colour, **style)
        for bifurcation in branch.bifurcations:
            marker = BIFURCATION_MARKERS[bifurcation.kind]
            ax.plot(
                branches.axis.factor * bifurcation.value, y[bifurcation.index], ls="",
                mec="#111111", mew=0.7, ms=MARKER_SIZE[marker["marker"]], zorder=3, **marker,
            )  # fmt: skip
    ax.set_ylabel(quantity.label)
    ax.set_ylim(bottom=0)


def list_branch_keys(branches: BranchSet) -> list[Key]:
    """Return the legend of `plot_branches`: what is drawn, and nothing else."""
    periods = sorted({branch.points[0].orbit.periods for branch in branches.branches})
    kinds = {bifurcation.kind for _, bifurcation in branches.bifurcations}
    keys = [
        Key("stable", {"color": GUIDE_COLOUR, "lw": 1.5}),
        Key("unstable", {"color": GUIDE_COLOUR, "ls": (0, (4, 2.2))}),
    ]
    if periods not in ([], [1]):
        keys += [Key(f"period {n}", {"color": period_colour(n), "lw": 3}) for n in periods]
    keys += [
        Key(
            kind,
            {"ls": "", "mec": "#111111", "mew": 0.7, "ms": MARKER_SIZE[marker["marker"]]} | marker,
        )
        for kind, marker in BIFURCATION_MARKERS.items()
        if kind in kinds
    ]
    if branches.chaotic:
        keys.append(Key("chaos", {"color": CHAOS_COLOUR}, is_patch=True))
    keys += [
        Key(curve.label, {"ls": "", "marker": "o", "color": curve.colour, "alpha": 0.55, "ms": 5.5})
        for curve in branches.measured
    ]
    return keys
