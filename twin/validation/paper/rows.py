"""Row of the comparison table: a statement of the paper and the result of the model."""

from dataclasses import dataclass, field

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
FREQUENCY_TOLERANCE = 0.05  # relative; a frequency within it agrees
NO_HYSTERESIS = "no hysteresis"
RowValues = dict[str, float | str | bool | list[float] | list[list[float]]]


@dataclass(frozen=True, slots=True)
class ComparisonRow:
    """Statement of the paper, result of the model, verdict, and the rule of the verdict."""

    key: str
    case: str
    paper: str
    model: str
    verdict: str
    rule: str
    values: RowValues = field(default_factory=dict)


def format_difference(model: float, paper: float) -> str:
    """Return the relative difference between model and paper in percent, with sign."""
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")
