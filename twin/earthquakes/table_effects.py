"""Library of the effects that a table may have beside its basic twin; see `table_evidence.py`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TableEffectParameter:
    """Parameter of an effect in SI: typical (its size for screening), smallest, largest value."""

    name: str
    unit: str
    typical: float
    low: float
    high: float
    meaning: str


@dataclass(frozen=True)
class TableEffect:
    """An effect that a table may have: its first parameter makes it vanish at 0.

    `trials` are the values at which its slope is taken, of all its parameters in their order.
    """

    id: str
    description: str
    equation: str
    source: str
    parameters: tuple[TableEffectParameter, ...]
    trials: tuple[tuple[float, ...], ...]

    @property
    def name(self) -> str:
        return self.id

    @property
    def amplitude(self) -> TableEffectParameter:
        """The parameter that makes it vanish at 0."""
        return self.parameters[0]

    @property
    def shapes(self) -> tuple[tuple[float, ...], ...]:
        """Trial values of the other parameters."""
        return tuple(dict.fromkeys(trial[1:] for trial in self.trials))

    @property
    def used_keys(self) -> frozenset[object]:
        return frozenset(parameter.name for parameter in self.parameters)

    @property
    def bounds(self) -> dict[str, tuple[float, float, float]]:
        """Return typical, smallest and largest value by name, as those of BOUNDS."""
        return {
            parameter.name: (parameter.typical, parameter.low, parameter.high)
            for parameter in self.parameters
        }


def _list_trials(*sizes: float) -> tuple[tuple[float, ...], ...]:
    return tuple((size,) for size in sizes)


LIBRARY: tuple[TableEffect, ...] = (
    TableEffect(
        "dead_band",
        "dead band of the valve: the spool overlaps its ports",
        "u -> u - d_v sat(u / d_v)",
        "Merritt, Hydraulic Control Systems (1967), chapter 5",
        (
            TableEffectParameter(
                "dead_band_m_s", "m/s", 1e-3, 0.0, 0.1, "No-load speed lost on either side."
            ),
        ),
        _list_trials(1e-4, 5e-4, 1.5e-3, 4e-3, 1e-2),
    ),
    TableEffect(
        "valve_hysteresis",
        "hysteresis of the valve: its opening depends on the direction of its last motion",
        "u -> u - w_h z_h / 2, z_h' = 2 u' / w_h (1 - z_h sign(u'))",
        "Merritt (1967), chapter 7; loop of Dahl, Aerospace Corp. TOR-0158 (1968)",
        (
            TableEffectParameter(
                "valve_hysteresis_m_s", "m/s", 1e-3, 0.0, 0.1, "Width of the loop, no-load speed."
            ),
        ),
        _list_trials(2e-4, 1e-3, 3e-3, 8e-3),
    ),
    TableEffect(
        "flow_asymmetry",
        "flow that differs with direction: unequal piston areas or ports of the valve",
        "u -> u (1 + a_u sign(u))",
        "Merritt (1967), chapter 6",
        (
            TableEffectParameter(
                "flow_asymmetry", "", 0.02, -0.6, 0.6, "Half the difference over the mean."
            ),
        ),
        _list_trials(0.05),
    ),
    TableEffect(
        "friction_drift",
        "friction that drifts with time, as oil and seals warm up",
        "F -> (1 + d_F t) F",
        "Merritt (1967), chapter 1: viscosity of oil over temperature",
        (
            TableEffectParameter(
                "friction_drift_1_s", "1/s", 2e-3, -0.02, 0.05, "Relative change per time."
            ),
        ),
        _list_trials(2e-3),
    ),
    TableEffect(
        "friction_asymmetry",
        "friction that differs with direction",
        "z -> +-(1 + a_F sign(v)) instead of +-1, of the same stiffness",
        "Armstrong-Hélouvry et al., Automatica 30 (1994) 1083",
        (
            TableEffectParameter(
                "friction_asymmetry", "", 0.02, -0.8, 0.8, "Half the difference over the mean."
            ),
        ),
        _list_trials(0.05),
    ),
    TableEffect(
        "friction_slope",
        "friction that changes along the stroke",
        "z -> +-(1 + g_F (y - y_f)) instead of +-1, of the same stiffness",
        "Armstrong-Hélouvry et al. (1994)",
        (
            TableEffectParameter(
                "friction_slope_1_m", "1/m", 2.0, -200.0, 200.0, "Relative change per length."
            ),
        ),
        _list_trials(5.0),
    ),
    TableEffect(
        "backlash",
        "backlash of the coupling between piston and table",
        "f -> f - K b/2 sat(2 f / (K b))",
        "Nordin, Gutman, Automatica 38 (2002) 1633",
        (
            TableEffectParameter(
                "backlash_m", "m", 1e-5, 0.0, 5e-3, "Free travel from stop to stop."
            ),
        ),
        _list_trials(3e-6, 1e-5, 4e-5, 1.5e-4),
    ),
    TableEffect(
        "transducer_gain",
        "gain error of the transducer that closes the stroke loop",
        "q_t = (1 + g_t) (y - y_f)",
        "Conte, Trombetti, Earthquake Engng Struct. Dyn. 29 (2000) 1375",
        (
            TableEffectParameter(
                "transducer_gain_error", "", 0.005, -0.3, 0.3, "Relative error; + reads too much."
            ),
        ),
        _list_trials(0.01),
    ),
    TableEffect(
        "transducer_lag",
        "lag of the transducer in the stroke loop, of its filter",
        "t_t q_t' = y - y_f - q_t",
        "Conte, Trombetti (2000)",
        (TableEffectParameter("transducer_lag_s", "s", 1e-3, 0.0, 0.05, "Time constant."),),
        _list_trials(2e-3, 8e-3),
    ),
    TableEffect(
        "second_frame_mode",
        "second resonance of the frame or of the floor that bears the actuator",
        "y_f -> y_f + y_2, y_2'' = -r_2 (f - F) / m - w_2 (w_2 y_2 + 2 z_2 y_2')",
        "Conte, Trombetti (2000), extended by a mode",
        (
            TableEffectParameter(
                "second_frame_ratio", "", 0.005, 0.0, 1.0, "Mass of the table over its modal mass."
            ),
            TableEffectParameter("second_frame_hz", "Hz", 25.0, 4.0, 60.0, "Its frequency."),
            TableEffectParameter("second_frame_damping", "", 0.05, 0.01, 0.5, "Its damping."),
        ),
        tuple((0.005, hz, 0.06) for hz in (6.0, 8.0, 10.0, 18.0, 21.0, 24.0, 27.0, 30.0, 34.0)),
    ),
)
EFFECT_BY_ID = {effect.id: effect for effect in LIBRARY}
# What a table may have too, and why a rehearsal at low level does not show it.
UNTESTED = {
    "valve null offset": "it only shifts the table, which the tare takes away",
    "saturation of valve opening or slew": "the valve opens by a few percent of its travel only",
    "sag of the supply pressure": "the flow is a few percent of the largest only",
    "oil stiffness along the stroke": "the stroke used changes the oil volumes by too little",
    "error of the moving mass": "a motion shows ratios of force to mass only",
}
