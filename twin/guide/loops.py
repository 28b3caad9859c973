"""Force-displacement loops of the model without and with an effect, as SVG for the gallery.

The loops of the built-in effects are shipped in loops.json, because their solvers take most of a
minute to compile. `python -m twin.guide.loops` writes it again; a test compares it with the model.
"""

import json
import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.units import GRAVITY_M_S2
from twin.laws.effect import Effect
from twin.laws.library import EFFECTS
from twin.model.model import Model
from twin.model.parameters import Parameters

LOOPS_FILE = Path(__file__).with_name("loops.json")
# Damper, bumpers and level of the shipped model and tests.
STIFFNESS, DAMPING, MASS = 36e3, 1.1e3, 550.0
BUMPER = (510e3, 900.0)
CONTACT_GAP_M = 2e-3  # a side
LEVEL_G = 0.05
FLIGHT_HZ, CONTACT_HZ = 1.2, 2.0
SETTLE_CYCLES = 40
SAMPLES_PER_CYCLE = 2000
LOOP_POINTS = 160
SENSOR_CHANNELS = {"sensor_offset": "rel_disp_m"}
ACCELEROMETER = "mass_acc_m_s2"  # the channel of the other sensor effects
FIGURE_VALUES = {"sensor_lag": {"lag": 0.01}}  # where a typical value is too small to be visible
WIDTH, HEIGHT, MARGIN = 360.0, 250.0, 44.0  # of the picture


@dataclass(frozen=True, slots=True, eq=False)
class ForceLoop:
    """One cycle: u in mm and inertia force -M a in kN, (point,) each."""

    u_mm: Float1D
    force_kn: Float1D


LoopPair = tuple[ForceLoop, ForceLoop]  # without and with the effect


def find_loops(effect: Effect) -> LoopPair:
    """Return the loops of an effect: those shipped, or computed for a new one."""
    shipped = _read_shipped_loops()
    return shipped[effect.id] if effect.id in shipped else compute_loops(effect)


@cache
def _read_shipped_loops() -> dict[str, LoopPair]:
    loops = json.loads(LOOPS_FILE.read_text(encoding="utf-8"))
    return {
        name: (ForceLoop(*map(np.array, before)), ForceLoop(*map(np.array, after)))
        for name, (before, after) in loops.items()
    }


def compute_loops(effect: Effect) -> LoopPair:
    """Simulate a steady sine without the effect, and with it at its typical values."""
    gap_m = CONTACT_GAP_M if shows_in_contact(effect) else math.inf
    base = Model(Parameters(MASS, STIFFNESS, DAMPING, *BUMPER, *BUMPER, gap_m, gap_m))
    changed = base.with_effect(effect.id, find_channel(effect), **figure_values(effect))
    frequency_hz = drive_frequency_hz(effect)
    return _simulate_loop(base, frequency_hz), _simulate_loop(changed, frequency_hz)


def find_channel(effect: Effect) -> str:
    """Return the channel on which a sensor effect acts in the figure, "" for another effect."""
    return SENSOR_CHANNELS.get(effect.id, ACCELEROMETER) if effect.acts == "sensor" else ""


def figure_values(effect: Effect) -> dict[str, float]:
    """Return the values of an effect in its figure, typical ones wherever they are visible."""
    typical = {parameter.name: parameter.typical for parameter in effect.parameters}
    return FIGURE_VALUES.get(effect.id, typical)


def shows_in_contact(effect: Effect) -> bool:
    """Return whether an effect shows only where the mass meets the bumpers."""
    return effect.is_in_bumpers or effect.id.startswith("gap_")


def drive_frequency_hz(effect: Effect) -> float:
    """Return the frequency of the sine in Hz."""
    return CONTACT_HZ if shows_in_contact(effect) else FLIGHT_HZ


def _simulate_loop(model: Model, frequency_hz: float) -> ForceLoop:
    rate_hz = SAMPLES_PER_CYCLE * frequency_hz
    phase = 2 * math.pi * np.arange(1, SETTLE_CYCLES * SAMPLES_PER_CYCLE + 1) / SAMPLES_PER_CYCLE
    wave = np.sin(phase)
    level = LEVEL_G * GRAVITY_M_S2
    from twin.model.prepare import prepare_solver  # the guide itself needs no compiler

    solver, out = prepare_solver(model, rate_hz), np.empty((7, wave.size))
    state = solver.rest_state()
    solver.advance(state, level * wave, -level / (2 * math.pi * frequency_hz) ** 2 * wave, out)
    u, acceleration = out[0, -SAMPLES_PER_CYCLE:], out[2, -SAMPLES_PER_CYCLE:]
    for sensor in model.sensors:
        if sensor.channel == ACCELEROMETER:
            delayed = np.roll(acceleration, round(sensor.lag * rate_hz))
            acceleration = sensor.gain * delayed + sensor.offset
        else:
            u = u + sensor.offset
    force = -MASS * acceleration
    keep = slice(None, None, SAMPLES_PER_CYCLE // LOOP_POINTS)
    return ForceLoop(1e3 * u[keep], 1e-3 * force[keep])


def draw_loops(pair: LoopPair) -> str:
    """Return an SVG of both loops on common axes; its colors are those of the page."""
    u_limit, force_limit = (
        _round_up(max(float(np.abs(getattr(loop, name)).max()) for loop in pair))
        for name in ("u_mm", "force_kn")
    )
    x_scale = (WIDTH / 2 - MARGIN) / u_limit
    y_scale = (HEIGHT / 2 - MARGIN / 2 - 8) / force_limit
    x_zero, y_zero = WIDTH / 2 + MARGIN / 2, HEIGHT / 2 - 8

    def trace(loop: ForceLoop, name: str) -> str:
        points = " ".join(
            f"{x_zero + x_scale * u:.1f},{y_zero - y_scale * force:.1f}"
            for u, force in zip(loop.u_mm, loop.force_kn, strict=True)
        )
        return f'<polygon class="{name}" points="{points}"/>'

    left, right = x_zero - x_scale * u_limit, x_zero + x_scale * u_limit
    top, bottom = y_zero - y_scale * force_limit, y_zero + y_scale * force_limit
    ticks = "".join(
        f'<text x="{x_zero + x_scale * value:.1f}" y="{bottom + 15:.1f}">{value:g}</text>'
        for value in (-u_limit, 0, u_limit)
    ) + "".join(
        f'<text class="side" x="{left - 6:.1f}" y="{y_zero - y_scale * value + 4:.1f}">'
        f"{value:g}</text>"
        for value in (-force_limit, 0, force_limit)
    )
    return (
        f'<svg class="loop" viewBox="0 0 {WIDTH:g} {HEIGHT:g}" role="img" '
        f'aria-label="Inertia force over relative displacement">'
        f'<path class="axes" d="M{left:.1f} {y_zero:.1f}H{right:.1f}M{x_zero:.1f} {top:.1f}'
        f'V{bottom:.1f}"/>{ticks}'
        f'<text x="{x_zero:.1f}" y="{bottom + 30:.1f}">u in mm</text>'
        f'<text class="side turned" x="0" y="0" transform="translate(14 {y_zero:.1f}) '
        f'rotate(-90)">−M a in kN</text>'
        f"{trace(pair[0], 'before')}{trace(pair[1], 'after')}</svg>"
    )


def _round_up(value: float) -> float:
    """Return the next round number."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(
        step * power for step in (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step * power >= value
    )


def main() -> None:
    """Write loops.json again."""

    def to_json(loop: ForceLoop) -> list[list[Any]]:
        return [np.round(loop.u_mm, 3).tolist(), np.round(loop.force_kn, 4).tolist()]

    loops = {effect.id: [*map(to_json, compute_loops(effect))] for effect in EFFECTS}
    LOOPS_FILE.write_text(json.dumps(loops, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
