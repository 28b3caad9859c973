"""`prc`: the response curves of a recording, or of every run of a campaign."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from table_io.errors import InputError
from twin.campaign import STATE_FILE
from twin.report.prc_table import print_prc
from twin.results.contract import format_json
from twin.results.contracts import RunSummary
from twin.results.recordings import open_recording, read_recorded_config
from twin.results.summary import summarise
from twin.system.terminal import console

CURVE_KEYS = ("run", "u_star_m", "a_star_m_s2", "steps", "jumps", "hysteresis")


@dataclass(frozen=True, eq=False)
class RecordedCurves:
    """Summaries of the runs with curves, one by one; `is_campaign`: of those of a campaign."""

    runs: tuple[RunSummary, ...]
    is_campaign: bool

    def to_plain(self) -> Mapping[str, object]:
        """Return what `prc --json` prints."""
        curves = [{key: run.to_plain()[key] for key in CURVE_KEYS} for run in self.runs]
        return {"runs": curves} if self.is_campaign else curves[0]


def read_curves(log: str | Path) -> RecordedCurves:
    """Return the curves, jumps and hysteresis of a recording, or of every run of a campaign.

    InputError for a recording of a displacement history, which has no curves.
    """
    log = Path(log)
    if (log / STATE_FILE).is_file():
        from twin.campaign.summary import read_campaign  # it draws

        runs = (run.summary for run in read_campaign(log).runs if run.profile.steps)
        return RecordedCurves(tuple(runs), is_campaign=True)
    recording = open_recording(log)
    if not recording.start.steps:
        raise InputError(
            "a test without steps has no curves over frequency",
            where=recording.path,
            allowed="recordings of a stepped sine",
            remedy="see the windows in summary.json, or in report.html by `shaketwin report`",
        )
    summary = summarise(recording, read_recorded_config(recording).parameters)
    return RecordedCurves((summary,), is_campaign=False)


def print_curves(log: Path, as_json: bool) -> None:
    """Print the PRC of a recording, or of every run of a campaign, as a table or JSON."""
    curves = read_curves(log)
    if as_json:
        print(format_json(curves.to_plain()))
        return
    for run in curves.runs:
        print_prc(console, run)
