"""`prc` and `report`: what a recording says."""

from pathlib import Path

from table_io.card import BadInput
from twin.service import summary as summaries
from twin.service.campaign.state import STATE
from twin.service.recordings import recorded_bundle, recording_of
from twin.service.sweeps import TABLE
from twin.service.terminal import console, say


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
    recording = recording_of(log)
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
    from twin.service.parts import gather
    from twin.service.report import write_report
    from twin.stream.folder import PARTS

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
    recording = recording_of(folder)
    if not (folder / "summary.json").exists():
        found = summaries.summarise(recording, recorded_bundle(recording).parameters)
        summaries.write(found, folder / "summary.json")
    say(f"{write_report(folder, recording)}")
