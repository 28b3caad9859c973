"""Short recordings of the simulated table, with something hidden in it, made ready for learning."""

import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from table_io.block import Block
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.profile import Profile
from table_io.sim.config import SimulatedTableConfig
from tests.builders.rigs import RIG
from tests.builders.sessions import play_session
from tests.builders.truths import seal_truth
from twin.discovery.discover import PreparedLog, PreparedProblem, prepare_problem
from twin.discovery.parameters import NuisanceKey
from twin.discovery.residuals import build_log_residuals
from twin.discovery.signals import LogSignals, build_signals
from twin.model.model import Model
from twin.model.parameters import Parameters

TRUE = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
SNM = Model(TRUE)
CELL_SHARE = 0.52  # of the right force in its first cell, and of the left one in its second
ACC_GAIN = 1.008


def profile(gap_mm: float = 4.0, start_hz: float = 1.4, stop_hz: float = 4.4) -> Profile:
    """Up and back in a few steps, through flight, impacts and jumps."""
    sweep = {"start_hz": start_hz, "stop_hz": stop_hz, "step_hz": 0.6, "cycles": 5}
    return Profile.model_validate(
        {
            "title": "short",
            "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
            "sweep": sweep,
            "acquisition": {"rate_hz": 1000.0},
            "loop_check": {"enabled": False},
            "control": {"enabled": False},
        }
    )


@cache
def blocks(truth: str = "", noise: float = 1.0, gap_mm: float = 4.0) -> tuple[Block, ...]:
    """Measured blocks of a rig that hides a truth, with so many times the card's noise."""
    sensors = [
        sensor.model_copy(update={"noise_rms": sensor.noise_rms * noise}) for sensor in RIG.sensors
    ]
    simulated = RIG.get_section(SimulatedTableConfig)
    assert simulated is not None
    with tempfile.TemporaryDirectory() as folder:
        if truth:
            simulated = simulated.model_copy(update=seal_truth(Path(folder), truth))
        rig = RIG.model_copy(update={"sensors": tuple(sensors), "simulated": simulated})
        return tuple(play_session(profile(gap_mm), rig=rig, joins_blocks=True).select(Block))


def log(truth: str = "", noise: float = 1.0, gap_mm: float = 4.0) -> PreparedLog:
    """The same, made ready."""
    test = profile(gap_mm)
    readings = build_signals(blocks(truth, noise, gap_mm), "short", 550.0, test.specimen.gaps_m)
    return PreparedLog(readings, test.comparison.contact_n, test.sweep.steps)


@cache
def prepare_bare_log() -> PreparedProblem:
    """The problem of the recording that hides nothing; not to be changed."""
    return prepare_problem([log()], SNM)


def distort(signals: LogSignals) -> LogSignals:
    """Return the signals of a laboratory with shared loads and a gain of an accelerometer."""
    spectra = dict(signals.spectra)
    for cells, share in ((RIGHT_CELLS, CELL_SHARE), (LEFT_CELLS, 1.0 - CELL_SHARE)):
        force = spectra[cells[0]] + spectra[cells[1]]
        moved = (share - 0.5) * force
        spectra |= {cells[0]: spectra[cells[0]] + moved, cells[1]: spectra[cells[1]] - moved}
    spectra["mass_acc_m_s2"] = ACC_GAIN * spectra["mass_acc_m_s2"]
    return replace(signals, spectra=spectra)


@cache
def imperfect_log(truth: str = "") -> PreparedLog:
    """The same, of such a laboratory."""
    prepared = log(truth)
    return replace(prepared, signals=distort(prepared.signals))


def idealize(prepared: PreparedProblem) -> PreparedProblem:
    """The problem with instruments that have the noise of their rest alone."""
    fit = prepared.first_fit
    residuals = build_log_residuals(
        [
            (each.signals if each.nuisances is None else each.nuisances.raw, each.contact_n)
            for each in prepared.problem.log_residuals
        ],
        prepared.problem.log_residuals[0].reference,
    )
    free = tuple(own for own in fit.free if not isinstance(own.key, NuisanceKey))
    fit = replace(fit, parameters=fit.parameters.with_free(free))
    problem = replace(prepared.problem, log_residuals=residuals)
    return replace(prepared, problem=problem, first_fit=fit)


def format_truth(effect: str, channel: str = "", form: str = "", **parameters: float) -> str:
    """A sealed truth with one effect."""
    lines = ["[[effects]]", f'id = "{effect}"']
    lines += [f'channel = "{channel}"'] if channel else []
    lines += [f'form = "{form}"'] if form else []
    numbers = ", ".join(f"{name} = {value!r}" for name, value in parameters.items())
    return "\n".join([*lines, f"parameters = {{ {numbers} }}", ""])
