"""Blind study: effects of a table named from its rehearsal, and truth of its intervals.

    python -m tests.studies.table_effects [CASES] [SEED] [FILE]

Random tables of `tests/earthquakes/planted_tables.py`, one third without an effect, are rehearsed
and identified; a line of JSON is written for each, and the counts at the end.
"""

import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from tests.builders.rigs import compute_oil_column_hz
from tests.earthquakes.hydraulic_rig import TABLE
from tests.earthquakes.planted_tables import SIZES, PlantedTable, draw_table, record_rehearsal
from twin.earthquakes.table_evidence import discover_table_effects
from twin.earthquakes.table_identification import RehearsalProblem, fit_basic_twin

MASS_KG, STALL_N = TABLE.moving_mass_kg, 42_000.0


def list_cases(count: int, seed: int) -> list[PlantedTable]:
    """Return random tables: every third without an effect, the kinds of effect by turns."""
    rng = np.random.default_rng(seed)
    kinds = [str(kind) for kind in rng.permutation(list(SIZES))]
    effects = []
    for index in range(count):
        effects.append("" if index % 3 == 2 else kinds[(index - index // 3) % len(kinds)])
    return [draw_table(rng, effect) for effect in effects]


def find_truth(table: PlantedTable) -> dict[str, float]:
    """Return the true values of the parameters whose intervals are judged."""
    assert TABLE.hydraulic is not None
    config = TABLE.hydraulic.model_copy(update=dict(table.hydraulic))
    return {
        "friction_n": config.friction_n,
        "oil_hz": compute_oil_column_hz(config, MASS_KG),
        "gain_1_s": config.gain_1_s,
        "velocity_feedforward": config.velocity_feedforward,
        "frame_hz": config.frame_frequency_hz,
    }


def run_case(table: PlantedTable) -> dict[str, Any]:
    """Return what was planted and what was named in one table."""
    begin = time.process_time()
    problem = RehearsalProblem.from_rehearsal(record_rehearsal(table), MASS_KG, STALL_N)
    basic = fit_basic_twin(problem)
    fitted_s = time.process_time() - begin
    discovery = discover_table_effects(basic)
    verdict = discovery.verdict
    parameters, widths = (
        discovery.fitted.fit.parameters,
        discovery.fitted.fit.estimate_half_widths(),
    )
    planted = {key: float(table.hydraulic[key]) for key in SIZES.get(table.effect, {})}
    return {
        "effect": table.effect,
        "planted": planted,
        "outcome": verdict.outcome,
        "probability": verdict.confidence,
        "place": verdict.place,
        "named": [*verdict.best.names],
        "alternatives": [other.names for other in verdict.alternatives],
        "sizes": [getattr(parameters, each.amplitude.name) for each in verdict.best.effects],
        "gaps": [discovery.basic.gap, discovery.fitted.gap],
        "errors_in_half_widths": {
            name: (getattr(parameters, name) - true) / widths[name]
            for name, true in find_truth(table).items()
        },
        "half_widths": {name: widths[name] / true for name, true in find_truth(table).items()},
        "seconds": [fitted_s, time.process_time() - begin],
    }


def main() -> None:
    """Run the study."""
    count, seed = (int(word) for word in (sys.argv[1:3] + ["24", "9000"][len(sys.argv[1:3]) :]))
    out = Path(sys.argv[3]) if len(sys.argv) > 3 else None
    rows = []
    for table in list_cases(count, seed):
        rows.append(run_case(table))
        print(json.dumps(rows[-1]), flush=True)
        if out is not None:
            out.write_text("".join(json.dumps(row) + "\n" for row in rows))
    planted, clean = (
        [row for row in rows if bool(row["effect"]) == kind] for kind in (True, False)
    )
    right = sum(row["named"][:1] == [row["effect"]] for row in planted)
    wrong = sum(bool(row["named"]) and row["named"][0] != row["effect"] for row in planted)
    print(f"planted {len(planted)}: {right} right, {wrong} wrong, "
          f"{len(planted) - right - wrong} abstained")  # fmt: skip
    print(f"without effect {len(clean)}: {sum(bool(row['named']) for row in clean)} false names")
    for name in rows[0]["errors_in_half_widths"]:
        errors = [abs(row["errors_in_half_widths"][name]) for row in clean]
        print(f"{name}: interval holds the truth in {sum(e <= 1 for e in errors)} of {len(errors)}")


if __name__ == "__main__":
    main()
