"""The co-simulation unit of a specimen, as an FMU holds it: pythonfmu3 runs this file in a tool.

The Python of the tool needs shaketwin, whose solver advances the state; nothing is approximated.
"""

from pathlib import Path

import numpy as np
from pythonfmu3 import CoSimulation, Float64, Fmi3Causality, Fmi3Slave, Fmi3Variability

from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from twin.model.config import ModelConfig
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT, Solver

OUTPUTS = (
    ("rel_disp_m", "Displacement of the mass relative to the table in m"),
    ("rel_vel_m_s", "Its velocity in m/s"),
    ("mass_acc_m_s2", "Total acceleration of the mass in m/s2"),
    ("force_r_n", "Force of the right bumper in N, 0 or more"),
    ("force_l_n", "Force of the left bumper in N, 0 or less"),
)
INPUTS = (
    ("table_acc_m_s2", "Acceleration of the table at the end of the step in m/s2"),
    ("table_disp_m", "Displacement of the table at the end of the step in m, for table tilt"),
)


class SpecimenUnit(Fmi3Slave, CoSimulation):  # type: ignore[misc]
    """Specimen on the table, from rest; the table's acceleration is linear within a step."""

    description = "Specimen on a shaking table between two bumpers, the model of a digital twin"

    def __init__(self, **settings: object) -> None:
        super().__init__(**settings)
        folder = Path(str(self.resources))
        profile = parse_toml((folder / "profile.toml").read_text("utf-8"), Profile, "profile")
        config = parse_toml((folder / "model.toml").read_text("utf-8"), ModelConfig, "model")
        self._model = config.build_model(profile.specimen)
        self._solver: Solver | None = None
        self._step_s = 0.0
        self._state = np.empty(0)
        self.time = 0.0
        self.register_variable(
            Float64(
                "time",
                causality=Fmi3Causality.independent,
                variability=Fmi3Variability.continuous,
            )
        )
        for names, causality in ((INPUTS, Fmi3Causality.input), (OUTPUTS, Fmi3Causality.output)):
            for name, meaning in names:
                setattr(self, name, 0.0)
                self.register_variable(Float64(name, causality=causality, description=meaning))

    def do_step(self, current_time: float, step_size: float) -> bool:
        """Advance the specimen by a step, of the same size as all before; False if it cannot."""
        if self._solver is None:
            self._step_s = step_size
            self._solver = prepare_solver(self._model, 1.0 / step_size)
            self._state = self._solver.rest_state()
        if abs(step_size - self._step_s) > 1e-9 * self._step_s:
            return False
        out = np.empty((OUTPUT_COUNT, 1))
        acceleration, displacement = (
            np.array([getattr(self, name)], dtype=np.float64) for name, _ in INPUTS
        )
        self._solver.advance(self._state, acceleration, displacement, out)
        for (name, _), value in zip(OUTPUTS, out[:, 0].tolist(), strict=False):
            setattr(self, name, value)
        self.time = current_time + step_size
        return bool(np.isfinite(out).all())
