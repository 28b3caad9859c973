"""What `verify` found, for people."""

from rich.table import Table

from twin.service.terminal import console, print_table, say
from twin.service.verifying import Json

SHOWN = 10  # of a list that may be long


def print_verified(found: Json, advise: bool = True) -> None:
    """A few lines and a table of the topics; with advice where something can be done."""
    samples, rate = found["samples"], found["samples"]["rate_hz"]
    seconds = samples["acquired"] / rate
    end = samples["stopped"] or "without an end"
    say(f"{', '.join(found['log'])}: run {found['run']} of {found['started_at']}")
    say(
        f"  {samples['acquired']} samples at {rate:g} Hz ({seconds:.1f} s), {end}; "
        f"schema version {found['schema']}; content {_content(found)}"
    )
    table = Table("topic", "messages", "missing", box=None)
    for topic, one in found["topics"].items():
        table.add_row(topic, str(one["messages"]), str(one["missing"] or ""))
    print_table(console, table)
    for one in found["sensors"]:
        if told := _sensor(one):
            say(f"sensor {one['channel']}: {told}")
    for one in found["altered"]:
        say(f"altered: attachment {one} is not what was written")
    _some("damage", [_damage(one) for one in found["damage"]])
    _some("gap", [_gap(one, rate) for one in found["gaps"]])
    because = found["replay"]["because"]
    reason = f": {'; '.join(because)}" if because else ""
    if not found["replay"]["possible"]:
        say(f"cannot be replayed{reason}")
    elif found["replay"]["identical"]:
        say("can be replayed, to the bit")
    else:
        say(f"can be replayed, but perhaps not to the bit{reason}")
    if found["repaired"]:
        names = (name for key, name in found["repaired"].items() if key.startswith("from_"))
        say(f"repaired: from {', '.join(names)}: {found['repaired'].get('damage', '')}")
    if found["apart"]:
        for sentence in found["apart"]:
            say(sentence)
    elif found["damage"] or found["altered"]:
        advice = "; `--repair NEW` writes what is left as a whole file" if advise else ""
        say(f"damaged{advice}")
    else:
        say("whole" if found["sound"] else "the file is whole, the recording has gaps")


def _content(found: Json) -> str:
    return {
        "same": "as its hash says",
        "differs": "differs from its hash",
        "unknown": "without a hash (an unfinished log, or one of version 1)",
    }[found["content"]]


def _sensor(one: Json) -> str:
    """What its card says of the instrument; nothing where it says nothing."""
    due = f"due {one['due']}{', OVERDUE when the run began' if one['overdue'] else ''}"
    parts = (
        one["instrument"],
        one["serial"] and f"serial {one['serial']}",
        one["calibrated"] and f"calibrated {one['calibrated']}",
        one["due"] and due,
        one["certificate"] and f"certificate {one['certificate']}",
        one["checked"] and f"checked {one['checked']}",
    )
    return ", ".join(filter(None, parts))


def _damage(one: Json) -> str:
    where = f"bytes {one['byte']} to {one['byte'] + one['bytes']}: " if one["bytes"] else ""
    return f"{where}{one['reason']}"


def _gap(one: Json, rate: float) -> str:
    first, count = one["first"], one["count"]
    where = f" of {one['channel']}" if one["channel"] else ""
    if not count:
        return f"from sample {first}{where} (at {first / rate:.3f} s): {one['reason']}"
    return (
        f"samples {first} to {first + count - 1}{where} (at {first / rate:.3f} s, "
        f"{count / rate:.4g} s): {one['reason']}"
    )


def _some(what: str, lines: list[str]) -> None:
    for line in lines[:SHOWN]:
        say(f"{what}: {line}")
    if len(lines) > SHOWN:
        say(f"{what}: and {len(lines) - SHOWN} more; see --json")
