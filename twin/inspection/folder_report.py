"""`report`: the report of a run, campaign, simulated sweeps or map, written again."""

from pathlib import Path

from table_io.errors import InputError
from twin.campaign import STATE_FILE
from twin.recording.merge import merge_run_parts
from twin.recording.run_paths import PARTS_FOLDER
from twin.report.figures import draw_figures
from twin.report.report import load_report_data, write_report
from twin.results.recordings import open_recording, read_recorded_config
from twin.results.summary import summarise
from twin.studies import DEFINITION_FILE, TABLE_FILE
from twin.system.terminal import print_line

FIGURE_FORMATS = ("svg", "pdf", "csv")  # next to PNG


def write_folder_report(
    folder: str | Path,
    as_pdf: bool = False,
    all_formats: bool = False,
    for_customer: bool = False,
) -> tuple[Path, ...]:
    """Rewrite report.html in the folder of a run, campaign, batch or map; return the new pages.

    A run or campaign is reported from its recordings, a batch from its table, a map from its
    arrays. Of a run also report.pdf, each figure in all formats, and the customer's report as a
    page and a PDF, where asked for.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give the folder of a run or a batch")
    if (folder / PARTS_FOLDER).is_dir():
        merge_run_parts(folder)
    if as_pdf or all_formats or for_customer:
        kind = "pdf" if as_pdf else "customer"
        _require_run(folder, f"--format {kind}" if as_pdf or for_customer else "--figures")
    # What draws pictures is slow to import: the report of a run waits for none of it.
    if (folder / STATE_FILE).is_file():
        from twin.campaign.report import write_campaign_report

        return (write_campaign_report(folder),)
    if (folder / TABLE_FILE).is_file():
        from twin.studies.figures import write_study_page

        return (write_study_page(folder),)
    if (folder / DEFINITION_FILE).is_file():
        from twin.studies.maps.page import write_map_page

        return (write_map_page(folder),)
    recording = open_recording(folder)
    if not (folder / "summary.json").exists():
        summary = summarise(recording, read_recorded_config(recording).parameters)
        summary.write(folder / "summary.json")
    pages = [write_report(folder, recording)]
    if all_formats:
        from twin.drawing.pictures import save_figures

        figures = draw_figures(load_report_data(folder, recording))
        save_figures(figures, folder / "figures", more_formats=FIGURE_FORMATS)
    if as_pdf:
        from twin.report.pdf_report import write_pdf_report

        pages.append(folder / "report.pdf")
        write_pdf_report(load_report_data(folder, recording), pages[-1])
    if for_customer:
        from twin.report.customer_report import write_customer_report

        pages += write_customer_report(load_report_data(folder, recording), folder)
    return tuple(pages)


def print_report(folder: Path, output: str, all_formats: bool) -> None:
    """Write the report of a folder again, "html", "pdf" or "customer", and print its pages."""
    pages = write_folder_report(folder, output == "pdf", all_formats, output == "customer")
    for page in pages:
        print_line(f"{page}")


def _require_run(folder: Path, option: str) -> None:
    """Raise InputError if the folder is that of a campaign, batch or map."""
    if any((folder / name).is_file() for name in (STATE_FILE, TABLE_FILE, DEFINITION_FILE)):
        raise InputError(
            "the report of a campaign, batch or map is a page only",
            where=option,
            allowed="the folder of a run",
            remedy="give the folder of one of its runs",
        )
