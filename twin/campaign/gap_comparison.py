"""Comparison of gaps over records: which gap is best by acceleration, displacement and force.

Peaks over the whole record, of the measured motion and of the free-running twin along the measured
motion of the table: total acceleration of the mass, displacement relative to the table, and force
of a bumper, the larger of both sides. eta_a and eta_d are the first two over those of the same
record at the reference, without bumpers; r is the force over the weight of the mass, as in Eq. 1d
of Stefani, De Angelis, Andreaus.
"""

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.excitation.record import RecordedHistory
from table_io.config.profile import Profile
from table_io.units import GRAVITY_M_S2
from twin.campaign.result import BestGap, GapResult, GapSpread, PeakSource, RecordResponse, Spread
from twin.results.contracts import MotionResult, RunSummary
from twin.results.paper_cases import name_gap

SOURCES: tuple[PeakSource, ...] = ("measured", "twin")
PEAKS = ("u_m", "a_m_s2", "force_n")
ETA_A, ETA_D, COMPROMISE, FORCE_RATIO = "eta_a", "eta_d", "compromise", "r"
CRITERIA = {
    ETA_A: "smallest acceleration of the mass",
    ETA_D: "smallest displacement of the bearing",
    COMPROMISE: "best compromise of both",
    FORCE_RATIO: "smallest force of a bumper",
}


@dataclass(frozen=True, slots=True)
class RecordRun:
    """One complete run of a record: name of the record, gap, mass and merged summary.

    Runs of equal `motion` are repetitions.
    """

    motion: str
    record: str
    gap_mm: float
    mass_kg: float
    label: str
    summary: RunSummary

    @property
    def has_dropouts(self) -> bool:
        """Whether samples are missing in its last recording, which holds the whole record."""
        return self.summary.has_dropouts


@dataclass(frozen=True, slots=True, eq=False)
class GapComparison:
    """Responses to every record at every gap, the widest gap first.

    `values` holds (record, gap) by source and quantity: PEAKS in SI, and the CRITERIA. The
    compromise is the root mean square of eta_a and eta_d: 1 is no better than the reference. NaN
    where there is no complete run, and for the force without bumpers. Of a simulation the twin is
    the only source. `left_out` are the labels of complete runs with dropouts.
    """

    records: tuple[str, ...]
    gaps_mm: tuple[float, ...]
    values: Mapping[tuple[str, str], Float2D]
    sources: tuple[PeakSource, ...] = SOURCES
    left_out: tuple[str, ...] = ()

    @property
    def main_source(self) -> PeakSource:
        """Source by which the gaps are judged first."""
        return self.sources[0]

    @property
    def main_name(self) -> str:
        """The main source in words."""
        return "measured" if self.main_source == "measured" else "model"

    @property
    def reference_mm(self) -> float:
        """Gap at which eta_a and eta_d are 1: the widest, or none at all."""
        return self.gaps_mm[0]

    @property
    def reference(self) -> str:
        """The reference in words."""
        if math.isinf(self.reference_mm):
            return "without bumpers"
        return f"at {format_gap(self.reference_mm)}"


def format_gap(gap_mm: float) -> str:
    """Return the name of a gap as it is printed in the paper: G16, G−1, G∞."""
    return name_gap(gap_mm).replace("-", "−")


def list_record_runs(
    runs: Sequence[tuple[str, Profile, RunSummary]], names: Mapping[str, str]
) -> list[RecordRun]:
    """Return the complete runs of records of (label, profile, summary).

    `names` are those of the records by the label of a run; else the name of the file counts.
    Different motions of one name have the scale added, and the label of a run if that is equal too.
    """
    listed: dict[str, list[tuple[str, Profile, RunSummary]]] = {}
    for label, profile, summary in runs:
        if isinstance(profile.excitation, RecordedHistory) and summary.verdict == "complete":
            listed.setdefault(_identify(profile.excitation), []).append((label, profile, summary))
    record_names = _name_records(listed, names)
    return [
        RecordRun(
            key,
            record_names[key],
            profile.specimen.gap_mm,
            profile.specimen.mass_kg,
            label,
            summary,
        )
        for key, several in listed.items()
        for label, profile, summary in several
    ]


def _identify(excitation: RecordedHistory) -> str:
    """Return a text that two runs share if they play the same motion."""
    keys = excitation.model_dump(exclude={"files", "windows", "drive", "file", "sha256"})
    return json.dumps([excitation.checksum, keys], sort_keys=True)


def _name_records(
    listed: Mapping[str, list[tuple[str, Profile, RunSummary]]], names: Mapping[str, str]
) -> dict[str, str]:
    """Return a different name for each motion, by its key, of the runs that play it."""
    record_names, scales, labels = {}, {}, {}
    for key, several in listed.items():
        labels[key], profile, _ = several[0]
        excitation = profile.excitation
        assert isinstance(excitation, RecordedHistory)
        scales[key] = f"{excitation.scale:g}"
        stated = [names[label] for label, _, _ in several if label in names]
        record_names[key] = stated[0] if stated else Path(excitation.file).stem
    for additions, pattern in ((scales, "{} × {}"), (labels, "{} ({})")):
        counts = Counter(record_names.values())
        record_names = {
            key: pattern.format(name, additions[key]) if counts[name] > 1 else name
            for key, name in record_names.items()
        }
    return record_names


def compare_gaps(
    runs: Sequence[RecordRun], sources: tuple[PeakSource, ...] = SOURCES
) -> GapComparison | None:
    """Return the comparison; None unless a record was played at two gaps, one the reference.

    A record without a run at the reference, the widest gap, is left out, and so is a run with
    dropouts, which may hide a peak. Several runs of one record at one gap count with their mean.
    """
    left_out = tuple(run.label for run in runs if run.has_dropouts)
    runs = [run for run in runs if not run.has_dropouts]
    gaps_mm = tuple(sorted({run.gap_mm for run in runs}, reverse=True))
    if len(gaps_mm) < 2:
        return None
    at_reference = {run.motion for run in runs if run.gap_mm == gaps_mm[0]}
    records = {run.motion: run.record for run in runs if run.motion in at_reference}
    if not any(run.motion in at_reference and run.gap_mm != gaps_mm[0] for run in runs):
        return None
    values: dict[tuple[str, str], Float2D] = {}
    for source in sources:
        peaks = np.full((len(PEAKS) + 1, len(records), len(gaps_mm)), np.nan)
        for row, motion in enumerate(records):
            for column, gap_mm in enumerate(gaps_mm):
                rows = [
                    find_record_peaks(run, source)
                    for run in runs
                    if (run.motion, run.gap_mm) == (motion, gap_mm)
                ]
                if rows:
                    peaks[:, row, column] = np.mean(rows, axis=0)
        u, a, force, r = peaks
        eta_d, eta_a = u / u[:, :1], a / a[:, :1]
        compromise = np.sqrt((eta_d**2 + eta_a**2) / 2.0)
        quantities = (*PEAKS, FORCE_RATIO, ETA_D, ETA_A, COMPROMISE)
        for name, table in zip(quantities, (u, a, force, r, eta_d, eta_a, compromise), strict=True):
            values[source, name] = table
    return GapComparison(tuple(records.values()), gaps_mm, values, sources, left_out)


def find_record_peaks(run: RecordRun, source: PeakSource) -> tuple[float, float, float, float]:
    """Return the peaks (u in m, a in m/s2, force in N, force over weight) of a run over its record.

    NaN for what is missing, and for the force without bumpers.
    """
    windows = run.summary.windows or []
    motions = [
        (window.measured if source == "measured" else window.twin) or MotionResult()
        for window in windows
    ]

    def find_largest(*names: str) -> float:
        peaks = [getattr(motion, name).peak for motion in motions for name in names]
        known = [peak for peak in peaks if peak is not None]
        return float(max(known)) if known and len(known) == len(peaks) else math.nan

    force = math.nan if math.isinf(run.gap_mm) else find_largest("force_r", "force_l")
    weight = run.mass_kg * GRAVITY_M_S2
    return find_largest("u"), find_largest("a"), force, force / weight


def rank_gaps(comparison: GapComparison, source: PeakSource, criterion: str) -> BestGap | None:
    """Return the best gap by the median over the records, and how clear it is.

    Gaps at which a record is missing are left out; None with fewer than two.
    """
    table = comparison.values[source, criterion]
    complete = np.flatnonzero(np.isfinite(table).all(axis=0))
    if complete.size < 2:
        return None
    ranked = table[:, complete]
    medians = np.median(ranked, axis=0)
    best, following = np.argsort(medians, kind="stable")[:2]
    best_in = int(np.count_nonzero(np.argmin(ranked, axis=1) == best))
    return BestGap(
        gap_mm=comparison.gaps_mm[complete[best]],
        is_smallest_gap=bool(complete[best] == len(comparison.gaps_mm) - 1),
        median=float(medians[best]),
        smallest=float(ranked[:, best].min()),
        largest=float(ranked[:, best].max()),
        best_in=best_in,
        of=len(comparison.records),
        next_gap_mm=comparison.gaps_mm[complete[following]],
        next_median=float(medians[following]),
        margin=float(medians[following] / medians[best] - 1.0) if medians[best] > 0 else None,
        compared_gaps_mm=[comparison.gaps_mm[column] for column in complete],
    )


def describe_comparison(comparison: GapComparison) -> GapResult:
    """Return the comparison as it is printed, shown and written."""
    quantities = (*PEAKS, *CRITERIA)
    return GapResult(
        reference_gap_mm=comparison.reference_mm,
        reference=comparison.reference,
        sources=list(comparison.sources),
        main_name=comparison.main_name,
        records=list(comparison.records),
        left_out=list(comparison.left_out),
        gaps_mm=list(comparison.gaps_mm),
        criteria=CRITERIA,
        best={
            source: {name: rank_gaps(comparison, source, name) for name in CRITERIA}
            for source in comparison.sources
        },
        gaps=[
            GapSpread(
                gap_mm=gap_mm,
                **{
                    source: {
                        name: _find_spread(comparison.values[source, name][:, column])
                        for name in CRITERIA
                    }
                    for source in comparison.sources
                },
            )
            for column, gap_mm in enumerate(comparison.gaps_mm)
        ],
        responses=[
            RecordResponse(
                record=record,
                gap_mm=gap_mm,
                **{
                    source: {
                        name: float(comparison.values[source, name][row, column])
                        for name in quantities
                    }
                    for source in comparison.sources
                },
            )
            for column, gap_mm in enumerate(comparison.gaps_mm)
            for row, record in enumerate(comparison.records)
        ],
    )


def _find_spread(values: Float1D) -> Spread:
    """Return smallest, median and largest over the records of (record,), and their number."""
    known = values[np.isfinite(values)]
    if not known.size:
        return Spread(smallest=None, median=None, largest=None, count=0)
    return Spread(
        smallest=float(known.min()),
        median=float(np.median(known)),
        largest=float(known.max()),
        count=int(known.size),
    )


def format_best(best: BestGap | None) -> str:
    """Format the best gap with how clear it is."""
    if best is None:
        return "not ranked: fewer than two gaps with every record"
    edge = ", the smallest gap tested" if best.is_smallest_gap else ""
    margin = "" if best.margin is None else f" (+{100 * best.margin:.0f} %)"
    return (
        f"{format_gap(best.gap_mm)}{edge}: {best.median:.2f}, best in {best.best_in} of {best.of} "
        f"records; next {format_gap(best.next_gap_mm)}: {best.next_median:.2f}{margin}"
    )
