"""Motion of a table in a recording: for the identification of its twin, and for the next drive."""

import math

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.config.base import parse_toml
from table_io.config.excitation import History
from table_io.config.profile import Profile
from table_io.errors import InputError
from twin.drive.table_identification import CROSSOVER_HZ, TableMotion
from twin.recording.reader import Recording

CHANNELS = "drive_disp_m", "table_disp_m", "table_acc_m_s2"
REST_S = 0.5  # kept before and after the motion
BLEND_HZ = 0.5  # half width of the change from displacement to acceleration


def read_table_motion(recording: Recording) -> TableMotion:
    """Return command and table of a whole recording, from rest to rest.

    The specimen's force on the table is that of its measured acceleration. InputError if samples
    or channels are missing.
    """
    block = _find_whole_block(recording)
    mass_kg = _read_profile(recording).specimen.mass_kg
    moving = np.flatnonzero(block.label != Label.REST)
    if moving.size == 0:
        raise InputError("the table does not move in it", where=recording.path)
    margin = math.ceil(REST_S * block.rate_hz)
    first = max(int(moving[0]) - margin, 0)
    last = min(int(moving[-1]) + margin, len(block))
    block = block.cut(block.index + first, block.index + last)
    reaction = np.zeros(len(block))
    if "mass_acc_m_s2" in block.channels:
        reaction = -mass_kg * block.channel("mass_acc_m_s2")
    command, displacement, acceleration = (block.channel(name) for name in CHANNELS)
    return TableMotion(block.rate_hz, command, displacement, acceleration, reaction)


def read_followed_target(recording: Recording) -> tuple[Float1D, Float1D]:
    """Return (target, achieved) table displacement in m of a history, (sample,) each.

    The achieved one is that of the laser at low frequencies and of the accelerometer above.
    """
    profile = _read_profile(recording)
    if not isinstance(profile.excitation, History):
        raise InputError(
            "the recording is not that of a displacement history", where=recording.path
        )
    block = _find_whole_block(recording)
    played = np.flatnonzero((block.label == Label.MEASURE) & (block.cycle < 0))
    target = profile.plan.target_m
    if played.size == 0 or int(played[0]) + target.size > len(block):
        raise InputError("its history was not played to the end", where=recording.path)
    first = block.index + int(played[0])
    block = block.cut(first, first + target.size)
    achieved = fuse_displacement(
        block.channel("table_disp_m"), block.channel("table_acc_m_s2"), block.rate_hz
    )
    return target, achieved


def fuse_displacement(displacement: Float1D, acceleration: Float1D, rate_hz: float) -> Float1D:
    """Return the displacement in m from a laser below CROSSOVER_HZ, an accelerometer above."""
    count = displacement.size
    frequency_hz = np.fft.rfftfreq(count, 1.0 / rate_hz)
    share = np.clip(0.5 + (frequency_hz - CROSSOVER_HZ) / (2.0 * BLEND_HZ), 0.0, 1.0)
    square = np.where(frequency_hz > 0.0, (math.tau * frequency_hz) ** 2, 1.0)
    fast = -np.fft.rfft(acceleration - acceleration.mean()) / square
    spectrum = (1.0 - share) * np.fft.rfft(displacement) + share * fast
    fused: Float1D = np.fft.irfft(spectrum, count)
    return fused


def _read_profile(recording: Recording) -> Profile:
    return parse_toml(recording.start.profile_toml, Profile, str(recording.path))


def _find_whole_block(recording: Recording) -> Block:
    """Return the measured samples; InputError if some are missing."""
    blocks = recording.contiguous_blocks("meas")
    if len(blocks) != 1:
        raise InputError(
            f"its measured samples are in {len(blocks)} parts",
            where=recording.path,
            remedy="record the motion again without losses",
        )
    missing = [name for name in CHANNELS if name not in blocks[0].channels]
    if missing:
        raise InputError(f"it has no {', '.join(missing)}", where=recording.path)
    rows = [blocks[0].channel(name) for name in CHANNELS]
    if not all(np.isfinite(row).all() for row in rows):
        raise InputError("samples were lost in it", where=recording.path)
    return blocks[0]
