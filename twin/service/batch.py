"""Many models through the stepped sine on all cores: the kernels leave the interpreter alone."""

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace

from table_io.block import Float1D
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.sweep import SteppedSine

LOOK_S = 0.1  # how often it is asked whether to stop


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
    sweeps = one_by_one(models, frequencies_hz, acceleration, cycles, cores)
    return [sweep for _, sweep in sweeps]


def one_by_one(
    models: Iterable[Model | Parameters],
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    cores: int | None = None,
    stop: Callable[[], object] = lambda: False,
) -> Iterator[tuple[int, SteppedSine]]:
    """(place, sweep) as in `batch`, as they come; in their order.

    Once `stop()` is true none is begun any more; those under way are finished and handed out.
    """
    ready = [one if isinstance(one, Model) else Model(one) for one in models]
    with ThreadPoolExecutor(cores or len(os.sched_getaffinity(0))) as pool:
        waiting = deque(
            (place, pool.submit(swept, model, frequencies_hz, acceleration, cycles))
            for place, model in enumerate(ready)
        )
        try:
            while waiting:
                while not waiting[0][1].done() and not stop():
                    wait([waiting[0][1]], timeout=LOOK_S)
                if stop():
                    waiting = deque(one for one in waiting if not one[1].cancel())
                if waiting:
                    place, future = waiting.popleft()
                    yield place, future.result()
        finally:
            for _, future in waiting:
                future.cancel()


def at_gaps(model: Model, gaps_m: Iterable[float]) -> list[Model]:
    """The same model at other total gaps in m, half of each a side."""
    return [
        Model(replace(model.base, gap_r=gap / 2, gap_l=gap / 2), model.effects) for gap in gaps_m
    ]
