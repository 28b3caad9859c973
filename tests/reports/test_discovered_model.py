"""The model file that a discovery writes, and what it says of sensors that the file cannot hold."""

from dataclasses import replace

import pytest

from tests.discovery.played import prepare_bare_log
from twin.discovery.least_squares import FitResult
from twin.discovery.model_file import format_fitted_model
from twin.discovery.parameters import INPUT_GAIN, INPUT_OFFSET


@pytest.fixture(scope="module")
def fit() -> FitResult:
    return prepare_bare_log().first_fit


@pytest.mark.parametrize(
    ("gain", "std_error", "named", "faulty"),
    [
        (1.0001, 5e-5, [], []),
        (1.012, 5e-5, [], []),  # as in any laboratory
        (1.05, 5e-5, [], ["sensor_gain"]),
        (1.021, 0.01, [], []),  # not known that well
        (1.012, 5e-5, ["sensor_gain.table_acc_m_s2"], ["sensor_gain"]),
        (1.0, 5e-5, ["sensor_offset.table_acc_m_s2"], ["sensor_offset"]),
    ],
)
def test_a_sound_sensor_of_the_table_is_not_to_be_repaired(
    gain: float, std_error: float, named: list[str], faulty: list[str], fit: FitResult
) -> None:
    """Without an accelerometer on the specimen that of the table is fitted in every recording.

    What a discovery names it says, however small.
    """
    parameters = fit.parameters.with_values({INPUT_GAIN: gain, INPUT_OFFSET: 1e-3})
    std_errors = {**fit.std_errors, INPUT_GAIN: std_error, INPUT_OFFSET: 1e-4}
    fitted = replace(fit, parameters=parameters, std_errors=std_errors)
    text, notes = format_fitted_model(fitted, "specimen", "", "a log", named=named)
    assert "sensor" not in text
    assert [note.partition(".")[0] for note in notes] == faulty
