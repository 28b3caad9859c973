"""Short recordings of a simulated rig whose truth is known, with any noise."""

from functools import cache
from typing import Any

import numpy as np

from table_io.block import Block, Float2D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.clock import ManualClock
from table_io.config.profile import Profile
from table_io.excitation.trajectory import plan_sweep
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import RIG
from twin.discovery.discover import PreparedLog
from twin.discovery.signals import build_signals
from twin.model.model import Model
from twin.model.parameters import Parameters

TRUTH = {"stiffness": 31e3, "damping": 1500.0, "bumper_stiffness": 420e3, "bumper_damping": 1300.0}
CHANNELS = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2", *RIGHT_CELLS, *LEFT_CELLS,
)  # fmt: skip
FAR = Model(Parameters(1.0, 60e3, 600.0, 900e3, 300.0, 900e3, 300.0, np.inf, np.inf))


def card(right_mm: float, left_mm: float) -> dict[str, Any]:
    """Up and back through four frequencies, 25 s, with these gaps."""
    return {
        "title": "short", "loop_check": {"enabled": False}, "control": {"enabled": False},
        "specimen": {
            "mass_kg": 550.0, "gap_mm": right_mm + left_mm, "gap_right_mm": right_mm,
            "gap_left_mm": left_mm,
        },
        "sweep": {
            "start_hz": 1.6, "stop_hz": 3.4, "step_hz": 0.6, "cycles": 4, "acceleration_g": 0.05,
        },
        "acquisition": {"rate_hz": 1000.0, "block_samples": 50, "rest_s": 1.0},
    }  # fmt: skip


@cache
def profile(right_mm: float, left_mm: float) -> Profile:
    """That test, validated."""
    return Profile.model_validate(card(right_mm, left_mm))


@cache
def clean(right_mm: float, left_mm: float) -> Float2D:
    """(channel, sample) what truly happened, in SI."""
    simulated = RIG.get_section(SimulatedTableConfig)
    assert simulated is not None
    table = simulated.model_copy(
        update={
            "damper_stiffness_n_m": TRUTH["stiffness"],
            "damper_damping_n_s_m": TRUTH["damping"],
            "bumper_stiffness_n_m": TRUTH["bumper_stiffness"],
            "bumper_damping_n_s_m": TRUTH["bumper_damping"],
        }
    )
    test = profile(right_mm, left_mm)
    drive = plan_sweep(test)
    count = drive.planned_end + 6000  # until the mass is at rest again
    rig = RIG.model_copy(update={"simulated": table})
    backend = SimulatedBackend(rig, test.specimen, 1000.0, ManualClock())
    observations: list[Float2D] = []
    backend.observer = lambda first, command, signals: observations.append(signals.copy())
    backend.open()
    backend.queue(0, drive.command(0, count) * RIG.output.volts_per_m)
    backend.start()
    backend.take(count)
    y, y_acc, x, x_acc, right, left = observations[0]
    return np.array([y, y_acc, x, x_acc, right / 2, right / 2, -left / 2, -left / 2])


def make_noisy_blocks(
    noise: float, seed: int = 0, gaps_mm: tuple[float, float] = (2.0, 2.0),
    channels: tuple[str, ...] = CHANNELS,
) -> tuple[Block, ...]:  # fmt: skip
    """The measured blocks, each channel with noise of so much of its rms."""
    true, drive = clean(*gaps_mm), plan_sweep(profile(*gaps_mm))
    draw = np.random.default_rng(seed).standard_normal(true.shape)
    rms = np.maximum(true.std(axis=1), [0, 0, 0, 0, 9, 9, 9, 9])  # idle load cells are noisy too
    values = true + noise * rms[:, None] * draw
    known = dict(zip(CHANNELS, values, strict=True))
    known["rel_disp_m"] = known["mass_disp_m"] - known["table_disp_m"]
    bumpers = known["force_r1_n"] + known["force_r2_n"] - known["force_l1_n"] - known["force_l2_n"]
    known["damper_force_n"] = -550.0 * known["mass_acc_m_s2"] - bumpers
    chosen = np.array([known[name] for name in channels])
    return (Block("meas", 0, 1000.0, channels, chosen, *drive.labels(0, true.shape[1])),)


def prepare_log(
    blocks: tuple[Block, ...], gaps_mm: tuple[float, float] = (2.0, 2.0), name: str = "short"
) -> PreparedLog:
    """The recording as a log that states these gaps."""
    gaps = (1e-3 * gaps_mm[0], 1e-3 * gaps_mm[1])
    return PreparedLog(
        build_signals(blocks, name, 550.0, gaps), 10.0, plan_sweep(profile(2.0, 2.0)).steps
    )


def oscillator(stiffness: float, damping: float) -> Model:
    """Per unit mass, without bumpers, to start from."""
    return Model(Parameters(1.0, stiffness, damping, 1.0, 1.0, 1.0, 1.0, np.inf, np.inf))


def log_columns(name: str, rate_hz: float, columns: dict[str, np.ndarray]) -> PreparedLog:
    """Columns as a log that moves all the time."""
    values = np.array(list(columns.values()))
    label = np.full(values.shape[1], int(Label.SETTLE), dtype=np.int64)
    outside = np.full(values.shape[1], -1, dtype=np.int64)
    block = Block("meas", 0, rate_hz, tuple(columns), values, outside, label, outside.copy())
    return PreparedLog(build_signals((block,), name, 1.0, (np.inf, np.inf)), 1.0)
