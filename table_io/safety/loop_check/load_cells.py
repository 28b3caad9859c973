"""Load-cell checks of the loop check.

An unloaded cell shows neither its sign nor its gain. Without contact the checks cover its noise,
which must be present and small, its offset, and cross-talk from the motion of the table. In contact
(bumpers touched, or precompressed by a negative gap) they also cover its sign and its share of the
force.
"""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, relative_displacement
from table_io.records import Check
from table_io.safety.loop_check.checks import finite_mean, lag_sine, make_check
from table_io.safety.loop_check.data import LoopCheckData

LOAD_CELLS = RIGHT_CELLS + LEFT_CELLS
NEAR_GAP_RATIO = 0.9  # of the gap: below this displacement there is no contact
MIN_NOISE_RATIO = 0.1  # of the noise stated in the rig file
MIN_LOADED_SNR = 50.0  # tone over its standard error above which a cell counts as loaded
MIN_FORCE_SHARE = 0.1  # of the force of the other cell on the same side
MAX_CELL_OFFSET_RATIO = MAX_CROSS_TALK_RATIO = 0.5  # of the contact threshold
NO_LIMITS = (-math.inf, math.inf)


def check_load_cells(data: LoopCheckData) -> Iterator[Check]:
    """Check every load cell of the rig."""
    for name in filter(data.has, LOAD_CELLS):
        yield from _check_noise_present(data, name)
        yield from _check_preload(data, name)
        yield from _check_cross_talk(data, name)
        yield from _check_polarity(data, name)
        yield from _check_force_share(data, name)
    if data.has(*LOAD_CELLS) and min(data.profile.specimen.gaps_m) < 0:
        right, left = (abs(finite_mean(force)) for force in contact_forces(data.rest_before))
        asymmetry = (right - left) / (right + left)
        yield make_check(data, "preload, right over left", "force", asymmetry, *NO_LIMITS, "")


def _check_noise_present(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check that a cell shows noise if its converter resolves it."""
    sensor = next(sensor for sensor in data.rig.sensors if sensor.channel == name)
    expected = sensor.noise_rms * sensor.si_per_unit
    if expected > data.lsb(name):
        yield make_check(
            data, "alive, noise at rest", name, data.noise(name), MIN_NOISE_RATIO * expected,
            math.inf, "N",
        )  # fmt: skip


def _check_preload(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the offset of a cell at rest; with precompressed bumpers report the preload only."""
    preload = finite_mean(data.rest_before.channel(name))
    if min(data.profile.specimen.gaps_m) > 0:
        max_offset = MAX_CELL_OFFSET_RATIO * data.profile.comparison.contact_n
        yield make_check(data, "offset", name, preload, -max_offset, max_offset, "N")
    else:
        yield make_check(data, "preload", name, preload, *NO_LIMITS, "N")


def _find_contact_holds(data: LoopCheckData) -> npt.NDArray[np.bool_]:
    """Find the held motions in which the mass may have touched a bumper, bool (hold,)."""
    min_distance = NEAR_GAP_RATIO * min(data.profile.specimen.gaps_m)
    distances = [np.abs(relative_displacement(data.window(hold))).max() for hold in data.holds]
    return ~(np.array(distances) < min_distance)


def _check_cross_talk(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the force on a cell, scaled to the test level, in motions without contact."""
    free = ~_find_contact_holds(data)
    if free.any():
        force = float(np.abs(data.tones(name))[free].max()) * data.test_level
        max_force = MAX_CROSS_TALK_RATIO * data.profile.comparison.contact_n
        yield make_check(data, "cross-talk from the motion", name, force, 0.0, max_force, "N")


def _find_loaded_holds(data: LoopCheckData, name: str) -> npt.NDArray[np.bool_]:
    """Find the held motions in which a cell is loaded, bool (hold,)."""
    return _find_contact_holds(data) & (
        np.abs(data.tones(name)) > MIN_LOADED_SNR * data.tone_errors(name)
    )


def _check_polarity(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check the sign of a loaded cell: compression is positive.

    A right bumper pushes the mass to the left, so the force correlates negatively with the
    acceleration of the mass on the right, positively on the left. The relative displacement u is
    not used: on a stiff specimen the gain errors of two lasers hide it.
    """
    if not data.has("mass_acc_m_s2") or (lag_sine(data, "mass_acc_m_s2") or 0.0) <= 0:
        return
    windows = [data.window(data.holds[k]) for k in np.flatnonzero(_find_loaded_holds(data, name))]
    if not windows:
        return
    a = np.concatenate([window.channel("mass_acc_m_s2") for window in windows])
    load = np.concatenate([window.channel(name) for window in windows])
    finite = np.isfinite(a) & np.isfinite(load)
    if finite.any():
        sign = -1.0 if name in RIGHT_CELLS else 1.0
        correlation = sign * float(np.corrcoef(a[finite], load[finite])[0, 1])
        yield make_check(data, "polarity in contact", name, correlation, 0.0, 1.0, "")


def _check_force_share(data: LoopCheckData, name: str) -> Iterator[Check]:
    """Check that a cell bears a share of the force of the other cell on its side."""
    side = RIGHT_CELLS if name in RIGHT_CELLS else LEFT_CELLS
    for neighbour in filter(data.has, side):
        loaded = _find_loaded_holds(data, neighbour)
        if neighbour != name and loaded.any():
            shares = np.abs(data.tones(name)[loaded] / data.tones(neighbour)[loaded])
            share = float(shares.max())
            yield make_check(
                data, "force ratio to its neighbour", name, share, MIN_FORCE_SHARE, math.inf, ""
            )
