"""HTML page of an identification, next to the model file: numbers of identify.json and figures."""

import math
from pathlib import Path

from twin.discovery.identify import IdentificationResult
from twin.discovery.identify_figures import draw_identification_figures
from twin.discovery.sensor_section import describe_sensors
from twin.discovery.serialize import Json
from twin.drawing.page import embed_images, render_page
from twin.results.quantities import format_quantity


def write_identification_page(
    folder: Path, result: IdentificationResult, report: Json, model_name: str, model: str
) -> Path:
    """Write folder/report.html and its figures; return the path of the page."""
    text = render_page(
        Path(__file__).with_name("identify.html"),
        report=report,
        estimate=format_estimate,
        quantity=format_quantity,
        sensor_lines=describe_sensors(report["sensors"]),
        images=embed_images(draw_identification_figures(result, folder)),
        model=model,
        model_name=model_name,
    )
    path = folder / "report.html"
    path.write_text(text, encoding="utf-8")
    return path


def format_estimate(estimate: Json) -> str:
    """Format an estimate with half its 95 % interval, or alone with four digits."""
    half = 0.5 * (estimate["high"] - estimate["low"]) if "high" in estimate else math.inf
    known = half if math.isfinite(half) and half > 0 else None
    return format_quantity(estimate["value"], estimate["unit"], known, digits=4)
