"""Do the sensors of one body agree? No law of force can break it: (total) x'' is a.

Per held cycle <phi, a> = <phi'', x> for the mass and for the table (`held.functions`), and the two
load cells of a side carry the same share. What departs is a sensor, or its mounting.
"""

from dataclasses import dataclass

import numpy as np

from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import Event, Record
from twin.compare.watch.held import Held, Noise, WatchSetup, against, functions

BODIES = (
    ("mass", "mass_acc_m_s2", "mass_disp_m"),
    ("table", "table_acc_m_s2", "table_disp_m"),
)
PAIRS = (("right", *RIGHT_CELLS), ("left", *LEFT_CELLS))
OFF = 0.008  # of the acceleration: what mounting and calibration may be off
SHARE = 0.1  # of a side's force: by which its two cells may differ
NOISES = 5.0
CYCLES = 3  # in a row
SAID = -1


@dataclass(frozen=True, slots=True)
class Doubts:
    """Cycles in a row in doubt, or `SAID`: of each body, then of each pair of cells."""

    cycles: tuple[int, ...] = (0,) * (len(BODIES) + len(PAIRS))

    @property
    def any(self) -> bool:
        """True while sensors contradict each other."""
        return SAID in self.cycles


def doubted(
    setup: WatchSetup, doubts: Doubts, noise: Noise, held: Held
) -> tuple[Doubts, list[Record]]:
    """After one more cycle; an Event for each pair of sensors that does not agree."""
    looks = [_body(setup, noise, held, *one) for one in BODIES]
    looks += [_cells(setup, held, *one) for one in PAIRS]
    cycles: list[int] = []
    items: list[Record] = []
    for was, text in zip(doubts.cycles, looks, strict=True):
        now = was if text is None or (text and was == SAID) else was + 1 if text else 0
        if now == CYCLES and text:
            items.append(Event(held.end, "instrument", text))
            now = SAID
        cycles.append(now)
    return Doubts(tuple(cycles)), items


def _body(
    setup: WatchSetup, noise: Noise, held: Held, body: str, acc: str, disp: str
) -> str | None:
    """What does not agree, in words; "" where it does, None where nobody can tell."""
    a, x = held.column(acc), held.column(disp)
    rms = noise.of(acc), noise.of(disp)
    if not (np.isfinite(a + x).all() and np.isfinite(rms).all()):
        return None
    phi, _, bend = functions(a.size, setup.rate_hz)
    by_acc, by_disp = against(phi, a)[1:], against(bend, x)[1:]  # a steady offset is no motion
    sd = np.hypot(
        rms[0] * np.sqrt((phi[1:] ** 2).sum(axis=1)), rms[1] * np.sqrt((bend[1:] ** 2).sum(axis=1))
    )
    off, size = by_acc - by_disp, float(np.sqrt((by_acc**2).sum()))
    share = float(np.sqrt((off**2).sum())) / size if size > 0 else 0.0
    if share <= OFF or not (np.abs(off) > NOISES * sd).any():
        return ""
    gain = float((by_acc * by_disp).sum() / (by_disp**2).sum())
    return (
        f"{acc} and {disp} of the {body} do not agree: {100 * share:.1f} % of the acceleration at "
        f"{held.step.frequency_hz:g} Hz, the first reads {gain:.3f} of what the second says"
    )


def _cells(setup: WatchSetup, held: Held, side: str, first: str, second: str) -> str | None:
    one, other = held.column(first), held.column(second)
    both = one + other
    pressed = both > 4 * setup.contact_n
    if not (np.isfinite(both).all() and pressed.any()):
        return None
    share = float((one[pressed] - other[pressed]).sum() / both[pressed].sum())
    if abs(share) <= SHARE:
        return ""
    return (
        f"{first} and {second} share the force on the {side} unequally: "
        f"{100 * (0.5 + 0.5 * share):.0f} to {100 * (0.5 - 0.5 * share):.0f} %"
    )
