"""`check --table`: the wiring of a table, checked with an operator and printed."""

import math
import select
import sys
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.safety.wiring_check import CheckLine, RestingInputs
from twin.results.contract import format_json
from twin.rig.check_table import WiringCheckResult, check_table
from twin.system.exit_codes import EXIT_FAILED
from twin.system.terminal import console, print_line, print_table


def print_wiring_check(table: str, unattended: bool, as_json: bool) -> int:
    """Check the wiring and print the result; return 0, or 2 if a line fails."""
    has_operator = sys.stdin.isatty() and not (unattended or as_json)
    result = check_table(
        table,
        TerminalOperator() if has_operator else None,
        (lambda _: None) if as_json else print_line,
    )
    print_wiring_result(result, as_json)
    return 0 if result.has_passed else EXIT_FAILED


class TerminalOperator:
    """Operator at this terminal."""

    def ask(self, what: str) -> None:
        print_line(f"now: {what} (Enter: skip)")

    def declines(self) -> bool:
        return bool(select.select([sys.stdin], [], [], 0.0)[0]) and bool(sys.stdin.readline())


def print_wiring_result(result: WiringCheckResult, as_json: bool) -> None:
    """Print the inputs at rest, the checks, warnings and the verdict, or all as JSON."""
    if as_json:
        print(format_json(_to_json(result)))
        return
    if result.resting is not None:
        print_table(console, _make_inputs_table(result.resting))
    print_table(console, _make_lines_table(result.lines))
    for line in result.lines:
        if line.verdict == "fail":
            print_line(f"FAIL {line.name}, {line.channel or 'all'}: {line.do}")
    for reason in dict.fromkeys(line.do for line in result.lines if line.verdict == "not tested"):
        lines = [
            line for line in result.lines if line.do == reason and line.verdict == "not tested"
        ]
        checks = ", ".join(dict.fromkeys(f"{line.name} {line.channel}".strip() for line in lines))
        print_line(f"not tested, {checks}: {reason}")
    for sentence in result.warnings:
        print_line(f"warning: {sentence}")
    failed = sum(line.verdict == "fail" for line in result.lines)
    untested = sum(line.verdict == "not tested" for line in result.lines)
    verdict = f"{failed} of {len(result.lines)} lines fail" if failed else "no line fails"
    print_line(f"{result.rig.name}: {verdict}, {untested} not tested; nothing was moved")


def _make_inputs_table(resting: RestingInputs) -> Table:
    """Make the table of each channel's reading, noise and mains hum at rest."""
    table = Table(title="inputs at rest", box=SIMPLE_HEAD, title_justify="left")
    for header in ("channel", "shows", "noise rms", "bits", "mains hum"):
        table.add_column(header, justify="left" if header == "channel" else "right")
    hum = resting.hum
    for place, sensor in enumerate(resting.rig.sensors):
        if resting.is_lost[place]:
            table.add_row(sensor.channel, "nothing", "", "", "")
            continue
        table.add_row(
            sensor.channel,
            f"{resting.means[place]:.4g} {sensor.unit}",
            f"{resting.noise_rms[place]:.3g} {sensor.unit}",
            f"{resting.effective_bits(place):.1f} of {sensor.bits}",
            f"{hum.rms[place]:.2g} {sensor.unit} at {hum.frequency_hz:.0f} Hz",
        )
    return table


def _make_lines_table(lines: list[CheckLine]) -> Table:
    """Make the table of checks: a row per failure, grouped rows for passed and untested ones."""
    table = Table(title="wiring", box=SIMPLE_HEAD, title_justify="left")
    for header in ("check", "channel", "value", "allowed", "result"):
        table.add_column(header, justify="right" if header == "value" else "left")
    for name in dict.fromkeys(line.name for line in lines):
        for verdict, word in (("fail", "FAIL"), ("pass", "pass"), ("not tested", "not tested")):
            group = [line for line in lines if line.name == name and line.verdict == verdict]
            if verdict != "fail" and len(group) > 1:
                table.add_row(name, f"{len(group)} channels", "", "", word)
                continue
            for line in group:
                known = verdict != "not tested"
                value = f"{line.value:.4g} {line.unit}" if known else ""
                table.add_row(
                    name, line.channel, value, _format_limits(line) if known else "", word
                )
    return table


def _format_limits(line: CheckLine) -> str:
    if math.isinf(line.high):
        return f"at least {line.low:.3g}"
    return f"{line.low:.3g} to {line.high:.3g}"


def _to_json(result: WiringCheckResult) -> dict[str, Any]:
    resting = result.resting
    return {
        "table": result.rig.name,
        "backend": result.rig.backend,
        "passed": result.has_passed,
        "lines": [
            {name: getattr(line, name) for name in CheckLine.__slots__} for line in result.lines
        ],
        "inputs": [] if resting is None else [
            {
                "channel": sensor.channel, "unit": sensor.unit,
                "mean": resting.means[place], "noise_rms": resting.noise_rms[place],
                "bits": resting.effective_bits(place), "hum_rms": resting.hum.rms[place],
                "hum_hz": resting.hum.frequency_hz,
            }
            for place, sensor in enumerate(resting.rig.sensors)
        ],
        "warnings": result.warnings,
    }  # fmt: skip
