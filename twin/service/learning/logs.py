"""Recordings made ready for learning."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.card import BadInput, parse
from table_io.profile import Profile
from twin.learn.discover import Log
from twin.learn.readings import alive, readings_of
from twin.learn.where import Step
from twin.service.recordings import log_path, open_log
from twin.stream.mcap_log import Recording

CLIPPED = 10  # samples in a row at a channel's very extreme


def logs_of(paths: Sequence[Path]) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """(the logs, what to say of them); BadInput names a log that nothing can be learned from."""
    twice = {str(path) for path in paths if list(paths).count(path) > 1}
    if twice:
        raise BadInput(f"{', '.join(sorted(twice))}: given twice; give each log once")
    logs, notes = [], []
    for path in paths:
        recording = open_log(path)
        logs.append(log_of(recording))
        notes += notes_on(recording)
    return tuple(logs), tuple(notes)


def log_of(recording: Recording) -> Log:
    """One recording made ready."""
    start, where = recording.start, str(recording.path)
    if start.source == "model":
        raise BadInput(f"{where}: holds a model alone, nothing measured; give a recorded test")
    profile = parse(start.profile_toml, Profile, where)
    specimen = profile.specimen
    blocks = recording.pieces("meas")
    readings = readings_of(blocks, named(recording), specimen.mass_kg, specimen.gaps_m)
    steps = tuple(Step(one.index, one.frequency_hz, one.direction) for one in start.steps)
    return Log(readings, profile.comparison.contact_n, steps)


def named(recording: Recording) -> str:
    """What a person calls the recording: its run, and where it lies."""
    path = log_path(recording.path)
    return path.parent.name if path.name == "run.mcap" else path.stem


def notes_on(recording: Recording) -> list[str]:
    """What a reader of the verdict should know of the recording."""
    name, notes = named(recording), []
    blocks = recording.pieces("meas")
    if recording.missing_samples:
        notes.append(f"{name}: {recording.missing_samples} samples are missing; none is invented")
    for channel in blocks[0].channels if blocks else ():
        if _clipped(blocks, channel):
            notes.append(f"{name}: {channel} stands at its extreme for a while: clipped?")
        elif not any(alive(block.channel(channel)) for block in blocks):
            notes.append(f"{name}: {channel} is dead; effects that need it fall away")
    return notes


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
