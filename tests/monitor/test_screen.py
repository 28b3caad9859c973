"""The monitor's screen: complete, with units, and nothing cut, at every size."""

import random
import re
from dataclasses import replace

import pytest
from rich.text import Text

from table_io.records import Agreement, Estimate, Event, RunStop, Trip
from tests.monitor.monitored import RUN, point, records, start, stream
from tests.monitor.test_run_state import board
from twin.monitor import curves, panels
from twin.monitor.curves import MIN_MARK_SPACING, PlotCurve, plot_curves
from twin.monitor.panels import SessionStatus, format_number, format_percent
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.screen import (
    DEFAULT_LAYOUT,
    LARGE_LAYOUT,
    NARROW_LAYOUT,
    SHORT_LAYOUT,
    draw_screen,
)
from twin.transport.codec import WireError, decode_item, encode_item, topic_for
from twin.viewer.plots import nice_ceil

SIZES = [
    (36, 8),
    (40, 12),
    (60, 20),
    (72, 24),
    (80, 24),
    (100, 30),
    (120, 40),
    (160, 50),
    (200, 60),
]
ABOUT = SessionStatus(
    frozenset({f"{RUN}.rig", f"{RUN}.twin", "observer.ana.monitor-17", "observer.ana.monitor-18"}),
    0.1,
    True,
)


@pytest.fixture(scope="module")
def watched_state() -> LiveRunState:
    return board([*records(), *stream()])


def text(state: LiveRunState, width: int, height: int, about: SessionStatus = ABOUT) -> str:
    return "\n".join(line.plain for line in draw_screen(state, about, width, height))


@pytest.mark.parametrize("size", SIZES)
def test_it_fills_the_terminal_and_no_more(
    watched_state: LiveRunState, size: tuple[int, int]
) -> None:
    for state in (watched_state, LiveRunState(), board([start()])):
        lines = draw_screen(state, ABOUT, *size)
        assert len(lines) == size[1]
        assert all(line.cell_len <= size[0] for line in lines)
        assert not any("…" in line.plain or "\n" in line.plain for line in lines)


@pytest.mark.parametrize("width", [39, 40, 59, 65])
def test_no_panel_is_wider_than_its_column(watched_state: LiveRunState, width: int) -> None:
    """The screen would cut what is."""
    for panel in {cell.title: cell
                  for set_ in (NARROW_LAYOUT, SHORT_LAYOUT, DEFAULT_LAYOUT, LARGE_LAYOUT)
                  for column in set_ for cell in column}.values():  # fmt: skip
        lines = panel.draw(watched_state, width, 20)
        assert len(lines) <= 20
        assert Text.from_markup(panel.title + panel.legend).cell_len < width
        assert all(line.cell_len <= width for line in lines), panel.title


def test_too_small_a_terminal_is_told_what_is_needed() -> None:
    assert "needs 40 x 10" in text(LiveRunState(), 30, 5)
    assert len(draw_screen(LiveRunState(), ABOUT, 5, 3)) == 3


def test_at_120_columns_everything_is_there(watched_state: LiveRunState) -> None:
    shown = text(watched_state, 120, 40)
    for part in (
        "watched  Simulated uni-axial shaking table", "● running, measuring  0:00:08",
        "step  4/10   3.500 Hz ↑ forward    cycle 2/5", "13 %  0:00:52 left",
        "demanded    0.0500 g  command × 1.034", "now         0.0500 g",
        "accepted, corrected 2 ×", "jump down at 3.982 Hz (3.91 to 4.05)",
        "rig        0.410   1.960   5.200      0",
        "measured   1  2  3.000 mm  0.140  0.280", "twin       1  2  3.000 mm  0.168  0.336",
        "0:00:07 divergence: the twin has left the measurement",
        "dropout: 3 samples of force_l2_n lost", "dropouts: 3 samples, force L2",
        "connected  monitor:ana×2  rig  twin", "q quit  h hold  r resume  s stop  a abort",
    ):  # fmt: skip
        assert part in shown, part
    assert re.search(r"force R1 .*━+─+  4.000/10   kN    40 %", shown)
    assert re.search(r"velocity .* 22\.\d+/500  mm/s 4.\d %", shown)
    assert re.search(r"stiffness  36.10±0.050 kN/m  -5.0±0.2 %", shown)


def test_at_80_columns_the_essential_is_there(watched_state: LiveRunState) -> None:
    shown = text(watched_state, 80, 24)
    for part in (
        "step  4/10", "0.0500 g", "u rel", "force R1", "PRC η_d", "η_a", "divergence:",
        "p99  rig 2.0  twin 2.0 ms  0 missed", "connected", "q quit",
    ):  # fmt: skip
        assert part in shown, part


def test_where_not_all_have_room_the_nearest_to_a_limit_are_shown(
    watched_state: LiveRunState,
) -> None:
    rows = [line.plain.split("  ")[0].strip() for line in panels.draw_limits(watched_state, 39, 3)]
    assert [row[:9] for row in rows] == ["table acc", "mass disp", "force R1"]
    shown = text(watched_state, 80, 24).splitlines()
    begin = next(k for k, line in enumerate(shown) if line.startswith("Margins"))
    assert [line[:9].strip() for line in shown[begin + 1 : begin + 4]] == [row[:9] for row in rows]
    assert shown[begin + 4].startswith("Identified")


def test_a_panel_without_room_is_left_out(watched_state: LiveRunState) -> None:
    low, high = text(watched_state, 60, 12), text(watched_state, 60, 24)
    assert "Level ─" in low
    assert "PRC" not in low
    assert "PRC" in high
    assert "Measured | twin" not in high
    assert "Error of the last cycle by phase" in text(watched_state, 200, 60)


def test_beyond_its_band_is_marked(watched_state: LiveRunState) -> None:
    rows = {line.plain.split("  ")[0]: line for line in panels.draw_twin(watched_state, 59, 9)}
    assert rows["u rel"].plain.rstrip().endswith("◀")
    assert "0.100  0.050 mm" in rows["u rel"].plain
    assert "200 %" in rows["u rel"].plain
    assert "◀" not in rows["mass disp"].plain
    agreement = watched_state.get_latest(Agreement)
    assert agreement is not None
    nothing = replace(agreement, band=(float("nan"),) * len(agreement.band))
    silent = board([*records(), *stream(), replace(nothing, index=7999)])
    assert not any("◀" in line.plain for line in panels.draw_twin(silent, 59, 9))


def test_the_error_is_told_by_phase_where_there_is_room(watched_state: LiveRunState) -> None:
    assert "flight   right    left" in text(watched_state, 200, 60)
    assert re.search(r"u rel +0\.080   0\.150   0\.160 mm", text(watched_state, 200, 60))
    assert not panels.draw_phases(board([start()]), 60, 9)[0].plain.startswith(" ")


def test_without_agreement_the_error_is_that_of_the_last_second() -> None:
    state = board([start(), *stream()])
    assert any("1.000  0.100      – mm      10 %   0.200" in line.plain
               for line in panels.draw_twin(state, 59, 9))  # fmt: skip


def test_what_has_drifted_comes_first(watched_state: LiveRunState) -> None:
    first, *others = (line.plain.rstrip() for line in panels.draw_specimen(watched_state, 39, 6))
    assert first.startswith("stiffness")
    assert others[0].startswith("jump")
    assert len(others) == 5
    assert "bumper R   510.0±0.930 kN/m" in others
    assert "gap L      1.990±0.003 mm    +0.1±0.2 %" in others
    estimate = watched_state.get_latest(Estimate)
    assert estimate is not None
    steady = board([start(), replace(estimate, drift=(100.0, 0.0, 0.0, 0.0, 0.0))])
    assert panels.draw_specimen(steady, 39, 1)[0].plain.startswith("no jump forecast")


def test_the_newest_comes_first_and_long_sentences_go_on_below() -> None:
    state = board([start(), Event(1000, "warning", "first " * 20), Event(2000, "state", "holding")])
    lines = [line.plain for line in panels.draw_events(state, 39, 10)]
    assert lines[0] == "0:00:02 state: holding"
    assert lines[1].startswith("0:00:01 warning: first")
    assert lines[2].startswith("        first")
    assert " ".join(lines[1:]).count("first") == 20


def test_the_end_a_trip_and_silence_are_told(watched_state: LiveRunState) -> None:
    trip = Trip(500, 520, "stroke", "table_disp_m", 0.07, 0.06, "the table moved too far")
    halted = board([start(), trip, RunStop(520, "aborted", "the table moved too far")])
    assert "ended: aborted" in text(halted, 80, 24)
    assert "protection (stroke): the table" in text(halted, 80, 24)
    assert "0:01:05" in text(watched_state, 80, 24, replace(ABOUT, silent_s=65.0))
    assert "0:01:05" not in text(halted, 80, 24, replace(ABOUT, silent_s=65.0))
    late = board([start(), *stream(64_000, 65_000)])
    assert "100 %  0:00:05 over" in text(late, 80, 24)  # longer than planned
    held = board([*records(), *stream(), Event(7990, "state", "holding")])
    assert "until resumed" in text(held, 80, 24)


def test_orders_are_offered_to_whom_they_are_allowed_and_confirmed(
    watched_state: LiveRunState,
) -> None:
    assert "abort" not in text(watched_state, 80, 24, replace(ABOUT, may_command=False))
    assert "q quit" in text(watched_state, 80, 24, replace(ABOUT, may_command=False))
    assert "stop the test?  y = yes" in text(
        watched_state, 80, 24, replace(ABOUT, pending_command="stop")
    )


def test_numbers_have_at_most_six_characters() -> None:
    values = (0.0, 0.0123, -0.5, 9.9999, 12.345, -123.4, 1234.5, 98765.4, 1e9)
    assert all(len(format_number(value)) <= 6 for value in values)
    assert [format_number(number) for number in (0.0123, 12.345, 1234.5)] == [
        "0.012",
        "12.35",
        "1234",
    ]
    assert format_number(None) == format_number(float("nan")) == format_percent(float("inf")) == "–"
    assert [format_percent(share) for share in (0.001, 0.5, 1.2)] == ["0.1 %", "50 %", "120 %"]


def dots(lines: list[Text]) -> set[tuple[int, int]]:
    """(row, column) of every character with a dot or a mark, the axis left out."""
    return {
        (row, column)
        for row, line in enumerate(lines[:-2])
        for column, letter in enumerate(line.plain[line.plain.index("│" if "│" in line.plain
                                                                    else "┤") + 1 :])
        if letter != " "
    }  # fmt: skip


def test_a_plot_puts_points_where_they_belong() -> None:
    corners = [(0.0, 0.0), (10.0, 0.0), (10.0, 2.0), (0.0, 2.0)]
    cells = [(7, 0, "⡀"), (7, 29, "⢀"), (0, 29, "⠈"), (0, 0, "⠁")]
    for (x, y), (row, column, letter) in zip(corners, cells, strict=True):
        lines = plot_curves([PlotCurve("red", [(x, y)])], (0.0, 10.0), 2.0, 32, 10, "Hz")
        assert len(lines) == 10
        assert dots(lines) == {(row, column)}
        assert letter in lines[row].plain
    line = plot_curves(
        [PlotCurve("red", [(0.0, 0.0), (10.0, 2.0)])], (0.0, 10.0), 2.0, 32, 10, "Hz"
    )
    assert {row for row, _ in dots(line)} == set(range(8))
    assert line[-1].plain.split() == ["0", "5", "10", "Hz"]


def test_a_plot_bears_what_lies_outside_and_what_is_lost() -> None:
    wild = PlotCurve("red", [(-5.0, 1.0), (float("nan"), 1.0), (20.0, 9.0), (5.0, float("inf"))])
    lines = plot_curves([wild], (0.0, 10.0), 2.0, 32, 10, "Hz")
    assert all(line.cell_len <= 32 for line in lines)
    assert not dots(plot_curves([PlotCurve("red", [])], (3.0, 3.0), 0.0, 32, 10, "Hz"))


def test_marks_have_room_between_them() -> None:
    many = PlotCurve("white", [(k / 10, 1.0) for k in range(101)], "○")
    row = next(line.plain for line in plot_curves([many], (0.0, 10.0), 2.0, 40, 10, "Hz")
               if "○" in line.plain)  # fmt: skip
    assert re.fullmatch(rf"[^○]*(○[^○]{{{MIN_MARK_SPACING - 1}}})+○?[^○]*", row)


def test_the_curve_grows_with_the_points(watched_state: LiveRunState) -> None:
    """Both directions, measured over twin; a point more is a dot more at its frequency."""
    before = curves.draw_prc(board([start(), point(0)]), 60, 16)
    after = curves.draw_prc(board([start(), point(0), point(9)]), 60, 16)
    assert len(dots(after)) > len(dots(before)) > 0
    styles = {str(span.style) for line in after for span in line.spans}
    assert {curves.FORWARD_COLOUR, curves.BACKWARD_COLOUR} <= styles
    assert curves.BACKWARD_COLOUR not in {str(span.style) for line in before for span in line.spans}
    assert "●" in "".join(line.plain for line in before)
    lost = board([start(), replace(point(0), measured=None, twin=None)])
    assert not dots(curves.draw_prc(lost, 60, 16))


def test_the_end_of_an_axis_is_round() -> None:
    assert [nice_ceil(number) for number in (0.9, 0.21, 3.2, 1000.0)] == pytest.approx(
        [1.0, 0.3, 4.0, 1000.0]
    )


def test_a_text_from_elsewhere_does_not_command_the_terminal() -> None:
    wild = Event(10, "order", "stop: \x1b[2J\x1b]0;mine\x07 by\tana\n\u202e")
    state = board([replace(start(), name="a\x1b[31m"), wild])
    about = replace(ABOUT, components=frozenset({"observer.a\x1b[5m.monitor-1"}))
    for size in SIZES:
        assert all(line.plain.isprintable() for line in draw_screen(state, about, *size))


def test_damaged_bytes_never_break_it() -> None:
    """Whatever can be decoded can be drawn."""
    chance = random.Random(7)
    sound = [*records(), *stream(7800), RunStop(8000, "complete", "all driven")]
    payloads = [(topic_for(item), encode_item(item, RUN)) for item in sound]
    state, taken = LiveRunState(), 0
    for turn in range(4000):
        state = state if turn % 400 else LiveRunState()
        where, payload = chance.choice(payloads)
        damaged = bytearray(payload)
        for _ in range(chance.randrange(4)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        try:
            run, item = decode_item(where, bytes(damaged))
        except WireError:
            continue
        state, taken = update_run_state(state, run, item), taken + 1
        if turn % 40 == 0:
            for size in ((80, 24), (200, 60)):
                assert len(draw_screen(state, ABOUT, *size)) == size[1]
    assert taken > 1000
