"""Simulations of the paper's tests under the ideal stepped sine: PRC points and motions by gap.

Forward then backward sweep with the state carried over; the last cycles of each step are measured.
The three sweeps of G4 are merged as in Sect. 4.3 of the paper, each where its grid is finest.
"""

import math
from dataclasses import dataclass
from functools import cached_property

from table_io.block import Float1D
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.records import PrcPoint, Step
from table_io.units import GRAVITY_M_S2
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.parameters import Parameters, free_flight_resonance
from twin.model.stepped_sine import SteppedSineResponse
from twin.results import ideal_points
from twin.results.players import HarmonicSimulator, SystemMotion, make_simulator
from twin.setup.run_config import read_model

GAPS: dict[str, tuple[str, ...]] = {
    "G∞": ("ginf",), "G30": ("g30",), "G16": ("g16",), "G10": ("g10",),
    "G4": ("g4_ss1", "g4_ss2", "g4_ss3"), "G0": ("g0",), "G-1": ("gm1",), "G-2": ("gm2",),
    "G-10": ("gm10",),
}  # fmt: skip
SWEEP_END_HZ = {"g4_ss1": 0.79, "g4_ss2": 1.6}  # G4: frequency where the next sweep takes over


def name_gap(gap_mm: float) -> str:
    """Return the name of a gap as in GAPS: G16, G-1, G∞."""
    return "G∞" if math.isinf(gap_mm) else f"G{gap_mm:g}"


@dataclass(frozen=True, eq=False)
class PaperTest:
    """One test profile of the paper and the simulated response of a model."""

    __test__ = False  # keeps pytest from collecting the class

    name: str
    profile: Profile
    parameters: Parameters
    full_model: Model | None = None  # with effects; None: `parameters` only
    scale_override: tuple[float, float] | None = None  # u*, a*; None: from `parameters`

    @cached_property
    def scale(self) -> tuple[float, float]:
        """Normalization (u* in m, a* in m/s2) of the curves."""
        return self.scale_override or free_flight_resonance(self.parameters, self.acceleration)[:2]

    @cached_property
    def steps(self) -> tuple[Step, ...]:
        return self.profile.sweep.steps

    @cached_property
    def acceleration(self) -> float:
        return self.profile.sweep.acceleration_g * GRAVITY_M_S2

    @cached_property
    def model(self) -> Model:
        return self.full_model or Model(self.parameters)

    @cached_property
    def simulator(self) -> HarmonicSimulator:
        return make_simulator(self.model)

    @cached_property
    def response(self) -> SteppedSineResponse:
        frequencies = [step.frequency_hz for step in self.steps]
        return simulate_sweep(self.model, frequencies, self.acceleration, self.profile.sweep.cycles)

    @cached_property
    def points(self) -> tuple[PrcPoint, ...]:
        """PRC point of every step, as `twin`."""
        sweep = self.profile.sweep
        return ideal_points.compute_prc_points(
            self.model, self.steps, self.response, sweep.cycles, sweep.measured_cycles, self.scale
        )

    def compute_state(self, index: int, cycles: int) -> Float1D:
        """Return the state vector `cycles` before the end of a step."""
        lead_cycles = self.profile.sweep.cycles - cycles
        start_state = self.response.states[index - 1] if index else None
        frequency = self.steps[index].frequency_hz
        return self.simulator.sweep(
            [frequency], self.acceleration, lead_cycles, start_state
        ).states[0]


@dataclass(frozen=True, eq=False)
class PaperCase:
    """All tests of one gap, merged into one curve."""

    name: str
    tests: tuple[PaperTest, ...]

    @property
    def parameters(self) -> Parameters:
        return self.tests[0].parameters

    @property
    def gaps_m(self) -> tuple[float, float]:
        """Initial gaps (right, left) in m, negative when the bumpers are precompressed."""
        return self.parameters.gap_r, self.parameters.gap_l

    @property
    def simulator(self) -> HarmonicSimulator:
        return self.tests[0].simulator

    @property
    def scale(self) -> tuple[float, float]:
        return self.tests[0].scale

    @property
    def acceleration(self) -> float:
        return self.tests[0].acceleration

    @cached_property
    def points(self) -> tuple[PrcPoint, ...]:
        """PRC points of all tests, each frequency range from the test with the finest grid."""
        points: list[PrcPoint] = []
        from_hz = 0.0
        for test in self.tests:
            to_hz = SWEEP_END_HZ.get(test.name, math.inf)
            points += [
                point for point in test.points if from_hz < point.frequency_hz <= to_hz + 1e-9
            ]
            from_hz = to_hz + 1e-9
        return tuple(points)

    def simulate_motion(self, frequency_hz: float, direction: str, cycles: int) -> SystemMotion:
        """Simulate the last `cycles` cycles of the step at this frequency."""
        test, index = self._find_step(frequency_hz, direction)
        state = test.compute_state(index, cycles)
        return self.simulator.simulate_motion(frequency_hz, self.acceleration, state, cycles)

    def find_onsets(
        self, frequency_hz: float, direction: str, cycles: int
    ) -> tuple[Float1D, Float1D]:
        """Return the contact onset times in cycles (right, left) over the last cycles of a step."""
        test, index = self._find_step(frequency_hz, direction)
        state = test.compute_state(index, cycles)
        return self.simulator.find_onsets(frequency_hz, self.acceleration, state, cycles)[:2]

    def _find_step(self, frequency_hz: float, direction: str) -> tuple[PaperTest, int]:
        for test in self.tests:
            for step in test.steps:
                if step.direction == direction and abs(step.frequency_hz - frequency_hz) < 1e-9:
                    return test, step.index
        raise ValueError(f"{self.name} has no step at {frequency_hz} Hz {direction}")


def load_paper_cases(
    model: str | None = None, scale: tuple[float, float] | None = None
) -> dict[str, PaperCase]:
    """Load every gap of the paper by name from the shipped profiles.

    `model` replaces the model of the profiles; `scale` (u* in m, a* in m/s2) the model's own.
    """
    paper_cases = {}
    for gap, names in GAPS.items():
        tests = []
        for name in names:
            profile, _ = load_config(
                PROFILES_DIR / "tests" / f"{name}.toml", Profile, "test profile"
            )
            config, _ = read_model(model or profile.model)
            case_model = config.build_model(profile.specimen)
            case_model.require_steady_state()
            tests.append(PaperTest(name, profile, case_model.parameters, case_model, scale))
        paper_cases[gap] = PaperCase(gap, tuple(tests))
    return paper_cases
