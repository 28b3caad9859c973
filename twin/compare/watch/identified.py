"""The specimen as the running test shows it, and whether it drifts.

The equations of each held cycle are summed by chunks of a few cycles, and the chunks give
    now     least squares over the last ones
    drift   least squares over all, stiffness or gap with a straight trend in time and another in
            the logarithm of the amplitude, so that a law that bends is not taken for a drift
with the spread that the chunks show among themselves, where it is more than noise explains.
"""

from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.channels import rel_disp
from table_io.records import Estimate, Event, Record
from twin.compare.watch.equations import equations
from twin.compare.watch.held import Held, Noise, WatchSetup

FULL_S, FEWEST = 1.0, 3  # of held cycles of one step that make a chunk, and cycles at least
RECENT_S = 30.0  # of the test, whose chunks make the present value
LEAST = 8  # chunks before a drift is told
OFF = 0.01  # of a contact force: what the gain of load cells may be off all the time
SURE = 4.0  # standard deviations of a drift
NOTICED = 0.003  # of a stiffness; for a gap, of the deepest deformation: less concerns nobody
# Of a stiffness per e-fold of the amplitude: what a law may bend beyond the model's, while the twin
# has stayed within its band, and once it has left it.
BENDS, BENDS_MORE = 0.003, 0.1
STILL_M = 1e-9
MOST = 256  # chunks of a law that are kept apart; then neighbours are put together
NAMES = (
    ("stiffness", "damping"),
    ("bumper_stiffness_r", "gap_r"),
    ("bumper_stiffness_l", "gap_l"),
)
TREND = (0, 1, 1)  # which of the two linear numbers of a law may drift


@dataclass(frozen=True, slots=True, eq=False)
class Chunk:
    """Normal equations of one law's n numbers, (n, n) and (n,), from `count` cycles.

    About `at_s`, `lasts_s` in all; `reach` is the mean logarithm of the amplitude of u in m.
    """

    at_s: float
    reach: float
    step: int
    count: int
    lasts_s: float
    matrix: Float2D
    right: Float1D

    @property
    def full(self) -> bool:
        return self.count >= FEWEST and self.lasts_s >= FULL_S


@dataclass(frozen=True, slots=True, eq=False)
class Identified:
    """Chunks of each law so far, the last one still growing; what was said to drift."""

    chunks: tuple[tuple[Chunk, ...], ...] = ((), (), ())
    drifting: frozenset[str] = frozenset()
    deepest: float = 0.0  # m, of a bumper


def identify(
    setup: WatchSetup, known: Identified, noise: Noise, held: Held, trusted: bool, doubt: bool
) -> tuple[Identified, list[Record]]:
    """With one more cycle; the Estimate where a chunk is full.

    `trusted`: the twin has stayed within its band so far, so its laws hold. `doubt`: sensors
    contradict each other, so no drift is told.
    """
    new = equations(setup, noise, held)
    chunks = tuple(
        mine if one is None else _grown(mine, held, setup.rate_hz, *one)
        for mine, one in zip(known.chunks, new, strict=True)
    )
    known = replace(known, chunks=chunks, deepest=max(known.deepest, _depth(setup, held)))
    grown = [mine for mine, one in zip(chunks, new, strict=True) if one is not None]
    if not any(mine[-1].full for mine in grown):
        return known, []
    known, items = _told(setup, known, held, BENDS if trusted else BENDS_MORE)
    return known, [one for one in items if not (doubt and isinstance(one, Event))]


def _grown(
    chunks: tuple[Chunk, ...], held: Held, rate_hz: float, rows: Float2D, values: Float1D
) -> tuple[Chunk, ...]:
    """With the weighed equations (equation, n) and (equation,) of a cycle."""
    lasts_s = len(held.measured) / rate_hz
    at_s = held.end / rate_hz - 0.5 * lasts_s
    last = chunks[-1] if chunks else None
    if last is None or last.step != held.step.index or last.full:
        size = rows.shape[1]
        last = Chunk(at_s, 0.0, held.step.index, 0, 0.0, np.zeros((size, size)), np.zeros(size))
    else:
        chunks = chunks[:-1]
    reach = float(np.log(max(np.ptp(rel_disp(held.true)), STILL_M)))
    grown = Chunk(
        last.at_s + (at_s - last.at_s) / (last.count + 1),
        last.reach + (reach - last.reach) / (last.count + 1),
        last.step,
        last.count + 1,
        last.lasts_s + lasts_s,
        last.matrix + (rows[:, :, None] * rows[:, None, :]).sum(axis=0),
        last.right + (rows * values[:, None]).sum(axis=0),
    )
    return (*(_thinned(chunks) if len(chunks) >= MOST else chunks), grown)


def _thinned(chunks: tuple[Chunk, ...]) -> tuple[Chunk, ...]:
    """Each two neighbours as one."""
    pairs = zip(chunks[::2], chunks[1::2], strict=False)
    return tuple(
        Chunk(
            0.5 * (a.at_s + b.at_s),
            0.5 * (a.reach + b.reach),
            b.step,
            a.count + b.count,
            a.lasts_s + b.lasts_s,
            a.matrix + b.matrix,
            a.right + b.right,
        )
        for a, b in pairs
    ) + (chunks[-1:] if len(chunks) % 2 else ())


def _depth(setup: WatchSetup, held: Held) -> float:
    """m by which the cycle has pressed into a bumper, at most."""
    u = rel_disp(held.true)
    reach = [float(np.nanmax(s * u)) for s in (1, -1)] if np.isfinite(u).any() else [0.0, 0.0]
    return max(0.0, *(r - g for r, g in zip(reach, setup.gaps_m, strict=True)))


def _told(
    setup: WatchSetup, known: Identified, held: Held, bends: float
) -> tuple[Identified, list[Record]]:
    """The Estimate, and an Event for what has begun to drift."""
    p = setup.model.parameters
    deepest = max(known.deepest, STILL_M)
    reach = p.stiffness, p.bumper_stiffness_r * deepest, p.bumper_stiffness_l * deepest
    names: list[str] = []
    columns: list[tuple[float, float, float, float]] = []
    for law, (two, mine) in enumerate(zip(NAMES, known.chunks, strict=True)):
        found = _values(mine, law, bends * reach[law])
        names += two if found else ()
        columns += found
    if not names:
        return known, []
    values, sd, drift, drift_sd = (tuple(one) for one in zip(*columns, strict=True))
    record = Estimate(held.end, held.step.index, tuple(names), values, sd, drift, drift_sd)
    items: list[Record] = [record]
    drifting = set(known.drifting)
    for name, value, change, spread in zip(names, values, drift, drift_sd, strict=True):
        least = NOTICED * (known.deepest if name.startswith("gap") else abs(value))
        sure = abs(change) > SURE * spread and abs(change) > least
        if sure and name not in drifting:
            items.append(Event(held.end, "drift", _sentence(name, value, change, spread)))
            drifting.add(name)
        elif abs(change) < 0.5 * SURE * spread:
            drifting.discard(name)
    return replace(known, drifting=frozenset(drifting)), items


def _sentence(name: str, value: float, change: float, spread: float) -> str:
    if name.startswith("gap"):
        return (
            f"{name} has changed by {1e3 * change:+.3f} mm (+-{2e3 * spread:.3f}) since the start, "
            f"to {1e3 * value:.3f} mm"
        )
    first = value - change
    return (
        f"{name} has changed by {100 * change / first:+.2f} % "
        f"(+-{200 * spread / first:.2f}) since the start, to {value:.5g}"
    )


def _values(
    chunks: tuple[Chunk, ...], law: int, bends: float
) -> list[tuple[float, float, float, float]]:
    """(value, sd, drift, sd of the drift) of both numbers of a law; nothing while too few.

    `bends`: by how much the one that may drift may depend on the logarithm of the amplitude.
    """
    whole = [one for one in chunks if one.count >= FEWEST]
    if len(whole) < 2:
        return []
    since_s = min(whole[-1].at_s - RECENT_S, whole[-2].at_s)
    recent = _solved([one for one in whole if one.at_s >= since_s], None, 0.0)
    if recent is None:
        return []
    (first, second), covariance = recent[0][:2], recent[1][:2, :2]
    if first <= 0:  # what pushes nothing back is no spring: nothing is known yet
        return []
    jacobian = np.eye(2)
    if law:  # of (K, K G) -> (K, G)
        jacobian[1] = -second / first**2, 1 / first
        second = second / first
    sd = np.sqrt(np.diag(jacobian @ covariance @ jacobian.T))
    drift = [(float("nan"), float("nan"))] * 2
    trend = _solved(whole, TREND[law], bends) if len(whole) >= LEAST else None
    if trend is not None and trend[0][0] > 0:
        span = whole[-1].at_s - whole[0].at_s
        x, spread = trend
        scale = span / x[0] if law else span
        drift[TREND[law]] = float(scale * x[-1]), float(scale * np.sqrt(spread[-1, -1]))
    return [(float(first), float(sd[0]), *drift[0]), (float(second), float(sd[1]), *drift[1])]


def _solved(chunks: list[Chunk], trend: int | None, bends: float) -> tuple[Float1D, Float2D] | None:
    """(numbers, covariance) by least squares over the chunks.

    With a trend of one of them, two more follow: per e-fold of the amplitude, and per s. The
    covariance is noise's, larger where the chunks scatter more; None where they say nothing.
    """
    each = np.array([one.matrix for one in chunks])
    wanted = np.array([one.right for one in chunks])
    when = np.array([(one.reach, one.at_s) for one in chunks])
    count = wanted.shape[1]
    into = np.tile(np.eye(count, count if trend is None else count + 2), (len(chunks), 1, 1))
    prior = np.zeros(into.shape[2])
    prior[2:count] = OFF**-2  # the gains of load cells are 1 but for that
    right = prior.copy()
    if trend is not None:
        into[:, trend, count:] = when - when[0]
        prior[count] = bends**-2
    right += (into.mT @ wanted[:, :, None]).sum(axis=0)[:, 0]
    matrix = (into.mT @ each @ into).sum(axis=0) + np.diag(prior)
    size = np.sqrt(np.diag(matrix))
    if not (size > 0).all():
        return None
    scaled = matrix / np.outer(size, size)
    if np.linalg.cond(scaled) > 1e10:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(size, size)
    x: Float1D = inverse @ right
    left = (into.mT @ (wanted - (each @ into) @ x)[:, :, None])[:, :, 0]
    spare = len(chunks) / max(len(chunks) - x.size, 1)
    scatter = spare * inverse @ (left.T @ left) @ inverse
    more = np.sqrt(np.maximum(np.diag(scatter) / np.diag(inverse), 1.0))
    return x, inverse * np.outer(more, more)
