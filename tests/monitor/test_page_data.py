"""What the page gets: the numbers of the monitor, in JSON that every browser reads."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import RunStop
from tests.builders.blocks import recut_blocks
from tests.monitor.monitored import LEVEL, RATE, RUN, block, point, receive, records, start, stream
from twin.monitor.page_data import build_sections
from twin.monitor.recent import MAX_TRACE_POINTS, MAX_TRACE_S, TraceBuffer
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.monitor.run_view import RunView, SessionStatus
from twin.transport.codec import Item


def sections_of(state: LiveRunState, **status: Any) -> dict[str, Any]:
    return {
        name: json.loads(text, parse_constant=pytest.fail)
        for name, text in build_sections(RunView(state, SessionStatus(**status))).items()
    }


def predict(measured: Block, error_m: float) -> Block:
    """The twins' block over a measured one: u off by an error, the restarted one by a tenth."""
    mass, table = measured.channel("mass_disp_m"), measured.channel("table_disp_m")
    names, rows = [], []
    for name, share in (("free", 1.0), ("window", 0.1)):
        names += [f"{name}/mass_disp_m", f"{name}/table_disp_m"]
        rows += [mass + share * error_m, table]
    return replace(measured, stream="pred", channels=tuple(names), values=np.array(rows))


def test_the_page_has_the_numbers_of_the_monitor() -> None:
    sections = sections_of(receive(*records(), *stream()), components=frozenset({f"{RUN}.rig"}))
    state, level = sections["state"], sections["level"]
    assert (state["state"], state["tone"], state["step"], state["steps"]) == (
        "running",
        "good",
        4,
        10,
    )
    assert (state["progress"], state["left_s"]) == (pytest.approx(8 / 60, rel=1e-4), 52.0)
    assert state["components"] == ["rig"]
    assert level["current_g"] == pytest.approx(0.05, rel=1e-3)
    assert (level["alarm"], level["abort_db"], level["accepted"]) == (0.1, 6.0, True)
    margins = {row["name"]: row for row in sections["margins"]["rows"]}
    assert margins["force R1"] == {
        "name": "force R1", "peak": 4.0, "limit": 10.0, "unit": "kN", "share": 0.4,
        "tone": "good",
    }  # fmt: skip
    assert [row["name"] for row in sections["twin"]["rows"] if row["exceeds"]] == ["u rel"]
    assert sections["events"]["rows"][0]["level"] == "WARN"
    assert [row["component"] for row in sections["timing"]["rows"]] == ["rig", "twin"]


def test_the_curves_grow_point_by_point_up_and_back() -> None:
    state = receive(*records())
    prc = sections_of(state)["prc"]
    assert (prc["count"], prc["range_hz"]) == (3, [2.0, 4.0])
    assert prc["forecast"] == {"kind": "down", "jump_hz": 3.982, "low_hz": 3.91, "high_hz": 4.05}
    assert {curve["direction"] for curve in prc["curves"]} == {"forward"}
    for step in (3, 4, 5):
        update_run_state(state, RUN, point(step))
    curves = {
        (c["source"], c["direction"]): c["points"] for c in sections_of(state)["prc"]["curves"]
    }
    assert len(curves["measured", "forward"]) == 5
    assert curves["measured", "backward"] == [[4.0, pytest.approx(0.2)]]
    assert curves["twin", "backward"] == [[4.0, pytest.approx(0.24)]]


def test_the_last_cycles_are_shown_over_the_twin() -> None:
    items: list[Item] = [start()]
    for index in range(6000, 8000, 20):
        items += [block(index), predict(block(index), 1e-4)]
    trace = sections_of(receive(*items))["trace"]
    tracks = trace["tracks"]
    assert trace["span_s"] == pytest.approx(3 / 3.5, rel=1e-4)
    assert tracks["measured"]["t"][0] == pytest.approx(-trace["span_s"], abs=0.01)
    u = np.array([tracks[name]["u"] for name in ("measured", "free", "window")])
    assert np.allclose(u[1] - u[0], 0.1, atol=1e-4)
    assert np.allclose(u[2] - u[0], 0.01, atol=1e-4)
    assert np.ptp(u[0]) == pytest.approx(2e3 * LEVEL / (2 * math.pi * 3.5) ** 2, rel=1e-2)
    assert set(tracks["free"]["force"]) == {None}


def test_no_run_an_ended_one_and_a_silent_one_are_shown_as_such() -> None:
    assert sections_of(LiveRunState())["state"]["state"] == "waiting for a run"
    ended = receive(*records(), RunStop(8000, "stopped", "asked to stop"))
    state = sections_of(ended, silent_s=100.0)["state"]
    assert (state["ended"], state["tone"], state["reason"]) == (True, "bad", "asked to stop")
    silent = sections_of(receive(*records()), silent_s=65.0)["state"]
    assert (silent["tone"], "0:01:05" in silent["state"]) == ("bad", True)


def test_a_history_without_steps_has_no_curves() -> None:
    sections = sections_of(receive(replace(start(), steps=()), block(100)))
    assert sections["prc"]["range_hz"] is None
    assert sections["level"] == {}
    assert sections["trace"]["span_s"] == 2.0


@pytest.mark.parametrize("size", [1, 7, 64])
def test_traces_do_not_depend_on_the_blocks(size: int) -> None:
    whole, parts = TraceBuffer(), TraceBuffer()
    long = block(1000, 640)
    whole.add(long)
    for part in recut_blocks([long], size):
        parts.add(part)
    assert np.array_equal(
        whole.select_last(500)["measured"], parts.select_last(500)["measured"], equal_nan=True
    )


def test_traces_are_bounded_and_start_again_with_a_replay() -> None:
    traces = TraceBuffer()
    for index in range(0, int(2 * MAX_TRACE_S * RATE), 1000):
        traces.add(block(index, 1000))
    rows = traces.select_last(math.inf)["measured"]
    assert rows.shape[1] <= MAX_TRACE_POINTS
    assert np.ptp(rows[0]) <= (MAX_TRACE_S + 1) * RATE
    traces.add(block(0))
    assert traces.select_last(math.inf)["measured"][0].tolist() == [0, 5, 10, 15]
