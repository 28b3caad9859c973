"""`replay`, `prc` and `report`: what a recording says."""

from pathlib import Path
from typing import TYPE_CHECKING

from table_io.card import BadInput
from table_io.clock import RealClock
from table_io.records import Comparison
from twin.service import summary as summaries
from twin.service.campaign.state import STATE
from twin.service.folders import new_run
from twin.service.kernels import ready
from twin.service.outcome import EXIT_NOT_IDENTICAL, close
from twin.service.progress import RunProgress
from twin.service.recordings import open_log, recorded_bundle
from twin.service.sweeps import TABLE
from twin.service.terminal import console, say
from twin.stream.wire import Item

if TYPE_CHECKING:
    from twin.service.runs import Identity


def replay(log: Path, model: str | None, out: Path | None, speed: str, view: bool) -> int:
    """The pipeline on a recording; the exit code."""
    from twin.service.runs import replay as play

    recording = open_log(log)
    if "table_acc_m_s2" not in recording.start.channels:
        raise BadInput(
            f"{recording.path}: no table_acc_m_s2, which drives the twin; there: "
            f"{', '.join(recording.start.channels)}; import the table's acceleration too"
        )
    bundle = recorded_bundle(recording, model)
    factor = _factor(speed)
    ready(bundle)
    folder, run = new_run(out, f"{bundle.name}-replay")
    clock = RealClock()
    began = clock.now()
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:

        def watch(item: Item) -> None:
            if factor is not None:
                clock.wait_until(began + item.index / recording.start.rate_hz / factor)
            progress(item)

        identity = play(recording, bundle, folder / "run.mcap", run, watch)
    same_model = bundle.model_toml == recording.start.model_toml
    told = {
        "of": str(recording.path),
        "run": recording.run,
        "model": "recorded" if same_model else model,
        **_told(identity),
        "recorded_comparison": summaries.nrmse(recording.of(Comparison), bundle.parameters),
    }
    code = close(folder, bundle, view, {"replay": told})
    if identity.identical:
        said = f"{identity.compared} comparisons, identical to the bit"
    else:
        said = (
            f"{identity.differing} of {identity.recorded} comparisons differ, "
            f"{identity.missing} missing, {identity.unrecorded} never recorded; see summary.json, "
            "replay"
        )
    say(said)
    return EXIT_NOT_IDENTICAL if same_model and not identity.identical else code


def _told(identity: "Identity") -> summaries.Json:
    """How the comparisons relate, by the keys of the summary."""
    return {
        "identical": identity.identical,
        "comparisons": identity.recorded,
        "compared": identity.compared,
        "differing": identity.differing,
        "missing": identity.missing,
        "unrecorded": identity.unrecorded,
        "first_difference_index": identity.first_difference,
        "largest_difference_of_error_sums": identity.largest,
    }


def _factor(speed: str) -> float | None:
    if speed == "max":
        return None
    try:
        factor = float(speed)
    except ValueError:
        factor = 0.0
    if not 0 < factor < 1e6:
        raise BadInput(f"--speed {speed}: allowed: max, or a number above 0 (times real time)")
    return factor


def prc(log: Path, as_json: bool) -> None:
    """The PRC of a recording, or of every run of a campaign, as a table or as JSON."""
    from twin.service.prc_table import print_prc

    keys = ("run", "u_star_m", "a_star_m_s2", "steps", "jumps", "hysteresis")
    if (log / STATE).is_file():
        from twin.service.campaign.whole import read_whole

        runs = [run.summary for run in read_whole(log).runs]
        if as_json:
            print(summaries.dumps({"runs": [{key: run[key] for key in keys} for run in runs]}))
        for run in runs if not as_json else ():
            print_prc(console, run)
        return
    recording = open_log(log)
    found = summaries.summarise(recording, recorded_bundle(recording).parameters)
    if as_json:
        print(summaries.dumps({key: found[key] for key in keys}))
    else:
        print_prc(console, found)


def report(folder: Path) -> None:
    """Writes DIR/report.html anew, of a run or campaign from what was recorded, of a batch from
    its table."""
    if not folder.is_dir():
        raise BadInput(f"{folder}: no such folder; give the folder of a run or a batch")
    from twin.service.report import write_report
    from twin.service.supervisor import PARTS, gather

    if (folder / PARTS).is_dir():
        gather(folder)
    if (folder / STATE).is_file():
        from twin.service.campaign.report import write_whole

        say(f"{write_whole(folder)}")
        return
    if (folder / TABLE).is_file():
        from twin.service.sweeps.page import write_page

        say(f"{write_page(folder)}")
        return
    recording = open_log(folder)
    if not (folder / "summary.json").exists():
        found = summaries.summarise(recording, recorded_bundle(recording).parameters)
        summaries.write(found, folder / "summary.json")
    say(f"{write_report(folder, recording)}")
