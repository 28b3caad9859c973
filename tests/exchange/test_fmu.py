"""The model as a co-simulation unit of FMI 3.0, run by fmpy against the own solver."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Profile
from tests.input_errors import raises_input_error
from tests.reports.recordings import start_record
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.fmu_unit import INPUTS, OUTPUTS
from twin.model.config import ModelConfig
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.recording.mcap_log import write_items

RATE_HZ = 1000.0
SNM = (PROFILES_DIR / "models/snm.toml").read_text()
MODELS = {
    "closed form": SNM,
    "found law": SNM + '\n[[effects]]\nid = "cubic_stiffness"\nparameters = { k3 = 4e7 }\n',
}


@pytest.fixture
def log(tmp_path: Path) -> Path:
    profile = (PROFILES_DIR / "tests/g4_ss3.toml").read_text()
    start = replace(start_record(), profile_toml=profile, model_toml=SNM)
    write_items(tmp_path / "run.mcap", [start], start)
    return tmp_path / "run.mcap"


def sweep() -> Float1D:
    """Acceleration of a table in m/s2, 3 s from 2 to 5 Hz, (sample,)."""
    time_s = np.arange(1, 3001) / RATE_HZ
    return np.asarray(1.2 * np.sin(2 * np.pi * (2.0 * time_s + 0.5 * time_s**2)))


def run_unit(fmu: Path, folder: Path, acceleration: Float1D) -> Float1D:
    """Return the outputs of a unit at the end of each step, (step, output), by fmpy."""
    fmpy: Any = pytest.importorskip("fmpy")
    fmi3: Any = pytest.importorskip("fmpy.fmi3")
    description = fmpy.read_model_description(fmu)
    assert description.fmiVersion == "3.0"
    fmpy.extract(str(fmu), str(folder))
    numbers = {variable.name: variable.valueReference for variable in description.modelVariables}
    unit = fmi3.FMU3Slave(
        guid=description.guid,
        unzipDirectory=str(folder),
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="specimen",
    )
    unit.instantiate()
    unit.enterInitializationMode()
    unit.exitInitializationMode()
    outputs = [numbers[name] for name, _ in OUTPUTS]
    rows = []
    for k, value in enumerate(acceleration.tolist()):
        unit.setFloat64([numbers[INPUTS[0][0]]], [value])
        unit.doStep(currentCommunicationPoint=k / RATE_HZ, communicationStepSize=1 / RATE_HZ)
        rows.append([*unit.getFloat64(outputs)])
    unit.terminate()
    unit.freeInstance()
    return np.array(rows)


@pytest.mark.parametrize("name", MODELS)
def test_unit_is_the_own_solver_over_a_sweep_with_contacts(
    log: Path, tmp_path: Path, name: str
) -> None:
    pytest.importorskip("pythonfmu3")
    (tmp_path / "found.toml").write_text(MODELS[name])
    model = str(tmp_path / "found.toml")
    export_log(ExportOptions(log, ("fmu",), tmp_path / "unit", model=model))
    acceleration = sweep()
    profile = parse_toml((PROFILES_DIR / "tests/g4_ss3.toml").read_text(), Profile, "test")
    config = parse_toml(MODELS[name], ModelConfig, "model")
    solver = prepare_solver(config.build_model(profile.specimen), RATE_HZ)
    own = np.empty((OUTPUT_COUNT, acceleration.size))
    solver.advance(solver.rest_state(), acceleration, np.zeros(acceleration.size), own)
    assert (own[3] > 0).any(), "no contact on the right"
    assert (own[4] < 0).any(), "no contact on the left"
    outputs = run_unit(tmp_path / "unit.fmu", tmp_path / "unpacked", acceleration)
    assert np.abs(outputs[:, 0] - own[0]).max() < 1e-9
    assert np.abs(outputs.T - own[: len(OUTPUTS)]).max() < 1e-6


def test_unit_needs_the_extra_and_is_not_overwritten(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pythonfmu3")
    (tmp_path / "unit.fmu").write_text("mine")
    with raises_input_error(where=tmp_path / "unit.fmu"):
        export_log(ExportOptions(log, ("fmu",), tmp_path / "unit"))
    assert (tmp_path / "unit.fmu").read_text() == "mine"
    monkeypatch.setitem(sys.modules, "pythonfmu3", None)
    with raises_input_error(where="--fmu") as caught:
        export_log(ExportOptions(log, ("fmu",), tmp_path / "other"))
    assert "shaketwin[fmu]" in str(caught.value)
