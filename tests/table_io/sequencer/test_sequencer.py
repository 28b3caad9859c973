"""How a test goes on: on a table whose response is known, whatever the cut of the samples."""

import itertools
import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from table_io.block import Block, Float1D, Label
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_sweep
from table_io.records import Event, Level, Record
from table_io.sequencer.procedure import (
    advance_test,
    hold_test,
    make_test_plan,
    nominal_drive,
    resume_test,
    start_test,
)
from table_io.sequencer.state import SequencerState
from table_io.units import GRAVITY_M_S2
from tests.builders.drives import sine_segment_at, sine_segments
from tests.builders.profiles import make_profile
from tests.builders.rigs import RIG

RATE_HZ = 2000.0
A = 0.05 * GRAVITY_M_S2
CHANNELS = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")


def profile(control: dict[str, Any] | None = None, **sweep: Any) -> Profile:
    """2, 3, 4 Hz up and down, four cycles each, no loop check."""
    tables = {"control": control or {}, "loop_check": {"enabled": False}}
    return make_profile(tables=tables, **{"stop_hz": 4.0, "step_hz": 1.0, **sweep})


@dataclass
class Table:
    """Plays a conductor's drive on a table of gain(f), and keeps what was played."""

    gain: Any
    state: SequencerState
    records: list[Record] = field(default_factory=list)
    command: list[Float1D] = field(default_factory=list)
    at: int = 0

    def block(self, samples: int) -> Block:
        drive, at = self.state.drive, self.at
        metres = drive.command(at - 1, samples + 2)
        acceleration = np.diff(metres, 2) * RATE_HZ**2
        f = np.array([_frequency(drive, at + i) for i in range(0, samples)])
        values = np.array([metres[1:-1], metres[1:-1], self.gain(f) * acceleration])
        self.command.append(metres[1:-1])
        self.at += samples
        return Block("meas", at, RATE_HZ, CHANNELS, values, *drive.labels(at, samples))

    def play(self, samples: int, until: int | None = None) -> None:
        while self.at < (until or 10**9):
            if until is None and self.state.is_finished and self.at >= self.state.drive.rest_start:
                return
            self.state, records = advance_test(self.state, self.block(samples))
            self.records += records


def _frequency(drive: Drive, index: int) -> float:
    segment = sine_segment_at(drive, index)
    x = min(max((index - segment.start) / segment.count, 0.0), 1.0)
    return segment.f0 + (segment.f1 - segment.f0) * x**3 * (10 - 15 * x + 6 * x * x)


def roll_off(f: Float1D) -> Float1D:
    """A table that reaches 0.97 at 2 Hz and 0.7 at 4 Hz, without an identified response."""
    return 1.0 / (1.0 + (f / 6.2) ** 2)


def play_test(test: Profile, gain: Any = roll_off, samples: int = 20) -> Table:
    table = Table(gain, start_test(make_test_plan(test, RIG, 40)))
    table.play(samples)
    return table


def levels(table: Table, segment: Any) -> Float1D:
    """Amplitude of the table's acceleration in the held cycles of a segment."""
    return np.array([roll_off(np.array(segment.f0)) * segment.level0 * segment.correction0])


@pytest.mark.parametrize("samples", [1, 7, 64, 500])
def test_cut_of_the_samples_changes_nothing(samples: int) -> None:
    test = profile(directions=["forward"], stop_hz=3.0)
    whole, cut = play_test(test), play_test(test, samples=samples)
    size = min(whole.at, cut.at)
    first, other = np.concatenate(whole.command)[:size], np.concatenate(cut.command)[:size]
    assert first.tobytes() == other.tobytes()
    assert whole.records == cut.records
    assert whole.state.drive == cut.state.drive


def test_level_is_reached_at_every_step_and_frozen_while_it_is_measured() -> None:
    table = play_test(profile())
    held = [segment for segment in sine_segments(table.state.drive) if segment.cycles]
    assert len(held) == 6
    for segment in held:
        assert levels(table, segment) == pytest.approx(A, rel=0.02)
        assert segment.correction0 == segment.correction1
        assert segment.count == math.ceil(4 * RATE_HZ / segment.f0)
    looks = [record for record in table.records if isinstance(record, Level)]
    assert all(record.update <= 3 for record in looks)
    assert sum(record.accepted for record in looks) == 6
    assert not [record for record in table.records if isinstance(record, Event)]
    # Without control the same table is far off.
    off = play_test(profile({"enabled": False}))
    least = min(
        float(levels(off, segment)[0])
        for segment in sine_segments(off.state.drive)
        if segment.cycles
    )
    assert least < 0.75 * A


def test_correction_is_reused_on_the_way_back() -> None:
    table = play_test(profile())
    updates: dict[int, int] = {}
    for record in table.records:
        if isinstance(record, Level):
            updates[record.step] = max(updates.get(record.step, 0), record.update)
    assert max(updates[step] for step in (0, 1, 2)) >= 1
    assert [updates[step] for step in (3, 4, 5)] == [0, 0, 0]


def test_no_update_asks_for_more_than_its_clamp_nor_for_more_than_105_percent() -> None:
    table = play_test(profile({"clamp_db": 0.5}), gain=lambda f: 0.8 + 0 * f)
    looks = [record for record in table.records if isinstance(record, Level) and record.step == 0]
    ratios = np.array([b.correction / a.correction for a, b in itertools.pairwise(looks)])
    assert ratios.size >= 2
    assert ratios.max() <= 10 ** (0.5 / 20) + 1e-12
    command = np.concatenate([*table.command, np.zeros(10)])
    played_m_s2 = np.abs(np.diff(command, 2)) * RATE_HZ**2
    most = max(record.correction for record in table.records if isinstance(record, Level))
    assert played_m_s2.max() <= 1.05 * most * A * 1.001
    ideal = table.state.drive.acceleration(0, table.state.drive.planned_end)
    assert np.abs(ideal).max() <= 1.05 * A


def test_unreached_level_is_an_event() -> None:
    table = play_test(profile({"updates": 1, "clamp_db": 0.5}), gain=lambda f: 0.5 + 0 * f)
    events = [record for record in table.records if isinstance(record, Event)]
    assert events
    assert events[0].kind == "level"
    assert "demanded" in events[0].text
    assert len([segment for segment in sine_segments(table.state.drive) if segment.cycles]) == 6


def test_without_control_the_drive_is_the_plan() -> None:
    test = profile({"enabled": False})
    table = play_test(test)
    assert table.state.drive == plan_sweep(test)


@pytest.mark.parametrize("name", ["quickstart", "g4_ss3", "gm10"])
def test_rehearsal_is_what_a_perfect_table_plays(name: str) -> None:
    test = load_config(PROFILES_DIR / "tests" / f"{name}.toml", Profile, "test")[0]
    sweep = test.sweep.model_copy(update={"stop_hz": test.sweep.start_hz + test.sweep.step_hz})
    test = test.model_copy(
        update={
            "excitation": sweep,
            "loop_check": test.loop_check.model_copy(update={"enabled": False}),
        }
    )
    table = play_test(test, gain=np.ones_like)
    assert table.state.drive == nominal_drive(make_test_plan(test, RIG, 40))


@pytest.mark.parametrize("where", [0.2, 0.5, 0.9])
def test_hold_stays_at_its_step_and_the_step_is_measured_anew(where: float) -> None:
    test = profile()
    whole = nominal_drive(make_test_plan(test, RIG, 40))
    table = Table(np.ones_like, start_test(make_test_plan(test, RIG, 40)))
    table.play(20, until=round(where * whole.planned_end))
    before = np.concatenate(table.command)
    table.state = hold_test(table.state, table.at + 100)
    assert table.state.stage.kind == "open"
    table.play(20, until=table.at + 8000)
    step, label, cycle = table.state.drive.labels(table.at - 2000, 2000)
    assert len(set(step)) == 1
    assert set(label) == {Label.SETTLE}
    assert set(cycle) == {-1}
    assert table.state.blocks == (), "an hour of samples would be kept and copied at every block"
    table.state = resume_test(table.state, table.at + 100)
    table.play(20)
    command = np.concatenate(table.command)
    assert command[: before.size].tobytes() == before.tobytes()
    assert np.abs(np.diff(command, 2)).max() * RATE_HZ**2 <= 1.051 * A
    _, labels, cycles = table.state.drive.labels(0, table.at)
    steps = table.state.drive.labels(0, table.at)[0]
    for index in range(6):
        assert set(cycles[(steps == index) & (labels == Label.MEASURE)]) == {2, 3}, index
    held = int(step[0])
    first = np.flatnonzero((steps == held) & (cycles == 3))[-1]
    assert first > before.size + 8000


def test_hold_or_a_resume_out_of_place_changes_nothing() -> None:
    test = profile()
    state = start_test(make_test_plan(test, RIG, 40))
    assert resume_test(state, 100) is state
    table = play_test(test)
    assert hold_test(table.state, table.at) is table.state
    waiting = replace(state, stage=replace(state.stage, kind="check"))
    assert hold_test(waiting, 100) is waiting
