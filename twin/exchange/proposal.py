"""Proposal of a column map for a foreign table: channels, units, sampling rate and mass.

Nothing is imported by a guess: the proposal is printed with its reasons, and the user accepts it
or saves it as a map to edit. What names and units leave open is a question, never a choice.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.units import UNITS
from twin.exchange.columns import CANONICAL_COLUMNS, ColumnMap, ColumnSource, ImportColumns
from twin.exchange.formats import SampleTable
from twin.exchange.formats.layout import TIME_UNITS, find_unit, is_unit, normalize_unit
from twin.exchange.plausibility import CHECKED_PAIRS, find_plausible_units, match_unit_pairs
from twin.recording.tabular import LABEL_UNITS, TIME_COLUMN, TWIN_PREFIX

QUANTITY_WORDS = {
    "time": {"t", "time", "timestamp", "elapsed", "zeit", "tempo"},
    "displacement": {
        "x", "u", "d", "disp", "displ", "displacement", "dist", "distance", "pos", "position",
        "laser", "lvdt", "stroke", "deformation", "elongation", "spostamento", "weg",
    },
    "acceleration": {"a", "acc", "accel", "acceleration", "accelerometer", "accelerazione"},
    "force": {"f", "force", "forc", "load", "loadcell", "cell", "lc", "reaction", "forza", "kraft"},
    "velocity": {"v", "vel", "velocity", "speed"},
}  # fmt: skip
QUANTITY_UNITS = {"m": "displacement", "m/s2": "acceleration", "N": "force", "m/s": "velocity"}
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
OPEN_UNIT = "?"  # in a saved map: refused until a person replaces it
MIN_PREFIX_LETTERS = 4  # "accelero" is an accelerometer
INTERVAL_SPREAD = 0.01  # relative, of a column of times


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
    rate_hz: float | None = None
    mass_kg: float | None = None
    questions: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    left_out: tuple[str, ...] = ()
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
    table: SampleTable,
    known: ImportColumns = CANONICAL_COLUMNS,
    settings: Mapping[str, Any] | None = None,
) -> MapProposal:
    """Propose the map of a table from names, units, facts and numbers.

    `settings` are keys of a map that the user states: they answer questions.
    """
    stated = {key: float((settings or {})[key]) for key in FACT_KEYS if key in (settings or {})}
    table = replace(table, facts=table.facts | stated)
    names = [
        name
        for name in _longest_columns(table)
        if name not in LABEL_UNITS and not name.startswith(TWIN_PREFIX)
    ]
    quantities = {name: _find_quantity(table, name) for name in names}
    questions: list[str] = []
    alternatives: dict[str, tuple[str, ...]] = {}
    chosen: dict[str, str] = {name: name for name in names if name in known.channels}
    time_column = _find_time(table, names, quantities)
    sorted_names = [name for name in names if name not in chosen and name != time_column]
    for quantity, possible in CHANNELS_OF.items():
        group = [name for name in sorted_names if quantities[name] == quantity]
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
    columns = [
        ProposedColumn(TIME_COLUMN, time_column, *_propose_time_unit(table, time_column))
    ] if time_column else []  # fmt: skip
    for channel, name in sorted(chosen.items(), key=lambda item: [*known.channels].index(item[0])):
        unit, reason, question = _propose_unit(table, channel, name, chosen, known)
        columns.append(ProposedColumn(channel, name, OPEN_UNIT if question else unit, reason))
        questions += [question] if question else []
    infos = [table.columns[name] for name in chosen.values()]
    has_time = bool(time_column) or any(info.clock or info.rate_hz for info in infos)
    rate_hz = None if has_time else table.facts.get("rate_hz")
    if not has_time and rate_hz is None:
        questions.append("no times and no sampling rate in the file: state --rate HZ")
    if not chosen:
        questions.append("no column is known by its name or unit: state the columns in a map")
    open_names = {*alternatives, *chosen.values(), time_column}
    return MapProposal(
        tuple(columns), rate_hz, table.facts.get("mass_kg"), tuple(questions),
        tuple(_list_missing({*chosen}, "mass_kg" in table.facts, settings or {}))
        if chosen
        else (),
        tuple(name for name in names if name not in open_names),
        alternatives,
    )  # fmt: skip


def _longest_columns(table: SampleTable) -> list[str]:
    """Return the columns of the most frequent length: those of one recording."""
    sizes = [info.size for info in table.columns.values()]
    size = max(sizes, key=lambda length: (sizes.count(length), length))
    return [name for name, info in table.columns.items() if info.size == size]


def _split_words(name: str) -> list[str]:
    """Return the lower-case words of a column name, without a unit in brackets at its end."""
    bare = re.sub(r"[(\[][^()\[\]]*[)\]]\s*$", "", name)
    spaced = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", bare)
    return [word for word in re.split(r"[^a-zA-Z0-9]+", spaced.lower()) if word]


def _stated_unit(table: SampleTable, name: str) -> str:
    """Return the unit that the file or the end of the name states, "" without one."""
    unit = normalize_unit(table.columns[name].unit) or find_unit(name)
    if unit:
        return unit
    words = re.split(r"[^a-zA-Z0-9/²]+", name.strip(" )]"))
    if len(words) > 2 and is_unit("/".join(words[-2:])):  # acc_m_s2
        return normalize_unit("/".join(words[-2:]))
    return normalize_unit(words[-1]) if len(words) > 1 and is_unit(words[-1]) else ""


def _matches(words: Sequence[str], known: set[str]) -> bool:
    return any(
        word.rstrip("0123456789") in known
        or word in known
        or (
            len(word) >= MIN_PREFIX_LETTERS
            and any(len(k) >= MIN_PREFIX_LETTERS and word.startswith(k) for k in known)
        )
        for word in words
    )


def _find_quantity(table: SampleTable, name: str) -> str:
    """Return the quantity of a column by its unit, else by its name; "" if neither tells."""
    unit = _stated_unit(table, name)
    by_unit = QUANTITY_UNITS.get(UNITS[unit][0]) if unit in UNITS else None
    if by_unit:
        return by_unit
    words = _split_words(name)
    quantities = [key for key, known in QUANTITY_WORDS.items() if _matches(words, known)]
    long_words = [word for word in words if len(word.rstrip("0123456789")) > 1]
    if len(quantities) > 1:  # "acc x": a letter may be an axis
        quantities = [
            key for key, known in QUANTITY_WORDS.items() if _matches(long_words, known)
        ] or quantities
    return quantities[0] if len(quantities) == 1 else ""


def _find_body(name: str) -> str:
    """Return the body that the name tells, "" if none or several."""
    words = _split_words(name)
    bodies = [body for body, known in BODY_WORDS.items() if _matches(words, known)]
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


def _find_time(table: SampleTable, names: list[str], quantities: dict[str, str]) -> str:
    """Return the column of times, "" without one: by its name, else by numbers that rise evenly."""
    by_name = [name for name in names if quantities[name] == "time" or name == TIME_COLUMN]
    for name in by_name or [name for name in names if not quantities[name]]:
        values = table.read_column(name)
        steps = np.diff(values)
        if steps.size > 1 and (steps > 0).all():
            spread = float(np.std(steps) / np.mean(steps))
            if by_name or spread < INTERVAL_SPREAD:
                return name
    return ""


def _propose_time_unit(table: SampleTable, name: str) -> tuple[str, str]:
    """Return (unit, reason) of a column of times."""
    unit = _stated_unit(table, name)
    if unit in TIME_UNITS:
        return unit, "stated in the file"
    rate_hz = table.facts.get("rate_hz")
    step = float(np.median(np.diff(table.read_column(name))))
    if rate_hz:
        for candidate, factor in TIME_UNITS.items():
            if abs(step * factor * rate_hz - 1) < INTERVAL_SPREAD:
                return candidate, f"agrees with the {rate_hz:g} Hz of the file"
    return "s", f"a step of {step:.4g} s"


def _propose_unit(
    table: SampleTable, channel: str, name: str, chosen: dict[str, str], known: ImportColumns
) -> tuple[str, str, str]:
    """Return (unit, reason, question) of the source of a channel."""
    allowed = known.unit_factors(channel)
    stated = _stated_unit(table, name)
    if name == channel:
        return "", "its name", ""
    if stated in allowed:
        return stated, "stated in the file", ""
    if stated in UNITS and UNITS[stated][0] == "V":
        return "", "in volts", f"column {name!r} is in volts: state its gain in the map, SI per V"
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


def _unit_by_partner(table: SampleTable, channel: str, name: str, chosen: dict[str, str]) -> str:
    """Return the unit of a displacement or acceleration by its partner with a stated unit."""
    rate_hz = table.facts.get("rate_hz") or 1.0
    for disp, acc in CHECKED_PAIRS:
        if channel not in (disp, acc) or not {disp, acc} <= chosen.keys():
            continue
        partner = chosen[acc if channel == disp else disp]
        unit = _stated_unit(table, partner)
        time = _find_time(table, [*table.columns], dict.fromkeys(table.columns, ""))
        if time:
            rate_hz = 1.0 / float(np.median(np.diff(table.read_column(time))))
        if not unit:
            continue
        pairs = match_unit_pairs(
            _remove_mean(table.read_column(chosen[disp])),
            _remove_mean(table.read_column(chosen[acc])),
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
