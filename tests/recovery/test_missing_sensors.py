"""A laboratory with other channels than ours: what is there still gives the truth."""

from pathlib import Path

import numpy as np
import pytest

from tests.studies.evidence.imported import format_profile, import_columns
from tests.studies.evidence.laboratory import Instruments, Specimen, StepTest, record
from twin.discovery.discover import prepare_problem
from twin.discovery.loading import load_logs
from twin.discovery.noise import number_bands
from twin.discovery.nuisances import list_sizes, widen_intervals
from twin.discovery.parameters import STIFFNESS, BaseKey, GapKey
from twin.model.model import Model
from twin.model.parameters import Parameters

START = Model(Parameters(550.0, 36e3, 1100.0, 500e3, 900.0, 500e3, 900.0, 4e-3, 4e-3))
SHORT, PRESSED = StepTest(1.6, 3.2, 0.8, 6), StepTest(2.0, 8.0, 2.0, 10)
# Always in contact the damping of the bumpers and the lags of the readings look alike; in free
# flight the mass still moves where the drive, and the record, has ended. The error of a laser that
# is not linear shows where the motion is largest: without those steps, only noise would hold it.
CASES = {
    "no mass accelerometer": (Instruments(missing=("mass_acc_m_s2",)), 10.0, SHORT),
    "no mass accelerometer, free": (Instruments(missing=("mass_acc_m_s2",)), 40.0, StepTest()),
    "no table accelerometer": (Instruments(missing=("table_acc_m_s2",)), -1.0, PRESSED),
    "laser on the table": (Instruments(has_relative_laser=True), 4.0, SHORT),
}


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(case, marks=[pytest.mark.slow] if case.endswith("free") else [])
        for case in CASES
    ],
)
def test_the_parameters_are_those_of_the_specimen(case: str, tmp_path: Path) -> None:
    instruments, gap_mm, test = CASES[case]
    specimen = Specimen(gap_mm=gap_mm)
    columns = record(specimen, instruments, 7, test)
    log = import_columns(columns, tmp_path, format_profile(specimen, test))
    logs, _ = load_logs([log])
    prepared = prepare_problem(logs, START)
    problem = prepared.problem
    fit = widen_intervals(prepared.first_fit, problem.log_residuals)
    assert fit.cost < 1.2 * problem.expected_square
    assert problem.fit_effects(prepared.parameters, ()).cost < 1.2 * problem.expected_square
    truth = {
        "stiffness": specimen.k, "damping": specimen.c, "bumper_stiffness_r": specimen.kb,
        "bumper_damping_r": specimen.cb,
    }  # fmt: skip
    for free in fit.free:
        names = [getattr(key, "name", "") for key in free.keys]
        true = next((truth[name] for name in names if name in truth), None)
        if true is not None:
            assert abs(fit.values[free.key] - true) < 3.0 * fit.std_errors[free.key], free.name
            assert fit.std_errors[free.key] < 0.1 * true, free.name
    for nuisance, size in list_sizes(problem.log_residuals[0], fit.parameters):
        if nuisance.kind == "lag":
            assert abs(size * nuisance.size) < 4e-4, nuisance


def test_bumpers_that_the_mass_does_not_reach_are_no_parameters(tmp_path: Path) -> None:
    """Without load cells the contacts are those of the model: a gap far off must not make any."""
    specimen = Specimen(gap_mm=40.0)
    cells = ("force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n")
    columns = record(specimen, Instruments(missing=cells), 38, SHORT)
    logs, _ = load_logs([import_columns(columns, tmp_path, format_profile(specimen, SHORT))])
    fit = prepare_problem(logs, START).first_fit
    names = {free.name for free in fit.free if isinstance(free.key, BaseKey | GapKey)}
    assert names == {"stiffness", "damping"}
    assert fit.values[STIFFNESS] == pytest.approx(specimen.k, rel=0.02)


def test_hum_that_beats_leaves_no_noise_at_its_frequency(tmp_path: Path) -> None:
    """What the filter of a line leaves was several times the noise; an appendage was named."""
    specimen, test = Specimen(gap_mm=-1.0), StepTest(2.0, 9.0, 1.0, 10)
    columns = record(specimen, Instruments(filter_share=0.25, hum=3.0, beat_hz=0.3), 7, test)
    logs, _ = load_logs([import_columns(columns, tmp_path, format_profile(specimen, test))])
    (residuals,) = prepare_problem(logs, START).problem.log_residuals
    at_hum, elsewhere = number_bands(np.array([50.0, 20.0]))
    for side in ("right cells", "left cells"):
        scale = residuals.noise_scale[side]
        assert scale[at_hum] < 1.2 * scale[elsewhere]
        assert scale[elsewhere] < 1.3
