"""Two-speed protection: what must stop the table, and what a person should hear of.

Per sample (`watch.py`): limits, lost and broken sensors, command and table against what was
queued. Once every half cycle, over the last whole one (`tracks.py`, `looks.py`): level, response,
drift, and whether displacement, acceleration and forces still fit together.

    guard = begin(profile, rig, noise_from(tare_volts, rig.sensors))
    guard, findings = inspect(guard, Seen.of(block, clipped, drive))

However the same samples are cut into blocks, the findings are the same at the same samples. A
fault of a sensor that the controller needs stops; of another one, as the profile says.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Block, Bool2D, Float1D, Float2D, Label
from table_io.drive import Drive
from table_io.profile import Profile
from table_io.protection.cycle import Bench
from table_io.protection.findings import Finding, confirmed, worded
from table_io.protection.law import Law, Memory, law, nothing
from table_io.protection.tracks import HOLDS, Stretch, Tracks, look
from table_io.protection.watch import CHECKING, GAIN, HALF, LAG, watch
from table_io.records import Response
from table_io.response import transfer_at
from table_io.rig import Rig

__all__ = ["Finding", "Guard", "Seen", "begin", "identified", "inspect"]

MOST_FOUND = 256  # by one call
HELD = (Label.SETTLE, Label.MEASURE, Label.CHECK)
_KEYS = np.array([float(HOLDS if one in HELD else one != Label.REST) for one in Label])


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Consecutive samples: measured (SI, tared, NaN = lost) beside what the drive asked for."""

    block: Block
    clipped: Bool2D  # (channel, sample): at the sensor's range
    command_m: Float1D  # displacement, as queued
    phase: Float1D  # of the drive, in cycles
    level_m_s2: Float1D  # demanded peak acceleration

    @classmethod
    def of(cls, block: Block, clipped: Bool2D, drive: Drive) -> "Seen":
        """The block beside the drive that played it."""
        where = block.index, len(block)
        return cls(block, clipped, drive.command(*where), drive.phase(*where), drive.level(*where))


@dataclass(frozen=True, slots=True, eq=False)
class Guard:
    """The protection and where it stands before sample `index`.

    `past` are the samples before it: values (channel, sample), command and phase (sample,). `parts`
    are those since the last mark, with the level and the label at their end.
    """

    bench: Bench
    law: Law
    memory: Memory
    index: int
    past: tuple[Float2D, Float1D, Float1D]
    parts: tuple[tuple[Float2D, Float1D, Float1D], ...] = ()
    at_end: tuple[float, int, int] = (0.0, 0, 0)  # level, label, key of the newest sample
    tracks: Tracks = field(default_factory=Tracks)


def begin(profile: Profile, rig: Rig, noise: Mapping[str, tuple[float, int]]) -> Guard:
    """The guard before the first sample of a run.

    `noise` of a channel at rest: (rms in SI, longest run of equal samples), where it is known.
    """
    one = law(profile, rig, noise)
    sigma = np.array([noise[name][0] if name in noise else 0.0 for name in rig.channels])
    channels = len(rig.channels)
    past = np.full((channels, one.past), np.nan), np.zeros(one.past), np.zeros(one.past)
    guard = Guard(Bench(profile, rig, sigma, one.spike), one, nothing(channels), 0, past)
    _compile(guard)
    return guard


def _compile(guard: Guard) -> None:
    """Has the pass over the samples compiled, so that the first block is not late."""
    flags, empty = np.zeros((guard.past[0].shape[0], 0), dtype=np.bool_), np.zeros(0)
    found = np.empty((MOST_FOUND, 5))
    values, *past = guard.past
    watch(values, flags, *past, empty, empty, 0, 0, guard.law, guard.memory, found)


def identified(guard: Guard, response: Response) -> Guard:
    """A guard that from now on compares the table with the response of the loop check."""
    f = guard.bench.profile.sweep.steps[0].frequency_hz
    tracks = replace(guard.tracks, response=response)
    return _followed(guard, tracks.following(transfer_at(response, f), f))


def inspect(guard: Guard, seen: Seen) -> tuple[Guard, tuple[Finding, ...]]:
    """(guard, findings) after the next samples; ValueError where samples were left out."""
    block, past = seen.block, guard.law.past
    if block.index != guard.index:
        raise ValueError(f"samples from {guard.index} on are next, not from {block.index}")
    values = np.ascontiguousarray(np.concatenate([guard.past[0], block.values], axis=1))
    command = np.concatenate([guard.past[1], seen.command_m])
    phase = np.concatenate([guard.past[2], seen.phase])
    clipped, level = np.ascontiguousarray(seen.clipped), np.ascontiguousarray(seen.level_m_s2)
    keys = _keys(block)
    old = guard.memory
    guard = replace(guard, memory=Memory(old.per.copy(), old.one.copy(), old.told.copy()))
    found = np.empty((MOST_FOUND, 5))
    findings: list[Finding] = []
    at = 0
    while at < len(block):
        first = at
        at, mark, count = watch(
            values, clipped, command, phase, level, keys, block.index, at,
            guard.law, guard.memory, found,
        )  # fmt: skip
        for index, code, row, value, limit in found[:count].tolist():
            channel = block.channels[int(row)]
            what = int(code), int(index), channel, value, limit
            findings.append(worded(*what, guard.bench.profile))
        if at > first:
            span = slice(past + first, past + at)
            part = values[:, span], command[span], phase[span]
            end = float(level[at - 1]), int(block.label[at - 1]), int(keys[at - 1])
            guard = replace(guard, parts=(*guard.parts, part), at_end=end)
        if mark:
            guard, told = _closed(guard, mark == HALF, block.index + at)
            findings += told
    rest = slice(len(block), None)
    kept = values[:, rest].copy(), command[rest].copy(), phase[rest].copy()
    return replace(guard, index=block.end, past=kept), tuple(findings)


def _closed(guard: Guard, half: bool, index: int) -> tuple[Guard, list[Finding]]:
    """The guard after the open stretch has ended before sample `index`: a look at it."""
    tracks, findings = guard.tracks, []
    if guard.parts:
        values = np.concatenate([one[0] for one in guard.parts], axis=1)
        command, phase = (np.concatenate([one[k] for one in guard.parts]) for k in (1, 2))
        stretch = Stretch(values, command, phase, *guard.at_end, half)
        tracks, doubts = look(guard.bench, tracks, stretch)
        findings = [confirmed(one, index, guard.bench.profile) for one in doubts]
    return replace(_followed(guard, tracks), parts=()), findings


def _followed(guard: Guard, tracks: Tracks) -> Guard:
    """The guard with other tracks; every sample of the table is held against what they know."""
    one = guard.memory.one.copy()
    if tracks.lag_s >= 0:
        one[GAIN], one[LAG] = tracks.gain, tracks.lag_s
    return replace(guard, tracks=tracks, memory=guard.memory._replace(one=one))


def _keys(block: Block) -> Float1D:
    """Which motion each sample belongs to: 0 rest, 1 a blend, from HOLDS on a held step.

    -1 before the first step: a loop check judges the sensors itself, and must come to speak.
    """
    keys = _KEYS[block.label]
    keys = np.where(keys == HOLDS, HOLDS + block.step, keys)
    return np.where((block.step < 0) & (keys != 0), CHECKING, keys)
