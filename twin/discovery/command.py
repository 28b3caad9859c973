"""Commands `discover` and `identify`: progress, files and words of their tasks."""

import contextlib
import math
from collections.abc import Iterator, Sequence
from pathlib import Path

from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from table_io.errors import InputError
from twin.discovery.decide import TestOperator, decide
from twin.discovery.decisive_test import DecideOptions, TestProposal
from twin.discovery.features.page import write_features_page
from twin.discovery.features.task import (
    FeatureProgress,
    discover_features,
)
from twin.discovery.page import write_discovery_page, write_identification_page
from twin.discovery.parameters import GapKey
from twin.discovery.result import (
    FeatureResult,
    FeatureVerdict,
    IdentificationReport,
    Interval,
    Verdict,
    describe_fit,
    label_feature,
)
from twin.discovery.selection import ProgressCallback, SelectionProgress
from twin.discovery.task import DiscoveredModel, PathLike, discover, identify
from twin.discovery.words import (
    describe_excluded,
    describe_proposal,
    describe_sensors,
    format_interval,
    format_share,
    format_verdict,
)
from twin.evidence.linear import INTERVAL_SIGMA
from twin.evidence.selection import Cancelled
from twin.results.quantities import format_quantity
from twin.setup.folders import make_output_folder, make_run_folder, remove_empty_folders
from twin.system.exit_codes import EXIT_INTERRUPTED
from twin.system.progress import make_task_bar
from twin.system.terminal import catch_interrupts, console, print_line, print_table

SHOWN_FITS = 8  # effects and pairs printed; the page has all
SYMBOLS = {
    "stiffness": "K", "damping": "C", "bumper_stiffness": "K_j", "bumper_damping": "C_j",
}  # fmt: skip


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
                key="--table" if rig else "--yes",
                remedy="give --decide or --run, too",
            )
        return None
    options = DecideOptions(profile, rig, budget_min, not yes, speed == "max")
    options.check()
    return options


def run_discovery(
    logs: Sequence[PathLike],
    model: PathLike,
    out: Path | None,
    without: Sequence[str] = (),
    held_out: Sequence[PathLike] = (),
    options: DecideOptions | None = None,
) -> tuple[DiscoveredModel | None, int]:
    """Run a discovery, write its results to a new folder, print them; return (result, exit code).

    No result if it was interrupted before there was one.
    """
    folder, _ = make_run_folder(out, "discover")
    try:
        result = _discover_with_progress(logs, model, without, held_out, options)
    except (InputError, Cancelled) as error:
        remove_empty_folders()
        if isinstance(error, InputError):
            raise
        return None, EXIT_INTERRUPTED
    _keep_result(result, folder, options.profile if options else None)
    return result, 0 if result.is_complete else EXIT_INTERRUPTED


def _discover_with_progress(
    logs: Sequence[PathLike],
    model: PathLike,
    without: Sequence[str],
    held_out: Sequence[PathLike],
    options: DecideOptions | None,
) -> DiscoveredModel:
    with (
        catch_interrupts("stopping: the best result so far is kept") as is_stopping,
        _show_progress() as show,
    ):

        def report(progress: SelectionProgress) -> None:
            if is_stopping():
                raise Cancelled
            show(progress)

        try:
            return discover(logs, model, without, held_out, options, report)
        except Cancelled:
            print_line("interrupted before any result; nothing is written")
            raise


def _keep_result(result: DiscoveredModel, folder: Path, profile: Path | None = None) -> None:
    """Write the files and the page of a discovery, and print its verdict."""
    result.write(folder, profile)
    write_discovery_page(folder, result)
    print_verdict(result.verdict)
    print_line(f"{folder}")


class ConsoleOperator(TestOperator):
    """TestOperator at the console: sees the verdicts and is asked before the table moves."""

    def __init__(self, options: DecideOptions) -> None:
        self._asks = options.asks

    def judge(
        self,
        logs: Sequence[PathLike],
        model: PathLike,
        without: Sequence[str],
        held_out: Sequence[PathLike],
        options: DecideOptions,
    ) -> DiscoveredModel:
        return _discover_with_progress(logs, model, without, held_out, options)

    def keep(self, result: DiscoveredModel, folder: Path) -> None:
        _keep_result(result, folder)

    def tell(self, text: str) -> None:
        print_line(text)

    def confirm(self, proposal: TestProposal) -> str:
        """Ask the operator to set up a test and let the table move: "done", "skip" or "quit"."""
        if not self._asks:
            return super().confirm(proposal)
        config = proposal.test.config
        peak = max(config.margins, key=lambda demand: demand.displacement_m)
        level_m_s2 = max(demand.acceleration_m_s2 for demand in config.margins)
        print_line(
            f"TEST: {proposal.test.title}: {config.extent}, {proposal.test.minutes:.2g} min; the "
            f"table moves up to {1e3 * peak.displacement_m:.3g} mm and {level_m_s2:.3g} m/s2"
        )
        print_line(f"SET-UP: {proposal.test.set_up or 'as in the recording'}")
        try:
            reply = console.input("Press Enter to play it, s for the next best test, q to stop: ")
        except (KeyboardInterrupt, EOFError):
            print_line("")
            return "quit"
        return {"q": "quit", "s": "skip"}.get(reply.strip().lower()[:1], "done")


def run_decision(
    logs: Sequence[PathLike],
    model: PathLike,
    out: Path | None,
    without: Sequence[str],
    held_out: Sequence[PathLike],
    options: DecideOptions,
) -> int:
    """Judge, play the proposed test and judge again, until decided; return the exit code."""
    operator = ConsoleOperator(options)
    return decide(logs, model, without, held_out, options, out, operator).code


@contextlib.contextmanager
def _show_progress() -> Iterator[ProgressCallback]:
    """Yield a progress callback: a progress bar on a terminal, plain lines elsewhere."""
    if not console.is_terminal:
        yield (
            lambda progress: (
                print_line(f"  {_format_progress(progress)}")
                if progress.index or not progress.best
                else None
            )
        )
        return
    bar = Progress(
        TextColumn("{task.description}"), BarColumn(bar_width=16), MofNCompleteColumn(),
        TextColumn("[green]{task.fields[best]}"), TimeElapsedColumn(), console=console,
        transient=True,
    )  # fmt: skip
    task = bar.add_task("reading", total=None, best="")

    def show(progress: SelectionProgress) -> None:
        bar.tasks[0].total = None  # update() takes None for no change
        bar.update(
            task, description=escape(" + ".join(progress.names) or progress.stage),
            total=progress.count or None, completed=max(progress.index - 1, 0),
            best=escape(_format_best(progress)),
        )  # fmt: skip

    with bar:
        yield show


def _format_progress(progress: SelectionProgress) -> str:
    if not progress.index:
        return f"fitting {progress.stage}"
    place = f"{progress.index} of {progress.count}"
    return f"fitting {' + '.join(progress.names)} ({place}); {_format_best(progress)}"


def _format_best(progress: SelectionProgress) -> str:
    if progress.best is None:
        return ""
    names = " + ".join(progress.best.names) or "nothing added"
    return f"best so far {names}: {math.sqrt(progress.best.cost):.3g} times the noise"


def print_verdict(verdict: Verdict) -> None:
    """Print the verdict, the misfit, the fitted parameters and the notes."""
    print_line(f"{verdict.verdict}: {format_verdict(verdict)}")
    certainty = (
        "" if verdict.confidence is None else f" (probability {format_share(verdict.confidence)})"
    )
    print_line(f"  {verdict.why}{certainty}")
    misfit = verdict.gap
    columns = " | ".join(
        f"{label} {value:.3g}"
        for label, value in (
            ("as given", misfit.given),
            ("refitted", misfit.held_out_before),
            *([("with the effects", misfit.held_out_after)] if verdict.effects else []),
            ("noise floor", misfit.noise_floor),
        )
    )
    print_line(f"  misfit in multiples of the noise: {columns}")
    for line in describe_proposal(verdict.law) if verdict.law else ():
        print_line(f"  {line}")
    for effect in verdict.effects:
        for name, value in effect.parameters.items():
            print_line(f"  {effect.id} {name} = {format_interval(value)}")
    for effect in verdict.effects:
        for name, value in effect.parameters.items():
            half = verdict.form_errors.get(f"{effect.id}.{name}")
            if half is not None:
                text = format_quantity(value.value, value.unit, half)
                print_line(f"  {effect.id} {name} if its law has another form: {text}")
    for rival in describe_excluded(verdict) if verdict.verdict == "named" else ():
        print_line(f"  excluded: {rival.id}, worse by {rival.sigma:.2g} standard errors")
    for line in describe_sensors(verdict.sensors):
        print_line(f"  {line}")
    for log in verdict.held_out_logs:
        print_line(
            f"  {log.log}, held out entirely: NRMSE of the damper force "
            f"{log.nrmse_before:.3g} -> {log.nrmse_after:.3g} (model as given "
            f"{log.nrmse_given:.3g}, noise {log.noise_floor:.2g})"
        )
    for note in verdict.notes:
        print_line(f"  note: {note}")
    print_line(f"  suggested next test: {verdict.next_run}")


def run_identification(logs: Sequence[PathLike], model: PathLike, out: Path | None) -> int:
    """Identify parameters from recordings; write a model file and a page; return the exit code."""
    target = _resolve_target(out)
    with console.status("reading") as status:
        fitted = identify(logs, model, status.update)
    folder = make_output_folder(target.with_suffix(""), "")
    fitted.save_model(target)
    (folder / "identify.json").write_text(fitted.report.to_json(), encoding="utf-8")
    page = write_identification_page(folder, fitted, target.name)
    print_identification(fitted.report)
    print_line(f"{target}; {page}")
    return 0


def _resolve_target(out: Path | None) -> Path:
    """Return the path of the new model file; raise InputError, before the fit, if not usable."""
    if out is None:
        return make_run_folder(None, "identify")[0] / "model.toml"
    if out.suffix != ".toml":
        raise InputError("not a model file", where=f"--out {out}", allowed="a name in .toml")
    if out.exists():
        raise InputError(
            "exists; files are never overwritten", where=f"--out {out}", remedy="give a new name"
        )
    # checked here and created at the end, so that a failure leaves no folder
    make_output_folder(out.with_suffix(""), "").rmdir()
    return out


def print_identification(report: IdentificationReport) -> None:
    """Print the parameters as tables, then correlations, errors, warnings and notes."""
    table = Table(title="Identified parameters, with 95 % intervals", title_justify="left")
    for heading in ("", "value", "+-", "unit", "start model", "difference in std dev"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, estimate in report.parameters.items():
        table.add_row(
            SYMBOLS.get(name, name), *_format_interval(estimate), estimate.unit,
            "" if estimate.start is None else f"{estimate.start:g}",
            f"{estimate.deviations:+.1f}" if estimate.deviations else "",
        )  # fmt: skip
    for log, gap in report.gaps.items():
        if gap.interval:
            half = gap.interval.half_width
            difference = gap.interval.value - gap.stated if gap.stated is not None else 0.0
            table.add_row(
                f"gap of {log}",
                *_format_interval(gap.interval, 1e3),
                "mm",
                "not stated" if gap.stated is None else f"{1e3 * gap.stated:g}",
                f"{INTERVAL_SIGMA * difference / half:+.1f}" if half and difference else "",
            )
    print_table(console, table)
    _print_subsets(report)
    for pair in report.correlations:
        print_line(f"strongly correlated: {' and '.join(pair.of)}, correlation {pair.value:+.2f}")
    for window in report.windows:
        print_line(
            f"{window.log}: error of u over windows of {window.window_s:g} s, "
            f"{100 * window.nrmse_start:.3g} % of its rms with the start model, "
            f"{100 * window.nrmse_identified:.3g} % as identified, noise "
            f"{100 * window.noise_floor:.2g} %"
        )
    print_line(f"rms residual over the sensor noise: {report.rms_over_noise:.3f}")
    for line in describe_sensors(report.sensors):
        print_line(line)
    for note in report.warnings:
        print_line(f"warning: {note}")
    for note in report.notes:
        print_line(f"note: {note}")


def _print_subsets(report: IdentificationReport) -> None:
    """Print the estimates from subsets of the samples, and the gaps from contact onsets."""
    names = [name for name in report.parameters if name in SYMBOLS]
    gaps = [log for log, name in enumerate(report.logs) if report.gaps[name].interval]
    table = Table(title="Estimates from subsets of the samples", title_justify="left")
    table.add_column("")
    for name in names:
        unit = report.parameters[name].unit
        table.add_column(f"{SYMBOLS[name]} in {unit}", justify="right")
    for log in gaps:
        table.add_column(f"gap correction per side, log {log}, mm", justify="right")
    for subset in report.sources:
        estimates = subset.parameters
        cells = [
            " +- ".join(_format_interval(estimates[name])) if name in estimates else ""
            for name in names
        ]
        cells += [
            " +- ".join(_format_interval(estimates[name], 1e3)) if name in estimates else ""
            for name in map(str, map(GapKey, gaps))
        ]
        table.add_row(subset.source, *cells)
    print_table(console, table)
    for contact in report.contacts:
        print_line(
            f"{contact.log}: {contact.side} gap from {contact.count} {contact.kind}s "
            f"{' +- '.join(_format_interval(contact, 1e3))} mm, "
            f"scatter {1e3 * contact.scatter:.3f} mm, "
            f"corrected by {1e3 * contact.correction:.3f} mm"
        )


def _format_interval(estimate: Interval, scale: float = 1.0) -> tuple[str, str]:
    """Return (value, half interval) as text, with the digits that the interval justifies.

    Without an interval, as of too few cycles, the value has four digits.
    """
    value = scale * estimate.value
    half = scale * (estimate.half_width or 0.0)
    if not half > 0:
        return f"{value:.4g}", "-"
    places = max(0, 1 - math.floor(math.log10(half)))
    return f"{value:.{places}f}", f"{half:.{places}f}"


def run_feature_search(
    features: str, model: str, out: Path | None, without: Sequence[str] = ()
) -> int:
    """Search the effects that explain a features file; write a new folder; return the exit code."""
    folder, _ = make_run_folder(out, "features")
    with (
        catch_interrupts("stopping: the fits so far are kept") as is_stopping,
        make_task_bar() as bar,
    ):
        places = {stage: bar.add_task(stage, visible=False) for stage in ("effects", "pairs")}

        def show(progress: FeatureProgress) -> None:
            if progress.stage:
                place = places[progress.stage]
                bar.update(place, total=progress.count, completed=progress.done, visible=True)
            if progress.text:
                print_line(progress.text)

        result = discover_features(features, model, without, show, is_stopping)
    result.write(folder)
    write_features_page(folder, result)
    print_features(result.verdict)
    print_line(f"{folder}")
    return 0 if result.is_complete else EXIT_INTERRUPTED


def print_features(content: FeatureVerdict) -> None:
    """Print the counts, the ranking, what stays unexplained, the price and the deciding test."""
    count = len(content.features)
    print_line(f"{content.verdict}: {content.why}")
    print_line(f"  model as given: {content.given.explained} of {count} features explained")
    print_line(f"  base refitted: {content.refitted.explained} of {count}")
    for entry in content.fits[:SHOWN_FITS]:
        print_line(f"  {describe_fit(entry, count)}")
    for number in content.unexplained:
        print_line(f"  unexplained: {_describe_entry(content.features[number])}")
    for number in content.best_fit.lost if content.best_fit else ():
        print_line(f"  the price: {_describe_entry(content.features[number])}")
    for note in content.notes:
        print_line(f"  note: {note}")
    print_line(f"  suggested next test: {content.next_run}")


def _describe_entry(entry: FeatureResult) -> str:
    return f"{label_feature(entry)}; predicted: {entry.best.text}"


def require_no_logs(logs: Sequence[Path], held_out: Sequence[Path]) -> None:
    """Raise InputError if logs are given beside a features file."""
    if logs or held_out:
        raise InputError(
            "features take the place of recordings", key="--features",
            remedy="omit LOG and --held-out, or omit --features",
        )  # fmt: skip
