"""What `check --table` found, for people and as JSON."""

import math
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.wiring_check import Line, Resting
from twin.service.summary import dumps
from twin.service.terminal import console, print_table, say
from twin.service.wiring_check import Found


def print_found(found: Found, as_json: bool) -> None:
    """The inputs at rest, each line that did not pass, one for those that did, the verdict."""
    if as_json:
        print(dumps(_json(found)))
        return
    if found.resting is not None:
        print_table(console, _inputs(found.resting))
    print_table(console, _lines(found.lines))
    for line in found.lines:
        if line.verdict == "fail":
            say(f"FAIL {line.name}, {line.channel or 'all'}: {line.do}")
    for why in dict.fromkeys(line.do for line in found.lines if line.verdict == "not tested"):
        names = [one for one in found.lines if one.do == why and one.verdict == "not tested"]
        what = ", ".join(dict.fromkeys(f"{one.name} {one.channel}".strip() for one in names))
        say(f"not tested, {what}: {why}")
    for sentence in found.warnings:
        say(f"warning: {sentence}")
    failed = sum(line.verdict == "fail" for line in found.lines)
    untested = sum(line.verdict == "not tested" for line in found.lines)
    verdict = f"{failed} of {len(found.lines)} lines fail" if failed else "no line fails"
    say(f"{found.rig.name}: {verdict}, {untested} not tested; nothing was moved")


def _inputs(resting: Resting) -> Table:
    """What each channel shows at rest."""
    table = Table(title="inputs at rest", box=SIMPLE_HEAD, title_justify="left")
    for head in ("channel", "shows", "noise rms", "bits", "mains hum"):
        table.add_column(head, justify="left" if head == "channel" else "right")
    hum = resting.hum
    for place, sensor in enumerate(resting.rig.sensors):
        if resting.lost[place]:
            table.add_row(sensor.channel, "nothing", "", "", "")
            continue
        table.add_row(
            sensor.channel,
            f"{resting.means[place]:.4g} {sensor.unit}",
            f"{resting.noise[place]:.3g} {sensor.unit}",
            f"{resting.bits(place):.1f} of {sensor.bits}",
            f"{hum.rms[place]:.2g} {sensor.unit} at {hum.frequency_hz:.0f} Hz",
        )
    return table


def _lines(lines: list[Line]) -> Table:
    """A row for each line that fails, and one for all of a name that pass, or are not tested."""
    table = Table(title="wiring", box=SIMPLE_HEAD, title_justify="left")
    for head in ("check", "channel", "value", "allowed", "result"):
        table.add_column(head, justify="right" if head == "value" else "left")
    for name in dict.fromkeys(line.name for line in lines):
        for verdict, word in (("fail", "FAIL"), ("pass", "pass"), ("not tested", "not tested")):
            those = [one for one in lines if one.name == name and one.verdict == verdict]
            if verdict != "fail" and len(those) > 1:
                table.add_row(name, f"{len(those)} channels", "", "", word)
                continue
            for one in those:
                known = verdict != "not tested"
                value = f"{one.value:.4g} {one.unit}" if known else ""
                table.add_row(name, one.channel, value, _allowed(one) if known else "", word)
    return table


def _allowed(line: Line) -> str:
    if math.isinf(line.high):
        return f"at least {line.low:.3g}"
    return f"{line.low:.3g} to {line.high:.3g}"


def _json(found: Found) -> dict[str, Any]:
    resting = found.resting
    return {
        "table": found.rig.name,
        "backend": found.rig.backend,
        "passed": found.passed,
        "lines": [
            {name: getattr(line, name) for name in Line.__slots__} for line in found.lines
        ],
        "inputs": [] if resting is None else [
            {
                "channel": sensor.channel, "unit": sensor.unit,
                "mean": resting.means[place], "noise_rms": resting.noise[place],
                "bits": resting.bits(place), "hum_rms": resting.hum.rms[place],
                "hum_hz": resting.hum.frequency_hz,
            }
            for place, sensor in enumerate(resting.rig.sensors)
        ],
        "warnings": found.warnings,
    }  # fmt: skip
