"""Everything that pictures and table draw from, computed once."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from twin.service.paper import findings
from twin.service.paper.cases import Case, cases
from twin.service.paper.findings import Folds, Impacts, Slow

SECONDARY_HZ = (0.53, 0.71, 1.1)  # the paper's f1, f2, f3
IRREGULAR_HZ, COEXISTING_HZ = 1.4, 3.4
CLOSE_HZ = (*SECONDARY_HZ, IRREGULAR_HZ, COEXISTING_HZ)
CHAOS_HZ = np.arange(500, 1605, 5) / 1000


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """The model of every gap, by the paper's names."""

    cases: dict[str, Case]
    slow: dict[str, Slow]
    folds: dict[str, Folds | None]
    impacts: dict[float, Impacts]
    exponents: Float1D  # per cycle, at CHAOS_HZ, G4


def study() -> Study:
    """Runs the model through every test of the paper; some 3 s."""
    found = cases()
    slow = {name: findings.slow(case) for name, case in found.items()}
    g4 = found["G4"]
    return Study(
        found,
        slow,
        {name: findings.folds(found[name], slow[name]) for name in found if name != "G∞"},
        {
            hz: findings.impacts(g4.parameters, hz, g4.acceleration)
            for hz in (*SECONDARY_HZ, IRREGULAR_HZ)
        },
        np.array([findings.exponent(g4, float(hz), 400) for hz in CHAOS_HZ]),
    )
