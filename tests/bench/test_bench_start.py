"""Compile once: how long a process takes from its start to its first result, shown, not asserted.

The first process finds an empty cache and compiles; the benchmark is what every later one takes.

    pytest tests/bench/test_bench_start.py -n 0 --benchmark-enable -s
"""

import os
import subprocess
import sys
import time

import pytest

MODEL = """
import numpy as np
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import Parameters
model = Model(Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3))
"""
FORCES = """
model = model.with_effect("bouc_wen", force=150.0, yield_displacement=3e-3)
model = model.with_effect("bumper_hardening", k2=1e8)
"""
SWEEP = """
up = np.arange(5, 51) / 10
extremes = simulate_sweep(model, np.concatenate([up, up[::-1]]), 0.05 * 9.80665, 10).extremes
assert np.isfinite(extremes).all()
"""
LIBRARIES = "import numba, numpy, scipy.linalg"


def process_s(code: str, cache: str | None) -> float:
    """Wall time of a fresh process in s, from its start to its end."""
    env = dict(os.environ) if cache is None else {**os.environ, "NUMBA_CACHE_DIR": cache}
    begin = time.perf_counter()
    subprocess.run([sys.executable, "-c", code], env=env, check=True)
    return time.perf_counter() - begin


@pytest.mark.benchmark(group="start")
@pytest.mark.parametrize("effects", ["", FORCES], ids=["snm", "forces"])
def test_a_second_process_finds_what_the_first_compiled(benchmark, effects, tmp_path):
    """The whole G4 SS3 sweep through the Python door, beside nothing but importing libraries."""
    code = MODEL + effects + SWEEP
    cache = str(tmp_path) if benchmark.enabled else None
    first = process_s(code, cache)
    benchmark.pedantic(process_s, (code, cache), rounds=5)
    if benchmark.stats is None:
        return
    second = benchmark.stats.stats.min
    bare = min(process_s(LIBRARIES, cache) for _ in range(5))
    benchmark.extra_info["over_imports_first"] = round(first / bare, 2)
    benchmark.extra_info["over_imports"] = round(second / bare, 3)
    print(f"\nfirst process {first:.1f} s, second {second:.2f} s, importing libraries {bare:.2f} s")
