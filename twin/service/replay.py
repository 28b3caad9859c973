"""`replay`: recordings through the pipeline again; one with its report, or many in one table."""

from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import Comparison
from twin.service import summary as summaries
from twin.service.bundle import Bundle
from twin.service.deviation import deviation, sentence
from twin.service.folders import new_run
from twin.service.kernels import ready
from twin.service.outcome import EXIT_INTERRUPTED, EXIT_NOT_IDENTICAL, close
from twin.service.progress import RunProgress
from twin.service.publishing import publishing
from twin.service.recordings import recorded_bundle, warned
from twin.service.replaying import Identity, Recorded, Span, replay
from twin.service.step_range import step_range
from twin.service.terminal import console, say
from twin.service.versions import changes, differing
from twin.stream.folder import log_path
from twin.stream.keys import Keys
from twin.stream.recording import Recording, fitting
from twin.stream.wire import CMP_TOPIC, Item

RECORDED = "recorded"  # as a model: the one in the log


@dataclass(frozen=True, slots=True)
class Asked:
    """The options of the command; `publish` is an endpoint, `steps` as step_range has it."""

    logs: list[Path]
    models: list[str]
    out: Path | None = None
    speed: str = "max"
    view: bool = False
    publish: str | None = None
    steps: str | None = None
    keys: Keys | None = None


def replay_command(asked: Asked) -> int:
    """The exit code."""
    factor(asked.speed)
    if asked.steps is not None:
        step_range(asked.steps)
    alone = len(asked.logs) * max(len(asked.models), 1) == 1
    if not alone and (asked.view or asked.publish):
        raise BadInput("--view and --publish show one replay; give one log and one model")
    from twin.service.replay_table import replay_all

    try:
        return _one(asked) if alone else replay_all(asked)
    except KeyboardInterrupt:
        say("interrupted; what was replayed until then is kept")
        return EXIT_INTERRUPTED


def open_recorded(log: Path) -> Recorded:
    """A log to be replayed; BadInput where nothing in it drives a twin."""
    recorded = Recorded.open(log_path(log))
    warned(recorded.recording)
    driven(recorded.recording)
    return recorded


def driven(recording: Recording) -> None:
    """BadInput where nothing in a recording drives a twin."""
    channels = recording.start.channels
    if "table_acc_m_s2" not in channels:
        raise BadInput(
            f"{recording.path}: no table_acc_m_s2, which drives the twin; there: "
            f"{', '.join(channels)}; import the table's acceleration too"
        )


def bundle_with(recording: Recording, model: str | None) -> Bundle:
    """The bundle of a recording, with another model in it where one is named."""
    bundle = recorded_bundle(recording, None if model in (None, RECORDED) else model)
    ready(bundle)
    return bundle


def span_of(recording: Recording, steps: str | None) -> Span:
    """The samples that were asked for."""
    if steps is None:
        return Span.whole(recording)
    return Span.of_steps(recording, *step_range(steps))


def _one(asked: Asked) -> int:
    recorded = open_recorded(asked.logs[0])
    model = asked.models[0] if asked.models else None
    recording = recorded.recording
    bundle, span = bundle_with(recording, model), span_of(recording, asked.steps)
    pace, rate = factor(asked.speed), recorded.start.rate_hz
    watched = pace is not None or asked.publish is not None
    cut = recorded.start.block_samples if watched else 0
    link = publishing(bundle, asked.publish, asked.keys) if asked.publish else nullcontext()
    clock = RealClock()
    samples = min(bundle.drive.planned_end, span.last)
    with link as bus, RunProgress(console, len(bundle.steps), samples) as progress:
        folder, run = new_run(asked.out, f"{bundle.name}-replay")
        if bus is not None:
            bus.begin(run, at_once=pace is not None)
        began = clock.now()

        def watch(item: Item) -> None:
            if pace is not None:
                at = (item.end if isinstance(item, Block) else item.index) - span.first
                clock.wait_until(began + at / rate / pace)
            if bus is not None:
                bus.put(item)
            progress(item)

        identity = replay(recorded, bundle, folder / "run.mcap", run, watch, span, cut)
    told = about(recorded, bundle, model, identity, folder / "run.mcap")
    code = close(folder, bundle, asked.view, {"replay": told})
    say(said(identity, told))
    same = bundle.model_toml == recorded.start.model_toml
    return EXIT_NOT_IDENTICAL if same and identity.differs else code


def about(
    recorded: Recorded, bundle: Bundle, model: str | None, identity: Identity, made: Path
) -> summaries.Json:
    """How a replay relates to its recording, as `replay` in its summary.json."""
    recording = recorded.recording
    same = bundle.model_toml == recording.start.model_toml
    compared = [payload for _, payload in sorted(recorded.comparisons.items())]
    before = [*fitting(CMP_TOPIC, compared, recording.start, [])]
    return {
        "of": str(recording.path),
        "run": recording.run,
        "model": RECORDED if same else model,
        "identical": identity.identical,
        "beginning": identity.beginning or None,
        "comparisons": identity.recorded,
        "compared": identity.compared,
        "differing": identity.differing,
        "missing": identity.missing,
        "unrecorded": identity.unrecorded,
        "first_difference_index": identity.first_difference,
        "largest_difference_of_error_sums": identity.largest,
        "relative_difference": deviation(recording.path, made) if identity.differing else {},
        "versions_differing": differing(recording.start.versions),
        "recorded_comparison": summaries.nrmse(
            tuple(one for one in before if isinstance(one, Comparison)), bundle.parameters
        ),
    }


def said(identity: Identity, told: summaries.Json) -> str:
    """One line: identical, or what differs, by how much, and what may be why."""
    if identity.identical:
        return f"{identity.compared} comparisons, identical to the bit"
    if not identity.recorded:
        return f"no comparisons were recorded; {identity.made} are made"
    parts = [f"its beginning is in {identity.beginning}"] if identity.beginning else []
    parts += [
        f"{identity.differing} of {identity.recorded} comparisons differ, "
        f"{identity.missing} missing, {identity.unrecorded} never recorded"
    ]
    if told["relative_difference"]:
        parts.append(sentence(told["relative_difference"]))
    if told["model"] == RECORDED:
        changed = changes(told["versions_differing"])
        parts.append(f"versions: {changed or 'all that were recorded are the same'}")
    return "; ".join([*parts, "see summary.json, replay"])


def factor(speed: str) -> float | None:
    """Times real time; None for max."""
    if speed == "max":
        return None
    try:
        number = float(speed)
    except ValueError:
        number = 0.0
    if not 0 < number < 1e6:
        raise BadInput(f"--speed {speed}: allowed: max, or a number above 0 (times real time)")
    return number
