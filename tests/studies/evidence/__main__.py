"""Play the cases of the study of evidence: draw, import as a user would, discover, score.

python -m tests.studies.evidence [--group NAME] [--seeds N] [--first N] [--out FILE]
"""

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from tests.studies.evidence.imported import format_profile, import_columns
from tests.studies.evidence.laboratory import (
    Instruments,
    Specimen,
    StepTest,
    Test,
    record,
    record_component,
    vary,
)
from tests.studies.evidence.worlds import draw_world, state_specimen


@dataclass(frozen=True)
class Case:
    """One recording: where it comes from, and what would be right to say of it."""

    group: str
    name: str
    seed: int
    specimen: Specimen = Specimen()  # noqa: RUF009
    lab: Instruments = Instruments()  # noqa: RUF009
    test: Test = StepTest()  # noqa: RUF009
    component: tuple[tuple[float, ...], tuple[float, ...], float] | None = None
    truth: tuple[str, ...] = ()
    place: str = ""  # of a stranger: "damper" or "bumper"
    options: dict[str, float] = field(default_factory=dict)


def draw_component_cases(seeds: range) -> Iterator[Case]:
    """Clean component tests: noise x rate x frequencies."""
    for seed in seeds:
        rng = np.random.default_rng(1000 + seed)
        noise = 1e-6 * float(rng.choice([1.0, 3.0, 10.0, 30.0]))
        rate = float(rng.choice([100.0, 200.0, 500.0, 1000.0, 2000.0]))
        hz = ((1.0,), (0.5, 2.0), (0.5, 1.0, 3.0))[int(rng.integers(3))]
        amplitude = ((2e-3,), (1e-3, 4e-3))[int(rng.integers(2))]
        lab = Instruments(laser=noise, cell=0.5, gain=0.002, lag_s=0.0, offset=0.0)
        yield Case(
            "component", f"noise {noise:.0e} rate {rate:.0f} hz {hz} a {len(amplitude)}", seed,
            vary(Specimen(gap_mm=np.inf), rng), lab, component=(hz, amplitude, rate),
        )  # fmt: skip


LABS = {
    "plain": Instruments(),
    "filter": Instruments(filter_share=0.2),
    "no rest": Instruments(rest_s=0.0),
    "filter no rest": Instruments(filter_share=0.2, rest_s=0.0),
    "hum": Instruments(hum=3.0),
    "beat": Instruments(hum=3.0, beat_hz=0.3),
    "pink": Instruments(pink=2.0),
    "plate": Instruments(plate_kg=2.0),
    "no mass acc": Instruments(missing=("mass_acc_m_s2",)),
    "no lasers' mate": Instruments(missing=("table_acc_m_s2",)),
    "all": Instruments(filter_share=0.25, hum=2.0, beat_hz=0.3, pink=1.0, plate_kg=1.0),
}
OTHER_LABS = {
    "relative laser": Instruments(has_relative_laser=True),
    "relative laser alone": Instruments(
        has_relative_laser=True, missing=("table_disp_m", "mass_acc_m_s2")
    ),
    "no cells": Instruments(missing=("force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n")),
    "one cell a side": Instruments(share=1.0, share_left=1.0, missing=("force_r2_n", "force_l2_n")),
    "skew": Instruments(skew_s=1e-4, filter_share=0.2),
    "14 bits": Instruments(bits=14),
    "curved": Instruments(curve=1e-3),
    "loud": Instruments(laser=5e-5, acc=0.05, cell=5.0),
    "quiet": Instruments(laser=1e-6, acc=1e-3, cell=0.2),
    "500 Hz": Instruments(filter_share=0.35),
    "2000 Hz": Instruments(filter_share=0.2),
    "4000 Hz": Instruments(),
}
GAPS = {"g0": 0.0, "gm1": -1.0, "g4": 4.0, "g10": 10.0, "free": 40.0}


def draw_clean_cases(seeds: range) -> Iterator[Case]:
    """Clean recordings of laboratories: gap x instruments."""
    names = [(gap, lab) for gap in GAPS for lab in LABS]
    for seed in seeds:
        gap, lab = names[(7 * seed) % len(names)]
        rng = np.random.default_rng(2000 + seed)
        yield Case(
            "clean", f"{gap} {lab}", seed, vary(Specimen(gap_mm=GAPS[gap]), rng), LABS[lab],
            _test(gap),
        )  # fmt: skip


def draw_other_cases(seeds: range) -> Iterator[Case]:
    """Clean recordings of laboratories of other kinds: channels, rates and converters."""
    names = [(gap, lab) for gap in GAPS for lab in OTHER_LABS]
    for seed in seeds:
        gap, lab = names[(7 * seed) % len(names)]
        rng = np.random.default_rng(5000 + seed)
        test = _test(gap)
        if lab.endswith("Hz"):
            test = replace(test, rate_hz=float(lab.split()[0]))
        specimen = vary(Specimen(gap_mm=GAPS[gap]), rng)
        yield Case("other", f"{gap} {lab}", seed, specimen, OTHER_LABS[lab], test)


EFFECTS: dict[str, tuple[str, dict[str, float]]] = {
    "cubic_stiffness": ("g10", {"k3": 3e8}),
    "coulomb_friction": ("g4", {"fc": 8.0}),
    "quadratic_damping": ("g10", {"c2": 2500.0}),
    "bouc_wen": ("g10", {"bw_force": 25.0, "bw_yield": 1e-3}),
    "maxwell_damper": ("g10", {"k1": 4e3, "tau": 0.05}),
    "bumper_hardening": ("g4", {"k2": 1.2e8}),
    "hunt_crossley": ("g4", {"hc": 2.5e6}),
    "bumper_maxwell": ("g4", {"kb": 6e4, "tau_b": 0.02}),
    "bumper_asymmetry": ("g4", {"kr": 580e3}),
    "gap_drift": ("g4", {"wear": 5e-6}),
    "table_tilt": ("g10", {"tilt": 0.2}),
}


def draw_effect_cases(seeds: range) -> Iterator[Case]:
    """One effect of the library, well above the noise, in several laboratories."""
    labs = ("plain", "filter", "no rest", "pink", "plate")
    for seed in seeds:
        effect = [*EFFECTS][seed % len(EFFECTS)]
        gap, hidden = EFFECTS[effect]
        lab = labs[seed // len(EFFECTS) % len(labs)]
        rng = np.random.default_rng(3000 + seed)
        specimen = replace(vary(Specimen(gap_mm=GAPS[gap]), rng), hidden=hidden)
        yield Case(
            "effect", f"{effect} {gap} {lab}", seed, specimen, LABS[lab], _test(gap),
            truth=(effect,),
        )  # fmt: skip


SMALL = ("cubic_stiffness", "coulomb_friction", "quadratic_damping", "bumper_hardening")


def draw_small_cases(seeds: range) -> Iterator[Case]:
    """One effect, from far below the noise to well above it: what `excludes` states must hold."""
    for seed in seeds:
        effect = SMALL[seed % len(SMALL)]
        gap, hidden = EFFECTS[effect]
        rng = np.random.default_rng(6000 + seed)
        share = 10.0 ** rng.uniform(-3.0, -0.5)
        scaled = {name: share * value for name, value in hidden.items()}
        specimen = replace(vary(Specimen(gap_mm=GAPS[gap]), rng), hidden=scaled)
        yield Case("small", f"{effect} {gap}", seed, specimen, LABS["plain"], _test(gap),
                   truth=(effect,))  # fmt: skip


PAIRS = (
    ("cubic_stiffness", "coulomb_friction"),
    ("coulomb_friction", "bumper_hardening"),
    ("quadratic_damping", "bumper_asymmetry"),
    ("cubic_stiffness", "hunt_crossley"),
    ("maxwell_damper", "bumper_hardening"),
    ("bouc_wen", "gap_drift"),
    ("hunt_crossley", "bumper_asymmetry"),
    ("cubic_stiffness", "table_tilt"),
)


def draw_pair_cases(seeds: range) -> Iterator[Case]:
    """Two effects of the library at once, each of the size that it has alone."""
    for seed in seeds:
        pair = PAIRS[seed % len(PAIRS)]
        gap = "g4" if any(EFFECTS[effect][0] == "g4" for effect in pair) else "g10"
        hidden = {name: value for effect in pair for name, value in EFFECTS[effect][1].items()}
        rng = np.random.default_rng(7000 + seed)
        specimen = replace(vary(Specimen(gap_mm=GAPS[gap]), rng), hidden=hidden)
        yield Case("pair", f"{'+'.join(pair)} {gap}", seed, specimen, LABS["plain"], _test(gap),
                   truth=pair)  # fmt: skip


STRANGERS: dict[str, tuple[str, str, dict[str, float]]] = {
    "soft layer": ("g4", "bumper", {"soft_depth": 4e-4, "soft_share": 0.3}),
    "flexible mount": ("g4", "bumper", {"mount_k": 1.5e6, "mount_kg": 20.0}),
    "hertz": ("g4", "bumper", {"stop_power": 1.5}),
    "friction with u": ("g10", "damper", {"friction_u": 4000.0}),
    "saturating spring": ("g10", "damper", {"tanh_force": 30.0, "tanh_u": 1e-3}),
    "fifth power": ("g10", "damper", {"k5": 3e13}),
    "dead band": ("g10", "damper", {"dead_band": 3e-4}),
    "warming": ("g10", "damper", {"warming": 0.055}),
    "u |u|": ("g10", "damper", {"softening": 1e6}),
    "stribeck": ("g10", "damper", {"fc": 8.0, "stribeck": 1.0}),
    "adhesion": ("g4", "bumper", {"pull": 60.0}),
    "damping cools": ("g10", "damper", {"cooling": 0.3}),
}


# Those that the library has: their names are right.
KNOWN = {"dead band": "dead_band", "stribeck": "stribeck_friction", "adhesion": "adhesion"}


def draw_stranger_cases(seeds: range) -> Iterator[Case]:
    """Effects that the library lacks, or names otherwise."""
    for seed in seeds:
        name = [*STRANGERS][seed % len(STRANGERS)]
        gap, place, hidden = STRANGERS[name]
        rng = np.random.default_rng(4000 + seed)
        specimen = replace(vary(Specimen(gap_mm=GAPS[gap]), rng), hidden=hidden)
        yield Case("stranger", f"{name} {gap}", seed, specimen, LABS["plain"], _test(gap),
                   truth=(KNOWN[name],) if name in KNOWN else (), place=place)  # fmt: skip


def draw_world_cases(seeds: range, hide: str = "") -> Iterator[Case]:
    """Laboratories of any size, with what is hidden."""
    for seed in seeds:
        specimen, lab, motion, name, _ = draw_world(seed, hide)
        truth = (name,) if hide == "effect" else ()
        label = f"{name} {motion.kind} {specimen.mass:.0f} kg {motion.natural_hz:.2g} Hz"
        yield Case(f"world {hide}".strip(), label, seed, specimen, lab, motion, truth=truth)


def _test(gap: str) -> StepTest:
    if gap in ("g0", "gm1"):
        return StepTest(2.0, 9.0, 1.0, cycles=10)
    return StepTest()


GROUPS: dict[str, Callable[[range], Iterator[Case]]] = {
    "component": draw_component_cases,
    "clean": draw_clean_cases,
    "other": draw_other_cases,
    "effect": draw_effect_cases,
    "small": draw_small_cases,
    "pair": draw_pair_cases,
    "stranger": draw_stranger_cases,
    "world": draw_world_cases,
    "world effect": partial(draw_world_cases, hide="effect"),
    "world stranger": partial(draw_world_cases, hide="stranger"),
}


def play(case: Case) -> dict[str, object]:
    """Return what the product says of a case, next to the truth."""
    from twin.discovery.task import discover

    s = case.specimen
    with tempfile.TemporaryDirectory() as text:
        folder = Path(text)
        profile = ""
        if case.component is not None:
            columns = record_component(s, case.lab, case.seed, *case.component)
        else:
            columns = record(s, case.lab, case.seed, case.test)
            profile = format_profile(s, case.test) if isinstance(case.test, StepTest) else ""
        start = time.process_time()
        row: dict[str, object] = {
            "group": case.group, "name": case.name, "seed": case.seed, "truth": case.truth,
            "place": case.place,
        }  # fmt: skip
        try:
            stated = {} if profile or case.component else state_specimen(s, case.lab)
            log = import_columns(columns, folder, profile, stated)
            start = time.process_time()
            result = discover([log])
        except Exception as error:
            return {**row, "verdict": f"error {type(error).__name__}: {str(error)[:150]}"}
        verdict = result.verdict
        base = verdict.base
        row |= {
            "verdict": verdict.verdict,
            "effects": [
                e.id + (f".{e.channel}" if getattr(e, "channel", None) else "")
                for e in verdict.effects
            ],
            "law": [term.id for term in verdict.law.terms] if verdict.law else [],
            "sensors": verdict.sensors.state,
            "blamed": [
                f"{c.kind} {'+'.join(c.channels)}" for c in verdict.sensors.checks if not c.healthy
            ],
            "confidence": round(verdict.confidence or 0.0, 3),
            "excludes": {size.id: size.force_share for size in verdict.excludes},
            "bounds": {size.id: size.value for size in verdict.excludes},
            "hidden": dict(s.hidden),
            "before": round(verdict.gap.held_out_before, 3),
            "after": round(verdict.gap.held_out_after, 3),
            "floor": round(verdict.gap.noise_floor, 3),
            "seconds": round(time.process_time() - start, 1),
            "why": verdict.why[:160],
            "probability": [
                ("+".join(e.effects), e.stranger, round(e.probability, 3))
                for e in verdict.probability[:4]
            ],
        }
        for name, true in (("stiffness", s.k), ("damping", s.c), ("bumper_stiffness", s.kb),
                           ("bumper_damping", s.cb)):  # fmt: skip
            entry = base.get(name)
            if entry is not None:
                half = (entry.high or np.inf) - entry.value
                row[name] = [round(entry.value / true, 4), round(half / true, 4),
                             bool(abs(entry.value - true) <= half)]  # fmt: skip
        return row


def judge(row: dict[str, object]) -> str:
    """Return right, wrong or half for what is said of a case."""
    verdict, effects = str(row["verdict"]), [str(e) for e in row.get("effects", [])]  # type: ignore[attr-defined]
    blamed = any(e.startswith(("sensor_", "mass_error")) for e in effects)
    if row["group"] in ("component", "clean", "other", "world"):
        return "right" if verdict == "none" and not row.get("blamed") else "wrong"
    if row["group"] in ("effect", "pair", "world effect"):
        if verdict == "named" and sorted(effects) == sorted(row["truth"]):  # type: ignore[call-overload]
            return "right"
        return "open" if verdict in ("unexplained", "ambiguous") and not blamed else "wrong"
    if row["group"] == "small":
        if verdict == "named":
            return "right" if effects == [*row["truth"]] else "wrong"  # type: ignore[misc]
        (true,) = row["hidden"].values()  # type: ignore[attr-defined]
        bound = row["bounds"].get(row["truth"][0], 0.0)  # type: ignore[attr-defined, index]
        if verdict == "none":
            return "none, bound holds" if abs(true) <= abs(bound) else "none, bound too small"
        return "open"
    law = row.get("law")
    if verdict == "unexplained" and not blamed:
        return "right"
    if row["truth"] and verdict == "named" and effects == [*row["truth"]]:  # type: ignore[misc]
        return "right"
    return "law" if law and not blamed else "wrong"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--group", default="")
    parser.add_argument("--seeds", type=int, default=4)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--match", default="")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    seeds = range(options.first, options.first + options.seeds)
    groups = [options.group] if options.group else [*GROUPS]
    cases = [c for g in groups for c in GROUPS[g](seeds) if options.match in c.name]
    rows = []
    with ProcessPoolExecutor(options.workers) as pool:
        for done in as_completed([pool.submit(play, each) for each in cases]):
            row = done.result()
            row["score"] = judge(row)
            rows.append(row)
            parts = {k: v for k, v in row.items() if k not in ("group", "truth", "place")}
            print(row["group"], json.dumps(parts), flush=True)
            if options.out:
                options.out.write_text("\n".join(map(json.dumps, rows)))
    for group in groups:
        scores = [str(r["score"]) for r in rows if r["group"] == group]
        print(group, {s: scores.count(s) for s in sorted({*scores})}, "of", len(scores))


if __name__ == "__main__":
    main()
