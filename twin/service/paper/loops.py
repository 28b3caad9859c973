"""Force-displacement loops in primary resonance: Figs. 3, 6 and 8, and the histories of Fig. 7."""

from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.service.paper.cases import Case
from twin.service.paper.findings import coexisting
from twin.service.paper.look import (
    AT_REST,
    COLOUR,
    DIRECTIONS,
    GUIDE,
    OF_GAP,
    UNSTABLE,
    Drawing,
    Drawings,
    bumper_loops,
    contact_bands,
    directions_key,
    letter,
    mass_loop,
    minus,
    obstacles,
    pen,
)
from twin.service.paper.players import Motion
from twin.service.paper.rig import Rig
from twin.service.paper.study import COEXISTING_HZ, Study

SETTLE = 200  # cycles at a frequency before its motion is drawn
PAPER_HZ = {"G4": 3.4, "G0": 4.8, "G-1": 6.0, "G-2": 7.3, "G-10": 7.6}
HISTORY_CYCLES = 3
ZOOM_MM = 3.4


@dataclass(frozen=True, slots=True, eq=False)
class Resonant:
    """The steady motions of a gap in its resonance, and how its panel is called."""

    case: Case
    hz: float
    motions: dict[str, Motion]

    @property
    def title(self) -> str:
        name, paper = minus(self.case.name), PAPER_HZ[self.case.name]
        said = "" if abs(paper - self.hz) < 1e-9 else f"  (paper: {paper:g} Hz)"
        return f"{name}, $f$ = {self.hz:.4g} Hz{said}"


def draw(found: Study, rig: Rig | None) -> Drawings:
    """Figs. 3, 6, 7 and 8, of the model only."""
    if rig is not None:
        return
    resonant = {name: _resonant(found, name) for name in PAPER_HZ}
    yield _all_gaps(found)
    yield _pairs(found, [resonant[name] for name in ("G4", "G0", "G-1")], ("6", "fig06_loops"))
    yield _histories([resonant[name] for name in ("G4", "G0", "G-1")])
    yield _pairs(found, [resonant[name] for name in ("G-2", "G-10")], ("8", "fig08_loops"))


def steady(found: Study, name: str, hz: float, direction: str, cycles: int) -> Motion:
    """The steady motion that slow passage in this direction leads to."""
    case = found.cases[name]
    begin = found.slow[name].state(hz, direction)
    a = case.acceleration
    state = case.player.sweep([hz], a, SETTLE, begin).states[0]
    return case.player.motion(hz, a, state, cycles)


def _resonant(found: Study, name: str) -> Resonant:
    """At 3.4 Hz for G4, in the middle of a left hysteresis, else where eta_d is largest."""
    fold = found.folds[name]
    hz = found.slow[name].peak_hz
    if name == "G4":
        hz = COEXISTING_HZ
    elif fold is not None:
        hz = round((fold.forward_hz + fold.backward_hz) / 2, 3)
    motions = {one: steady(found, name, hz, one, HISTORY_CYCLES) for one in DIRECTIONS}
    return Resonant(found.cases[name], hz, motions)


def _once(motion: Motion) -> Motion:
    """The first of `HISTORY_CYCLES` cycles."""
    end = motion.u.size // HISTORY_CYCLES
    return Motion(*(getattr(motion, name)[:end] for name in Motion.__slots__))


def _all_gaps(found: Study) -> Drawing:
    figure = Figure(figsize=(11, 5.6))
    mass_ax, bumper_ax = figure.subplots(1, 2)
    insets = [
        mass_ax.inset_axes((0.61, 0.05, 0.38, 0.34)),
        bumper_ax.inset_axes((0.06, 0.61, 0.36, 0.34)),
    ]  # fmt: skip
    for name, case in found.cases.items():
        place, direction = found.slow[name].peak
        hz = float(found.slow[name].frequency[place])
        motion = steady(found, name, hz, direction, 1)
        look: dict[str, Any] = {"color": OF_GAP[name], "lw": 1.4}
        for ax in (mass_ax, insets[0]):
            mass_loop(ax, motion, case.parameters.mass, True, **look)
        for ax in (bumper_ax, insets[1]):
            if name == "G∞":
                continue
            bumper_loops(ax, motion, True, **look)
            if case.parameters.gap_r > 0:
                obstacles(case.parameters, ax.axvline, **{**look, "lw": 0.8})
        if 0 < case.parameters.gap_r < 1:
            obstacles(case.parameters, mass_ax.axvline, **{**look, "lw": 0.8})
    for inset in insets:
        inset.set_xlim(-ZOOM_MM, ZOOM_MM)
        inset.set_ylim(-3.9, 3.9)
        inset.tick_params(labelsize=7)
        inset.set_title("small gaps", size=8)
        inset.set_zorder(3)
    letter(mass_ax, "a", "Mass")
    letter(bumper_ax, "b", "Bumpers")
    _label(mass_ax, "$u$ in mm", "$F_I$ in kN")
    _label(bumper_ax, "$v_j$ in mm", "$F_j$ in kN")
    handles = [Line2D([], [], color=OF_GAP[n], lw=2, label=minus(n)) for n in found.cases]
    handles.append(Line2D([], [], **AT_REST, label="bumper at rest"))
    figure.legend(handles=handles, loc="outside upper center", ncols=10)
    peaks = ", ".join(f"{minus(n)} {found.slow[n].peak_hz:.2f}" for n in found.cases)
    return Drawing(
        "fig03_loops", "3", "Loops in primary resonance, all gaps",
        "Force-displacement cycles in steady primary resonance: a mass, b bumpers. Dashed: initial "
        f"position of the bumpers for G > 0. Frequencies of the largest η_d in Hz: {peaks}.",
        figure,
    )  # fmt: skip


def _label(ax: Axes, x: str, y: str) -> None:
    ax.set_xlabel(x)
    ax.set_ylabel(y)
    ax.axhline(0, color=GUIDE, lw=0.5, zorder=0.6)


def _pairs(found: Study, shown: list[Resonant], names: tuple[str, str]) -> Drawing:
    """Top row mass, bottom row bumpers, a column a gap; forward and backward."""
    figure = Figure(figsize=(3.9 * len(shown) + (0 if len(shown) > 2 else 1), 7.4))
    axes = figure.subplots(2, len(shown), squeeze=False)
    for place, (top, bottom, one) in enumerate(zip(*axes, shown, strict=True)):
        letter(top, "abc"[place], one.title)
        letter(bottom, "abcdef"[place + len(shown)])
        p = one.case.parameters
        for direction in DIRECTIONS:
            motion, look = _once(one.motions[direction]), pen(direction, 1.6)
            mass_loop(top, motion, p.mass, True, **look)
            bumper_loops(bottom, motion, True, **look)
        both = coexisting(one.case, found.slow[one.case.name], one.hz)
        if both is not None and both.unstable is not None:
            state = both.unstable.state
            motion = one.case.player.motion(one.hz, one.case.acceleration, state, 1)
            mass_loop(top, motion, p.mass, True, **UNSTABLE)
            bumper_loops(bottom, motion, True, **UNSTABLE)
        if p.gap_r > 0:
            obstacles(p, top.axvline)
            obstacles(p, bottom.axvline)
        _label(top, "$u$ in mm", "$F_I$ in kN" if place == 0 else "")
        _label(bottom, "$v_j$ in mm", "$F_j$ in kN" if place == 0 else "")
    handles = directions_key(pen)
    if found.exact:
        handles.append(Line2D([], [], **UNSTABLE, label="unstable, between the two"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    which = ", ".join(minus(one.case.name) for one in shown)
    return Drawing(
        names[1], names[0], f"Loops in resonance: {which}",
        "Force-displacement cycles in steady resonance, forward (red) and backward (blue): top mass"
        ", bottom bumpers. "
        + ("Dotted: the unstable motion between two stable ones, which no experiment can hold. "
           if found.exact else "")
        + "Where the model's resonance lies elsewhere than the experiment's, it is drawn "
        "at its own frequency and the paper's is named.",
        figure,
    )  # fmt: skip


def _held(shown: list[Resonant]) -> str:
    """What the forward motion of G-1 does, from its forces."""
    forward = next(one for one in shown if one.case.name == "G-1").motions["forward"]
    lets_go = not ((forward.force_r > 0) & (forward.force_l < 0)).all()
    return "exceeds it, and leaves a bumper for a moment" if lets_go else "does so too"


def _histories(shown: list[Resonant]) -> Drawing:
    figure = Figure(figsize=(11, 8.4))
    for place, (ax, one) in enumerate(zip(figure.subplots(3, 1), shown, strict=True)):
        letter(ax, "abc"[place], one.title)
        for direction in DIRECTIONS:
            motion = one.motions[direction]
            ax.plot(motion.time, motion.u * 1e3, **pen(direction, 1.8))
            contact_bands(ax, motion, COLOUR[direction], alpha=0.13)
        if one.case.parameters.gap_r:
            obstacles(one.case.parameters, ax.axhline)
        else:
            ax.axhline(0, **AT_REST)
        ax.set_xlim(0, HISTORY_CYCLES / one.hz)
        ax.set_ylabel("$u$ in mm")
    ax.set_xlabel("$t$ in s")
    handles = [*directions_key(pen), Line2D([], [], **AT_REST, label="gap, or pre-strain")]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    return Drawing(
        "fig07_histories", "7", "Relative displacement in resonance",
        "Time histories of u in steady condition: a G4 in the right hysteresis, b G0, c G−1 in the "
        "left hysteresis. Dashed: a, b the initial gap, c the pre-strain of the bumpers. Vertical "
        "bands: contact with each bumper, red forward, blue backward, darker where both touch. In "
        "the paper's c the forward motion stays within the pre-strain; the model's "
        f"{_held(shown)}.",
        figure,
    )  # fmt: skip
