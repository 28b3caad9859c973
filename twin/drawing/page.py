"""HTML pages: template rendering and embedded figures."""

import base64
import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemBytecodeCache, FileSystemLoader, StrictUndefined
from platformdirs import user_cache_path

from twin.drawing.panels import Picture

TEMPLATE_DIR = Path(__file__).parent  # contains the shared parts.html and style.html
CACHE_DIR = user_cache_path("shaketwin") / "templates"  # compiled, by the hash of their texts
MAX_PLAIN = 1e12  # larger numbers are written as a power of ten


def format_significant(value: Any, digits: int = 3) -> str:
    """Format a number with `digits` significant digits, never in E notation; a dash if invalid."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    if decimals > 9 or abs(value) >= MAX_PLAIN:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10^{int(exponent)}".replace("-", "−")
    return f"{value:.{decimals}f}".replace("-", "−")


def render_page(template: Path, **values: Any) -> str:
    """Render a template as HTML text; values are escaped, a missing variable is an error."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, TEMPLATE_DIR]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        bytecode_cache=_open_cache(),
    )
    environment.filters["sig"] = format_significant
    return environment.get_template(template.name).render(**values)


def _open_cache() -> FileSystemBytecodeCache | None:
    """Return the cache of compiled templates; None where its folder cannot be written."""
    try:
        CACHE_DIR.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return FileSystemBytecodeCache(str(CACHE_DIR)) if os.access(CACHE_DIR, os.W_OK) else None


def write_page(folder: Path, template: Path, **values: Any) -> Path:
    """Write folder/report.html from a template, as `render_page`; return its path."""
    path = folder / "report.html"
    path.write_text(render_page(template, **values), encoding="utf-8")
    return path


def embed_images(pictures: Iterable[Picture]) -> list[tuple[Picture, str]]:
    """Return (picture, its PNG in base64) pairs for embedding in a page."""
    return [(picture, base64.b64encode(picture.path.read_bytes()).decode()) for picture in pictures]
