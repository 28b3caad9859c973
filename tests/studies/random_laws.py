"""Random force laws under a recorded test: each is refused, fails by name, or is finite throughout.

    python -m tests.studies.random_laws --count 200 --seed 1

Expressions, widths, ranges and magnitudes are drawn here, without the checks of the product. Laws
that `run` refuses for the test are replayed all the same, as `replay --model` takes them.
"""

import argparse
import signal
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import Event
from tests.builders.profiles import NO_LOOP_CHECK, format_test
from twin.model.config import load_model_config
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.results.rerun import rerun_twin
from twin.results.summary import summarise
from twin.setup.law_limits import check_laws
from twin.setup.run_config import RunConfig, from_texts, read_run_config
from twin.setup.unpaced import play_unpaced

MAX_LAW_S = 30
PROFILE = format_test(
    2.8,
    3.2,
    0.2,
    acceleration_g=0.05,
    tables=NO_LOOP_CHECK | {"acquisition": {"rate_hz": 1000.0, "block_samples": 20}},
)
BASE = """
title = "with a random law"
[base]
stiffness_n_m = 36000.0
damping_n_s_m = 1100.0
bumper_stiffness_n_m = 510000.0
bumper_damping_n_s_m = 900.0
[[effects]]
file = "law.toml"
[effects.parameters]
"""


def write_law(rng: np.random.Generator, folder: Path) -> tuple[Path, str]:
    """Write a model with a random law; return its path and the law in words."""
    in_bumper = rng.random() < 0.3
    length = "d" if in_bumper else "u"
    expression = _draw_expression(rng, ["x", "y"], 3)
    expression = expression.replace("x", f"({length}/w)").replace("y", "(v/s)")
    sign = rng.choice(["", "-"])
    force = f"{sign}k*({expression})"
    force = force.replace("k*", f"k*({length}/w)*") if rng.random() < 0.6 else force
    amplitude, width = 10 ** rng.uniform(-1, 16), 10 ** rng.uniform(-5, 0)
    speed = 10 ** rng.uniform(-4, 1)
    if rng.random() < 0.6:
        amplitude = 10 ** rng.uniform(-1, 4)
    lines = [
        'id = "random_law"', f'place = "{"bumpers" if in_bumper else "damper"}"',
        f'force = "{force}"', "[parameters]",
        'k = { unit = "N", low = 0.0, high = 1e17, vanishing = 0.0, typical = 1.0 }',
        f'w = {{ unit = "m", low = 1e-6, high = 10.0, typical = {max(width, 1e-4)!r} }}',
    ]  # fmt: skip
    if "s)" in force:
        lines.append('s = { unit = "m/s", low = 1e-5, high = 100.0, typical = 1.0 }')
    end, fast = 10 ** rng.uniform(-5, -1.5), 10 ** rng.uniform(-3, 0)
    low = 0.0 if in_bumper else -end
    lines += ["[range]", f"{length} = [{low!r}, {end!r}]", f"v = [{-fast!r}, {fast!r}]"]
    (folder / "law.toml").write_text("\n".join(lines))
    model = folder / "model.toml"
    speed_line = f"s = {speed!r}\n" if "s)" in force else ""
    model.write_text(f"{BASE}k = {amplitude!r}\nw = {width!r}\n{speed_line}")
    return model, f"{force}, k {amplitude:.2g}, w {width:.2g}, s {speed:.2g}, to {end:.2g} m"


def _draw_expression(rng: np.random.Generator, names: list[str], depth: int) -> str:
    if depth == 0 or rng.random() < 0.2:
        return str(rng.choice([*names, "1", "0.5"]))
    part = _draw_expression(rng, names, depth - 1)
    other = _draw_expression(rng, names, depth - 1)
    shape = rng.choice(
        ["{0}*{1}", "{0}+{1}", "log(1+{0})", "sqrt(1+{0})", "exp({0})", "tanh({0})", "abs({0})",
         "({0})/(1+{1})", "({0})**2", "({0})**3", "log(1.001+{0}*{1})", "sqrt(1.01-({0})**2)"]
    )  # fmt: skip
    return f"({shape.format(part, other)})"


def replay_with(recording: Recording, config: RunConfig, path: Path) -> tuple[Recording, bool]:
    """Return the recording with the twin of another model, and whether it was finite throughout."""
    items = [*rerun_twin(recording, config)]
    write_items(path, items, recording.start)
    states = []
    for item in items:
        if isinstance(item, Block) and item.stream == "pred":
            values = item.channel("free/rel_disp_m")
            states.append(np.isfinite(values))
    known = np.concatenate(states)
    begun = int(known.argmax()) if known.any() else 0
    return read_recording(path), bool(known.any() and known[begun:].all())


def judge_law(recording: Recording, config: RunConfig, model: Path, folder: Path) -> str:
    """Return what the product makes of a model: how it ends, "WRONG: ..." where it must not."""
    try:
        _, text = load_model_config(model)
        config = from_texts("law", config.profile_toml, config.rig_toml, text, "law")
    except InputError:
        return "refused in its file"
    end = "finite"
    try:
        check_laws(config.model, config.profile)
    except InputError as error:
        if "too much for" in str(error):
            return "refused for its slope"  # its replay takes minutes
        end = "refused for the test"
    path = folder / "law.mcap"
    path.unlink(missing_ok=True)
    try:
        replayed, is_finite = replay_with(recording, config, path)
    except InputError:
        return "refused at the start"
    failures = [event for event in replayed.records(Event) if event.kind == "twin_failed"]
    summary = summarise(replayed, config.parameters)
    verdict = summary.twin_verdict
    assert verdict is not None
    if failures or not is_finite:
        restarted = any("restarted" in event.text for event in failures)
        free = not is_finite or any("restarted" not in event.text for event in failures)
        errors = summary.comparison["rel_disp_m"]
        if verdict.verdict == "agrees" or not failures:
            return f"WRONG: {verdict.verdict}, {verdict.reason}, {len(failures)} failures"
        if (free and errors.free_nrmse is not None) or (restarted and errors.nrmse is not None):
            return f"WRONG: scores {errors.free_nrmse}, {errors.nrmse} of a failed twin"
        return f"{end}, failed in a replay" if end != "finite" else "failed, by name"
    return end if end != "finite" else f"finite, twin {verdict.verdict}"


def give_up(*_: object) -> None:
    raise TimeoutError


def main() -> None:
    signal.signal(signal.SIGALRM, give_up)
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    rng, ends = np.random.default_rng(options.seed), Counter[str]()
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "short.toml").write_text(PROFILE)
        config = read_run_config(folder / "short.toml")
        play_unpaced(config, "short", folder / "run.mcap", lambda: None, lambda _: None)
        recording = read_recording(folder / "run.mcap")
        taken = 0
        while taken < options.count:
            model, words = write_law(rng, folder)
            signal.alarm(MAX_LAW_S)
            try:
                end = judge_law(recording, config, model, folder)
            except TimeoutError:
                end = "slow"
            signal.alarm(0)
            ends[end if not end.startswith("WRONG") else "WRONG"] += 1
            taken += end != "refused in its file"
            if end != "refused in its file":
                print(f"{taken:>4} {end}: {words}", flush=True)
    print(dict(ends))


if __name__ == "__main__":
    main()
