"""Proposal of a column map for a foreign table: channels, units, sampling rate and mass.

Nothing is imported by a guess: the proposal is printed with its reasons, and the user accepts it
or saves it as a map to edit. What names and units leave open is a question, never a choice.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS, TIME_COLUMN
from table_io.errors import InputError
from table_io.formats.table import ForeignTable
from table_io.formats.timing import (
    MAX_INTERVAL_ERROR,
    SAMPLE_UNIT,
    check_rate,
    describe_other_times,
    describe_unusable_times,
    describe_wrapped,
    find_remark_rate,
    find_time_column,
    judge_time_unit,
)
from table_io.formats.words import (
    find_named_quantity,
    find_quantity,
    find_stated_unit,
    find_unit,
    find_unknown_unit,
    matches_words,
    split_words,
)
from table_io.units import UNITS
from twin.exchange.columns import (
    CANONICAL_COLUMNS,
    ColumnMap,
    ColumnSource,
    ImportColumns,
    abbreviate,
    is_added_column,
)
from twin.exchange.plausibility import CHECKED_PAIRS, find_plausible_units, match_unit_pairs

BODY_WORDS = {
    "command": {"cmd", "command", "commanded", "reference", "ref", "drive", "setpoint", "target"},
    "relative": {
        "rel", "relative", "bearing", "isolator", "isolation", "damper", "device", "spring",
    },
    "table": {
        "table", "base", "ground", "shaker", "platform", "foundation", "tavola", "input", "tbl",
    },
    "mass": {
        "mass", "top", "floor", "roof", "deck", "slab", "structure", "specimen", "block", "cart",
        "payload", "superstructure", "massa",
    },
    "right": {"right", "r", "r1", "r2", "dx", "east"},
    "left": {"left", "l", "l1", "l2", "sx", "west"},
}  # fmt: skip
CHANNEL_OF = {
    ("displacement", "command"): "drive_disp_m",
    ("displacement", "table"): "table_disp_m",
    ("displacement", "mass"): "mass_disp_m",
    ("displacement", "relative"): "rel_disp_m",
    ("acceleration", "table"): "table_acc_m_s2",
    ("acceleration", "mass"): "mass_acc_m_s2",
    ("force", "relative"): "damper_force_n",
}
SIDE_CELLS = {"right": RIGHT_CELLS, "left": LEFT_CELLS}
CHANNELS_OF = {
    "displacement": ("rel_disp_m", "mass_disp_m", "table_disp_m", "drive_disp_m"),
    "acceleration": ("mass_acc_m_s2", "table_acc_m_s2"),
    "force": ("damper_force_n", *RIGHT_CELLS, *LEFT_CELLS),
}
FACT_KEYS = ("rate_hz", "mass_kg")
MIN_LENGTH_SHARE = 0.5  # of the other columns, from which a column is one of their recording
OPEN_UNIT = "?"  # in a saved map: refused until a person replaces it


@dataclass(frozen=True)
class ProposedColumn:
    """Source proposed for a channel, or for the time, with the reason for a person."""

    channel: str
    column: str
    unit: str
    reason: str


@dataclass(frozen=True, eq=False)
class MapProposal:
    """Proposed map of a table. `questions` are what a person must answer before an import."""

    columns: tuple[ProposedColumn, ...]
    rate_hz: float | None = None  # to be stated in the map; without times in the file
    file_rate_hz: float | None = None  # that the file states for its columns
    mass_kg: float | None = None
    questions: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    findings: tuple[str, ...] = ()  # on the quality of the samples
    left_out: tuple[str, ...] = ()
    dropped: tuple[str, ...] = ()  # with the reason why they are no columns
    alternatives: dict[str, tuple[str, ...]] = field(default_factory=dict)

    def to_map(self) -> ColumnMap:
        """Return the proposal as a column map, without what is open."""
        return ColumnMap(
            rate_hz=self.rate_hz,
            mass_kg=self.mass_kg,
            columns={
                item.channel: ColumnSource(column=item.column, unit=item.unit)
                for item in self.columns
            },
        )

    def to_toml(self) -> str:
        """Return the text of a map file; what is open stands in it as a remark."""
        lines = [f"# {question}" for question in self.questions]
        lines += [f"rate_hz = {self.rate_hz!r}"] if self.rate_hz is not None else []
        lines += [
            f"mass_kg = {self.mass_kg!r}"
            if self.mass_kg is not None
            else "# mass_kg = 0.0  # of the moving mass; a component test needs none"
        ]
        lines.append("[columns]")
        for item in self.columns:
            unit = f", unit = {json.dumps(item.unit)}" if item.unit else ""
            lines.append(f"{item.channel} = {{ column = {json.dumps(item.column)}{unit} }}")
        for column, channels in self.alternatives.items():
            lines.append(
                f'# {" or ".join(channels)} = {{ column = {json.dumps(column)}, unit = "" }}'
            )
        lines += [f"# ... = {{ column = {json.dumps(name)} }}" for name in self.left_out]
        return "\n".join(lines) + "\n"


def propose_map(
    table: ForeignTable,
    known: ImportColumns = CANONICAL_COLUMNS,
    settings: Mapping[str, Any] | None = None,
) -> MapProposal:
    """Propose the map of a table from names, units, facts and numbers.

    `settings` are keys of a map that the user states: they answer questions.
    """
    stated = {key: float((settings or {})[key]) for key in FACT_KEYS if key in (settings or {})}
    file_hz = table.facts.get("rate_hz")
    if "rate_hz" in stated and file_hz and "other_rate_hz" not in table.facts:
        check_rate(
            stated["rate_hz"], file_hz, table.path, table.kind, MAX_INTERVAL_ERROR, "rate_hz"
        )
    table = replace(table, facts=table.facts | stated)
    names = [name for name in _select_recording(table) if not is_added_column(name)]
    quantities = {name: find_quantity(name, table.columns[name].unit) for name in names}
    questions: list[str] = []
    alternatives: dict[str, tuple[str, ...]] = {}
    chosen: dict[str, str] = {name: name for name in names if name in known.channels}
    time_column = find_time_column(table, names)
    clocks = {table.columns[name].clock for name in names}
    sorted_names = [name for name in names if name not in {*chosen, time_column, *clocks}]
    for quantity, possible in CHANNELS_OF.items():
        group = [name for name in sorted_names if quantities[name] == quantity]
        questions += filter(None, (_ask_contradiction(table, name, quantity) for name in group))
        bodies = {name: _find_body(name) for name in group}
        for name, body in bodies.items():
            channel = _choose_channel(quantity, body, bodies, chosen)
            if channel:
                chosen[channel] = name
            else:
                free = tuple(other for other in possible if other not in chosen)
                alternatives[name] = free
                candidates = " or ".join(free) or "no channel is left"
                questions.append(f"column {name!r}: {quantity} of which body? {candidates}")
    columns: list[ProposedColumn] = []
    if time_column:
        judged = judge_time_unit(table, time_column, stated.get("rate_hz"))
        unit = OPEN_UNIT if judged.question else judged.unit
        columns.append(ProposedColumn(TIME_COLUMN, time_column, unit, judged.reason))
        others = "" if judged.question else describe_other_times(table, names, time_column)
        questions += [question for question in (judged.question, others) if question]
    for channel, name in sorted(chosen.items(), key=lambda item: [*known.channels].index(item[0])):
        unit, reason, question = _propose_unit(table, channel, name, chosen, known)
        columns.append(ProposedColumn(channel, name, OPEN_UNIT if question else unit, reason))
        questions += [question] if question else []
    infos = [table.columns[name] for name in names]
    file_rate_hz = next((info.rate_hz for info in infos if info.rate_hz), None)
    has_time = bool(time_column or file_rate_hz) or any(info.clock for info in infos)
    counts_samples = bool(columns) and columns[0].unit == SAMPLE_UNIT
    rate_hz = stated.get("rate_hz") if counts_samples or not has_time else None
    if rate_hz is None and (counts_samples or not has_time):
        rate_hz, question = _find_rate(table, names)
        questions += [question] if question else []
    questions += _ask_other_sampling(table, names)
    if not (chosen or alternatives):
        questions.append(_ask_columns(table, sorted_names))
    open_names = {*alternatives, *chosen.values(), time_column, *clocks}
    return MapProposal(
        columns=tuple(columns),
        rate_hz=rate_hz,
        file_rate_hz=file_rate_hz,
        mass_kg=table.facts.get("mass_kg"),
        questions=tuple(questions),
        missing=tuple(_list_missing({*chosen}, "mass_kg" in table.facts, settings or {}))
        if chosen
        else (),
        left_out=tuple(name for name in names if name not in open_names),
        dropped=_list_dropped(table, names),
        alternatives=alternatives,
    )


def _find_rate(table: ForeignTable, names: list[str]) -> tuple[float | None, str]:
    """Return (rate in Hz that the file states, question) of a table without usable times."""
    try:
        if rate_hz := find_remark_rate(table):
            return rate_hz, ""
        wrong = describe_unusable_times(table, names) or "no times and no sampling rate found in it"
    except InputError as error:
        wrong = error.problem
    return None, f"{wrong}: state --rate HZ"


def _ask_contradiction(table: ForeignTable, name: str, quantity: str) -> str:
    """Return the question of a column whose name and unit tell two quantities, or ""."""
    named = find_named_quantity(name, with_letters=False)
    if named in ("", quantity):
        return ""
    unit = find_stated_unit(name, table.columns[name].unit)
    return f"column {name!r} is of {named} by its name, of {quantity} by its unit {unit}: which?"


def _ask_columns(table: ForeignTable, names: list[str]) -> str:
    """Return the question of a table none of whose columns is known, with its columns."""
    if not names:
        return "no column of numbers but of times"
    if wrapped := describe_wrapped(table):
        return wrapped
    units = [find_stated_unit(name, table.columns[name].unit) for name in names]
    listed = [f"{name!r}{unit and f' in {unit}'}" for name, unit in zip(names, units, strict=True)]
    gain = ", volts with their gain" if {*units} & {"V", "mV"} else ""
    return (
        f"no column is known by its name or unit, of {abbreviate(listed)}: state in a map what "
        f"each one is{gain}"
    )


def _ask_other_sampling(table: ForeignTable, names: list[str]) -> Iterator[str]:
    """Yield questions on columns of a channel's quantity that are no rows of the recording."""
    if not names:
        return
    usual = table.columns[names[0]]
    for name, column in table.columns.items():
        is_known = name in names or is_added_column(name)
        if is_known or find_quantity(name, column.unit) not in CHANNELS_OF:
            continue
        if column.rate_hz and usual.rate_hz and column.rate_hz != usual.rate_hz:
            yield (
                f"column {name!r} has {column.size} rows at {column.rate_hz:.9g} Hz, others "
                f"{usual.size} at {usual.rate_hz:.9g} Hz: resample it, or leave it out in a map"
            )
        elif column.size > MIN_LENGTH_SHARE * usual.size:
            yield (
                f"column {name!r} has {column.size} rows, others {usual.size}, and no rate tells "
                "which are the same: leave it out in a map, or import it alone"
            )


def _list_dropped(table: ForeignTable, names: list[str]) -> tuple[str, ...]:
    """Return what is no column of the recording, each with the reason."""
    others = [
        f"{name} ({column.size} rows, the others {table.columns[names[0]].size})"
        for name, column in table.columns.items()
        if names and column.size != table.columns[names[0]].size and name not in names
    ]
    dropped = [f"{name} ({why})" for name, why in table.dropped.items() if name not in table.texts]
    return (*others, *dropped)


def _select_recording(table: ForeignTable) -> list[str]:
    """Return the columns of one recording: of the most frequent length, or of its times."""
    sizes = [column.size for column in table.columns.values()]
    size = max(sizes, key=lambda length: (sizes.count(length), length))
    rates = {c.rate_hz for c in table.columns.values() if c.size == size and c.rate_hz}
    return [
        name
        for name, column in table.columns.items()
        if column.size == size or column.rate_hz in rates
    ]


def _find_body(name: str) -> str:
    """Return the body that the name tells, "" if none or several."""
    words = split_words(name)
    bodies = [body for body, known in BODY_WORDS.items() if matches_words(words, known)]
    return bodies[0] if len(bodies) == 1 else ""


def _choose_channel(
    quantity: str, body: str, bodies: dict[str, str], chosen: dict[str, str]
) -> str:
    """Return the free channel of a column, "" if it is open."""
    if quantity == "force" and body in SIDE_CELLS:
        return next((cell for cell in SIDE_CELLS[body] if cell not in chosen), "")
    is_only = len(bodies) == 1
    if is_only and quantity == "force" and body in ("", "mass", "table"):
        body = "relative"
    if is_only and quantity == "displacement" and not body:
        body = "relative"  # a component test: one displacement, one force
    channel = CHANNEL_OF.get((quantity, body), "")
    is_ambiguous = not is_only and [*bodies.values()].count(body) > 1
    return "" if channel in chosen or is_ambiguous else channel


def _propose_unit(
    table: ForeignTable, channel: str, name: str, chosen: dict[str, str], known: ImportColumns
) -> tuple[str, str, str]:
    """Return (unit, reason, question) of the source of a channel."""
    allowed = known.unit_factors(channel)
    stated = find_stated_unit(name, table.columns[name].unit)
    if name == channel:
        return "", "its name", ""
    if find_unit(name) not in ("", stated):
        return "", "", f"column {name!r} states {find_unit(name)}, but its unit {stated}: which?"
    if stated in allowed:
        return stated, "stated in the file", ""
    if stated in UNITS and UNITS[stated][0] == "V":
        return "", "in volts", f"column {name!r} is in volts: state its gain in the map, SI per V"
    text = find_unknown_unit(name) or table.columns[name].unit.strip("- ")
    if text and not any(matches_words([text.lower()], words) for words in BODY_WORDS.values()):
        return "", "", (
            f"column {name!r}: its unit {text!r} is not known; state one of {', '.join(allowed)}"
        )  # fmt: skip
    if known.recorded_unit(channel) not in ("m", "m/s2"):
        return "", "", (
            f"column {name!r}: its unit is not stated; state one of {', '.join(allowed)}"
        )  # fmt: skip
    values = _remove_mean(table.read_column(name))
    plausible = find_plausible_units(known.recorded_unit(channel), values, allowed)
    pair = _unit_by_partner(table, channel, name, chosen)
    if pair:
        return pair, "agrees with the other sensor of the same motion", ""
    reach = f"a range of {np.nanmax(values) - np.nanmin(values):.4g}"
    if len(plausible) == 1:
        return plausible[0], f"not stated; {reach} fits no other unit", ""
    return "", reach, (
        f"column {name!r}: its unit is not stated, {reach} may be in "
        f"{' or '.join(plausible or allowed)}"
    )  # fmt: skip


def _unit_by_partner(table: ForeignTable, channel: str, name: str, chosen: dict[str, str]) -> str:
    """Return the unit of a displacement or acceleration by its partner with a stated unit."""
    rate_hz = table.facts.get("rate_hz") or 1.0
    for disp, acc in CHECKED_PAIRS:
        if channel not in (disp, acc) or not {disp, acc} <= chosen.keys():
            continue
        partner = chosen[acc if channel == disp else disp]
        unit = find_stated_unit(partner, table.columns[partner].unit)
        time = find_time_column(table, [*table.columns])
        if time:
            rate_hz = 1.0 / float(np.median(np.diff(table.read_column(time))))
        if not unit:
            continue
        size = min(table.columns[chosen[name]].size for name in (disp, acc))
        pairs = match_unit_pairs(
            _remove_mean(table.read_column(chosen[disp])[:size]),
            _remove_mean(table.read_column(chosen[acc])[:size]),
            rate_hz,
        )
        fitting = {d if channel == disp else a for d, a in pairs if unit in (d, a)}
        if len(fitting) == 1:
            return fitting.pop()
    return ""


def _remove_mean(values: Float1D) -> Float1D:
    return values - np.nanmean(values)


def _list_missing(chosen: set[str], has_mass: bool, settings: Mapping[str, Any]) -> Iterator[str]:
    """Yield what an analysis would need in addition."""
    displacement = (
        "rel_disp_m" in chosen
        or {"mass_disp_m", "table_disp_m"} <= chosen
        or "integrate_hz" in settings
    )
    accelerations = {"mass_acc_m_s2", "table_acc_m_s2"} <= chosen
    if not displacement and accelerations:
        yield "a relative displacement: --integrate LOW:HIGH (Hz) derives it"
    elif not displacement:
        yield "a relative displacement (rel_disp_m, or mass_disp_m and table_disp_m)"
    if not chosen & {"damper_force_n", "mass_acc_m_s2", "table_acc_m_s2"}:
        yield "a force: damper_force_n, or mass_acc_m_s2 or table_acc_m_s2 with the mass"
    if not chosen & {"table_acc_m_s2"} and "damper_force_n" not in chosen:
        yield "table_acc_m_s2: without it no twin and no replay"
    if not has_mass and "damper_force_n" not in chosen:
        yield "the mass: state --mass KG, else forces are per unit mass"
    if not chosen & {*RIGHT_CELLS, *LEFT_CELLS} and "damper_force_n" not in chosen:
        yield "load cells: bumper forces are then known by the inertia of the mass only"
