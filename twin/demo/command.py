"""`shaketwin demo`: a rig hides an effect at random, the twin departs, `discover` names it.

The effect is sealed: only the simulated table reads its file, and the seal is opened at the end.
"""

import hashlib
import json
import math
import random
import secrets
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from table_io.clock import RealClock
from table_io.config.base import PROFILES_DIR
from table_io.sim.ground_truth import (
    DEFINITION_BY_ID,
    GroundTruth,
    HiddenEffect,
    parse_ground_truth,
)
from twin.discovery.command import run_discovery
from twin.discovery.result import Verdict
from twin.drawing.charts import make_chart_script
from twin.drawing.page import render_page
from twin.drawing.panels import CaptionedFigure, PanelFigure
from twin.drawing.plot_style import LineStyle, direction_keys, measured_style, twin_style
from twin.drawing.prc_drawing import break_at_jumps, plot_prc
from twin.laws.library import find_effect
from twin.live.run_command import run_test
from twin.results.contracts import RunSummary
from twin.results.report_data import extract_prc
from twin.results.twin_verdict import format_misfit
from twin.setup.folders import make_output_folder, make_run_folder
from twin.system.files import open_in_browser
from twin.system.terminal import print_line

TEST = "demo"
CHANNEL = "rel_disp_m"  # whose error is shown: displacement of the mass relative to the table
SEALED_FILE, RIG_FILE = "sealed.toml", "rig.toml"
FIRST_RUN, DISCOVERY, SECOND_RUN = "1-first-run", "2-discovery", "3-second-run"
# Effects that this short test shows at a typical size; cubic stiffness and table tilt stay below
# the noise in it.
HIDEABLE_EFFECTS = (
    "bouc_wen", "bumper_asymmetry", "bumper_hardening", "bumper_maxwell", "coulomb_friction",
    "hunt_crossley", "maxwell_damper", "quadratic_damping",
)  # fmt: skip
MARKERS: LineStyle = {"marker": "o", "ms": 3}
MIN_SIZE, MAX_SIZE = 0.8, 1.5  # of the typical one


@dataclass
class Story:
    """Story of a demonstration by chapters: printed as it goes, and told again by its page."""

    chapters: list[tuple[str, list[str]]] = field(default_factory=list)

    def begin_chapter(self, title: str) -> None:
        self.chapters.append((title, []))
        print_line(f"\n{len(self.chapters)}. {title}")

    def add_line(self, text: str) -> None:
        self.chapters[-1][1].append(text)
        print_line(f"   {text}")


@dataclass(frozen=True)
class TwinError:
    """Error of the twin in a run and the part of it that is noise, as shares of the motion."""

    error: float
    noise_floor: float
    summary: RunSummary

    @property
    def verdict(self) -> str:
        """Verdict on the twin."""
        return self.summary.twin_verdict.verdict if self.summary.twin_verdict else "not judged"

    def __str__(self) -> str:
        misfit = format_misfit(self.summary.twin_verdict)
        return f"the twin {self.verdict}, {100 * self.error:.2g} % of the motion off, {misfit}"


def run_demo(out: Path | None, seed: int | None, keep: Path | None, show_page: bool) -> int:
    """Run the demonstration and show its page; return the exit code."""
    clock = RealClock()
    start_s = clock.now()
    kept_folder = None if keep is None else make_output_folder(keep, "")
    folder, _ = make_run_folder(out, "demo")
    seed = secrets.randbelow(10**6) if seed is None else seed
    story = Story()

    story.begin_chapter("A rig with something hidden in it")
    digest = seal_effect(folder, seed)
    story.add_line(
        f"An effect was drawn at random (--seed {seed}) and sealed in {SEALED_FILE}, SHA-256 "
        f"{digest[:12]}..."
    )
    story.add_line("Only the simulated table reads it; twin and discovery see the sensors alone.")

    story.begin_chapter("Run the test, with the twin beside it and the model as it is")
    code = _run_twin(folder, FIRST_RUN, None)
    if code:
        return code
    before = read_twin_error(folder / FIRST_RUN)
    story.add_line(f"Twin error: {before}.")

    story.begin_chapter("Discover what the model lacks, from the recording")
    discovered, code = run_discovery([folder / FIRST_RUN], "snm", folder / DISCOVERY)
    if code or discovered is None:
        return code
    verdict = discovered.verdict
    story.add_line(_describe_verdict(verdict))

    story.begin_chapter("Add it to the model and run again, with new noise")
    write_rig(folder, digest, seed + 1)
    code = _run_twin(folder, SECOND_RUN, str(folder / DISCOVERY / "model.toml"))
    if code:
        return code
    after = read_twin_error(folder / SECOND_RUN)
    story.add_line(f"Twin error: {after}.")

    story.begin_chapter("Open the seal")
    (hidden,) = open_seal(folder, digest).effects
    for line in compare_with_seal(hidden, verdict):
        story.add_line(line)
    story.add_line(
        f"Twin error {100 * before.error:.2g} % before, {100 * after.error:.2g} % after; "
        f"{100 * after.noise_floor:.2g} % is noise of the sensors."
    )
    page = write_demo_page(folder, story, before, after)
    if kept_folder is not None:
        path = keep_rig(kept_folder, hidden, seed)
        print_line(f"\nA rig file to edit: {path}\n  shaketwin run {TEST} --table {path}")
    print_line(f"\n{clock.now() - start_s:.0f} s; the story as a page: {page}")
    if show_page and not open_in_browser(page):
        print_line("no browser here; open the page on a computer that has one")
    return 0


def seal_effect(folder: Path, seed: int) -> str:
    """Write a random effect to a sealed file, and the rig file that hides it; return its hash."""
    chance = random.Random(seed)
    name = chance.choice(HIDEABLE_EFFECTS)
    (definition, *_) = (value for (key, _), value in DEFINITION_BY_ID.items() if key == name)
    share, values = chance.uniform(MIN_SIZE, MAX_SIZE), {}
    for parameter in definition.parameters:
        absent = parameter.vanishing
        if absent is not None:
            values[parameter.name] = float(f"{absent + share * (parameter.typical - absent):.3g}")
        elif parameter.default is None:
            values[parameter.name] = parameter.typical
    salt = secrets.token_hex(16)  # else the hash of each effect could be tried
    text = f"# {salt}\n{_format_effect(HiddenEffect(id=name, parameters=values), 'effects')}"
    (folder / SEALED_FILE).write_text(text, encoding="utf-8")
    digest = hashlib.sha256(text.encode()).hexdigest()
    write_rig(folder, digest, seed)
    return digest


def _format_effect(effect: HiddenEffect, table: str) -> str:
    """Format a hidden effect as an entry of an array of tables."""
    values = ", ".join(f"{name} = {value!r}" for name, value in effect.parameters.items())
    return f'[[{table}]]\nid = "{effect.id}"\nparameters = {{ {values} }}\n'


def write_rig(folder: Path, digest: str, noise_seed: int) -> None:
    """Write the rig file: the simulated table with the sealed effect and noise of this seed."""
    path = json.dumps(str((folder / SEALED_FILE).resolve()))
    text = f'{_read_simulated_rig(noise_seed)}truth = {path}\ntruth_sha256 = "{digest}"\n'
    (folder / RIG_FILE).write_text(text, encoding="utf-8")


def _read_simulated_rig(noise_seed: int) -> str:
    """Return the text of the shipped rig file, which ends in [simulated], with this seed."""
    text = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")
    return text.replace("\nseed = 1\n", f"\nseed = {noise_seed}\n")


def _run_twin(folder: Path, name: str, model: str | None) -> int:
    """Run the test into a folder of this name, as fast as possible; return the exit code."""
    test, rig = PROFILES_DIR / "tests" / f"{TEST}.toml", str(folder / RIG_FILE)
    return run_test(test, folder / name, True, model, rig, False, "")


def read_twin_error(run: Path) -> TwinError:
    """Read the error of the twin from the summary of a run."""
    summary = RunSummary.read(run / "summary.json", "run the demonstration again")
    error = summary.comparison[CHANNEL]
    return TwinError(error.nrmse or math.nan, error.noise_floor or math.nan, summary)


def _describe_verdict(verdict: Verdict) -> str:
    names = [f"{effect.id}, {find_effect(effect.id).term}" for effect in verdict.effects]
    return f"Verdict: {verdict.verdict}{': ' if names else ''}{' + '.join(names)}."


def open_seal(folder: Path, digest: str) -> GroundTruth:
    """Read the sealed effect; InputError if the file was altered since it was sealed."""
    path = folder / SEALED_FILE
    return parse_ground_truth(path.read_bytes(), digest, str(path))


def compare_with_seal(hidden: HiddenEffect, verdict: Verdict) -> list[str]:
    """Return a line whether the hidden effect was named, and one per parameter and false name."""
    parameters_by_id = {effect.id: effect.parameters for effect in verdict.effects}
    is_named = verdict.verdict == "named" and hidden.id in parameters_by_id
    if not is_named:
        lines = [f"It was {hidden.id}, which discovery did not name this time."]
    else:
        lines = [
            f"It was {hidden.id}: named from the recording alone. The rig's law has a form of its "
            "own, so parameters may differ by a few per cent."
        ]
        for name, fit in parameters_by_id[hidden.id].items():
            half = math.inf if fit.half_width is None else fit.half_width
            truth = hidden.parameters.get(name)
            known = "" if truth is None else f"hidden {truth:.4g}, "
            lines.append(f"{name}: {known}found {fit.value:.4g} +- {half:.1g} {fit.unit}".rstrip())
    false_names = [name for name in parameters_by_id if name != hidden.id]
    if false_names:
        word = "found" if verdict.verdict == "named" else "proposed"
        lines.append(f"Not hidden, but {word}: {', '.join(false_names)}.")
    return lines


def keep_rig(folder: Path, hidden: HiddenEffect, seed: int) -> Path:
    """Write a rig file that shows what it hides, for users to edit; return its path."""
    path = folder / RIG_FILE
    comment = "# What this rig hides from the model; edit it, or add further [[...]] entries.\n"
    entry = _format_effect(hidden, "simulated.hidden.effects")
    path.write_text(f"{_read_simulated_rig(seed)}\n{comment}{entry}", encoding="utf-8")
    return path


def write_demo_page(folder: Path, story: Story, before: TwinError, after: TwinError) -> Path:
    """Write folder/report.html, the story with its figure and links; return the path."""
    figure = _draw_runs(before, after)
    page = render_page(
        Path(__file__).with_name("demo.html"),
        chapters=story.chapters,
        figure=figure,
        script=make_chart_script([figure]),
        before=before,
        after=after,
        links={
            1: (f"{FIRST_RUN}/report.html", "report of the first run"),
            2: (f"{DISCOVERY}/report.html", "report of the discovery"),
            3: (f"{SECOND_RUN}/report.html", "report of the second run"),
            4: (SEALED_FILE, "the sealed file"),
        },
    )
    path = folder / "report.html"
    path.write_text(page, encoding="utf-8")
    return path


def _draw_runs(before: TwinError, after: TwinError) -> CaptionedFigure:
    """Return the figure of excursions of rig and twin over frequency, first and second run."""
    runs = {"first run, model as it was": before, "second run, effect added": after}
    figure = PanelFigure((10.0, 3.8), 1, len(runs), sharey="row")
    for panel, (title, run) in zip(figure.panels[0], runs.items(), strict=True):
        for source, jumps, make_style in (
            ("measured", run.summary.jumps, _rig_style),
            ("twin", run.summary.twin_jumps, _twin_style),
        ):
            curves = break_at_jumps(partial(extract_prc, run.summary.steps, source), jumps)
            plot_prc([(panel, {"eta_d": 1})], curves, make_style)
        panel.set_title(f"{title}: twin error {100 * run.error:.2g} %")
        panel.set_xlabel("frequency of the table in Hz")
    figure.panels[0, 0].set_ylabel("excursion of the mass, normalized")
    keys = [*direction_keys(_rig_style, "rig, "), *direction_keys(_twin_style, "twin, ")]
    figure.legend(keys, columns=4)
    return CaptionedFigure(
        "runs", "Rig and twin over frequency, before and after",
        "Excursion of the mass at each frequency of the sweep, up (forward) and down (backward), "
        "broken where it jumps. Wide and pale: measured; thin: the twin.", figure,
    )  # fmt: skip


def _rig_style(direction: str) -> LineStyle:
    return {**measured_style(direction, 4.0), "alpha": 0.45, **MARKERS}


def _twin_style(direction: str) -> LineStyle:
    return {**twin_style(direction, 1.2), **MARKERS}
