"""Protection over whole runs: a table of faults, each with its finding and the time until it.

The specimen is a rigid block without contact on a table that follows its command exactly, so that
every channel is known in closed form. What the simulated table adds (servo, impacts, chaos) is in
test_protection_simulated.py, each limit to the number in test_sample_checks.py and
test_cycle_checks.py.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from table_io.block import Block, Float2D, Label
from table_io.config.profile import Profile
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget, plan_sweep, start_trajectory
from table_io.records import Event, FrequencyResponse, Trip
from table_io.safety.findings import Finding
from table_io.safety.protection import (
    Observation,
    ProtectionState,
    inspect_samples,
    set_response,
    start_protection,
)
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_profile
from tests.builders.rigs import NOISE_SI, RIG

NAMES = RIG.channels
DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, R2, L1, L2 = range(9)
RATE_HZ = 2000.0
FAULT_SAMPLE = 5000  # in the held cycles of the first step, 2 Hz, held from 1.5 s to 6 s
CYCLE_SAMPLES = 1000
HELD_FROM = 3000
LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
EVERYTHING = slice(None)
Change = Callable[[Any], None]  # of values, (channel, sample)


def make_test(sensor: str = "stop", gap_mm: float = 4.0, **sweep: Any) -> Profile:
    """Return a test of 2 and 2.5 Hz, nine cycles each."""
    grid = {"stop_hz": 2.5, "cycles": 9, "measured_cycles": 8, "directions": ("forward",)}
    return make_profile(gap_mm, {"protection": {"sensor": sensor}}, **grid | sweep)


TEST = make_test()
PLAN = plan_sweep(TEST)


def scale_noise(scale: float) -> dict[str, tuple[float, int]]:
    """Return what the tare measures of each channel."""
    return {
        name: (scale * rms, 2 if scale * rms else int(RATE_HZ))
        for name, (rms, _) in NOISE_SI.items()
    }


@cache
def _simulate_once(drive: Drive, scale: float, lag: int) -> Float2D:
    count = drive.rest_start + 1000
    values = np.zeros((len(NAMES), count))
    values[DRIVE] = drive.command(0, count)
    values[[TABLE, MASS]] = drive.command(-lag, count)
    values[[ACC, MASS_ACC]] = drive.acceleration(-lag, count)
    noise = np.random.default_rng(7).standard_normal(values.shape)
    rms = np.array([[noise_rms] for noise_rms, _ in scale_noise(scale).values()])
    return values + rms * noise


def simulate_channels(drive: Drive = PLAN, scale: float = 1.0, lag: int = 0) -> Float2D:
    """Return (channel, sample): table and mass move as one, `lag` samples behind the command."""
    return _simulate_once(drive, scale, lag).copy()


@cache
def evaluate_drive(drive: Drive) -> tuple[Any, ...]:
    """Return labels, command, phase, level and acceleration of every sample that is measured."""
    span = 0, drive.rest_start + 1000
    return (
        drive.labels(*span),
        drive.command(*span),
        np.unwrap(drive.phase(*span), period=1.0),
        drive.level(*span),
        drive.demanded_acceleration(*span),
    )


def observe(values: Float2D, at_range: Any, drive: Drive, first: int, count: int) -> Observation:
    window = slice(first, min(first + count, values.shape[1]))
    labels, *demands = evaluate_drive(drive)
    part = values[:, window].copy()
    block = Block("meas", first, RATE_HZ, NAMES, part, *(label[window] for label in labels))
    return Observation(block, at_range[:, window], *(demand[window] for demand in demands))


def list_findings(
    change: Change | None = None,
    test: Profile = TEST,
    drive: Drive = PLAN,
    at_range: Change | None = None,
    cut: int = 5000,
    scale: float = 1.0,
    lag: int = 0,
    known: FrequencyResponse | None = None,
    noisy: tuple[int, ...] = tuple(range(9)),
    last: int | None = None,
) -> list[Finding]:
    """Return all findings of a run in which `change` was made; `noisy`: rows that have noise."""
    values = simulate_channels(drive, scale, lag)
    quiet = [row for row in range(len(NAMES)) if row not in noisy]
    values[quiet] = simulate_channels(drive, 0.0, lag)[quiet]
    clipped = np.zeros(values.shape, dtype=np.bool_)
    if change is not None:
        change(values)
    if at_range is not None:
        at_range(clipped)
    noise = {
        name: entry for name, entry in scale_noise(scale).items() if NAMES.index(name) in noisy
    }
    guard = start_protection(test, RIG, noise)
    if known is not None:
        guard = set_response(guard, known)
    findings: list[Finding] = []
    values = values[:, :last]
    for first in range(0, values.shape[1], cut):
        guard, some = inspect_samples(guard, observe(values, clipped, drive, first, cut))
        findings += some
    return findings


def put(rows: Any, value: Any, count: int | None = None, first: int = FAULT_SAMPLE) -> Change:
    """Set samples of channels."""

    def change(values: Any) -> None:
        values[rows, first : None if count is None else first + count] = value

    return change


def add(rows: Any, value: Any, count: int | None = None, first: int = FAULT_SAMPLE) -> Change:
    """Add to samples of channels."""

    def change(values: Any) -> None:
        values[rows, first : None if count is None else first + count] += value

    return change


def multiply(rows: Any, factor: float, first: int = FAULT_SAMPLE) -> Change:
    """Multiply channels from a sample on."""

    def change(values: Any) -> None:
        values[rows, first:] *= factor

    return change


def combine(*changes: Change) -> Change:
    """Make several changes, one after another."""

    def change(values: Any) -> None:
        for part in changes:
            part(values)

    return change


def repeat(back: int, count: int) -> Change:
    """Deliver old samples once more in all channels."""

    def change(values: Any) -> None:
        for k in range(FAULT_SAMPLE, FAULT_SAMPLE + count):
            values[:, k] = values[:, k - back]

    return change


def ramp_table(speed_m_s: float) -> Change:
    """Move the table away for 50 ms."""

    def change(values: Any) -> None:
        way = speed_m_s * np.minimum(np.arange(values.shape[1] - FAULT_SAMPLE), 100) / RATE_HZ
        values[TABLE, FAULT_SAMPLE:] += way

    return change


def delay_command(values: Any) -> None:
    values[DRIVE, FAULT_SAMPLE:] = values[DRIVE, FAULT_SAMPLE - 20 : -20].copy()


def stop_table(values: Any) -> None:
    """Let the table and its load stay where they are."""
    sound = simulate_channels(PLAN, 0.0)
    place, motion = [TABLE, MASS], [ACC, MASS_ACC]
    held = sound[place, FAULT_SAMPLE, None]
    values[place, FAULT_SAMPLE:] += held - sound[place, FAULT_SAMPLE:]
    values[motion, FAULT_SAMPLE:] -= sound[motion, FAULT_SAMPLE:]


def make_noise(row: int, share: float) -> Float2D:
    """Return noise of a share of that of a channel, (4000,)."""
    generator = np.random.default_rng(1)
    noise: Any = share * NOISE_SI[NAMES[row]][0] * generator.standard_normal(4000)
    return noise


def find_spike_limit(row: int) -> float:
    """Return the limit of a spike in SI: noise or range, and the steps of a stiff table."""
    sensor = RIG.sensors[row]
    limit = max(10 * sensor.noise_rms, 1e-3 * sensor.range) * sensor.si_per_unit
    return limit + (RIG.output.lsb_m * 1e6 if row == ACC else 0.0)


def press_bumper(share: float, change: Change | None = None) -> Change:
    """Let the right cells carry the mass part of each cycle, the first one `share` of it."""

    def press(values: Any) -> None:
        labels, _, phase, level, _ = evaluate_drive(PLAN)
        held = np.isin(labels[1], (Label.SETTLE, Label.MEASURE))
        frequency_hz = np.where(held, np.abs(np.gradient(phase)) * RATE_HZ, 0.0)
        u = np.where(held, 3e-3 * level / LEVEL_M_S2 * np.sin(2 * np.pi * phase), 0.0)
        force = np.maximum(u - 2e-3, 0.0) * 500e3
        values[R1] += share * force
        values[R2] += (1 - share) * force
        values[MASS] += u
        values[MASS_ACC] -= (2 * np.pi * frequency_hz) ** 2 * u
        if change is not None:
            change(values)

    return press


def make_response(lag_s: float) -> FrequencyResponse:
    frequencies_hz = (1.0, 3.0, 9.0)
    phases = tuple(-2 * np.pi * f * lag_s for f in frequencies_hz)
    return FrequencyResponse(0, frequencies_hz, (1.0, 1.0, 1.0), phases)


WARN: dict[str, Any] = {"test": make_test("warn")}


@dataclass(frozen=True)
class Fault:
    """A change and its first finding: kind, channel, whether it stops, latest sample from there.

    `is_only`: there is no other finding at all. `among`: other kinds may come before it.
    """

    name: str
    change: Change | None
    kind: str
    row: int | None
    stops: bool
    latest: int
    earliest: int = 0
    is_only: bool = False
    value: float | None = None
    options: dict[str, Any] | None = None


def list_limit_and_sensor_faults() -> Iterator[Fault]:
    """Faults that single samples show."""
    table_alone = 30e3 / 2000.0 - 550.0 / 2000.0 * LEVEL_M_S2
    mass_alone = (30e3 + 2000.0 * 2 * LEVEL_M_S2) / 550.0
    no_mass = put(MASS_ACC, np.nan)
    # fmt: off
    for sign, side in ((1.0, "right"), (-1.0, "left")):
        yield Fault(f"stroke {side}", put(TABLE, sign * 0.0602), "stroke", TABLE, True, 2, 1)
        yield Fault(f"acceleration {side}", put(ACC, sign * 1.02 * GRAVITY_M_S2), "acceleration",
                    ACC, True, 2, 1)
        yield Fault(f"force {side}", put(MASS_ACC, sign * mass_alone), "force", ACC, True, 2, 1)
    yield Fault("force of the table", put(ACC, table_alone + 0.2), "force", ACC, True, 600)
    yield Fault("force without the mass", combine(no_mass, put(ACC, 15.1)), "force", ACC, True, 5)
    yield Fault("velocity", ramp_table(0.55), "velocity", TABLE, True, 22, 1)
    yield Fault("at its range", None, "rail", MASS, True, 2, 2, True,
                options={"at_range": put(MASS, True, 3)})
    yield Fault("at its range, to warn of", None, "rail", MASS, False, 2, 2, True,
                options={"at_range": put(MASS, True, 3), **WARN})
    yield Fault("lost sample", put(TABLE, np.nan, 1), "lost", TABLE, False, 0, 0, True)
    yield Fault("lost 20 ms", put(TABLE, np.nan, 41), "lost", TABLE, True, 40, 40)
    yield Fault("lost block", put(EVERYTHING, np.nan, 20), "lost", None, False, 0, 0, True)
    for row in (TABLE, ACC, MASS, MASS_ACC, R1):
        name = NAMES[row]
        yield Fault(f"stuck {name}", put(row, 1e-4), "stuck", row, True, 19, 19)
        yield Fault(f"cable off {name}", put(row, make_noise(row, 0.1), 4000), "silent", row, True,
                    300)
    for row in (DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, L2):
        limit = 1.7 * find_spike_limit(row)
        yield Fault(f"spike {NAMES[row]}", add(row, limit, 1), "spike", row, False, 0, 0, True)
    for back in (7, 20, 333):
        yield Fault(f"repeated after {back}", repeat(back, 15), "repeated", None, False, 4, 4, True,
                    back / RATE_HZ)
    yield Fault("repeated for 30 ms", repeat(20, 60), "lost", None, True, 50)
    # fmt: on


def list_motion_faults() -> Iterator[Fault]:
    """Faults that the motion shows, some over several cycles."""
    soft = {"lag": 50, "known": make_response(0.015)}
    quarter = CYCLE_SAMPLES // 4
    checks = round(2.6 * CYCLE_SAMPLES)
    # fmt: off
    yield Fault("late command", delay_command, "command", DRIVE, True, quarter)
    yield Fault("table stays", stop_table, "following", TABLE, True, quarter)
    for factor in (1.12, 0.88):
        rows = [TABLE, ACC, MASS, MASS_ACC]
        yield Fault(f"level {factor}", multiply(rows, factor, 0), "level", ACC, False, 9999, -9999,
                    value=factor * LEVEL_M_S2)
    for factor in (2.1, 0.48):
        rows = [TABLE, ACC, MASS, MASS_ACC]
        held = HELD_FROM - FAULT_SAMPLE + 2 * CYCLE_SAMPLES
        yield Fault(f"level {factor}", multiply(rows, factor, 0), "level", ACC, True, held + 200,
                    held)
    yield Fault("softer than identified", None, "response", TABLE, True, 9999, -9999, value=0.025,
                options=soft)
    for row, size in ((ACC, 0.1), (MASS_ACC, 0.15), (R1, 8.0)):
        yield Fault(f"offset {NAMES[row]}", add(row, size), "drift", row, True, checks)
    for row in (TABLE, ACC, MASS, MASS_ACC):
        for factor in (0.9, 1.1, -1.0):
            yield Fault(f"{NAMES[row]} times {factor}", multiply(row, factor), "consistency", row,
                        True, checks)
    yield Fault("sensor to warn of", multiply(MASS_ACC, -1.0), "consistency", MASS_ACC, False,
                checks, options=WARN)
    yield Fault("sensor of the controller", multiply(ACC, -1.0), "consistency", ACC, True, checks,
                options=WARN)
    for share in (0.5, 0.35, 0.6):
        for row, factor in ((R1, 1.3), (R2, 0.7), (R1, -1.0), (R2, 0.1)):
            yield Fault(f"{NAMES[row]} times {factor}, share {share}",
                        press_bumper(share, multiply(row, factor)),
                        "polarity" if factor < 0 else "share", None, True, 3100)
    yield Fault("gap elsewhere", press_bumper(0.5, add(MASS, -4e-3)), "drift", MASS, True, 9999)
    # fmt: on


FAULTS = [*list_limit_and_sensor_faults(), *list_motion_faults()]


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_fault_is_found_in_time(fault: Fault) -> None:
    findings = list_findings(fault.change, **fault.options or {})
    same = [
        finding
        for finding in findings
        if (finding.kind, finding.stop) == (fault.kind, fault.stops)
        and (fault.row is None or finding.channel == NAMES[fault.row])
    ]
    assert same, [(finding.kind, finding.channel, finding.stop) for finding in findings]
    finding = same[0]
    assert fault.earliest <= finding.index - FAULT_SAMPLE <= fault.latest
    if fault.is_only:
        assert len(findings) == 1
    if not fault.stops:
        assert not [other for other in findings if other.stop]
        assert finding.to_event().kind == ("alarm" if fault.kind == "level" else "sensor")
    if fault.kind in ("stroke", "acceleration", "force") and " " in fault.name:
        assert np.sign(finding.value) == (-1.0 if fault.name.endswith("left") else 1.0)
        assert abs(finding.value) > finding.limit
    if fault.value is not None:
        assert finding.value == pytest.approx(fault.value, rel=0.02)

    # fmt: on


@pytest.mark.parametrize("noisy", [(ACC,), (TABLE,), (TABLE, ACC), (TABLE, ACC, MASS, MASS_ACC)])
def test_repetition_is_proved_by_two_sensors_with_noise(noisy: tuple[int, ...]) -> None:
    findings = list_findings(repeat(50, 40), noisy=noisy)
    is_repeated = "repeated" in {finding.kind for finding in findings}
    assert is_repeated == (len(noisy) > 1)


def make_check_drive() -> Drive:
    """Return a held motion at a tenth of the level, as in a loop check."""
    target = SineTarget(2.0, 0.1 * LEVEL_M_S2)
    course = start_trajectory(TEST).append_blend(target, -1, 1.5, Label.BLEND)
    return course.append_hold(6000, -1, Label.CHECK).to_drive(TEST.sweep.steps)


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC, MASS, MASS_ACC])
@pytest.mark.parametrize("factor", [-1.0, 0.3, 2.0])
def test_wrong_sensors_are_left_to_the_loop_check(row: int, factor: float) -> None:
    assert list_findings(multiply(row, factor, 0), drive=make_check_drive()) == []


@pytest.mark.parametrize(
    ("kind", "change"),
    [("stroke", put(TABLE, 0.07)), ("stuck", put(TABLE, 1e-4)), ("following", add(TABLE, 2e-3))],
)
def test_limits_and_broken_sensors_stop_a_loop_check(kind: str, change: Change) -> None:
    findings = list_findings(change, drive=make_check_drive())
    assert kind in {finding.kind for finding in findings if finding.stop}


MANY_FAULTS = combine(
    put(R1, np.random.default_rng(2).standard_normal(6000) * 0.1, 6000, 3500),
    add(TABLE, 0.02, 1, 4001),
    put(EVERYTHING, np.nan, 20, 4500),
    multiply(MASS_ACC, 1.4, 5100),
    repeat(20, 15),
    put(MASS, 0.01, 300, 7007),
    multiply(ACC, 0.4, 8000),
    put(TABLE, 0.061, first=11000),
)


def test_division_into_blocks_changes_no_finding() -> None:
    whole = list_findings(MANY_FAULTS, cut=20, last=11100, **WARN)
    kinds = {"silent", "spike", "lost", "consistency", "repeated", "stuck", "level", "stroke"}
    assert {finding.kind for finding in whole} >= kinds
    for cut in (1, 7, 64, 500):
        assert repr(list_findings(MANY_FAULTS, cut=cut, last=11100, **WARN)) == repr(whole), cut


def test_state_of_protection_is_a_value() -> None:
    values = simulate_channels()
    MANY_FAULTS(values)
    clipped = np.zeros(values.shape, dtype=np.bool_)
    guard = start_protection(TEST, RIG, NOISE_SI)
    states: list[tuple[ProtectionState, Observation]] = []
    for first in range(0, 9000, 500):
        states.append((guard, observe(values, clipped, PLAN, first, 500)))
        guard, _ = inspect_samples(*states[-1])
    for state in states:
        assert repr(inspect_samples(*state)[1]) == repr(inspect_samples(*state)[1])


def test_omitted_samples_are_refused() -> None:
    values = simulate_channels()
    clipped = np.zeros(values.shape, dtype=np.bool_)
    guard = start_protection(TEST, RIG, NOISE_SI)
    guard, _ = inspect_samples(guard, observe(values, clipped, PLAN, 0, 20))
    with pytest.raises(ValueError, match=r"\b20\b.*\b40\b"):
        inspect_samples(guard, observe(values, clipped, PLAN, 40, 20))


def test_finding_becomes_a_trip_or_an_event() -> None:
    finding = Finding(12, "stroke", "table_disp_m", 0.07, 0.06, "too far", True)
    assert finding.to_trip(20) == Trip(12, 20, "stroke", "table_disp_m", 0.07, 0.06, "too far")
    assert finding.to_event() == Event(12, "sensor", "too far")
    assert replace(finding, kind="level").to_event().kind == "alarm"


@pytest.mark.parametrize(
    ("kind", "change", "options", "parts"),
    [
        ("stroke", put(TABLE, 0.0612), {}, ("table_disp_m: 61.2 mm at sample 500", "60 mm")),
        ("lost", put(EVERYTHING, np.nan, 20), {}, ("all channels",)),
        ("response", None, {"lag": 50, "known": make_response(0.015)}, ("25.0 ms", "15.0 ms")),
        ("drift", press_bumper(0.5, add(MASS, -4e-3)), {}, ("other side of the gap",)),
    ],
)
def test_finding_states_channel_value_and_limit(
    kind: str, change: Change | None, options: dict[str, Any], parts: tuple[str, ...]
) -> None:
    findings = list_findings(change, **options)
    text = next(finding.text for finding in findings if finding.kind == kind)
    assert all(part in text for part in parts), text
