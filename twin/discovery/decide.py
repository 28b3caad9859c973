"""Judge recordings, play the test that would decide, and judge again, until it is decided."""

import getpass
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from table_io.clock import local_datetime
from table_io.errors import InputError
from twin.discovery.decisive_test import DecideOptions, TestProposal
from twin.discovery.result import ChainLink, Verdict
from twin.discovery.task import DiscoveredModel, PathLike, discover
from twin.evidence.selection import Cancelled
from twin.live.run_command import run_test
from twin.results.recordings import open_recording
from twin.setup.folders import make_output_folder, make_run_folder
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED
from twin.transport.endpoint import DEFAULT_ENDPOINT


class TestOperator:
    """Judges, and is asked and told, while tests are played; this one accepts all silently."""

    def judge(
        self,
        logs: Sequence[PathLike],
        model: PathLike,
        without: Sequence[str],
        held_out: Sequence[PathLike],
        options: DecideOptions,
    ) -> DiscoveredModel:
        """Return the verdict on recordings, with the proposed tests."""
        return discover(logs, model, without, held_out, options)

    def keep(self, result: DiscoveredModel, folder: Path) -> None:
        """Write a verdict to its folder."""
        result.write(folder)

    def confirm(self, proposal: TestProposal) -> str:
        """Return the answer to a test: "quit", "skip", or what its profile says of the set-up."""
        return "unattended"

    def tell(self, text: str) -> None:
        """Take note of what happens."""


@dataclass(frozen=True, eq=False)
class DecidedTests:
    """Chain of verdicts in `folder`, why it ended, and the exit code."""

    folder: Path
    reason: str
    results: tuple[DiscoveredModel, ...] = ()
    code: int = 0


@dataclass(frozen=True)
class _Chain:
    """Folder, rig and operator of a chain of tests."""

    folder: Path
    options: DecideOptions
    operator: TestOperator
    links: list[ChainLink] = field(default_factory=list)
    results: list[DiscoveredModel] = field(default_factory=list)

    def end(self, reason: str, code: int = 0) -> DecidedTests:
        self.operator.tell(reason)
        return DecidedTests(self.folder, reason, tuple(self.results), code)


def decide(
    logs: Sequence[PathLike],
    model: PathLike = "snm",
    without: Sequence[str] = (),
    held_out: Sequence[PathLike] = (),
    options: DecideOptions | None = None,
    out: PathLike | None = None,
    operator: TestOperator | None = None,
) -> DecidedTests:
    """Judge recordings, play the proposed test and judge again, until decided.

    Ends too when no test separates, none is left that the rig plays, or the rig time is used up.
    Verdicts and runs are in the new folder `out`.
    """
    paths = [Path(log) for log in logs]
    options = options or DecideOptions(asks=False)
    operator = operator or TestOperator()
    folder, _ = make_run_folder(None if out is None else Path(out), "decide")
    if not options.rig:
        rig = folder / "rig.toml"
        rig.write_text(open_recording(paths[-1]).start.rig_toml, encoding="utf-8")
        options = replace(options, rig=str(rig))
    chain = _Chain(folder, replace(options, profile=None), operator)
    remaining_min = options.budget_min
    link = ChainLink(played="", minutes=0.0, probability=None, log="")
    while True:
        count = len(chain.links) + 1
        verdict_folder = make_output_folder(folder / f"verdict-{count}", "")
        try:
            result = operator.judge(
                paths, model, without, held_out, replace(chain.options, budget_min=remaining_min)
            )
        except (InputError, Cancelled) as error:
            verdict_folder.rmdir()  # leave no empty folder after a failure
            if isinstance(error, InputError):
                raise
            return chain.end("stopped", EXIT_INTERRUPTED)
        chain.links.append(_complete_link(link, result.verdict))
        verdict = result.verdict.model_copy(update={"chain": [*chain.links]})
        result = replace(result, verdict=verdict)
        chain.results.append(result)
        operator.keep(result, verdict_folder)
        if not result.is_complete:
            return chain.end("stopped", EXIT_INTERRUPTED)
        if reason := find_end(result, count, remaining_min):
            return chain.end(reason)
        run_folder = folder / f"run-{count}"
        proposal, code = _play_best(chain, result, verdict_folder, run_folder)
        if proposal is None:
            if code:
                return DecidedTests(folder, "stopped", tuple(chain.results), code)
            return chain.end("not decided: no proposed test is left to play")
        paths.append(run_folder)
        played_min = measure_minutes(run_folder)
        remaining_min -= played_min
        link = ChainLink(
            played=proposal.test.title,
            minutes=played_min,
            probability=proposal.prediction.probability,
            log=str(run_folder.relative_to(folder)),
        )


def _complete_link(link: ChainLink, verdict: Verdict) -> ChainLink:
    """Return a link of the chain with what its verdict says."""
    return link.model_copy(
        update={
            "verdict": verdict.verdict,
            "effects": [effect.name for effect in verdict.effects],
            "confidence": min((effect.confidence for effect in verdict.effects), default=None),
        }
    )


def measure_minutes(run_folder: Path) -> float:
    """Return how long the table was played in a run in min, to its end or stop."""
    recording = open_recording(run_folder)
    return recording.contiguous_blocks("meas")[-1].end / recording.start.rate_hz / 60.0


def find_end(result: DiscoveredModel, count: int, remaining_min: float) -> str:
    """Return why no further test is played; "" if there is one to play.

    A first verdict that is decided already is confirmed by one test.
    """
    played = f"{count - 1} test{'s' if count > 2 else ''}"
    if result.is_decided and count > 1:
        return f"decided after {played}"
    if remaining_min <= 0:
        return f"not decided: the rig time is used up after {played}"
    if not result.proposals:
        return f"not decided: no test of at most {remaining_min:.2g} min separates what is open"
    return ""


def _play_best(
    chain: _Chain, result: DiscoveredModel, verdict_folder: Path, run_folder: Path
) -> tuple[TestProposal | None, int]:
    """Play the best test that rig and operator accept; return it, or None, and the exit code."""
    options = chain.options
    for proposal in result.proposals:
        answer = chain.operator.confirm(proposal)
        if answer == "quit":
            return None, EXIT_INTERRUPTED
        if answer == "skip":
            continue
        profile = run_folder.with_suffix(".toml")
        set_up = {"set_up": _describe_set_up(proposal, answer)}
        profile.write_text(proposal.format_profile(options.rig, set_up), encoding="utf-8")
        try:
            code = run_test(
                profile, run_folder, options.unpaced, str(verdict_folder / "model.toml"),
                options.rig, False, DEFAULT_ENDPOINT,
            )  # fmt: skip
        except InputError as error:
            chain.operator.tell(f"the rig refuses {proposal.test.title}: {error}")
            continue
        return (proposal, 0) if code in (0, EXIT_GAPS) else (None, code)
    return None, 0


def _describe_set_up(proposal: TestProposal, answer: str) -> dict[str, Any]:
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
