"""Motion of a table in a recording: for the identification of its twin, and for the next drive."""

import math

import numpy as np

from table_io.block import Block, Float1D, Label
from table_io.config.base import parse_toml
from table_io.config.excitation import History
from table_io.config.profile import Profile
from table_io.errors import InputError
from twin.earthquakes.drive_computation import PlayedDrive
from twin.earthquakes.table_identification import CROSSOVER_HZ, TableRehearsal
from twin.recording.reader import Recording

CHANNELS = "drive_disp_m", "table_disp_m", "table_acc_m_s2"
MASS_CHANNEL = "mass_acc_m_s2"
NOISE_S = 0.4  # at the start, where the table rests
REST_S = 0.5  # kept before and after the motion
BLEND_HZ = 0.5  # half width of the change from displacement to acceleration


def read_table_motion(recording: Recording) -> TableRehearsal:
    """Return command and table of a whole recording, from rest to rest.

    The specimen's force on the table is that of its measured acceleration. InputError if samples
    or channels are missing.
    """
    block = _find_whole_block(recording)
    profile = _read_profile(recording)
    moving = np.flatnonzero(block.label != Label.REST)
    if moving.size == 0:
        raise InputError("the table does not move in it", where=recording.path)
    margin = math.ceil(REST_S * block.rate_hz)
    first = max(int(moving[0]) - margin, 0)
    last = min(int(moving[-1]) + margin, len(block))
    block = block.cut(block.index + first, block.index + last)
    reaction = _measure_reaction(block, profile)
    command, displacement, acceleration = (block.channel(name) for name in CHANNELS)
    return TableRehearsal(block.rate_hz, command, displacement, acceleration, reaction)


def read_played_drive(recording: Recording) -> tuple[Float1D, PlayedDrive]:
    """Return the target displacement of a history in m, (sample,), and its run.

    InputError if the recording is not that of a history that was played to its end.
    """
    profile = _read_profile(recording)
    if not isinstance(profile.excitation, History):
        raise InputError(
            "the recording is not that of a displacement history", where=recording.path
        )
    whole = _find_whole_block(recording)
    played = np.flatnonzero(whole.is_history)
    plan, rate_hz = profile.plan, whole.rate_hz
    if played.size == 0 or int(played[0]) + plan.target_m.size > len(whole):
        raise InputError("its history was not played to the end", where=recording.path)
    first = whole.index + int(played[0])
    block = whole.cut(first, first + plan.target_m.size)
    displacement, acceleration = (block.channel(name) for name in CHANNELS[1:])
    resting = whole.cut(whole.index, whole.index + round(NOISE_S * rate_hz))
    noise_m, noise_m_s2 = (float(resting.channel(name).std()) for name in CHANNELS[1:])
    return plan.target_m, PlayedDrive(
        plan.history_m,
        fuse_displacement(displacement, acceleration, rate_hz),
        _measure_reaction(block, profile),
        noise_m,
        noise_m_s2,
    )


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


def _measure_reaction(block: Block, profile: Profile) -> Float1D:
    """Return the specimen's force on the table by its acceleration, N, (sample,); 0 without one."""
    if MASS_CHANNEL not in block.channels:
        return np.zeros(len(block))
    reaction: Float1D = -profile.specimen.mass_kg * block.channel(MASS_CHANNEL)
    return reaction


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
    used = [name for name in (*CHANNELS, MASS_CHANNEL) if name in blocks[0].channels]
    rows = [blocks[0].channel(name) for name in used]
    if not all(np.isfinite(row).all() for row in rows):
        raise InputError("samples were lost in it", where=recording.path)
    return blocks[0]
