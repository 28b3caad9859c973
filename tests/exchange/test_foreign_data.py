"""The commands of FOREIGN_DATA.md, each run as it stands there on files as it describes them."""

import json
import re
import shlex
import tomllib
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter

from table_io.block import Float1D
from twin.cli.table import app
from twin.exchange import import_table
from twin.recording.reader import read_recording

PAGE = Path(import_table.__file__).with_name("FOREIGN_DATA.md")
RATE, MASS, STIFFNESS, DAMPING = 200.0, 250.0, 40e3, 600.0
FRICTION_N = 120.0


def write(path: Path, header: str, *columns: Float1D, above: str = "") -> None:
    np.savetxt(path, np.array(columns).T, "%.9g", ",", header=above + header, comments="")


def respond(acceleration: Float1D, u: float = 0.0) -> Float1D:
    """Displacement of the mass relative to its base, (sample,), from `u` at rest: small steps."""
    parts, v, out = 20, 0.0, np.empty(acceleration.size)
    dt = 1.0 / RATE / parts
    times = np.arange(acceleration.size * parts) / parts
    for step, value in enumerate(np.interp(times, np.arange(acceleration.size), acceleration)):
        if step % parts == 0:
            out[step // parts] = u
        v += dt * (-value - (STIFFNESS * u + DAMPING * v) / MASS)
        u += dt * v
    return out


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files as the page describes them."""
    folder = tmp_path_factory.mktemp("foreign")
    rng = np.random.default_rng(3)
    time = np.arange(0, 30, 1 / RATE)
    ramp = np.clip((time - 1) / 2, 0, 1) * np.clip((28 - time) / 2, 0, 1)
    for name, hz, amplitude in (
        ("slow", 0.5, 0.01), ("fast", 1.7, 0.01), ("large", 1.1, 0.025), ("damper", 1.0, 0.01),
    ):  # fmt: skip
        u = amplitude * ramp * np.sin(2 * np.pi * hz * time)
        v = np.gradient(u, time)
        force = STIFFNESS * u + DAMPING * v + FRICTION_N * np.tanh(v / 2e-4)
        u = u + 2e-6 * rng.normal(size=time.size)
        force = force + rng.normal(size=time.size)
        units = ("(in)", "(kip)") if name != "damper" else ("", "")
        header = f"time (s),stroke {units[0]},force {units[1]}"
        write(folder / f"{name}.csv", header, time, u / 0.0254, force / 4448.2216)
    drive = lfilter([1.0], [1.0, -0.7], rng.normal(size=time.size)) * ramp * 0.3
    u = respond(drive)
    total = np.gradient(np.gradient(u, time), time) + drive
    noise = 1e-3 * rng.normal(size=(2, time.size))
    write(
        folder / "accelerations.csv", "time (s),acc mass (g),acc table (g)",
        time, (total + noise[0]) / 9.80665, (drive + noise[1]) / 9.80665,
    )  # fmt: skip
    for number in (1, 2, 3):
        decay = respond(np.zeros(1000), u=0.01 * number)
        acc = -(STIFFNESS * decay + DAMPING * np.gradient(decay, time[:1000])) / MASS
        decay += 2e-6 * rng.normal(size=1000)
        acc += 1e-3 * rng.normal(size=1000)
        header = "time (s),displacement (cm),acc of mass (mm/s2)"
        write(folder / f"decay{number}.csv", header, time[:1000], 100 * decay, 1e3 * acc)
    push = -MASS * drive / 1e3
    wire = 1e3 * u + 2e-3 * rng.normal(size=time.size)
    write(folder / "push.csv", "time,wire,shaker", time, wire, push)
    lines = ["Sampling rate: 200 Hz", "Mass: 0.25 t", "Time  Disp  Acc table"]
    lines.append("s  mm  g")
    table = zip(time, wire, drive / 9.80665, strict=True)
    lines += ["  ".join(f"{value:.7g}" for value in row) for row in table]
    (folder / "table.txt").write_text("\n".join(lines))
    (folder / "push.toml").write_text(find_blocks("toml")[0])
    return folder


def find_blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(), re.S)


def run(line: str) -> None:
    words = shlex.split(line)
    assert words[0] == "shaketwin"
    with pytest.raises(SystemExit) as ended:
        app(words[1:])
    assert ended.value.code in (0, None), line


def test_the_commands_of_the_page_do_what_it_says(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    for line in "".join(find_blocks("sh")).splitlines():
        run(line)
        if "--save-map" in line:  # the user answers what is open
            text = (folder / "damper.toml").read_text()
            stroke, force = re.findall(r'^.*unit = "\?".*$', text, re.M)[::-1]
            answered = text.replace(stroke, stroke.replace("?", "in"))
            (folder / "damper.toml").write_text(answered.replace(force, force.replace("?", "kip")))
    logs = {path.stem for path in [*folder.glob("*.mcap"), *folder.glob("tests/*.mcap")]}
    assert logs == {
        "table", "part", "damper", "raw", "centred", "slow", "fast", "large", "accelerations",
        "push",
    }  # fmt: skip
    verdict = json.loads((folder / "found" / "verdict.json").read_text())
    assert "coulomb_friction" in [effect["id"] for effect in verdict["effects"]]
    model = tomllib.loads((folder / "found" / "model.toml").read_text())
    assert model["base"]["stiffness_n_m"] == pytest.approx(STIFFNESS, rel=0.01)
    (held_out,) = verdict["held_out_logs"]
    assert held_out["nrmse_after"] < 0.25 * held_out["nrmse_before"]
    identified = tomllib.loads((folder / "specimen.toml").read_text())["base"]
    assert identified["stiffness_n_m"] == pytest.approx(STIFFNESS, rel=0.01)


@pytest.mark.parametrize("name", ["push", "accelerations", "table"])
def test_the_logs_hold_one_motion(folder: Path, name: str) -> None:
    """However it was measured: relative displacement against what the specimen does."""
    log = folder / f"{name}.mcap"
    if not log.exists():
        pytest.skip("the commands of the page failed")
    (block,) = read_recording(log).contiguous_blocks("meas")
    u = respond(block.channel("table_acc_m_s2"))
    error = block.channel("rel_disp_m") - u
    inside = slice(500, -500)
    assert error[inside].std() < 0.05 * u[inside].std()
