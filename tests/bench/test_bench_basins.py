"""Basins of attraction of G4 from 0.5 to 5 Hz: 5,000 starts at each of 92 frequencies.

Run with: pytest tests/bench/test_bench_basins.py -n 0 --benchmark-enable
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.bench.test_bench_model import AG, G4
from twin.dynamics.basins import StartGrid, compute_basins_over
from twin.dynamics.event_driven_map import make_period_map
from twin.model.model import Model


@pytest.mark.benchmark(group="basins")
def test_basins_over_frequency(benchmark):
    """Goal: 30 s on two cores."""
    point, full = make_period_map(Model(G4), 1.0, AG), benchmark.enabled
    grid = StartGrid.from_limits(6e-3, 0.15, *((50, 100) if full else (3, 3)))
    frequencies = np.linspace(0.5, 5.0, 92) if full else [2.0, 3.4]
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        compute_basins_over(point, "frequency", [2.0], StartGrid.from_limits(1e-3, 0.1, 2, 2))
        begin = time.process_time()
        results = benchmark.pedantic(
            compute_basins_over, (point, "frequency", frequencies, grid, pool.map), rounds=1
        )
        core_seconds = time.process_time() - begin
    assert max(basins.undecided_share for basins in results) == 0
    if full:
        benchmark.extra_info["core_seconds"] = round(core_seconds, 1)
        print(f"\n{core_seconds:.1f} core seconds")
