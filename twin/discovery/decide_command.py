"""`shaketwin discover --decide`: write the test that would decide, or let the rig play it."""

import getpass
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from table_io.clock import local_datetime
from table_io.config.folders import find_config
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from table_io.records import RunStart
from twin.discovery.decisive_section import describe_next_run, proposal_to_json
from twin.discovery.decisive_test import TestProposal, list_candidate_tests, propose_tests
from twin.discovery.discover import Discovery
from twin.discovery.law_search import LawProposal
from twin.discovery.serialize import Json
from twin.live.run_command import run_test
from twin.report.finalize import EXIT_GAPS, EXIT_INTERRUPTED
from twin.results.recordings import open_recording
from twin.setup.folders import make_run_folder
from twin.system.terminal import console, print_line, show_status
from twin.transport.endpoint import DEFAULT_ENDPOINT

BUDGET_MIN = 10.0  # of rig time, by default


@dataclass(frozen=True)
class DecideOptions:
    """Options of `--decide`: file of the proposed profile, rig, rig time, who is asked, speed.

    Without `profile` it is written next to the verdict. `chain` are the verdicts before.
    """

    profile: Path | None = None
    rig: str = ""
    budget_min: float = BUDGET_MIN
    asks: bool = True
    unpaced: bool = False
    chain: tuple[Json, ...] = ()

    def check(self) -> None:
        """Raise InputError if the profile exists or the budget is no time."""
        if self.profile is not None and self.profile.exists():
            raise InputError(
                "exists; nothing is overwritten",
                key="--decide",
                value=str(self.profile),
                remedy="give a new file",
            )
        if not self.budget_min > 0:
            raise InputError(
                "no rig time", key="--budget-min", value=self.budget_min, allowed="above 0 min"
            )


def parse_options(
    profile: Path | None, run: bool, rig: str, budget_min: float, yes: bool, speed: str
) -> DecideOptions | None:
    """Return the checked options of `--decide` and `--run`; None without either of them."""
    if speed not in ("realtime", "max"):
        raise InputError("unknown pace", key="--speed", value=speed, allowed="realtime or max")
    if profile is None and not run:
        if rig or yes:
            raise InputError(
                "concerns the tests that are proposed",
                key="--rig" if rig else "--yes",
                remedy="give --decide or --run, too",
            )
        return None
    options = DecideOptions(profile, rig, budget_min, not yes, speed == "max")
    options.check()
    return options


@dataclass(frozen=True, eq=False)
class JudgedLogs:
    """Verdict on recordings in its folder, the tests proposed after it, and the exit code."""

    folder: Path
    verdict: Json
    proposals: Sequence[TestProposal]
    is_decided: bool
    code: int


def add_proposal(
    verdict: Json,
    discovery: Discovery,
    law: LawProposal | None,
    recorded: RunStart,
    rig_toml: str,
    folder: Path,
    options: DecideOptions,
) -> list[TestProposal]:
    """Write the profile of the best test and add it to the verdict; return all proposals."""
    with show_status("simulating candidate tests") as show:
        tests = list_candidate_tests(recorded, rig_toml, options.budget_min, options.asks)
        proposals = propose_tests(discovery, tests, show, law.fitted if law else None)
    path = options.profile if options.profile and not options.chain else folder / "decide.toml"
    verdict["decide"] = proposal_to_json(proposals, path.name)
    if proposals:
        path.write_text(format_proposal(proposals[0], options), encoding="utf-8")
        verdict["next_run"] = describe_next_run(verdict["decide"])
    else:
        verdict["next_run"] = (
            f"of {len(tests)} tests that the rig can play, none separates with every sensor within "
            "its range"
        )
    if options.chain:
        verdict["chain"] = [*options.chain[:-1], options.chain[-1] | list_verdict_entries(verdict)]
    return proposals


def read_recorded_test(paths: Sequence[Path], options: DecideOptions) -> tuple[RunStart, str]:
    """Return the last recorded test and the text of the rig; InputError if either is unknown."""
    recorded = open_recording(paths[-1]).start
    rig_toml = load_named_rig(options.rig) if options.rig else recorded.rig_toml
    if not recorded.profile_toml or not rig_toml:
        raise InputError(
            "no test can be proposed: its profile and rig are not in the recording",
            where=paths[-1],
            remedy="import it with --profile, or omit --decide",
        )
    return recorded, rig_toml


def load_named_rig(rig: str) -> str:
    """Return the text of a rig file by its name or path."""
    return load_rig(find_config(rig, "rigs", option="--rig"))[1]


def format_proposal(proposal: TestProposal, options: DecideOptions) -> str:
    """Return the text of the profile of a proposal, for the rig of the options."""
    return proposal.format_profile(options.rig or proposal.test.config.profile.rig)


def list_verdict_entries(verdict: Json) -> Json:
    """Return the entries of a link of the chain that are about the verdict."""
    confidences = [effect["confidence"] for effect in verdict["effects"]]
    return {
        "verdict": verdict["verdict"],
        "effects": [
            ".".join(filter(None, (effect["id"], effect.get("channel"))))
            for effect in verdict["effects"]
        ],
        "confidence": min(confidences, default=None),
    }


def make_link(
    played: str = "", minutes: float = 0.0, probability: float | None = None, log: str = ""
) -> Json:
    """Return a link of the chain without its verdict."""
    return {"played": played, "minutes": minutes, "probability": probability, "log": log}


def play_decisive_tests(
    paths: Sequence[Path],
    model: str,
    out: Path | None,
    without: Sequence[str],
    held_out: Sequence[Path],
    options: DecideOptions,
) -> int:
    """Judge, play the proposed test and judge again, until decided; return the exit code.

    Ends too when no test separates, none is left that the rig plays, or the rig time is used up.
    """
    from twin.discovery.discover_command import judge_logs  # which imports this module

    logs = [*paths]
    folder, _ = make_run_folder(out, "decide")
    if not options.rig:
        rig = folder / "rig.toml"
        rig.write_text(open_recording(paths[-1]).start.rig_toml, encoding="utf-8")
        options = replace(options, rig=str(rig))
    remaining_min = options.budget_min
    chain: tuple[Json, ...] = (make_link(),)
    while True:
        step = replace(options, budget_min=remaining_min, chain=chain)
        judged = judge_logs(logs, model, folder / f"verdict-{len(chain)}", without, held_out, step)
        chain = tuple(judged.verdict["chain"])
        reason = find_end(judged, len(chain), remaining_min)
        if judged.code or reason:
            print_line(reason or "stopped")
            return judged.code
        run_folder = folder / f"run-{len(chain)}"
        proposal, code = play_best(judged, run_folder, step)
        if proposal is None:
            return code
        logs.append(run_folder)
        played_min = measure_minutes(run_folder)
        remaining_min -= played_min
        link = make_link(
            proposal.test.title,
            played_min,
            proposal.prediction.probability,
            str(run_folder.relative_to(folder)),
        )
        chain = (*chain, link)


def measure_minutes(run_folder: Path) -> float:
    """Return how long the table was played in a run in min, to its end or stop."""
    recording = open_recording(run_folder)
    return max(item.end for item in recording.blocks("meas")) / recording.start.rate_hz / 60.0


def find_end(judged: JudgedLogs, count: int, remaining_min: float) -> str:
    """Return why no further test is played; "" if there is one to play.

    A first verdict that is decided already is confirmed by one test.
    """
    played = f"{count - 1} test{'s' if count > 2 else ''}"
    if judged.is_decided and count > 1:
        return f"decided after {played}"
    if remaining_min <= 0:
        return f"not decided: the rig time is used up after {played}"
    if not judged.proposals:
        return f"not decided: no test of at most {remaining_min:.2g} min separates what is open"
    return ""


def play_best(
    judged: JudgedLogs, folder: Path, options: DecideOptions
) -> tuple[TestProposal | None, int]:
    """Play the best test that rig and operator accept; return it, or None, and the exit code."""
    for proposal in judged.proposals:
        answer = confirm_test(proposal) if options.asks else "unattended"
        if answer == "quit":
            return None, EXIT_INTERRUPTED
        if answer == "skip":
            continue
        profile = folder.with_suffix(".toml")
        profile.write_text(
            proposal.format_profile(
                options.rig or proposal.test.config.profile.rig,
                {"set_up": confirm_set_up(proposal, answer)},
            ),
            encoding="utf-8",
        )
        try:
            code = run_test(
                profile, folder, options.unpaced, str(judged.folder / "model.toml"),
                options.rig or None, False, DEFAULT_ENDPOINT,
            )  # fmt: skip
        except InputError as error:
            print_line(f"the rig refuses {proposal.test.title}: {error}")
            continue
        return (proposal, 0) if code in (0, EXIT_GAPS) else (None, code)
    print_line("not decided: no proposed test is left to play")
    return None, 0


def confirm_test(proposal: TestProposal) -> str:
    """Ask the operator to set up a test and let the table move: "done", "skip" or "quit"."""
    config = proposal.test.config
    peak = max(config.margins, key=lambda demand: demand.displacement_m)
    level_m_s2 = max(demand.acceleration_m_s2 for demand in config.margins)
    print_line(
        f"TEST: {proposal.test.title}: {config.extent}, {proposal.test.minutes:.2g} min; the table "
        f"moves up to {1e3 * peak.displacement_m:.3g} mm and {level_m_s2:.3g} m/s2"
    )
    print_line(f"SET-UP: {proposal.test.set_up or 'as in the recording'}")
    try:
        reply = console.input("Press Enter to play it, s for the next best test, q to stop: ")
    except (KeyboardInterrupt, EOFError):
        print_line("")
        return "quit"
    return {"q": "quit", "s": "skip"}.get(reply.strip().lower()[:1], "done")


def confirm_set_up(proposal: TestProposal, answer: str) -> Json:
    """Return the table [set_up] of a profile: what was asked, and the answer."""
    try:
        who = getpass.getuser()
    except (KeyError, OSError):
        who = "unknown"
    return {
        "campaign": "discover --decide",
        "label": proposal.purpose,
        "asked": proposal.test.set_up or "as in the recording",
        "answer": answer,
        "who": who,
        "at": local_datetime().isoformat(timespec="seconds"),
    }
