"""Result of a run as classes: what is computed, drawn and printed, and the content of summary.json.

Each key, its meaning and its unit is written here only; the order is that of the file. A key with a
default may be absent in the file of an older version.
"""

import math
from collections.abc import Sequence
from typing import Literal

from pydantic import Field

from twin.results.contract import (
    SI,
    Acceleration,
    Contract,
    Hertz,
    Index,
    Metres,
    Milliseconds,
    Number,
    Ratio,
    RealAcceleration,
    RealDegrees,
    RealHertz,
    RealMetres,
    RealRatio,
    RealSeconds,
    RealSI,
    Seconds,
)

Direction = Literal["forward", "backward"]
Phase = Literal["flight", "contact_right", "contact_left", ""]
TwinAgreement = Literal["agrees", "departs", "not judged"]
NOTHING_MEASURED = "nothing was measured that the twin predicts"  # reason of a verdict


class RunInfo(Contract):
    """Origin and length of a recording."""

    id: str = Field("", description="unique name of the run")
    name: str = Field("", description="name of its profile")
    title: str = Field("", description="title in the profile")
    source: str = Field("", description="origin of the measured samples: table or model")
    started_at: str = Field("", description="local time, ISO 8601")
    host: str = Field("", description="computer that recorded it")
    rate_hz: RealHertz = Field(math.nan, description="sampling rate")
    samples: Index = Field(0, description="length in samples")
    duration_s: RealSeconds = Field(math.nan, description="length in time")
    gap_m: Metres = Field(None, description="nominal total gap; null without bumpers")
    model: str | None = Field(None, description="title of the twin's model")
    normalisation: str = Field("", description="how u* and a* are found")
    branches_from: str = Field(
        "measured", description="source of `jumps` and `hysteresis`: measured or twin"
    )


class Response(Contract):
    """Normalized response at a step: mean over the measured cycles of the ratio of each cycle.

    Eq. 1 of Stefani et al. takes one largest and one smallest value of the steady motion, which is
    the same where every cycle is alike and more where they differ.
    """

    eta_d: RealRatio = Field(math.nan, description="half range of u over u*")
    eta_a: RealRatio = Field(
        math.nan, description="half range of the total acceleration of the mass over a*"
    )
    eta_r: RealRatio = Field(math.nan, description="deformation of the right bumper over u*")
    eta_l: RealRatio = Field(math.nan, description="deformation of the left bumper over u*")
    r_r: RealRatio = Field(
        math.nan, description="force of the right bumper over the weight of the mass"
    )
    r_l: RealRatio = Field(
        math.nan, description="force of the left bumper over the weight of the mass"
    )
    impacts_right: list[int] = Field([], description="impacts on the right bumper in each cycle")
    impacts_left: list[int] = Field([], description="impacts on the left bumper in each cycle")
    drift: RealRatio = Field(
        math.nan, description="change of eta_d over the measured cycles, of its mean"
    )
    spread: RealRatio = Field(
        math.nan, description="range of eta_d over the measured cycles, of its mean"
    )
    spread_a: RealRatio = Field(
        math.nan, description="range of eta_a over the measured cycles, of its mean"
    )


class LevelResult(Contract):
    """Amplitude control at a step."""

    demanded_m_s2: RealAcceleration = Field(description="demanded fundamental of the table")
    error: RealRatio = Field(description="relative error of the measured fundamental")
    error_uncorrected: RealRatio = Field(description="the same without the correction")
    correction: RealRatio = Field(description="factor on the command")
    updates: int = Field(description="changes of the correction at this step")
    accepted: bool = Field(description="whether the correction was frozen for the measured cycles")


class StepMisfit(Contract):
    """Error of the restarted twin in a channel at a step: of the median of its held cycles."""

    error: RealSI = Field(description="rms of measured minus twin")
    band: RealSI = Field(description="tolerance, see `TwinVerdict.tolerance`")
    misfit: Ratio = Field(description="error over the noise at rest; null if that is unknown")
    phase: Phase = Field(description="phase with the largest error; empty if unknown")

    @property
    def share(self) -> float:
        """Error over band: beyond 1 it is outside the tolerance."""
        return self.error / self.band


class StepBranch(Contract):
    """Whether the free-running twin is on the branch of the specimen at a step."""

    is_same: bool = Field(description="eta_d and phase are those of the specimen")
    share: RealRatio = Field(description="difference of eta_d over its tolerance")
    free_error: Ratio = Field(description="rms error of u over the rms of u; null if unknown")


class StepEntry(Contract):
    """Results of a step."""

    index: int = Field(description="number of the step in the test, from 0")
    direction: Direction = Field(description="direction of the sweep")
    frequency_hz: Hertz = Field(description="frequency of the step")
    measured: Response | None = Field(None, description="null without a measurement")
    twin: Response | None = Field(None, description="null without a twin")
    table_acc_peak_m_s2: RealAcceleration = Field(
        math.nan, description="peak of the table acceleration"
    )
    table_acc_fundamental_m_s2: RealAcceleration = Field(
        math.nan, description="its fundamental amplitude"
    )
    thd: RealRatio = Field(math.nan, description="its total harmonic distortion")
    demanded_m_s2: RealAcceleration = Field(
        math.nan, description="demanded fundamental of the table"
    )
    agreement: dict[str, StepMisfit] = Field(
        {}, description="of the restarted twin by channel; absent without a comparison"
    )
    branch: StepBranch | None = Field(
        None, description="of the free-running twin; absent without a comparison"
    )
    level: LevelResult | None = Field(None, description="absent without amplitude control")
    reason: str = Field("", description="why an adaptive policy added it; absent for others")


class Jump(Contract):
    """Jump of one direction between two neighbouring grid frequencies."""

    direction: Direction = Field(description="direction of the sweep")
    from_hz: Hertz = Field(description="frequency before the jump, in driving order")
    to_hz: Hertz = Field(description="frequency after the jump")
    kind: Literal["up", "down"] = Field(
        description="change of eta_d, or of eta_a if that tells the solutions apart more clearly"
    )


class WorstMisfit(Contract):
    """Step and channel with the largest error over band; without a step of a whole history."""

    step: int | None = Field(None, description="number of the step")
    direction: Direction | None = Field(None, description="its direction")
    frequency_hz: Number = Field(
        None, description="its frequency", json_schema_extra={"unit": "Hz"}
    )
    channel: str = Field(description="channel that departs most")
    share: RealRatio = Field(description="error over band; beyond 1 it is outside the tolerance")
    error: SI = Field(None, description="rms of measured minus twin; null for a whole history")
    band: SI = Field(None, description="tolerance; null for a whole history")
    misfit: Ratio = Field(description="error over the noise at rest; null if that is unknown")
    phase: Phase = Field("", description="phase with the largest error; empty if unknown")


class WorstBranch(Contract):
    """Step at which the responses of specimen and free twin differ most."""

    step: int = Field(description="number of the step")
    direction: Direction = Field(description="its direction")
    frequency_hz: Hertz = Field(description="its frequency")
    measured: RealRatio = Field(description="eta_d of the specimen")
    twin: RealRatio = Field(description="eta_d of the twin")
    free_error: Ratio = Field(description="rms error of u over the rms of u; null if unknown")

    @property
    def departure(self) -> float:
        """How far the two eta_d are apart, as a ratio of at least 1."""
        low, high = sorted((self.measured, self.twin))
        return high / low if low > 0 else math.inf


class ExcitationVerdict(Contract):
    """Verdict on what the table played; see `twin.results.excitation_verdict`."""

    verdict: Literal["reached", "missed", "not judged"] = Field(
        description="whether the table played the level of the steps, or the record"
    )
    reason: str = Field(description="what decided it")
    outside: int = Field(description="steps, or demands on a record, that were missed")
    worst_error: Ratio = Field(
        description="relative error of the level at the worst step, or rms error of a record"
    )


class TwinVerdict(Contract):
    """Verdict on the twin, apart from that on the test; see `twin.results.twin_verdict`."""

    verdict: TwinAgreement = Field(
        description="whether the twin is within its tolerance and jumps where the rig does"
    )
    reason: str = Field(description="what decided it")
    tolerance: str = Field(description="definition of the band")
    worst: WorstMisfit | None = Field(description="null if nothing could be judged")
    worst_branch: WorstBranch | None = Field(
        None, description="null if the free twin is on the branch of the specimen everywhere"
    )
    steps_outside: int = Field(description="steps with u or a outside the band")
    steps_apart: int = Field(0, description="steps with the free twin on another branch")
    steps_judged: int = Field(description="steps with a band")
    misfit: Ratio = Field(description="of u in multiples of the noise: median over the steps")
    misfit_worst: Ratio = Field(None, description="the same at the worst step")
    missing_jumps: list[Jump] = Field(description="jumps of the twin that the rig does not show")
    unexpected_jumps: list[Jump] = Field(description="jumps of the rig that the twin lacks")
    warnings: int = Field(description="warnings of the condition monitoring")
    next_command: str = Field(description="command to type next; DIR is the folder of the run")


class HysteresisInterval(Contract):
    """Interval of at least two grid frequencies at which the directions differ.

    They differ in eta_d, eta_a or in these and the impact counts, beyond the scatter over cycles.
    """

    kind: Literal["right", "left"] = Field(description="right: the forward branch is larger")
    from_hz: Hertz = Field(description="first grid frequency at which the directions differ")
    to_hz: Hertz = Field(description="last grid frequency at which the directions differ")


class FaultEntry(Contract):
    """Failure of a component."""

    index: Index = Field(description="when it was recorded")
    component: str = Field(description="process that failed")
    from_index: Index = Field(description="first sample without its output")
    to_index: Index = Field(description="first sample with its output again")
    reason: str = Field(description="cause")


class CheckEntry(Contract):
    """Result line of the loop check."""

    index: Index = Field(description="when it was checked")
    name: str = Field(description="name of the check")
    channel: str = Field(description="channel that was checked")
    value: Number = Field(description="measured value, in `unit`")
    low: Number = Field(description="lowest allowed value, in `unit`")
    high: Number = Field(description="highest allowed value, in `unit`")
    unit: str = Field(description="unit of the three numbers")
    passed: bool = Field(description="whether the value is allowed")


class TripEntry(Contract):
    """Trip of the protection."""

    index: Index = Field(description="sample that tripped")
    decided: Index = Field(description="sample up to which the session had read")
    kind: str = Field(description="stroke, velocity, acceleration, force, lost, stuck, level, ...")
    channel: str = Field(description="channel that tripped")
    value: SI = Field(description="value that tripped")
    limit: SI = Field(description="limit that it exceeded")
    text: str = Field(description="message to the user")


class PeakAndRms(Contract):
    """Peak and rms over a window; null without known samples."""

    peak: SI = Field(None, description="largest magnitude")
    rms: SI = Field(None, description="root mean square")


class MotionResult(Contract):
    """Motion and contact of the specimen over a window."""

    u: PeakAndRms = Field(PeakAndRms(), description="relative displacement in m")
    a: PeakAndRms = Field(PeakAndRms(), description="total acceleration of the mass in m/s2")
    force_r: PeakAndRms = Field(PeakAndRms(), description="force of the right bumper in N")
    force_l: PeakAndRms = Field(PeakAndRms(), description="force of the left bumper in N")
    impacts_right: int | None = Field(None, description="contacts that begin on the right")
    impacts_left: int | None = Field(None, description="contacts that begin on the left")


class ChannelError(Contract):
    """Errors of the twin in a channel; null where there is nothing to compare."""

    nrmse: Ratio = Field(None, description="of the twin restarted from the measured state")
    free_nrmse: Ratio = Field(None, description="of the free-running twin")
    noise_floor: Ratio = Field(None, description="what the noise of the sensors alone would leave")

    @property
    def noise_multiple(self) -> float | None:
        """Error of the restarted twin in multiples of the noise; None if either is unknown."""
        return (
            self.nrmse / self.noise_floor if self.nrmse is not None and self.noise_floor else None
        )


class WindowResult(Contract):
    """Results of a window of a displacement history."""

    index: int = Field(description="number of the window")
    from_s: Seconds = Field(description="begin")
    to_s: Seconds = Field(description="end")
    table_disp: PeakAndRms = Field(PeakAndRms(), description="table displacement in m")
    table_acc: PeakAndRms = Field(PeakAndRms(), description="table acceleration in m/s2")
    measured: MotionResult | None = Field(None, description="null without a measurement")
    twin: MotionResult | None = Field(None, description="null without a twin")
    comparison: dict[str, ChannelError] = Field({}, description="errors of the twin by channel")


class SpectrumRatios(Contract):
    """Spectrum of the table over that asked for: the amplitude of each line of a multisine."""

    lower: Ratio = Field(description="least allowed ratio")
    upper: Ratio = Field(description="largest allowed ratio; null without a limit")
    count: int = Field(description="frequencies that were checked")
    outside: int | None = Field(description="ratios outside; null if samples are lost")
    lowest_ratio: Ratio = Field(description="smallest ratio")
    lowest_hz: Number = Field(description="its frequency", json_schema_extra={"unit": "Hz"})
    highest_ratio: Ratio = Field(description="largest ratio")
    highest_hz: Number = Field(description="its frequency", json_schema_extra={"unit": "Hz"})


class RequiredSpectrumResult(SpectrumRatios):
    """Test response spectrum (TRS) of the table over the required one (RRS), at 1/6 octave."""

    passed: bool = Field(description="whether every ordinate is allowed")


class TrackingError(Contract):
    """Motion of the table against its target; a perfect table has errors 0 and ratios 1.

    See `twin.results.tracking`; the criteria are those of Chen et al. (2018). The lag, positive if
    the table is late, is taken out first. Null is what cannot be had: without a displacement, and
    in the band, of spectra and of energy if samples are lost.
    """

    band_hz: tuple[Hertz, Hertz] = Field(
        description="band of interest, as in the profile or from the energy of the target"
    )
    damping: RealRatio = Field(description="ratio, of the response spectra")
    lag_s: RealSeconds = Field(description="of the table behind its target")
    acc_rms_error_band: RealRatio = Field(
        description="rms error of the acceleration in the band, of the rms of the target there"
    )
    acc_rms_error_full: RealRatio = Field(description="the same at all frequencies")
    pga_ratio_band: RealRatio = Field(
        description="peak acceleration in the band, achieved over target"
    )
    pga_ratio_full: RealRatio = Field(description="the same at all frequencies")
    sa_share: RealRatio = Field(
        description="share of the ordinates of the 1/6-octave response spectrum in the band that "
        "are within 10 % of the target"
    )
    sa_count: int = Field(description="ordinates of it")
    sa_worst_ratio: RealRatio = Field(description="ordinate farthest from the target, over it")
    sa_worst_hz: RealHertz = Field(description="its frequency")
    sa_fine_share: RealRatio = Field(description="as `sa_share`, at 1/72 octave")
    arias_ratio: RealRatio = Field(description="Arias intensity, achieved over target")
    cav_ratio: RealRatio = Field(description="cumulative absolute velocity, achieved over target")
    disp_rms_error_band: RealRatio = Field(
        description="rms error of the displacement in the band, of the rms of the target there"
    )
    disp_rms_error_full: RealRatio = Field(description="the same at all frequencies")
    lost_samples: Index = Field(description="samples of the acceleration that are missing")


class TrackingResult(TrackingError):
    """Motion of the table against the displacement history that it should follow."""

    acc_rms_error_record: RealRatio = Field(
        math.nan,
        description="as `acc_rms_error_band`, against the record itself, before the band filter of "
        "the profile; null of a history that is no acceleration record",
    )
    from_s: Seconds = Field(description="begin of the history")
    to_s: Seconds = Field(description="end of the part that was played")
    required_spectrum: RequiredSpectrumResult | None = Field(
        description="null without one in the profile"
    )
    lines: SpectrumRatios | None = Field(
        None, description="of a random motion and a multisine, which have no peak to reach"
    )


class BestLinearResult(Contract):
    """Best linear approximation of one pair of accelerations, by line of a periodic multisine.

    See `twin.results.best_linear`. Ratios are rms over that of the output on the excited lines.
    """

    input: str = Field(description="command, or a channel")
    output: str = Field(description="channel")
    band_hz: tuple[Hertz, Hertz] | None = Field(
        description="in which at most half of the power of a period is noise: nothing can be "
        "promised of the output beyond it; null: nowhere"
    )
    distortion_ratio: RealRatio = Field(description="nonlinear distortion on the excited lines")
    noise_ratio: RealRatio = Field(description="noise on the excited lines, of one period")
    even_ratio: Ratio = Field(description="distortion on even lines; null: they are excited")
    odd_ratio: Ratio = Field(description="distortion on odd lines that were left out; null: none")
    frequency_hz: list[RealHertz] = Field(description="excited lines")
    gain: list[RealRatio] = Field(description="of the approximation")
    phase_deg: list[RealDegrees] = Field(description="of the approximation")
    half_width: list[RealRatio] = Field(description="radius of the circle of 95 % about it")
    level_m_s2: list[RealAcceleration] = Field(description="amplitude of the output")
    distortion_m_s2: list[RealAcceleration] = Field(description="nonlinear distortion in it")
    noise_m_s2: list[RealAcceleration] = Field(description="noise in it, of one period")


class SweptPoint(Contract):
    """Level of a swept sine over a few cycles; all levels are fundamentals."""

    sweep: int = Field(description="pass, or after the last one dwell")
    direction: Literal["forward", "backward", "dwell"] = Field(description="of the frequency")
    at_s: Seconds = Field(description="end of the cycles")
    frequency_hz: Hertz = Field(description="in their middle")
    reference_m_s2: RealAcceleration = Field(description="level of the profile")
    demanded_m_s2: RealAcceleration = Field(description="what limits leave of it")
    achieved_m_s2: RealAcceleration = Field(description="by the control channels")
    limited_by: str = Field(description="channel whose limit reduces the level; empty: none")
    predicted_m_s2: RealAcceleration = Field(
        math.nan, description="level by the twin before the run; null without a notch"
    )


class ResonanceEntry(Contract):
    """Peak of the ratio of the response channel to the level in a pass."""

    sweep: int = Field(description="pass")
    direction: Direction = Field(description="of the frequency")
    frequency_hz: Hertz = Field(description="of the peak")
    amplification: RealRatio = Field(description="fundamental of the response over the level")


def select_judged_points(points: list[SweptPoint]) -> list[SweptPoint]:
    """Return the points where the level is judged: at the first frequency it is still being set."""
    return [point for point in points if point.frequency_hz != points[0].frequency_hz]


class SweptSineResult(Contract):
    """Swept sine: the level against its tolerance over frequency, and what was found."""

    octaves_per_min: RealRatio = Field(description="sweep rate")
    control_channels: list[str] = Field(description="channels on which the level is measured")
    strategy: str = Field(description="of several control channels: average or maximum")
    tolerance: RealRatio = Field(description="of the demanded level, on either side")
    abort_db: RealSI = Field(description="deviation at which the table stops")
    passes: int = Field(description="passes that were played to their end")
    planned_passes: int = Field(description="passes of the profile")
    inside: RealRatio = Field(description="share of the time within the tolerance")
    highest_ratio: RealRatio = Field(description="achieved over demanded, largest")
    highest_hz: RealHertz = Field(description="frequency of it")
    lowest_ratio: RealRatio = Field(description="achieved over demanded, smallest")
    lowest_hz: RealHertz = Field(description="frequency of it")
    notched: RealRatio = Field(description="share of the time with a reduced level")
    response_channel: str = Field(description="channel that shows the resonances")
    resonances: list[ResonanceEntry] = Field(description="of each pass, largest first")
    points: list[SweptPoint] = Field(description="in order of time")


class PlannedOrbitEntry(Contract):
    """Orbit of the twin at a planned point."""

    frequency_hz: Hertz = Field(description="its frequency")
    amplitude_m: RealMetres = Field(description="half of max u - min u")
    multiplier: RealRatio = Field(description="magnitude of its largest Floquet multiplier")


class OrbitResult(Contract):
    """Periodic orbit that a continuation held by feedback."""

    index: int = Field(description="planned point")
    frequency_hz: Hertz = Field(description="frequency")
    acceleration_m_s2: RealAcceleration = Field(description="fundamental of the table, measured")
    amplitude_m: RealMetres = Field(description="half of max u - min u")
    fundamental_m: RealMetres = Field(description="fundamental of u")
    phase_deg: RealDegrees = Field(description="its lead over that of the table's acceleration")
    feedback_m: RealMetres = Field(description="root of the sum of squares of its harmonics")
    feedback_share: RealRatio = Field(description="the same over the amplitude of the command")
    feedback_harmonics_m: list[RealMetres] = Field(description="amplitudes of harmonics 0, 1, ...")
    noise_m: RealMetres = Field(description="standard error of `feedback_m`, by scatter of cycles")
    periods: int = Field(description="since the change of point")
    updates: int = Field(description="changes of the reference")
    accepted: bool = Field(description="the feedback has vanished, on the sought branch")
    reason: str = Field(description="why it is not accepted; empty if it is")
    stable: bool = Field(description="without feedback, by the plan")
    multiplier: RealRatio = Field(description="measured Floquet multiplier; null if it was not")
    multiplier_sd: Ratio | None = Field(description="its standard deviation; null without one")
    planned: PlannedOrbitEntry = Field(description="orbit of the twin")


class MeasuredFold(Contract):
    """Fold between measured stable and unstable orbits, by a parabola through the nearest."""

    kind: Literal["lower", "upper"] = Field(description="whether the branch turns up or down there")
    frequency_hz: Hertz = Field(description="where the branch turns")
    amplitude_m: RealMetres = Field(description="half of max u - min u there")
    orbits: int = Field(description="measured orbits that the parabola is fitted to")


class Latency(Contract):
    """Latency of the twin: scheduled last sample of a block to its published Comparison."""

    p50: Milliseconds = Field(None, description="median")
    p99: Milliseconds = Field(None, description="99th percentile")
    max: Milliseconds = Field(None, description="largest")


class ComponentTiming(Contract):
    """Latency of a component of the run."""

    index: Index = Field(description="when it was recorded")
    p50_ms: Milliseconds = Field(description="median latency")
    p99_ms: Milliseconds = Field(description="99th percentile of the latency")
    max_ms: Milliseconds = Field(description="largest latency")
    missed: int = Field(description="missed deadlines")
    blocks: int = Field(description="blocks processed")
    cpu_share: Ratio = Field(description="share of one core")
    scheduler: str = Field(description="scheduling policy")


class TimingResult(Contract):
    """Timing of a run; null where nothing was timed."""

    latency_ms: Latency = Field(Latency(), description="latency of the twin")
    missed_deadlines: int | None = Field(None, description="of all components")
    components: dict[str, ComponentTiming] = Field({}, description="timing of each component")


class ParameterEstimate(Contract):
    """Last estimate of a parameter by the condition monitoring, SI."""

    value: RealSI = Field(description="estimate")
    sd: RealSI = Field(description="its standard deviation")
    drift: RealSI = Field(description="change since the first estimate")
    drift_sd: RealSI = Field(description="standard deviation of the drift")


class WarningEntry(Contract):
    """Warning of the condition monitoring, or alarm."""

    at_s: Seconds = Field(description="time in the test")
    kind: str = Field(description="kind of the event")
    text: str = Field(description="message to the user")
    is_clipped: bool = Field(
        False, description="a sensor of the motion was off its range in the step that it is about"
    )


class VersionPair(Contract):
    """Versions of a package."""

    recorded: str | None = Field(description="in the recording")
    installed: str | None = Field(description="here")


class ReplayResult(Contract):
    """Comparison of a replay with its recording."""

    of: str = Field(description="path of the recording")
    run: str = Field(description="its name")
    model: str | None = Field(description="model of the replay, or `recorded`")
    identical: bool | None = Field(description="null if it cannot be judged")
    beginning: str | None = Field(description="run with the earlier samples")
    comparisons: int = Field(description="comparisons in the recording")
    compared: int = Field(description="comparisons of both")
    differing: int = Field(description="comparisons that differ")
    missing: int = Field(description="recorded, but not made by the replay")
    unrecorded: int = Field(description="made by the replay, but not recorded")
    lost_with_twin: int = Field(
        0, description="made by the replay, not recorded because the twin died"
    )
    hashes: int = Field(0, description="hashes of predictions in the recording")
    hashes_compared: int = Field(0, description="hashes of both")
    hashes_differing: int = Field(0, description="hashes that differ")
    predictions_compared: int = Field(
        0, description="blocks of predictions of both, where the recording has a part of them"
    )
    predictions_differing: int = Field(0, description="blocks of predictions that differ")
    first_difference_index: Index | None = Field(description="first sample that differs")
    largest_difference_of_error_sums: dict[str, SI] = Field(description="by channel, SI squared")
    relative_difference: dict[str, Ratio] = Field(
        description="rms(new - old) / rms(old) by predicted channel; empty if identical"
    )
    versions_differing: dict[str, VersionPair] = Field(description="by package")
    recorded_comparison: dict[str, ChannelError] = Field(description="errors as recorded")


class RunSummary(Contract):
    """summary.json of a run, a replay or a simulation."""

    run: RunInfo = Field(description="origin and length of the recording")
    verdict: str = Field(description="how the test ended: complete, stopped, aborted or halted")
    reason: str = Field("", description="why the test ended")
    gaps: int = Field(0, description="gaps in the recording")
    lost_samples: Index = Field(0, description="samples missing in the file")
    clipped_channels: list[str] = Field(
        [], description="of the motion, with samples off the range of the sensor"
    )
    clipped_steps: list[Index] = Field([], description="with a sensor of the motion off its range")
    faults: list[FaultEntry] = Field([], description="failures of components")
    u_star_m: Metres = Field(
        None, description="u* that normalizes displacements; null without steps"
    )
    a_star_m_s2: Acceleration = Field(
        None, description="a* that normalizes accelerations; null without steps"
    )
    checks: list[CheckEntry] = Field([], description="loop check")
    trips: list[TripEntry] = Field([], description="trips of the protection")
    planned_steps: int = Field(0, description="of the sweep")
    steps: Sequence[StepEntry] = Field(description="planned steps that were measured, in order")
    windows: list[WindowResult] | None = Field(
        None, description="of a displacement history; absent for a stepped sine"
    )
    tracking: TrackingResult | None = Field(
        None, description="of the table, in a displacement history that was measured"
    )
    best_linear: list[BestLinearResult] = Field(
        [], description="of table and specimen; absent without a periodic multisine"
    )
    swept_sine: SweptSineResult | None = Field(
        None, description="level of a swept sine; absent otherwise"
    )
    orbits: list[OrbitResult] | None = Field(
        None, description="of a continuation, in order of measurement; absent otherwise"
    )
    folds: list[MeasuredFold] = Field(
        [], description="of the branch of a continuation; absent otherwise"
    )
    visits: list[StepEntry] = Field([], description="steps added during the test, not in the PRC")
    findings: list[str] = Field([], alias="found", description="of the adaptive policies")
    jumps: list[Jump] = Field([], description="jumps of `run.branches_from`")
    hysteresis: list[HysteresisInterval] = Field(
        [], description="hysteresis of `run.branches_from`"
    )
    twin_jumps: list[Jump] = Field([], description="jumps of the twin")
    twin_hysteresis: list[HysteresisInterval] = Field([], description="hysteresis of the twin")
    timing: TimingResult = Field(TimingResult(), description="latencies")
    comparison: dict[str, ChannelError] = Field({}, description="errors of the twin by channel")
    estimates: dict[str, ParameterEstimate] = Field({}, description="by parameter")
    warnings: list[WarningEntry] = Field([], description="warnings of the condition monitoring")
    alarms: list[WarningEntry] = Field(
        [], description="of the protection and of the test's own limits, where they stop nothing"
    )
    excitation_verdict: ExcitationVerdict | None = Field(
        None, description="whether the table played the test"
    )
    twin_verdict: TwinVerdict | None = Field(
        None, description="on the twin, apart from `verdict` on the test"
    )
    replay: ReplayResult | None = Field(None, description="absent unless it is a replay")
    sha256: str | None = Field(None, description="hash of run.mcap; only in a campaign")

    @property
    def stars(self) -> tuple[float, float] | None:
        """u* in m and a* in m/s2 that normalize the steps; None without steps."""
        if self.u_star_m is None or self.a_star_m_s2 is None:
            return None
        return self.u_star_m, self.a_star_m_s2

    @property
    def has_dropouts(self) -> bool:
        """Whether samples are missing in the recording."""
        return bool(self.gaps)

    @property
    def is_twin_judged(self) -> bool:
        """Whether anything was measured that the twin predicts."""
        return self.twin_verdict is not None and self.twin_verdict.reason != NOTHING_MEASURED
