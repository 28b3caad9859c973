"""`Parameters` of the SNM in SI, and its free-flight resonance."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields

from table_io.errors import InputError, suggest


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of the SNM in SI: kg, N/m, N s/m, m. Gaps at rest, inf = no bumper, < 0 = preload.

    M u'' + C u' + K u + F_R + F_L = -M A;  F_j = C_j u_j' + K_j u_j in contact, 0 in flight.
    C_j = 0 is a bumper without memory: its face returns at once, contact ends at u_j = 0.
    Source: Stefani, De Angelis, Andreaus, Sect. 5.
    """

    mass: float
    stiffness: float
    damping: float
    bumper_stiffness_r: float
    bumper_damping_r: float
    bumper_stiffness_l: float
    bumper_damping_l: float
    gap_r: float
    gap_l: float

    def __post_init__(self) -> None:
        for name, value in self.as_dict().items():
            if name.startswith("gap"):
                if math.isnan(value) or value == -math.inf:
                    raise InputError(
                        "not a gap", key=name, value=float(value), allowed="m, or inf for no bumper"
                    )
            elif not math.isfinite(value) or value < 0 or (value == 0 and "damping" not in name):
                allowed = "0 or more" if "damping" in name else "more than 0"
                raise InputError(
                    "out of range",
                    key=name,
                    value=float(value),
                    allowed=f"{allowed}, finite, in SI units",
                )

    def as_dict(self) -> dict[str, float]:
        """Return field name -> SI value."""
        return {field.name: getattr(self, field.name) for field in fields(self)}

    @classmethod
    def from_dict(cls, values: Mapping[str, float]) -> "Parameters":
        """Build from the values of `as_dict`; InputError names missing or unknown ones."""
        known = [field.name for field in fields(cls)]
        for name in values:
            if name not in known:
                raise InputError("unknown model parameter", key=name, remedy=suggest(name, known))
        missing = [name for name in known if name not in values]
        if missing:
            raise InputError(
                "missing model parameters", key=", ".join(missing), remedy="add them in SI units"
            )
        return cls(**{name: float(values[name]) for name in known})


def free_flight_resonance(
    parameters: Parameters, acceleration: float
) -> tuple[float, float, float]:
    """Return free-flight maxima (u* in m, a* in m/s2, frequency of u* in Hz) at peak A in m/s2.

    Linear oscillator, steady, continuous in frequency; u relative, a total; w0^2 = K/M,
    z = C / (2 M w0). Each maximum lies at its own frequency:
        u* = A / (2 z w0^2 sqrt(1 - z^2))        at w = w0 sqrt(1 - 2 z^2), or A/w0^2 at w = 0
        a* = A T,  T^2 = (1 + x) / ((1 - r^2)^2 + x),  x = (2 z r)^2,
                                                 at r^2 = (sqrt(1 + 8 z^2) - 1) / (4 z^2)
    For the SNM at 0.05 g: 30.537 mm at 1.2678 Hz, and 2.057 m/s2 at 1.2690 Hz.
    """
    if parameters.damping == 0:
        raise InputError(
            "the free-flight resonance is unbounded",
            key="damping",
            value=0,
            allowed="above 0 N s/m",
        )
    w02 = parameters.stiffness / parameters.mass
    z2 = parameters.damping**2 / (4 * parameters.mass * parameters.stiffness)
    r2 = 4 / (math.sqrt(1 + 8 * z2) + 1) / 2
    x = 4 * z2 * r2
    a = acceleration * math.sqrt((1 + x) / ((1 - r2) ** 2 + x))
    if 2 * z2 >= 1:
        return acceleration / w02, a, 0.0
    u = acceleration / (2 * w02 * math.sqrt(z2 * (1 - z2)))
    return u, a, math.sqrt(w02 * (1 - 2 * z2)) / (2 * math.pi)
