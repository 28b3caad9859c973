"""The pages: what every template has, and pictures inside a page."""

import base64
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from twin.service.figures import Picture

HERE = Path(__file__).parent  # with the style that they share


def significant(value: Any, digits: int = 3) -> str:
    """A number with that many significant digits, never in E notation; a dash for none."""
    if not isinstance(value, int | float) or not math.isfinite(value):
        return "–"
    if value == 0:
        return "0"
    decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
    if decimals > 9:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}·10^{int(exponent)}".replace("-", "−")
    return f"{value:.{decimals}f}".replace("-", "−")


def page(template: Path, **values: Any) -> str:
    """The HTML of a template. Every value is escaped; one that is missing is an error."""
    environment = Environment(
        loader=FileSystemLoader([template.parent, HERE]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["sig"] = significant
    return environment.get_template(template.name).render(**values)


def inside(pictures: Iterable[Picture]) -> list[tuple[Picture, str]]:
    """(picture, its PNG in base64) of each: a page has them inside it."""
    return [(one, base64.b64encode(one.path.read_bytes()).decode()) for one in pictures]
