"""Paper study: every simulation that figures and table need, computed once."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from table_io.block import Float1D
from twin.paper import findings, low_frequency
from twin.paper.findings import Folds, ImpactDistribution
from twin.paper.low_frequency import ChaosMeasure, InternalLoops, SecondaryResonances
from twin.paper.slow_passage import SlowSweep, run_slow_sweep
from twin.results.paper_cases import PaperCase, load_paper_cases
from twin.system.process_pool import map_in_threads

T = TypeVar("T")
V = TypeVar("V")
SECONDARY_HZ = (0.53, 0.71, 1.1)  # f1, f2, f3 of the paper
IRREGULAR_HZ, COEXISTING_HZ = 1.4, 3.4
DETAIL_HZ = (*SECONDARY_HZ, IRREGULAR_HZ, COEXISTING_HZ)
CHAOS_SCAN_HZ = np.arange(500, 1605, 5) / 1000
MIN_CHAOTIC_EXPONENT = 0.05  # per cycle
POSITIVE_GAPS = ("G30", "G16", "G10", "G4")


@dataclass(frozen=True, slots=True, eq=False)
class PaperStudy:
    """Results of the model for every gap, by the paper's gap names."""

    cases: dict[str, PaperCase]
    slow_sweeps: dict[str, SlowSweep]
    folds: dict[str, Folds | None]
    impacts: dict[float, ImpactDistribution]
    exponents: Float1D  # per cycle, at CHAOS_SCAN_HZ, G4
    chaos: dict[float, ChaosMeasure]  # G4, at the paper's frequencies up to 1.4 Hz
    secondary: dict[str, SecondaryResonances]  # of the positive gaps
    loops: dict[float, InternalLoops]  # G4, at the paper's frequencies up to 1.4 Hz

    @property
    def is_exact(self) -> bool:
        """Whether the model is solved in closed form, so that the one-period map is available."""
        return self.cases["G4"].simulator.is_exact

    def find_own_hz(self, paper_hz: float) -> float | None:
        """Return the model's secondary resonance of G4 in the place of one of the paper's."""
        return low_frequency.nearest_hz(self.secondary["G4"].resonances_hz, paper_hz)

    def is_chaotic(self, hz: float) -> bool:
        """Return whether G4 is chaotic at a frequency within `CHAOS_SCAN_HZ`."""
        return bool(np.interp(hz, CHAOS_SCAN_HZ, self.exponents) > MIN_CHAOTIC_EXPONENT)


def run_paper_study(
    model: str | None = None,
    scale: tuple[float, float] | None = None,
    on_done: Callable[[], None] = lambda: None,
) -> PaperStudy:
    """Simulate every test of the paper with a model, by default the paper's.

    Takes about 20 s for a model in closed form, 2 min for an integrated one. `on_done` is called
    after each of the `JOB_COUNT` jobs.
    """
    cases = load_paper_cases(model, scale)
    names, g4 = list(cases), cases["G4"]

    def run_parallel(compute: Callable[[V], T], values: Sequence[V]) -> list[T]:
        return map_in_threads(compute, values, on_done)

    sweeps = run_parallel(run_slow_sweep, list(cases.values()))
    slow_sweeps = dict(zip(names, sweeps, strict=True))
    gaps = [name for name in names if name != "G∞"]
    folds = run_parallel(lambda name: findings.find_folds(cases[name], slow_sweeps[name]), gaps)
    frequencies = (*SECONDARY_HZ, IRREGULAR_HZ)
    impacts = run_parallel(lambda hz: findings.compute_impact_distribution(g4, hz), frequencies)
    chaos = run_parallel(lambda hz: low_frequency.measure_chaos(g4, hz), frequencies)
    loops = run_parallel(lambda hz: low_frequency.count_internal_loops(g4, hz), frequencies)
    secondary = run_parallel(
        lambda name: low_frequency.find_secondary_resonances(cases[name]), POSITIVE_GAPS
    )
    exponents = run_parallel(
        lambda hz: findings.compute_lyapunov_exponent(g4, hz, 400), CHAOS_SCAN_HZ.tolist()
    )
    return PaperStudy(
        cases, slow_sweeps, dict(zip(gaps, folds, strict=True)),
        dict(zip(frequencies, impacts, strict=True)), np.array(exponents),
        dict(zip(frequencies, chaos, strict=True)),
        dict(zip(POSITIVE_GAPS, secondary, strict=True)),
        dict(zip(frequencies, loops, strict=True)),
    )  # fmt: skip


JOB_COUNT = 9 + 8 + 4 + 4 + 4 + len(POSITIVE_GAPS) + CHAOS_SCAN_HZ.size
