"""`shaketwin identify`: the shell round `twin.learn.identify`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.table import Table

from table_io.card import BadInput
from table_io.clock import RealClock
from twin.learn.fit import Fit
from twin.learn.guess import GAP, ZERO, Guess, log_of
from twin.learn.identify import WINDOW_S, Identified, identify
from twin.learn.parts import local_gap
from twin.service.folders import new_folder, new_run
from twin.service.learning.command import model_of
from twin.service.learning.logs import taken
from twin.service.learning.told import SURE, Json, model_toml, number
from twin.service.summary import dumps
from twin.service.terminal import console, print_table, say

METHOD = (
    "least squares of the forces along the measured motion, less what the noise of that motion "
    "does to it; 95 % intervals from the scatter between forcing cycles"
)
GAPS = "gaps belong to the test profile of each log, not to the model card"
SYMBOLS = {
    "stiffness": "K", "damping": "C", "bumper_stiffness": "K_j", "bumper_damping": "C_j",
}  # fmt: skip


def identify_command(paths: Sequence[Path], model: str, out: Path | None) -> int:
    """The parameters that recordings say, as a model card with figures; the exit code."""
    clock = RealClock()
    began = clock.now()
    target = _target(out)
    start, card = model_of(model)
    with console.status("reading"):
        read = [*taken(paths)]
    with console.status("fitting the forces along the measured motion"):
        found = identify([one.log for one in read], [one.blocks for one in read], start)
    names = ", ".join(one.log.readings.name for one in read)
    text, left_out = model_toml(_lean(found.fit), f"{card.title}; identified", METHOD, names)
    told = told_json(
        found, [*(note for one in read for note in one.notes), *found.notes, *left_out, GAPS]
    )
    told["start"] = model
    told["seconds"] = clock.now() - began
    folder = new_folder(target.with_suffix(""), "")
    target.write_text(text, encoding="utf-8")
    (folder / "identify.json").write_text(dumps(told), encoding="utf-8")
    from twin.service.learning.identify_figures import draw  # slow to import

    draw(found, folder)
    show(told)
    say(f"{target}, with its figures and identify.json in {folder}")
    return 0


def _target(out: Path | None) -> Path:
    """Where the model goes; BadInput before the long work where it cannot."""
    if out is None:
        return new_run(None, "identify")[0] / "model.toml"
    if out.suffix != ".toml":
        raise BadInput(f"--out {out}: a model is a .toml file; give a name that ends so")
    if out.exists():
        raise BadInput(f"--out {out}: exists; nothing is ever overwritten. Give a new name")
    new_folder(out.with_suffix(""), "").rmdir()  # made at the end: nothing is left of a failure
    return out


def _lean(fit: Fit) -> Fit:
    """Without what belongs to each log and to no model: the zeros of its sensors, its gaps."""
    kept = {key: value for key, value in fit.guess.values.items() if not key.startswith(ZERO)}
    values = {key: value for key, value in fit.values.items() if log_of(key) is None}
    return replace(fit, guess=Guess(kept), values=values)


def told_json(found: Identified, notes: Sequence[str]) -> Json:
    """What was identified, in SI, as it stands in identify.json."""
    fit, sheets = found.fit, found.bench.sheets
    names = [sheet.readings.name for sheet in sheets]
    units = {one.name: one.unit for one in fit.free}
    return {
        "method": METHOD,
        "logs": names,
        "parameters": {
            one.name: number(fit, one.name, one.unit) | _from_start(found, one.name, one.keys[0])
            for one in fit.free
            if log_of(one.name) is None
        },
        "gaps": {name: _gap(found, k) for k, name in enumerate(names)},
        "zeros": {
            one.name: number(fit, one.name, one.unit)
            for one in fit.free
            if one.name.startswith(ZERO)
        },
        "gap_offset": _span(*found.asymmetry, "m") if found.asymmetry else None,
        "correlations": [{"of": [a, b], "value": value} for a, b, value in found.tied],
        "rms_over_noise": math.sqrt(fit.cost),
        "converged": fit.converged,
        "at_bound": [*fit.at_bound],
        "not_determined": [*found.fixed],
        "sources": [
            {
                "source": part.source,
                "entries": part.entries,
                "converged": part.converged,
                "parameters": {
                    name: _span(*pair, units[name]) for name, pair in part.values.items()
                },
            }
            for part in found.parts
        ],
        "contacts": [
            _span(one.value, one.sd, "m")
            | {
                "log": names[one.log], "side": one.side, "kind": one.kind, "scatter": one.scatter,
                "count": int(one.gaps.size), "correction": float(one.depth.mean()),
            }
            for one in found.onsets
        ],
        "windows": [
            {"log": name, "window_s": WINDOW_S, "nrmse_start": pair[0], "nrmse_identified": pair[1]}
            for name, pair in zip(names, found.windows, strict=True)
            if pair
        ],
        "warnings": [*found.warnings],
        "notes": [*notes],
    }  # fmt: skip


def _span(value: float, sd: float, unit: str) -> Json:
    return {"value": value, "low": value - SURE * sd, "high": value + SURE * sd, "unit": unit}


def _from_start(found: Identified, name: str, key: str) -> Json:
    """What the start model said, and how many deviations away that is."""
    was, sd = found.began.values.get(key), found.fit.spread[name]
    if was is None:
        return {}
    return {"start": was, "deviations": (found.fit.values[name] - was) / sd if sd else None}


def _gap(found: Identified, log: int) -> Json:
    """The total gap of a log: as stated, and as found with its interval where it touches."""
    sheet, name = found.bench.sheets[log], f"{GAP}{log}"
    sides = {side: local_gap(sheet, found.fit, side) for side in ("right", "left")}
    told: Json = {"stated": sum(sheet.readings.gaps_m), "unit": "m", **sides}
    if name in found.fit.spread:
        told |= _span(sum(sides.values()), 2 * found.fit.spread[name], "m")
    return told


def show(told: Json) -> None:
    """The numbers as tables, then what is suspicious."""
    table = Table(title="Identified, with 95 % intervals", title_justify="left")
    for head in ("", "value", "+-", "unit", "start model", "deviations apart"):
        table.add_column(head, justify="left" if head in ("", "unit") else "right")
    for name, one in told["parameters"].items():
        apart = one.get("deviations")
        table.add_row(
            SYMBOLS.get(name, name), *_digits(one), one["unit"],
            f"{one['start']:g}" if "start" in one else "", f"{apart:+.1f}" if apart else "",
        )  # fmt: skip
    for log, one in told["gaps"].items():
        if "low" in one:
            off = SURE * 2 * (one["value"] - one["stated"]) / (one["high"] - one["low"])
            table.add_row(
                f"gap of {log}", *_digits(one, 1e3), "mm", f"{1e3 * one['stated']:g}", f"{off:+.1f}"
            )
    print_table(console, table)
    _show_sources(told)
    for one in told["correlations"]:
        say(f"hard to tell apart: {' and '.join(one['of'])}, correlation {one['value']:+.2f}")
    for one in told["windows"]:
        say(
            f"{one['log']}: error of u over windows of {one['window_s']:g} s, "
            f"{100 * one['nrmse_start']:.3g} % of its rms with the start model, "
            f"{100 * one['nrmse_identified']:.3g} % as identified"
        )
    say(f"rms of what is left over the sensors' noise: {told['rms_over_noise']:.3f}")
    for one in told["warnings"]:
        say(f"warning: {one}")
    for one in told["notes"]:
        say(f"note: {one}")


def _show_sources(told: Json) -> None:
    """The same numbers, each from some of the samples alone."""
    names = [name for name in told["parameters"] if name in SYMBOLS]
    gaps = [f"{GAP}{k}" for k, log in enumerate(told["logs"]) if "low" in told["gaps"][log]]
    table = Table(title="From some of the samples alone", title_justify="left")
    table.add_column("")
    for name in names:
        unit = told["parameters"][name]["unit"]
        table.add_column(f"{SYMBOLS[name]} in {unit}", justify="right")
    for name in gaps:
        table.add_column(f"each gap wider, log {name[len(GAP) :]}, mm", justify="right")
    for part in told["sources"]:
        there = part["parameters"]
        cells = [" +- ".join(_digits(there[name])) if name in there else "" for name in names]
        cells += [" +- ".join(_digits(there[g], 1e3)) if g in there else "" for g in gaps]
        table.add_row(part["source"], *cells)
    print_table(console, table)
    for one in told["contacts"]:
        say(
            f"{one['log']}: {one['side']} gap from {one['count']} {one['kind']}s "
            f"{' +- '.join(_digits(one, 1e3))} mm, scatter {1e3 * one['scatter']:.3f} mm, "
            f"corrected by {1e3 * one['correction']:.3f} mm"
        )


def _digits(one: Json, scale: float = 1.0) -> tuple[str, str]:
    """(value, half the interval) with as many digits as the interval bears."""
    half = 0.5 * scale * (one["high"] - one["low"])
    places = max(0, 1 - math.floor(math.log10(half))) if 0 < half < math.inf else 3
    return f"{scale * one['value']:.{places}f}", f"{half:.{places}f}"
