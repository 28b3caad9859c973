"""Tests that `check` calls ready, played up to the end of their loop check: none may be refused.

    python -m tests.studies.ready_tests --count 200 --seed 1

Profiles, records and rigs are drawn at random; each rig is tared, as a laboratory does. A line is
printed for each ready test: how it ended, of a refusal after motion with its reason.
"""

import argparse
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from table_io.acquisition.session import OperatorCommand, find_take_back, run_session
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from table_io.records import RunStop
from table_io.units import GRAVITY_M_S2
from twin.rig.check import check_test
from twin.rig.tare import TareOptions, tare
from twin.setup.run_config import RunConfig

KINDS = ("sweep", "sweep", "record", "long record", "random", "multisine", "swept_sine")
RECORDS = ("el_centro", "kobe", "erzincan", "newhall", "rinaldi", "sylmar", "chi_chi")
PROFILE = """
title = "ready"
rig = "rig.toml"
model = "snm"
[specimen]
mass_kg = {mass:.0f}
gap_mm = {gap:.2f}
[acquisition]
rate_hz = {rate:.0f}
"""


def draw_profile(rng: np.random.Generator, folder: Path) -> str:
    """Write a profile and its rig; return its kind."""
    kind = str(rng.choice(KINDS))
    rate = float(rng.choice([1000.0, 2000.0]))
    gap_mm = float(rng.choice([rng.uniform(0.5, 20.0), rng.uniform(-3.0, 0.0), np.inf]))
    text = PROFILE.format(mass=rng.uniform(200, 900), gap=gap_mm, rate=rate)
    level = 10 ** rng.uniform(-2.3, -0.5)
    low = 10 ** rng.uniform(-0.7, 0.6)
    if kind == "sweep":
        step_hz = round(low * rng.uniform(0.05, 0.3), 3)
        stop_hz = low + step_hz * rng.integers(2, 20)
        text += (
            f"[sweep]\nstart_hz = {low:.3f}\nstop_hz = {stop_hz:.3f}\n"
            f"step_hz = {step_hz}\ncycles = 4\nmeasured_cycles = 2\nacceleration_g = {level:.4f}\n"
        )
    elif kind == "swept_sine":
        text += (
            f'[excitation]\nkind = "swept_sine"\nstart_hz = {low:.3f}\n'
            f"stop_hz = {low * rng.uniform(2, 10):.3f}\nacceleration_g = {level:.4f}\n"
        )
    elif kind == "multisine":
        text += (
            f'[excitation]\nkind = "multisine"\nlow_hz = {low:.3f}\nhigh_hz = '
            f"{low * rng.uniform(3, 15):.3f}\nrms_g = {level / 3:.4f}\nduration_s = 8\n"
        )
    elif kind == "random":
        text += (
            f'[excitation]\nkind = "random"\nlow_hz = {low:.3f}\nhigh_hz = '
            f"{low * rng.uniform(3, 15):.3f}\nrms_g = {level / 3:.4f}\nduration_s = 20\n"
        )
    else:
        text += '[excitation]\nkind = "record"\n'
        if kind == "record":
            name = str(rng.choice(RECORDS))
            (folder / "record.csv").write_text((PROFILES_DIR / "tests" / f"{name}.csv").read_text())
        else:  # a pulse of a long period
            t = np.arange(0, 60, 0.01)
            f = 10 ** rng.uniform(-0.9, 0.5)
            acc = np.sin(2 * np.pi * f * t) * np.exp(-(((t - 30) * f / 2) ** 2))
            rows = [f"{a:.4f},{b:.6f}" for a, b in zip(t, 3 * acc, strict=True)]
            (folder / "record.csv").write_text("time_s,acceleration_m_s2\n" + "\n".join(rows))
        text += f'file = "record.csv"\nscale = {level:.3f}\nbaseline = "linear"\n'
        if rng.random() < 0.7:
            text += f"band_hz = [{rng.uniform(0.1, 0.6):.2f}, {rng.uniform(8, 20):.1f}]\n"
    (folder / "ready.toml").write_text(text)
    name = str(rng.choice(["simulated", "hydraulic", "paper_like"]))
    rig = (PROFILES_DIR / "rigs" / f"{name}.toml").read_text()
    louder = 10 ** rng.uniform(-0.5, 1.0)

    def make_louder(match: re.Match[str]) -> str:
        return f"noise_rms = {float(match[1]) * louder * 10 ** rng.uniform(-0.2, 0.2):.3g}"

    rig = re.sub(r"noise_rms = ([0-9.e-]+)", make_louder, rig)
    rig = re.sub(r"(?m)^bits = 18$", f"bits = {rng.choice([12, 14, 16, 18])}", rig)
    rig = re.sub(r"stroke_mm = 60.0", f"stroke_mm = {rng.uniform(20, 60):.0f}", rig)
    (folder / "rig.toml").write_text(rig)
    for record in (folder / "rig.tares").glob("*.toml"):
        record.unlink()
    tare(TareOptions(str(folder / "rig.toml")), lambda _: None)
    return f"{kind} on {name}"


def play_loop_check(config: RunConfig) -> tuple[str, str]:
    """Return (verdict, reason) of a run that is stopped once its excitation begins."""
    clock = ManualClock()
    backend = open_backend(config.rig, config.profile, clock)
    has_begun = [False]

    def operate() -> OperatorCommand | None:
        return OperatorCommand("stop", "study") if has_begun[0] else None

    for item in run_session(
        config.session_setup, backend, clock, config.make_start_factory("ready", "table"),
        operate, take_back=find_take_back(backend, clock),
    ):  # fmt: skip
        if isinstance(item, Block) and (item.step >= 0).any():
            has_begun[0] = True
        elif isinstance(item, RunStop):
            stop = item
    return ("begun", "") if has_begun[0] else (stop.verdict, stop.reason)


def draw_ready_tests(
    folder: Path, rng: np.random.Generator
) -> Iterator[tuple[str, RunConfig | None]]:
    """Yield (kind, configuration) of tests that `check` calls ready; the kind with its level."""
    while True:
        kind = draw_profile(rng, folder)
        try:
            config = check_test(folder / "ready.toml").config
            plan = config.profile.plan
            level_g = plan.level_m_s2 / GRAVITY_M_S2
            yield f"{kind}, {level_g:.3g} g, {plan.low_hz:.3g} to {plan.high_hz:.3g} Hz", config
        except InputError as error:
            yield f"not ready: {error}", None


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    ends = Counter[str]()
    with TemporaryDirectory() as name:
        for kind, config in draw_ready_tests(Path(name), np.random.default_rng(options.seed)):
            if config is None:
                ends["not ready"] += 1
                continue
            verdict, reason = play_loop_check(config)
            ends[verdict] += 1
            print(f"{sum(ends.values())} {kind}: {verdict} {reason}", flush=True)
            if sum(ends.values()) - ends["not ready"] >= options.count:
                break
    print(dict(ends))


if __name__ == "__main__":
    main()
