"""Digital inputs of the wiring check: heartbeat read-back, limit switches and interlocks."""

from collections.abc import Sequence
from itertools import pairwise

from table_io.safety.wiring_check.check_line import CheckLine, check_value, mark_untested

BEAT_HZ = (5.0, 15.0)  # for a beat of 10 Hz, sampled at 50 Hz
HEARTBEAT = "heartbeat"

LevelSamples = Sequence[dict[str, bool]]  # name -> level, per sample


def check_digital_inputs(
    held_levels: LevelSamples,
    held_s: float,
    released_levels: LevelSamples,
    has_heartbeat: bool,
    simulated: bool,
) -> tuple[CheckLine, ...]:
    """Check the digital inputs, sampled while the output was held and after it was released.

    Inputs missing in the rig file are not tested; a simulated table has none.
    """
    names = tuple(held_levels[0]) if held_levels else ()
    lines = []
    if HEARTBEAT in names:
        beats = _count_changes(held_levels) / (2.0 * held_s)
        remedy = "no heartbeat is read back: check its output line, cable and the interlock input"
        lines.append(check_value("heartbeat comes back", "", beats, BEAT_HZ, "Hz", remedy))
        remedy = "the input still changes after the heartbeat stopped: check where it is connected"
        changes = float(_count_changes(released_levels))
        lines.append(check_value("heartbeat stops", "", changes, (0.0, 0.0), "changes", remedy))
    elif has_heartbeat:
        reason = (
            "the rig file has no heartbeat_back, or the output was not held: connect the heartbeat "
            "to an input, or check that the lamp of the interlock goes out"
        )
        lines.append(mark_untested("heartbeat comes back", "", reason))
    for name in names:
        if name != HEARTBEAT:
            share = 100.0 * sum(levels[name] for levels in held_levels) / len(held_levels)
            remedy = "the input is low: check the switch, its supply and its cable"
            lines.append(check_value("all is well", name, share, (100.0, 100.0), "%", remedy))
    if not simulated:
        reason = (
            "with this computer off, trip each limit switch and the emergency stop by hand; the "
            "table must come to rest by itself"
        )
        lines.append(mark_untested("stroke limits and emergency stop", "", reason))
    return tuple(lines)


def _count_changes(levels: LevelSamples) -> int:
    return sum(before[HEARTBEAT] != after[HEARTBEAT] for before, after in pairwise(levels))
