"""Discovery on the measured sets of other laboratories: verdicts and held-out errors, a table.

    git clone https://github.com/labcontrol-data/mr-damper FOLDER/mr-damper
    git clone https://github.com/ARTS-Laboratory/Dataset-Friction-Damper-with-Backlash \\
        FOLDER/Dataset-Friction-Damper-with-Backlash
    git clone https://github.com/jaorozco1/physics-informed-lstm-base-isolation \\
        FOLDER/physics-informed-lstm-base-isolation
    git clone https://github.com/biaslab/nsi-silverbox FOLDER/nsi-silverbox
    python -m tests.studies.measured_sets FOLDER [--only CASE]... [--out DIR]

Each case is imported and discovered by the commands that a user would give. What they find is then
judged by a plain computation of its own, which shares no code with the product: the force laws of
the model file are evaluated with their own integrators on the held-out motion (component tests), or
the model is simulated (Silverbox). NRMSE = rms of (measured - modelled force) about its mean, over
the rms of the measured force about its mean, while it moves. A set that is not in FOLDER is listed
as absent. About a minute a case.
"""

import argparse
import json
import math
import subprocess
import sys
import time
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numba as nb
import numpy as np
from scipy.io import loadmat
from scipy.signal import resample_poly

from table_io.block import Float1D
from twin.system.exit_codes import EXIT_GAPS

SHAKETWIN = (sys.executable, "-c", "from twin.cli.table import main; main()")
INCH_M, KIP_N = 0.0254, 4448.2216152605
MR_RUNS = tuple(f"ensaio{number}.1" for number in range(1, 10))  # one current, falling amplitude
MR_MAP = """
rate_hz = 100.0
[columns]
rel_disp_m = { column = "x_F:1", unit = "mm" }
damper_force_n = { column = "x_F:3", unit = "N" }
"""
SILVERBOX_MAP = """
rate_hz = 610.3515625
[columns]
table_acc_m_s2 = { column = "V1", gain = -1.0 }
rel_disp_m = { column = "V2" }
"""
SILVERBOX_HZ = 1e7 / 2**14
ARROW, MULTISINE = slice(1000, 40500), slice(41000, 67000)  # rows: extrapolating test, training
# share of each floor of the five-storey building, from its base up, in the total mass
FLOOR_SHARES = (0.09328893, 0.1695185, 0.16294455, 0.11053888, 0.1059777, 0.35773146)
BNCS_HZ = 200.0
SUBSTEPS_PER_SAMPLE = 20  # of a sample, where a law with memory is integrated


@dataclass(frozen=True, eq=False)
class MeasuredRun:
    """Motion u in m and force in N of a component test, (sample,), for the judgement."""

    name: str
    rate_hz: float
    u: Float1D
    force: Float1D


@dataclass(frozen=True, eq=False)
class PreparedCase:
    """Files to import with one column map, the same runs, the held-out runs, the judgement."""

    files: tuple[Path, ...]
    column_map: str  # none: the proposed map is accepted
    training: tuple[MeasuredRun, ...] = ()
    held_out: tuple[MeasuredRun, ...] = ()
    judge: Callable[[dict[str, Any]], float] | None = None
    linear: dict[str, Any] | None = None  # model to compare with, if no force is measured
    options: tuple[str, ...] = ()  # of the import


@dataclass(frozen=True, eq=False)
class Case:
    """A measured set, what is known of it, and the largest held-out error.

    The verdict is right if it names one of `right_effects` and, of the specimen, only these and
    `tolerated_effects`; `expects_remainder`: a part that no library effect explains must be
    reported.
    """

    name: str
    source: str
    prepare: Callable[[Path, Path], PreparedCase]
    goal: float
    right_effects: frozenset[str]
    tolerated_effects: frozenset[str] = frozenset()
    expects_remainder: bool = False
    unit: str = ""


@dataclass(frozen=True)
class CaseResult:
    """Outcome of a case; `error` and `linear_error` are NRMSE, or mV."""

    name: str
    outcome: str
    effects: tuple[str, ...]
    confidence: float
    judgement: str
    linear_error: float
    error: float
    seconds: float
    details: tuple[str, ...] = field(default=())


# Preparation: the sets as files that a user would have


def prepare_mr_damper(folder: Path, scratch: Path, variant: str) -> PreparedCase:
    """Magnetorheological damper under sines at one current: odd runs train, even runs judge."""

    def read(name: str) -> MeasuredRun:
        table = loadmat(folder / "data" / f"{name}.mat")["x_F"].astype(float)
        return MeasuredRun(name, 100.0, 1e-3 * table[:, 0], table[:, 2])

    training, held_out = (tuple(map(read, names)) for names in (MR_RUNS[::2], MR_RUNS[1::2]))
    if variant in ("raw", "rest cut"):
        files = tuple(folder / "data" / f"{run.name}.mat" for run in training)
        latest_s = max(find_motion(run.u).start for run in training) / 100.0
        cut = ("--from", f"{latest_s:g}") if variant == "rest cut" else ()
        return PreparedCase(files, MR_MAP, training, held_out, options=cut)
    tables = []
    for run in training:
        columns = {
            "time (s)": np.arange(run.u.size) / run.rate_hz,
            "displacement (mm)": 1e3 * (run.u - run.u.mean()),
            "force (N)": run.force - run.force.mean(),
        }
        tables.append(write_table(scratch / f"{run.name}.csv", columns))
    return PreparedCase(tuple(tables), "", training, held_out)


def prepare_friction_damper(folder: Path, scratch: Path, training: str) -> PreparedCase:
    """Band-brake damper with backlash, one band tension, judged on earthquakes.

    Trained on sines, or on the earthquakes but one. (The earthquakes are the same files in the
    folders of 30 and of 36 lb; the force of the sines shows that they belong to 30 lb.)
    """
    data = folder / "data" / "dataset-3"
    names = ["ImperialValleyDBE", "ImperialValleyMCE", "KocaeliDBE", "KocaeliMCE"]
    earthquakes = [data / "earthquake profiles" / f"{name}.json" for name in names]
    sines = [
        data / "characterization tests" / f"{hz}Hz30lbtension{amplitude}amplitude.json"
        for hz in ("0.25", "0.5", "1")
        for amplitude in ("0.5", "1", "1.5")
    ]
    held_out = earthquakes if training == "sines" else earthquakes[1:2]
    trained = sines if training == "sines" else [p for p in earthquakes if p not in held_out]
    files: list[Path] = []
    runs = {}
    for path in (*trained, *held_out):
        time_s, inches, kips, *_ = np.array(json.loads(path.read_text())["data"]).T
        name = path.stem.replace(".", "_")
        runs[path] = MeasuredRun(name, 1024.0, INCH_M * inches, KIP_N * kips)
        columns = {"time (s)": time_s, "displacement (in)": inches, "friction force (kip)": kips}
        if path in trained:
            files.append(write_table(scratch / f"{name}.csv", columns))
    return PreparedCase(
        tuple(files), "", tuple(runs[path] for path in trained),
        tuple(runs[path] for path in held_out),
    )  # fmt: skip


def read_bearing_run(folder: Path, name: str) -> dict[str, Float1D]:
    """Return the channels of a run of the base-isolated building, per unit of its mass."""
    data = folder / "data" / f"BI-BNCS_{name}"

    def read(column: str) -> Float1D:
        return np.loadtxt(data / f"{column}.txt").ravel()

    floors = [read(f"a{number}") for number in range(1, 7)]
    columns = {
        "time_s": np.arange(floors[0].size) / BNCS_HZ,
        "rel_disp_m": read("d1"),
        "damper_force_n": -np.array(FLOOR_SHARES) @ np.array(floors),
        "table_acc_m_s2": read("u"),
        "mass_acc_m_s2": floors[0],
    }
    size = min(values.size for values in columns.values())
    return {key: values[:size] for key, values in columns.items()}


def prepare_bearings(folder: Path, scratch: Path) -> PreparedCase:
    """Building on high-damping rubber bearings: one motion at 50 and 140 % trains, four judge."""
    files: list[Path] = []
    runs = []
    for name in ("ICA50", "ICA140", "CNP100", "ICA100", "LAC100", "SP100"):
        columns = read_bearing_run(folder, name)
        runs.append(MeasuredRun(name, BNCS_HZ, columns["rel_disp_m"], columns["damper_force_n"]))
        if len(files) < 2:
            files.append(write_table(scratch / f"{name}.csv", columns))
    return PreparedCase(tuple(files), "", tuple(runs[:2]), tuple(runs[2:]))


def prepare_silverbox(folder: Path, scratch: Path) -> PreparedCase:
    """Electronic oscillator with cubic spring: trained on multisines, simulated on the arrow."""
    volts = np.genfromtxt(
        folder / "data" / "Silverbox" / "SNLS80mV.csv", delimiter=",", skip_header=1
    )[:, :2]
    part = volts[MULTISINE]
    file = write_table(scratch / "multisine.csv", {"V1": part[:, 0], "V2": part[:, 1]})

    return PreparedCase(
        (file,),
        SILVERBOX_MAP,
        judge=lambda model: simulate_arrow(volts, model),
        linear=fit_linear_oscillator(part),
    )


def write_table(path: Path, columns: dict[str, Float1D]) -> Path:
    """Write columns as a CSV file; return its path."""
    header = ",".join(columns)
    np.savetxt(path, np.array([*columns.values()]).T, delimiter=",", header=header, comments="")
    return path


# Judgement: plain evaluation of a model file


@nb.njit
def integrate_hysteresis(v: Float1D, dt: float, yield_displacement: float) -> Float1D:
    """Return Bouc-Wen's z, (sample,), by Heun steps: uy z' = v - (|v| z |z| + v z^2) / 2."""
    z, out = 0.0, np.empty(v.size)
    for sample in range(v.size):
        out[sample] = z
        if sample == v.size - 1:
            break
        for step in range(SUBSTEPS_PER_SAMPLE):
            first = v[sample] + (v[sample + 1] - v[sample]) * step / SUBSTEPS_PER_SAMPLE
            second = v[sample] + (v[sample + 1] - v[sample]) * (step + 1) / SUBSTEPS_PER_SAMPLE
            h = dt / SUBSTEPS_PER_SAMPLE / yield_displacement
            rate = first - 0.5 * (abs(first) * z * abs(z) + first * z * z)
            end = min(max(z + h * rate, -1.0), 1.0)
            after = second - 0.5 * (abs(second) * end * abs(end) + second * end * end)
            z = min(max(z + 0.5 * h * (rate + after), -1.0), 1.0)
    return out


@nb.njit
def integrate_relaxation(v: Float1D, dt: float, stiffness: float, tau: float) -> Float1D:
    """Return the force of a Maxwell branch, (sample,): f' = k1 v - f / tau, v piecewise linear."""
    force, out = 0.0, np.empty(v.size)
    decay = math.exp(-dt / tau)
    for sample in range(v.size):
        out[sample] = force
        if sample < v.size - 1:
            mean = 0.5 * (v[sample] + v[sample + 1])
            force = force * decay + stiffness * tau * (1.0 - decay) * mean
    return out


def evaluate_law(law: dict[str, Any], values: dict[str, float], u: Float1D, dt: float) -> Float1D:
    """Return the force in N of the law of an effect file on a motion, (sample,), by Heun steps."""
    states = [*law.get("states", {})]
    unpack = [f"{name} = {value!r}" for name, value in values.items()]
    rates = ", ".join(f"({state['rate']})" for state in law.get("states", {}).values())
    lines = [
        "def integrate(us, vs, ts, dt, substeps):",
        *(f"    {line}" for line in unpack),
        *(f"    {name} = 0.0" for name in states),
        "    out = np.empty(us.size)",
        "    for sample in range(us.size):",
        "        u, v, t, a = us[sample], vs[sample], ts[sample], 0.0",
        f"        out[sample] = {law['force']}",
        "        if sample == us.size - 1:",
        "            break",
    ]
    if states:
        old, first, second = (
            [f"{prefix}_{name}" for name in states] for prefix in ("old", "first", "second")
        )

        def assign(targets: Sequence[str], texts: Sequence[str]) -> str:
            pairs = zip(targets, texts, strict=True)
            return "; ".join(f"{target} = {text}" for target, text in pairs)

        rows = tuple(zip(states, old, first, second, strict=True))
        lines += [
            "        for step in range(substeps):",
            "            start, end = step / substeps, (step + 1) / substeps",
            "            u = us[sample] + (us[sample + 1] - us[sample]) * start",
            "            v = vs[sample] + (vs[sample + 1] - vs[sample]) * start",
            f"            {assign(old, states)}",
            f"            {', '.join(first)}, = ({rates},)",
            f"            {assign(states, [f'{o} + dt * {k}' for _, o, k, _ in rows])}",
            "            u = us[sample] + (us[sample + 1] - us[sample]) * end",
            "            v = vs[sample] + (vs[sample + 1] - vs[sample]) * end",
            f"            {', '.join(second)}, = ({rates},)",
            "            "
            + assign(states, [f"{o} + 0.5 * dt * ({k} + {m})" for _, o, k, m in rows]),
        ]
    source = "\n".join([*lines, "    return out"])
    namespace = {
        **{name: getattr(math, name) for name in ("sqrt", "exp", "log", "sin", "cos")},
        "sinh": math.sinh, "tanh": math.tanh, "np": np,
        "sign": nb.njit(lambda x: math.copysign(1.0, x)),
    }  # fmt: skip
    exec(source, namespace)  # of a model file that this study has just had written
    integrate: Callable[..., Float1D] = nb.njit(namespace["integrate"])
    v = np.gradient(u) / dt
    steps = SUBSTEPS_PER_SAMPLE
    return integrate(u, v, dt * np.arange(u.size), dt / steps, steps)


def evaluate_force(u: Float1D, rate_hz: float, model: dict[str, Any], slip_speed: float) -> Float1D:
    """Return the force of the damper of a model file on this motion, (sample,), in N."""
    v = np.gradient(u) * rate_hz
    force = model["base"]["stiffness_n_m"] * u + model["base"]["damping_n_s_m"] * v
    for effect in model.get("effects", ()):
        p = effect["parameters"]
        if "law" in effect:
            force = force + evaluate_law(effect["law"], p, u, 1.0 / rate_hz)
            continue
        match effect["id"]:
            case "cubic_stiffness":
                force = force + p["k3"] * u**3
            case "quadratic_damping":
                force = force + p["c2"] * v * np.abs(v)
            case "position_damping":
                force = force + p["cu"] * u**2 * v
            case "coulomb_friction":
                force = force + p["fc"] * np.tanh(v / slip_speed)
            case "stribeck_friction":
                falling = 1.0 + (p["ratio"] - 1.0) * np.exp(-((v / p["speed"]) ** 2))
                force = force + p["fc"] * falling * np.tanh(v / slip_speed)
            case "bouc_wen":
                z = integrate_hysteresis(v, 1.0 / rate_hz, p["yield_displacement"])
                force = force + p["force"] * z
            case "maxwell_damper":
                force = force + integrate_relaxation(v, 1.0 / rate_hz, p["k1"], p["tau"])
            case "sensor_offset" | "sensor_gain" | "sensor_lag":
                pass  # of an instrument; the forces are compared about their means
            case name:
                raise RuntimeError(f"{name} is in the model, and this study cannot evaluate it")
    return force


def compute_nrmse(run: MeasuredRun, model: dict[str, Any], slip_speed: float) -> float:
    """Return the NRMSE of the force of a held-out run while it moves, each about its mean."""
    force = evaluate_force(run.u, run.rate_hz, model, slip_speed)
    moving = find_motion(run.u)
    error = (run.force - force)[moving]
    return float(error.std() / run.force[moving].std())


def find_motion(u: Float1D) -> slice:
    """Return the samples from the first to the last that is off its end by 2 % of the range."""
    reach = 0.02 * np.ptp(u)
    off_start, off_end = np.abs(u - u[0]) > reach, np.abs(u - u[-1]) > reach
    return slice(int(np.argmax(off_start)), u.size - int(np.argmax(off_end[::-1])))


def fit_linear_force(runs: Sequence[MeasuredRun]) -> dict[str, Any]:
    """Return a model of spring and dashpot, by linear regression on the runs, as a model file."""
    rows, forces = [], []
    for run in runs:
        moving = find_motion(run.u)
        columns = np.array([run.u, np.gradient(run.u) * run.rate_hz])[:, moving]
        rows.append(columns.T - columns.mean(axis=1))
        forces.append(run.force[moving] - run.force[moving].mean())
    stiffness, damping = np.linalg.lstsq(np.vstack(rows), np.hstack(forces), rcond=None)[0]
    return {"base": {"stiffness_n_m": stiffness, "damping_n_s_m": damping}}


@nb.njit
def simulate_oscillator(
    push: Float1D, dt: float, stiffness: float, damping: float, cubic: float
) -> Float1D:
    """Return u of u'' + c u' + k u + k3 u^3 = push, (sample,): Runge-Kutta, two samples a step."""
    u, v, out = 0.0, 0.0, np.empty(push.size // 2)
    for step in range(out.size - 1):
        out[step] = u
        a, b, c = push[2 * step], push[2 * step + 1], push[2 * step + 2]
        v1, w1 = v, a - damping * v - stiffness * u - cubic * u**3
        u2, v2 = u + 0.5 * dt * v1, v + 0.5 * dt * w1
        w2 = b - damping * v2 - stiffness * u2 - cubic * u2**3
        u3, v3 = u + 0.5 * dt * v2, v + 0.5 * dt * w2
        w3 = b - damping * v3 - stiffness * u3 - cubic * u3**3
        u4, v4 = u + dt * v3, v + dt * w3
        w4 = c - damping * v4 - stiffness * u4 - cubic * u4**3
        u += dt / 6.0 * (v1 + 2.0 * v2 + 2.0 * v3 + v4)
        v += dt / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
    out[-1] = u
    return out


def simulate_arrow(volts: Float1D, model: dict[str, Any]) -> float:
    """Return the rms error of the simulated output in mV on the part that extrapolates.

    The model file gives stiffness, damping and cubic term; the gain and the offset of the input,
    which no model file holds, are those that fit the simulated training part best.
    """
    effects = {effect["id"]: effect["parameters"] for effect in model.get("effects", ())}
    cubic = effects.get("cubic_stiffness", {}).get("k3", 0.0)
    base, parts = model["base"], 16

    def simulate(rows: slice, gain: float, offset: float) -> Float1D:
        push = resample_poly(gain * volts[rows, 0] + offset, parts, 1)
        u = simulate_oscillator(
            push, 2.0 / SILVERBOX_HZ / parts, base["stiffness_n_m"], base["damping_n_s_m"], cubic
        )
        return u[:: parts // 2]

    gain, offset = base["stiffness_n_m"], 0.0  # the static gain of the box is about one
    rows, settled = MULTISINE, slice(2000, None)
    for _ in range(4):  # Gauss-Newton with finite differences
        u = simulate(rows, gain, offset)
        by_gain = (simulate(rows, 1.001 * gain, offset) - u) / (1e-3 * gain)
        by_offset = (simulate(rows, gain, offset + 1e-4 * gain) - u) / (1e-4 * gain)
        columns = np.array([by_gain, by_offset, np.ones(u.size)]).T[settled]
        step = np.linalg.lstsq(columns, (volts[rows, 1] - u)[settled], rcond=None)[0]
        gain, offset = gain + float(step[0]), offset + float(step[1])
    u = simulate(slice(0, ARROW.stop), gain, offset)
    return float(1e3 * (volts[: ARROW.stop, 1] - u)[ARROW].std())


def fit_linear_oscillator(volts: Float1D) -> dict[str, Any]:
    """Return the linear oscillator that fits (input, output), (sample, 2), best, as a model file.

    Regression on spectral lines: w^2 U = k U + i w c U - g V, in the band of the multisines.
    """
    window = np.hanning(len(volts))[:, None]
    push, u = np.fft.rfft((volts - volts.mean(axis=0)) * window, axis=0).T
    omega = 2 * np.pi * SILVERBOX_HZ * np.fft.rfftfreq(len(volts))
    inside = (omega > 2 * np.pi * 10.0) & (omega < 2 * np.pi * 180.0)
    left = omega**2 * u
    rows = (np.array([u, 1j * omega * u, -push]) / np.abs(left).mean())[:, inside].T
    target = (left / np.abs(left).mean())[inside]
    stiffness, damping, _ = np.linalg.lstsq(
        np.vstack([rows.real, rows.imag]), np.hstack([target.real, target.imag]), rcond=None
    )[0]
    return {"base": {"stiffness_n_m": stiffness, "damping_n_s_m": damping}}


# The cases


def make_mr_case(variant: str) -> Case:
    def prepare(folder: Path, scratch: Path) -> PreparedCase:
        return prepare_mr_damper(folder, scratch, variant)

    return Case(
        f"MR damper, {variant}",
        "mr-damper",
        prepare,
        0.12,
        frozenset({"bouc_wen", "coulomb_friction"}),
        frozenset({"quadratic_damping", "maxwell_damper"}),
    )


def make_friction_case(training: str, goal: float) -> Case:
    """Return the case with half the error of the best linear + Coulomb model as its goal."""

    def prepare(folder: Path, scratch: Path) -> PreparedCase:
        return prepare_friction_damper(folder, scratch, training)

    return Case(
        f"friction damper, {training}",
        "Dataset-Friction-Damper-with-Backlash",
        prepare,
        goal,
        frozenset({"coulomb_friction", "bouc_wen"}),
        expects_remainder=True,
    )


CASES = (
    make_mr_case("raw"),
    make_mr_case("mean removed"),
    make_mr_case("rest cut"),
    make_friction_case("sines", 0.48),
    make_friction_case("earthquakes", 0.59),
    Case(
        "BNCS",
        "physics-informed-lstm-base-isolation",
        prepare_bearings,
        0.255,
        frozenset({"bouc_wen"}),
        expects_remainder=True,
    ),
    Case(
        "Silverbox", "nsi-silverbox", prepare_silverbox, 0.7, frozenset({"cubic_stiffness"}),
        unit=" mV",
    ),
)  # fmt: skip
INSTRUMENT_EFFECTS = frozenset({"sensor_offset", "sensor_gain", "sensor_lag"})


def run_shaketwin(*arguments: str | Path) -> str:
    """Run a command of the product; return its output, raise RuntimeError if it fails."""
    done = subprocess.run(
        [*SHAKETWIN, *map(str, arguments)], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, EXIT_GAPS):
        raise RuntimeError(f"shaketwin {arguments[0]}: {(done.stderr or done.stdout).strip()}")
    return done.stdout


def run_case(case: Case, folder: Path, out: Path) -> CaseResult:
    """Import and discover a case, and judge what was found."""
    out.mkdir(parents=True)
    prepared = case.prepare(folder, out)
    (out / "map.toml").write_text(prepared.column_map)
    logs = []
    for file in prepared.files:
        log = out / f"{file.stem}.mcap"
        given = ["--columns", str(out / "map.toml")] if prepared.column_map else ["--accept"]
        options = [*given, *prepared.options]
        run_shaketwin("import", file, "-o", log, *options)
        logs.append(log)
    start_s = time.monotonic()
    text = run_shaketwin("discover", *logs, "--out", out / "discovery")
    seconds = time.monotonic() - start_s
    (out / "discover.txt").write_text(text)
    verdict = json.loads((out / "discovery" / "verdict.json").read_text())
    model = tomllib.loads((out / "discovery" / "model.toml").read_text())
    for effect in model.get("effects", ()):
        if "file" in effect:
            effect["law"] = tomllib.loads((out / "discovery" / effect["file"]).read_text())
    if prepared.judge is not None:
        linear_error = prepared.judge(prepared.linear or model)
        return summarize(case, verdict, linear_error, prepared.judge(model), seconds)
    slip_speed = next(
        (effect["slip_speed"]["value"] for effect in verdict["effects"] if "slip_speed" in effect),
        1e-3,
    )
    linear = fit_linear_force(prepared.training)
    errors = {run.name: compute_nrmse(run, model, slip_speed) for run in prepared.held_out}
    linear_errors = [compute_nrmse(run, linear, slip_speed) for run in prepared.held_out]
    return summarize(
        case,
        verdict,
        float(np.mean(linear_errors)),
        float(np.mean([*errors.values()])),
        seconds,
        tuple(f"{name} {error:.3f}" for name, error in errors.items()),
    )


def summarize(
    case: Case,
    verdict: dict[str, Any],
    linear_error: float,
    error: float,
    seconds: float,
    details: tuple[str, ...] = (),
) -> CaseResult:
    """Judge a verdict: right, refused (honest), or wrong, with the reason."""
    names = tuple(
        ".".join(filter(None, (effect["id"], effect.get("channel", ""))))
        for effect in verdict["effects"]
    )
    specimen = {effect["id"] for effect in verdict["effects"]} - INSTRUMENT_EFFECTS
    sets = [{name.split(".")[0] for name in ids} for ids in verdict["ambiguous"]]
    if verdict["verdict"] == "unexplained":
        judgement = "refused"
    elif verdict["verdict"] == "ambiguous" and any(case.right_effects & ids for ids in sets):
        judgement = "refused (right among the candidates)"
    elif not specimen & case.right_effects:
        judgement = "WRONG: the known effect is not named"
    elif specimen - case.right_effects - case.tolerated_effects:
        extra = specimen - case.right_effects - case.tolerated_effects
        judgement = f"WRONG: also {', '.join(sorted(extra))}"
    elif case.expects_remainder and not verdict["remainder"]["unexplained"]:
        judgement = "right, but the remainder is not reported"
    else:
        judgement = "right"
    confidence = min((effect["confidence"] for effect in verdict["effects"]), default=math.nan)
    return CaseResult(
        case.name, verdict["verdict"], names, confidence, judgement, linear_error, error, seconds,
        details,
    )  # fmt: skip


def format_row(case: Case, result: CaseResult) -> str:
    """Format a result as a row of the table."""
    met = "met" if result.error <= case.goal else "MISSED"
    effects = " + ".join(result.effects) or "-"
    return (
        f"| {case.name} | {result.outcome}: {effects} ({result.confidence:.2f}) | "
        f"{result.judgement} | {result.linear_error:.3g}{case.unit} | "
        f"{result.error:.3g}{case.unit} | {case.goal:g}{case.unit}: {met} | "
        f"{result.seconds:.0f} s |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--only", action="append", default=[], help="Cases that contain this.")
    parser.add_argument("--out", type=Path, help="New folder that keeps logs and results.")
    arguments = parser.parse_args()
    print("| set | verdict (confidence) | judged | linear | model | goal | discover |")
    print("|---|---|---|---|---|---|---|", flush=True)
    with TemporaryDirectory() as temporary:
        for case in CASES:
            if arguments.only and not any(part in case.name for part in arguments.only):
                continue
            folder = arguments.folder / case.source
            if not folder.is_dir():
                print(f"| {case.name} | absent: {folder} | | | | | |", flush=True)
                continue
            out = (arguments.out or Path(temporary)) / case.name.replace(" ", "_").replace(",", "")
            try:
                result = run_case(case, folder, out)
            except (RuntimeError, OSError) as error:
                print(f"| {case.name} | FAILED: {error} | | | | | |", flush=True)
                continue
            print(format_row(case, result), flush=True)
            if result.details:
                print(f"  held out: {', '.join(result.details)}", flush=True)


if __name__ == "__main__":
    main()
