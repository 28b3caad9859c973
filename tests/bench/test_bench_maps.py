"""A chunk of a study against the bare sweeps in it, and against diffrax's vmap over the same gaps.

pytest tests/bench/test_bench_maps.py -n 0 --benchmark-enable -s
"""

from dataclasses import replace

import numpy as np
import pytest

from tests.bench.peers import AG, diffrax_sweep
from tests.bench.test_bench_peers import ATOL, CYCLES, G4, REGULAR, RTOL, WHOLE, seconds
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.studies.maps.store import make_seeds
from twin.studies.maps.study import Study
from twin.studies.maps.task import compute_outcomes

CASES, VMAP_CASES = 200, 1000
STUDY = """
title = "Gaps of G4"
profile = "g4_ss3"
outcomes = ["curves", "peaks", "forces", "hysteresis"]
[[parameters]]
name = "specimen.gap_mm"
start = 2.0
stop = 10.0
count = 200
"""


def sweep_gaps(gaps_m: np.ndarray, frequencies: np.ndarray, measured: int) -> list[np.ndarray]:
    """(state at the end of each frequency, 4) of every gap a side."""
    return [
        simulate_sweep(
            Model(replace(G4, gap_r=gap, gap_l=gap)), frequencies, AG, CYCLES, measured
        ).states[:, :4]
        for gap in gaps_m.tolist()
    ]


@pytest.mark.benchmark(group="maps")
def test_the_outcomes_of_a_chunk_cost_little_more_than_its_sweeps(benchmark, tmp_path) -> None:
    path = tmp_path / "study.toml"
    path.write_text(STUDY)
    study = Study.read(path)
    values, seeds = np.linspace(2.0, 10.0, CASES)[:, None], make_seeds(0, range(CASES))
    benchmark(compute_outcomes, study, values, seeds)
    if benchmark.stats is not None:
        sweeps_s = seconds(lambda: sweep_gaps(values[:, 0] / 2e3, WHOLE, 3), 5)
        benchmark.extra_info["over_sweeps"] = benchmark.stats.stats.min / sweeps_s


@pytest.mark.slow
@pytest.mark.benchmark(group="maps")
def test_a_thousand_sweeps_against_diffrax_vmap(benchmark) -> None:
    """One core each, compilation excluded, where the motion is not chaotic."""
    pytest.importorskip("diffrax", reason="diffrax is not installed: pip install shaketwin[bench]")
    gaps_m = np.linspace(1e-3, 5e-3, VMAP_CASES)
    peer = diffrax_sweep(CYCLES, RTOL, ATOL)
    states, _ = peer(REGULAR, gaps_m)
    ours = np.array(sweep_gaps(gaps_m, REGULAR, 3))
    # A jump may come a step earlier or later: the last bits of the tolerance decide.
    differs = np.abs(states[:, -1, 0] - ours[:, -1, 0]) > 1e-6
    assert differs.mean() < 0.02
    benchmark.pedantic(sweep_gaps, (gaps_m, REGULAR, 3), rounds=3)
    if benchmark.stats is not None:
        peer_s = seconds(lambda: peer(REGULAR, gaps_m), 1)
        benchmark.extra_info["over_diffrax_vmap"] = benchmark.stats.stats.min / peer_s
        print(f"\ndiffrax vmap {peer_s:.1f} s, ours {benchmark.stats.stats.min:.2f} s")
