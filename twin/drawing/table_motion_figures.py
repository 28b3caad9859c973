"""Figures of the table's motion: histories, Fourier and response spectra, energy, shock spectra."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.units import GRAVITY_M_S2
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, FigurePanel, Key, PanelFigure
from twin.drawing.plot_style import (
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    TWIN_COLOUR,
    measured_style,
    twin_style,
)
from twin.results.report_data import ReportData
from twin.results.spectra import (
    DEFAULT_DAMPING,
    FINE_PER_OCTAVE,
    USUAL_PER_OCTAVE,
    compute_arias_intensity,
    compute_fourier_spectrum,
    compute_response_spectrum,
    compute_shock_spectrum,
    list_octave_frequencies,
)
from twin.results.table_motion import TableMotion, find_table_motion
from twin.results.tracking import MAX_BAND_RATIO, SA_TOLERANCE, delay_record, keep_band
from twin.results.windows import extract_free_twin, join_channel

DETAIL_PERIODS = 6.0  # of the middle of the band, that the detail shows around the peak
BAND_MARGIN = 2.0  # factor beyond the band that is drawn of a spectrum
FOURIER_SMOOTHING = 12  # intervals per octave over which a Fourier spectrum is averaged
SHOCK_LOW_HZ, SHOCK_PER_OCTAVE = 1.0, 24
MOTION_FIGURES = (  # names, in order
    "table_acceleration",
    "table_displacement",
    "table_spectrum",
    "table_fourier",
    "mass_srs",
)
CORRIDOR_COLOUR, REQUIRED_COLOUR = "#8b929c", "#1559b0"
ACHIEVED_STYLE, TARGET_STYLE = measured_style("forward"), twin_style("forward")
MAX_PLOTTED_SAMPLES = 20_000
MIN_FOURIER_SHARE = 1e-5  # of the highest amplitude that is drawn


@dataclass(frozen=True, slots=True)
class MotionDrawing:
    """What every figure of the table's motion needs; `late` is the target delayed by the lag."""

    motion: TableMotion
    late_acc_m_s2: Float1D
    late_disp_m: Float1D
    band_hz: tuple[float, float]
    profile: Profile

    @property
    def is_whole(self) -> bool:
        """Whether every sample of the acceleration was recorded."""
        return bool(np.isfinite(self.motion.achieved_acc_m_s2).all())


def draw_table_motion(run: ReportData) -> CaptionedFigures:
    """Draw the motion of the table against its target, and the shocks of the specimen."""
    tracking = run.summary.tracking
    if not tracking:
        return
    profile = parse_toml(run.recording.start.profile_toml, Profile, "recorded profile")
    motion = find_table_motion(run.recording, profile)
    if motion is None:
        return
    drawing = MotionDrawing(
        motion,
        delay_record(motion.target_acc_m_s2, tracking.lag_s, motion.rate_hz),
        delay_record(motion.target_disp_m, tracking.lag_s, motion.rate_hz),
        tracking.band_hz,
        profile,
    )
    yield _draw_acceleration(drawing)
    yield _draw_displacement(drawing)
    if drawing.is_whole:
        yield _draw_response_spectrum(drawing)
        yield _draw_fourier_and_energy(drawing)
    yield from _draw_shock_spectrum(run, motion)


def _draw_acceleration(drawing: MotionDrawing) -> CaptionedFigure:
    """Draw the acceleration over time with a detail around its peak, and what is not the target."""
    motion = drawing.motion
    figure = PanelFigure((FIGURE_WIDTH_IN, 6.4), 3, sharex=False, heights=(2.0, 2.0, 1.3))
    whole, detail, rest = figure.panels[:, 0]
    error = motion.achieved_acc_m_s2 - drawing.late_acc_m_s2
    for axis in (whole, detail):
        _plot_pair(
            axis,
            motion.time_s,
            motion.achieved_acc_m_s2 / GRAVITY_M_S2,
            drawing.late_acc_m_s2 / GRAVITY_M_S2,
            1 if axis is detail else _stride(motion),
        )
        axis.set_ylabel("acceleration in g")
    low_s, high_s = _find_detail(drawing)
    detail.set_xlim(low_s, high_s)
    whole.axvspan(low_s, high_s, color=GUIDE_COLOUR, alpha=0.09, lw=0)
    rest.plot(motion.time_s, error / GRAVITY_M_S2, color=GUIDE_COLOUR, lw=0.5, label="in full")
    if drawing.is_whole:
        in_band = keep_band(error, motion.rate_hz, drawing.band_hz) / GRAVITY_M_S2
        low_hz, high_hz = drawing.band_hz
        label = f"in {low_hz:.2g} to {high_hz:.2g} Hz"
        rest.plot(motion.time_s, in_band, color=ACHIEVED_STYLE["color"], lw=1.0, label=label)
    rest.legend(loc="upper right", ncols=2)
    rest.set_ylabel("error in g")
    rest.set_xlabel("time in s")
    for axis in (whole, rest):
        axis.set_xlim(motion.time_s[0], motion.time_s[-1])
    peaks = [
        f", PGA {np.nanmax(np.abs(record)) / GRAVITY_M_S2:#.3g} g"
        for record in (motion.achieved_acc_m_s2, motion.target_acc_m_s2)
    ]
    _add_legend(figure, *peaks)
    return CaptionedFigure(
        "table_acceleration",
        "Acceleration of the table",
        "Wide and pale: achieved. Black: target, delayed by the lag of the table. Middle: detail "
        "around the peak (shaded above). Below: achieved minus target, at all frequencies and in "
        "the band.",
        figure,
    )


def _draw_displacement(drawing: MotionDrawing) -> CaptionedFigure:
    """Draw the displacement over time, and what is not the target."""
    motion = drawing.motion
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.6), 2, heights=(2.0, 1.0))
    upper, lower = figure.panels[:, 0]
    achieved, target = 1e3 * motion.achieved_disp_m, 1e3 * drawing.late_disp_m
    _plot_pair(upper, motion.time_s, achieved, target, _stride(motion))
    upper.set_ylabel("displacement\nin mm")
    lower.plot(motion.time_s, achieved - target, color=GUIDE_COLOUR, lw=0.7)
    lower.set_ylabel("error in mm")
    lower.set_xlabel("time in s")
    lower.set_xlim(motion.time_s[0], motion.time_s[-1])
    _add_legend(figure)
    return CaptionedFigure(
        "table_displacement",
        "Displacement of the table",
        "Wide and pale: achieved. Black: target, delayed by the lag of the table. Below: achieved "
        "minus target.",
        figure,
    )


def _draw_response_spectrum(drawing: MotionDrawing) -> CaptionedFigure:
    """Draw the response spectra at 1/6 and 1/72 octave with the corridor, and their ratio."""
    motion, config = drawing.motion, drawing.profile.tracking
    low_hz, high_hz = _widen(drawing)
    required = config.spectrum
    if required is not None:
        ends_hz = required.frequencies_hz[[0, -1]].tolist()
        low_hz, high_hz = min(low_hz, ends_hz[0]), max(high_hz, ends_hz[1])
        high_hz = min(high_hz, MAX_BAND_RATIO * motion.rate_hz)
    figure = PanelFigure((FIGURE_WIDTH_IN, 5.6), 2, heights=(2.2, 1.0))
    upper, lower = figure.panels[:, 0]
    for per_octave, style in ((FINE_PER_OCTAVE, {"lw": 0.9}), (USUAL_PER_OCTAVE, {"ls": ""})):
        hz = list_octave_frequencies(low_hz, high_hz, per_octave)
        achieved, target = (
            compute_response_spectrum(record, motion.rate_hz, hz, config.damping) / GRAVITY_M_S2
            for record in (motion.achieved_acc_m_s2, motion.target_acc_m_s2)
        )
        if per_octave == FINE_PER_OCTAVE:
            edges = (1 - SA_TOLERANCE) * target, (1 + SA_TOLERANCE) * target
            upper.fill_between(hz, *edges, color=CORRIDOR_COLOUR, alpha=0.35, lw=0)
            upper.plot(hz, target, **TARGET_STYLE)
            upper.plot(hz, achieved, color=ACHIEVED_STYLE["color"], **style)
            lower.plot(hz, achieved / target, color=ACHIEVED_STYLE["color"], **style)
        else:
            dots = {"color": ACHIEVED_STYLE["color"], "marker": "o", "ms": 3.6, **style}
            upper.plot(hz, achieved, **dots)
            lower.plot(hz, achieved / target, **dots)
    corridor = {"color": CORRIDOR_COLOUR, "alpha": 0.35, "lw": 0}
    keys = [
        Key("target", TARGET_STYLE),
        Key(f"target ± {100 * SA_TOLERANCE:g} %", corridor, is_patch=True),
        Key("achieved", {"color": ACHIEVED_STYLE["color"], "lw": 0.9, "marker": "o"}),
    ]
    caption = (
        f"Response spectrum of the absolute acceleration at {100 * config.damping:g} % damping. "
        "Dots: 1/6 octave, as judged; lines: 1/72 octave. Grey: target ± 10 %. Below: achieved "
        "over target. White: band of interest."
    )
    if required is not None:
        points_g = required.sa_m_s2 / GRAVITY_M_S2
        upper.plot(required.frequencies_hz, points_g, color=REQUIRED_COLOUR, lw=1.4)
        for factor in (config.required_lower, config.required_upper):
            if np.isfinite(factor):
                upper.plot(
                    required.frequencies_hz, factor * points_g, color=REQUIRED_COLOUR, lw=0.9,
                    ls="--",
                )  # fmt: skip
        keys.append(Key("required", {"color": REQUIRED_COLOUR, "lw": 1.4}))
        caption += " Blue: required spectrum and, dashed, its tolerance."
    upper.set_yscale("log")
    upper.set_ylabel("SA in g")
    lower.set_ylabel("achieved\nover target")
    ratios = [y for call in lower.find("plot") for y in call.arguments[1].tolist()]
    _draw_corridor(lower, ratios)
    for axis in (upper, lower):
        _format_frequency_axis(axis, low_hz, high_hz)
        _shade_outside(axis, (low_hz, high_hz), drawing.band_hz)
    lower.set_xlabel("frequency in Hz")
    figure.legend(keys, columns=4)
    return CaptionedFigure("table_spectrum", "Response spectrum of the table", caption, figure)


def _draw_fourier_and_energy(drawing: MotionDrawing) -> CaptionedFigure:
    """Draw the Fourier amplitude spectra, and the build-up of the Arias intensity."""
    motion = drawing.motion
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.9), 1, 2, sharex=False, widths=(1.35, 1.0))
    spectra, energy = figure.panels[0]
    top = 0.0
    low_hz = drawing.band_hz[0] / BAND_MARGIN
    high_hz = MAX_BAND_RATIO * motion.rate_hz
    for record, style in (
        (motion.achieved_acc_m_s2, ACHIEVED_STYLE),
        (drawing.late_acc_m_s2, TARGET_STYLE),
    ):
        hz, amplitude = _smooth_fourier(record, motion.rate_hz, low_hz, high_hz)
        top = max(top, float(amplitude.max(initial=0.0)))
        spectra.plot(hz, np.maximum(amplitude, MIN_FOURIER_SHARE * top), **style)
        energy.plot(motion.time_s, compute_arias_intensity(record, motion.rate_hz), **style)
    spectra.set_yscale("log")
    spectra.set_ylabel("Fourier amplitude in m/s")
    spectra.set_xlabel("frequency in Hz")
    _format_frequency_axis(spectra, low_hz, high_hz)
    _shade_outside(spectra, (low_hz, high_hz), drawing.band_hz)
    energy.set_ylabel("Arias intensity in m/s")
    energy.set_xlabel("time in s")
    energy.set_xlim(motion.time_s[0], motion.time_s[-1])
    energy.set_ylim(bottom=0.0)
    _add_legend(figure)
    return CaptionedFigure(
        "table_fourier",
        "Fourier spectrum and energy of the table",
        "Wide and pale: achieved. Black: target. Left: Fourier amplitude of the acceleration, rms "
        f"over 1/{FOURIER_SMOOTHING} octave, also beyond the band of interest (white). Right: "
        "build-up of the Arias intensity.",
        figure,
    )


def _draw_shock_spectrum(run: ReportData, motion: TableMotion) -> CaptionedFigures:
    """Draw the shock response spectrum of the acceleration of the mass, where it hits a bumper."""
    impacts = sum(
        (window_motion.impacts_right or 0) + (window_motion.impacts_left or 0)
        for window in run.windows
        for window_motion in (window.measured, window.twin)
        if window_motion is not None
    )
    records = dict(_extract_mass_records(run, motion))
    if not impacts or "measured" not in records:
        return
    hz = list_octave_frequencies(SHOCK_LOW_HZ, MAX_BAND_RATIO * motion.rate_hz, SHOCK_PER_OCTAVE)
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.9))
    axis = figure.panels[0, 0]
    axis.set_yscale("log")
    keys = []
    for source, record in records.items():
        shock = compute_shock_spectrum(record, motion.rate_hz, hz, DEFAULT_DAMPING)
        wide = source == "measured"
        sides = zip(("positive", "negative"), shock, ("forward", "backward"), strict=True)
        for side, values, direction in sides:
            style = measured_style(direction) if wide else twin_style(direction)
            axis.plot(hz, values / GRAVITY_M_S2, **style)
            keys.append(Key(f"{source}, {side}", style))
    axis.set_ylabel("SRS in g")
    axis.set_xlabel("natural frequency in Hz")
    _format_frequency_axis(axis, hz[0], hz[-1])
    figure.legend(keys, columns=4)
    caption = (
        "Shock response spectrum (ISO 18431-4, Q = 10) of the total acceleration of the mass: peak "
        "acceleration of an oscillator mounted on it, to the right (positive) and to the left. Up "
        "to a tenth of the sampling rate, 1/24 octave apart."
    )
    if "twin" in records:
        caption += " Thin: free-running twin."
    yield CaptionedFigure("mass_srs", "Shock response spectrum of the specimen", caption, figure)


def _extract_mass_records(run: ReportData, motion: TableMotion) -> Iterator[tuple[str, Float1D]]:
    """Yield (source, acceleration of the mass in m/s2, (sample,)) of those without a gap."""
    for source, stream in (("measured", "meas"), ("twin", "pred")):
        blocks = run.read_stream(stream, motion.start, motion.end)
        if source == "twin":
            blocks = [extract_free_twin(block) for block in blocks]
        record = join_channel(blocks, "mass_acc_m_s2")
        if record.size == motion.end - motion.start and np.isfinite(record).all():
            yield source, record


def _plot_pair(
    axis: FigurePanel, time_s: Float1D, achieved: Float1D, target: Float1D, stride: int
) -> None:
    axis.plot(time_s[::stride], achieved[::stride], **{**ACHIEVED_STYLE, "lw": 2.4})
    axis.plot(time_s[::stride], target[::stride], **TARGET_STYLE)


def _add_legend(figure: PanelFigure, achieved: str = "", target: str = "") -> None:
    """Add the legend of the pair, with what follows either name."""
    keys = [Key(f"achieved{achieved}", ACHIEVED_STYLE), Key(f"target{target}", TARGET_STYLE)]
    figure.legend(keys, columns=2)


def _stride(motion: TableMotion) -> int:
    return max(1, motion.time_s.size // MAX_PLOTTED_SAMPLES)


def _find_detail(drawing: MotionDrawing) -> tuple[float, float]:
    """Return begin and end in s of the detail around the peak of the target."""
    motion = drawing.motion
    middle_s = motion.time_s[int(np.argmax(np.abs(drawing.late_acc_m_s2)))]
    half_s = DETAIL_PERIODS / 2 / np.sqrt(drawing.band_hz[0] * drawing.band_hz[1])
    return max(middle_s - half_s, motion.time_s[0]), min(middle_s + half_s, motion.time_s[-1])


def _widen(drawing: MotionDrawing) -> tuple[float, float]:
    """Return the range of frequencies that is drawn of a response spectrum."""
    low_hz, high_hz = drawing.band_hz
    limit_hz = MAX_BAND_RATIO * drawing.motion.rate_hz
    return low_hz / BAND_MARGIN, max(min(BAND_MARGIN * high_hz, limit_hz), high_hz)


def _smooth_fourier(
    record: Float1D, rate_hz: float, low_hz: float, high_hz: float
) -> tuple[Float1D, Float1D]:
    """Return (frequency in Hz, rms Fourier amplitude in m/s), (interval,) each, by octave parts.

    A part without a frequency of the spectrum is left out.
    """
    hz, amplitude = compute_fourier_spectrum(record, rate_hz)
    edges = list_octave_frequencies(low_hz, high_hz, FOURIER_SMOOTHING)
    interval = np.searchsorted(edges, hz)
    inside = (interval > 0) & (interval < edges.size)
    counts = np.bincount(interval[inside], minlength=edges.size)[1:]
    sums = np.bincount(interval[inside], amplitude[inside] ** 2, edges.size)[1:]
    present = counts > 0
    return np.sqrt(edges[:-1] * edges[1:])[present], np.sqrt(sums[present] / counts[present])


def _draw_corridor(axis: FigurePanel, ratios: list[float]) -> None:
    axis.axhspan(1 - SA_TOLERANCE, 1 + SA_TOLERANCE, color=CORRIDOR_COLOUR, alpha=0.35, lw=0)
    axis.axhline(1.0, color=TWIN_COLOUR, lw=0.8)
    low, high = min(ratios), max(ratios)
    margin = 0.05 * (high - low)
    axis.set_ylim(min(low - margin, 1 - 2 * SA_TOLERANCE), max(high + margin, 1 + 2 * SA_TOLERANCE))


def _shade_outside(
    axis: FigurePanel, shown_hz: tuple[float, float], band_hz: tuple[float, float]
) -> None:
    """Shade the frequencies beyond the band of interest."""
    low, high = shown_hz
    for first, last in ((low, band_hz[0]), (band_hz[1], high)):
        if first < last:
            axis.axvspan(first, last, color=GUIDE_COLOUR, alpha=0.07, lw=0)


def _format_frequency_axis(axis: FigurePanel, low_hz: float, high_hz: float) -> None:
    """Give an axis a logarithmic frequency."""
    axis.set_xscale("log")
    axis.set_xlim(low_hz, high_hz)
