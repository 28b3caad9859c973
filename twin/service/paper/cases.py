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
from table_io.card import find, load
from table_io.profile import Profile
from table_io.records import Point, Quantities, Step
from table_io.units import GRAVITY_M_S2
from twin.model import exact
from twin.model.card import ModelCard
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.orbit import onsets
from twin.model.parameters import Parameters, resonance
from twin.model.sinusoid import Float3D
from twin.model.sweep import EXTREMES, SteppedSine, stepped_sine

GAPS: dict[str, tuple[str, ...]] = {
    "G∞": ("ginf",), "G30": ("g30",), "G16": ("g16",), "G10": ("g10",),
    "G4": ("g4_ss1", "g4_ss2", "g4_ss3"), "G0": ("g0",), "G-1": ("gm1",), "G-2": ("gm2",),
    "G-10": ("gm10",),
}  # fmt: skip
UNTIL_HZ = {"g4_ss1": 0.79, "g4_ss2": 1.6}  # G4: up to here this sweep, above it the next
SAMPLES = 2000  # a cycle, of the motions in the pictures


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion over some cycles, SI, right positive, (sample,); v_r, v_l: positions of the bumpers.

    A bumper without force stands still there or relaxes; a measured one is NaN out of contact.
    """

    time: Float1D
    u: Float1D
    v: Float1D
    a: Float1D
    force_r: Float1D
    force_l: Float1D
    v_r: Float1D
    v_l: Float1D


def sample(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> Motion:
    """The motion from a state at a zero upcrossing of A, `SAMPLES` a cycle."""
    count, rate = cycles * SAMPLES, frequency_hz * SAMPLES
    number = np.arange(count + 1)
    base = acceleration * np.sin(2 * math.pi * number / SAMPLES)
    out = np.empty((len(exact.OUTPUTS), count))
    exact.advance(state.copy(), exact.constants(parameters, rate), base[1:], out)
    u, v, a, force_r, force_l, u_r, u_l = out
    return Motion(
        number[:-1] / rate, u, v, a, force_r, force_l,
        u_r + parameters.gap_r, u_l - parameters.gap_l,
    )  # fmt: skip


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
    def played(self) -> SteppedSine:
        frequencies = [step.frequency_hz for step in self.steps]
        model = self.effects or Model(self.parameters)
        return swept(model, frequencies, self.acceleration, self.profile.sweep.cycles)

    @cached_property
    def points(self) -> tuple[Point, ...]:
        """The PRC point of every step, as `twin`."""
        kept = self.played.extremes[:, -self.profile.sweep.measured_cycles :]
        u_star, a_star = self.scale
        return tuple(
            Point(
                0, step.index, step.direction, step.frequency_hz, None,
                quantities(self.parameters, kept[step.index : step.index + 1], u_star, a_star),
                step.acceleration_m_s2, step.acceleration_m_s2, 0.0,
            )
            for step in self.steps
        )  # fmt: skip

    def state(self, place: int, cycles: int) -> Float1D:
        """The state `cycles` before the end of a step."""
        before = self.played.states[place - 1] if place else exact.rest(self.parameters)
        held = self.profile.sweep.cycles - cycles
        frequency = self.steps[place].frequency_hz
        return stepped_sine(
            self.parameters, [frequency], self.acceleration, held, state=before
        ).states[0]


def quantities(
    parameters: Parameters, extremes: Float3D, u_star: float, a_star: float
) -> Quantities:
    """The ratios of Eq. 1, means over the cycles of `extremes` (1, cycle, 8)."""
    u_max, u_min, a_max, a_min, f_r, f_l, hits_r, hits_l = (
        extremes[0, :, place] for place in range(len(EXTREMES))
    )
    weight = parameters.mass * GRAVITY_M_S2
    eta = (u_max - u_min) / (2 * u_star)
    depth_r = np.where(f_r > 0, u_max - parameters.gap_r, 0.0)
    depth_l = np.where(f_l < 0, -u_min - parameters.gap_l, 0.0)
    return Quantities(
        eta_d=float(eta.mean()),
        eta_a=float((a_max - a_min).mean() / (2 * a_star)),
        eta_r=float(np.maximum(depth_r, 0).mean() / u_star),
        eta_l=float(np.maximum(depth_l, 0).mean() / u_star),
        r_r=float(f_r.mean() / weight),
        r_l=float(-f_l.mean() / weight),
        impacts_right=tuple(int(n) for n in hits_r),
        impacts_left=tuple(int(n) for n in hits_l),
        drift=float((eta[-1] - eta[0]) / eta.mean()),
        spread=float(np.ptp(eta) / eta.mean()),
    )


@dataclass(frozen=True, eq=False)
class Case:
    """One gap: its tests, put together."""

    name: str
    tests: tuple[Test, ...]

    @property
    def parameters(self) -> Parameters:
        return self.tests[0].parameters

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
        return sample(self.parameters, frequency_hz, self.acceleration, state, cycles)

    def contacts(self, frequency_hz: float, direction: str, cycles: int) -> tuple[Float1D, Float1D]:
        """(right, left: times in cycles at which contact begins) over the last of the step."""
        test, place = self._step(frequency_hz, direction)
        state = test.state(place, cycles)
        return onsets(self.parameters, frequency_hz, self.acceleration, state, cycles)[:2]

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


def cases() -> dict[str, Case]:
    """Every gap of the paper by its name, from the shipped profiles."""
    found = {}
    for gap, names in GAPS.items():
        tests = []
        for name in names:
            profile, _ = load(find(name, "tests"), Profile, "test profile")
            card, _ = load(find(profile.model, "models"), ModelCard, "model")
            tests.append(Test(name, profile, card.model(profile.specimen).parameters))
        found[gap] = Case(gap, tuple(tests))
    return found
