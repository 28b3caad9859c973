"""The lines of a loop check about the load cells.

A cell that is not loaded tells little: without contact its sign, its gain and whether it feels
anything at all cannot be seen. What is judged then is that its noise is there and small, and that
the motion of the table alone does not reach it. Where the check touches the bumpers, or a negative
gap presses them in, its sign and its share of the force are judged too.
"""

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from table_io.channels import LEFT_CELLS, RIGHT_CELLS, contact_forces, rel_disp
from table_io.loop_check.heard import Heard
from table_io.loop_check.lines import lag, line, mean
from table_io.records import Check

CELLS = RIGHT_CELLS + LEFT_CELLS
NEAR_GAP = 0.9  # of the gap: a mass that comes no nearer has not touched
FLICKER = 0.1  # of the noise that the machine card expects
LOADED = 50.0  # tone over its standard error: a cell that is truly loaded
SHARE = 0.1  # of the force of its neighbour on the same side
CELL_OFFSET = CROSS_TALK = 0.5  # of the force that counts as contact
NO_LIMITS = (-math.inf, math.inf)


def cells(heard: Heard) -> Iterator[Check]:
    """All that can be said of the load cells at hand."""
    for name in filter(heard.has, CELLS):
        yield from _flicker(heard, name)
        yield from _at_rest(heard, name)
        yield from _cross_talk(heard, name)
        yield from _polarity(heard, name)
        yield from _share(heard, name)
    if heard.has(*CELLS) and min(heard.profile.specimen.gaps_m) < 0:
        right, left = (abs(mean(force)) for force in contact_forces(heard.before))
        uneven = (right - left) / (right + left)
        yield line(heard, "preload, right over left", "force", uneven, *NO_LIMITS, "")


def _flicker(heard: Heard, name: str) -> Iterator[Check]:
    """A cell whose converter resolves its noise has to show some."""
    sensor = next(one for one in heard.rig.sensors if one.channel == name)
    expected = sensor.noise_rms * sensor.si_per_unit
    if expected > heard.lsb(name):
        yield line(
            heard, "alive, noise at rest", name, heard.noise(name), FLICKER * expected,
            math.inf, "N",
        )  # fmt: skip


def _at_rest(heard: Heard, name: str) -> Iterator[Check]:
    """What a cell bears at rest: nothing with a gap; with a negative one for a person to see."""
    bears = mean(heard.before.channel(name))
    if min(heard.profile.specimen.gaps_m) > 0:
        most = CELL_OFFSET * heard.profile.comparison.contact_n
        yield line(heard, "offset", name, bears, -most, most, "N")
    else:
        yield line(heard, "preload", name, bears, *NO_LIMITS, "N")


def _touched(heard: Heard) -> npt.NDArray[np.bool_]:
    """Where the mass came so near to a bumper that it may have touched, (hold,)."""
    clear = NEAR_GAP * min(heard.profile.specimen.gaps_m)
    near = [np.abs(rel_disp(heard.window(hold))).max() for hold in heard.holds]
    return ~(np.array(near) < clear)


def _cross_talk(heard: Heard, name: str) -> Iterator[Check]:
    """Force on a cell at the test's level while the table moves and nothing touches."""
    free = ~_touched(heard)
    if free.any():
        force = float(np.abs(heard.tones(name))[free].max()) * heard.level
        most = CROSS_TALK * heard.profile.comparison.contact_n
        yield line(heard, "cross-talk from the motion", name, force, 0.0, most, "N")


def _loaded(heard: Heard, name: str) -> npt.NDArray[np.bool_]:
    """Where a cell truly bears a force, (hold,)."""
    return _touched(heard) & (np.abs(heard.tones(name)) > LOADED * heard.errors(name))


def _polarity(heard: Heard, name: str) -> Iterator[Check]:
    """In contact: compression is positive, where a right bumper pushes the mass to the left.

    So it goes with the acceleration of the mass, negative on the right; not with u, which two
    lasers of slightly different gain do not tell on a stiff specimen.
    """
    if not heard.has("mass_acc_m_s2") or (lag(heard, "mass_acc_m_s2") or 0.0) <= 0:
        return
    windows = [heard.window(heard.holds[k]) for k in np.flatnonzero(_loaded(heard, name))]
    if not windows:
        return
    a = np.concatenate([window.channel("mass_acc_m_s2") for window in windows])
    load = np.concatenate([window.channel(name) for window in windows])
    known = np.isfinite(a) & np.isfinite(load)
    if known.any():
        sign = -1.0 if name in RIGHT_CELLS else 1.0
        together = sign * float(np.corrcoef(a[known], load[known])[0, 1])
        yield line(heard, "polarity in contact", name, together, 0.0, 1.0, "")


def _share(heard: Heard, name: str) -> Iterator[Check]:
    """In contact: a cell bears a part of what its neighbour on the same side bears."""
    side = RIGHT_CELLS if name in RIGHT_CELLS else LEFT_CELLS
    for other in filter(heard.has, side):
        loaded = _loaded(heard, other)
        if other != name and loaded.any():
            shares = np.abs(heard.tones(name)[loaded] / heard.tones(other)[loaded])
            share = float(shares.max())
            yield line(heard, "force beside its neighbour", name, share, SHARE, math.inf, "")
