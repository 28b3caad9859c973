"""A test as whoever watches it gets it: every kind of item that the monitor shows."""

from pathlib import Path

import numpy as np

from table_io.block import Block, Label
from table_io.config.base import PROFILES_DIR
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    Extremes,
    JumpForecast,
    Level,
    NormalizedResponse,
    PrcPoint,
    RunStart,
    SampleGap,
    Step,
    Timing,
)
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import RIG_TEXT
from twin.compare import COMPARED_CHANNELS
from twin.monitor.run_state import LiveRunState, update_run_state
from twin.transport.codec import Item

RUN, RATE, LEVEL = "20260101-120000-watched", 1000.0, 0.05 * GRAVITY_M_S2
GRID = (2.0, 2.5, 3.0, 3.5, 4.0)
STEPS = tuple(
    Step(k, direction, f, LEVEL)
    for k, (direction, f) in enumerate(
        [("forward", f) for f in GRID] + [("backward", f) for f in reversed(GRID)]
    )
)
SENSORS = (
    "drive_disp_m", "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
PROFILE = Path(PROFILES_DIR / "tests" / "quickstart.toml").read_text()


def receive(*items: Item, state: LiveRunState | None = None, run: str = RUN) -> LiveRunState:
    """Return the state of the run after the items, from an earlier state if given."""
    state = state or LiveRunState()
    for item in items:
        state = update_run_state(state, run, item)
    return state


def start(run: str = RUN) -> RunStart:
    return RunStart(
        0, run, "watched", "table", PROFILE, RIG_TEXT, "", RATE, 20, SENSORS, STEPS, 60_000,
        {"mass_disp_m": 0.02}, {}, "lab", "2026-01-01T12:00:00", 0.0,
    )  # fmt: skip


def block(index: int, count: int = 20, step: int = 3, label: Label = Label.MEASURE) -> Block:
    """The table's acceleration as demanded at the step, other channels small constants."""
    w = 2 * np.pi * STEPS[step].frequency_hz
    at = (index + np.arange(count)) / RATE
    values = np.full((len(SENSORS), count), 1e-3)
    values[1], values[2] = -LEVEL / w**2 * np.sin(w * at), LEVEL * np.sin(w * at)
    values[5] = 4000.0
    cycle = -1 if label in (Label.REST, Label.BLEND) else 1
    whole = [np.full(count, label_value) for label_value in (step, int(label), cycle)]
    return Block("meas", index, RATE, SENSORS, values, *whole)


def quantities(eta: float) -> NormalizedResponse:
    return NormalizedResponse(eta, 2 * eta, 0.1, 0.1, 0.0, 0.0, (1, 1), (1, 2), 0.0, 0.0)


def point(step: int) -> PrcPoint:
    planned = STEPS[step]
    eta = 0.1 + 0.02 * step
    return PrcPoint(
        2000 * (step + 1), step, planned.direction, planned.frequency_hz, quantities(eta),
        quantities(1.2 * eta), LEVEL, LEVEL, 0.01,
    )  # fmt: skip


def make_comparison(index: int, count: int = 20) -> Comparison:
    """rms 1e-3, error of the restarted twin 1e-4, of the free one 2e-4, in every channel."""
    n = len(COMPARED_CHANNELS)
    return Comparison(index, count, COMPARED_CHANNELS, (1e-6 * count,) * n, (4e-8 * count,) * n,
                      (1e-8 * count,) * n)  # fmt: skip


def records() -> list[Item]:
    """What there is to know at 8 s, in step 3; the error of u is beyond its band."""
    extremes = Extremes(2e-3, -3e-3, 4.0, -4.0, 900.0, 800.0, (7100,), (7200, 7300))
    bands = tuple(5e-5 if name == "rel_disp_m" else 2e-4 for name in COMPARED_CHANNELS)
    nan = float("nan")
    phases = ((part,) * len(COMPARED_CHANNELS) for part in (8e-5, 1.5e-4, 1.6e-4))
    errors = (1e-4,) * len(COMPARED_CHANNELS)
    names = ("stiffness", "damping", "bumper_stiffness_r", "gap_r", "gap_l")
    return [
        start(),
        Event(0, "state", "checking"),
        Event(900, "state", "running"),
        *(point(step) for step in range(3)),
        Level(6500, 3, LEVEL, 0.99 * LEVEL, 1.034, 2, True, (0.01, 0.02, 0.0, 0.0)),
        CycleExtremes(7500, 3, 1, int(Label.MEASURE), 286, extremes, extremes),
        Agreement(7500, 3, 1, 286, COMPARED_CHANNELS, errors, bands, *phases),
        JumpForecast(7600, 3, "forward", 3.5, "down", 3.982, 3.91, 4.05),
        Estimate(
            7600, 3, names, (36.1e3, 1.1e3, 510e3, 2.01e-3, 1.99e-3),
            (50.0, 15.0, 930.0, 2e-6, 3e-6),
            (-1.8e3, 0.0, 0.0, 0.0, 1e-6), (60.0, nan, nan, 3e-6, 3e-6),
        ),
        *(Timing(7000, who, 0.41, 1.96, 5.2, 0, 350, 0.1, "fifo") for who in ("rig", "twin")),
        Event(7650, "divergence", "the twin has left the measurement by more than its band"),
        SampleGap(7700, 3, "force_l2_n", "lost"),
    ]  # fmt: skip


def stream(first: int = 6000, end: int = 8000) -> list[Item]:
    """Measured blocks and comparisons of samples first .. end - 1."""
    return [make(at) for at in range(first, end, 20) for make in (block, make_comparison)]
