"""Table tilt: the table rocks as it moves, so part of the weight acts on the mass.

    M u'' + C u' + K u + F_R + F_L = -M A - M g theta,  theta = tilt x table displacement

theta in rad, positive where it pushes the mass to the left when the table is on the right;
g = 9.80665 m/s2. It acts as base acceleration A + g tilt x, so the closed form remains. The total
acceleration is u'' + A as elsewhere, in the laboratory's horizontal direction.
"""

from twin.laws.effect import Effect, EffectParameter

EFFECT = Effect(
    id="table_tilt",
    description=__doc__,
    term="-M g tilt x_t on the right side, x_t the table displacement",
    constants={"lean": "g * tilt"},
    force="lean * y",
    parameters=(
        EffectParameter("tilt", "rad/m", -1e3, 1e3, 0.0, 0.1, "Rotation per table displacement."),
    ),
    place="input",
    required_channels=("table_disp_m",),
    residual=(
        "Force in phase with the table's displacement, so it falls with 1/f^2 at constant "
        "acceleration: quasi-static, at low frequency, in flight and in contact alike."
    ),
    confused_with=("sensor_gain", "cubic_stiffness"),
)
