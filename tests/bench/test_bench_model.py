"""Speed of the model beside scipy's on the same motion; the ratio is printed, nothing is asserted.

Run with: pytest tests/bench/test_bench_model.py -n 0 --benchmark-enable
"""

import math
import time

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from twin.dynamics.period_map import set_total_gap
from twin.model import closed_form
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.prepare import prepare_solver
from twin.model.solver import Solver
from twin.model.stepped_sine import simulate_stepped_sine
from twin.system.files import count_cores
from twin.system.process_pool import Workers, run_tasks

AG, FREQUENCY, CYCLES, RATE = 0.05 * 9.80665, 3.4, 10, 2000.0
G4 = Parameters(550.0, 36e3, 1100.0, 510e3, 900.0, 510e3, 900.0, 2e-3, 2e-3)
W = 2 * math.pi * FREQUENCY
SECONDS = CYCLES / FREQUENCY


def impacting() -> np.ndarray:
    return simulate_stepped_sine(G4, np.arange(300, 341, 2) / 100, AG, 40).states[-1]


def scipy_seconds() -> float:
    """Wall time of solve_ivp (RK45, rtol 1e-6) with events over ten impacting cycles."""

    def rhs(t, x):
        u, v = x
        force = 0.0
        if contact:
            force = 900.0 * v + 510e3 * (u - contact * 2e-3)
        return [v, -AG * math.sin(W * t) - (1100.0 * v + 36e3 * u + force) / 550.0]

    def right_event(t, x):
        return 2e-3 - x[0] if contact == 0 else contact * (900 * x[1] + 510e3 * x[0]) - 1020.0

    def left_event(t, x):
        return x[0] + 2e-3 if contact == 0 else 1.0

    for event in (right_event, left_event):  # solve_ivp reads attributes of its events
        vars(event).update(terminal=True, direction=-1)
    begin = time.perf_counter()
    contact, t, x = 0, 0.0, list(impacting()[:2])
    while t < SECONDS:
        piece = solve_ivp(
            rhs, (t, SECONDS), x, rtol=1e-6, atol=1e-9, events=(right_event, left_event)
        )
        t, x = piece.t[-1] + 1e-6, list(piece.y[:, -1])
        contact = 0 if contact else (1 if x[0] > 0 else -1)
    return time.perf_counter() - begin


def compare(benchmark, seconds_of_motion: float) -> None:
    if benchmark.stats is None:
        return
    ours = benchmark.stats.stats.min / seconds_of_motion
    scipys = min(scipy_seconds() for _ in range(3)) / SECONDS
    benchmark.extra_info["over_solve_ivp"] = ours / scipys
    print(f"\nsolve_ivp takes {scipys / ours:.0f} times as long")


@pytest.mark.benchmark(group="model")
def test_sampled_driver(benchmark):
    base = AG * np.sin(W * np.arange(1, round(SECONDS * RATE) + 1) / RATE)
    con = closed_form.discretized_params(G4, RATE)
    start = impacting()
    out = np.empty((7, base.size))
    benchmark(lambda: closed_form.advance_state(start.copy(), con, base, out))
    assert np.isfinite(out).all()
    compare(benchmark, SECONDS)


@pytest.mark.benchmark(group="model")
def test_one_block(benchmark):
    base = np.zeros(20)
    con = closed_form.discretized_params(G4, RATE)
    state = closed_form.rest_state(G4)
    out = np.empty((7, 20))
    benchmark(closed_form.advance_state, state, con, base, out)
    assert not out.any()


@pytest.mark.benchmark(group="model")
def test_sweep_of_the_paper_at_g4(benchmark):
    up = np.arange(5, 51) / 10
    frequencies = np.concatenate([up, up[::-1]])
    sweep = benchmark(simulate_stepped_sine, G4, frequencies, AG, 10)
    assert np.isfinite(sweep.extremes).all()
    compare(benchmark, float(np.sum(10 / frequencies)))


def shaken(model: Model, seconds: float = 10.0) -> tuple[Solver, np.ndarray, np.ndarray]:
    base = AG * np.sin(2 * math.pi * 2.6 * np.arange(1, round(seconds * RATE) + 1) / RATE)
    return prepare_solver(model, RATE), base, np.empty((7, base.size))


EFFECTS = {
    "linear": {"maxwell_damper": {"k1": 8e3, "tau": 0.05}},
    "forces": {"bouc_wen": {"force": 150.0, "yield_displacement": 3e-3},
               "bumper_hardening": {"k2": 1e8}},
}  # fmt: skip


@pytest.mark.benchmark(group="model")
@pytest.mark.parametrize("kind", EFFECTS)
def test_sampled_driver_with_effects(benchmark, kind):
    model = Model(G4)
    for effect, values in EFFECTS[kind].items():
        model = model.with_effect(effect, "", **values)
    solver, base, out = shaken(model)
    benchmark(lambda: solver.advance(solver.rest_state(), base, base, out))
    assert np.isfinite(out).all()
    if benchmark.stats is None:
        return
    nanoseconds = benchmark.stats.stats.min / base.size * 1e9
    plain, _, _ = shaken(Model(G4))
    plain_s = []
    for _ in range(50):
        begin = time.perf_counter()
        plain.advance(plain.rest_state(), base, base, out)
        plain_s.append(time.perf_counter() - begin)
    ratio = benchmark.stats.stats.min / min(plain_s)
    benchmark.extra_info["ns_a_sample"] = round(nanoseconds)
    benchmark.extra_info["over_snm"] = round(ratio, 2)
    print(f"\n{nanoseconds:.0f} ns a sample, {ratio:.0f} times the SNM")


@pytest.mark.benchmark(group="batch")
def test_batch_on_all_cores(benchmark):
    up = np.arange(5, 51) / 10
    frequencies = np.concatenate([up, up[::-1]])
    models = [set_total_gap(Model(G4), gap) for gap in np.linspace(2e-3, 0.03, 64)]
    sweep_models(models[:2], frequencies, count_cores())
    benchmark(sweep_models, models, frequencies, count_cores())
    if benchmark.stats is None:
        return
    single_core_s = min(_seconds(models, frequencies) for _ in range(3))
    ratio = single_core_s / benchmark.stats.stats.min
    benchmark.extra_info["cores_ratio"] = round(ratio, 2)
    print(
        f"\n{len(models) / single_core_s:.0f} sweeps a second on one core; "
        f"all cores {ratio:.2f} times that"
    )


def sweep_models(models: list[Model], frequencies: np.ndarray, cores: int) -> None:
    def sweep(number: int) -> None:
        simulate_sweep(models[number], frequencies, AG, 10)

    list(run_tasks(sweep, range(len(models)), Workers(cores, in_threads=True)))


def _seconds(models: list[Model], frequencies: np.ndarray) -> float:
    begin = time.perf_counter()
    sweep_models(models, frequencies, 1)
    return time.perf_counter() - begin
