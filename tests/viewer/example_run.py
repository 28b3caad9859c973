"""A run to be shown: sines, contacts, every kind of record; and what a .rrd file holds of it."""

from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rerun.chunk import RrdReader

from table_io.block import Block, Label
from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import PROFILES_DIR
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    Extremes,
    Fault,
    JumpForecast,
    Level,
    NormalizedResponse,
    Params,
    PrcPoint,
    Record,
    RunStart,
    RunStop,
    SampleGap,
    Step,
    Timing,
)
from tests.builders.recordings import store_items
from twin.compare import TWIN_CHANNELS
from twin.recording.reader import Recording

RATE_HZ = 2000.0
SAMPLE_COUNT = 12000
STEPS = (
    Step(0, "forward", 2.0, 0.49),
    Step(1, "forward", 2.5, 0.49),
    Step(2, "backward", 2.0, 0.49),
)
MEASURED = tuple(CHANNEL_BY_NAME)[:9]


def start(gap_mm: str = "4.0") -> RunStart:
    profile = (
        (PROFILES_DIR / "tests/g4_ss3.toml")
        .read_text()
        .replace("gap_mm = 4.0", f"gap_mm = {gap_mm}")
    )
    return RunStart(
        index=0, run="r1", name="synthetic", source="table", profile_toml=profile, rig_toml="",
        model_toml="", rate_hz=RATE_HZ, block_samples=20, channels=MEASURED, steps=STEPS,
        planned_samples=SAMPLE_COUNT, tare={}, versions={}, host="here", started_at="", epoch_s=0.0,
    )  # fmt: skip


def samples() -> tuple[Any, Any]:
    """(measured, predicted) values (channel, sample): sines, and a force beyond the gap."""
    t = np.arange(SAMPLE_COUNT) / RATE_HZ
    table, u = 2e-3 * np.sin(4 * np.pi * t), 4e-3 * np.sin(4 * np.pi * t + 1)
    right, left = 5e5 * np.clip(u - 2e-3, 0, None), 5e5 * np.clip(-u - 2e-3, 0, None)
    acc, v = -2.0 * np.sin(4 * np.pi * t + 1), np.gradient(u) * RATE_HZ
    cells = [right / 2, right / 2, left / 2, left / 2]
    measured = np.stack([table, table, 0.49 * np.sin(4 * np.pi * t), table + u, acc, *cells])
    track = np.stack([u, v, table + u, acc, *cells])
    return measured, np.concatenate([1.1 * track, track])


def blocks(size: int = 20, skip: Sequence[int] = ()) -> list[Block]:
    """Both streams, block by block; `skip` are the numbers of lost measured blocks."""
    measured, predicted = samples()
    step = np.minimum(np.arange(SAMPLE_COUNT) * len(STEPS) // SAMPLE_COUNT, len(STEPS) - 1)
    label = np.full(SAMPLE_COUNT, Label.MEASURE, dtype=np.int64)
    cut = []
    for number, first in enumerate(range(0, SAMPLE_COUNT, size)):
        part = slice(first, first + size)
        labels = (step[part].copy(), label[part].copy(), np.zeros_like(step[part]))
        for name, names, values in (
            ("meas", MEASURED, measured),
            ("pred", TWIN_CHANNELS, predicted),
        ):
            if name == "pred" or number not in skip:
                cut.append(Block(name, first, RATE_HZ, names, values[:, part].copy(), *labels))
    return cut


def records() -> list[Record]:
    nan = float("nan")
    extremes = Extremes(4e-3, -4e-3, 2.0, -2.0, 1000.0, 1000.0, (100,), (600, 700))
    items: list[Record] = [
        Event(10, "step", "2 Hz"),
        SampleGap(400, 20, "", "late"),
        Params(5, {}, "start"),
    ]
    for step in STEPS:
        end = (step.index + 1) * SAMPLE_COUNT // len(STEPS)
        eta = 0.2 + 0.1 * step.index
        quantities = NormalizedResponse(eta, eta, eta, eta, eta, nan, (1, 1), (), 0.0, 0.0)
        twin = None if step.index == 1 else quantities
        point = (step.index, step.direction, step.frequency_hz, quantities, twin, 0.49, 0.49, 0.01)
        items += [PrcPoint(end, *point), CycleExtremes(end, step.index, 0, 3, 1000, extremes, None)]
    items += [
        Comparison(k, 20, ("rel_disp_m",), (4.0,), (1.0,), (0.04,))
        for k in range(0, SAMPLE_COUNT, 20)
    ]
    items += [
        Fault(900, "twin", 900, 1000, "killed"),
        Timing(0, "a b/c", 1, 2, 3, 0, 9, 0.1, "other"),
    ]
    for index, error in ((4000, 0.5), (8000, 2.0)):
        parts = (2 * (error, nan), 2 * (nan, nan), 2 * (2 * error, 3.0))
        names = ("force_r1_n", "force_r2_n", "mass_acc_m_s2", "rel_disp_m")
        errors, bands = (error, 3.0, nan, error), (1.0, 2.0, 1.0, 0.0)
        items.append(Agreement(index, 0, 0, 1000, names, errors, bands, *parts))
    values = (1e5 + 1e3, 300.0, 1e-3 + 2e-5), (500.0, 3.0, 1e-5), (1e3, 0.0, 2e-5)
    items.append(Estimate(8000, 1, ("stiffness", "damping", "gap_r"), *values, (200.0, 3.0, 1e-5)))
    items.append(JumpForecast(4000, 0, "forward", 2.0, "down", 2.4, 2.3, 9.0))
    items.append(JumpForecast(8000, 1, "forward", 2.5, "", 2.2, 2.1, 2.3))
    items.append(Level(7000, 1, 0.5, 0.4, 1.1, 1, False, ()))
    items += [Event(6000, "warning", "u left its band"), Event(6000, "warning", "u left its band")]
    return [*items, RunStop(SAMPLE_COUNT, "complete", "played")]


def recording(items: Sequence[Block | Record], begin: RunStart | None = None) -> Recording:
    begin = begin or start()
    ordered = sorted(items, key=lambda item: item.index)
    return Recording(Path("run.mcap"), "r1", begin, store_items([begin, *ordered]), True)


@cache
def content(path: Path) -> dict[str, dict[str, tuple[Any, ...]]]:
    """{entity: {component: (times in ns, rows as lists)}} of what changes over time."""
    tables: dict[str, dict[str, list[tuple[int, Any]]]] = {}
    for chunk in RrdReader(path).stream():
        if chunk.is_static:
            continue
        batch = chunk.to_record_batch()
        times = batch.column("time").cast("int64").to_pylist()
        for name in batch.schema.names:
            if ":" in name:
                rows = tables.setdefault(chunk.entity_path, {}).setdefault(name, [])
                rows.extend(zip(times, batch.column(name).to_pylist(), strict=True))
    return {
        entity: {name: tuple(zip(*rows, strict=True)) for name, rows in columns.items()}
        for entity, columns in tables.items()
    }


def scalars(path: Path, entity: str) -> tuple[Any, Any]:
    """(times in s (row,), values (row, series)) of an entity."""
    times, rows = content(path)[entity]["Scalars:scalars"]
    return np.array(times) / 1e9, np.array(rows, dtype=np.float64)
