"""What one look at a whole cycle finds: level, response, drift, and whether the sensors fit.

Each function yields doubts; a doubt that stays for some looks in a row becomes a finding.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Label
from table_io.protection.consistency import Weak, weak, window
from table_io.protection.cycle import HARMONICS, Cycle, Doubt, drifted
from table_io.tracking import track

MATCH = 0.12  # of the motion: a little more than what the loop check lets pass
CHANGE = 0.05  # of the motion, from what the same sensors said over the last ten cycles
KNOWN = 6  # looks after which that is known
OFFSET_RANGE = 1e-3  # of a sensor's range
BY_OFFSET = 0.3  # of a difference: so little is left where an offset explains it
OFFSET_LEVEL = 0.02  # of the table's motion
READ_BACK = 0.02  # of the command
GAIN = 0.2  # of the identified response
LAG_MORE, LAG_S = 0.5, 0.003  # of the identified lag, and at least
AVERAGED = 20  # looks, ten cycles: a transient is over by then
ASYMMETRY = 0.35  # of the swing of the mass: twice what a chaotic G4 has
PAIRS = (
    (("table_disp_m",), "table_acc_m_s2"),
    (("mass_disp_m",), "mass_acc_m_s2"),
    (("rel_disp_m", "table_disp_m"), "mass_acc_m_s2"),
)


def fit(cycle: Cycle) -> Iterator[tuple[tuple[str, ...], str, Weak]]:
    """(displacements, acceleration, what they say) of every pair that the rig measures."""
    pairs = [pair for pair in PAIRS if cycle.has(*pair[0], pair[1])]
    if not pairs:
        return
    count = cycle.phase.size
    middle = 0.5 * float(cycle.phase[0] + cycle.phase[-1])
    one = window(count, cycle.turns, middle, cycle.bench.rate_hz)
    for names, acceleration in pairs:
        x = np.sum([cycle.clean(name) for name in names], axis=0)
        noise = cycle.sigma(*names), cycle.sigma(acceleration)
        yield names, acceleration, weak(one, x, cycle.clean(acceleration), noise)


@dataclass(frozen=True, slots=True)
class Usual:
    """How a pair of sensors has fitted so far: the last good look, their ratio over some looks."""

    last: Weak
    ratio: complex = complex("nan")
    looks: int = 0

    def after(self, seen: Weak) -> "Usual":
        """With one more good look."""
        if not math.isfinite(abs(seen.ratio)):
            return Usual(seen, self.ratio, self.looks)
        if not self.looks:
            return Usual(seen, seen.ratio, 1)
        part = 1.0 / min(self.looks + 1, AVERAGED)
        return Usual(seen, self.ratio + part * (seen.ratio - self.ratio), self.looks + 1)


def misfit(
    cycle: Cycle, names: tuple[str, ...], acceleration: str, seen: Weak, usual: Usual | None
) -> Iterator[Doubt]:
    """A displacement and an acceleration that do not belong to one motion, or no longer do.

    Accused is the one that is further from the last look that was good; where the motion itself
    changes from cycle to cycle it may as well be the other one.
    """
    share, limit, how = seen.apart / seen.size if seen.size else 0.0, MATCH, "does not fit"
    if share <= MATCH and usual is not None and usual.looks >= KNOWN:
        share, limit, how = seen.changed(usual.ratio) / seen.size, CHANGE, "no longer fits"
    most = OFFSET_RANGE * cycle.bench.range_si(acceleration) + 6.0 * seen.sigma_offset
    if share <= limit:
        # What a wrong gain within its limit would explain is no offset.
        if abs(seen.offset) > most + MATCH * seen.average:
            yield drifted(acceleration, seen.offset, most + MATCH * seen.average, "m/s2")
        return
    if abs(seen.offset) > most and seen.apart_but_offset < BY_OFFSET * seen.apart:
        yield drifted(acceleration, seen.offset, most, "m/s2")
        return
    accused, other = names[0], acceleration
    if usual is not None:
        moved = abs(seen.displacement[1] - usual.last.displacement[1])
        if abs(seen.acceleration[1] - usual.last.acceleration[1]) > moved:
            accused, other = acceleration, names[0]
    text = f"{accused} {how} {other}: {100 * share:.0f} % of the motion apart; "
    text += f"allowed: {100 * limit:.0f} %"
    yield Doubt("consistency", accused, share, limit, text, about=names[0])


def table_mean(cycle: Cycle) -> Iterator[Doubt]:
    """The mean of the table's displacement over a held cycle: it must be that at rest."""
    if not cycle.has("table_disp_m"):
        return
    table = cycle.tones["table_disp_m"]
    limit = OFFSET_RANGE * cycle.bench.range_si("table_disp_m")
    limit += OFFSET_LEVEL * table.fundamental + cycle.sigma("table_disp_m")
    if abs(table.offset) > limit:
        yield drifted("table_disp_m", table.offset, limit, "m")


@dataclass(frozen=True, slots=True)
class Swing:
    """Mean and half the range of u in m, averaged over about AVERAGED looks."""

    mean: float = 0.0
    half: float = 0.0
    looks: int = 0


def swung(cycle: Cycle, before: Swing) -> Swing:
    """The average after one more cycle; as it was where u is not measured."""
    u = cycle.relative()
    if u is None:
        return before
    part = 1.0 / min(before.looks + 1, AVERAGED)
    mean, half = float(u.mean()), 0.5 * float(np.ptp(u))
    return Swing(
        before.mean + part * (mean - before.mean),
        before.half + part * (half - before.half),
        before.looks + 1,
    )


def mass_mean(cycle: Cycle, swing: Swing) -> Iterator[Doubt]:
    """The mass may be thrown aside for a while; on average it swings about the middle.

    How far from it, impacts on one side more than on the other decide, and unequal gaps.
    """
    right, left = cycle.bench.profile.specimen.gaps_m
    aside = abs(right - left) / 2 if right != left else 0.0
    name = "rel_disp_m" if "rel_disp_m" in cycle.bench.rig.channels else "mass_disp_m"
    if swing.looks < AVERAGED or name not in cycle.bench.rig.channels:
        return
    limit = OFFSET_RANGE * cycle.bench.range_si(name) + ASYMMETRY * swing.half + aside
    if abs(swing.mean) > limit:
        yield drifted(name, swing.mean, limit, "m")


def level(cycle: Cycle) -> Iterator[Doubt]:
    """The fundamental of the table's acceleration against the demanded level."""
    if not cycle.has("table_acc_m_s2") or cycle.level <= 0.0:
        return
    card, seen = cycle.bench.profile.protection, cycle.tones["table_acc_m_s2"].fundamental
    off = seen / cycle.level - 1.0
    words = f"table at {seen:.4g} m/s2, demanded {cycle.level:.4g} m/s2"
    # Before the measured cycles a level may still be on its way to what is demanded.
    if abs(off) > card.alarm and cycle.label == Label.MEASURE:
        limit = math.copysign(card.alarm, off)
        text = f"{words}: {100 * off:+.1f} %; allowed: +-{100 * card.alarm:g} %"
        yield Doubt("level", "table_acc_m_s2", seen, (1 + limit) * cycle.level, text, "alarm", 1)
    off_db = 20 * math.log10(max(seen / cycle.level, 1e-9))
    if abs(off_db) > card.abort_db:
        limit = math.copysign(card.abort_db, off_db)
        text = f"{words}: {off_db:+.1f} dB; allowed: +-{card.abort_db:g} dB"
        bound = 10 ** (limit / 20) * cycle.level
        yield Doubt("level", "table_acc_m_s2", seen, bound, text, "stop")


def read_back(cycle: Cycle) -> Iterator[Doubt]:
    """The command as read back against the command as queued, where it is too small for a look at
    every sample.
    """
    asked = cycle.tones["command"].fundamental
    if not cycle.has("drive_disp_m") or asked == 0.0:
        return
    limit = READ_BACK + cycle.bench.rig.output.lsb_m / asked
    gain = cycle.tones["drive_disp_m"].fundamental / asked
    if abs(gain - 1.0) > limit:
        text = f"the command read back is {gain:.3f} of what was queued; allowed: +-{limit:.3f}"
        yield Doubt("command", "drive_disp_m", gain, 1 + math.copysign(limit, gain - 1), text)


def transfer(cycle: Cycle) -> tuple[complex, complex]:
    """(table displacement, table acceleration) over the command, complex; NaN where lost."""
    command = complex(cycle.tones["command"].amplitudes[0])
    found = []
    for name, scale in (("table_disp_m", 1.0), ("table_acc_m_s2", -(cycle.omega**-2))):
        known = cycle.has(name) and command != 0
        tone = scale * complex(cycle.tones[name].amplitudes[0])
        found.append(tone / command if known else complex("nan"))
    return found[0], found[1]


def response(cycle: Cycle, seen: tuple[complex, complex], known: complex) -> Iterator[Doubt]:
    """The table's response to its command against the one that is known.

    A servo whose oil pressure falls lags more and more before it loses amplitude.
    """
    ratios = [one / known for one in seen]
    if not all(math.isfinite(abs(one)) and one for one in ratios):
        return
    lag_s = lag(known, cycle.omega)
    push = pushed(cycle, lag_s)
    gain, most = min((abs(one) for one in ratios), key=lambda one: abs(one - 1.0)), GAIN + push
    # Both sensors have to agree: what only one of them shows is a fault of that sensor.
    if abs(gain - 1.0) > most:
        text = f"the table follows {gain:.2f} times as far as it did; allowed: +-{100 * most:.0f} %"
        yield Doubt("response", "table_acc_m_s2", gain, 1 + math.copysign(most, gain - 1), text)
    late_s = min((-np.angle(one) / cycle.omega for one in ratios), key=abs)
    limit = max(LAG_MORE * lag_s, LAG_S) + push / cycle.omega
    if abs(late_s) > limit:
        text = (
            f"the table lags {1e3 * (lag_s + late_s):.1f} ms behind its command, "
            f"{1e3 * lag_s:.1f} ms before; allowed: {1e3 * (lag_s + limit):.1f} ms"
        )
        yield Doubt("response", "table_disp_m", lag_s + late_s, lag_s + limit, text)


def pushed(cycle: Cycle, lag_s: float) -> float:
    """How far the specimen pushes the table aside, over the table's amplitude.

    M / m a / p^2 with the pole p = 2 / lag of a servo of two equal ones.
    """
    if not cycle.has("mass_acc_m_s2", "table_disp_m"):
        return 0.0
    bench = cycle.bench
    a = track(cycle.clean("mass_acc_m_s2"), cycle.phase, HARMONICS).fundamental
    ratio = bench.profile.specimen.mass_kg / bench.rig.moving_mass_kg
    return ratio * a * (0.5 * lag_s) ** 2 / cycle.tones["table_disp_m"].fundamental


def lag(ratio: complex, omega: float) -> float:
    """Time in s by which a response is behind."""
    return float(-np.angle(ratio)) / omega
