"""Loading and checking of recordings for `identify` and `discover`."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.channels import CHANNEL_BY_NAME, LEFT_CELLS, RIGHT_CELLS
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.records import SampleGap
from twin.compare.quality import clean_blocks
from twin.discovery.discover import PreparedLog
from twin.discovery.signals import (
    LogSignals,
    build_signals,
    find_unmeasured_side,
    is_channel_alive,
)
from twin.discovery.starting_values import measure_gaps
from twin.recording.reader import Recording
from twin.recording.run_paths import resolve_log_path
from twin.results.recordings import open_recording

LOAD_CELLS = (*RIGHT_CELLS, *LEFT_CELLS)
FORCE_CHANNELS = ("mass_acc_m_s2", "table_acc_m_s2", "damper_force_n")
CLEAR_LOAD_FACTOR = 5.0  # times the contact threshold, or the opposite sign: certainly a load


@dataclass(frozen=True, eq=False)
class LoadedLog:
    """Recording prepared for identification, with its measured blocks and notes to the user."""

    log: PreparedLog
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]


def load_logs(paths: Sequence[Path]) -> tuple[tuple[PreparedLog, ...], tuple[str, ...]]:
    """Return (logs, notes to the user); raise InputError for a log that cannot be used."""
    loaded_logs = [*load_recordings(paths)]
    return tuple(loaded.log for loaded in loaded_logs), tuple(
        note for loaded in loaded_logs for note in loaded.notes
    )


def load_recordings(paths: Sequence[Path]) -> Iterator[LoadedLog]:
    """Yield the recordings; raise InputError if one is given twice, even under another name."""
    path_by_digest: dict[bytes, Path] = {}
    for path, name in zip(paths, name_logs(paths), strict=True):
        recording = open_recording(path)
        with recording.path.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").digest()
        if digest in path_by_digest:
            raise InputError(
                f"the same log as {path_by_digest[digest]}", where=path, remedy="give each log once"
            )
        path_by_digest[digest] = path
        yield load_recording(recording, name)


def load_recording(recording: Recording, name: str) -> LoadedLog:
    """Prepare one recording under this name; raise InputError if it cannot be used."""
    start, location = recording.start, str(recording.path)
    if start.source == "model":
        raise InputError(
            "a simulated run without measured samples",
            where=location,
            remedy="give the recording of a test",
        )
    profile = parse_toml(start.profile_toml, Profile, location)
    specimen, clipped = profile.specimen, recording.clipped_gaps
    recorded = recording.contiguous_blocks("meas")
    blocks, findings = clean_blocks(
        [_discard_samples(block, clipped) for block in recorded], location
    )
    dead = _find_dead_channels(blocks)
    signals = build_signals(
        _drop_incomplete_cells(blocks, dead), name, specimen.mass_kg, specimen.gaps_m
    )
    if not {*signals.channels} & {*FORCE_CHANNELS}:
        raise InputError(
            "the forces cannot be determined",
            where=location,
            allowed="logs with mass_acc_m_s2 or table_acc_m_s2 (inertia force), or damper_force_n",
        )
    is_stated = "contact_n" in profile.comparison.model_fields_set
    contact_n = profile.comparison.contact_n if is_stated else 0.0  # else from the record
    signals = measure_gaps(signals, contact_n)
    log = PreparedLog(signals, contact_n, start.steps)
    notes = [
        *_list_notes(recording, profile, signals, recorded, blocks, dead),
        *_list_gap_notes(signals),
    ]
    clipping = _list_clipping_notes(name, clipped, recorded, blocks)
    return LoadedLog(log, blocks, (*(f"{name}: {line}" for line in findings), *notes, *clipping))


def _list_gap_notes(signals: LogSignals) -> Iterator[str]:
    """Yield notes on gaps that load cells show, where none is stated."""
    gaps = dict(zip(("right", "left"), signals.gaps_m, strict=True))
    if sides := signals.measured_sides:
        shown = " and ".join(f"{1e3 * gaps[side]:.4g} mm {side}" for side in sides)
        total = f", together {1e3 * sum(gaps.values()):.4g} mm" if len(sides) == len(gaps) else ""
        yield f"{signals.name}: the gap is not stated; the load cells show {shown}{total}"
    for side, cells in (("right", RIGHT_CELLS), ("left", LEFT_CELLS)):
        if sides and math.isinf(gaps[side]) and not {*cells} & {*signals.channels}:
            yield (
                f"{signals.name}: no load cell measures the {side} side: if there is a bumper, "
                "state the gap, and the balance of the mass gives the sum of both"
            )


def _discard_samples(block: Block, gaps: Sequence[SampleGap]) -> Block:
    """Return a block with nan for the samples of gaps: what a clipped sensor reads is wrong."""
    if not gaps:
        return block
    values = block.values.copy()
    for gap in gaps:
        if gap.channel in block.channels:
            first, last = (max(index - block.index, 0) for index in (gap.index, gap.end))
            values[block.channels.index(gap.channel), first:last] = np.nan
    return replace(block, values=values)


def _find_dead_channels(blocks: Sequence[Block]) -> frozenset[str]:
    """Return the channels that are dead in every block."""
    names = blocks[0].channels if blocks else ()
    return frozenset(
        n for n in names if not any(is_channel_alive(block.channel(n)) for block in blocks)
    )


def _drop_incomplete_cells(blocks: tuple[Block, ...], dead: frozenset[str]) -> tuple[Block, ...]:
    """Drop all load cells if one is dead: a partial bumper force is worse than none.

    The inertia of the mass still gives the sum of all forces.
    """
    if not dead & {*LOAD_CELLS}:
        return blocks
    rows = [k for k, name in enumerate(blocks[0].channels) if name not in LOAD_CELLS]
    names = tuple(blocks[0].channels[k] for k in rows)
    return tuple(replace(block, channels=names, values=block.values[rows]) for block in blocks)


def name_logs(paths: Sequence[Path]) -> list[str]:
    """Return the display name of each log: its run name, with parent folders if ambiguous."""
    paths = [resolve_log_path(path).resolve() for path in paths]
    places = [
        place.parent if place.name == "run.mcap" else place.with_suffix("") for place in paths
    ]
    for depth in range(1, max((len(place.parts) for place in places), default=0) + 1):
        names = ["/".join(place.parts[-depth:]) for place in places]
        if len({*names}) == len(names):
            return names
    return [str(path) for path in paths]


def _list_notes(
    recording: Recording,
    profile: Profile,
    signals: LogSignals,
    recorded: Sequence[Block],
    blocks: Sequence[Block],
    dead: frozenset[str],
) -> Iterator[str]:
    """Yield notes on the recording that matter for the verdict; `blocks` is what is used of it."""
    name = signals.name
    if recording.missing_samples:
        yield f"{name}: {recording.missing_samples} samples are missing; they are not used"
    live = {channel for block in blocks[:1] for channel in block.channels} - dead
    if side := find_unmeasured_side(live, profile.specimen.gaps_m):
        yield (
            f"{name}: no load cell measures the {side} bumper, so all load cells are ignored; the "
            "balance of the mass gives the sum of both"
        )
    _check_loads(recording, profile, blocks, dead)
    for channel in blocks[0].channels if blocks else ():
        if channel not in CHANNEL_BY_NAME:
            continue  # declared in the rig file: not used
        if lost := _count_missing(recorded, channel):
            yield f"{name}: {lost} samples of {channel} are lost; they are not used"
        if channel in dead:
            unused = ", so all load cells are ignored" if channel in LOAD_CELLS else ""
            yield f"{name}: {channel} is dead{unused}; effects that need it are not tested"


def _list_clipping_notes(
    name: str, clipped: Sequence[SampleGap], recorded: Sequence[Block], blocks: Sequence[Block]
) -> Iterator[str]:
    """Yield a note for each channel of which samples were discarded from what was recorded."""
    clipped_channels = {gap.channel for gap in clipped}
    for channel in blocks[0].channels if blocks else ():
        if channel not in clipped_channels:
            continue
        count = _count_missing(blocks, channel) - _count_missing(recorded, channel)
        if count:
            yield (
                f"{name}: {count} samples of {channel} are at the end of its range; they are not "
                "used"
            )


def _count_missing(blocks: Sequence[Block], channel: str) -> int:
    return sum(int(np.isnan(block.channel(channel)).sum()) for block in blocks)


def _check_loads(
    recording: Recording, profile: Profile, blocks: Sequence[Block], dead: frozenset[str]
) -> None:
    """Raise InputError for a load cell of the wrong sign."""
    min_force_n = CLEAR_LOAD_FACTOR * profile.comparison.contact_n
    for cell in LOAD_CELLS:
        if not blocks or cell not in blocks[0].channels or cell in dead:
            continue
        push, pull = _channel_extremes(blocks, cell)
        if pull > max(min_force_n, CLEAR_LOAD_FACTOR * push):
            raise InputError(
                f"reads {-pull:.0f} N under load; compression must be positive",
                where=recording.path,
                key=cell,
                remedy="import the channel with gain = -1",
            )


def _channel_extremes(blocks: Sequence[Block], channel: str) -> tuple[float, float]:
    """Return (maximum, minus minimum) of a live channel."""
    values = np.concatenate([block.channel(channel) for block in blocks])
    return float(np.nanmax(values)), float(-np.nanmin(values))
