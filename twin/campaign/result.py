"""Result of a campaign as classes: what is computed, drawn and printed, and its summary.json.

The order of the keys is that of the file.
"""

import math
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PlainSerializer

from twin.campaign.state import OperatorAnswer, RunPart, Status
from twin.results.contract import Acceleration, Contract, Hertz, Metres, Number, Real, RealRatio
from twin.results.contracts import Direction, RunInfo, RunSummary, StepEntry

Place = tuple[Hertz, Direction]
PeakSource = Literal["measured", "twin"]
# Total gap in mm, infinite without bumpers: null in the file.
Gap = Annotated[
    float,
    BeforeValidator(lambda value: math.inf if value is None else value),
    PlainSerializer(lambda gap_mm: gap_mm if math.isfinite(gap_mm) else None),
]


def _list_parts(parts: list[RunPart]) -> list[dict[str, Any]]:
    return [part.model_dump(exclude={"measured"}) for part in parts]


class LabelledRun(RunInfo):
    """Origin of a run of a campaign, that of its last recording."""

    label: str


class Demand(Contract):
    """Demand on the table at a step: the first key of a merged one."""

    demanded_m_s2: Acceleration = None


class MergedStep(StepEntry, Demand):
    """Results of a step, from the last recording that measured it."""

    part: str = Field(description="folder of that recording")


class BranchPiece(Contract):
    """Steps of a branch from one recording."""

    part: str
    from_hz: Hertz
    to_hz: Hertz


class BranchHistory(Contract):
    """Recordings of a branch: whether it was measured without interruption from its beginning."""

    direction: Direction
    history: Literal["whole", "broken", "restarted from rest"]
    broken_at_hz: list[Hertz]
    pieces: list[BranchPiece]


class Peak(Contract):
    """Largest value of a quantity, and where it was measured."""

    value: RealRatio
    frequency_hz: Hertz
    direction: Direction

    @property
    def place(self) -> Place:
        """Frequency in Hz and direction."""
        return self.frequency_hz, self.direction


class MostImpacts(Contract):
    """Mean impacts per cycle at the step with the most."""

    right: float
    left: float
    frequency_hz: Hertz
    direction: Direction


class MergedRun(RunSummary):
    """Results of a run of a campaign, merged from its recordings."""

    run: LabelledRun
    steps: Sequence[MergedStep]
    status: Status
    parts: Annotated[list[RunPart], PlainSerializer(_list_parts)]
    branches: list[BranchHistory]
    level_error: Number = Field(description="largest relative error of the level")
    level_error_hz: Number
    level_error_direction: Direction | None
    level_error_uncorrected: Number
    updates: int = Field(description="largest number of corrections at one step")
    latency_p99_ms: Number
    gap_mm: Gap = math.inf
    peak: dict[str, Peak] = Field({})
    most_impacts: MostImpacts | None = None
    set_up: list[OperatorAnswer] = Field([])

    @property
    def has_dropouts(self) -> bool:
        """Whether samples are missing in its last recording."""
        return bool(self.parts[-1].gaps if self.parts else self.gaps)


class FreeFlight(Contract):
    """u* and a* of a free-flight run: measured and of the twin on its grid, and of the model."""

    run: str
    step_hz: Hertz
    u_star_m: float
    u_star_m_at: Place
    twin_u_star_m: Metres
    twin_u_star_m_at: Place | None
    a_star_m_s2: float
    a_star_m_s2_at: Place
    twin_a_star_m_s2: Acceleration
    twin_a_star_m_s2_at: Place | None
    model_u_star_m: float
    model_a_star_m_s2: float
    model_at_hz: float

    @property
    def stars(self) -> tuple[float, float]:
        """Measured u* in m and a* in m/s2."""
        return self.u_star_m, self.a_star_m_s2


class BestGap(Contract):
    """Best gap by the median over the records, and how clear it is.

    `best_in` counts the records in which it is the best, `margin` is by how much the median of the
    next gap is larger. If the best gap is the smallest one tested, a smaller one may be better.
    """

    gap_mm: Gap
    is_smallest_gap: bool
    median: float
    smallest: float
    largest: float
    best_in: int
    of: int
    next_gap_mm: Gap
    next_median: float
    margin: float | None
    compared_gaps_mm: list[Gap]


class Spread(Contract):
    """Smallest, median and largest over the records, and their number."""

    smallest: Number = None
    median: Number = None
    largest: Number = None
    count: int


class GapSpread(Contract):
    """Spread of each criterion at a gap, by source."""

    gap_mm: Gap
    measured: dict[str, Spread] = Field({})
    twin: dict[str, Spread]

    def select(self, source: PeakSource) -> dict[str, Spread]:
        """Return the spreads of a source."""
        return self.measured if source == "measured" else self.twin


class RecordResponse(Contract):
    """Peaks in SI and criteria of a record at a gap, by source."""

    record: str
    gap_mm: Gap
    measured: dict[str, Real] = Field({})
    twin: dict[str, Real]


class GapResult(Contract):
    """Comparison of gaps over records, see `twin.campaign.gap_comparison`."""

    reference_gap_mm: Gap
    reference: str
    sources: list[PeakSource]
    main_name: str
    records: list[str]
    left_out: list[str]
    gaps_mm: list[Gap]
    criteria: dict[str, str]
    best: dict[PeakSource, dict[str, BestGap | None]]
    gaps: list[GapSpread]
    responses: list[RecordResponse]


class CampaignInfo(Contract):
    """What was planned; the rest is absent for a comparison of gaps by the model alone."""

    title: str
    citation: str
    notes: str
    model: str = Field("", description="titles of the models; absent for a campaign on a table")
    began: str = ""
    resume: str = ""
    normalisation: str = ""


class CampaignSummary(Contract):
    """summary.json of a campaign, on a table or by the model alone."""

    campaign: CampaignInfo
    verdict: str
    reason: str
    u_star_m: Metres = None
    a_star_m_s2: Acceleration = None
    free_flight: FreeFlight | None = None
    gap_comparison: GapResult | None
    runs: list[MergedRun] = Field([])
    warnings: list[str] = Field([], description="of the model alone; absent for a campaign")
