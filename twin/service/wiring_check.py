"""`shaketwin check --table NAME`: the wiring proven at rest, before anything is ever moved.

The output is played only where the command wired back stands at 0 V already, and then it is held at
0 V: what every run begins with. Nothing else is queued.
"""

import contextlib
import select
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeGuard

import numpy as np

from table_io.backends import Backend, MachineLost, Source, open_backend, open_source
from table_io.backends.digital import DigitalInputs, digital_inputs
from table_io.block import Float2D
from table_io.card import PROFILES, find, load
from table_io.clock import Clock, ManualClock, RealClock, today
from table_io.due import overdue
from table_io.profile import Acquisition, Profile
from table_io.rig import Rig
from table_io.rig_file import load_rig
from table_io.wiring_check import (
    Felt,
    Hand,
    Line,
    Resting,
    at_rest,
    hands,
    judged,
    moved,
    proven,
    restless,
    untested,
    watched,
    zero,
)

EXIT_FAILED = 2
PRIORITY = 50  # that of a rig: the machine takes a silence for its death
TARE_S, REST_S, PIECE_S = 1.0, 4.0, 0.02
CALM_S, BEFORE_S, HAND_S, AFTER_S = 1.0, 0.4, 30.0, 0.8  # of a hand: see `_felt`
TRIES = 3  # at a hand that comes too early
LATE_MS = 100.0
RELEASED_S = 0.5  # after the release: until it is through, and as long a look


class Person(Protocol):
    """Somebody at the table, who can be asked."""

    def ask(self, what: str) -> None:
        """Tell what to do now."""

    def declines(self) -> bool:
        """True where this one is to be left out; does not wait."""


@dataclass
class Found:
    """What the check has found; `resting` is what the inputs showed, where they came.

    `levels` are those of digital inputs while the output was held, one look after another.
    """

    rig: Rig
    lines: list[Line] = field(default_factory=list)
    resting: Resting | None = None
    levels: list[dict[str, bool]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return all(line.verdict != "fail" for line in self.lines)


def check_wiring(table: str, unattended: bool, as_json: bool) -> int:
    """Prints what was found; 0, or 2 where a line fails."""
    from twin.service.scheduling import urgent
    from twin.service.terminal import say
    from twin.service.wiring_table import print_found

    rig, _ = load_rig(find(table, "rigs"))
    clock: Clock = ManualClock() if rig.any_speed else RealClock()
    seen = sys.stdin.isatty() and not (unattended or as_json or rig.any_speed)
    if not as_json:
        say(f"{rig.title}: at rest, for {TARE_S + REST_S:g} s; keep away from the table")
    if not rig.any_speed:
        urgent(PRIORITY)
    found = examine(rig, clock, machine_of(rig, clock), seen and AtTable())
    print_found(found, as_json)
    return 0 if found.passed else EXIT_FAILED


def machine_of(rig: Rig, clock: Clock) -> Backend | Source:
    """The machine of a card, to rest at its usual sample rate; what only acquires is a Source."""
    profile, _ = load(PROFILES / "tests" / "quickstart.toml", Profile, "test profile")
    usual = profile.acquisition.rate_hz
    rate = usual if usual in rig.rates_hz else max(rig.rates_hz)
    if rig.backend in ("opendaq", "follow"):
        return open_source(rig, rate, clock)
    resting = profile.model_copy(update={"acquisition": Acquisition(rate_hz=rate)})
    return open_backend(rig, resting, clock)


def _plays(machine: Backend | Source) -> TypeGuard[Backend]:
    return hasattr(machine, "queue")


def examine(rig: Rig, clock: Clock, machine: Backend | Source, person: Person | bool) -> Found:
    """Everything that can be said of the wiring; `person` False: nobody is there to be asked.

    What takes long to compute waits until the machine is released: it watches for silence.
    """
    found = Found(rig, warnings=overdue(rig, today().date()))
    after: list[Line] = []
    inputs, released = None, []
    try:
        machine.open()
        inputs = digital_inputs(rig)
        take = _output_held(machine, found)
        if take is not None:
            after.append(_rest(found, clock, machine, take, inputs))
        else:
            why = "the command wired back is not at 0 V, so a start could move the table: mend that"
            after.append(untested("samples on time", "", why))
        for hand in hands(rig):
            if take is None or isinstance(person, bool):
                why = "the output is not held" if take is None else "nobody is there to ask"
                after += proven(hand, None, f"{why}: {hand.ask}")
            else:
                felt = _felt(hand, found, machine.rate_hz, take, person)
                after += proven(hand, felt, f"nobody did: {hand.ask}")
    except MachineLost as error:
        after.append(judged("machine answers", "", 0.0, (1.0, 1.0), "", str(error)))
    finally:
        machine.close()
        if inputs is not None:
            released = _released(inputs, clock)
    after += watched(found.levels, REST_S, released, rig.ni is not None, rig.simulated is not None)
    found.lines = [*(at_rest(found.resting) if found.resting is not None else ()), *after]
    return found


Take = Callable[[int], Float2D]


def _output_held(machine: Backend | Source, found: Found) -> Take | None:
    """What hands over samples with the output held at 0 V; None where it must not be played.

    Where somebody else plays, and we only acquire, nothing is ours to hold.
    """
    rate = machine.rate_hz
    if not _plays(machine):
        machine.start()
        return machine.read
    tare = Resting(found.rig, rate, machine.tare(round(TARE_S * rate)))
    (line,) = zero(tare)
    if line.verdict != "pass":
        found.resting = tare
        return None
    machine.queue(0, np.zeros(2))
    machine.start()
    return machine.read


def _released(inputs: DigitalInputs, clock: Clock) -> list[dict[str, bool]]:
    """Digital inputs once the machine was released, one look after another."""
    seen = []
    clock.wait_until(clock.now() + RELEASED_S)
    with contextlib.closing(inputs), contextlib.suppress(MachineLost):  # that was said
        for _ in range(round(RELEASED_S / PIECE_S)):
            seen.append(inputs.levels())
            clock.wait_until(clock.now() + PIECE_S)
    return seen


def _rest(
    found: Found,
    clock: Clock,
    machine: Backend | Source,
    take: Take,
    inputs: DigitalInputs | None,
) -> Line:
    """Takes the inputs at rest; how punctual they were."""
    pieces, late_s = [], []
    piece = round(PIECE_S * machine.rate_hz)
    for k in range(round(REST_S / PIECE_S)):
        pieces.append(take(piece))
        late_s.append(clock.now() - machine.scheduled((k + 1) * piece - 1))
        if inputs is not None:
            found.levels.append(inputs.levels())
    found.resting = Resting(found.rig, machine.rate_hz, np.concatenate(pieces, axis=1))
    late = 1e3 * statistics.median(late_s)
    do = "this computer is too busy, or the device hands over in pieces that are too long"
    return judged("samples on time", "", late, (-LATE_MS, LATE_MS), "ms", do)


def _felt(hand: Hand, found: Found, rate: float, take: Take, person: Person) -> Felt | None:
    """What came while the hand was there; None where it was left out, or nobody came.

    What still rings from the hand before is let go for CALM_S. Then the person is asked; from
    BEFORE_S after that on a motion counts, and AFTER_S of it are taken. Who comes earlier, or does
    not let go, is asked again.
    """
    scale = np.array([[one.volts_per_unit] for one in found.rig.sensors])
    piece, before, second = round(PIECE_S * rate), round(BEFORE_S * rate), round(rate)

    def felt(volts: Float2D) -> Felt:
        resting = found.resting
        noise = resting.noise if resting is not None else np.zeros(len(scale))
        rest = resting.means if resting is not None else None
        return Felt(found.rig, rate, volts / scale, noise, before, rest)

    def pieces(seconds: float) -> Float2D:
        return np.concatenate([take(piece) for _ in range(round(seconds / PIECE_S))], axis=1)

    for tried in range(TRIES):
        pieces(CALM_S)
        person.ask(f"let go; once more: {hand.ask}" if tried else hand.ask)
        volts = pieces(BEFORE_S)
        if not restless(hand, felt(volts)):
            break
    else:
        return felt(volts)
    for _ in range(round(HAND_S / PIECE_S)):
        volts = np.concatenate([volts, take(piece)], axis=1)
        if moved(hand, felt(volts)) is not None:
            return felt(np.concatenate([volts, pieces(AFTER_S)], axis=1))
        if person.declines():
            break
        kept = max(before, volts.shape[1] - second)
        volts = np.concatenate([volts[:, :before], volts[:, kept:]], axis=1)
    return None


class AtTable:
    """The person at this terminal."""

    def ask(self, what: str) -> None:
        from twin.service.terminal import say

        say(f"now: {what} (Enter: leave it out)")

    def declines(self) -> bool:
        return bool(select.select([sys.stdin], [], [], 0.0)[0]) and bool(sys.stdin.readline())
