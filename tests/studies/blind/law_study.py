"""Study of laws for what no library holds, on the blind cases.

The library is not tried first: what is judged is the law alone, from the refitted base. The same
hidden plant then plays two tests more, without noise: one 25 % stronger, along whose motion the
forces of the law are compared, and one at other frequencies, which the model simulates freely from
the motion of the table. The gap there is that of the pseudo-resonance curves: the rms over the
steps of the error of the excursions, relative to the rms of the true ones. A curve shows steady
motion: that test holds each step longer, and a step counts where the true motion repeats itself
from cycle to cycle, as it did in the step before. Chaos, the subharmonics beside it, the orbit to
which it leads, and what dies away slowly after a jump are not those of a nearly exact model either.
"""

import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Int1D, Label
from table_io.clock import RealClock, cpu_seconds
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from tests.studies.blind.cases import draw_case
from tests.studies.blind.discovery_study import run_method
from tests.studies.blind.harness import RESULTS_FILE, Study, StudyOptions, read_rows, run_study
from tests.studies.blind.metrics import Rate, select_kind, select_latest
from tests.studies.blind.plant import SealedPlant, describe_end, generate_case
from tests.studies.blind.rig import MODEL_TOML, PROFILE, PROFILE_TOML, StudySignals
from tests.studies.blind.rivals import describe_missing, find_rivals, load_case
from tests.studies.blind.scoring import select_case_facts
from twin.discovery.discover import (
    PreparedProblem,
    prepare_problem,
)
from twin.discovery.law_search import LawProposal, search_laws, select_law
from twin.discovery.law_terms import LAW_PREFIX
from twin.discovery.residuals import FORCE_ROWS, LogResiduals
from twin.discovery.selection import FittedSet, SelectionProblem
from twin.model.inverse_dynamics import forces_along
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.model.valid_range import find_range_exits
from twin.system.terminal import print_line

Json = dict[str, Any]
TABLE_FILE = "laws.md"
DEFAULT_CELLS = ("unknown/*/3/1%", "unknown/*/3/5%", "single/appendage/3/*", "none/*")
LEVEL_RATIO = 1.25  # ratio of the level of the test that leaves the fitted range
MAX_FLOOR_RATIO, MAX_RATIO_OUTSIDE, MIN_CLOSED = 1.1, 3.0, 0.9
MAX_SECONDS, MAX_PARAMETER_ERROR = 60.0, 0.1
MIN_CURVE_GAP = 0.01  # of the excursions: with less the base needs no law to predict them
MIN_STEPS = 5  # of a curve, with steady motion: with fewer it says too little


def _change_sweep(**values: object) -> Profile:
    """Return the study's test with other values of its sweep."""
    text = PROFILE_TOML
    for name, value in values.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    return parse_toml(text, Profile, "the study's test")


STRONGER_TEST = _change_sweep(acceleration_g=0.05 * LEVEL_RATIO)
# Between the frequencies of the recording; the motion has eight cycles to become steady.
STEADY_CYCLES = 8
MAX_CHANGE = 0.03  # of u from a cycle to the next, rms over the rms of u, where it is steady
UNUSED_TEST = _change_sweep(start_hz=1.0, stop_hz=4.2, cycles=2 * STEADY_CYCLES)

# Term with the form of the rig's own law, and its exponent; other laws have a form of their own.
EXACT_TERMS: Mapping[str, tuple[str, float | None]] = {
    "quintic_stiffness": ("spring_power", 5), "even_stiffness": ("even_spring", 2),
    "cubic_damping": ("damping_power", 3), "saturating_stiffness": ("saturating_spring", None),
    "slack_stiffness": ("right_stop_spring", None), "root_friction": ("damping_power", 0.5),
    "cross_damping": ("speed_stiffness", 2), "one_sided_damping": ("one_way_damping", 2),
    "position_friction": ("position_friction", 1),
    "square_position_friction": ("position_friction", 2),
    "saturating_damping": ("saturating_damping", None), "damping_drift": ("drifting_damping", None),
    "warming_friction": ("settling_friction", None), "cable_drag": ("table_speed", None),
    "cable_stiffness": ("table_power", 3), "hertz_bumper": ("bumper_power", 1.5),
    "quintic_bumper": ("bumper_power", 5), "one_sided_cubic": ("right_bumper_power", 3),
    "compression_dashpot": ("compression_damping", 1),
    "cubic_bumper_damping": ("bumper_rate_power", 3),
    "softening_bumper": ("contact_softening", None), "dahl_friction": ("hysteresis", 1),
    "cubic_maxwell": ("nonlinear_relaxation", None), "cubic_appendage": ("cubic_resonator", None),
    "table_resonator": ("table_resonator", None), "appendage": ("resonator", None),
}  # fmt: skip
MAX_EXPONENT_ERROR = 0.05


NO_PREDICTION: Mapping[str, Any] = {
    "outside": {"error": math.inf, "said": []}, "curve": {"before": 1.0, "after": 1.0},
}  # fmt: skip


def run_law_study(options: StudyOptions, rig: str = "simulated", has_rivals: bool = False) -> int:
    """Evaluate the cases that have no result; return the exit code."""
    folder, numbers, workers = options.prepare("study-laws", DEFAULT_CELLS)
    if has_rivals and describe_missing():
        print_line(describe_missing())
    task = partial(evaluate_proposed_law, folder, rig, has_rivals)
    return run_study(Study(task, format_law_row, write_page), folder, numbers, workers)


def evaluate_proposed_law(root: Path, rig: str, has_rivals: bool, number: int) -> Json:
    """Return the row of a case: held-out errors, the law, and what it predicts elsewhere."""
    case = draw_case(number)
    paths = generate_case(case, root)
    about = json.loads(paths.about.read_text(encoding="utf-8"))
    row = select_case_facts(about) | {"label": case.label, "rig": rig}
    if not about["sized"]:
        return row
    plant, folder = SealedPlant(case, paths.truth, rig), paths.case_dir
    if rig != "simulated":
        folder = paths.case_dir / rig
        row["ended"] = describe_end(plant.record(folder / "log.mcap"))
        row["sized"] = row["ended"] == "complete"
        (folder / "model.toml").write_text(MODEL_TOML, encoding="utf-8")
    if not row["sized"]:
        return row
    logs, _, model = load_case(folder)
    clock = RealClock()
    start_s, start_cpu_s = clock.now(), cpu_seconds()
    prepared = prepare_problem(logs, model)
    problem, null, law = find_law_of_base(prepared)
    row |= {"wall_s": clock.now() - start_s, "seconds": cpu_seconds() - start_cpu_s}
    best = law.fitted if law else null
    (residuals,) = problem.log_residuals
    floor = problem.noise
    row |= {
        "hidden": about["effects"],
        "law": _describe_terms(law),
        "law_class": law.law_class if law else "",
        "before": math.sqrt(null.cost / floor),
        "after": math.sqrt(best.cost / floor),
        "forces": _measure_forces(residuals, best),
    }
    if law is not None:
        row |= _judge_structure(law, about)
        try:
            row |= _judge_predictions(plant, residuals, null, best)
        except InputError as error:  # a law that cannot be simulated predicts nothing
            row |= {**NO_PREDICTION, "unusable": str(error)}
    if has_rivals:
        row["rivals"] = {}
        for name, method in find_rivals().items():
            verdict, failure = run_method(method, folder)
            row["rivals"][name] = {
                "forces": None if failure else verdict["gap"]["held_out_after"],
                "failed": failure,
            }
    return row


def find_law_of_base(
    prepared: PreparedProblem,
) -> tuple[SelectionProblem, FittedSet, LawProposal | None]:
    """Return (problem, its base, law) without a search of the library before."""
    problem = prepared.problem
    null = problem.fit_effects(prepared.parameters, ())
    return problem, null, select_law(problem, null, search_laws(problem, null, null))


def _describe_terms(law: LawProposal | None) -> list[Json]:
    """Return id, force, rates of states and values of each term of a law."""
    return [
        {
            "id": term.id,
            "force": term.force,
            "rates": {name: state.rate for name, state in term.states.items()},
            "values": term.typical_values,
        }
        for term in (law.laws if law else ())
    ]


def _measure_forces(residuals: LogResiduals, fitted: FittedSet) -> float:
    """Return the rms over the noise of the held-out rows of forces, as for the baselines."""
    values = fitted.held_out[0][residuals.entry_row < len(FORCE_ROWS)]
    return math.sqrt(float(values @ values) / values.size)


def _judge_predictions(
    plant: SealedPlant, residuals: LogResiduals, null: FittedSet, best: FittedSet
) -> Json:
    """Return the error in a stronger test, whether its range is said, and the gap in another."""
    stronger, unused = map(plant.simulate, (STRONGER_TEST, UNUSED_TEST))
    m = residuals.motion()
    models = [fitted.fit.parameters.model_for_log(0, m) for fitted in (null, best)]
    weights = [residuals.weights.get(row, 1.0) for row in FORCE_ROWS]
    noise = residuals.force_noise(m, m.mass_kg) * np.array(weights)
    motion = _derive_motion(stronger)
    outside = [*find_range_exits(models[1], motion)]
    before, after = (measure_curve_error(model, unused) for model in models)
    steps = len(list_steady_samples(unused))
    curve = {"before": before, "after": after, "steps": steps}
    return {
        "outside": {
            "error": math.hypot(1.0, measure_force_error(models[1], stronger, noise)),
            "said": [f"{range_exit.effect}.{range_exit.variable}" for range_exit in outside],
        },
        "curve": None if math.isnan(before) else curve,
    }


def _derive_motion(signals: StudySignals) -> dict[str, Any]:
    """Return u, v, a, t and y of a test, (sample,), SI."""
    rate = PROFILE.acquisition.rate_hz
    u = signals.channels["mass_disp_m"] - signals.channels["table_disp_m"]
    return {
        "u": u, "v": np.gradient(u) * rate, "a": signals.channels["table_acc_m_s2"],
        "t": np.arange(u.size) / rate, "y": signals.channels["table_disp_m"],
    }  # fmt: skip


def measure_force_error(model: Model, signals: StudySignals, noise: Any) -> float:
    """Return the rms over the noise, (3,) in N, of the forces of a model along the true motion.

    Of the damper's while the table moves, of a bumper's in contact.
    """
    motion, mass = _derive_motion(signals), model.parameters.mass
    contact = np.array([signals.right > 0.0, signals.left < 0.0], dtype=np.int8)
    added = model.added_acceleration(motion["y"])
    extra = 0.0 if added is None else added
    damper, right, left = forces_along(
        model, motion["u"], motion["v"], motion["a"] + extra, motion["t"], contact
    )
    measured = -mass * signals.channels["mass_acc_m_s2"] - signals.right - signals.left
    errors = (
        (measured - damper - mass * extra)[signals.moving] / noise[0],
        (signals.right - right)[signals.moving & (contact[0] > 0)] / noise[1],
        (signals.left - left)[signals.moving & (contact[1] > 0)] / noise[2],
    )
    values = np.concatenate(errors)
    return float(np.sqrt(np.mean(values**2)))


def measure_curve_error(model: Model, signals: StudySignals) -> float:
    """Return the relative error of the excursions in a free simulation of the unused test.

    Excursions of relative displacement and total acceleration in the steady cycles, the rms of each
    over the steps; the mean of the two. nan if fewer than `MIN_STEPS` steps are steady.
    """
    steady = list_steady_samples(signals)
    if len(steady) < MIN_STEPS:
        return math.nan
    solver = prepare_solver(model, PROFILE.acquisition.rate_hz)
    base_acc, table_disp = (
        np.ascontiguousarray(signals.channels[name]) for name in ("table_acc_m_s2", "table_disp_m")
    )
    out = np.empty((OUTPUT_COUNT, base_acc.size))
    solver.advance(solver.rest_state(), base_acc, table_disp, out)
    true_motion = _derive_motion(signals)
    errors = []
    for true, own in (
        (true_motion["u"], out[0]), (signals.channels["mass_acc_m_s2"], out[2])
    ):  # fmt: skip
        expected, simulated = (
            np.array([np.ptp(values[samples]) for samples in steady]) for values in (true, own)
        )
        errors.append(np.sqrt(np.mean((simulated - expected) ** 2) / np.mean(expected**2)))
    return float(np.mean(errors))


def list_steady_samples(signals: StudySignals) -> list[Int1D]:
    """Return the samples of the last cycles of the steps of the unused test with steady motion.

    The motion of such a step has the period of the forcing, and so had that of the step before.
    """
    u, steady = _derive_motion(signals)["u"], []
    held = np.where(np.isin(signals.label, (Label.SETTLE, Label.MEASURE)), signals.step, -1)
    was_steady = True
    for number, step in enumerate(UNUSED_TEST.sweep.steps):
        period = round(PROFILE.acquisition.rate_hz / step.frequency_hz)
        samples = np.flatnonzero(held == number)[-STEADY_CYCLES * period :]
        is_steady = samples.size > period and bool(
            np.std(u[samples[period:]] - u[samples[:-period]]) <= MAX_CHANGE * np.std(u[samples])
        )
        if is_steady and was_steady:
            steady.append(samples)
        was_steady = is_steady
    return steady


def _judge_structure(law: LawProposal, about: Json) -> Json:
    """Return whether the law has the form of the hidden one, and the errors of a resonator."""
    if len(about["effects"]) != 1:
        return {}
    (hidden,) = about["effects"]
    expected, exponent = EXACT_TERMS.get(hidden["name"], ("", None))
    (term, *further) = law.laws
    is_exact = not further and term.id == f"{LAW_PREFIX}{expected}"
    if is_exact and exponent is not None:
        is_exact = (
            abs(_find_exponent(term.force, term.typical_values) - exponent) < MAX_EXPONENT_ERROR
        )
    row: Json = {"exact": is_exact}
    truth = hidden["parameters"]
    values = term.typical_values
    describe_resonator = {
        "appendage": lambda: (
            values
            | {
                "frequency": math.sqrt(values["omega2"]) / (2 * math.pi),
                "damping_ratio": 0.5 * values["decay"] / math.sqrt(values["omega2"]),
            }
        ),
        "table_resonator": lambda: (
            values
            | {
                "frequency": math.sqrt(max(values["omega2"] - values["k"] / values["mass"], 0.0))
                / (2 * math.pi),
                "coupling": values["k"],
            }
        ),
        "cubic_appendage": lambda: values | {"damping": values["decay"]},
    }.get(hidden["name"])
    if describe_resonator is not None and expected == term.id.removeprefix(LAW_PREFIX):
        own = describe_resonator()
        row["resonator"] = {name: own[name] / true - 1.0 for name, true in truth.items()}
    elif describe_resonator is not None:
        row["resonator"] = {}
    return row


def _find_exponent(force: str, parameters: Mapping[str, float]) -> float:
    """Return the exponent of a power law: a parameter, or a number in its text."""
    for name in ("p", "n"):
        if name in parameters:
            return parameters[name]
    written = re.findall(r"\*\*\s*([\d.]+)", force)
    return float(written[0]) if written else 1.0


def format_law_row(row: Json) -> str:
    """Return one line about a case."""
    text = " + ".join(term["force"] for term in row["law"]) or "no law"
    curve = row.get("curve")
    closed = f", curve {curve['before']:.3f} -> {curve['after']:.4f}" if curve else ""
    return f"{row['before']:.3f} -> {row['after']:.3f}{closed} in {row['seconds']:.0f} s: {text}"


def write_page(folder: Path) -> Path:
    """Write the figures of the study with counts and Wilson intervals; return the page."""
    page = folder / TABLE_FILE
    page.write_text("\n".join(format_page(read_rows(folder / RESULTS_FILE))) + "\n", "utf-8")
    return page


def format_page(rows: Sequence[Json]) -> Iterator[str]:
    """Yield the lines of the page."""
    latest = select_latest(rows)
    failed = [_make_miss(row) for row in latest if row.get("failed")]
    usable = [*(row for row in latest if row.get("sized") and "law" in row), *failed]
    yield "# Laws for what no library holds\n"
    yield (
        f"{len(usable)} cases, of which {len(failed)} failed and count as misses; "
        f"{len(latest) - len(usable)} not played. Rates with counts and 95 % Wilson intervals.\n"
    )
    yield "| quantity | goal | seen |"
    yield "|---|---|---|"
    for name, goal, rate in _list_rates(usable):
        if rate.count:
            yield f"| {name} | {goal} | {rate} |"
    searched = [row for row in usable if row["kind"] != "none"]
    for name, key in (("processor time", "seconds"), ("wall clock", "wall_s")):
        if values := [row[key] for row in searched]:
            yield (
                f"| {name} of the search in s | | "
                f"median {np.median(values):.1f}, largest {max(values):.1f} |"
            )
    yield "\n| case | held out over floor, before -> after | curves | outside | exact | law |"
    yield "|---|---|---|---|---|---|"
    for row in usable:
        if row["kind"] != "none":
            yield _format_case(row)
    yield from _format_rivals(usable)


def _make_miss(row: Json) -> Json:
    """Return the row of a case that failed, as one without a law."""
    cell = draw_case(row["number"]).cell
    return row | {
        "kind": cell.kind, "noise": cell.noise, "law": [], "before": math.inf, "after": math.inf,
        "seconds": math.inf, "wall_s": math.inf, "forces": None,
    }  # fmt: skip


def _list_rates(rows: Sequence[Json]) -> Iterator[tuple[str, str, Rate]]:
    """Yield (quantity, goal, rate) in the order of the page."""
    searched = [row for row in rows if row["kind"] != "none"]
    strangers = select_kind(rows, "unknown")
    proposed = [row for row in searched if row["law"]]
    drawn = [row for row in proposed if row.get("curve")]
    curves = [row for row in drawn if row["curve"]["before"] >= MIN_CURVE_GAP]
    names = ("appendage", "table_resonator", "cubic_appendage")
    resonators = [row for row in searched if any(name in row["cell"] for name in names)]
    stronger = f"a test 25 % stronger: error <= {MAX_RATIO_OUTSIDE:g} x floor"

    def has_law(row: Json) -> bool:
        return bool(row["law"])

    def is_near_outside(row: Json) -> bool:
        return bool(row["outside"]["error"] <= MAX_RATIO_OUTSIDE)

    for noise in sorted({row["noise"] for row in strangers}):
        own = [row for row in strangers if row["noise"] == noise]
        at_noise = f"noise {100 * noise:g} %"
        yield (
            f"laws outside the library, {at_noise}: held-out error of the law "
            f"<= {MAX_FLOOR_RATIO:g} x floor",
            ">= 85 %",
            Rate.of(own, lambda row: has_law(row) and row["after"] <= MAX_FLOOR_RATIO),
        )
        yield f"{at_noise}: a law proposed", "", Rate.of(own, has_law)
    yield (
        f"search <= {MAX_SECONDS:g} s of processor time", "",
        Rate.of(searched, lambda row: row["seconds"] <= MAX_SECONDS),
    )  # fmt: skip
    yield (
        f"{stronger}, or said", ">= 90 %",
        Rate.of(proposed, lambda row: is_near_outside(row) or bool(row["outside"]["said"])),
    )  # fmt: skip
    yield stronger, "", Rate.of(proposed, is_near_outside)
    yield (
        f"gap closed in the steady steps of a run never used >= {MIN_CLOSED:g} (base misses "
        f">= {100 * MIN_CURVE_GAP:g} %; {len(proposed) - len(drawn)} without such steps)",
        ">= 85 %",
        Rate.of(
            curves, lambda row: 1 - row["curve"]["after"] / row["curve"]["before"] >= MIN_CLOSED
        ),
    )
    yield "exact structure", "reported", Rate.of(searched, lambda row: bool(row.get("exact")))
    yield "nothing hidden: a law proposed", "<= 2 %", Rate.of(select_kind(rows, "none"), has_law)
    yield (
        "attached resonator: all its numbers within 10 %", ">= 90 %",
        Rate.of(resonators, _is_resonator_right),
    )  # fmt: skip


def _is_resonator_right(row: Json) -> bool:
    errors = row.get("resonator") or {}
    return bool(errors) and max(map(abs, errors.values())) <= MAX_PARAMETER_ERROR


def _format_case(row: Json) -> str:
    curve, outside = row.get("curve"), row.get("outside")
    terms = " + ".join(
        f"`{term['force']}` ({', '.join(f'{k} {v:.4g}' for k, v in term['values'].items())})"
        for term in row["law"]
    )
    cells = (
        row["cell"],
        f"{row['before']:.3f} -> {row['after']:.3f}",
        f"{curve['before']:.4f} -> {curve['after']:.4f}" if curve else "",
        f"{outside['error']:.2f}{' said' if outside['said'] else ''}" if outside else "",
        "yes" if row.get("exact") else "",
        terms or "none",
    )
    return f"| {' | '.join(cells)} |"


def _format_rivals(rows: Sequence[Json]) -> Iterator[str]:
    """Yield a table of the held-out error of the forces by method, on the same recordings."""
    compared = [row for row in rows if row.get("rivals") and row["kind"] != "none"]
    if not compared:
        return
    yield "\nHeld-out rms of the forces over the noise, on the same recordings.\n"
    yield f"| method | median | <= {MAX_FLOOR_RATIO:g} |"
    yield "|---|---|---|"
    for name in ("law search", *compared[0]["rivals"]):
        errors = [
            row["forces"] if name == "law search" else row["rivals"].get(name, {}).get("forces")
            for row in compared
        ]
        values = [error for error in errors if error is not None]
        hits = sum(value <= MAX_FLOOR_RATIO for value in values)
        yield f"| {name} | {np.median(values):.3f} | {Rate(hits, len(values))} |"
