"""Blind studies of discovery: `python -m tests.studies.blind discovery|decide|laws --out FOLDER`.

Each simulates cases with a hidden truth, lets a method judge their recordings, and scores what it
says afterwards. What is done already is kept: `--resume` continues a study in its folder.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from table_io.errors import InputError
from tests.studies.blind.cases import LABORATORY_LEVELS
from tests.studies.blind.decide_study import FIRST_TESTS, run_decide_study
from tests.studies.blind.discovery_study import run_discovery_study
from tests.studies.blind.harness import StudyOptions
from tests.studies.blind.law_study import run_law_study
from twin.system.terminal import print_line


def main(words: Sequence[str] | None = None) -> int:
    """Run a study; return its exit code, 2 for bad input."""
    given = make_parser().parse_args(words)
    scheduler = given.scheduler if given.study == "discovery" else ""
    options = StudyOptions(
        given.out, given.seeds, given.cells or [], given.workers, given.resume, scheduler
    )
    try:
        match given.study:
            case "discovery":
                return run_discovery_study(options, given.laboratory, given.controls)
            case "decide":
                return run_decide_study(options, given.first)
            case _:
                return run_law_study(options, given.rig, given.rivals)
    except InputError as error:
        print_line(str(error))
        return 2


def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    parser = argparse.ArgumentParser("python -m tests.studies.blind", description=__doc__)
    studies = parser.add_subparsers(dest="study", required=True)
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--out", type=Path, help="new folder, or an existing one with --resume")
    common.add_argument("--resume", action="store_true", help="continue the study in --out")
    common.add_argument("--workers", type=int, help="processes; default: all cores")
    common.add_argument(
        "--cells", action="append", metavar="CELL",
        help="only these cells, such as 'single/*/3/1%%', or a case number; repeatable",
    )  # fmt: skip
    seeds = "cases per cell; five times as many without effect and of pairs"

    discovery = studies.add_parser("discovery", parents=[common], help="verdicts of discovery")
    discovery.add_argument("--seeds", type=int, default=10, help=seeds)
    discovery.add_argument("--scheduler", default="", help="Dask scheduler whose workers compute")
    discovery.add_argument(
        "--laboratory", choices=LABORATORY_LEVELS, default="none",
        help="imperfections of instruments and set-up; bad: one at a time",
    )  # fmt: skip
    discovery.add_argument(
        "--controls", action="store_true", help="also reversed time, effect not in the library"
    )
    decide = studies.add_parser(
        "decide", parents=[common], help="tests that `discover --decide` proposes, and random ones"
    )
    decide.add_argument("--seeds", type=int, default=2, help=seeds)
    decide.add_argument(
        "--first", choices=FIRST_TESTS, default="sweep",
        help="first test: a sweep, or at one level one-frequency, or flight",
    )  # fmt: skip
    laws = studies.add_parser("laws", parents=[common], help="laws for what no library holds")
    laws.add_argument("--seeds", type=int, default=1, help=seeds)
    laws.add_argument(
        "--rig", choices=("simulated", "hydraulic"), default="simulated",
        help="rig that records the hidden laws",
    )  # fmt: skip
    laws.add_argument(
        "--rivals", action="store_true", help="fit the installed rivals to the same recordings"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
