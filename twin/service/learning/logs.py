"""Recordings made ready for learning."""

import hashlib
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.card import BadInput, parse
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.profile import Profile
from twin.learn.discover import Log
from twin.learn.readings import alive, readings_of
from twin.service.recordings import recording_of
from twin.stream.folder import log_path
from twin.stream.recording import Recording

CELLS = (*RIGHT_CELLS, *LEFT_CELLS)
ACCELERATIONS = ("mass_acc_m_s2", "table_acc_m_s2", "damper_force_n")
MUCH = 5.0  # times the threshold of contact, or the opposite sign: surely borne
CLIPPED = 10  # samples in a row at a channel's very extreme


@dataclass(frozen=True, eq=False)
class Taken:
    """A recording made ready: what can be learned from, its measured blocks, what to say of it."""

    log: Log
    blocks: tuple[Block, ...]
    notes: tuple[str, ...]


def logs_of(paths: Sequence[Path]) -> tuple[tuple[Log, ...], tuple[str, ...]]:
    """(the logs, what to say of them); BadInput names a log that nothing can be learned from."""
    ready = [*taken(paths)]
    return tuple(one.log for one in ready), tuple(note for one in ready for note in one.notes)


def taken(paths: Sequence[Path]) -> Iterator[Taken]:
    """The recordings, one by one; BadInput where one is given twice, whatever its name."""
    seen: dict[bytes, Path] = {}
    for path, name in zip(paths, names_of(paths), strict=True):
        recording = recording_of(path)
        with recording.path.open("rb") as file:
            content = hashlib.file_digest(file, "sha256").digest()
        if content in seen:
            raise BadInput(f"{path}: the same log as {seen[content]}; give each log once")
        seen[content] = path
        yield take(recording, name)


def take(recording: Recording, name: str) -> Taken:
    """One recording made ready, under this name."""
    start, where = recording.start, str(recording.path)
    if start.source == "model":
        raise BadInput(f"{where}: holds a model alone, nothing measured; give a recorded test")
    profile = parse(start.profile_toml, Profile, where)
    specimen, blocks = profile.specimen, recording.pieces("meas")
    dead = _dead(blocks)
    readings = readings_of(_whole_sides(blocks, dead), name, specimen.mass_kg, specimen.gaps_m)
    if not {*readings.channels} & {*ACCELERATIONS}:
        raise BadInput(
            f"{where}: no force can be told; needed: mass_acc_m_s2 or table_acc_m_s2 for that of "
            "the mass, or damper_force_n"
        )
    log = Log(readings, profile.comparison.contact_n, start.steps)
    return Taken(log, blocks, tuple(_notes(recording, name, profile, blocks, dead)))


def _dead(blocks: Sequence[Block]) -> frozenset[str]:
    """The channels that say nothing from beginning to end."""
    names = blocks[0].channels if blocks else ()
    return frozenset(n for n in names if not any(alive(block.channel(n)) for block in blocks))


def _whole_sides(blocks: tuple[Block, ...], dead: frozenset[str]) -> tuple[Block, ...]:
    """Without the load cells where one is dead: half a force is worse than none.

    The inertia of the mass still gives the sum of all forces.
    """
    if not dead & {*CELLS}:
        return blocks
    rows = [k for k, name in enumerate(blocks[0].channels) if name not in CELLS]
    names = tuple(blocks[0].channels[k] for k in rows)
    return tuple(replace(block, channels=names, values=block.values[rows]) for block in blocks)


def names_of(paths: Sequence[Path]) -> list[str]:
    """What a person calls each log: its run, with the folders above where two are called alike."""
    paths = [log_path(one).resolve() for one in paths]
    places = [one.parent if one.name == "run.mcap" else one.with_suffix("") for one in paths]
    for depth in range(1, max((len(one.parts) for one in places), default=0) + 1):
        names = ["/".join(one.parts[-depth:]) for one in places]
        if len({*names}) == len(names):
            return names
    return [str(one) for one in paths]


def _notes(
    recording: Recording, name: str, profile: Profile, blocks: Sequence[Block], dead: frozenset[str]
) -> Iterator[str]:
    """What a reader of the verdict should know of the recording."""
    if recording.missing_samples:
        yield f"{name}: {recording.missing_samples} samples are missing; none is invented"
    if len({one.frequency_hz for one in recording.start.steps}) == 1:
        alike = "damping, lag, relaxation and hysteresis look alike"
        yield f"{name}: one frequency only; there {alike}"
    yield from _bearing(recording, name, profile, blocks, dead)
    for channel in blocks[0].channels if blocks else ():
        if _clipped(blocks, channel):
            yield f"{name}: {channel} stands at its extreme for a while: clipped?"
        elif lost := sum(int(np.isnan(block.channel(channel)).sum()) for block in blocks):
            yield f"{name}: {lost} samples of {channel} are lost; none is invented"
        if channel in dead:
            fallen = "the load cells, all of which" if channel in CELLS else "it"
            yield f"{name}: {channel} is dead; effects that need {fallen} fall away"


def _bearing(
    recording: Recording, name: str, profile: Profile, blocks: Sequence[Block], dead: frozenset[str]
) -> Iterator[str]:
    """What load cells read that the profile does not allow; BadInput where one has no sense."""
    least = MUCH * profile.comparison.contact_n
    sides = ("right", RIGHT_CELLS), ("left", LEFT_CELLS)
    for (side, cells), gap in zip(sides, profile.specimen.gaps_m, strict=True):
        for cell in cells:
            if not blocks or cell not in blocks[0].channels or cell in dead:
                continue
            push, pull = _extremes(blocks, cell)
            if pull > max(least, MUCH * push):
                raise BadInput(
                    f"{recording.path}: {cell} reads {-pull:.0f} N where it bears; compression is "
                    "positive: import it with gain = -1"
                )
            if math.isinf(gap) and push > least:
                yield (
                    f"{name}: {cell} bears up to {push:.0f} N, but the profile says "
                    f"that there is no {side} bumper: give the gap"
                )


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
