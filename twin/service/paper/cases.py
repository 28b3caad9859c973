"""The paper's tests on the ideal stepped sine: PRC points and motions of every gap.

Forward and backward, the state carried through, the last cycles of each step measured. The three
sweeps of G4 are put together as in the paper's Sect. 4.3, each where its steps are finest.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D
from table_io.card import BadInput, find, load
from table_io.profile import Profile
from table_io.records import Point, Step
from table_io.units import GRAVITY_M_S2
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.parameters import Parameters, resonance
from twin.model.sweep import SteppedSine
from twin.service import ideal_points
from twin.service.bundle import read_model
from twin.service.paper.players import Motion, Player, player

GAPS: dict[str, tuple[str, ...]] = {
    "G∞": ("ginf",), "G30": ("g30",), "G16": ("g16",), "G10": ("g10",),
    "G4": ("g4_ss1", "g4_ss2", "g4_ss3"), "G0": ("g0",), "G-1": ("gm1",), "G-2": ("gm2",),
    "G-10": ("gm10",),
}  # fmt: skip
UNTIL_HZ = {"g4_ss1": 0.79, "g4_ss2": 1.6}  # G4: up to here this sweep, above it the next


@dataclass(frozen=True, eq=False)
class Test:
    """One profile and what the model does on it."""

    __test__ = False  # for pytest: this is a laboratory's test

    name: str
    profile: Profile
    parameters: Parameters
    effects: Model | None = None  # where it is more than its linear parts
    stars: tuple[float, float] | None = None  # u*, a* to divide by; None: the model's own

    @cached_property
    def scale(self) -> tuple[float, float]:
        """(u* in m, a* in m/s2), by which every curve is divided."""
        return self.stars or resonance(self.parameters, self.acceleration)[:2]

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        return self.profile.sweep.steps

    @cached_property
    def acceleration(self) -> float:
        return self.profile.sweep.acceleration_g * GRAVITY_M_S2

    @cached_property
    def model(self) -> Model:
        return self.effects or Model(self.parameters)

    @cached_property
    def player(self) -> Player:
        return player(self.model)

    @cached_property
    def played(self) -> SteppedSine:
        frequencies = [step.frequency_hz for step in self.steps]
        return swept(self.model, frequencies, self.acceleration, self.profile.sweep.cycles)

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """The PRC point of every step, as `twin`."""
        measured = self.profile.sweep.measured_cycles
        return ideal_points.points(self.model, self.steps, self.played, measured, self.scale)

    def state(self, place: int, cycles: int) -> Float1D:
        """The state `cycles` before the end of a step."""
        held = self.profile.sweep.cycles - cycles
        before = self.played.states[place - 1] if place else None
        frequency = self.steps[place].frequency_hz
        return self.player.sweep([frequency], self.acceleration, held, before).states[0]


@dataclass(frozen=True, eq=False)
class Case:
    """One gap: its tests, put together."""

    name: str
    tests: tuple[Test, ...]

    @property
    def parameters(self) -> Parameters:
        return self.tests[0].parameters

    @property
    def player(self) -> Player:
        return self.tests[0].player

    @property
    def scale(self) -> tuple[float, float]:
        return self.tests[0].scale

    @property
    def acceleration(self) -> float:
        return self.tests[0].acceleration

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """The PRC points of all tests, each frequency from the test that is finest there."""
        found: list[Point] = []
        from_hz = 0.0
        for test in self.tests:
            to_hz = UNTIL_HZ.get(test.name, math.inf)
            found += [one for one in test.points if from_hz < one.frequency_hz <= to_hz + 1e-9]
            from_hz = to_hz + 1e-9
        return tuple(found)

    def motion(self, frequency_hz: float, direction: str, cycles: int) -> Motion:
        """The last `cycles` of the step at this frequency."""
        test, place = self._step(frequency_hz, direction)
        state = test.state(place, cycles)
        return self.player.motion(frequency_hz, self.acceleration, state, cycles)

    def contacts(self, frequency_hz: float, direction: str, cycles: int) -> tuple[Float1D, Float1D]:
        """(right, left: times in cycles at which contact begins) over the last of the step."""
        test, place = self._step(frequency_hz, direction)
        state = test.state(place, cycles)
        return self.player.onsets(frequency_hz, self.acceleration, state, cycles)[:2]

    def _step(self, frequency_hz: float, direction: str) -> tuple[Test, int]:
        for test in self.tests:
            for step in test.steps:
                if step.direction == direction and abs(step.frequency_hz - frequency_hz) < 1e-9:
                    return test, step.index
        raise ValueError(f"{self.name} has no step at {frequency_hz} Hz {direction}")


def curve(
    points: Sequence[Point], source: str, direction: str, name: str
) -> tuple[Float1D, Float1D]:
    """(frequency in Hz, quantity) of one direction of "twin" or "measured" points, upwards."""
    found = sorted(
        (one.frequency_hz, getattr(getattr(one, source), name))
        for one in points
        if one.direction == direction and getattr(one, source) is not None
    )
    table = np.array(found, dtype=np.float64).reshape(-1, 2)
    return table[:, 0], table[:, 1]


def cases(model: str | None = None, stars: tuple[float, float] | None = None) -> dict[str, Case]:
    """Every gap of the paper by its name, from the shipped profiles; with another model in them.

    `stars`: u*, a* to divide by, instead of the model's own.
    """
    found = {}
    for gap, names in GAPS.items():
        tests = []
        for name in names:
            profile, _ = load(find(name, "tests"), Profile, "test profile")
            card, _ = read_model(model or profile.model)
            whole = card.model(profile.specimen)
            _steady(whole, model or profile.model)
            tests.append(Test(name, profile, whole.parameters, whole, stars))
        found[gap] = Case(gap, tuple(tests))
    return found


def _steady(model: Model, name: str) -> None:
    """BadInput where the model has no steady motions to draw."""
    if any(one.effect.id == "gap_drift" for one in model.present):
        raise BadInput(
            f"--model {name}: effect 'gap_drift': the paper's motions are steady, and with gaps "
            "that move there are none; leave it out of the model"
        )
