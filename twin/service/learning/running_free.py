"""The model running free on the measured table, before and after, beside the measured PRC."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from table_io.block import Block, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.records import Point, Step
from twin.compare.cycles import Scale
from twin.compare.pipeline import Setup, start, step
from twin.compare.windows import TwinSetup
from twin.learn.naming import Explained
from twin.learn.sheet import Sheet
from twin.model.parameters import resonance
from twin.service.learning.figures_evidence import Shown
from twin.service.learning.told import Json

WINDOW_S = 0.5
Runs = tuple[list[Point], list[Point]]  # before, after


def runs_of(shown: Shown) -> dict[int, Runs]:
    """By number of the log; a log that cannot be run freely is not in it."""
    found: dict[int, Runs] = {}
    for sheet in shown.sheets:
        steps = shown.steps(sheet.number)
        before, after = (free_run(sheet, steps, one) for one in shown.pair)
        if before and after:
            found[sheet.number] = before, after
    return found


def misfits(shown: Shown, runs: dict[int, Runs]) -> list[Json]:
    """Of each log: the measured peak of eta_d and its frequency in Hz, the model's before and
    after, and the rms of its error over that of the measured curve, both directions."""
    return [
        {
            "log": shown.sheets[number].readings.name,
            "measured": _peak(runs[number][0], "measured"),
            **{
                name: _peak(points, "twin") | {"error": _error(points)}
                for name, points in zip(("before", "after"), runs[number], strict=True)
            },
        }
        for number in runs
    ]


def _peak(points: Sequence[Point], who: str) -> Json:
    known = [
        (values.eta_d, one.frequency_hz)
        for one in points
        if (values := getattr(one, who)) is not None and math.isfinite(values.eta_d)
    ]
    peak, hz = max(known, default=(math.nan, math.nan))
    return {"eta_d": peak, "frequency_hz": hz}


def _error(points: Sequence[Point]) -> float:
    pairs = [(p.twin.eta_d, p.measured.eta_d) for p in points if p.twin and p.measured]
    known = [pair for pair in pairs if all(map(math.isfinite, pair))]
    if not known:
        return math.nan
    twin, measured = np.array(known).T
    return float(np.linalg.norm(twin - measured) / max(float(np.linalg.norm(measured)), 1e-300))


def free_run(sheet: Sheet, steps: Sequence[Step], one: Explained) -> list[Point]:
    """The PRC points of a log, measured and by the model running free on the measured table.

    Empty where the table's acceleration or the steps are not known. Sensors that are known to err
    are read as the explanation has them.
    """
    guess = one.fit.guess
    m = sheet.motion(guess.sensors())
    if not steps or not np.isfinite(m.table_acc).all() or not np.isfinite(m.acc).all():
        return []
    held = m.label == Label.MEASURE
    cycles = [np.unique(m.cycle[held & (m.step == s.index)]).size for s in steps]
    level = math.sqrt(2.0) * float(m.table_acc[held].std()) if held.any() else 0.0
    if level == 0.0 or max(cycles) == 0 or sheet.reference.parameters.damping == 0:
        return []
    columns = {"rel_disp_m": m.u, "table_disp_m": m.table_disp, "table_acc_m_s2": m.table_acc}
    columns["mass_acc_m_s2"] = m.acc
    if m.cells:
        columns |= dict.fromkeys(RIGHT_CELLS, 0.5 * m.right) | dict.fromkeys(
            LEFT_CELLS, 0.5 * m.left
        )
    first = round(m.time_s[0] * m.rate_hz)
    block = Block(
        "meas", first, m.rate_hz, tuple(columns), np.array([*columns.values()]),
        m.step.copy(), m.label.copy(), m.cycle.copy(),
    )  # fmt: skip
    model = guess.local(sheet.number, m)
    window = round(WINDOW_S * m.rate_hz)
    twin = TwinSetup(model, m.rate_hz, window, window, sheet.contact_n)
    u_star, a_star, _ = resonance(replace(sheet.reference.parameters, mass=m.mass_kg), level)
    gaps = model.parameters.gap_r, model.parameters.gap_l
    scale = Scale(model.parameters, m.rate_hz, sheet.contact_n, u_star, a_star, gaps)
    driven = tuple(replace(one, acceleration_m_s2=level) for one in steps)
    setup = Setup(twin, scale, driven, max(cycles))
    state, _ = start(setup, first)
    _, items = step(setup, state, block)
    return [item for item in items if isinstance(item, Point)]
