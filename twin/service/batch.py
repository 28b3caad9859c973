"""Many models through the stepped sine on all cores: the kernels leave the interpreter alone."""

import os
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

from table_io.block import Float1D
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.sweep import SteppedSine


def batch(
    models: Iterable[Model | Parameters],
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    cores: int | None = None,
) -> list[SteppedSine]:
    """One sweep from rest for each model, in their order; `acceleration` in m/s2.

    `cores` threads, all by default. A result does not depend on how many there are.
    """
    ready = [one if isinstance(one, Model) else Model(one) for one in models]

    def run(model: Model) -> SteppedSine:
        return swept(model, frequencies_hz, acceleration, cycles)

    with ThreadPoolExecutor(cores or len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(run, ready))


def at_gaps(model: Model, gaps_m: Iterable[float]) -> list[Model]:
    """The same model at other total gaps in m, half of each a side."""
    return [
        Model(replace(model.base, gap_r=gap / 2, gap_l=gap / 2), model.effects) for gap in gaps_m
    ]
