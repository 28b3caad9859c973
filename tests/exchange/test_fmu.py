"""The model as a co-simulation unit of FMI 3.0, run by fmpy against the own solver."""

import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D, Float2D
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Profile
from tests.input_errors import raises_input_error
from tests.reports.recordings import start_record
from twin.exchange import fmu
from twin.exchange.export import ExportOptions, export_log
from twin.exchange.fmu import VARIABLES
from twin.model.config import ModelConfig
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT
from twin.recording.mcap_log import write_items

RATE_HZ = 1000.0
SNM = (PROFILES_DIR / "models/snm.toml").read_text()
LAW = """
[[effects]]
file = "found.effect.toml"
parameters = { k = 3e4 }
[files]
"found.effect.toml" = '''
id = "found"
force = "k * v * abs(u) * abs(u)"
[parameters.k]
unit = "N s/m3"
low = 0.0
high = 1e9
vanishing = 0.0
typical = 3e4
'''
"""
MODELS = {
    "closed form": SNM,
    "tilt": SNM + '\n[[effects]]\nid = "table_tilt"\nparameters = { tilt = -0.05 }\n',
    "stiffness": SNM + '\n[[effects]]\nid = "cubic_stiffness"\nparameters = { k3 = 4e7 }\n',
    "found law": SNM + LAW,
}
INPUTS, OUTPUTS = (
    [name for name, (causality, _) in VARIABLES.items() if causality == kind]
    for kind in ("input", "output")
)
TABLE_M = 0.02  # motion of the table, which matters to tilt


@pytest.fixture
def log(tmp_path: Path) -> Path:
    profile = (PROFILES_DIR / "tests/g4_ss3.toml").read_text()
    start = replace(start_record(), profile_toml=profile, model_toml=SNM, rate_hz=RATE_HZ)
    write_items(tmp_path / "run.mcap", [start], start)
    return tmp_path / "run.mcap"


def sweep() -> Float1D:
    """Acceleration of a table in m/s2, 3 s from 2 to 5 Hz, (sample,)."""
    time_s = np.arange(1, 3001) / RATE_HZ
    return np.asarray(1.2 * np.sin(2 * np.pi * (2.0 * time_s + 0.5 * time_s**2)))


def run_unit(fmu: Path, folder: Path, inputs: Float2D, span: int = 1) -> Float2D:
    """Return the outputs of a unit at the end of each step of `span` samples, (output, step)."""
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
    references = [[numbers[name] for name in names] for names in (INPUTS, OUTPUTS)]
    rows = []
    step_s = span / RATE_HZ
    for k, values in enumerate(inputs.T[span - 1 :: span].tolist()):
        unit.setFloat64(references[0], values)
        unit.doStep(currentCommunicationPoint=k * step_s, communicationStepSize=step_s)
        rows.append([*unit.getFloat64(references[1])])
    with pytest.raises(Exception, match="failed"):
        unit.doStep(currentCommunicationPoint=99.0, communicationStepSize=1.5 / RATE_HZ)
    unit.terminate()
    unit.freeInstance()
    return np.array(rows).T


@pytest.fixture(autouse=True)
def _require_compiler() -> None:
    if shutil.which("cc") is None:
        pytest.importorskip("ziglang")


@pytest.mark.parametrize("name", MODELS)
def test_unit_is_the_own_solver_over_a_sweep_with_contacts(
    log: Path, tmp_path: Path, name: str
) -> None:
    (tmp_path / "model.toml").write_text(MODELS[name])
    model = str(tmp_path / "model.toml")
    export_log(ExportOptions(log, ("fmu",), tmp_path / "unit", model=model))
    inputs = np.array([sweep(), TABLE_M * sweep()])
    profile = parse_toml((PROFILES_DIR / "tests/g4_ss3.toml").read_text(), Profile, "test")
    config = parse_toml(MODELS[name], ModelConfig, "model")
    solver = prepare_solver(config.build_model(profile.specimen), RATE_HZ)
    own = np.empty((OUTPUT_COUNT, inputs.shape[1]))
    solver.advance(solver.rest_state(), inputs[0], inputs[1], own)
    assert (own[3] > 0).any(), "no contact on the right"
    assert (own[4] < 0).any(), "no contact on the left"
    outputs = run_unit(tmp_path / "unit.fmu", tmp_path / "unpacked", inputs)
    assert np.abs(outputs[0] - own[0]).max() < 1e-9
    assert np.abs(outputs - own[: len(OUTPUTS)]).max() < 1e-6


def test_longer_steps_are_linear_between_their_ends(log: Path, tmp_path: Path) -> None:
    export_log(ExportOptions(log, ("fmu",), tmp_path / "unit"))
    ramps = np.interp(np.arange(1, 3001), np.arange(0, 3001, 4), [0.0, *sweep()[3::4]])
    inputs = np.array([ramps, np.zeros(ramps.size)])
    fine = run_unit(tmp_path / "unit.fmu", tmp_path / "fine", inputs)
    coarse = run_unit(tmp_path / "unit.fmu", tmp_path / "coarse", inputs, span=4)
    assert np.abs(coarse - fine[:, 3::4]).max() < 1e-6


def test_unit_needs_no_python(log: Path, tmp_path: Path) -> None:
    export_log(ExportOptions(log, ("fmu",), tmp_path / "unit"))
    with zipfile.ZipFile(tmp_path / "unit.fmu") as unit:
        (library,) = (name for name in unit.namelist() if name.startswith("binaries/"))
        assert not any(name.endswith(".py") for name in unit.namelist())
        for symbol in (b"Py", b"numba_"):
            assert symbol not in unit.read(library)
        assert unit.read("resources/model.toml").decode() == SNM


def test_unit_needs_a_compiler_and_is_not_overwritten(
    log: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "unit.fmu").write_text("mine")
    with raises_input_error(where=tmp_path / "unit.fmu"):
        export_log(ExportOptions(log, ("fmu",), tmp_path / "unit"))
    assert (tmp_path / "unit.fmu").read_text() == "mine"
    monkeypatch.setattr(fmu, "find_spec", lambda _: None)
    monkeypatch.setenv("PATH", "")
    with raises_input_error(where="--fmu") as caught:
        export_log(ExportOptions(log, ("fmu",), tmp_path / "other"))
    assert "shaketwin[fmu]" in str(caught.value)
