"""The forces of a log over their noise, and columns for each effect that the state alone makes.

    damper     -M a - F_R - F_L  =  K u + C u' + const            + sum of columns
    bumpers    F_R, -F_L         =  K_j d + C_j d' + const        + sum of columns, in contact

with d the depth past the gap on either side. Motion, forces, noise, gap and the entries that count
are those of discovery, so a rival sees the same states; a memory (hysteresis, relaxation) is no
function of them and has no column.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.learn.discover import Log, prepare
from twin.learn.guess import Guess
from twin.learn.motion import Motion
from twin.learn.search import folds_of
from twin.learn.sheet import FORCES, Sheet
from twin.model.model import Model

Json = dict[str, Any]
METRIC = (
    "rms of measured minus told forces along the measured motion, over the noise of the sensors, "
    "on steps that were not fitted; the entries are those of discovery"
)


@dataclass(frozen=True, eq=False)
class Regression:
    """One force over its noise, (entry,), and what may make it, (entry, column) each.

    `entries` are its places among the entries of the sheet, `fold` and `block` where each lies.
    """

    force: Float1D
    base: Float2D
    names: tuple[str, ...]
    columns: Float2D
    entries: Int1D
    fold: Int1D
    block: Int1D


@dataclass(frozen=True, eq=False)
class Bench:
    """A log with the base refitted: what a rival starts from."""

    sheet: Sheet
    guess: Guess

    @cached_property
    def motion(self) -> Motion:
        """As discovery believes it before it doubts a sensor."""
        return self.sheet.motion(self.guess.sensors())

    @cached_property
    def u(self) -> Float1D:
        """(sample,) less what the tare of the displacement is believed to be off."""
        return self.motion.u - self.guess.zero(self.sheet.number, "u")

    @cached_property
    def regressions(self) -> tuple[Regression, ...]:
        """Of the damper, and of the bumpers where there are contacts."""
        found = [self._damper()]
        return (*found, self._bumpers()) if (self.sheet.row_of == 1).any() else tuple(found)

    def _damper(self) -> Regression:
        m = self.motion
        u, v = self.u, m.v
        columns = {
            "cubic_stiffness": u**3, "quadratic_damping": v * np.abs(v),
            "coulomb_friction": np.sign(v), "table_tilt": m.table_disp, "mass_error": m.acc,
        }  # fmt: skip
        places = np.flatnonzero(self.sheet.row_of == 0)
        return self._regression(places, [u, v], columns)

    def _bumpers(self) -> Regression:
        m, rows = self.motion, self.sheet.row_of
        p = self.guess.local(self.sheet.number, m).parameters
        places = np.flatnonzero((rows == 1) | (rows == 2))
        samples, way = self.sheet.sample_of[places], np.where(rows[places] == 1, 1.0, -1.0)
        depth = way * self.u[samples] - np.where(way > 0, p.gap_r, p.gap_l)
        speed = way * m.v[samples]
        columns = {
            "bumper_hardening": depth * np.abs(depth), "hunt_crossley": np.abs(depth) * speed,
            "bumper_asymmetry": way * depth, "gap_offset": way, "gap_drift": m.time_s[samples],
        }  # fmt: skip
        return self._regression(places, [depth, speed], columns, whole=False)

    def _regression(
        self, places: Int1D, base: Sequence[Float1D], columns: dict[str, Float1D],
        whole: bool = True,
    ) -> Regression:  # fmt: skip
        """Of the entries `places`; base and columns are of samples where `whole`, else of them."""
        sheet, m = self.sheet, self.motion
        samples, rows = sheet.sample_of[places], sheet.row_of[places]
        mass = self.guess.local(sheet.number, m).parameters.mass
        noise = sheet.noise(m, mass)[rows] * sheet.weight
        values = np.stack([*base, *columns.values()], axis=1)
        values = (values[samples] if whole else values) / noise[:, None]
        force = sheet.measured(m, mass, self.guess)[rows, samples] / noise
        return Regression(
            force, np.column_stack([values[:, : len(base)], 1.0 / noise]), tuple(columns),
            values[:, len(base) :], places, folds_of(sheet)[places], sheet.block_of[places],
        )  # fmt: skip

    def gap(self, left: Sequence[Float1D]) -> Json:
        """The gap as in verdict.json, with what a rival leaves of each regression when held out.

        The other entries (sensors against each other, values at rest) stay as the base has them.
        """
        everything = self.sheet.residual(self.guess)
        counted = self.sheet.row_of < len(self.sheet.rows)
        before = _rms(everything[counted])
        for one, values in zip(self.regressions, left, strict=True):
            everything[one.entries] = values
        return {
            "metric": METRIC, "held_out_before": before,
            "held_out_after": _rms(everything[counted]), "noise_floor": 1.0,
        }  # fmt: skip


def bench_of(log: Log, model: Model) -> Bench:
    """A log with the base refitted on all of it; BadInput as in discovery."""
    prepared = prepare([log], model)
    sheet = prepared.bench.sheets[0]
    assert sheet.whitening is None, "a rival takes the balance as it is measured"
    assert sheet.rows[: len(FORCES)] == FORCES
    return Bench(sheet, prepared.guess)


def _rms(values: Float1D) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
