"""Digital inputs, as they were seen: a heartbeat that beats and stops, switches that are well."""

from collections.abc import Sequence
from itertools import pairwise

from table_io.wiring_check.line import Line, judged, untested

BEAT_HZ = (5.0, 15.0)  # of 10 Hz, looked at fifty times a second
HEARTBEAT = "heartbeat"

Seen = Sequence[dict[str, bool]]  # name -> level, one look after another


def watched(
    held: Seen, held_s: float, released: Seen, has_heartbeat: bool, simulated: bool
) -> tuple[Line, ...]:
    """The lines of the digital inputs: `held` while the output was, `released` after it.

    Where the card names none, they are not tested; a table that is simulated has none.
    """
    names = tuple(held[0]) if held else ()
    found = []
    if HEARTBEAT in names:
        beats = _changes(held) / (2.0 * held_s)
        do = "no heartbeat comes back: look at its line, its cable and the interlock's input"
        found.append(judged("heartbeat comes back", "", beats, BEAT_HZ, "Hz", do))
        do = "it does not stop with the rig: what comes back is not its heartbeat"
        changes = float(_changes(released))
        found.append(judged("heartbeat stops", "", changes, (0.0, 0.0), "changes", do))
    elif has_heartbeat:
        why = (
            "the card names no heartbeat_back, or the output was not held: wire it back, or see "
            "the interlock's lamp go out"
        )
        found.append(untested("heartbeat comes back", "", why))
    for name in names:
        if name != HEARTBEAT:
            share = 100.0 * sum(one[name] for one in held) / len(held)
            do = "it says that not all is well: look at the switch, its supply and its cable"
            found.append(judged("all is well", name, share, (100.0, 100.0), "%", do))
    if not simulated:
        why = (
            "trip each limit switch and the emergency stop by hand, with this computer off: the "
            "machine must come to rest by itself"
        )
        found.append(untested("stroke limits and emergency stop", "", why))
    return tuple(found)


def _changes(seen: Seen) -> int:
    return sum(one[HEARTBEAT] != other[HEARTBEAT] for one, other in pairwise(seen))
