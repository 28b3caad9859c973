"""What a model leaves of the measured forces, along the measured motion; and its best parameters.

    damper row   -M a - F_R - F_L - D          (the damper's force from the balance, or measured)
    bumper rows  F_R - model's, -(F_L - model's), where contact was measured
each divided by its noise. Without load cells the damper row holds all forces, and the model says
where it touches. Nothing is simulated, so a fit converges from far and in chaos.

Residuals of real rigs are coloured: statistics are taken over blocks (forcing cycles), never over
samples.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Bool2D, Float1D, Float2D, Int1D
from twin.learn.motion import Motion
from twin.model.forced import along, tilting
from twin.model.model import Model

CONTACT_NOISES = 8.0  # a load cell above so many of its noise bears something
EDGE_S = 0.012  # next to a measured touch or release the low pass smears the jump
BLOCK_S = 1.0  # of a block where there are no forcing cycles
MOST_STEPS = 40
CLOSE = 1e-7  # of the cost: what an iteration must gain to be followed by another
DAMPER, RIGHT, LEFT = range(3)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A motion prepared for fits: which samples count in which row, and in which block they lie."""

    motion: Motion
    contact_n: float

    @cached_property
    def touched(self) -> Bool2D:
        """(2, sample): 1 where a side was measured to bear, 0 where not, -1 where nobody knows."""
        m = self.motion
        if not m.cells:
            known = -1 if any(math.isfinite(gap) for gap in m.gaps_m) else 0
            return np.full((2, m.u.size), known, dtype=np.int8)
        noise = (m.noise.right, m.noise.left)
        return np.array(
            [
                push > max(self.contact_n, CONTACT_NOISES * rms)
                for push, rms in zip((m.right, m.left), noise, strict=True)
            ],
            dtype=np.int8,
        )

    @cached_property
    def used(self) -> Bool2D:
        """(3, sample): what counts in the rows damper, right, left."""
        m = self.motion
        used = np.zeros((3, m.u.size), dtype=bool)
        used[DAMPER] = m.moving & np.isfinite(self.measured(m.mass_kg)[DAMPER])
        if m.cells:
            margin = max(round(EDGE_S * m.rate_hz), 1)
            for row, touched in ((RIGHT, self.touched[0] > 0), (LEFT, self.touched[1] > 0)):
                inside = np.convolve(~touched, np.ones(2 * margin + 1), "same") == 0
                used[row] = m.moving & touched & inside
        return used

    def measured(self, mass_kg: float) -> Float2D:
        """(3, sample): damper force from the balance of a mass, F_R, -F_L in N."""
        m = self.motion
        if m.damper is not None:
            return np.array([m.damper, np.full(m.u.size, np.nan), np.full(m.u.size, np.nan)])
        inertia = -mass_kg * m.acc
        if not m.cells:
            return np.array([inertia, m.right, m.left])
        return np.array([inertia - m.right + m.left, m.right, m.left])

    @cached_property
    def noise(self) -> Float1D:
        """(3,) rms of the rows in N, from the sensors alone."""
        n, mass = self.motion.noise, self.motion.mass_kg
        if self.motion.damper is not None:
            return np.array([n.force, np.nan, np.nan])
        if not self.motion.cells:
            return np.array([mass * n.acc, np.nan, np.nan])
        return np.array([math.hypot(mass * n.acc, n.right, n.left), n.right, n.left])

    @cached_property
    def blocks(self) -> Int1D:
        """(sample,) number of the block that a sample lies in: a forcing cycle, else a second."""
        m = self.motion
        seconds = (m.time_s / BLOCK_S).astype(np.int64)
        loose = np.where(m.cycle >= 0, 0, seconds)
        key = np.stack([m.step, m.cycle, loose])
        change = np.any(np.diff(key, axis=1) != 0, axis=0)
        numbers: Int1D = np.concatenate([[0], np.cumsum(change)])
        return numbers

    def residual(self, model: Model) -> Float2D:
        """(3, sample) measured minus model over noise; zero where a row does not count."""
        m = self.motion
        d, right, left = along(model, m.u, m.v, m.time_s, self.touched)
        if not m.cells and m.damper is None:
            d = d + right + left
        if model.value("table_tilt", "tilt"):
            d = d + tilting(model, m.table_disp)
        measured = self.measured(model.parameters.mass)
        left_over = (measured - np.array([d, right, -left])) / self.noise[:, None]
        return np.where(self.used, left_over, 0.0)


@dataclass(frozen=True, slots=True)
class Free:
    """A number that a fit may move: `set(values, x)` writes it into a flat model."""

    name: str
    start: float
    low: float
    high: float
    scale: float
    keys: tuple[str, ...]
    added: bool = False  # x is added to each of the keys' starting values (gaps)
    logarithmic: bool = False

    def write(self, flat: dict[str, float], x: float) -> None:
        """Put the value into a flat model."""
        for key in self.keys:
            flat[key] = flat[key] + x if self.added else x


BASE = (
    ("stiffness", ("stiffness",)),
    ("damping", ("damping",)),
    ("bumper_stiffness", ("bumper_stiffness_r", "bumper_stiffness_l")),
    ("bumper_damping", ("bumper_damping_r", "bumper_damping_l")),
)


def base_free(model: Model, touches: bool) -> tuple[Free, ...]:
    """The parameters of the SNM; those of the bumpers only where they were touched."""
    flat = model.flat()
    wanted = BASE if touches else BASE[:2]
    free = [
        Free(
            name,
            flat[keys[0]],
            0.0 if "damping" in name else 1e-3,
            math.inf,
            abs(flat[keys[0]]) or 1.0,
            keys,
        )
        for name, keys in wanted
    ]
    if touches:
        free.append(Free("gap", 0.0, -0.02, 0.02, 1e-3, ("gap_r", "gap_l"), added=True))
    return tuple(free)


def effect_free(model: Model, name: str) -> tuple[Free, ...]:
    """The parameters of one active effect of a model."""
    active = next(one for one in model.effects if one.name == name)
    free = []
    for p in active.effect.parameters:
        x = active.values[p.name]
        shape = p.vanishing is None
        scale = abs(p.typical - (p.vanishing or 0.0)) or 1.0
        free.append(
            Free(
                f"{name}.{p.name}",
                x,
                p.low,
                p.high,
                scale,
                (f"{name}.{p.name}",),
                logarithmic=shape,
            )
        )
    return tuple(free)


@dataclass(frozen=True, eq=False)
class Fit:
    """The best parameters of a model on some blocks, and how well they are known."""

    model: Model
    values: Mapping[str, float]
    spread: Mapping[str, float]  # standard deviation, robust against coloured residuals
    correlation: Float2D
    cost: float  # mean square of the residual over its noise, on the blocks fitted
    converged: bool
    at_bound: tuple[str, ...]


def fit(
    sheets: Sequence[Sheet],
    model: Model,
    free: Sequence[Free],
    train: Sequence[Bool2D],
    models: Callable[[Model, Sheet], Model] | None = None,
) -> Fit:
    """Levenberg-Marquardt on the blocks of each sheet where `train` is True, (block,) each.

    `models(model, sheet)` puts a log's own gaps and mass into the model, where logs differ.
    """
    search = _Search(sheets, model, tuple(free), train, models or (lambda one, _: one))
    return search.run()


class _Search:
    """One Levenberg-Marquardt search; x are the free values, logarithms where they are shapes."""

    def __init__(
        self,
        sheets: Sequence[Sheet],
        model: Model,
        free: tuple[Free, ...],
        train: Sequence[Bool2D],
        models: Callable[[Model, Sheet], Model],
    ) -> None:
        self.sheets, self.model, self.free, self.models = sheets, model, free, models
        self.flat = model.flat()
        self.chosen = [
            sheet.used & mask[sheet.blocks][None, :]
            for sheet, mask in zip(sheets, train, strict=True)
        ]
        self.count = max(sum(int(one.sum()) for one in self.chosen), 1)

    def at(self, x: Float1D) -> Model:
        flat = dict(self.flat)
        for one, value in zip(self.free, x, strict=True):
            one.write(flat, math.exp(value) if one.logarithmic else value)
        return Model.from_flat(flat)

    def residuals(self, x: Float1D) -> list[Float1D]:
        """Of every sheet, the rows that count one after another."""
        model = self.at(x)
        return [
            sheet.residual(self.models(model, sheet))[chosen]
            for sheet, chosen in zip(self.sheets, self.chosen, strict=True)
        ]

    def jacobian(self, x: Float1D, before: list[Float1D]) -> list[Float2D]:
        columns: list[list[Float1D]] = [[] for _ in self.sheets]
        for i, one in enumerate(self.free):
            step = 1e-4 * (1.0 if one.logarithmic else one.scale)
            low, high = self.bounds(one)
            step = -step if x[i] + step > high else step
            moved = x.copy()
            moved[i] = np.clip(x[i] + step, low, high)
            for k, after in enumerate(self.residuals(moved)):
                columns[k].append((after - before[k]) / (moved[i] - x[i]))
        return [np.array(rows) for rows in columns]

    @staticmethod
    def bounds(one: Free) -> tuple[float, float]:
        if one.logarithmic:
            return math.log(max(one.low, 1e-300)), math.log(one.high)
        return one.low, one.high

    def run(self) -> Fit:
        x = np.array([math.log(f.start) if f.logarithmic else f.start for f in self.free])
        low, high = (np.array(side) for side in zip(*map(self.bounds, self.free), strict=True))
        x = np.clip(x, low, high)
        r = self.residuals(x)
        cost, damping, converged = _square(r), 1e-3, False
        for _ in range(MOST_STEPS):
            jacobian = self.jacobian(x, r)
            hessian = np.sum([j @ j.T for j in jacobian], axis=0)
            gradient = np.sum([j @ one for j, one in zip(jacobian, r, strict=True)], axis=0)
            gained = 0.0
            for _ in range(8):
                step = -_solved(hessian, damping, gradient)
                trial = np.clip(x + step, low, high)
                after = self.residuals(trial)
                new = _square(after)
                if new < cost:
                    gained = (cost - new) / max(cost, 1e-300)
                    x, r, cost, damping = trial, after, new, max(damping / 10, 1e-9)
                    break
                damping *= 10
            if gained < CLOSE:
                converged = True
                break
        return self._fit(x, r, cost, converged, (low, high))

    def _fit(
        self,
        x: Float1D,
        r: list[Float1D],
        cost: float,
        converged: bool,
        limits: tuple[Float1D, Float1D],
    ) -> Fit:
        """Values, and spreads from the scatter of the blocks' gradients (a sandwich)."""
        jacobian = self.jacobian(x, r)
        hessian = np.sum([j @ j.T for j in jacobian], axis=0)
        size = _sizes(hessian)
        inverse = np.linalg.pinv(hessian / np.outer(size, size), hermitian=True)
        inverse /= np.outer(size, size)
        middle = np.zeros_like(inverse)
        for sheet, chosen, j, one in zip(self.sheets, self.chosen, jacobian, r, strict=True):
            blocks = np.broadcast_to(sheet.blocks, chosen.shape)[chosen]
            gradients = np.array([np.bincount(blocks, weights=row * one) for row in j])
            middle += gradients @ gradients.T
        covariance = inverse @ middle @ inverse
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale = np.where(sd > 0, sd, 1.0)
        values, spread, stuck = {}, {}, []
        for i, free in enumerate(self.free):
            value = math.exp(x[i]) if free.logarithmic else float(x[i])
            values[free.name] = value
            spread[free.name] = float(sd[i] * (value if free.logarithmic else 1.0))
            if x[i] in (limits[0][i], limits[1][i]) and value != 0.0:
                stuck.append(free.name)
        correlation = covariance / np.outer(scale, scale)
        return Fit(
            self.at(x), values, spread, correlation, cost / self.count, converged, tuple(stuck)
        )


def _sizes(hessian: Float2D) -> Float1D:
    """What makes the parameters comparable: the root of their own curvature."""
    curvature = np.sqrt(np.diag(hessian))
    return np.where(curvature > 0, curvature, 1.0)


def _solved(hessian: Float2D, damping: float, gradient: Float1D) -> Float1D:
    """The damped Newton step, well scaled."""
    size = _sizes(hessian)
    scaled = hessian / np.outer(size, size) + damping * np.eye(size.size)
    step: Float1D = np.linalg.lstsq(scaled, gradient / size, rcond=1e-14)[0] / size
    return step


def _square(residuals: list[Float1D]) -> float:
    return float(sum(one @ one for one in residuals))


def by_block(sheet: Sheet, model: Model) -> Float2D:
    """(3, block) sums of the squared residuals over noise of each block."""
    r2 = sheet.residual(model) ** 2
    count = int(sheet.blocks[-1]) + 1
    return np.array([np.bincount(sheet.blocks, weights=row, minlength=count) for row in r2])


def counts(sheet: Sheet) -> Float2D:
    """(3, block) how many samples count in each block."""
    count = int(sheet.blocks[-1]) + 1
    return np.array([np.bincount(sheet.blocks, weights=row, minlength=count) for row in sheet.used])


def localised(model: Model, sheet: Sheet) -> Model:
    """The model with the mass of a log's specimen; the gaps stay the model's own."""
    return replace(model, base=replace(model.base, mass=sheet.motion.mass_kg))
