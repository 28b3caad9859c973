"""Page and tables of a resonance map."""

import csv
from pathlib import Path

import numpy as np

from twin.branches.map_figures import draw_map_figures
from twin.drawing.branch_curves import make_axis
from twin.drawing.page import embed_images, render_page
from twin.dynamics.main_branches import ResonanceMap


def write_map_report(
    folder: Path, resonance: ResonanceMap, title: str, subtitle: str, model_toml: str
) -> Path:
    """Write report.html, peaks.csv, loci.csv and figures/*.png to `folder`.

    Return the path of the page. The tables are in SI.
    """
    pictures = draw_map_figures(resonance, folder / "figures")
    write_tables(resonance, folder)
    axis, peaks = make_axis(resonance.parameter), resonance.peaks
    columns = (
        axis.factor * peaks.values, 1e3 * peaks.u_m, peaks.u_hz, peaks.a_m_s2, peaks.a_hz
    )  # fmt: skip
    text = render_page(
        Path(__file__).with_name("map.html"),
        title=title,
        subtitle=subtitle,
        headline=format_map_headline(resonance),
        parameter=axis.label,
        rows=np.column_stack(columns).tolist(),
        images=embed_images(pictures),
        model=model_toml,
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def write_tables(resonance: ResonanceMap, folder: Path) -> None:
    """Write peaks.csv and loci.csv, in SI, without loss of precision."""
    name, peaks = resonance.parameter, resonance.peaks
    with (folder / "peaks.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name, "u_m", "u_frequency_hz", "a_m_s2", "a_frequency_hz"])
        writer.writerows(
            np.column_stack(
                (peaks.values, peaks.u_m, peaks.u_hz, peaks.a_m_s2, peaks.a_hz)
            ).tolist()
        )
    with (folder / "loci.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["locus", "kind", "frequency_hz", name])
        for number, locus in enumerate(resonance.loci, 1):
            writer.writerows([number, locus.kind, *place] for place in locus.values.tolist())


def format_map_headline(resonance: ResonanceMap) -> str:
    """State where the largest displacement and acceleration are least, in one sentence."""
    axis, peaks = make_axis(resonance.parameter), resonance.peaks
    parts = []
    for label, unit, y in (
        ("displacement", "mm", 1e3 * peaks.u_m),
        ("total acceleration", "m/s²", peaks.a_m_s2),
    ):
        if not np.isfinite(y).any():
            continue
        least, most = int(np.nanargmin(y)), int(np.nanargmax(y))
        x = axis.factor * peaks.values
        parts.append(
            f"the largest {label} is least, {y[least]:.3g} {unit}, at {x[least]:.4g} and "
            f"most, {y[most]:.3g} {unit}, at {x[most]:.4g}"
        )
    text = "; ".join(parts) or "no stable motion is known"
    return f"{text[0].upper()}{text[1:]} ({axis.label})."
