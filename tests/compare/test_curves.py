"""Jumps and hysteresis from PRC points, as contracts.md words them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from table_io.records import NormalizedResponse, PrcPoint
from twin.compare.curves import (
    Hysteresis,
    PrcJump,
    Solutions,
    compare_amplitudes,
    detect_all_hysteresis,
    detect_hysteresis,
    find_sudden_change,
)
from twin.model.parameters import Parameters, free_flight_resonance
from twin.model.stepped_sine import simulate_stepped_sine
from twin.results.paper_cases import load_paper_cases

GRID = tuple(round(2.0 + 0.1 * k, 9) for k in range(21))
LEVEL = 0.05 * 9.80665
Curve = Callable[[float], float]


def make_response(
    eta_d: float,
    spread: float = 0.002,
    eta_a: float = 1.0,
    spread_a: float | None = 0.002,
    impacts: tuple[int, ...] = (0, 0, 0),
) -> NormalizedResponse:
    return NormalizedResponse(
        eta_d, eta_a, 0.0, 0.0, 0.0, 0.0, impacts, impacts, 0.0, spread, spread_a
    )


def point(
    direction: str, hz: float, values: NormalizedResponse | None, source: str = "measured"
) -> PrcPoint:
    pair = {"measured": None, "twin": None, source: values}
    return PrcPoint(0, 0, direction, hz, pair["measured"], pair["twin"], LEVEL, LEVEL, 0.0)


def sweep(
    forward: Curve, backward: Curve, grid: Sequence[float] = GRID, source: str = "measured"
) -> list[PrcPoint]:
    """Points in driving order, up and back, with 0.4 % of scatter between the directions."""
    rng = np.random.default_rng(1)
    return [
        point(direction, hz, make_response(curve(hz) * (1 + 0.002 * rng.standard_normal())), source)
        for direction, curve, ordered in (
            ("forward", forward, grid),
            ("backward", backward, grid[::-1]),
        )
        for hz in ordered
    ]


def upper(hz: float) -> float:
    return 0.1 * hz


def lower(hz: float) -> float:
    return 0.15 / hz


def hardening(jump_hz: float) -> Curve:
    """On the upper branch below the jump, on the lower one from there on."""
    return lambda hz: upper(hz) if hz < jump_hz else lower(hz)


def softening(jump_hz: float) -> Curve:
    return lambda hz: lower(hz) if hz < jump_hz else 0.6 / hz


RIGHT = (
    [PrcJump("forward", 3.5, 3.6, "down"), PrcJump("backward", 2.7, 2.6, "up")],
    [Hysteresis("right", 2.7, 3.5)],
)


@pytest.mark.parametrize("source", ["measured", "twin"])
def test_right_hysteresis(source: str) -> None:
    points = sweep(hardening(3.55), hardening(2.65), source=source)
    assert detect_hysteresis(points, source) == RIGHT
    assert detect_hysteresis(points, "twin" if source == "measured" else "measured") == ([], [])


@pytest.mark.parametrize(
    ("branch", "forward", "backward", "kinds"),
    [
        (softening, (3.5, 3.6), (2.7, 2.6), ("left", "up", "down")),
        (hardening, (3.9, 4.0), (2.1, 2.0), ("right", "down", "up")),  # to the ends of the grid
    ],
)
def test_hysteresis_lies_between_its_jumps(branch, forward, backward, kinds) -> None:
    points = sweep(branch(sum(forward) / 2), branch(sum(backward) / 2))
    assert detect_hysteresis(points, "measured") == (
        [
            PrcJump("forward", forward[0], forward[1], kinds[1]),
            PrcJump("backward", backward[0], backward[1], kinds[2]),
        ],
        [Hysteresis(kinds[0], backward[0], forward[0])],
    )


def test_the_order_of_the_points_does_not_matter() -> None:
    points = sweep(hardening(3.55), hardening(2.65))
    assert detect_hysteresis(points[::-1], "measured") == RIGHT


def test_no_hysteresis_where_the_directions_agree() -> None:
    """A steep branch, even a jump that both directions make at the same place, is none."""
    assert detect_hysteresis(sweep(upper, upper), "measured") == ([], [])
    assert detect_hysteresis(sweep(hardening(3.05), hardening(3.05)), "measured") == ([], [])


def test_a_smooth_difference_is_no_hysteresis() -> None:
    """A gap that opened between the directions: 20 % everywhere, and no jump."""
    assert detect_hysteresis(sweep(upper, lambda hz: 1.2 * upper(hz)), "measured") == ([], [])


def test_two_hystereses() -> None:
    """A left one at the precompressed contact and a right one above it."""

    def forward(hz: float) -> float:
        return lower(hz) if hz < 2.45 else hardening(3.55)(hz)

    def backward(hz: float) -> float:
        return lower(hz) if hz < 2.15 else hardening(3.15)(hz)

    _, intervals = detect_hysteresis(sweep(forward, backward), "measured")
    assert intervals == [Hysteresis("left", 2.2, 2.4), Hysteresis("right", 3.2, 3.5)]


def test_hysteresis_that_reaches_the_lower_edge() -> None:
    jumps, intervals = detect_hysteresis(sweep(hardening(3.55), lower), "measured")
    assert intervals == [Hysteresis("right", 2.0, 3.5)]
    assert jumps == [PrcJump("forward", 3.5, 3.6, "down")]


def test_hysteresis_that_reaches_the_upper_edge() -> None:
    """The jump came while the highest frequency was held: the way back begins below."""
    jumps, intervals = detect_hysteresis(sweep(upper, hardening(2.65)), "measured")
    assert intervals == [Hysteresis("right", 2.7, 4.0)]
    assert jumps == [PrcJump("backward", 2.7, 2.6, "up")]


def test_missing_points_are_bridged() -> None:
    points = [
        point
        for point in sweep(hardening(3.55), hardening(2.65))
        if (point.direction, point.frequency_hz) not in {("forward", 3.0), ("backward", 2.6)}
    ]
    points.append(point("forward", 3.0, None))
    jumps, intervals = detect_hysteresis(points, "measured")
    assert intervals == RIGHT[1]
    assert jumps == [RIGHT[0][0], PrcJump("backward", 2.7, 2.5, "up")]


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_one_direction_alone_has_no_hysteresis(direction: str) -> None:
    points = sweep(hardening(3.55), hardening(2.65))
    assert detect_hysteresis(
        [point for point in points if point.direction == direction], "measured"
    ) == (
        [],
        [],
    )


def test_detect_hysteresis_without_points() -> None:
    assert detect_hysteresis([], "measured") == ([], [])


@pytest.mark.parametrize("seed", range(30))
def test_chaotic_scatter_is_no_hysteresis(seed: int) -> None:
    """Cycles of 10 % scatter, three to a point: the directions differ, but nothing jumps."""
    rng = np.random.default_rng(seed)
    points = []
    for direction in ("forward", "backward"):
        for hz in GRID:
            etas = 0.3 * (1 + 0.1 * rng.standard_normal(3))
            points.append(
                point(direction, hz, make_response(etas.mean(), float(np.ptp(etas) / etas.mean())))
            )
    assert detect_hysteresis(points, "measured") == ([], [])


# Judged by eta_a and by impact counts as well

Motion = Callable[[float], NormalizedResponse]


def both(forward: Motion, backward: Motion, grid: Sequence[float] = GRID) -> list[PrcPoint]:
    return [
        point(direction, hz, motion(hz))
        for direction, motion, ordered in (
            ("forward", forward, grid),
            ("backward", backward, grid[::-1]),
        )
        for hz in ordered
    ]


def branches(
    jump_hz: float, above: NormalizedResponse, below: NormalizedResponse
) -> Callable[[float], NormalizedResponse]:
    return lambda hz: below if hz < jump_hz else above


def test_a_hysteresis_of_eta_a_alone() -> None:
    """eta_d differs by 8 %, eta_a by 18 %: below the jump the smaller acceleration."""
    below, above = make_response(0.108, eta_a=0.69), make_response(0.1175, eta_a=0.84)
    points = both(branches(3.55, above, below), branches(2.65, above, below))
    assert detect_hysteresis(points, "measured") == (
        [PrcJump("forward", 3.5, 3.6, "up"), PrcJump("backward", 2.7, 2.6, "down")],
        [Hysteresis("left", 2.7, 3.5)],
    )


@pytest.mark.parametrize(
    ("below", "above", "is_found"),
    [
        # 5 % in eta_a, and one impact more in every cycle
        (make_response(0.115, eta_a=0.80, impacts=(2, 2, 2)),
         make_response(0.116, eta_a=0.84, impacts=(1, 1, 1)), True),
        # the same with a cycle that has as many impacts as the others
        (make_response(0.115, eta_a=0.80, impacts=(2, 1, 2)),
         make_response(0.116, eta_a=0.84, impacts=(1, 1, 1)), False),
        # a grazing contact more: the count, but neither eta
        (make_response(0.115, eta_a=0.80, impacts=(1, 1, 1)),
         make_response(0.116, eta_a=0.81, impacts=(0, 0, 0)), False),
        # 5 % in eta_a are within its scatter
        (make_response(0.115, eta_a=0.80, spread_a=0.03, impacts=(2, 2, 2)),
         make_response(0.116, eta_a=0.84, spread_a=0.03, impacts=(1, 1, 1)), False),
        # an old recording without the scatter of eta_a: eta_d alone
        (make_response(0.115, eta_a=0.50, spread_a=None), make_response(0.116, eta_a=0.84), False),
        # a lost load cell: no counts
        (make_response(0.115, eta_a=0.80, impacts=()), make_response(0.116, eta_a=0.84), False),
        # a lost accelerometer
        (make_response(0.115, eta_a=math.nan, spread_a=math.nan),
         make_response(0.116, eta_a=0.84), False),
    ],
)  # fmt: skip
def test_impact_counts_decide_on_a_small_difference_beyond_its_scatter(
    below: NormalizedResponse, above: NormalizedResponse, is_found: bool
) -> None:
    points = both(branches(3.55, above, below), branches(2.65, above, below))
    assert bool(detect_hysteresis(points, "measured")[1]) == is_found


def test_one_grid_frequency_is_no_interval_but_its_two_jumps_are_jumps() -> None:
    jumps, intervals = detect_hysteresis(sweep(hardening(3.05), hardening(2.95)), "measured")
    assert intervals == []
    assert jumps == [PrcJump("forward", 3.0, 3.1, "down"), PrcJump("backward", 3.0, 2.9, "up")]


def test_one_outlying_point_is_nothing() -> None:
    """The backward sweep is low at one frequency: it changes twice, the forward sweep never."""
    points = sweep(upper, lambda hz: (0.7 if hz == 3.0 else 1.0) * upper(hz))
    assert detect_hysteresis(points, "measured") == ([], [])


def test_a_difference_that_fades_on_a_steep_flank_is_no_hysteresis() -> None:
    """A specimen that warmed up: its resonance is lower on the way back, and nothing jumps."""

    def resonance(peak_hz: float) -> Curve:
        return lambda hz: 0.02 / math.hypot(1 - (hz / peak_hz) ** 2, 0.25 * hz / peak_hz)

    points = sweep(resonance(3.0), resonance(2.9), [round(2.0 + 0.1 * k, 9) for k in range(21)])
    pairs = {hz: resonance(3.0)(hz) / resonance(2.9)(hz) for hz in (2.7, 3.3)}
    assert pairs[3.3] > 1.1
    assert detect_hysteresis(points, "measured") == ([], [])


@pytest.mark.parametrize("noise", [0.002, 0.03, 0.15])
def test_noise_of_a_healthy_sweep_is_no_hysteresis_of_eta_a(noise: float) -> None:
    """Three noisy cycles a point, and a grazing contact that is counted or not."""

    def noisy(hz: float) -> NormalizedResponse:
        eta_d = 0.1 * hz * (1 + 0.1 * noise * rng.standard_normal(3))
        eta_a = 0.3 * hz * (1 + noise * rng.standard_normal(3))
        return make_response(
            float(eta_d.mean()), float(np.ptp(eta_d) / eta_d.mean()), float(eta_a.mean()),
            float(np.ptp(eta_a) / eta_a.mean()), tuple(rng.integers(1, 3, 3).tolist()),
        )  # fmt: skip

    for seed in range(100):
        rng = np.random.default_rng(seed)
        assert detect_hysteresis(both(noisy, noisy), "measured") == ([], []), seed


# The model's own sweeps: ten cycles a step, the last three measured


def swept(gap_m: float, start_hz: float, stop_hz: float) -> list[PrcPoint]:
    p = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, gap_m / 2, gap_m / 2)
    grid = [round(start_hz + 0.1 * k, 9) for k in range(round((stop_hz - start_hz) * 10) + 1)]
    driven = simulate_stepped_sine(p, [*grid, *grid[::-1]], LEVEL, 10)
    u_star, _, _ = free_flight_resonance(p, LEVEL)
    etas = (driven.column("u_max") - driven.column("u_min"))[:, -3:] / (2 * u_star)
    return [
        point("forward" if k < len(grid) else "backward", hz,
              make_response(row.mean(), float(np.ptp(row) / row.mean())))
        for k, (hz, row) in enumerate(zip([*grid, *grid[::-1]], etas, strict=True))
    ]  # fmt: skip


def test_g4_has_the_right_hysteresis_of_the_paper_and_none_in_its_chaos() -> None:
    """physics.md: fold 4.027 Hz, passed at 4.1 to 4.3 in ten cycles; up-jump 2.787 Hz."""
    jumps, (interval,) = detect_hysteresis(swept(0.004, 0.5, 5.0), "measured")
    assert interval.kind == "right"
    # at 2.8 Hz, 0.01 Hz above the up-jump, the transient of a step may tip it
    assert interval.from_hz in {2.8, 2.9}
    assert interval.to_hz in {4.1, 4.2, 4.3}
    down, up = jumps
    assert (down.direction, down.kind, down.from_hz) == ("forward", "down", interval.to_hz)
    assert (up.direction, up.kind, up.from_hz) == ("backward", "up", interval.from_hz)
    assert up.to_hz == pytest.approx(up.from_hz - 0.1)


def test_g4_has_a_left_hysteresis_at_its_secondary_resonance() -> None:
    """The model's 0.902 to 1.010 Hz on the grid of SS2, in which eta_d differs by 8 % at 1.0 Hz."""
    test = load_paper_cases()["G4"].tests[1]
    jumps, intervals = detect_hysteresis(test.points, "twin")
    assert intervals == [Hysteresis("left", 0.95, 1.0)]
    assert jumps == [
        PrcJump("forward", 1.0, 1.05, "up"),
        PrcJump("backward", 0.95, 0.9, "down"),
    ]


def test_g0_has_no_hysteresis() -> None:
    assert detect_hysteresis(swept(0.0, 3.0, 7.0), "measured") == ([], [])


def test_gm2_has_a_left_hysteresis_in_the_model() -> None:
    """physics.md: SNM detaches at G-2, hysteresis 5.81 to 6.15 Hz (the rig does not)."""
    jumps, (interval,) = detect_hysteresis(swept(-0.002, 4.5, 7.5), "measured")
    assert interval.kind == "left"
    assert 5.7 <= interval.from_hz <= 5.9
    assert 6.0 <= interval.to_hz <= 6.2
    assert {(jump.direction, jump.kind) for jump in jumps} == {
        ("forward", "up"),
        ("backward", "down"),
    }


# The hint while a test runs


@pytest.mark.parametrize(
    ("before", "after", "change"),
    [
        ((4.0, 0.2), (4.2, 0.03), -1),
        ((4.2, 0.03), (4.0, 0.2), 1),
        ((4.0, 0.2), (4.1, 0.15), 0),
        ((4.0, 0.2), (4.2, 0.0), 0),
        ((4.0, 0.2), (4.2, math.nan), 0),
    ],
)
def test_a_sudden_change_is_a_ratio_that_no_smooth_branch_reaches(
    before: tuple[float, float], after: tuple[float, float], change: int
) -> None:
    first, second = (point("forward", hz, make_response(eta)) for hz, eta in (before, after))
    assert find_sudden_change(first, second, "measured") == change


def test_a_sudden_change_needs_two_points_of_one_direction() -> None:
    a = point("forward", 4.0, make_response(0.2))
    assert find_sudden_change(None, a, "measured") == 0
    assert find_sudden_change(a, point("backward", 4.2, make_response(0.03)), "measured") == 0
    assert find_sudden_change(a, point("forward", 4.2, None), "measured") == 0
    assert find_sudden_change(point("forward", 4.0, None), a, "measured") == 0


@pytest.mark.parametrize(("eta", "is_apart"), [(1.05, False), (1.3, True), (0.2, True)])
def test_amplitudes_beyond_a_tenth_and_the_scatter_are_different_solutions(
    eta: float, is_apart: bool
) -> None:
    first, second = (replace(make_response(value), spread=0.05) for value in (1.0, eta))
    assert (compare_amplitudes(first, second) > 1) == is_apart
    assert compare_amplitudes(first, second, allowance=1.0) < 1


def test_many_sweeps_at_once_are_judged_as_one_by_one() -> None:
    """Sweeps with and without hysteresis, a jump at every place, in one array."""
    forwards: list[Curve] = [upper, lower, *(high_until(hz) for hz in GRID[2:-2:3])]
    sweeps = [sweep(forward, lower) for forward in forwards]
    columns = [
        [
            Solutions.from_responses(
                [p.measured for p in sorted(points, key=lambda p: p.frequency_hz)
                 if p.direction == direction and p.measured is not None]
            )
            for points in sweeps
        ]
        for direction in ("forward", "backward")
    ]  # fmt: skip
    forward, backward = (
        Solutions(*(np.stack(rows) for rows in zip(*solutions, strict=True)))
        for solutions in columns
    )
    together = detect_all_hysteresis(GRID, forward, backward)
    assert [together[index,] for index in range(len(sweeps))] == [
        detect_hysteresis(points, "measured") for points in sweeps
    ]
    assert sum(bool(jumps) for jumps, _ in together.values()) >= 4


def high_until(jump_hz: float) -> Curve:
    return lambda hz: upper(hz) if hz <= jump_hz else lower(hz)
