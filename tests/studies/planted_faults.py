"""How every planted fault is found, and how fast: the table of the guide, The controller.

    python -m tests.studies.planted_faults            every fault, several channels, sizes, times
    python -m tests.studies.planted_faults smallest   the smallest gain, drift and spike found
    python -m tests.studies.planted_faults sweeps     false findings over ten whole sweeps

Complete controlled sessions on the simulated table, unpaced. A fault is found when the first trip,
event or gap after it is known, on the session's clock: the block that shows it is waited for.
"""

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from statistics import median
from typing import Any

import numpy as np

from table_io.acquisition.session import SessionSetup, run_session
from table_io.block import Block
from table_io.channels import CHANNEL_BY_NAME
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Event, Record, RunStart, RunStop, SampleGap, Trip
from table_io.sim.config import FAULT_KINDS
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import RIG, make_faulty_rig

TOLD = frozenset({"sensor", "alarm", "late", "level"})  # kinds of events that tell of a fault
# Large enough to matter: a tenth of the test's level, or of what a sensor shows in it.
SIZES: dict[str, dict[str, tuple[float, ...]]] = {
    "gain": {"m": (0.15, -0.3), "m/s2": (0.15, -0.3), "N": (0.3, -0.5)},
    "drift": {"m": (1.0,), "m/s2": (0.01,), "N": (0.02,)},  # mm/s, g/s, kN/s
    "spike": {"m": (1.0, 30.0), "m/s2": (0.1, 0.5), "N": (0.1, 1.0)},  # mm, g, kN
}
MACHINE = (
    {"kind": "dropped", "for_s": 0.01},
    {"kind": "dropped", "for_s": 0.1},
    {"kind": "repeated", "for_s": 0.01},
    {"kind": "repeated", "for_s": 0.1},
    {"kind": "replayed", "for_s": 0.02},
    {"kind": "late", "size": 0.2},
    {"kind": "stall"},
    {"kind": "power_loss"},
    {"kind": "oil_loss", "size": 0.5},
    {"kind": "oil_loss", "size": 0.25},
)


@dataclass(frozen=True)
class Outcome:
    """One fault in one session: found after `seconds` and `cycles` (NaN: never), by what."""

    kind: str
    channel: str
    size: float
    seconds: float
    cycles: float
    by: str
    ended: str
    early: int  # findings before it was planted: false ones


def short(name: str) -> Profile:
    """Slow and chaotic, middle with jumps, fast and precompressed."""
    gap, start, stop, step, cycles = {
        "slow": (4.0, 0.5, 0.7, 0.2, 6),
        "middle": (4.0, 2.4, 3.4, 0.5, 12),
        "fast": (-10.0, 6.0, 10.0, 2.0, 30),
    }[name]
    sweep = {"start_hz": start, "stop_hz": stop, "step_hz": step, "cycles": cycles}
    return Profile.model_validate(
        {
            "title": name,
            "specimen": {"mass_kg": 550.0, "gap_mm": gap},
            "sweep": {"directions": ("forward",), **sweep},
        }
    )


def session(profile: Profile, rig: RigConfig) -> Iterator[tuple[Block | Record, float]]:
    """What a session yields, each with the time on its clock since sample 0, in s."""
    clock, rate = ManualClock(), profile.acquisition.rate_hz
    backend = SimulatedBackend(rig, profile.specimen, rate, clock)
    nothing = RunStart(0, "", "", "table", "", "", "", rate, 20, (), (), 0, {}, {}, "", "", 0.0)
    stream = run_session(
        SessionSetup(profile, rig), backend, clock, lambda tare, at: nothing, lambda: None
    )
    for item in stream:
        yield item, clock.now() - backend.scheduled_time_s(0)


def times(profile: Profile, count: int, seed: int) -> list[tuple[float, float]]:
    """(time in s, frequency in Hz) at random in the sweep of a sound session.

    Not in its first 15 %, where what is usual is learnt, and not in its last 30 %.
    """
    step: list[np.ndarray] = []
    for item, _ in session(profile, make_faulty_rig()):
        if isinstance(item, Block):
            step.append(item.step)
    steps = np.concatenate(step)
    moving = np.flatnonzero(steps >= 0)
    moving = moving[int(0.15 * moving.size) : int(0.7 * moving.size)]
    at = np.random.default_rng(seed).choice(moving, count, replace=False)
    hz = [step.frequency_hz for step in profile.sweep.steps]
    rate = profile.acquisition.rate_hz
    return [(float(i / rate), hz[steps[i]]) for i in sorted(at.tolist())]


def faults() -> Iterator[dict[str, Any]]:
    """Every kind, with every channel and every size."""
    yield from MACHINE
    for kind, needs in FAULT_KINDS.items():
        for channel in RIG.channels if needs.channel else ():
            sizes = SIZES.get(kind, {}).get(CHANNEL_BY_NAME[channel].unit, (None,))
            for size in sizes:
                extra = {} if size is None else {"size": size}
                yield {"kind": kind, "channel": channel, **extra}


def try_fault(profile: Profile, fault: dict[str, Any], at_s: float, hz: float) -> Outcome:
    """One fault planted in one session."""
    delay_s, by, early, ended = float("nan"), "", 0, ""
    for item, now_s in session(profile, make_faulty_rig(({"at_s": at_s, **fault},))):
        if isinstance(item, RunStop):
            ended = item.verdict
        elif isinstance(item, (Trip, SampleGap)) or (isinstance(item, Event) and item.kind in TOLD):
            if now_s < at_s:
                early += 1
            elif not by:
                delay_s, by = now_s - at_s, name_finding(item)
    size = fault.get("size", fault.get("for_s", float("nan")))
    return Outcome(
        fault["kind"], fault.get("channel", ""), size, delay_s, delay_s * hz, by, ended, early
    )


def name_finding(event: Trip | SampleGap | Event) -> str:
    """What found it, in a word or two."""
    if isinstance(event, Trip):
        return event.kind
    if isinstance(event, SampleGap):
        return f"gap ({event.reason})"
    return event.kind


def study(profiles: tuple[str, ...], count: int, seed: int = 1) -> list[Outcome]:
    """Every fault at `count` random times in each of the profiles."""
    out = []
    for name in profiles:
        profile = short(name)
        moments = times(profile, count * sum(1 for _ in faults()), seed)
        order = np.random.default_rng(seed).permutation(len(moments)).tolist()
        for k, fault in enumerate(faults()):
            for at_s, hz in (moments[order[count * k + j]] for j in range(count)):
                out.append(try_fault(profile, fault, at_s, hz))
                print(name, f"{at_s:.3f} s", out[-1], file=sys.stderr, flush=True)
    return out


def table(outcomes: list[Outcome]) -> str:
    """The table in Markdown."""
    rows = [
        "| fault | planted | found | median | worst | cycles, median / worst | by | then |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for kind in FAULT_KINDS:
        mine = [outcome for outcome in outcomes if outcome.kind == kind]
        hit = [outcome for outcome in mine if outcome.by]
        if not hit:
            rows.append(f"| {kind} | {len(mine)} | 0 | | | | | |")
            continue
        ms, cycles = [1e3 * outcome.seconds for outcome in hit], [outcome.cycles for outcome in hit]
        by = " ".join(
            sorted({outcome.by for outcome in hit}, key=[outcome.by for outcome in hit].count)[::-1]
        )
        ends = sorted({outcome.ended for outcome in hit})
        endings = ", ".join(
            f"{[outcome.ended for outcome in hit].count(end)} {end}" for end in ends
        )
        rows.append(
            f"| {kind} | {len(mine)} | {len(hit)} | {median(ms):.0f} ms | {max(ms):.0f} ms | "
            f"{median(cycles):.2f} / {max(cycles):.2f} | {by} | {endings} |"
        )
    return "\n".join(rows)


LADDERS = {
    "gain": (0.02, 0.04, 0.06, 0.08, 0.1, 0.12, 0.15, 0.2, 0.3),
    "drift": (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0),  # of the largest below
    "spike": (0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0),
}
LARGEST = {"m": 10.0, "m/s2": 0.1, "N": 0.5}  # mm, g, kN; a second of it, for a drift


def smallest(name: str) -> str:
    """The smallest gain error, drift and spike that is found in each channel, in Markdown."""
    profile = short(name)
    at_s, hz = times(profile, 1, 5)[0]
    rows = ["| channel | gain | drift, a second | spike |", "|---|---|---|---|"]
    for channel in RIG.channels:
        unit = CHANNEL_BY_NAME[channel].unit
        cells = []
        for kind, ladder in LADDERS.items():
            entry = "not found"
            for step in ladder:
                size = step if kind == "gain" else step * LARGEST[unit]
                fault = {"kind": kind, "channel": channel, "size": size}
                if try_fault(profile, fault, at_s, hz).by:
                    human = {"m": "mm", "m/s2": "g", "N": "kN"}[unit]
                    entry = f"{100 * size:g} %" if kind == "gain" else f"{size:g} {human}"
                    break
            cells.append(entry)
        rows.append(f"| {channel} | {' | '.join(cells)} |")
        print(rows[-1], file=sys.stderr, flush=True)
    return "\n".join(rows)


SWEEPS = ("g4_ss3", "gm10", "ginf", "g0", "gm1", "g30", "g4_ss3", "gm10", "g4_ss1", "g4_ss2")


def false_findings() -> str:
    """Findings over ten whole sweeps of a sound table, each with a seed of its own."""
    rows = ["| sweep | seed | minutes | trips | findings |", "|---|---|---|---|---|"]
    for seed, name in enumerate(SWEEPS, 11):
        profile = load_config(PROFILES_DIR / "tests" / f"{name}.toml", Profile, "test profile")[0]
        trips, events, end = 0, 0, 0
        for item, _ in session(profile, make_faulty_rig(seed=seed)):
            trips += isinstance(item, Trip)
            events += isinstance(item, Event) and item.kind in TOLD
            end = item.index
        minutes = end / profile.acquisition.rate_hz / 60
        rows.append(f"| {name} | {seed} | {minutes:.1f} | {trips} | {events} |")
        print(rows[-1], file=sys.stderr, flush=True)
    return "\n".join(rows)


def main(what: str) -> None:
    if what == "smallest":
        print(smallest("middle"))
    elif what == "sweeps":
        print(false_findings())
    else:
        outcomes = study(tuple(sys.argv[2:]) or ("slow", "middle", "fast"), 2)
        print(table(outcomes))
        missed = [outcome for outcome in outcomes if not outcome.by]
        print(f"\n{len(outcomes)} planted, {len(outcomes) - len(missed)} found; ", end="")
        print(f"{sum(outcome.early for outcome in outcomes)} findings before a fault was planted")
        print(*missed, sep="\n")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "")
