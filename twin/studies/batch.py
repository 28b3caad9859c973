"""Parallel stepped-sine sweeps of many models in threads; the kernels release the GIL."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace

from table_io.block import Float1D
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.stepped_sine import SteppedSineResponse
from twin.run.system import count_cores

STOP_POLL_S = 0.1  # period of polling `stop`


def sweep_models(
    models: Iterable[Model | Parameters],
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    cores: int | None = None,
) -> list[SteppedSineResponse]:
    """Simulate one sweep from rest per model, in the order of the models; `acceleration` in m/s2.

    Uses `cores` threads, by default all cores; the results do not depend on their number.
    """
    sweeps = iterate_sweeps(models, frequencies_hz, acceleration, cycles, cores)
    return [sweep for _, sweep in sweeps]


def iterate_sweeps(
    models: Iterable[Model | Parameters],
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float,
    cycles: int,
    cores: int | None = None,
    stop: Callable[[], object] = lambda: False,
) -> Iterator[tuple[int, SteppedSineResponse]]:
    """Yield (index, sweep) as in `sweep_models`, in the order of the models.

    Once `stop()` is true no further sweep starts; those in progress are finished and yielded.
    """
    prepared_models = [model if isinstance(model, Model) else Model(model) for model in models]
    with ThreadPoolExecutor(cores or count_cores()) as pool:
        pending = deque(
            (index, pool.submit(simulate_sweep, model, frequencies_hz, acceleration, cycles))
            for index, model in enumerate(prepared_models)
        )
        try:
            while pending:
                while not pending[0][1].done() and not stop():
                    wait([pending[0][1]], timeout=STOP_POLL_S)
                if stop():
                    pending = deque(item for item in pending if not item[1].cancel())
                if pending:
                    index, future = pending.popleft()
                    yield index, future.result()
        finally:
            for _, future in pending:
                future.cancel()


def make_gap_variants(model: Model, gaps_m: Iterable[float]) -> list[Model]:
    """Return the model at other total gaps in m, half of each gap per side."""
    return [
        Model(replace(model.base, gap_r=gap / 2, gap_l=gap / 2), model.effects) for gap in gaps_m
    ]
