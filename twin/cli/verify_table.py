"""Terminal output of `verify`."""

from rich.table import Table

from twin.cli.verify import Json
from twin.run.terminal import console, print_line, print_table

MAX_LISTED = 10  # lines per list


def print_verification(report: Json, advise: bool = True) -> None:
    """Print the report of `verify`, with advice on repair unless `advise` is False."""
    samples, rate_hz = report["samples"], report["samples"]["rate_hz"]
    seconds = samples["acquired"] / rate_hz
    end = samples["stopped"] or "without an end"
    print_line(f"{', '.join(report['log'])}: run {report['run']} of {report['started_at']}")
    print_line(
        f"  {samples['acquired']} samples at {rate_hz:g} Hz ({seconds:.1f} s), {end}; "
        f"schema version {report['schema']}; content {_describe_content(report)}"
    )
    table = Table("topic", "messages", "missing", box=None)
    for topic, counts in report["topics"].items():
        table.add_row(topic, str(counts["messages"]), str(counts["missing"] or ""))
    print_table(console, table)
    for sensor in report["sensors"]:
        if text := _describe_sensor(sensor):
            print_line(f"sensor {sensor['channel']}: {text}")
    for attachment in report["altered"]:
        print_line(f"altered: attachment {attachment} is not what was written")
    _print_limited("damage", [_describe_damage(damage) for damage in report["damage"]])
    _print_limited("gap", [_describe_gap(gap, rate_hz) for gap in report["gaps"]])
    reasons = report["replay"]["because"]
    reason = f": {'; '.join(reasons)}" if reasons else ""
    if not report["replay"]["possible"]:
        print_line(f"cannot be replayed{reason}")
    elif report["replay"]["identical"]:
        print_line("can be replayed, to the bit")
    else:
        print_line(f"can be replayed, but perhaps not to the bit{reason}")
    if report["repaired"]:
        names = (name for key, name in report["repaired"].items() if key.startswith("from_"))
        print_line(f"repaired: from {', '.join(names)}: {report['repaired'].get('damage', '')}")
    if report["apart"]:
        for sentence in report["apart"]:
            print_line(sentence)
    elif report["damage"] or report["altered"]:
        advice = "; `--repair NEW` writes what is left as a whole file" if advise else ""
        print_line(f"damaged{advice}")
    else:
        print_line("whole" if report["sound"] else "the file is whole, the recording has gaps")


def _describe_content(report: Json) -> str:
    return {
        "same": "as its hash says",
        "differs": "differs from its hash",
        "unknown": "without a hash (an unfinished log, or one of version 1)",
    }[report["content"]]


def _describe_sensor(sensor: Json) -> str:
    """Format the instrument data of a sensor's config, "" if there is none."""
    due = f"due {sensor['due']}{', OVERDUE when the run began' if sensor['overdue'] else ''}"
    parts = (
        sensor["instrument"],
        sensor["serial"] and f"serial {sensor['serial']}",
        sensor["calibrated"] and f"calibrated {sensor['calibrated']}",
        sensor["due"] and due,
        sensor["certificate"] and f"certificate {sensor['certificate']}",
        sensor["checked"] and f"checked {sensor['checked']}",
    )
    return ", ".join(filter(None, parts))


def _describe_damage(damage: Json) -> str:
    place = (
        f"bytes {damage['byte']} to {damage['byte'] + damage['bytes']}: " if damage["bytes"] else ""
    )
    return f"{place}{damage['reason']}"


def _describe_gap(gap: Json, rate: float) -> str:
    first, count = gap["first"], gap["count"]
    channel = f" of {gap['channel']}" if gap["channel"] else ""
    if not count:
        return f"from sample {first}{channel} (at {first / rate:.3f} s): {gap['reason']}"
    return (
        f"samples {first} to {first + count - 1}{channel} (at {first / rate:.3f} s, "
        f"{count / rate:.4g} s): {gap['reason']}"
    )


def _print_limited(label: str, lines: list[str]) -> None:
    for line in lines[:MAX_LISTED]:
        print_line(f"{label}: {line}")
    if len(lines) > MAX_LISTED:
        print_line(f"{label}: and {len(lines) - MAX_LISTED} more; see --json")
