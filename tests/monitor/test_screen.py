"""The monitor's screen: whole screens, and what changes them."""

import random
import re
from dataclasses import replace

import pytest
from rich.text import Text

from table_io.block import Block
from table_io.records import Agreement, Estimate, Event, Record, RunStop, Trip
from tests.monitor.monitored import LEVEL, RUN, block, point, receive, records, start, stream
from twin.monitor import panels
from twin.monitor.panels import (
    MIN_MARK_SPACING,
    PlotCurve,
    format_number,
    format_percent,
    plot_curves,
)
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.run_view import RunView, SessionStatus
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
    (36, 8), (40, 12), (60, 20), (72, 24), (80, 24), (100, 30), (120, 40), (160, 50), (200, 60),
]  # fmt: skip
STATUS = SessionStatus(
    frozenset({f"{RUN}.rig", f"{RUN}.twin", "observer.ana.monitor-17", "observer.ana.monitor-18"}),
    0.1,
    True,
)
SCREEN_98_BY_40 = """\
watched  Simulated uni-axial shaking table                           ● running, measuring  0:00:08
step  4/10   3.500 Hz ↑ forward  ━━━━━━───────────────────────────────────────  13 %  0:00:52 left
Level ──────────────────────────────────────────  PRC η_d ━ forward ━ backward ○ twin ────────────
demanded    0.0500 g  command × 1.034             0.2┤                                ⢸
now         0.0500 g  +0.02 %  peak 0.0500 g         │                                ⢸
accepted, corrected 2 ×, thd 4.6 %                   │                      ○         ⢸
                                                     │                 ⣀⠤⠔⠒⠉          ⢸
Margins to limits, peak of 1 s ─────────────────     │           ⢀⣀⠤⠔⠊⠉               ⢸
drive      ──────────────  1.000/60   mm   1.7 %     │      ⢀⣀⠤⠒⠊○       ⣀⡠⠤●         ⢸
table disp ──────────────  1.014/60   mm   1.7 %     │ ⢀⡠⠤⠒⠊⠁     ⢀⣀⠤⠔⠒⠊⠉             ⢸
table acc  ━─────────────  0.050/1    g    5.0 %     │○⠁    ⢀⣀⠤⠔⠒⠉⠁                   ⢸
mass disp  ━━━───────────  21.00/100  mm    21 %     │⣀⣀⠤⠔⠒⠉⠁                         ⢸
mass acc   ──────────────  0.000/5    g    0.0 %  0.1┤                                ⢸
force R1   ━━━━━━────────  4.000/10   kN    40 %     │                                ⢸
force R2   ──────────────  0.000/10   kN   0.0 %     │                                ⢸
force L1   ──────────────  0.000/10   kN   0.0 %     │                                ⢸
force L2   ──────────────  0.000/10   kN   0.0 %     │                                ⢸
velocity   ━─────────────  22.25/500  mm/s 4.5 %     │                                ⢸
force      ──────────────  0.981/30   kN   3.3 %     │                                ⢸
                                                     │                                ⢸
Measured | twin ────────────────────────────────     │                                ⢸
              rms  error   band                     0└┴─────────────────────┴────────────────────┴
u rel       1.000  0.100  0.050 mm   ◀                2                   3                   4 Hz
mass disp   1.000  0.100  0.200 mm                Last cycle and last point ──────────────────────
mass acc    0.001  0.000  0.000 m/s²                         R  L    u peak    η_d    η_a
force R1    0.001  0.000  0.000 N                 measured   1  2  3.000 mm  0.140  0.280
force R2    0.001  0.000  0.000 N                 twin       1  2  3.000 mm  0.168  0.336
force L1    0.001  0.000  0.000 N                 Latency in ms ──────────────────────────────────
force L2    0.001  0.000  0.000 N                              p50     p99     max missed
                                                  rig        0.410   1.960   5.200      0
Identified parameters ──────────────────────────  twin       0.410   1.960   5.200      0
stiffness  36.10±0.050 kN/m  -4.7±0.2 %
jump down at 3.982 Hz (3.91 to 4.05)              Warnings and events ────────────────────────────
damping    1.100±0.015 kNs/m                      0:00:07 dropout: 3 samples of force_l2_n lost
bumper R   510.0±0.930 kN/m                       0:00:07 divergence: the twin has left the
gap R      2.010±0.002 mm    +0.0±0.1 %                   measurement by more than its band
gap L      1.990±0.003 mm    +0.1±0.2 %           0:00:00 state: running
                                                  0:00:00 state: checking
connected  monitor:ana×2  rig  twin                                  dropouts: 3 samples, force L2
q quit  h hold  r resume  s stop  a abort
"""
SCREEN_60_BY_30 = """\
watched                        ● running, measuring  0:00:08
step  4/10   3.500 Hz ↑ forward  ━──────  13 %  0:00:52 left
Level ──────────────────────────────────────────────────────
demanded    0.0500 g  command × 1.034
now         0.0500 g  +0.02 %  peak 0.0500 g
accepted, corrected 2 ×, thd 4.6 %
PRC η_d ━ forward ━ backward ○ twin ────────────────────────
0.2┤                                         ⢸
   │         ⣀⣀⣀⣀⣀○⠤⠤⠤⠤⠒⠒⠒⠒⠒⢉⣉⣉⣉●            ⢸
   │○⣒⣒⣒⣉⣉⡩⠭⠭⠤⠤⠤⠔⠒⠒⠒⠒⠒⠊⠉⠉⠉⠉⠉⠁                ⢸
0.1┤                                         ⢸
   │                                         ⢸
   │                                         ⢸
  0└┴───────────────────────────┴──────────────────────────┴
    2                         3                         4 Hz
Last cycle and last point ──────────────────────────────────
           R  L    u peak    η_d    η_a
measured   1  2  3.000 mm  0.140  0.280
twin       1  2  3.000 mm  0.168  0.336
Warnings and events ────────────────────────────────────────
0:00:07 dropout: 3 samples of force_l2_n lost
0:00:07 divergence: the twin has left the measurement by
        more than its band
Margins to limits, peak of 1 s ─────────────────────────────
table acc  ━─────────────────────────  0.050/1    g    5.0 %
mass disp  ━━━━━─────────────────────  21.00/100  mm    21 %
force R1   ━━━━━━━━━━────────────────  4.000/10   kN    40 %
p99  rig 2.0  twin 2.0 ms  0 missed
connected  monitor:ana×2 +2    dropouts: 3 samples, force L2
q quit  h hold  r resume  s stop  a abort
"""


def view(*items: Block | Record, status: SessionStatus = STATUS) -> RunView:
    return RunView(receive(*items), status)


def render(shown: RunView, width: int, height: int) -> str:
    lines = draw_screen(shown, width, height)
    return "".join(line.plain.rstrip() + "\n" for line in lines)


@pytest.fixture(scope="module")
def midway() -> RunView:
    return view(*records(), *stream())


def test_screen_shows_every_panel_in_two_columns_or_the_essential_in_one(midway: RunView) -> None:
    assert render(midway, 98, 40) == SCREEN_98_BY_40
    assert render(midway, 60, 30) == SCREEN_60_BY_30


@pytest.mark.parametrize("size", SIZES)
def test_screen_fills_any_terminal_and_no_more(midway: RunView, size: tuple[int, int]) -> None:
    for shown in (midway, RunView(LiveRunState(), STATUS), view(start())):
        lines = draw_screen(shown, *size)
        assert len(lines) == size[1]
        assert all(line.cell_len <= size[0] for line in lines)
        assert not any("…" in line.plain or "\n" in line.plain for line in lines)


@pytest.mark.parametrize("width", [39, 40, 59, 65])
def test_no_panel_is_wider_than_its_column(midway: RunView, width: int) -> None:
    """The screen would cut what is."""
    for panel in {cell.title: cell
                  for set_ in (NARROW_LAYOUT, SHORT_LAYOUT, DEFAULT_LAYOUT, LARGE_LAYOUT)
                  for column in set_ for cell in column}.values():  # fmt: skip
        lines = panel.draw(midway, width, 20)
        assert len(lines) <= 20
        assert Text.from_markup(panel.title + panel.legend).cell_len < width
        assert all(line.cell_len <= width for line in lines), panel.title


def test_too_small_a_terminal_names_the_size_needed() -> None:
    shown = RunView(LiveRunState(), STATUS)
    assert "needs 40 x 10" in render(shown, 30, 5)
    assert len(draw_screen(shown, 5, 3)) == 3


def test_panels_without_room_are_left_out(midway: RunView) -> None:
    low, high, large = (render(midway, *size) for size in ((60, 12), (60, 24), (200, 60)))
    assert "Level ─" in low
    assert "PRC" not in low
    assert "PRC" in high
    assert "Measured | twin" not in high
    assert "Error of the last cycle by phase" in large
    assert "flight   right    left" in large
    assert re.search(r"u rel +0\.080   0\.150   0\.160 mm", large)


def test_tightest_margins_are_shown_where_not_all_have_room(midway: RunView) -> None:
    shown = render(midway, 80, 24).splitlines()
    begin = next(k for k, line in enumerate(shown) if line.startswith("Margins"))
    names = [line[:9] for line in shown[begin + 1 : begin + 4]]
    assert names == ["table acc", "mass disp", "force R1 "]
    assert shown[begin + 4].startswith("Identified")


def test_error_beyond_its_band_is_marked_and_without_bands_is_that_of_the_second(
    midway: RunView,
) -> None:
    rows = {line.plain.split("  ")[0]: line.plain for line in panels.draw_twin(midway, 59, 9)}
    assert "0.100  0.050 mm     200 %   0.200 ◀" in rows["u rel"]
    assert "◀" not in rows["mass disp"]
    agreement = midway.agreement
    assert isinstance(agreement, Agreement)
    unknown = replace(agreement, band=(float("nan"),) * len(agreement.band), index=7999)
    silent = view(*records(), *stream(), unknown)
    assert not any("◀" in line.plain for line in panels.draw_twin(silent, 59, 9))
    no_agreement = view(start(), *stream())
    assert (
        "1.000  0.100      – mm      10 %   0.200" in panels.draw_twin(no_agreement, 59, 9)[1].plain
    )
    assert panels.draw_phases(no_agreement, 60, 9)[0].plain == "no cycle compared yet"


def test_parameters_without_drift_follow_the_forecast(midway: RunView) -> None:
    estimate = midway.run_state.get_latest(Estimate)
    assert estimate is not None
    steady = view(start(), replace(estimate, drift=(100.0, 0.0, 0.0, 0.0, 0.0)))
    assert panels.draw_specimen(steady, 39, 1)[0].plain == "no jump forecast yet"


def test_long_events_are_wrapped_below_the_newest() -> None:
    shown = view(start(), Event(1000, "warning", "first " * 20), Event(2000, "state", "holding"))
    lines = [line.plain for line in panels.draw_events(shown, 39, 10)]
    assert lines[0] == "0:00:02 state: holding"
    assert lines[1].startswith("0:00:01 warning: first")
    assert lines[2].startswith("        first")
    assert " ".join(lines[1:]).count("first") == 20


TRIP = Trip(500, 520, "stroke", "table_disp_m", 0.07, 0.06, "the table moved too far")


@pytest.mark.parametrize(
    ("items", "status", "expected", "absent"),
    [
        ([*records(), *stream()], {"silent_s": 65.0}, "no data for 0:01:05", "● running"),
        ([start(), TRIP, RunStop(520, "aborted", "too far")], {"silent_s": 65.0},
         "ended: aborted", "0:01:05"),
        ([start(), TRIP], {}, "protection (stroke): the table", "ended"),
        ([*records(), *stream(), Event(7990, "state", "holding")], {}, "until resumed", "left"),
        ([start(), *stream(64_000, 65_000)], {}, "100 %  0:00:05 over", "left"),
        ([replace(start(), steps=()), block(100)], {}, "window 4/0", "the steps"),
        ([start()], {}, "before the steps", "between"),
        ([start(), point(0)], {}, "between the steps", "before"),
        ([start()], {"may_command": False}, "q quit", "abort"),
        ([start()], {"pending_command": "stop"}, "stop the test?  y = yes", "abort"),
    ],
)  # fmt: skip
def test_screen_states_end_silence_hold_and_commands(
    items: list[Record | Block], status: dict[str, object], expected: str, absent: str
) -> None:
    shown = render(view(*items, status=replace(STATUS, **status)), 80, 24)  # type: ignore[arg-type]
    assert expected in shown
    assert absent not in shown


def test_level_tone_follows_tolerance_and_alarm() -> None:
    """2 % is the profile's tolerance and 10 % the alarm of the protection."""
    for factor, tone in ((1.01, "good"), (1.05, "warn"), (1.2, "bad")):
        blocks = [block(index) for index in range(6000, 8000, 20)]
        for measured in blocks:
            measured.values.setflags(write=True)
            measured.values[2] *= factor
        level = view(start(), *blocks).level
        assert level is not None
        assert level.current_g == pytest.approx(factor * LEVEL / 9.80665, rel=1e-3)
        assert level.tone == tone


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


def plot(points: list[tuple[float, float]], mark: str = "", width: int = 32) -> list[Text]:
    return plot_curves([PlotCurve("red", mark, points)], (0.0, 10.0), 2.0, width, 10, "Hz")


def find_dots(lines: list[Text]) -> set[tuple[int, int]]:
    """Return (row, column) of every character with a dot or a mark, without the axis."""
    rows = [re.split("[│┤]", line.plain, maxsplit=1)[1] for line in lines[:-2]]
    return {(row, column) for row, text in enumerate(rows)
            for column, letter in enumerate(text) if letter != " "}  # fmt: skip


def test_plot_puts_points_at_their_coordinates() -> None:
    corners = [(0.0, 0.0), (10.0, 0.0), (10.0, 2.0), (0.0, 2.0)]
    cells = [(7, 0, "⡀"), (7, 29, "⢀"), (0, 29, "⠈"), (0, 0, "⠁")]
    for corner, (row, column, letter) in zip(corners, cells, strict=True):
        lines = plot([corner])
        assert len(lines) == 10
        assert find_dots(lines) == {(row, column)}
        assert letter in lines[row].plain
    line = plot([(0.0, 0.0), (10.0, 2.0)])
    assert {row for row, _ in find_dots(line)} == set(range(8))
    assert line[-1].plain.split() == ["0", "5", "10", "Hz"]
    wild = plot([(-5.0, 1.0), (float("nan"), 1.0), (20.0, 9.0), (5.0, float("inf"))])
    assert all(line.cell_len <= 32 for line in wild)
    assert not find_dots(plot([]))
    assert [nice_ceil(number) for number in (0.9, 0.21, 3.2, 1000.0)] == pytest.approx(
        [1.0, 0.3, 4.0, 1000.0]
    )


def test_marks_of_a_curve_keep_their_distance() -> None:
    lines = plot([(k / 10, 1.0) for k in range(101)], "○", 40)
    row = next(line.plain for line in lines if "○" in line.plain)
    assert re.fullmatch(rf"[^○]*(○[^○]{{{MIN_MARK_SPACING - 1}}})+○?[^○]*", row)


def test_prc_grows_with_the_points_of_both_directions() -> None:
    before = panels.draw_prc(view(start(), point(0)), 60, 16)
    after = panels.draw_prc(view(start(), point(0), point(9)), 60, 16)
    assert len(find_dots(after)) > len(find_dots(before)) > 0
    styles = {str(span.style) for line in after for span in line.spans}
    assert {panels.FORWARD_COLOUR, panels.BACKWARD_COLOUR} <= styles
    assert panels.BACKWARD_COLOUR not in {str(span.style) for line in before for span in line.spans}
    assert "●" in "".join(line.plain for line in before)
    lost = view(start(), replace(point(0), measured=None, twin=None))
    assert not find_dots(panels.draw_prc(lost, 60, 16))


def test_received_texts_cannot_command_the_terminal() -> None:
    wild = Event(10, "order", "stop: \x1b[2J\x1b]0;mine\x07 by\tana\n\u202e")
    status = replace(STATUS, components=frozenset({"observer.a\x1b[5m.monitor-1"}))
    shown = view(replace(start(), name="a\x1b[31m"), wild, status=status)
    for size in SIZES:
        assert all(line.plain.isprintable() for line in draw_screen(shown, *size))


def test_whatever_decodes_from_damaged_bytes_is_drawn() -> None:
    chance = random.Random(7)
    sound = [*records(), *stream(7800), RunStop(8000, "complete", "all driven")]
    payloads = [(topic_for(item), encode_item(item, RUN)) for item in sound]
    state, taken = LiveRunState(), 0
    for turn in range(4000):
        state = state if turn % 400 else LiveRunState()
        topic, payload = chance.choice(payloads)
        damaged = bytearray(payload)
        for _ in range(chance.randrange(4)):
            damaged[chance.randrange(len(damaged))] = chance.randrange(256)
        try:
            run, item = decode_item(topic, bytes(damaged))
        except WireError:
            continue
        state, taken = update_run_state(state, run, item), taken + 1
        if turn % 40 == 0:
            for size in ((80, 24), (200, 60)):
                assert len(draw_screen(RunView(state, STATUS), *size)) == size[1]
    assert taken > 1000
