"""Does a motion that was steady become another one while the drive stays as it is?"""

from dataclasses import dataclass

import numpy as np

from table_io.channels import rel_disp
from table_io.records import Event, Record
from twin.compare.watch.held import Held

STEADY = 0.05  # range of the amplitude over `CYCLES`, of its mean
OTHER = 0.25  # of the steady amplitude: another motion
CYCLES, AGAIN = 4, 2  # that make a motion steady; that make the other one more than a stumble


@dataclass(frozen=True, slots=True)
class Steady:
    """Amplitudes of u in m of the last cycles, and the one that was steady, if any.

    Of one frequency of one direction: who stays there visits it again and again.
    """

    place: tuple[str, float] = ("", 0.0)
    recent: tuple[float, ...] = ()
    steady: float | None = None


def steadied(was: Steady, held: Held) -> tuple[Steady, list[Record]]:
    """After one more cycle; an Event where the motion has changed to another one."""
    u = rel_disp(held.true)
    reach = 0.5 * float(np.ptp(u))
    place = held.step.direction, held.step.frequency_hz
    if was.place != place or not np.isfinite(reach):
        was = Steady(place)
        if not np.isfinite(reach):
            return was, []
    recent = (*was.recent, reach)[-CYCLES:]
    steady = was.steady
    if steady is None or abs(reach - steady) <= OTHER * steady:
        whole = len(recent) == CYCLES and float(np.ptp(recent)) <= STEADY * float(np.mean(recent))
        return Steady(place, recent, float(np.mean(recent)) if whole else steady), []
    if not all(abs(one - steady) > OTHER * steady for one in recent[-AGAIN:]):
        return Steady(place, recent, steady), []
    text = (
        f"the motion has changed to another one at {held.step.frequency_hz:g} Hz "
        f"{held.step.direction}, cycle {held.number}: amplitude of u {1e3 * steady:.3g} -> "
        f"{1e3 * reach:.3g} mm"
    )
    return Steady(place, (), None), [Event(held.end, "attractor", text)]
