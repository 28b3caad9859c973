"""Everything that pictures and table draw from, computed once."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from table_io.block import Float1D
from twin.service.paper import findings
from twin.service.paper.cases import Case, cases
from twin.service.paper.findings import Folds, Impacts
from twin.service.paper.passage import Slow, slow

T = TypeVar("T")
SECONDARY_HZ = (0.53, 0.71, 1.1)  # the paper's f1, f2, f3
IRREGULAR_HZ, COEXISTING_HZ = 1.4, 3.4
CLOSE_HZ = (*SECONDARY_HZ, IRREGULAR_HZ, COEXISTING_HZ)
CHAOS_HZ = np.arange(500, 1605, 5) / 1000
CHAOTIC = 0.05  # of an exponent per cycle


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The model of every gap, by the paper's names."""

    cases: dict[str, Case]
    slow: dict[str, Slow]
    folds: dict[str, Folds | None]
    impacts: dict[float, Impacts]
    exponents: Float1D  # per cycle, at CHAOS_HZ, G4

    @property
    def exact(self) -> bool:
        """Whether the model is in closed form, and with it all that follows from that."""
        return self.cases["G4"].player.exact

    def chaotic(self, hz: float) -> bool:
        """Whether G4 is chaotic at this frequency, up to the end of `CHAOS_HZ`."""
        return bool(np.interp(hz, CHAOS_HZ, self.exponents) > CHAOTIC)


def study(
    model: str | None = None,
    stars: tuple[float, float] | None = None,
    done: Callable[[], None] = lambda: None,
) -> Study:
    """Runs a model, by default the paper's, through every test of the paper.

    Some 3 s for a model in closed form, a minute for one that is integrated. `done` is called
    `JOBS` times, whenever a part of it is finished.
    """
    found = cases(model, stars)
    names, g4 = list(found), found["G4"]

    def part(work: Callable[..., T], *lists: Sequence[object]) -> list[T]:
        """`work` on all of the lists at once: the kernels leave the interpreter alone."""

        def one(*words: object) -> T:
            result = work(*words)
            done()
            return result

        return list(pool.map(one, *lists))

    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        passages = dict(zip(names, part(slow, list(found.values())), strict=True))
        gaps = [name for name in names if name != "G∞"]
        folds = part(lambda name: findings.folds(found[name], passages[name]), gaps)
        close = (*SECONDARY_HZ, IRREGULAR_HZ)
        impacts = part(lambda hz: findings.impacts(g4, hz), close)
        exponents = part(lambda hz: findings.exponent(g4, hz, 400), CHAOS_HZ.tolist())
    return Study(
        found, passages, dict(zip(gaps, folds, strict=True)),
        dict(zip(close, impacts, strict=True)), np.array(exponents),
    )  # fmt: skip


JOBS = 9 + 8 + 4 + CHAOS_HZ.size
