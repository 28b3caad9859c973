"""Replay of several recordings and models, with a table of comparison."""

import csv
import math
from itertools import product
from pathlib import Path
from typing import Any

from rich.table import Table

from table_io.errors import InputError
from twin.recording.reader import read_recording
from twin.recording.run_paths import resolve_log_path
from twin.replay.command import (
    RECORDED,
    ReplayRequest,
    describe_replay,
    format_identity,
    load_replay_config,
    open_replay_log,
    parse_speed,
    require_drive_channel,
    select_span,
)
from twin.replay.pipeline_replay import replay_recording
from twin.report.finalize import EXIT_GAPS, EXIT_NOT_IDENTICAL
from twin.results import summary as summaries
from twin.setup.folders import make_run_folder
from twin.system.terminal import console, print_line, print_table
from twin.transport.codec import TOPIC_TYPES
from twin.transport.endpoint import MEAS_TOPIC, PRED_TOPIC

Row = dict[str, Any]
PRC_QUANTITIES = ("eta_d", "eta_a", "eta_r", "eta_l", "r_r", "r_l")
TABLE_COLUMNS = {
    "u": "nrmse rel_disp_m", "a": "nrmse mass_acc_m_s2", "F_R": "nrmse force_r1_n",
    "F_L": "nrmse force_l1_n", "u free": "free_nrmse rel_disp_m", "PRC eta_d": "prc eta_d",
}  # fmt: skip


def replay_all(request: ReplayRequest) -> int:
    """Replay every log with every model; return the exit code.

    Each replay has a folder; comparison.json and comparison.csv are written next to them.
    """
    if parse_speed(request.speed) is not None:
        raise InputError(
            "several replays run at full speed only",
            where=f"--speed {request.speed}",
            remedy="omit it",
        )
    models, names = request.models or [RECORDED], _name_logs(request.logs)
    _check_replays(request, models, names)
    folder, _ = make_run_folder(request.out, "replays")
    rows: list[Row] = []
    for log, name in zip(request.logs, names, strict=True):
        recorded = open_replay_log(log)
        span = select_span(recorded.recording, request.steps)
        for model in models:
            config = load_replay_config(recorded.recording, model)
            replay_folder = folder / _folder_name(name, model)
            replay_folder.mkdir()
            new_log = replay_folder / "run.mcap"
            identity = replay_recording(
                recorded, config, new_log, replay_folder.name, lambda _: None, span
            )
            comparison = describe_replay(recorded, config, model, identity, new_log)
            summary = summaries.summarise(
                read_recording(new_log, TOPIC_TYPES.keys() - {PRED_TOPIC}), config.parameters
            )
            summaries.write_summary(
                {**summary, "replay": comparison}, replay_folder / "summary.json"
            )
            print_line(f"{replay_folder.name}: {format_identity(identity, comparison)}")
            rows.append({"log": name, "model": model, **_make_row(summary, comparison)})
    _write_comparison(folder, rows)
    print_table(console, _make_table(rows))
    print_line(f"{folder / 'comparison.csv'}, {folder / 'comparison.json'}; a page of one: "
        f"shaketwin report {folder / '<log>-<model>'}")  # fmt: skip
    if any(row["same_model"] and row["identical"] is False for row in rows):
        return EXIT_NOT_IDENTICAL
    return EXIT_GAPS if any(row["gaps"] for row in rows) else 0


def _check_replays(request: ReplayRequest, models: list[str], names: list[str]) -> None:
    """Raise InputError if any replay is impossible, before the first: all may take hours."""
    model_of_folder: dict[str, str] = {}
    for model, name in product(models, names):
        folder_name = _folder_name(name, model)
        if folder_name in model_of_folder:
            raise InputError(
                f"its results would be {folder_name}, as those of {model_of_folder[folder_name]}",
                where=f"--model {model}",
                remedy="give each model once, and two of one name under other names",
            )
        model_of_folder[folder_name] = model
    for log in request.logs:
        # Read only what the checks need; each whole recording is read for its replay.
        recording = read_recording(
            resolve_log_path(log), () if request.steps is None else (MEAS_TOPIC,)
        )
        require_drive_channel(recording)
        select_span(recording, request.steps)
        for model in models:
            load_replay_config(recording, model)


def _folder_name(name: str, model: str) -> str:
    """Return the folder name of a replay."""
    return f"{name}-{Path(model).stem}"


def _name_logs(logs: list[Path]) -> list[str]:
    """Return a name for each log: of its folder or file, numbered if not unique."""
    names: list[str] = []
    for log in logs:
        path = resolve_log_path(log).absolute()
        name = path.parent.name if path.name == "run.mcap" else path.stem
        taken_count = sum(other == name or other.startswith(f"{name}-") for other in names)
        names.append(f"{name}-{taken_count + 1}" if name in names else name)
    return names


def _make_row(summary: summaries.Json, comparison: summaries.Json) -> Row:
    """Return the comparison of one replay; errors as ratios, None if not comparable."""
    nrmse = {
        f"{kind} {channel}": values[kind]
        for channel, values in summary["comparison"].items()
        for kind in ("nrmse", "free_nrmse")
    }
    pairs = [
        (step["measured"], step["twin"])
        for step in summary["steps"]
        if step["measured"] and step["twin"]
    ]
    return {
        "same_model": comparison["model"] == RECORDED,
        "identical": comparison["identical"],
        "gaps": summary["gaps"],
        **nrmse,
        **{f"prc {name}": _prc_error(pairs, name) for name in PRC_QUANTITIES},
        "steps": len(pairs),
        "steps_with_the_same_impacts": sum(
            _count_impacts(rig) == _count_impacts(twin) for rig, twin in pairs
        ),
        "jumps": _format_jumps(summary["jumps"]),
        "twin_jumps": _format_jumps(summary["twin_jumps"]),
    }


def _prc_error(pairs: list[tuple[summaries.Json, summaries.Json]], name: str) -> float | None:
    """Return the relative error of a PRC quantity: rms of twin minus measured over rms measured."""
    known = [
        (rig[name], twin[name])
        for rig, twin in pairs
        if math.isfinite(rig[name]) and math.isfinite(twin[name])
    ]
    signal = sum(rig**2 for rig, _ in known)
    return math.sqrt(sum((twin - rig) ** 2 for rig, twin in known) / signal) if signal else None


def _count_impacts(values: summaries.Json) -> tuple[int, ...]:
    """Return the impacts of a whole step, right and left.

    Twin and rig cut cycles at different samples, so that counts per cycle may differ.
    """
    return tuple(sum(values[f"impacts_{side}"]) for side in ("right", "left"))


def _format_jumps(jumps: list[summaries.Json]) -> str:
    return ", ".join(f"{jump['kind']} {jump['from_hz']:g}-{jump['to_hz']:g} Hz" for jump in jumps)


def _write_comparison(folder: Path, rows: list[Row]) -> None:
    summaries.write_json({"replays": rows}, folder / "comparison.json")
    names = list(dict.fromkeys(name for row in rows for name in row))
    with (folder / "comparison.csv").open("x", newline="") as file:
        writer = csv.DictWriter(file, names)
        writer.writeheader()
        writer.writerows(rows)


def _make_table(rows: list[Row]) -> Table:
    """Make the table of NRMSE by channel (u also free-running), PRC error, impacts and jumps."""
    table = Table(title="Replays: error of the twin over the signal, in per cent")
    heads = ("log", "model", *TABLE_COLUMNS, "same impacts", "jumps", "twin's jumps", "bits")
    for head in heads:
        table.add_column(head, justify="right" if head in TABLE_COLUMNS else "left")
    for row in rows:
        shares = [row.get(key) for key in TABLE_COLUMNS.values()]
        cells = ["-" if share is None else f"{100 * share:.3g}" for share in shares]
        same = f"{row['steps_with_the_same_impacts']} of {row['steps']} steps"
        bits = {True: "identical", False: "differ", None: "-"}[row["identical"]]
        table.add_row(
            row["log"], str(row["model"]), *cells, same, row["jumps"], row["twin_jumps"], bits
        )
    return table
