"""Errors of a model on a log that no fit has seen."""

import math
from dataclasses import dataclass, replace

from table_io.block import Float1D
from twin.discovery.discover import PreparedLog
from twin.discovery.motion import MeasuredMotion
from twin.discovery.parameters import GapKey, ParameterSet, get_log
from twin.discovery.residuals import LogResiduals, build_log_residuals


@dataclass(frozen=True, slots=True)
class ForceError:
    """Error of the damper force on the measured motion of a log, over the force itself.

    Both are standard deviations in N. Without load cells the force is the sum of all forces.
    """

    nrmse: float
    noise_floor: float  # what the noise of the sensors alone would leave


def compute_force_error(log: PreparedLog, parameters: ParameterSet) -> ForceError:
    """Return the error of the damper force on a log, with the gaps stated there.

    Whatever belongs to the specimen or to a sensor is kept from the fit, the speed of slip too;
    gap corrections, tare errors and nuisances are those of other logs.
    """
    kept = {key: value for key, value in parameters.values.items() if get_log(key) is None}
    parameters = replace(parameters, values={**kept, GapKey(0): 0.0}, free=())
    (residuals,) = build_log_residuals(
        [(log.signals.in_whole_band, log.contact_n)], parameters.to_model()
    )
    m = residuals.motion(parameters.assumed_sensors())
    mass = parameters.model_for_log(0, m).parameters.mass
    used = residuals.row_mask[0]
    force = residuals.measured_forces(m, mass)[0][used]
    error = residuals.force_errors(parameters, m)[0][used]
    noise = _force_noise(residuals, m, mass)
    return ForceError(_ratio(error, force), noise / max(float(force.std()), 1e-300))


def _force_noise(residuals: LogResiduals, m: MeasuredMotion, mass_kg: float) -> float:
    """Return the rms noise of the damper force in N, also where it is derived from u."""
    if residuals.whitening is None:
        return float(residuals.force_noise(m, mass_kg)[0])
    p = residuals.reference.parameters
    return mass_kg * residuals.signals.balance_noise(p.stiffness / mass_kg, p.damping / mass_kg)


def _ratio(error: Float1D, measured: Float1D) -> float:
    size = float(measured.std())
    return float(error.std()) / size if size > 0 else math.nan
