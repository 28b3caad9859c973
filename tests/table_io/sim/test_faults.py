"""Planted faults: what each does to the samples, at which samples, however they are read."""

from typing import Any

import numpy as np
import pytest

from table_io.backends import SAMPLE_TIMEOUT_S, MachineLost
from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.config.base import parse_toml
from table_io.config.calibration import command_to_volts
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.config import FAULT_KINDS
from table_io.sim.faults import CONVERTER_NOISE_RATIO, VALVE_CLOSING_S
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import RIG, RIG_TEXT, make_faulty_rig

RATE_HZ = 2000.0
AT, FOR = 1.0005, 0.25  # s: not where reads begin
FIRST, LAST = 2001, 2501
ALL = (
    {"kind": "dropped", "for_s": FOR},
    {"kind": "repeated", "for_s": FOR},
    {"kind": "replayed", "for_s": FOR},
    {"kind": "late", "size": 0.1},
    {"kind": "stall"},
    {"kind": "stuck", "channel": "mass_disp_m", "for_s": FOR},
    {"kind": "cable_off", "channel": "mass_disp_m", "for_s": FOR},
    {"kind": "gain", "channel": "mass_disp_m", "size": -0.2, "for_s": FOR},
    {"kind": "polarity", "channel": "mass_disp_m", "for_s": FOR},
    {"kind": "rail", "channel": "mass_disp_m", "for_s": FOR},
    {"kind": "drift", "channel": "mass_disp_m", "size": 4.0, "for_s": FOR},
    {"kind": "spike", "channel": "mass_disp_m", "size": 20.0},
    {"kind": "nan", "channel": "mass_disp_m", "for_s": FOR},
    {"kind": "power_loss"},
    {"kind": "oil_loss", "size": 0.4},
)
MASS = RIG.channels.index("mass_disp_m")
VOLTS_PER_MM = 0.1


def command(seconds: float) -> Float1D:
    """Volts of a 2 Hz motion that grows from rest over half a second."""
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ
    metres = 4e-3 * np.minimum(2 * t, 1.0) ** 3 * np.sin(2 * np.pi * 2.0 * t)
    return command_to_volts(metres, RIG.output)


def start_backend(
    rig: RigConfig, seconds: float = 2.0, clock: ManualClock | None = None
) -> SimulatedBackend:
    """A backend that has started to play the motion."""
    backend = SimulatedBackend(rig, SPECIMEN, RATE_HZ, clock or ManualClock())
    backend.open()
    backend.queue(0, command(seconds))
    backend.start()
    return backend


def read(rig: RigConfig, cut: int = 4000) -> Float2D:
    """Two seconds, read in pieces."""
    backend = start_backend(rig)
    return np.concatenate([backend.read(min(cut, 4000 - at)) for at in range(0, 4000, cut)], axis=1)


def both(**fault: Any) -> tuple[Float2D, Float2D]:
    """(without the fault, with it), (channel, sample) in V."""
    return read(make_faulty_rig()), read(make_faulty_rig(({"at_s": AT, **fault},)))


def test_tested_faults_cover_every_kind() -> None:
    assert {fault["kind"] for fault in ALL} == set(FAULT_KINDS)


@pytest.mark.parametrize("fault", ALL, ids=[str(fault["kind"]) for fault in ALL])
@pytest.mark.parametrize("cut", [1, 7, 64, 500])
def test_cut_into_reads_changes_no_fault(fault: dict[str, Any], cut: int) -> None:
    if fault["kind"] == "stall":
        return
    if cut == 1 and fault["kind"] not in ("power_loss", "oil_loss", "repeated"):
        return  # what acts sample by sample has no more to show
    rig = make_faulty_rig(({"at_s": AT, **fault},))
    assert read(rig, cut).tobytes() == read(rig).tobytes()


@pytest.mark.parametrize(
    "fault",
    [fault for fault in ALL if fault["kind"] not in ("stall", "late")],
    ids=lambda f: f["kind"],
)
def test_nothing_happens_before_a_fault_and_something_at_it(fault: dict[str, Any]) -> None:
    sound, broken = both(**fault)
    np.testing.assert_array_equal(broken[:, :FIRST], sound[:, :FIRST])
    soon = slice(FIRST, FIRST + 200)
    assert not np.array_equal(broken[:, soon], sound[:, soon])


@pytest.mark.parametrize(
    "fault",
    [fault for fault in ALL if fault.get("channel") and "for_s" in fault],
    ids=lambda f: f["kind"],
)
def test_sensor_fault_is_its_channel_s_alone_and_ends(fault: dict[str, Any]) -> None:
    sound, broken = both(**fault)
    others = np.arange(len(sound)) != MASS
    np.testing.assert_array_equal(broken[others], sound[others])
    np.testing.assert_array_equal(broken[MASS, LAST:], sound[MASS, LAST:])


def test_sensor_faults_in_closed_form() -> None:
    inside = slice(FIRST, LAST)
    sound = read(make_faulty_rig())[MASS]

    def read_mass(**fault: Any) -> Float1D:
        row: Float1D = read(make_faulty_rig(({"at_s": AT, "channel": "mass_disp_m", **fault},)))[
            MASS
        ]
        return row

    assert (read_mass(kind="stuck")[FIRST:] == sound[FIRST - 1]).all()
    assert np.isnan(read_mass(kind="nan")[FIRST:]).all()
    assert (read_mass(kind="rail")[FIRST:] == 10.0).all()
    np.testing.assert_array_equal(read_mass(kind="polarity")[inside], -sound[inside])
    np.testing.assert_allclose(read_mass(kind="gain", size=0.25)[inside], 1.25 * sound[inside])
    off = read_mass(kind="cable_off")[FIRST:]
    assert off.std() == pytest.approx(CONVERTER_NOISE_RATIO * 10.0, rel=0.1)
    assert abs(off.mean()) < 5 * off.std() / np.sqrt(off.size)
    drift = read_mass(kind="drift", size=4.0)[inside] - sound[inside]
    np.testing.assert_allclose(drift, 4.0 * VOLTS_PER_MM * np.arange(500) / RATE_HZ, atol=1e-12)
    spike = read_mass(kind="spike", size=20.0) - sound
    assert np.flatnonzero(spike).tolist() == [FIRST]
    assert spike[FIRST] == pytest.approx(20.0 * VOLTS_PER_MM)


def test_fault_stays_within_the_range_of_the_converter() -> None:
    _, broken = both(kind="spike", channel="mass_disp_m", size=1e6)
    assert broken[MASS, FIRST] == 10.0
    _, broken = both(kind="gain", channel="mass_disp_m", size=1e6)
    assert np.abs(broken[MASS]).max() == 10.0


def test_stuck_sensor_at_the_very_start_stays_there() -> None:
    broken = read(make_faulty_rig(({"kind": "stuck", "channel": "mass_disp_m", "at_s": 0.0},)))
    assert (broken[MASS] == broken[MASS, 0]).all()


def test_dropped_block_keeps_its_place() -> None:
    sound, broken = both(kind="dropped", for_s=FOR)
    assert np.isnan(broken[:, FIRST:LAST]).all()
    np.testing.assert_array_equal(broken[:, LAST:], sound[:, LAST:])


def test_repeated_block_is_the_one_before_it() -> None:
    sound, broken = both(kind="repeated", for_s=FOR)
    np.testing.assert_array_equal(broken[:, FIRST:LAST], sound[:, FIRST - 500 : LAST - 500])
    np.testing.assert_array_equal(broken[:, LAST:], sound[:, LAST:])


def test_replayed_command_moves_the_table_again() -> None:
    sound, broken = both(kind="replayed", for_s=FOR)
    drive, table = 0, RIG.channels.index("table_disp_m")
    np.testing.assert_array_equal(broken[drive, FIRST:LAST], sound[drive, FIRST - 500 : LAST - 500])
    np.testing.assert_array_equal(broken[drive, LAST:], sound[drive, LAST:])
    late = slice(FIRST + 200, LAST)  # when the servo has followed
    before = slice(FIRST - 300, LAST - 500)
    np.testing.assert_allclose(broken[table, late], sound[table, before], atol=0.01)


def test_samples_come_late_by_the_size_and_only_once() -> None:
    clock = ManualClock()
    rig = make_faulty_rig(({"kind": "late", "at_s": AT, "size": 0.1},))
    backend = start_backend(rig, clock=clock)
    for at in range(0, 4000, 100):
        before = clock.now()
        backend.read(100)
        due = backend.scheduled_time_s(at + 99)
        late = clock.now() - due
        if at <= FIRST < at + 100:
            assert late == pytest.approx(0.1)
        else:
            assert clock.now() == max(due, before)


@pytest.mark.parametrize("fault", [{"kind": "stall"}, {"kind": "late", "size": 0.6}])
def test_machine_that_does_not_deliver_is_lost_after_its_patience(fault: dict[str, Any]) -> None:
    clock = ManualClock()
    backend = start_backend(make_faulty_rig(({"at_s": AT, **fault},)), clock=clock)
    backend.read(2000)
    with pytest.raises(MachineLost, match=rf"\b2099\b.* {SAMPLE_TIMEOUT_S:g} s"):
        backend.read(100)
    assert clock.now() == pytest.approx(backend.scheduled_time_s(2099) + SAMPLE_TIMEOUT_S)
    backend.queue(2099 + round(SAMPLE_TIMEOUT_S * RATE_HZ) + backend.replace_after + 1, np.zeros(1))
    if fault["kind"] == "stall":
        with pytest.raises(MachineLost):
            backend.read(100)


def test_without_power_the_table_stops_where_it_is() -> None:
    sound, broken = both(kind="power_loss")
    drive, table, acc = 0, RIG.channels.index("table_disp_m"), RIG.channels.index("table_acc_m_s2")
    np.testing.assert_array_equal(broken[drive], sound[drive])  # the command plays on
    stopped = broken[table, FIRST + 400 :] / VOLTS_PER_MM * 0.75
    assert np.ptp(stopped) < 0.1  # mm; the specimen still shakes the servo a little
    speed = 2 * np.pi * 2.0 * 4e-3  # m/s at most
    assert abs(broken[table, -1] - broken[table, FIRST]) * 7.5e-3 < speed * (VALVE_CLOSING_S + 0.03)
    assert np.abs(broken[acc]).max() / 5.0 < 0.5  # g: no jerk


def test_without_oil_the_bandwidth_falls() -> None:
    """At 2 Hz a servo of 20 Hz lags 15 ms, one of 8 Hz 31 ms."""
    sound, broken = both(kind="oil_loss", size=0.4)
    table = RIG.channels.index("table_disp_m")
    rig = make_faulty_rig(({"kind": "oil_loss", "at_s": 0.0, "size": 0.4},))
    long = start_backend(rig, 5.0).read(10000)[table, -2000:]
    fine = start_backend(make_faulty_rig(), 5.0).read(10000)[table, -2000:]
    turn = np.exp(-2j * np.pi * 2.0 * np.arange(2000) / RATE_HZ)
    lag = np.angle((fine @ turn) / (long @ turn)) / (2 * np.pi * 2.0)
    pole = 2 * np.pi * 20.0 / np.sqrt(np.sqrt(2.0) - 1)
    expected = (np.arctan(4 * np.pi / (0.4 * pole)) - np.arctan(4 * np.pi / pole)) / (2 * np.pi)
    assert lag == pytest.approx(expected, rel=0.03)
    assert (
        np.abs(broken - sound)[table, FIRST : FIRST + 20].max() < 1e-3
    )  # it falls, it does not jump


def refusal(text: str) -> str:
    card = RIG_TEXT
    with pytest.raises(InputError) as caught:
        parse_toml(f"{card}\n[[simulated.faults]]\n{text}\n", RigConfig, "rig.toml")
    return str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("kind = 'stuk'\nat_s = 1.0", "kind 'stuk' is unknown; did you mean 'stuck'?"),
        ("kind = 'xyzzy'\nat_s = 1.0", "known: dropped, repeated"),
        ("kind = 'stuck'\nat_s = 1.0", "needs channel (one of the rig's sensors); add it"),
        ("kind = 'gain'\nat_s = 1.0\nchannel = 'table_disp_m'", "needs size (relative error"),
        ("kind = 'dropped'\nat_s = 1.0", "needs for_s (seconds); add it"),
        ("kind = 'stall'\nat_s = 1.0\nfor_s = 1.0", "has no for_s; leave it out"),
        ("kind = 'stall'\nat_s = 1.0\nchannel = 'table_disp_m'", "has no channel; leave it out"),
        ("kind = 'late'\nat_s = 1.0\nsize = 0.0", "allowed: above 0 (seconds)"),
        ("kind = 'stall'\nat_s = -1.0", "faults.0.at_s = -1.0"),
        (
            "kind = 'rail'\nat_s = 1.0\nchannel = 'tabel_disp_m'",
            "fault 'rail': the rig has no sensor 'tabel_disp_m'; did you mean 'table_disp_m'?",
        ),
    ],
)
def test_wrong_fault_table_is_refused(text: str, says: str) -> None:
    assert says in refusal(text)


def test_fault_kinds_are_documented() -> None:
    from table_io.sim import faults

    assert faults.__doc__ is not None
    assert all(kind in faults.__doc__ for kind in FAULT_KINDS)
