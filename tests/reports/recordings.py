"""Recordings and summaries to report on: sines through eight steps, twin ten per cent larger."""

import math
from typing import Any

import numpy as np

from table_io.block import Block, Label
from table_io.records import Comparison, RunStart, RunStop, Step
from twin.compare import COMPARED_CHANNELS, TWIN_CHANNELS
from twin.transport.codec import Item

RATE, CYCLES, GRID = 500.0, 3, (1.0, 1.5, 2.0, 2.5)
MEASURED = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
PROFILE = """
title = "Quick <i>look</i>"
notes = "<script>alert('no')</script> & more"
[specimen]
mass_kg = 550.0
gap_mm = {gap}
"""
STEPS = tuple(
    Step(k, direction, hz, 0.49)
    for k, (direction, hz) in enumerate(
        [("forward", hz) for hz in GRID] + [("backward", hz) for hz in reversed(GRID)]
    )
)


def start_record(gap: str = "4.0") -> RunStart:
    return RunStart(
        index=0, run="20250101-000000-quick", name="quick", source="table",
        profile_toml=PROFILE.format(gap=gap), rig_toml='title = "Rig & table"',
        model_toml='title = "Model <1>"\n[base]\nstiffness_n_m = 36000.0', rate_hz=RATE,
        block_samples=50, channels=MEASURED, steps=STEPS, planned_samples=0,
        tare={"mass_disp_m": 1.25e-4}, versions={"shaketwin": "0.1.0"}, host="lab-host",
        started_at="2025-01-01T00:00:00", epoch_s=0.0,
    )  # fmt: skip


def amplitude(step: Step) -> float:
    """u in m: 2.5 Hz answers large forward, small backward."""
    return 4e-3 if step.direction == "forward" else 1e-3


def signals(step: Step, scale: float) -> dict[str, Any]:
    """A sine with contact above 2 mm, by channel."""
    n = round(CYCLES * RATE / step.frequency_hz)
    w = 2 * math.pi * step.frequency_hz
    u = scale * amplitude(step) * np.sin(w * np.arange(n) / RATE)
    right = 250e3 * np.maximum(u - 2e-3, 0)
    left = 250e3 * np.maximum(-u - 2e-3, 0)
    table = 1e-2 * np.cos(w * np.arange(n) / RATE)
    return {
        "table_disp_m": table, "table_acc_m_s2": -(w**2) * table, "mass_disp_m": u + table,
        "mass_acc_m_s2": -(w**2) * u, "rel_disp_m": u, "rel_vel_m_s": np.gradient(u, 1 / RATE),
        "force_r1_n": right, "force_r2_n": right, "force_l1_n": left, "force_l2_n": left,
    }  # fmt: skip


def blocks(channels: tuple[str, ...] = MEASURED) -> list[Item]:
    """Measured and predicted blocks of all steps, one a step, and their comparisons."""
    items: list[Item] = []
    index = 0
    for step in STEPS:
        rig, twin = signals(step, 1.0), signals(step, 1.1)
        n = rig["rel_disp_m"].size
        labels = np.full(n, step.index), np.full(n, int(Label.MEASURE)), np.arange(n) * CYCLES // n
        values = np.array([rig[name] for name in channels]).reshape(len(channels), n)
        items.append(Block("meas", index, RATE, channels, values, *labels))
        values = np.array([twin[name.split("/")[1]] for name in TWIN_CHANNELS])
        items.append(Block("pred", index, RATE, TWIN_CHANNELS, values, *labels))
        ss = tuple(float((rig[name] ** 2).sum()) for name in COMPARED_CHANNELS)
        free, window = (tuple(part**2 * error for error in ss) for part in (0.1, 0.05))
        items.append(Comparison(index, n, COMPARED_CHANNELS, ss, free, window))
        index += n
    return [*items, RunStop(index, "complete", "all steps driven")]


def summary(who: tuple[str, ...] = ("measured", "twin")) -> dict[str, Any]:
    def quantities(step: Step, scale: float) -> dict[str, Any]:
        eta = scale * (0.1234 + 0.01 * step.index)
        return {
            "eta_d": eta, "eta_a": 0.5678, "eta_r": 0.0345, "eta_l": 0.0346, "r_r": 0.211,
            "r_l": 0.212, "impacts_right": [2, 3, 2], "impacts_left": [1, 1, 1],
            "drift": 0.0123, "spread": 0.01,
        }  # fmt: skip

    steps = [
        {
            "index": step.index, "direction": step.direction, "frequency_hz": step.frequency_hz,
            "measured": quantities(step, 1.0) if "measured" in who else None,
            "twin": quantities(step, 1.1) if "twin" in who else None,
            "table_acc_peak_m_s2": 0.4876, "thd": 0.0215,
        }
        for step in STEPS
    ]  # fmt: skip
    return {
        "run": {"name": "quick", "title": "Quick <i>look</i>", "source": "table",
                "normalisation": "model, continuous"},
        "verdict": "complete", "reason": "all steps driven", "gaps": 0,
        "u_star_m": 0.030537, "a_star_m_s2": 2.057, "steps": steps,
        "jumps": [{"direction": "forward", "from_hz": 2.0, "to_hz": 2.5, "kind": "down"}],
        "hysteresis": [{"kind": "right", "from_hz": 1.5, "to_hz": 2.0}],
        "timing": {"latency_ms": {"p50": 1.11, "p99": 2.22, "max": 3.33}, "missed_deadlines": 0},
        "comparison": {"rel_disp_m": {"nrmse": 0.0512, "free_nrmse": 0.1021}},
    }  # fmt: skip


def one_step(channels: tuple[str, ...] = MEASURED) -> tuple[list[Item], dict[str, Any]]:
    """(items, summary) of a run that was stopped after its first step."""
    values = {**summary(), "verdict": "stopped", "hysteresis": [], "jumps": [], "timing": {}}
    return blocks(channels)[:3], {**values, "steps": values["steps"][:1]}
