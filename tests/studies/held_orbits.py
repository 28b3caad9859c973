"""Continuations and backbones: starts anywhere, the bound that `check` states, stops on the way.

    python -m tests.studies.held_orbits starts --count 40     start_hz over 2.75 to 4.1 Hz, two rigs
    python -m tests.studies.held_orbits bounds --count 20     profiles, on each of three rigs
    python -m tests.studies.held_orbits stops --count 20      at random samples, on three rigs
    python -m tests.studies.held_orbits releases --count 20   the same, within a release

The command is read where it is written to the rig, so its acceleration is exact.
"""

import argparse
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np

from table_io.acquisition.session import OperatorCommand, find_take_back, run_session
from table_io.backends import open_backend
from table_io.block import Block, Float1D
from table_io.clock import ManualClock
from table_io.control.orbit_feedback import MAX_COMMAND_RATIO, ReferenceSegment
from table_io.errors import InputError
from table_io.records import Event, OrbitPoint, RunStop
from table_io.sequencer.releases import advance_releases
from table_io.sequencer.state import SequencerState
from twin.setup.run_config import RunConfig, read_run_config

RIGS = ("simulated", "hydraulic", "slow_clock")
PROFILE = """
title = "held orbits"
rig = "{rig}"
model = "snm"
[specimen]
mass_kg = 550.0
gap_mm = {gap}
[excitation]
kind = "{kind}"
start_hz = {start}
stop_hz = {stop}
acceleration_g = {level}
points = {points}
{extra}
"""
REST_M = 1e-6


@dataclass(frozen=True)
class HeldTest:
    """A played test: its orbits, how it ended, the command in m, and what `check` bounds of it."""

    accepted: int
    planned: int
    verdict: str
    reason: str
    command_m: Float1D
    rate_hz: float
    level_m_s2: float  # the largest of the plan
    plateau_m_s2: float  # the largest command that was held, corrected for the table's gain
    bound_ratio: float  # by `check`, of the peak over the plateau
    is_whole: bool  # every sample was delivered
    rejections: tuple[str, ...]  # of orbits, with their reasons

    @property
    def peak_ratio(self) -> float:
        """Peak acceleration of the command over the plateau."""
        peak_m_s2 = float(np.abs(np.diff(self.command_m, 2)).max() * self.rate_hz**2)
        return peak_m_s2 / self.plateau_m_s2

    def rests(self, within_s: float, from_sample: int) -> bool:
        """Return whether the command is at rest so soon after a sample, and stays there."""
        moving = np.flatnonzero(np.abs(self.command_m) > REST_M)
        return bool(moving[-1] < from_sample + within_s * self.rate_hz)


def play(
    config: RunConfig, operate: Callable[[int], OperatorCommand | None] = lambda _: None
) -> HeldTest:
    """Play a test unpaced. `operate` is asked with the number of samples so far."""
    clock, rig = ManualClock(), config.rig
    backend = open_backend(rig, config.profile, clock)
    written, end = np.zeros(1 << 20), 0
    queue = backend.queue

    def record(index: int, volts: Float1D) -> None:
        nonlocal written, end
        last = index + volts.size
        while last > written.size:
            written = np.concatenate([written, np.zeros(written.size)])
        written[index:last] = volts
        written[last:end] = volts[-1]  # held until more is queued
        end = last
        queue(index, volts)

    backend.queue = record  # type: ignore[method-assign]
    progress = [0]  # samples so far
    accepted, stop, is_whole, held_m_s2 = 0, None, True, list[float]()
    rejections: list[str] = []

    def hold(*arguments: Any) -> ReferenceSegment:
        segment = ReferenceSegment(*arguments)
        held_m_s2.append(segment.max_acceleration_m_s2 / MAX_COMMAND_RATIO)
        return segment

    with patch("table_io.sequencer.orbits.ReferenceSegment", hold):
        for item in run_session(
            config.session_setup, backend, clock, config.make_start_factory("held", "table"),
            lambda: operate(progress[0]), take_back=find_take_back(backend, clock),
        ):  # fmt: skip
            if isinstance(item, Block):
                is_whole &= item.index == progress[0]
                progress[0] = item.end
            elif isinstance(item, OrbitPoint):
                accepted += item.accepted
                if not item.accepted:
                    orbit = f"orbit {item.step} at {item.frequency_hz:.3f} Hz"
                    rejections.append(f"{orbit}, {item.reason}")
            elif isinstance(item, Event) and item.kind == "lost":
                rejections.append(item.text)
            elif isinstance(item, RunStop):
                stop = item
    assert stop is not None
    written[end:] = written[end - 1]
    samples = progress[0]
    continuation = config.profile.continuation
    assert continuation is not None
    orbits = continuation.orbit_plan.points
    level_m_s2 = max(orbit.acceleration_m_s2 for orbit in orbits)
    bound_m_s2 = max(row.acceleration_m_s2 for row in config.margins if row.step >= 0)
    command_m = written[:samples] * rig.output.span_mm * 1e-3 / rig.output.span_v
    return HeldTest(
        accepted, len(orbits), stop.verdict, stop.reason, command_m, config.drive.rate_hz,
        level_m_s2, max(held_m_s2, default=level_m_s2), bound_m_s2 / level_m_s2,
        is_whole and stop.index == samples, tuple(rejections),
    )  # fmt: skip


def read(folder: Path, rig: str = "simulated", **keys: object) -> RunConfig:
    values = {"gap": 4.0, "kind": "continuation", "start": 2.75, "stop": 4.1, "level": 0.05,
              "points": 4, "extra": "", **keys}  # fmt: skip
    if rig == "slow_clock":
        rig, values["extra"] = "simulated", f"{values['extra']}\n[acquisition]\nrate_hz = 1000.0"
    path = folder / "held.toml"
    path.write_text(PROFILE.format(rig=rig, **values))
    return read_run_config(path)


def try_starts(folder: Path, count: int, points: int) -> None:
    reached = refused = 0
    starts = np.linspace(2.75, 4.1, count)
    for index, start in enumerate(starts.tolist()):
        for rig in RIGS[:2]:
            try:
                config = read(folder, rig, start=round(start, 3), stop=4.2, points=points,
                              extra="multiplier_periods = 0")  # fmt: skip
                test = play(config)
            except InputError as error:
                refused += 1
                print(f"{index:>3} {rig} {start:.3f} Hz refused: {error}", flush=True)
                continue
            is_reached = test.accepted >= 0.95 * test.planned
            reached += is_reached
            print(
                f"{index:>3} {rig} {start:.3f} Hz {test.accepted} of {test.planned}, "
                f"{test.verdict} {test.reason if not is_reached else ''}",
                *(() if is_reached else test.rejections), sep="\n    ", flush=True,
            )  # fmt: skip
    print(f"{reached} reached, {refused} refused before motion, of {2 * count}")


def try_bounds(folder: Path, count: int, seed: int, span_hz: float) -> None:
    rng, ratios, above = np.random.default_rng(seed), [], 0
    for index in range(count):
        kind = "backbone" if index % 3 == 2 else "continuation"
        level = round(float(rng.uniform(0.03, 0.06)), 4)
        gap = round(float(rng.uniform(3.5, 5.0)), 2)
        keys = {"kind": kind, "level": level, "gap": gap, "points": int(rng.integers(2, 5))}
        if kind == "backbone":
            keys |= {"start": 1.3, "stop": 4.5, "extra": f"min_acceleration_g = {0.6 * level:.4f}"}
        else:  # a part of the branch
            start = round(float(rng.uniform(2.6, 3.4)), 2)
            keys |= {"start": start, "stop": start + span_hz, "extra": "multiplier_periods = 16"}
        for rig in RIGS:
            try:
                config = read(folder, rig, **keys)
                test = play(config)
            except InputError as error:
                print(f"{index:>3} {rig} {keys} refused: {error}", flush=True)
                continue
            ratios.append(test.bound_ratio)
            above += test.peak_ratio > test.bound_ratio
            print(
                f"{index:>3} {rig} {kind} {level:g} g, {gap:g} mm: peak {test.peak_ratio:.3f}, "
                f"bound {ratios[-1]:.3f} of the plateau, which is "
                f"{test.plateau_m_s2 / test.level_m_s2:.3f} of the level, "
                f"{test.accepted} of {test.planned}, {test.verdict}",
                *((test.reason,) if test.verdict == "aborted" else ()), *test.rejections,
                sep="\n    ", flush=True,
            )  # fmt: skip
    print(f"{len(ratios)} played, {above} above the bound, bound at most {max(ratios):.3f}")


@dataclass(frozen=True)
class StopRequest:
    """Stop or abort, so many seconds after the first sample, or into a release of the feedback."""

    name: str
    delay_s: float
    release: int = 0  # its number, from 1 on

    def is_due(self, end: int, released: Sequence[int], rate_hz: float) -> bool:
        """Return whether it is due at sample `end`; released: at which releases began."""
        if self.release > len(released):
            return False
        since = released[self.release - 1] if self.release else 0
        return end >= since + self.delay_s * rate_hz


def try_stops(folder: Path, requests: Sequence[StopRequest]) -> None:
    """Stop one and the same test at each of the requests, on each rig.

    The test is played once: at each request the process divides, and its copy plays the stop.
    """
    asked, bad = 0, 0
    for rig in RIGS:
        config = read(folder, rig, points=3)
        pending, own, released = list(requests), list[tuple[StopRequest, int]](), list[int]()

        def note(
            state: SequencerState, block: Block, released: list[int] = released
        ) -> SequencerState:
            before, after = state.search, advance_releases(state, block).search
            assert before is not None
            assert after is not None
            assert before.releases is not None
            assert after.releases is not None
            if after.releases.is_released and not before.releases.is_released:
                released.append(block.end)
            return replace(state, search=after)

        def operate(
            end: int, config: RunConfig = config, pending: list[StopRequest] = pending,
            own: list[tuple[StopRequest, int]] = own, released: list[int] = released,
        ) -> OperatorCommand | None:  # fmt: skip
            nonlocal asked, bad
            if own:
                return None
            for request in tuple(pending):
                if request.is_due(end, released, config.drive.rate_hz):
                    pending.remove(request)
                    asked += 1
                    process = os.fork()
                    if not process:
                        own.append((request, end))
                        return OperatorCommand(request.name, "study")
                    bad += os.waitpid(process, 0)[1] != 0
            return None if pending else OperatorCommand("stop", "study")

        is_good = False
        try:
            with patch("table_io.sequencer.orbits.advance_releases", note):
                test = play(config, operate)
            if own:
                ((request, since),) = own
                is_good = (
                    test.rests(5.0, since) and test.peak_ratio <= test.bound_ratio and test.is_whole
                )
                print(
                    f"{rig} {request.name} at {since / config.drive.rate_hz:.2f} s, release "
                    f"{len(released)}: {'good' if is_good else 'WRONG'}, peak "
                    f"{test.peak_ratio / test.bound_ratio:.3f} of the bound, {test.verdict}",
                    flush=True,
                )
        finally:
            if own:  # a copy
                os._exit(not is_good)
    print(f"{bad} of {asked} wrong")


def draw_stops(count: int, seed: int) -> list[StopRequest]:
    rng = np.random.default_rng(seed)
    return [
        StopRequest(("stop", "abort")[k % 2], float(rng.uniform(16.0, 120.0))) for k in range(count)
    ]


def draw_stops_in_releases(count: int, seed: int) -> list[StopRequest]:
    """Draw stops while the feedback of an orbit is released, pushed or caught again."""
    rng = np.random.default_rng(seed)
    return [
        StopRequest(("stop", "abort")[k % 2], float(rng.uniform(0.0, 1.5)), int(rng.integers(1, 5)))
        for k in range(count)
    ]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("what", choices=("starts", "bounds", "stops", "releases"))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--points", type=int, default=12)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--span-hz", type=float, default=0.2, help="of a continuation's bounds")
    options = parser.parse_args()
    with TemporaryDirectory() as name:
        if options.what == "starts":
            try_starts(Path(name), options.count, options.points)
        elif options.what == "bounds":
            try_bounds(Path(name), options.count, options.seed, options.span_hz)
        elif options.what == "stops":
            try_stops(Path(name), draw_stops(options.count, options.seed))
        else:
            try_stops(Path(name), draw_stops_in_releases(options.count, options.seed))


if __name__ == "__main__":
    main()
