"""Words and tables of the verdict on the instruments."""

from typing import NamedTuple

from twin.discovery.serialize import Json
from twin.drawing.page import format_significant

KIND_LABELS = {
    "noise": "noise at rest, rms",
    "hum": "mains hum over noise",
    "one_over_f": "1/f noise up to",
    "resolution": "resolution over signal",
    "filter": "anti-alias filter",
    "gain": "gain error",
    "lag": "lag",
    "low_cut": "low cut",
    "resonance": "resonance of the mounting",
    "remainder": "disagreement left",
    "share": "share of the first cell less half",
    "plate": "mass in front of the cells",
    "gap": "true less stated gap",
    "offset": "offset",
}
CHANNEL_KINDS = ("noise", "hum", "one_over_f", "resolution", "filter")  # of a channel at rest
LEAST_SHOWN = 1e-12  # SI: a smaller value is that of a bound
# Units in which quantities are read: factor and name, by kind or by unit in SI.
SHOWN_UNITS = {
    "s": (1e6, "\u00b5s"), "m": (1e6, "\u00b5m"), "gain": (100.0, "%"),
    "resolution": (100.0, "%"), "remainder": (100.0, "%"), "plate": (100.0, "%"),
    "share": (100.0, "%"),
}  # fmt: skip


class CheckRow(NamedTuple):
    """Row of a table of checks; texts by column, and whether each is healthy."""

    log: str
    label: str
    cells: tuple[tuple[str, bool], ...]


def describe_sensors(sensors: Json) -> list[str]:
    """Return the verdict on the instruments in lines: one, and one for each error."""
    faults = [check for check in sensors["checks"] if not check["healthy"]]
    lines = [f"sensors: {sensors['state']}"]
    for check in faults:
        allowed = (
            f", allowed {'from' if check['kind'] in ('filter', 'resonance') else 'up to'} "
            f"{_format_size(check, check['limit'])}"
            if check["limit"]
            else ""
        )
        lines.append(
            f"  {KIND_LABELS.get(check['kind'], check['kind'])} of "
            f"{' against '.join(check['channels'])}: {_format_size(check, check['value'])}{allowed}"
        )
    return lines


def tabulate_channels(sensors: Json) -> list[CheckRow]:
    """Return a row per channel with what its readings at rest show, in CHANNEL_KINDS."""
    by_place: dict[tuple[str, str], dict[str, Json]] = {}
    for check in sensors["checks"]:
        if check["kind"] in CHANNEL_KINDS:
            by_place.setdefault((check["log"], check["channels"][0]), {})[check["kind"]] = check
    return [
        CheckRow(
            log, channel,
            tuple(
                (_format_size(checks[kind], checks[kind]["value"]), checks[kind]["healthy"])
                if kind in checks else ("\u2013", True)
                for kind in CHANNEL_KINDS
            ),
        )
        for (log, channel), checks in by_place.items()
    ]  # fmt: skip


def tabulate_comparisons(sensors: Json) -> list[CheckRow]:
    """Return a row per other check: label and channels; value, interval and limit."""
    rows = []
    for check in sensors["checks"]:
        if check["kind"] in CHANNEL_KINDS:
            continue
        low, high, limit = (check[key] for key in ("low", "high", "limit"))
        texts = (
            _format_size(check, check["value"]),
            f"{_format_size(check, low)} to {_format_size(check, high)}"
            if high > low
            else "\u2013",
            _format_size(check, limit) if limit else "\u2013",
        )
        label = f"{KIND_LABELS.get(check['kind'], check['kind'])}: {', '.join(check['channels'])}"
        rows.append(CheckRow(check["log"], label, tuple((t, check["healthy"]) for t in texts)))
    return rows


def _format_size(check: Json, value: float) -> str:
    unit = check["unit"]
    factor, name = SHOWN_UNITS.get(check["kind"], SHOWN_UNITS.get(unit, (1.0, unit)))
    shown = factor * value if abs(value) > LEAST_SHOWN else 0.0
    return f"{format_significant(shown)} {name}".strip()
