"""Several recordings and models replayed in one go, and the table that compares them."""

import csv
import math
from itertools import product
from pathlib import Path
from typing import Any

from rich.table import Table

from table_io.card import BadInput
from twin.service import summary as summaries
from twin.service.folders import new_run
from twin.service.outcome import EXIT_GAPS, EXIT_NOT_IDENTICAL
from twin.service.replay import (
    RECORDED,
    Asked,
    about,
    bundle_with,
    driven,
    factor,
    open_recorded,
    said,
    span_of,
)
from twin.service.replaying import replay
from twin.service.terminal import console, print_table, say
from twin.stream.folder import log_path
from twin.stream.recording import read
from twin.stream.wire import MEAS_TOPIC, PRED_TOPIC, TOPIC_TYPES

Row = dict[str, Any]
QUANTITIES = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
SHOWN = {
    "u": "nrmse rel_disp_m", "a": "nrmse mass_acc_m_s2", "F_R": "nrmse force_r1_n",
    "F_L": "nrmse force_l1_n", "u free": "free_nrmse rel_disp_m", "PRC eta_d": "prc eta_d",
}  # fmt: skip


def replay_all(asked: Asked) -> int:
    """Every log with every model into a folder each; comparison.json and .csv beside; exit code."""
    if factor(asked.speed) is not None:
        raise BadInput(f"--speed {asked.speed}: several replays go at full speed; leave it away")
    models, names = asked.models or [RECORDED], _names(asked.logs)
    _possible(asked, models, names)
    folder, _ = new_run(asked.out, "replays")
    rows: list[Row] = []
    for log, name in zip(asked.logs, names, strict=True):
        recorded = open_recorded(log)
        span = span_of(recorded.recording, asked.steps)
        for model in models:
            bundle = bundle_with(recorded.recording, model)
            where = folder / _place(name, model)
            where.mkdir()
            made = where / "run.mcap"
            identity = replay(recorded, bundle, made, where.name, lambda _: None, span)
            told = about(recorded, bundle, model, identity, made)
            found = summaries.summarise(
                read(made, TOPIC_TYPES.keys() - {PRED_TOPIC}), bundle.parameters
            )
            summaries.write({**found, "replay": told}, where / "summary.json")
            say(f"{where.name}: {said(identity, told)}")
            rows.append({"log": name, "model": model, **_row(found, told)})
    _write(folder, rows)
    print_table(console, _table(rows))
    say(f"{folder / 'comparison.csv'}, {folder / 'comparison.json'}; a page of one: "
        f"shaketwin report {folder / '<log>-<model>'}")  # fmt: skip
    if any(row["same_model"] and row["identical"] is False for row in rows):
        return EXIT_NOT_IDENTICAL
    return EXIT_GAPS if any(row["gaps"] for row in rows) else 0


def _possible(asked: Asked, models: list[str], names: list[str]) -> None:
    """BadInput where one of the replays cannot be: said before the first, which may take hours."""
    taken: dict[str, str] = {}
    for model, name in product(models, names):
        place = _place(name, model)
        if place in taken:
            raise BadInput(
                f"--model {model}: its results would be {place}, as those of {taken[place]}; "
                "give each model once, and two of one name under other names"
            )
        taken[place] = model
    for log in asked.logs:
        # Only what says whether it can be: whole recordings are opened when their turn comes.
        recording = read(log_path(log), () if asked.steps is None else (MEAS_TOPIC,))
        driven(recording)
        span_of(recording, asked.steps)
        for model in models:
            bundle_with(recording, model)


def _place(name: str, model: str) -> str:
    """Folder of a replay."""
    return f"{name}-{Path(model).stem}"


def _names(logs: list[Path]) -> list[str]:
    """A name for each log: its folder's, or its own; numbered where there are several."""
    names: list[str] = []
    for log in logs:
        path = log_path(log).absolute()
        name = path.parent.name if path.name == "run.mcap" else path.stem
        taken = sum(one == name or one.startswith(f"{name}-") for one in names)
        names.append(f"{name}-{taken + 1}" if name in names else name)
    return names


def _row(found: summaries.Json, told: summaries.Json) -> Row:
    """What is compared of one replay; shares as ratios, None where there is nothing to compare."""
    nrmse = {
        f"{kind} {channel}": values[kind]
        for channel, values in found["comparison"].items()
        for kind in ("nrmse", "free_nrmse")
    }
    pairs = [
        (step["measured"], step["twin"])
        for step in found["steps"]
        if step["measured"] and step["twin"]
    ]
    return {
        "same_model": told["model"] == RECORDED,
        "identical": told["identical"],
        "gaps": found["gaps"],
        **nrmse,
        **{f"prc {name}": _prc_error(pairs, name) for name in QUANTITIES},
        "steps": len(pairs),
        "steps_with_the_same_impacts": sum(_impacts(rig) == _impacts(twin) for rig, twin in pairs),
        "jumps": _jumps(found["jumps"]),
        "twin_jumps": _jumps(found["twin_jumps"]),
    }


def _prc_error(pairs: list[tuple[summaries.Json, summaries.Json]], name: str) -> float | None:
    """Rms over the steps of twin minus measured, over the rms of the measured curve."""
    known = [
        (rig[name], twin[name])
        for rig, twin in pairs
        if math.isfinite(rig[name]) and math.isfinite(twin[name])
    ]
    signal = sum(rig**2 for rig, _ in known)
    return math.sqrt(sum((twin - rig) ** 2 for rig, twin in known) / signal) if signal else None


def _impacts(values: summaries.Json) -> tuple[int, ...]:
    """Impacts of a whole step, right and left: per cycle they are counted between other cuts."""
    return tuple(sum(values[f"impacts_{side}"]) for side in ("right", "left"))


def _jumps(jumps: list[summaries.Json]) -> str:
    return ", ".join(f"{one['kind']} {one['from_hz']:g}-{one['to_hz']:g} Hz" for one in jumps)


def _write(folder: Path, rows: list[Row]) -> None:
    summaries.write({"replays": rows}, folder / "comparison.json")
    names = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "comparison.csv").open("x", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def _table(rows: list[Row]) -> Table:
    """NRMSE of the restarted twin by channel, of u free-running, PRC, impacts and jumps."""
    table = Table(title="Replays: error of the twin over the signal, in per cent")
    heads = ("log", "model", *SHOWN, "same impacts", "jumps", "twin's jumps", "bits")
    for head in heads:
        table.add_column(head, justify="right" if head in SHOWN else "left")
    for row in rows:
        shares = [row.get(key) for key in SHOWN.values()]
        cells = ["-" if share is None else f"{100 * share:.3g}" for share in shares]
        same = f"{row['steps_with_the_same_impacts']} of {row['steps']} steps"
        bits = {True: "identical", False: "differ", None: "-"}[row["identical"]]
        table.add_row(
            row["log"], str(row["model"]), *cells, same, row["jumps"], row["twin_jumps"], bits
        )
    return table
