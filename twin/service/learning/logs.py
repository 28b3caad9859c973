"""Recordings made ready for learning."""

import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.card import BadInput, parse
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.profile import Profile
from twin.learn.discover import Log
from twin.learn.readings import alive, readings_of
from twin.learn.where import Step
from twin.service.recordings import log_path, open_log
from twin.stream.mcap_log import Recording

CELLS = (*RIGHT_CELLS, *LEFT_CELLS)
ACCELERATIONS = ("mass_acc_m_s2", "table_acc_m_s2", "damper_force_n")
MUCH = 5.0  # times the threshold of contact, or the opposite sign: surely borne
CLIPPED = 10  # samples in a row at a channel's very extreme


def logs_of(paths: Sequence[Path]) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """(the logs, what to say of them); BadInput names a log that nothing can be learned from."""
    logs, notes = [], []
    for recording in opened(paths):
        logs.append(log_of(recording))
        notes += notes_on(recording)
    return tuple(logs), tuple(notes)


def opened(paths: Sequence[Path]) -> Iterator[Recording]:
    """The recordings, one by one; BadInput where one is given twice, whatever its name."""
    seen: dict[bytes, Path] = {}
    for path in paths:
        recording = open_log(path)
        with recording.path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").digest()
        if content in seen:
            raise BadInput(f"{path}: the same log as {seen[content]}; give each log once")
        seen[content] = path
        yield recording


def log_of(recording: Recording) -> Log:
    """One recording made ready."""
    start, where = recording.start, str(recording.path)
    if start.source == "model":
        raise BadInput(f"{where}: holds a model alone, nothing measured; give a recorded test")
    profile = parse(start.profile_toml, Profile, where)
    specimen = profile.specimen
    blocks = tuple(map(_whole_sides(recording), recording.pieces("meas")))
    readings = readings_of(blocks, named(recording), specimen.mass_kg, specimen.gaps_m)
    if not {*readings.channels} & {*ACCELERATIONS}:
        raise BadInput(
            f"{where}: no force can be told; needed: mass_acc_m_s2 or table_acc_m_s2 for that of "
            "the mass, or damper_force_n"
        )
    steps = tuple(Step(one.index, one.frequency_hz, one.direction) for one in start.steps)
    return Log(readings, profile.comparison.contact_n, steps)


def dead(recording: Recording) -> tuple[str, ...]:
    """The channels that say nothing from beginning to end."""
    blocks = recording.pieces("meas")
    names = blocks[0].channels if blocks else ()
    return tuple(name for name in names if not any(alive(block.channel(name)) for block in blocks))


def _whole_sides(recording: Recording) -> Callable[[Block], Block]:
    """What takes the load cells out of a block where one is dead: half a force is worse than none.

    The inertia of the mass still gives the sum of all forces.
    """
    gone = {*CELLS} if {*CELLS} & {*dead(recording)} else set()

    def kept(block: Block) -> Block:
        rows = [k for k, name in enumerate(block.channels) if name not in gone]
        names = tuple(block.channels[k] for k in rows)
        return replace(block, channels=names, values=block.values[rows])

    return kept if gone else lambda block: block


def named(recording: Recording) -> str:
    """What a person calls the recording: its run, and where it lies."""
    path = log_path(recording.path)
    return path.parent.name if path.name == "run.mcap" else path.stem


def notes_on(recording: Recording) -> list[str]:
    """What a reader of the verdict should know of the recording."""
    name, notes = named(recording), []
    blocks, silent = recording.pieces("meas"), dead(recording)
    if recording.missing_samples:
        notes.append(f"{name}: {recording.missing_samples} samples are missing; none is invented")
    if len({one.frequency_hz for one in recording.start.steps}) == 1:
        notes.append(
            f"{name}: one frequency only; there damping, lag, relaxation and hysteresis look alike"
        )
    notes += _bearing(recording)
    for channel in blocks[0].channels if blocks else ():
        if _clipped(blocks, channel):
            notes.append(f"{name}: {channel} stands at its extreme for a while: clipped?")
        elif lost := sum(int(np.isnan(block.channel(channel)).sum()) for block in blocks):
            notes.append(f"{name}: {lost} samples of {channel} are lost; none is invented")
        if channel in silent:
            fallen = "the load cells, all of which" if channel in CELLS else "it"
            notes.append(f"{name}: {channel} is dead; effects that need {fallen} fall away")
    return notes


def _bearing(recording: Recording) -> list[str]:
    """What load cells read that the profile does not allow; BadInput where one has no sense."""
    profile = parse(recording.start.profile_toml, Profile, str(recording.path))
    least, found = MUCH * profile.comparison.contact_n, []
    blocks = recording.pieces("meas")
    sides = ("right", RIGHT_CELLS), ("left", LEFT_CELLS)
    for (side, cells), gap in zip(sides, profile.specimen.gaps_m, strict=True):
        for cell in cells:
            if not blocks or cell not in blocks[0].channels or cell in dead(recording):
                continue
            push, pull = _extremes(blocks, cell)
            if pull > max(least, MUCH * push):
                raise BadInput(
                    f"{recording.path}: {cell} reads {-pull:.0f} N where it bears; compression is "
                    "positive: import it with gain = -1"
                )
            if math.isinf(gap) and push > least:
                found.append(
                    f"{named(recording)}: {cell} bears up to {push:.0f} N, but the profile says "
                    f"that there is no {side} bumper: give the gap"
                )
    return found


def _extremes(blocks: Sequence[Block], channel: str) -> tuple[float, float]:
    """(largest, largest of the opposite sign) of a channel that is alive."""
    values = np.concatenate([block.channel(channel) for block in blocks])
    return float(np.nanmax(values)), float(-np.nanmin(values))


def _clipped(blocks: Sequence[Block], channel: str) -> bool:
    values = np.concatenate([block.channel(channel) for block in blocks])
    if not np.isfinite(values).any() or np.nanmax(values) == np.nanmin(values):
        return False
    for extreme in (np.nanmax(values), np.nanmin(values)):
        if extreme == 0.0:
            continue
        runs = np.diff(np.flatnonzero(np.diff(np.r_[False, values == extreme, False])))[::2]
        if runs.size and runs.max() >= CLIPPED:
            return True
    return False
