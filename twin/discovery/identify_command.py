"""`shaketwin identify`: files and console output of `twin.discovery.identify`."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from rich.table import Table

from table_io.clock import RealClock
from table_io.errors import InputError
from twin.discovery.cross_checks import fitted_gap
from twin.discovery.identify import WINDOW_S, IdentificationResult, identify_parameters
from twin.discovery.least_squares import INTERVAL_SIGMA, FitResult
from twin.discovery.loading import load_recordings
from twin.discovery.parameters import FreeParameter, GapKey, TareKey, get_log
from twin.discovery.sensor_checks import check_sensors
from twin.discovery.sensor_section import describe_sensors
from twin.discovery.serialize import (
    Json,
    interval_to_json,
    model_to_toml,
    parameter_to_json,
    sensors_to_json,
)
from twin.results.summary import dump_strict_json
from twin.setup.folders import make_output_folder, make_run_folder
from twin.setup.run_config import read_model_template
from twin.system.terminal import console, print_line, print_table

METHOD = (
    "least squares of the forces on the measured motion, corrected for the bias caused by noise of "
    "that motion; 95 % intervals from the scatter between forcing cycles"
)
GAPS_NOTE = "gaps belong to the test profile of each log, not to the model file"
SYMBOLS = {
    "stiffness": "K", "damping": "C", "bumper_stiffness": "K_j", "bumper_damping": "C_j",
}  # fmt: skip


def identify_command(paths: Sequence[Path], model: str, out: Path | None) -> int:
    """Identify parameters from recordings; write a model file and a page; return the exit code."""
    clock = RealClock()
    start_s = clock.now()
    target = _resolve_target(out)
    start, config = read_model_template(model)
    with console.status("reading"):
        loaded_logs = [*load_recordings(paths)]
    with console.status("fitting the forces on the measured motion"):
        result = identify_parameters(
            [loaded.log for loaded in loaded_logs], [loaded.blocks for loaded in loaded_logs], start
        )
    names = ", ".join(loaded.log.signals.name for loaded in loaded_logs)
    text, omitted = model_to_toml(
        _drop_log_parameters(result.fit), f"{config.title}; identified", METHOD, names
    )
    report = identification_to_json(
        result,
        [
            *(note for loaded in loaded_logs for note in loaded.notes),
            *result.notes,
            *omitted,
            GAPS_NOTE,
        ],
    )
    report["start"] = model
    report["seconds"] = clock.now() - start_s
    folder = make_output_folder(target.with_suffix(""), "")
    target.write_text(text, encoding="utf-8")
    (folder / "identify.json").write_text(dump_strict_json(report), encoding="utf-8")
    from twin.discovery.identify_page import write_identification_page  # slow to import

    page = write_identification_page(folder, result, report, target.name, text)
    print_identification(report)
    print_line(f"{target}; {page}")
    return 0


def _resolve_target(out: Path | None) -> Path:
    """Return the path of the new model file; raise InputError, before the fit, if not usable."""
    if out is None:
        return make_run_folder(None, "identify")[0] / "model.toml"
    if out.suffix != ".toml":
        raise InputError("not a model file", where=f"--out {out}", allowed="a name in .toml")
    if out.exists():
        raise InputError(
            "exists; files are never overwritten", where=f"--out {out}", remedy="give a new name"
        )
    # checked here and created at the end, so that a failure leaves no folder
    make_output_folder(out.with_suffix(""), "").rmdir()
    return out


def _drop_log_parameters(fit: FitResult) -> FitResult:
    """Return the fit without the estimates for single logs: tare errors and gap corrections."""
    return replace(
        fit, values={key: value for key, value in fit.values.items() if get_log(key) is None}
    )


def identification_to_json(result: IdentificationResult, notes: Sequence[str]) -> Json:
    """Return the content of identify.json, in SI units."""
    fit, log_residuals = result.fit, result.problem.log_residuals
    names = [residuals.signals.name for residuals in log_residuals]
    units = {parameter.key: parameter.unit for parameter in fit.free}
    return {
        "method": METHOD,
        "logs": names,
        "parameters": {
            parameter.name: interval_to_json(
                fit.values[parameter.key], fit.interval_error(parameter.key), parameter.unit
            )
            | _count_cycles(fit, parameter)
            | _compare_with_start(result, parameter)
            for parameter in fit.free
            if get_log(parameter.key) is None
        },
        "gaps": {name: _gap_json(result, k) for k, name in enumerate(names)},
        "zeros": {
            parameter.name: parameter_to_json(fit, parameter)
            for parameter in fit.free
            if isinstance(parameter.key, TareKey)
        },
        "gap_offset": interval_to_json(*result.asymmetry, "m") if result.asymmetry else None,
        "correlations": [{"of": [a, b], "value": value} for a, b, value in result.correlated_pairs],
        "rms_over_noise": result.rms_over_noise,
        "converged": fit.converged,
        "at_bound": [*map(str, fit.at_bound)],
        "not_determined": [*map(str, result.undetermined)],
        "sources": [
            {
                "source": part.source,
                "entries": part.entry_count,
                "converged": part.converged,
                "parameters": {
                    str(key): interval_to_json(*pair, units[key])
                    for key, pair in part.values.items()
                },
            }
            for part in result.subsets
        ],
        "contacts": [
            interval_to_json(gaps.value, gaps.std_error, "m")
            | {
                "log": names[gaps.log], "side": gaps.side, "kind": gaps.kind,
                "scatter": gaps.scatter,
                "count": int(gaps.gaps.size), "correction": float(gaps.depth.mean()),
            }
            for gaps in result.contact_gaps
        ],
        "windows": [
            {
                "log": name, "window_s": WINDOW_S, "nrmse_start": pair[0],
                "nrmse_identified": pair[1], "noise_floor": floor,
            }
            for name, pair, floor in zip(
                names, result.window_errors, result.window_floors, strict=True
            )
            if pair
        ],
        "sensors": sensors_to_json(check_sensors(log_residuals, fit)),
        "warnings": [*result.warnings],
        "notes": [*notes],
    }  # fmt: skip


def _count_cycles(fit: FitResult, parameter: FreeParameter) -> Json:
    """Return the effective number of cycles or contacts that determine a parameter, if limited."""
    count = fit.block_counts.get(parameter.key, math.inf)
    return {"cycles": count} if math.isfinite(count) else {}


def _compare_with_start(result: IdentificationResult, parameter: FreeParameter) -> Json:
    """Return the value of the start model and the difference from it in standard deviations."""
    start_value = result.start.values.get(parameter.keys[0])
    value, sd = result.fit.values[parameter.key], result.fit.interval_error(parameter.key)
    if start_value is None:
        return {}
    return {
        "start": start_value,
        "deviations": (value - start_value) / sd if 0 < sd < math.inf else None,
    }


def _gap_json(result: IdentificationResult, log: int) -> Json:
    """Return the total gap of a log in m: stated, and with contact the fitted one."""
    residuals, key = result.problem.log_residuals[log], GapKey(log)
    sides = {side: fitted_gap(residuals, result.fit, side) for side in ("right", "left")}
    gap: Json = {"stated": sum(residuals.signals.gaps_m), "unit": "m", **sides}
    if key in result.fit.std_errors:
        gap |= interval_to_json(sum(sides.values()), 2 * result.fit.interval_error(key), "m")
    return gap


def print_identification(report: Json) -> None:
    """Print the parameters as tables, then correlations, errors, warnings and notes."""
    table = Table(title="Identified parameters, with 95 % intervals", title_justify="left")
    for heading in ("", "value", "+-", "unit", "start model", "difference in std dev"):
        table.add_column(heading, justify="left" if heading in ("", "unit") else "right")
    for name, note in report["parameters"].items():
        deviations = note.get("deviations")
        table.add_row(
            SYMBOLS.get(name, name), *_format_interval(note), note["unit"],
            f"{note['start']:g}" if "start" in note else "",
            f"{deviations:+.1f}" if deviations else "",
        )  # fmt: skip
    for log, note in report["gaps"].items():
        if "low" in note:
            width = note["high"] - note["low"]
            gap_deviations = INTERVAL_SIGMA * 2 * (note["value"] - note["stated"]) / width
            table.add_row(
                f"gap of {log}",
                *_format_interval(note, 1e3),
                "mm",
                f"{1e3 * note['stated']:g}",
                f"{gap_deviations:+.1f}" if width < math.inf else "",
            )
    print_table(console, table)
    _print_subsets(report)
    for note in report["correlations"]:
        print_line(
            f"strongly correlated: {' and '.join(note['of'])}, correlation {note['value']:+.2f}"
        )
    for note in report["windows"]:
        print_line(
            f"{note['log']}: error of u over windows of {note['window_s']:g} s, "
            f"{100 * note['nrmse_start']:.3g} % of its rms with the start model, "
            f"{100 * note['nrmse_identified']:.3g} % as identified, noise "
            f"{100 * note['noise_floor']:.2g} %"
        )
    print_line(f"rms residual over the sensor noise: {report['rms_over_noise']:.3f}")
    for line in describe_sensors(report["sensors"]):
        print_line(line)
    for note in report["warnings"]:
        print_line(f"warning: {note}")
    for note in report["notes"]:
        print_line(f"note: {note}")


def _print_subsets(report: Json) -> None:
    """Print the estimates from subsets of the samples, and the gaps from contact onsets."""
    names = [name for name in report["parameters"] if name in SYMBOLS]
    gaps = [log for log, name in enumerate(report["logs"]) if "low" in report["gaps"][name]]
    table = Table(title="Estimates from subsets of the samples", title_justify="left")
    table.add_column("")
    for name in names:
        unit = report["parameters"][name]["unit"]
        table.add_column(f"{SYMBOLS[name]} in {unit}", justify="right")
    for log in gaps:
        table.add_column(f"gap correction per side, log {log}, mm", justify="right")
    for subset in report["sources"]:
        estimates = subset["parameters"]
        cells = [
            " +- ".join(_format_interval(estimates[name])) if name in estimates else ""
            for name in names
        ]
        cells += [
            " +- ".join(_format_interval(estimates[name], 1e3)) if name in estimates else ""
            for name in map(str, map(GapKey, gaps))
        ]
        table.add_row(subset["source"], *cells)
    print_table(console, table)
    for contact in report["contacts"]:
        print_line(
            f"{contact['log']}: {contact['side']} gap from {contact['count']} {contact['kind']}s "
            f"{' +- '.join(_format_interval(contact, 1e3))} mm, "
            f"scatter {1e3 * contact['scatter']:.3f} mm, "
            f"corrected by {1e3 * contact['correction']:.3f} mm"
        )


def _format_interval(estimate: Json, scale: float = 1.0) -> tuple[str, str]:
    """Return (value, half interval) as text, with the digits that the interval justifies.

    Without an interval, as of too few cycles, the value has four digits.
    """
    value, half = scale * estimate["value"], 0.5 * scale * (estimate["high"] - estimate["low"])
    if not 0 < half < math.inf:
        return f"{value:.4g}", "-"
    places = max(0, 1 - math.floor(math.log10(half)))
    return f"{value:.{places}f}", f"{half:.{places}f}"
