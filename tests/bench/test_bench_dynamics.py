"""Speed of continuation, with figures in the extra information of each benchmark.

Run with: pytest tests/bench/test_bench_dynamics.py -n 0 --benchmark-enable
"""

import pytest

from tests.dynamics.maps import model_map, settle
from twin.dynamics.continuation import continue_branch
from twin.dynamics.loci import continue_locus


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
