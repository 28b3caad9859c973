"""Search of laws on blind recordings whose effect is in no library, one line a case.

    python -m tests.studies.law_search FOLDER CASE [CASE ...]

The library is not tried first: what is judged is the law alone, from the refitted base. Cases are
those of the blind study, by number.
"""

import json
import math
import sys
from pathlib import Path

from table_io.clock import cpu_seconds
from twin.identification.discover import prepare_problem
from twin.identification.law_search import find_law
from twin.identification.localization import estimate_repeatability_floor
from twin.validation.study.adapter import load_case
from twin.validation.study.generation import generate_case
from twin.validation.study.strata import draw_case


def judge_case(root: Path, number: int) -> str:
    """Return the line of a case: held-out errors over the floor, the law, what was hidden."""
    case = draw_case(number)
    paths = generate_case(case, root)
    if not paths.log.is_file():
        return f"{case.cell.name}: not played"
    logs, _, model = load_case(paths.case_dir)
    start_s = cpu_seconds()
    prepared = prepare_problem(logs, model)
    problem = prepared.problem
    null = problem.fit_effects(prepared.parameters, ())
    law = find_law(problem, [null], problem.noise)
    best = law.fitted if law else null
    floor = problem.noise * estimate_repeatability_floor(problem.log_residuals, best.held_out)
    before, after = (math.sqrt(fitted.cost / floor) for fitted in (null, best))
    hidden = json.loads(paths.about.read_text())["effects"]
    texts = []
    for term in law.laws if law else ():
        values = [f"{name} {own.typical:.4g}" for name, own in term.parameters.items()]
        texts.append(f"{term.force} ({', '.join(values)})")
    return (
        f"{case.cell.name}: {before:.3f} -> {after:.3f} in {cpu_seconds() - start_s:.0f} s: "
        f"{' + '.join(texts) or 'no law'}; hidden {[effect['parameters'] for effect in hidden]}"
    )


if __name__ == "__main__":
    for case_number in map(int, sys.argv[2:]):
        print(judge_case(Path(sys.argv[1]), case_number), flush=True)
