"""The unstable branch of G4 on the simulated table, against the orbits of that plant by shooting.

As a script, as fast as it computes: python -m tests.studies.branch_study --help.
Neither twin nor recording take part; the plan is that of the nominal model.
"""

import argparse
import math
import time
from pathlib import Path

import numpy as np

from table_io.acquisition.session import SessionSetup, run_session
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Event, OrbitPoint, RunStart, RunStop, Trip
from table_io.sim.plant import Plant
from tests.table_io.sim.plant_orbits import trace_orbits
from twin.results.orbits import find_measured_folds
from twin.setup.run_config import RunConfig, read_run_config

MASS_KG, STIFFNESS_N_M = 550.0, 36e3
LEVEL_M_S2 = 0.05 * 9.80665
REACH_HZ = 0.01  # of a fold, in which the frequency says little of the amplitude


def make_config(
    folder: Path, seed: int, mass: float, stiffness: float, points: int, multipliers: bool
) -> RunConfig:
    """Return the shipped test on a rig whose specimen is `mass` and `stiffness` times the model."""
    rig = (PROFILES_DIR / "rigs" / "simulated.toml").read_text()
    rig = rig.replace("seed = 1\n", f"seed = {seed}\n").replace(
        "damper_stiffness_n_m = 36000.0", f"damper_stiffness_n_m = {stiffness * STIFFNESS_N_M}"
    )
    if mass != 1.0:
        rig += f"\n[simulated.hidden.base]\nmass_kg = {mass * MASS_KG}\n"
    (folder / "rig.toml").write_text(rig)
    profile = (PROFILES_DIR / "tests" / "g4_unstable.toml").read_text()
    profile = profile.replace("points = 64", f"points = {points}")
    if not multipliers:
        profile += "multiplier_periods = 0\n"
    (folder / "branch.toml").write_text(profile)
    return read_run_config(folder / "branch.toml", str(folder / "rig.toml"))


def play(profile: Profile, rig: RigConfig) -> tuple[list[OrbitPoint], list[Event | Trip], float]:
    """Return the orbits, what was lost or tripped, and the duration of the test in s."""
    clock, points, faults, last = ManualClock(), [], [], 0
    backend = open_backend(rig, profile, clock)

    def describe(tare: dict[str, float], epoch_s: float) -> RunStart:
        return RunStart(
            0, "r", "n", "table", "", "", "", backend.rate_hz, 20, rig.channels, profile.steps, 0,
            tare, {}, "", "", epoch_s,
        )  # fmt: skip

    for item in run_session(SessionSetup(profile, rig), backend, clock, describe, lambda: None):
        if isinstance(item, Block):
            last = item.end
        elif isinstance(item, OrbitPoint):
            points.append(item)
        elif isinstance(item, Trip) or (isinstance(item, Event) and item.kind == "lost"):
            faults.append(item)
            print(item, flush=True)
        elif isinstance(item, RunStop):
            print(item.verdict, item.reason, flush=True)
    return points, faults, last / backend.rate_hz


def compare(points: list[OrbitPoint], mass: float, stiffness: float) -> None:
    """Print the errors of the measured orbits, multipliers and folds against the plant's."""
    plant = Plant(
        mass * MASS_KG, stiffness * STIFFNESS_N_M, 1100.0, 510e3, 900.0, 2e-3, 2e-3, 2000.0, 20.0,
        0.0, True, 1000.0,
    )  # fmt: skip
    accepted = [point for point in points if point.accepted]
    measured_m = np.array([math.hypot(*point.u_m[2:4]) for point in accepted])
    orbits = trace_orbits(plant, LEVEL_M_S2, 1.7e-3, 1.02 * float(measured_m.max()))
    true_m, true_hz, multipliers = (
        np.array(values)
        for values in zip(
            *((o.fundamental_m, o.frequency_hz, abs(o.multiplier)) for o in orbits), strict=True
        )
    )
    turns = np.flatnonzero(np.diff(np.sign(np.diff(true_hz)))) + 1
    folds_hz = [find_extremum(true_m[t - 1 : t + 2], true_hz[t - 1 : t + 2]) for t in turns]
    first, last = turns[0], turns[-1]
    errors, deviations = [], []
    for point, amplitude in zip(accepted, measured_m, strict=True):
        hz = point.frequency_hz
        off_hz = hz - np.interp(amplitude, true_m, true_hz)
        error = math.nan
        if not point.stable and true_hz[first] < hz < true_hz[last]:
            error = amplitude / np.interp(hz, true_hz[first:last], true_m[first:last]) - 1
            if min(hz - true_hz[first], true_hz[last] - hz) > REACH_HZ:
                errors.append(abs(error))
        true = np.interp(amplitude, true_m, multipliers)
        if point.multiplier_sd:
            deviations.append((point.multiplier - true) / point.multiplier_sd)
        print(
            f"{point.step:3d} {hz:.4f} Hz {1e3 * amplitude:.4f} mm: {1e3 * off_hz:+.1f} mHz, "
            f"{100 * error:+.2f} %; multiplier {point.multiplier:.3f} ({true:.3f})"
        )
    print(f"amplitude of the unstable orbits: at most {100 * max(errors):.2f} % off "
          f"({len(errors)}, {1e3 * REACH_HZ:g} mHz from the folds)")  # fmt: skip
    if deviations:
        rms = math.sqrt(np.mean(np.square(deviations)))
        print(f"multipliers: {len(deviations)}, {rms:.2f} standard deviations off (rms)")
    measured_folds = find_measured_folds(
        [
            {"accepted": point.accepted, "stable": point.stable,
             "amplitude_m": point.amplitude_m, "frequency_hz": point.frequency_hz}
            for point in points
        ]
    )  # fmt: skip
    for fold in measured_folds:
        true = min(folds_hz, key=lambda hz: abs(hz - fold["frequency_hz"]))
        print(f"{fold['kind']} fold {fold['frequency_hz']:.4f} Hz, of the plant {true:.4f} Hz")


def find_extremum(x: np.ndarray, y: np.ndarray) -> float:
    """Return the extremum of the parabola through three points."""
    parabola = np.polynomial.Polynomial.fit(x, y, 2)
    return float(parabola(parabola.deriv().roots()[0]))


def main() -> None:
    """Play the branch and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--mass", type=float, default=1.0, help="of the plant over the model's")
    parser.add_argument("--stiffness", type=float, default=1.0, help="the same")
    parser.add_argument("--points", type=int, default=64, help="unstable orbits that are planned")
    parser.add_argument("--multipliers", action="store_true", help="measure Floquet multipliers")
    parser.add_argument("--folder", type=Path, required=True, help="for rig and profile")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    config = make_config(
        arguments.folder, arguments.seed, arguments.mass, arguments.stiffness, arguments.points,
        arguments.multipliers,
    )  # fmt: skip
    began = time.process_time()
    points, faults, duration_s = play(config.profile, config.rig)
    accepted = [point for point in points if point.accepted]
    periods = [point.periods for point in points]
    shares = [math.hypot(*point.feedback_m) / point.command_m for point in accepted]
    print(
        f"{len(accepted)} of {len(config.steps)} orbits, {sum(not p.stable for p in accepted)} "
        f"unstable; {len(faults)} lost or tripped; periods median {np.median(periods):g}, 90 % "
        f"{np.percentile(periods, 90):g}, most {max(periods)}; {duration_s / 60:.1f} min of rig "
        f"time in {time.process_time() - began:.0f} s; feedback at most {100 * max(shares):.2f} % "
        f"of the command"
    )
    compare(points, arguments.mass, arguments.stiffness)


if __name__ == "__main__":
    main()
