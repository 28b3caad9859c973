"""Attached resonator: a second mass on a spring and a dashpot on the specimen, as a cable tray.

    M u'' + C u' + K u + F_R + F_L - m2 (w2^2 p + 2 z w2 p') = -M A
    y'' = -A - w2^2 p - 2 z w2 p',  p = y - u,  w2 = 2 pi frequency

y is the displacement of the second mass m2 relative to the table. Its states are p and y', so that
the acceleration of the specimen does not enter. M is the mass without m2. Passive: stored
m2 (w2^2 p^2 + y'^2) / 2, loss 2 z w2 m2 p'^2. At a frequency far above those of the motion m2
moves with the specimen: a mass error. Source: Den Hartog 1956, Mechanical Vibrations, the absorber.
"""

from twin.laws.effect import Effect, EffectParameter, State

EFFECT = Effect(
    id="appendage",
    description=__doc__,
    term="m2 (w2^2 (u - y) + 2 z w2 (u' - y')), y the displacement of an attached mass m2",
    constants={
        "w2": "2 * pi * frequency",
        "square": "w2 * w2",
        "decay": "2 * damping_ratio * w2",
        "spring": "mass * square",
        "dashpot": "mass * decay",
    },
    force="-spring * stretch - dashpot * (velocity - v)",
    states={
        "stretch": State("m", "velocity - v"),
        "velocity": State("m/s", "-a - square * stretch - decay * (velocity - v)"),
    },
    dissipates=True,
    parameters=(
        EffectParameter("mass", "kg", 0.0, 1e9, 0.0, 20.0, "m2, the attached mass."),
        EffectParameter(
            "frequency", "Hz", 1e-2, 1e3, None, 6.0, "w2 / (2 pi), with the specimen held."
        ),
        EffectParameter("damping_ratio", "", 1e-4, 2.0, None, 0.05, "z, of critical damping."),
    ),
    limits=("mass_error",),
    residual=(
        "A resonance and an antiresonance close together at one frequency, whatever the amplitude; "
        "free oscillation at it after each impact; force in phase with the acceleration below it."
    ),
    confused_with=("mass_error", "maxwell_damper"),
    required_channels=("table_acc_m_s2",),
)
