"""`import`: somebody's table of samples becomes a log like one of ours."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.block import Block, Float1D, Float2D
from table_io.card import BadInput, find, load, parse
from table_io.profile import Profile
from table_io.records import Event, Gap, RunStart, RunStop, Step
from table_io.rig import Rig
from twin.learn.steps import Found, find_steps
from twin.service.bundle import Bundle, from_texts, read_model, run_id
from twin.service.columns import Samples, read_map, samples
from twin.service.kernels import ready
from twin.service.labels import found_labels, held_cycles
from twin.service.outcome import EXIT_GAPS
from twin.service.progress import RunProgress
from twin.service.runs import SIMULATED_BLOCK, beside, record
from twin.service.sampling import holes
from twin.service.terminal import console, say
from twin.stream.tables import TEXTS, Table, read_table
from twin.stream.wire import Item

NO_PROFILE = (
    "warning: no --profile: unit mass, no bumpers, a 1 Hz placeholder model; PRC and twin mean "
    "nothing, give --profile"
)
MOTIONS = ("drive_disp_m", "table_disp_m", "table_acc_m_s2", "rel_disp_m")  # the first tells steps
MOST_GAPS = 1000  # a channel: beyond, its lost samples are only counted
SPARSE = 10  # samples a row, on the average, at most: else the file is no one recording
PLAIN_PROFILE = """\
title = {title}
notes = "No profile was given: a unit mass without bumpers, so a force is one per unit mass."
rig = {rig}
[specimen]
mass_kg = 1.0
gap_mm = inf
[acquisition]
rate_hz = {rate_hz!r}
[sweep]
start_hz = {hz!r}
stop_hz = {hz!r}
step_hz = {hz!r}
cycles = {cycles}
measured_cycles = {measured}
"""
PLAIN_MODEL = """\
title = "Placeholder: 1 Hz, 5 % damping; nothing was said of the specimen, give --model"
[base]
stiffness_n_m = 39.47841760435743
damping_n_s_m = 0.6283185307179586
bumper_stiffness_n_m = 1.0
bumper_damping_n_s_m = 0.0
"""


@dataclass(frozen=True, eq=False)
class _Grid:
    """Samples on their whole grid, NaN in the holes: values (channel, sample)."""

    channels: tuple[str, ...]
    values: Float2D
    holes: list[tuple[int, int]]

    @property
    def size(self) -> int:
        return int(self.values.shape[1])

    @property
    def pieces(self) -> Iterator[tuple[int, int]]:
        """(first, end) of what lies between the holes."""
        first = 0
        for at, count in self.holes:
            yield first, at
            first = at + count
        yield first, self.size


def take_in(
    file: Path, out: Path, profile: Path | None, rig: str | None, columns: Path | None
) -> int:
    """The table in `file` as a new log at `out`; the exit code."""
    if out.exists():
        raise BadInput(f"{out}: exists already; nothing recorded is ever overwritten")
    if out.suffix != ".mcap":
        raise BadInput(f"{out}: a log is a file that ends in .mcap; name it so")
    card = read_map(columns)
    if profile is not None:
        load(profile, Profile, "test profile")  # said now, not after a long table
    table = read_table(file, card.group if card is not None else "")
    found = samples(table, card)
    own = found_labels(table, found) if found.labels else None
    bundle = _bundle(table, profile, rig, found.rate_hz, own)
    grid = _grid(file, found)
    if own is not None:
        labels = own
    else:
        signal, is_acc = _motion(grid)
        labels = find_steps(
            signal, found.rate_hz, bundle.profile.sweep, is_acc=is_acc, on_grid=profile is not None
        )
    steps = labels.steps or bundle.steps
    bundle = replace(bundle, drive=replace(bundle.drive, steps=steps))
    bare = (NO_PROFILE,) if profile is None and not _brings_texts(table) else ()
    said = (*bare, *found.said, *labels.said, _of_steps(labels.steps))
    gaps = 0
    with RunProgress(console, len(steps), grid.size) as progress:

        def watch(item: Item) -> None:
            nonlocal gaps
            gaps += isinstance(item, Gap)
            progress(item)

        run = run_id(file.stem)
        start = replace(
            bundle.describe(run, "table")({}, 0.0),
            channels=grid.channels,
            planned_samples=grid.size,
        )
        items = _items(file, start, grid, labels, said)
        if "table_acc_m_s2" in grid.channels:
            ready(bundle)
            items = beside(items, bundle.twin())
        out.parent.mkdir(parents=True, exist_ok=True)
        record(items, out, run, found.rate_hz, watch)
    say(f"{grid.size} samples of {len(grid.channels)} channels, {gaps} gaps -> {out}")
    return EXIT_GAPS if gaps else 0


def contents(file: Path, columns: Path | None) -> None:
    """Says what a file holds, a line each."""
    card = read_map(columns)
    for line in read_table(file, card.group if card is not None else "").contents:
        say(line)


def _brings_texts(table: Table) -> bool:
    """Whether profile, machine card and model came with the samples, as out of our own export."""
    return len(table.texts) == len(TEXTS)


def _bundle(
    table: Table, profile: Path | None, rig: str | None, rate_hz: float, labels: Found | None
) -> Bundle:
    """What the log will say of specimen, machine and model, at the file's rate."""
    file = table.path
    if profile is None and _brings_texts(table):
        profile_toml, rig_toml, model_toml = (table.texts[name] for name in TEXTS)
        own = parse(profile_toml, Profile, f"profile in {file}")
        if own.acquisition.rate_hz != rate_hz:
            profile_toml = _at_rate(profile_toml, rate_hz)
        if rig is not None:
            rig_toml = load(find(rig, "rigs"), Rig, "machine card")[1]
        return from_texts(file.stem, profile_toml, rig_toml, model_toml, f"what {file} brings")
    if profile is None:
        hz = min(1.0, rate_hz / 100)  # nobody's sweep, but one that a profile allows
        cycles, measured = held_cycles(labels) if labels is not None else (3, 3)
        text = PLAIN_PROFILE.format(
            title=json.dumps(f"Imported: {file.name}"),
            rig=json.dumps(rig or "simulated"),
            rate_hz=rate_hz,
            hz=hz,
            cycles=cycles,
            measured=measured,
        )
        rig_toml = load(find(rig or "simulated", "rigs"), Rig, "machine card")[1]
        return from_texts(file.stem, text, rig_toml, PLAIN_MODEL, f"{file} without a profile")
    card, text = load(profile, Profile, "test profile")
    rig_toml = load(find(rig or card.rig, "rigs", profile), Rig, "machine card")[1]
    model_toml = read_model(card.model, profile)[1]
    where = f"{profile}, at the {rate_hz:g} Hz of {file}"
    if card.acquisition.rate_hz != rate_hz:
        text = _at_rate(text, rate_hz)
    return from_texts(profile.stem, text, rig_toml, model_toml, where)


def _at_rate(profile_toml: str, rate_hz: float) -> str:
    """The text of a profile with another rate in it."""
    head = re.search(r"(?m)^[ \t]*\[acquisition\].*$", profile_toml)
    if head is None:
        return f"{profile_toml.rstrip()}\n\n[acquisition]\nrate_hz = {rate_hz!r}\n"
    before, after = profile_toml[: head.end()], profile_toml[head.end() :]
    table = re.split(r"(?m)^[ \t]*\[", after, maxsplit=1)[0]
    without = re.sub(r"(?m)^[ \t]*rate_hz[ \t]*=.*\n?", "", table)
    return f"{before}\nrate_hz = {rate_hz!r}{without}{after[len(table) :]}"


def _grid(file: Path, found: Samples) -> _Grid:
    """The samples on their whole grid."""
    size = int(found.index[-1]) + 1
    if size > SPARSE * found.index.size:
        raise BadInput(
            f"{file}: {found.index.size} rows over {size / found.rate_hz:.6g} s at "
            f"{found.rate_hz:g} Hz, more is missing than there; import its parts one by one"
        )
    values = np.full((len(found.channels), size), np.nan)
    for row, channel in zip(values, found.channels.values(), strict=True):
        row[found.index] = channel
    return _Grid(tuple(found.channels), values, holes(found.index))


def _motion(grid: _Grid) -> tuple[Float1D, bool]:
    """(what tells the steps, (sample,), whether it is an acceleration)."""
    for name, values in zip(grid.channels, grid.values, strict=True):
        if name in MOTIONS and np.isfinite(values).any():
            return values, name == "table_acc_m_s2"
    return np.full(grid.size, np.nan), False


def _of_steps(steps: tuple[Step, ...]) -> str:
    """The steps that were found, in a sentence."""
    if not steps:
        return "no PRC can be made of it"
    ends = [one.frequency_hz for one in steps]
    ways = " and ".join(dict.fromkeys(one.direction for one in steps))
    return f"found {len(steps)} steps, {ways}, {min(ends):.4g} to {max(ends):.4g} Hz"


def _items(
    file: Path, start: RunStart, grid: _Grid, found: Found, said: tuple[str, ...]
) -> Iterator[Item]:
    """The recording: what was said, blocks, gaps, and its end."""
    yield start
    yield Event(0, "imported", file.name)
    for text in said:
        _, warns, rest = text.rpartition("warning: ")
        yield Event(0, "warning" if warns else "imported", rest)
    for first, end in grid.pieces:
        for at in range(first, end, SIMULATED_BLOCK):
            window = slice(at, min(at + SIMULATED_BLOCK, end))
            labels = found.step[window], found.label[window], found.cycle[window]
            values = np.ascontiguousarray(grid.values[:, window])
            yield Block("meas", at, start.rate_hz, grid.channels, values, *labels)
        yield from (Gap(end, count, "", "lost") for hole, count in grid.holes if hole == end)
    yield from _lost(grid)
    yield RunStop(grid.size, "complete", f"the whole of {file.name}", ("idle", "at rest"))


def _lost(grid: _Grid) -> Iterator[Item]:
    """A Gap for every stretch of lost samples of a channel; an Event where there are too many."""
    whole = np.zeros(grid.size, dtype=bool)
    for first, count in grid.holes:
        whole[first : first + count] = True
    for name, values in zip(grid.channels, grid.values, strict=True):
        bad = np.isnan(values) & ~whole
        edges = np.flatnonzero(np.diff(bad, prepend=False, append=False)).reshape(-1, 2)
        if len(edges) > MOST_GAPS:
            yield Event(0, "warning", f"{name}: {int(bad.sum())} of {grid.size} samples lost")
            continue
        for first, last in edges.tolist():
            yield Gap(first, last - first, name, "lost")
