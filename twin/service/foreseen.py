"""What every sensor should see at every step, by the model, beside the range of each.

The model is no law: a sensor that it drives out of range is worth a warning, not a refusal. What
the drive alone asks of the table's own sensors is refused in `table_io.limits`.
"""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.limits import ROOM
from table_io.rig import Rig
from table_io.sensor import Sensor
from table_io.units import GRAVITY_M_S2
from twin.model.ideal import swept
from twin.service.bundle import Bundle

FULL = 1.0 / ROOM  # of a range: beyond it a warning; the true specimen is not the model


@dataclass(frozen=True, slots=True)
class Foreseen:
    """The largest value of a sensor over the sweep, in the sensor's unit, and where."""

    sensor: Sensor
    peak: float
    frequency_hz: float
    direction: str

    @property
    def used(self) -> float:
        """Share of the sensor's range."""
        return self.peak / self.sensor.range


def foreseen(bundle: Bundle) -> tuple[Foreseen, ...]:
    """One entry a sensor of the rig."""
    found = []
    peaks = _peaks(bundle)
    for sensor in bundle.rig.sensors:
        if sensor.channel in peaks:
            values = peaks[sensor.channel]
            step = bundle.steps[int(np.argmax(values))]
            peak = float(values.max()) / sensor.si_per_unit
            found.append(Foreseen(sensor, peak, step.frequency_hz, step.direction))
    return tuple(found)


def _peaks(bundle: Bundle) -> dict[str, Float1D]:
    """Peak of each channel at each step, SI, (step,).

    Total displacement of the mass: at most that of the table and of the mass on it together.
    """
    steps, sweep = bundle.steps, bundle.profile.sweep
    frequencies = np.array([step.frequency_hz for step in steps])
    level = sweep.acceleration_g * GRAVITY_M_S2
    # The first step twice: the true drive starts softly, the ideal one would knock.
    motion = swept(bundle.model, np.r_[frequencies[:1], frequencies], level, sweep.cycles)
    table = level / (2 * np.pi * frequencies) ** 2

    def largest(*names: str) -> Float1D:
        rows = [np.abs(motion.column(name)[1:]).max(axis=1) for name in names]
        peaks: Float1D = np.max(rows, axis=0)
        return peaks

    u, a = largest("u_max", "u_min"), largest("a_max", "a_min")
    right, left = largest("f_r_max"), largest("f_l_min")
    peaks = {
        "drive_disp_m": table,
        "table_disp_m": table,
        "table_acc_m_s2": np.full(frequencies.size, level),
        "mass_disp_m": u + table,
        "mass_acc_m_s2": a,
        "rel_disp_m": u,
        "damper_force_n": bundle.profile.specimen.mass_kg * a + np.maximum(right, left),
    }
    for cells, force in ((RIGHT_CELLS, right), (LEFT_CELLS, left)):
        present = [name for name in cells if name in bundle.rig.channels]
        peaks |= {name: force / len(present) for name in present}
    return peaks


def clipped(rows: tuple[Foreseen, ...], rig: Rig) -> list[str]:
    """A warning for each sensor that the model drives near the end of its range or beyond it."""
    return [
        f"{row.sensor.channel}: the model foresees {row.peak:.4g} {row.sensor.unit} at "
        f"{row.frequency_hz:g} Hz {row.direction}, {100 * row.used:.0f} % of its range on "
        f"{rig.name!r}; use a sensor with a larger range"
        for row in rows
        if row.used > FULL
    ]
