"""`prc` and `report`: response curves and report of a recording."""

from collections.abc import Mapping
from pathlib import Path

from table_io.errors import InputError
from twin.campaign import STATE_FILE
from twin.results.contract import format_json
from twin.results.contracts import RunSummary
from twin.results.recordings import open_recording, read_recorded_config
from twin.results.summary import summarise
from twin.studies import DEFINITION_FILE, TABLE_FILE
from twin.system.terminal import console, print_line

CURVE_KEYS = ("run", "u_star_m", "a_star_m_s2", "steps", "jumps", "hysteresis")
FIGURE_FORMATS = ("svg", "pdf", "csv")  # next to PNG


def print_recording_prc(log: Path, as_json: bool) -> None:
    """Print the PRC of a recording, or of every run of a campaign, as a table or JSON."""
    from twin.report.prc_table import print_prc

    if (log / STATE_FILE).is_file():
        from twin.campaign.summary import read_campaign

        runs = [run.summary for run in read_campaign(log).runs if run.profile.steps]
        if as_json:
            print(format_json({"runs": [_select_curves(run) for run in runs]}))
        for run in runs if not as_json else ():
            print_prc(console, run)
        return
    recording = open_recording(log)
    if not recording.start.steps:
        raise InputError(
            "a displacement history has no curves over frequency",
            where=recording.path,
            allowed="recordings of a stepped sine",
            remedy="see the windows in summary.json, or in report.html by `shaketwin report`",
        )
    summary = summarise(recording, read_recorded_config(recording).parameters)
    if as_json:
        print(format_json(_select_curves(summary)))
    else:
        print_prc(console, summary)


def _select_curves(summary: RunSummary) -> Mapping[str, object]:
    """Return the part of a summary that is printed as JSON."""
    plain = summary.to_plain()
    return {key: plain[key] for key in CURVE_KEYS}


def write_folder_report(folder: Path, as_pdf: bool = False, all_formats: bool = False) -> None:
    """Rewrite report.html in the folder of a run, campaign, batch or map.

    A run or campaign is reported from its recordings, a batch from its table, a map from its
    arrays. Of a run also report.pdf, and each figure in all formats, where asked for.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of a run or a batch")
    from twin.recording.merge import merge_run_parts
    from twin.recording.run_paths import PARTS_FOLDER
    from twin.report.report import load_report_data, write_report

    if (folder / PARTS_FOLDER).is_dir():
        merge_run_parts(folder)
    if as_pdf or all_formats:
        _require_run(folder, "--format pdf" if as_pdf else "--figures")
    if (folder / STATE_FILE).is_file():
        from twin.campaign.report import write_campaign_report

        print_line(f"{write_campaign_report(folder)}")
        return
    if (folder / TABLE_FILE).is_file():
        from twin.studies.page import write_study_page

        print_line(f"{write_study_page(folder)}")
        return
    if (folder / DEFINITION_FILE).is_file():
        from twin.studies.maps.page import write_map_page

        print_line(f"{write_map_page(folder)}")
        return
    recording = open_recording(folder)
    if not (folder / "summary.json").exists():
        summary = summarise(recording, read_recorded_config(recording).parameters)
        summary.write(folder / "summary.json")
    print_line(f"{write_report(folder, recording, FIGURE_FORMATS if all_formats else ())}")
    if as_pdf:
        from twin.report.pdf_report import write_pdf_report

        path = folder / "report.pdf"
        write_pdf_report(load_report_data(folder, recording), path)
        print_line(f"{path}")


def _require_run(folder: Path, option: str) -> None:
    """Raise InputError if the folder is that of a campaign, batch or map."""
    if any((folder / name).is_file() for name in (STATE_FILE, TABLE_FILE, DEFINITION_FILE)):
        raise InputError(
            "the report of a campaign, batch or map is a page only",
            where=option,
            allowed="the folder of a run",
            remedy="give the folder of one of its runs",
        )
