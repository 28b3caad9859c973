"""Pre-flight margins against closed forms, refusals that name step and limit, limits of a block."""

import math
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.card import PROFILES, BadInput, load
from table_io.course import plan
from table_io.limits import Margin, margins, refuse, tripped, warnings
from table_io.profile import Profile
from table_io.rig import Rig
from table_io.units import GRAVITY_M_S2

RIG = load(PROFILES / "rigs" / "simulated.toml", Rig, "machine card")[0]
A = 0.05 * GRAVITY_M_S2


def rig(table: str = "limits", **changes: float) -> Rig:
    """The machine card with other values in one of its tables."""
    raw = RIG.model_dump()
    raw[table].update(changes)
    return Rig.model_validate(raw)


def profile(start_hz: float = 0.5, stop_hz: float = 10.0, **acquisition: Any) -> Profile:
    """A test of two steps, up and down."""
    sweep = {"start_hz": start_hz, "stop_hz": stop_hz, "step_hz": stop_hz - start_hz, "cycles": 3}
    return Profile.model_validate(
        {
            "title": "limits",
            "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
            "sweep": sweep,
            "acquisition": acquisition,
        }
    )


def rows(test: Profile, card: Rig = RIG) -> tuple[Margin, ...]:
    return margins(plan(test), test, card)


def refusal(test: Profile, card: Rig) -> list[str]:
    with pytest.raises(BadInput) as caught:
        refuse(rows(test, card), test, card, "a.toml")
    head, *faults = str(caught.value).splitlines()
    assert head == "a.toml: the table 'simulated' cannot do this test; nothing was started"
    return [fault.strip() for fault in faults]


def block(**rows_si: Any) -> Block:
    """Ten samples from 100 on; every channel that is not given rests."""
    values = np.zeros((len(RIG.channels), 10))
    for name, samples in rows_si.items():
        values[RIG.channels.index(name)] = samples
    nothing = np.full(10, -1, dtype=np.int64)
    return Block("meas", 100, 2000.0, RIG.channels, values, nothing, nothing + 1, nothing)


def at(place: int, value: float) -> np.ndarray:
    samples = np.zeros(10)
    samples[place] = value
    return samples


def test_margins_agree_with_closed_forms() -> None:
    first, second, third, fourth = rows(profile(1.0, 5.0))
    assert [row.step for row in (first, second, third, fourth)] == [0, 1, 2, 3]
    assert [row.direction for row in (first, fourth)] == ["forward", "backward"]
    w = 2 * math.pi * 1.0
    for row in (first, fourth):  # the largest of held cycles and blends: never less than held
        assert row.displacement_m == pytest.approx(A / w**2, rel=2e-3)
        assert A / w * 0.9999 <= row.velocity_m_s <= 1.05 * A / w
        assert A * 0.9999 <= row.acceleration_m_s2 <= 1.05 * A
        assert row.force_n == pytest.approx((2000.0 + 550.0) * row.acceleration_m_s2)
        assert row.lsb == pytest.approx(A / w**2 / (0.12 / 2**18))
    # The turn repeats 5 Hz without a blend, so its margins are those of held cycles alone.
    w = 2 * math.pi * 5.0
    assert third.displacement_m == pytest.approx(A / w**2, rel=1e-3)
    assert third.velocity_m_s == pytest.approx(A / w, rel=1e-3)
    assert third.acceleration_m_s2 == pytest.approx(A, rel=1e-3)


def test_a_16_bit_output_of_100_mm_has_41_steps_left_at_10_hz() -> None:
    card = rig("output", span_mm=100.0, bits=16, least_lsb=1)
    row = rows(profile(), card)[1]
    held_mm = 1e3 * A / (2 * math.pi * 10.0) ** 2
    assert held_mm == pytest.approx(0.124, abs=5e-4)
    assert card.output.lsb_m == pytest.approx(200e-3 / 65536)
    assert row.lsb == pytest.approx(held_mm * 1e-3 / (200e-3 / 65536))
    assert round(row.lsb) == 41
    (warning,) = warnings(rows(profile(), card), card)
    assert "2 steps have an amplitude below 100 DAC steps (least: 41 at 10 Hz)" in warning
    assert warnings(rows(profile()), RIG) == []


@pytest.mark.parametrize(
    ("table", "changes", "parts"),
    [
        ("limits", {"stroke_mm": 40.0}, ("step 0 (0.5 Hz forward)", "displacement 49.6", "40 mm")),
        ("output", {"span_mm": 45.0}, ("step 0 (0.5 Hz forward)", "displacement 49.6", "45 mm")),
        ("limits", {"velocity_mm_s": 100.0}, ("(0.5 Hz ", "velocity 15", "100 mm/s")),
        ("limits", {"acceleration_g": 0.04}, ("acceleration 0.05", "at most 0.04 g")),
        ("limits", {"force_kn": 1.0}, ("force 1.2", "at most 1 kN")),
        ("limits", {"frequency_hz": 9.0}, ("sweep.stop_hz 10 Hz", "at most 9")),
        ("output", {"bits": 12}, ("step 1 (10 Hz)", "4.2 steps of the DAC", "at least 20")),
    ],
    ids=["stroke", "span", "velocity", "acceleration", "force", "frequency", "resolution"],
)
def test_a_refusal_names_the_step_and_the_limit(
    table: str, changes: dict[str, float], parts: tuple[str, ...]
) -> None:
    (fault,) = refusal(profile(), rig(table, **changes))
    for part in parts:
        assert part in fault


def test_a_rate_that_the_card_does_not_have_is_refused() -> None:
    (fault,) = refusal(profile(rate_hz=1500.0), RIG)
    assert fault == "acquisition.rate_hz 1500 Hz; allowed: 1000, 2000, 4000"


def test_all_limits_that_are_exceeded_stand_in_one_refusal() -> None:
    card = rig(stroke_mm=1.0, velocity_mm_s=1.0, acceleration_g=0.01, force_kn=0.1)
    faults = refusal(profile(rate_hz=1500.0), card)
    assert len(faults) == 5


def test_what_is_just_allowed_is_not_refused() -> None:
    asked = rows(profile())
    card = rig(
        stroke_mm=max(row.displacement_m for row in asked) * 1e3 * (1 + 1e-9),
        force_kn=max(row.force_n for row in asked) * 1e-3 * (1 + 1e-9),
    )
    refuse(rows(profile(), card), profile(), card, "a.toml")


def test_a_quiet_block_does_not_trip() -> None:
    assert tripped(block(table_disp_m=0.0599, table_acc_m_s2=-9.8), RIG) is None
    # What the specimen does is not the table's business.
    assert tripped(block(mass_disp_m=5.0, mass_acc_m_s2=np.nan), RIG) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_trip_names_channel_sample_value_and_limit(sign: float) -> None:
    reason = tripped(block(table_disp_m=at(3, sign * 0.0612)), RIG)
    assert reason == "table_disp_m = 61.2 mm at sample 103 exceeds 60 mm"
    reason = tripped(block(table_acc_m_s2=at(9, sign * 1.25 * GRAVITY_M_S2)), RIG)
    assert reason == "table_acc_m_s2 = 1.25 g at sample 109 exceeds 1 g"


@pytest.mark.parametrize("name", ["table_disp_m", "table_acc_m_s2"])
def test_a_table_sensor_that_is_lost_trips(name: str) -> None:
    assert tripped(block(**{name: np.nan}), RIG) == f"{name} is lost from sample 100 on"


def test_one_lost_sample_neither_trips_nor_hides_the_next() -> None:
    assert tripped(block(table_disp_m=at(2, np.nan)), RIG) is None
    both = at(2, np.nan) + at(5, 0.07)
    assert "at sample 105" in str(tripped(block(table_disp_m=both), RIG))
