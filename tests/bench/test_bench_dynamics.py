"""Speed of continuation, with figures in the extra information of each benchmark.

Run with: pytest tests/bench/test_bench_dynamics.py -n 0 --benchmark-enable
"""

import os
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from tests.bench.test_bench_model import AG, G4
from tests.dynamics.maps import model_map, settle
from twin.dynamics.basins import StartGrid, compute_basins_over
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.loci import continue_locus
from twin.model.model import Model


@pytest.mark.benchmark(group="dynamics")
def test_primary_branch(benchmark):
    """G4 from 5 Hz through both folds to 1.5 Hz, with multipliers, folds and grazing."""
    start = settle(model_map(), 5.0)
    branch = benchmark(lambda: continue_branch(start, "frequency", (1.5, 5.0)))
    benchmark.extra_info["points"] = len(branch.points)
    assert len(branch.of_kind("fold")) == 2
    assert len(branch.of_kind("grazing")) == 1


@pytest.mark.benchmark(group="dynamics")
def test_loci_over_frequency_and_gap(benchmark):
    """Folds and grazings, at least 200 points each."""
    branch = continue_branch(settle(model_map(), 5.0), "frequency", (1.8, 5.0))
    starts = branch.of_kind("fold")[0], branch.of_kind("grazing")[0]

    def follow():
        limits = ((1.3, 5.5), (0.0, 0.03))
        return [continue_locus(start, limits=limits, max_step=0.08) for start in starts]

    loci = benchmark(follow)
    benchmark.extra_info["points"] = [len(locus.values) for locus in loci]
    assert min(len(locus.values) for locus in loci) >= 200


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
