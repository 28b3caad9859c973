"""The stepped-sine driver beside solve_ivp and diffrax on the same sweep of G4, in one run.

Always: they agree. With -n 0 --benchmark-enable: how many times faster, from 1.8 to 5 Hz
and back, where the motion is not chaotic and agreement can be checked. With -m slow also on the
whole SS3 sweep. diffrax is the optional extra `bench`.

    pytest tests/bench/test_bench_peers.py -n 0 --benchmark-enable -s
    pytest tests/bench/test_bench_peers.py -n 0 --benchmark-enable -m slow -s
"""

import time
from collections.abc import Callable

import numpy as np
import pytest

from tests.bench.peers import AG, diffrax_sweep, scipy_sweep
from twin.model.parameters import Parameters
from twin.model.stepped_sine import simulate_stepped_sine

G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)
CYCLES, RTOL, ATOL = 10, 1e-6, 1e-9
SCIPY_RATIO, DIFFRAX_RATIO, KERNEL_S = 1000, 30, 0.010


def there_and_back(low: float, high: float, step: float) -> np.ndarray:
    up = np.round(np.arange(round((high - low) / step) + 1) * step + low, 9)
    return np.concatenate([up, up[::-1]])


SHORT = there_and_back(3.0, 4.4, 0.2)
REGULAR = there_and_back(1.8, 5.0, 0.1)
WHOLE = there_and_back(0.5, 5.0, 0.1)


def seconds(call: Callable[[], object], times: int) -> float:
    """Best wall time of a few calls, in s."""
    best = np.inf
    for _ in range(times):
        begin = time.perf_counter()
        call()
        best = min(best, time.perf_counter() - begin)
    return best


def ours(frequencies: np.ndarray):
    """(state at the end of each frequency, onsets), extremes included in the time."""
    sweep = simulate_stepped_sine(G4, frequencies, AG, CYCLES)
    return sweep.states[:, :4], sweep.column("onsets_r").sum() + sweep.column("onsets_l").sum()


def agree(peer: tuple[np.ndarray, int], frequencies: np.ndarray, error_m: float) -> None:
    states, onsets = ours(frequencies)
    assert int(peer[1]) == onsets
    assert np.abs(peer[0][:, 0] - states[:, 0]).max() < error_m


def ratio(benchmark, frequencies: np.ndarray, peer_s: float, name: str, least: float) -> None:
    """Our time by pytest-benchmark, the peer's beside it; asserted where times are taken."""
    benchmark(ours, frequencies)
    if benchmark.stats is None:
        return
    time_ratio = peer_s / benchmark.stats.stats.min
    benchmark.extra_info[f"over_{name}"] = 1.0 / time_ratio
    motion = float(np.sum(CYCLES / frequencies))
    print(f"\n{name}: {1e3 * peer_s:.1f} ms, ours {1e3 * benchmark.stats.stats.min:.2f} ms for "
          f"{motion:.0f} s of motion: {time_ratio:.0f} times as long")  # fmt: skip
    assert time_ratio >= least


@pytest.mark.benchmark(group="peers")
def test_solve_ivp(benchmark):
    """RK45 with events; the error is its tolerance's."""
    agree(scipy_sweep(SHORT, CYCLES, RTOL), SHORT, 2e-6)
    enabled = benchmark.enabled
    peer_s = seconds(lambda: scipy_sweep(REGULAR, CYCLES, RTOL), 2) if enabled else 0.0
    ratio(benchmark, REGULAR, peer_s, "solve_ivp", SCIPY_RATIO)


@pytest.mark.benchmark(group="peers")
def test_diffrax(benchmark):
    """Compilation excluded; diffrax computes no extremes, ours does."""
    pytest.importorskip("diffrax", reason="diffrax is not installed: pip install shaketwin[bench]")
    peer = diffrax_sweep(CYCLES, RTOL, ATOL)
    agree(peer(REGULAR), REGULAR, 5e-8)
    peer_s = seconds(lambda: peer(REGULAR), 5) if benchmark.enabled else 0.0
    ratio(benchmark, REGULAR, peer_s, "diffrax", DIFFRAX_RATIO)


@pytest.mark.slow
@pytest.mark.benchmark(group="peers")
def test_solve_ivp_on_the_whole_sweep(benchmark):
    """SS3 whole; its low frequencies are chaotic, so only times compare."""
    peer_s = seconds(lambda: scipy_sweep(WHOLE, CYCLES, RTOL), 1) if benchmark.enabled else 0.0
    ratio(benchmark, WHOLE, peer_s, "solve_ivp", SCIPY_RATIO)


@pytest.mark.slow
@pytest.mark.benchmark(group="peers")
def test_diffrax_on_the_whole_sweep(benchmark):
    pytest.importorskip("diffrax", reason="diffrax is not installed: pip install shaketwin[bench]")
    peer = diffrax_sweep(CYCLES, RTOL, ATOL)
    peer(WHOLE)
    peer_s = seconds(lambda: peer(WHOLE), 5) if benchmark.enabled else 0.0
    ratio(benchmark, WHOLE, peer_s, "diffrax", DIFFRAX_RATIO)


@pytest.mark.benchmark(group="peers")
def test_the_whole_sweep_in_ten_milliseconds(benchmark):
    """G4 SS3, forward and backward, 10 cycles, extremes included, one core."""
    benchmark(ours, WHOLE)
    if benchmark.stats is not None:
        assert benchmark.stats.stats.min < KERNEL_S
