"""Strangers' files from the command to the log: what is bad in them is named, never fitted."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.records import SampleGap
from tests.input_errors import raises_input_error
from tests.studies.evidence.__main__ import LABS
from tests.studies.evidence.laboratory import Specimen, StepTest, record, write_table
from twin.discovery.task import identify
from twin.exchange.import_table import ImportOptions, import_table, propose_import
from twin.recording.reader import read_recording

STIFFNESS, DAMPING = 36e3, 1.1e3
TIME: Float1D = np.arange(6000) / 200.0


def make_component(seed: int = 1) -> tuple[Float1D, Float1D]:
    """Return (displacement, force) of a linear component in a smooth motion of three lines."""
    ramp = np.clip((TIME - 1) / 2, 0, 1) * np.clip((29 - TIME) / 2, 0, 1)
    ramp = ramp**3 * (10 - 15 * ramp + 6 * ramp**2)
    lines = ((0.01, 0.9, 0.0), (0.006, 2.3, 1.0), (0.003, 4.1, 2.0))
    u = ramp * np.sum([a * np.sin(2 * np.pi * hz * TIME + p) for a, hz, p in lines], axis=0)
    v = np.gradient(u, TIME)
    noise = np.random.default_rng(seed).normal(size=(2, TIME.size))
    return u + 1e-5 * noise[0], STIFFNESS * u + DAMPING * v + noise[1]


def write_component(path: Path, u: Float1D, force: Float1D) -> Path:
    header = "time_s,rel_disp_m,damper_force_n"
    np.savetxt(path, np.array([TIME, u, force]).T, "%.9g", ",", header=header, comments="")
    return path


@pytest.mark.parametrize(
    ("channel", "first", "values"),
    [
        (1, 3000, [-9999.0]), (1, 3000, [1e10]), (1, 2500, [32767.0, 32767.0]),
        (0, 3000, [-9.999]), (1, 3010, [0.0]),
    ],
)  # fmt: skip
def test_identify_from_a_table_with_wild_samples_is_as_if_they_were_absent(
    tmp_path: Path, channel: int, first: int, values: list[float]
) -> None:
    columns = make_component()
    if values == [0.0]:
        first = int(np.argmax(columns[1]))
    columns[channel][first : first + len(values)] = values
    name = ("rel_disp_m", "damper_force_n")[channel]
    table, log = write_component(tmp_path / "o.csv", *columns), tmp_path / "o.mcap"
    (finding,) = propose_import(table, ImportOptions()).findings
    assert f"{name}: {len(values)} samples are wild" in finding
    import_table(table, log, ImportOptions(accept=True))
    gaps = read_recording(log).records(SampleGap)
    assert [*gaps] == [SampleGap(first, len(values), name, "wild")]
    base = identify([log]).report.parameters
    assert base["stiffness"].value == pytest.approx(STIFFNESS, rel=2e-3)
    assert base["damping"].value == pytest.approx(DAMPING, rel=5e-3)


def test_import_of_a_reversed_force_asks_for_its_sign(tmp_path: Path) -> None:
    u, force = make_component()
    table, log = write_component(tmp_path / "rev.csv", u, -force), tmp_path / "rev.mcap"
    (question,) = propose_import(table, ImportOptions()).questions
    assert "reversed" in question
    with raises_input_error(where=table, problem="reversed", remedy="gain = -1.0"):
        import_table(table, log, ImportOptions(accept=True))

    def import_with(**source: Any) -> None:
        text = ", ".join(f"{key} = {value}" for key, value in source.items())
        column_map = tmp_path / "map.toml"
        column_map.write_text(
            f'[columns]\ndamper_force_n = {{ column = "damper_force_n", {text} }}\n'
        )
        log.unlink(missing_ok=True)
        import_table(table, log, ImportOptions(columns=column_map))

    import_with(gain=-1.0)
    assert identify([log]).report.parameters["stiffness"].value == pytest.approx(
        STIFFNESS, rel=2e-3
    )
    import_with(trusted="true")  # it is imported, but fitted by nobody
    with raises_input_error(where=log, problem="reversed"):
        identify([log])


@pytest.mark.parametrize("rate_hz", [0.1, 1.0, 1.3, 20_000.0, 1e6])
def test_import_at_a_rate_within_the_limits_is_a_log_or_names_the_rate(
    tmp_path: Path, rate_hz: float
) -> None:
    u, force = make_component()
    u[:300] = force[:300] = 0.0
    table, log = tmp_path / "a.csv", tmp_path / "a.mcap"
    columns = np.array([np.arange(u.size) / rate_hz, u, force]).T
    header = "time (s),disp (m),force (N)"
    np.savetxt(table, columns, "%.12g", ",", header=header, comments="")
    if rate_hz < 1.28:
        with raises_input_error(where=table, problem="samples per second", allowed="1.28 Hz"):
            import_table(table, log, ImportOptions(accept=True))
        return
    import_table(table, log, ImportOptions(accept=True))
    assert read_recording(log).start.rate_hz == pytest.approx(rate_hz, rel=1e-6)


@pytest.mark.parametrize("lab", ["plain", "filter", "pink"])
def test_a_clean_table_test_at_200_hz_raises_no_alarm_of_sensors(tmp_path: Path, lab: str) -> None:
    """No limit of an instrument lies beyond what the rate of the recording shows."""
    test = StepTest(2.0, 4.4, 0.8, cycles=6, rate_hz=200.0)
    columns = record(Specimen(gap_mm=40.0), LABS[lab], 30, test)
    table, log = write_table(columns, tmp_path / "a.csv"), tmp_path / "a.mcap"
    import_table(table, log, ImportOptions(accept=True, settings={"mass_kg": 550.0}))
    sensors = identify([log]).report.sensors
    assert [check.kind for check in sensors.checks if not check.healthy] == []
