"""How soon the watch sees what was planted, and whether it is silent otherwise: the table.

    python -m tests.studies.monitoring [PROFILE ...] [--laboratory typical|bad] [--seed N]

Plays each profile of profiles/tests (all of the paper's without arguments) on the simulated rig, at
its own rate and as fast as it goes, clean and with 5 % of stiffness lost over the test, and prints
what was said. With `--laboratory` instruments and set-up are imperfect, drawn for each profile.
Some minutes a profile.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from table_io.block import Block
from table_io.config.base import PROFILES_DIR, format_toml
from table_io.records import Event, Record
from tests.builders.laboratories import Level, draw_laboratory
from tests.builders.truths import hide_truth
from twin.compare.monitoring import EVENT_KINDS
from twin.setup.run_config import RunConfig, from_texts
from twin.setup.unpaced import add_twin_items, iter_simulated_session

ALL = ("ginf", "g30", "g16", "g10", "g4_ss1", "g4_ss2", "g4_ss3", "g0", "gm1", "gm2", "gm10")
LOST_SHARE = 0.05
TRUTH = '[[effects]]\nid = "stiffness_drift"\nparameters = {{ rate = {:.9f} }}\n'


def iter_session(name: str, truth: str, folder: Path) -> Iterator[tuple[RunConfig, Record | Block]]:
    """Every item of a session with that truth."""
    files = (f"tests/{name}.toml", "rigs/simulated.toml", "models/snm.toml")
    profile, rig, model = ((PROFILES_DIR / file).read_text() for file in files)
    rig = hide_truth(rig, folder, truth)
    bundle = from_texts(name, profile, rig, model, name)
    for item in add_twin_items(iter_simulated_session(bundle, "r"), bundle.prepare_twin()):
        yield bundle, item


def draw_imperfections(level: Level, seed: int) -> str:
    """Text of a truth file with the imperfections of a random laboratory."""
    entries = draw_laboratory(level, np.random.default_rng(seed))
    return format_toml(
        {"imperfections": [entry.model_dump(exclude_none=True) for entry in entries]}
    )


def row(name: str, truth: str, clean: str) -> tuple[str, float]:
    """(a line of the table, s that the test took)."""
    events: list[Event] = []
    begins, end, rate = -1, 0, 1.0
    with TemporaryDirectory() as folder:
        for bundle, item in iter_session(name, truth, Path(folder)):
            rate = bundle.drive.rate_hz
            if isinstance(item, Block) and item.stream == "meas":
                if begins < 0 and (item.step >= 0).any():
                    begins = item.index
                end = item.end
            elif isinstance(item, Event) and item.kind in EVENT_KINDS:
                events.append(item)
    jumps = [event for event in events if event.kind in ("jump", "no jump")]
    as_expected = sum("where the model expects it" in jump.text for jump in jumps)
    others = [event for event in events if event.kind not in ("jump", "no jump", "drift")]
    drift = next((event for event in events if event.kind == "drift"), None)
    drift_text = "-" if drift is None else f"{(drift.index - begins) / rate:.0f} s: {drift.text}"
    kinds = ", ".join(sorted({other.kind for other in others})) or "-"
    lasts = (end - begins) / rate
    return f"| {name} | {clean} | {as_expected} of {len(jumps)} | {drift_text} | {kinds} |", lasts


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("profiles", nargs="*", default=ALL)
    parser.add_argument("--laboratory", choices=("typical", "bad"))
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print("| test | planted | jumps as expected | drift seen after | else |\n|---|---|---|---|---|")
    for seed, name in enumerate(options.profiles, options.seed):
        truth = draw_imperfections(options.laboratory, seed) if options.laboratory else ""
        line, lasts = row(name, truth, "clean")
        print(line, flush=True)
        print(row(name, truth + TRUTH.format(-LOST_SHARE / lasts), "5 % lost")[0], flush=True)


if __name__ == "__main__":
    main()
