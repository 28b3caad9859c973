"""A row of the table: one statement of the paper beside what the model gives."""

from dataclasses import dataclass, field

AGREES, IN_KIND, DEPARTS = "agrees", "agrees in kind", "departs"
CLOSE = 0.05  # of a frequency: what still agrees
NONE = "no hysteresis"
Values = dict[str, float | str | bool | list[float] | list[list[float]]]


@dataclass(frozen=True, slots=True)
class Row:
    """One statement of the paper, what the model gives, and the rule that the verdict follows."""

    key: str
    case: str
    paper: str
    model: str
    verdict: str
    rule: str
    values: Values = field(default_factory=dict)


def percent(model: float, paper: float) -> str:
    return f"{100 * (model / paper - 1):+.0f} %".replace("-", "−")
