"""Force-displacement loops in primary resonance (Figs. 3, 6, 8) and time histories (Fig. 7)."""

from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.drawing.motion_drawing import (
    draw_rest_lines,
    plot_bumper_loops,
    plot_inertia_loop,
    shade_contact,
)
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.pictures import direction_handles, label_panel
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    GAP_COLOURS,
    GUIDE_COLOUR,
    REST_LINE_STYLE,
    UNSTABLE_STYLE,
    LineStyle,
    experiment_style,
    format_minus,
)
from twin.paper.findings import find_coexisting_orbits, simulate_steady_motion
from twin.paper.study import COEXISTING_HZ, PaperStudy
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase
from twin.results.players import SystemMotion
from twin.results.report_data import DIRECTIONS

PAPER_RESONANCE_HZ = {"G4": 3.4, "G0": 4.8, "G-1": 6.0, "G-2": 7.3, "G-10": 7.6}
HISTORY_CYCLES = 3
ZOOM_MM = 3.4


@dataclass(frozen=True, slots=True, eq=False)
class ResonantMotions:
    """Steady motions of a gap at resonance, by direction, and the title of its panel."""

    case: PaperCase
    hz: float
    motions: dict[str, SystemMotion]

    @property
    def title(self) -> str:
        """Gap name, frequency, and the paper's frequency where it differs."""
        name, paper_hz = format_minus(self.case.name), PAPER_RESONANCE_HZ[self.case.name]
        note = "" if abs(paper_hz - self.hz) < 1e-9 else f"  (paper: {paper_hz:g} Hz)"
        return f"{name}, $f$ = {self.hz:.4g} Hz{note}"


def draw_paper_loop_figures(
    study: PaperStudy, campaign: MeasuredCampaign | None
) -> CaptionedFigures:
    """Draw Figs. 3, 6, 7 and 8, for the model only."""
    if campaign is not None:
        return
    resonances = {name: _simulate_resonance(study, name) for name in PAPER_RESONANCE_HZ}
    yield _draw_gap_comparison(study)
    yield _draw_loops(
        study, [resonances[name] for name in ("G4", "G0", "G-1")], ("6", "fig06_loops")
    )
    yield _draw_histories([resonances[name] for name in ("G4", "G0", "G-1")])
    yield _draw_loops(study, [resonances[name] for name in ("G-2", "G-10")], ("8", "fig08_loops"))


def _simulate_resonance(study: PaperStudy, name: str) -> ResonantMotions:
    """Simulate a gap at 3.4 Hz (G4), in the middle of its hysteresis, or at the peak of eta_d."""
    fold = study.folds[name]
    hz = study.slow_sweeps[name].peak_hz
    if name == "G4":
        hz = COEXISTING_HZ
    elif fold is not None:
        hz = round((fold.forward_hz + fold.backward_hz) / 2, 3)
    motions = {
        direction: simulate_steady_motion(
            study.cases[name], study.slow_sweeps[name], hz, direction, HISTORY_CYCLES
        )
        for direction in DIRECTIONS
    }
    return ResonantMotions(study.cases[name], hz, motions)


def _take_first_cycle(motion: SystemMotion) -> SystemMotion:
    """Return the first of `HISTORY_CYCLES` cycles."""
    end = motion.u.size // HISTORY_CYCLES
    return SystemMotion(*(getattr(motion, name)[:end] for name in SystemMotion.__slots__))


def _draw_gap_comparison(study: PaperStudy) -> CaptionedFigure:
    figure = Figure(figsize=(11, 5.6))
    mass_ax, bumper_ax = figure.subplots(1, 2)
    insets = [
        mass_ax.inset_axes((0.61, 0.05, 0.38, 0.34)),
        bumper_ax.inset_axes((0.06, 0.61, 0.36, 0.34)),
    ]  # fmt: skip
    for name, case in study.cases.items():
        index, direction = study.slow_sweeps[name].peak
        hz = float(study.slow_sweeps[name].frequency[index])
        motion = simulate_steady_motion(case, study.slow_sweeps[name], hz, direction, 1)
        style: LineStyle = {"color": GAP_COLOURS[name], "lw": 1.4}
        for ax in (mass_ax, insets[0]):
            plot_inertia_loop(ax, motion, case.parameters.mass, True, **style)
        for ax in (bumper_ax, insets[1]):
            if name == "G∞":
                continue
            plot_bumper_loops(ax, motion, True, **style)
            if case.parameters.gap_r > 0:
                draw_rest_lines(case.gaps_m, ax.axvline, **{**style, "lw": 0.8})
        if 0 < case.parameters.gap_r < 1:
            draw_rest_lines(case.gaps_m, mass_ax.axvline, **{**style, "lw": 0.8})
    for inset in insets:
        inset.set_xlim(-ZOOM_MM, ZOOM_MM)
        inset.set_ylim(-3.9, 3.9)
        inset.tick_params(labelsize=7)
        inset.set_title("small gaps", size=8, loc="center")
        inset.set_zorder(3)
    label_panel(mass_ax, "a", "Mass")
    label_panel(bumper_ax, "b", "Bumpers")
    _label_axes(mass_ax, "$u$ in mm", "$F_I$ in kN")
    _label_axes(bumper_ax, "$v_j$ in mm", "$F_j$ in kN")
    handles = [
        Line2D([], [], color=GAP_COLOURS[n], lw=2, label=format_minus(n)) for n in study.cases
    ]
    handles.append(Line2D([], [], **REST_LINE_STYLE, label="bumper at rest"))
    figure.legend(handles=handles, loc="outside upper center", ncols=10)
    peaks = ", ".join(f"{format_minus(n)} {study.slow_sweeps[n].peak_hz:.2f}" for n in study.cases)
    return CaptionedFigure(
        "fig03_loops", "Loops in primary resonance, all gaps",
        "Force-displacement cycles in steady primary resonance: a mass, b bumpers. Dashed: initial "
        f"position of the bumpers for G > 0. Frequencies of the largest η_d in Hz: {peaks}.",
        figure, "3",
    )  # fmt: skip


def _label_axes(ax: Axes, x_label: str, y_label: str) -> None:
    ax.set_xlabel(x_label)
    ax.set_ylabel(y_label)
    ax.axhline(0, color=GUIDE_COLOUR, lw=0.5, zorder=0.6)


def _draw_loops(
    study: PaperStudy, resonances: list[ResonantMotions], names: tuple[str, str]
) -> CaptionedFigure:
    """Draw loops of the mass (top row) and the bumpers (bottom row), one column per gap."""
    figure = Figure(figsize=(3.9 * len(resonances) + (0 if len(resonances) > 2 else 1), 7.4))
    axes = figure.subplots(2, len(resonances), squeeze=False)
    for column, (top, bottom, resonance) in enumerate(zip(*axes, resonances, strict=True)):
        label_panel(top, "abc"[column], resonance.title)
        label_panel(bottom, "abcdef"[column + len(resonances)])
        p = resonance.case.parameters
        for direction in DIRECTIONS:
            motion = _take_first_cycle(resonance.motions[direction])
            style = experiment_style(direction, 1.6)
            plot_inertia_loop(top, motion, p.mass, True, **style)
            plot_bumper_loops(bottom, motion, True, **style)
        orbits = find_coexisting_orbits(
            resonance.case, study.slow_sweeps[resonance.case.name], resonance.hz
        )
        if orbits is not None and orbits.unstable is not None:
            state = orbits.unstable.period_map.to_state(orbits.unstable.x)
            motion = resonance.case.simulator.simulate_motion(
                resonance.hz, resonance.case.acceleration, state, 1
            )
            plot_inertia_loop(top, motion, p.mass, True, **UNSTABLE_STYLE)
            plot_bumper_loops(bottom, motion, True, **UNSTABLE_STYLE)
        if p.gap_r > 0:
            draw_rest_lines(resonance.case.gaps_m, top.axvline)
            draw_rest_lines(resonance.case.gaps_m, bottom.axvline)
        _label_axes(top, "$u$ in mm", "$F_I$ in kN" if column == 0 else "")
        _label_axes(bottom, "$v_j$ in mm", "$F_j$ in kN" if column == 0 else "")
    handles = direction_handles(experiment_style)
    if study.is_exact:
        handles.append(Line2D([], [], **UNSTABLE_STYLE, label="unstable, between the two"))
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    gap_names = ", ".join(format_minus(resonance.case.name) for resonance in resonances)
    return CaptionedFigure(
        names[1], f"Loops in resonance: {gap_names}",
        "Force-displacement cycles in steady resonance, forward (red) and backward (blue): top mass"
        ", bottom bumpers. "
        + ("Dotted: the unstable motion between two stable ones, which an open-loop test cannot "
           "maintain. "
           if study.is_exact else "")
        + "Where the model's resonance differs from the experiment's, the model is drawn at its "
        "own frequency and the paper's is given in the title.",
        figure, names[0],
    )  # fmt: skip


def _describe_forward_motion(resonances: list[ResonantMotions]) -> str:
    """Describe whether the forward motion of G-1 leaves a bumper, as the end of a sentence."""
    forward = next(resonance for resonance in resonances if resonance.case.name == "G-1").motions[
        "forward"
    ]
    detaches = not ((forward.force_r > 0) & (forward.force_l < 0)).all()
    return "exceeds it, and leaves a bumper for a moment" if detaches else "does so too"


def _draw_histories(resonances: list[ResonantMotions]) -> CaptionedFigure:
    figure = Figure(figsize=(11, 8.4))
    for row, (ax, resonance) in enumerate(zip(figure.subplots(3, 1), resonances, strict=True)):
        label_panel(ax, "abc"[row], resonance.title)
        for direction in DIRECTIONS:
            motion = resonance.motions[direction]
            ax.plot(motion.time, motion.u * 1e3, **experiment_style(direction, 1.8))
            shade_contact(ax, motion, DIRECTION_COLOURS[direction], (0.13, 0.13))
        if resonance.case.parameters.gap_r:
            draw_rest_lines(resonance.case.gaps_m, ax.axhline)
        else:
            ax.axhline(0, **REST_LINE_STYLE)
        ax.set_xlim(0, HISTORY_CYCLES / resonance.hz)
        ax.set_ylabel("$u$ in mm")
    ax.set_xlabel("$t$ in s")
    handles = [
        *direction_handles(experiment_style),
        Line2D([], [], **REST_LINE_STYLE, label="gap, or pre-strain"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    return CaptionedFigure(
        "fig07_histories", "Relative displacement in resonance",
        "Time histories of u in steady condition: a G4 in the right hysteresis, b G0, c G−1 in the "
        "left hysteresis. Dashed: a, b the initial gap, c the pre-strain of the bumpers. Vertical "
        "bands: contact with each bumper, red forward, blue backward, darker where both touch. In "
        "the paper's c the forward motion stays within the pre-strain; the model's "
        f"{_describe_forward_motion(resonances)}.",
        figure, "7",
    )  # fmt: skip
