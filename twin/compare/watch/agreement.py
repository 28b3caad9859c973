"""Is the restarted twin within its band? A band holds noise and what a good model may be off.

    band = 3 x noise at rest + 5 % of the cycle's amplitude

(displacements by the amplitude of u: the total one may be small where the mass stands still; a
force below what counts as contact is none, so it adds at least that).
On the simulated rig with the right model the error stays below half of it; see the tests.
"""

from dataclasses import dataclass

import numpy as np

from table_io.block import Bool2D, Float1D
from table_io.channels import contact_forces, rel_disp
from table_io.records import Agreement, Event, Record
from twin.compare import COMPARED
from twin.compare.watch.held import Held, Noise, WatchSetup
from twin.compare.windows import compared

NOISES = 3.0
TOLERANCE = 0.05  # of the amplitude
AGREES = 0.7  # of the band: below it the two agree again
CYCLES = 2  # in a row beyond the band before anything is said
SAID = -1
PHASES = ("in flight", "in contact right", "in contact left")


@dataclass(frozen=True, slots=True)
class Told:
    """Cycles in a row with a channel beyond its band, or `SAID` until all agree again."""

    cycles: int = 0
    ever: bool = False  # said at all


def agreement(setup: WatchSetup, told: Told, noise: Noise, held: Held) -> tuple[Told, list[Record]]:
    """The Agreement of a cycle, and an Event where channels have left their bands."""
    measured = compared(held.measured)
    errors = [
        (one - held.predicted.channel(f"window/{name}")) ** 2
        for one, name in zip(measured, COMPARED, strict=True)
    ]
    parts = [[_rms(one[phase]) for one in errors] for phase in _phases(setup, held)]
    reach = [_reach(one) for one in measured]
    band = [
        _least(setup, noise, name) + TOLERANCE * (reach[0] if name.endswith("disp_m") else mine)
        for mine, name in zip(reach, COMPARED, strict=True)
    ]
    record = Agreement(
        held.end, held.step.index, held.number, len(held.measured), COMPARED,
        tuple(_rms(one) for one in errors), tuple(band), *(tuple(one) for one in parts),
    )  # fmt: skip
    shares = [
        e / b if b > 0 and not np.isnan(e) else 0.0
        for e, b in zip(record.error, record.band, strict=True)
    ]
    if np.isnan(record.error).all():  # nobody can tell
        return told, [record]
    if told.cycles == SAID:
        return Told(SAID if max(shares) > AGREES else 0, True), [record]
    cycles = told.cycles + 1 if max(shares) > 1 else 0
    if cycles < CYCLES:
        return Told(cycles, told.ever), [record]
    return Told(SAID, True), [
        record,
        Event(held.end, "disagreement", _sentence(held, record, shares)),
    ]


def _sentence(held: Held, record: Agreement, shares: list[float]) -> str:
    worst = int(np.argmax(shares))
    others = [COMPARED[i] for i, one in enumerate(shares) if one > 1 and i != worst]
    parts = [one[worst] for one in (record.flight, record.right, record.left)]
    phase = PHASES[int(np.nanargmax(parts))]
    return (
        f"{COMPARED[worst]} and the restarted twin are {record.error[worst]:.3g} apart (rms), "
        f"{shares[worst]:.1f} times the band, at {held.step.frequency_hz:g} Hz "
        f"{held.step.direction}, most {phase}" + (f"; also {', '.join(others)}" if others else "")
    )


def _least(setup: WatchSetup, noise: Noise, name: str) -> float:
    """What a compared channel may be off without any motion; NaN where its noise is not known."""
    rms = noise.of(name)
    if name == "rel_disp_m" and np.isnan(rms):
        rms = float(np.hypot(noise.of("mass_disp_m"), noise.of("table_disp_m")))
    if name.startswith("force"):
        return max(setup.contact_n, NOISES * rms) if rms > 0 else setup.contact_n
    return NOISES * rms if rms > 0 else float("nan")


def _phases(setup: WatchSetup, held: Held) -> list[Bool2D]:
    """Which samples are in flight, in contact right, in contact left: by load cells, else gaps."""
    u = rel_disp(held.measured)
    touching = []
    for side, force, gap in zip((1, -1), contact_forces(held.measured), setup.gaps_m, strict=True):
        known = ~np.isnan(force)
        touching.append(np.where(known, side * force > setup.contact_n, side * u > gap))
    right, left = touching
    return [~(right | left), right, left]


def _rms(squares: Float1D) -> float:
    """Root of the mean of what is known; NaN where less than half is."""
    known = squares[~np.isnan(squares)]
    return float(np.sqrt(known.mean())) if 2 * known.size > squares.size else float("nan")


def _reach(values: Float1D) -> float:
    """Half of the range of what is known; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return 0.5 * float(np.ptp(known)) if known.size else float("nan")
