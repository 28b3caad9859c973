"""HDF5 and UFF 58 as their own libraries read them, and the description of an RO-Crate."""

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from tests.exchange.exported import LOST, export_formats, join_measured_blocks
from tests.input_errors import raises_input_error
from tests.reports.recordings import RATE, STEPS, amplitude, blocks, start_record
from twin.exchange.export import ExportOptions, export_log
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording

TABLE_M = 1e-2  # amplitude of the table in every step


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    pytest.importorskip("h5py")
    pytest.importorskip("pyuff")
    return export_formats(tmp_path_factory.mktemp("export"), ("hdf5", "uff"))


@pytest.fixture
def sine_log(tmp_path: Path) -> Path:
    """Every step a whole number of cycles of sines, with two samples lost."""
    start = start_record()
    items = blocks()
    for k, item in enumerate(items):
        if isinstance(item, Block) and item.stream == "meas":
            values = item.values.copy()
            values[:, 5:7] = np.nan
            items[k] = replace(item, values=values)
    write_items(tmp_path / "run.mcap", [start, *items], start)
    return tmp_path / "run.mcap"


def plant_ratios(direction: str) -> tuple[list[float], list[complex]]:
    """Frequencies in Hz and u over the table's acceleration in s2: a sine over minus a cosine."""
    steps = sorted(
        (step for step in STEPS if step.direction == direction), key=lambda s: s.frequency_hz
    )
    w = [2 * math.pi * step.frequency_hz for step in steps]
    ratios = [1j * amplitude(step) / (TABLE_M * k**2) for step, k in zip(steps, w, strict=True)]
    return [step.frequency_hz for step in steps], ratios


def test_h5py_reads_a_run_in_the_layout_of_nexus(both: tuple[Path, Path]) -> None:
    h5py = pytest.importorskip("h5py")
    log, out = both
    index, values, *_ = join_measured_blocks(read_recording(log))
    with h5py.File(out.with_suffix(".h5")) as file:
        entry = file[file.attrs["default"]]
        assert entry.attrs["NX_class"] == "NXentry"
        assert entry["start_time"][()].decode() == start_record().started_at
        data: Any = entry[entry.attrs["default"]]
        assert (data.attrs["NX_class"], list(data.attrs["axes"])) == ("NXdata", ["time_s"])
        assert data["time_s"].attrs["units"] == "s"
        assert data["time_s"][:].tolist() == (index / RATE).tolist()
        assert data["mass_acc_m_s2"].attrs["units"] == "m/s2"
        channel = start_record().channels.index("mass_acc_m_s2")
        assert data["mass_acc_m_s2"][:].tobytes() == values[channel].tobytes()
        assert "twin_free_rel_disp_m" in entry["twin"]
        profile = read_recording(log).start.profile_toml
        assert entry["configuration/profile_toml"][()].decode() == profile


def test_pyuff_reads_histories_and_frequency_responses(both: tuple[Path, Path]) -> None:
    pyuff = pytest.importorskip("pyuff")
    log, out = both
    index, values, *_ = join_measured_blocks(read_recording(log))
    file = pyuff.UFF(str(out.with_suffix(".uff")))
    sets = {entry["id1"].strip(): entry for entry in file.read_sets()}
    history = sets["mass_acc_m_s2"]
    channel = start_record().channels.index("mass_acc_m_s2")
    assert (history["func_type"], history["ordinate_spec_data_type"]) == (1, 12)
    assert history["ordinate_axis_units_lab"].strip() == "m/s2"
    assert history["data"][index].tobytes() == values[channel].tobytes()
    assert np.isnan(history["data"][slice(*LOST)]).all()
    assert history["x"] == pytest.approx(np.arange(index[-1] + 1) / RATE)
    assert history["id3"].strip() == start_record().started_at


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_frequency_responses_are_those_of_a_planted_motion(
    sine_log: Path, tmp_path: Path, direction: str
) -> None:
    h5py, pyuff = pytest.importorskip("h5py"), pytest.importorskip("pyuff")
    export_log(ExportOptions(sine_log, ("hdf5", "uff"), tmp_path / "out"))
    frequencies, ratios = plant_ratios(direction)
    with h5py.File(tmp_path / "out.h5") as file:
        group = file[f"entry/frf_{direction}"]
        assert group["frequency"][:].tolist() == frequencies
        assert group["rel_disp_m"].attrs["units"] == "(m)/(m/s2)"
        assert np.abs(group["rel_disp_m"][:] / ratios - 1).max() < 1e-9
        assert np.abs(group["mass_disp_m"][:1] / group["rel_disp_m"][:1] - 1).max() > 0.1
    file = pyuff.UFF(str(tmp_path / "out.uff"))
    sets = {entry["id1"].strip(): entry for entry in file.read_sets()}
    response = sets[f"rel_disp_m/table_acc_m_s2 {direction}"]
    assert (response["func_type"], response["abscissa_spec_data_type"]) == (4, 18)
    assert response["x"].tolist() == frequencies
    assert np.abs(response["data"] / ratios - 1).max() < 1e-9
    assert response["orddenom_axis_units_lab"].strip() == "m/s2"


def test_spectrograms_show_the_sine_of_each_step(tmp_path: Path) -> None:
    """The area below the peak is the mean square of the motion; lost samples leave a window out."""
    h5py = pytest.importorskip("h5py")
    start = start_record()
    time_s = np.arange(round(30.0 * RATE)) / RATE
    hz = np.where(time_s < 15.0, 5.0, 12.5)
    values = np.zeros((len(start.channels), time_s.size))
    row = start.channels.index("table_acc_m_s2")
    values[row] = 7.0 + 3.0 * np.sin(2 * np.pi * hz * time_s)
    values[row, round(25.0 * RATE)] = np.nan
    labels = (np.zeros(time_s.size, dtype=np.int64),) * 3
    block = Block("meas", 0, RATE, start.channels, values, *labels)
    write_items(tmp_path / "run.mcap", [start, block], start)
    export_log(ExportOptions(tmp_path / "run.mcap", ("hdf5",), tmp_path / "out"))
    with h5py.File(tmp_path / "out.h5") as file:
        group = file["entry/spectrogram"]
        window_s, frequency = group["time_s"][:], group["frequency"][:]
        density = group["table_acc_m_s2"][:]
        assert group["table_acc_m_s2"].attrs["units"] == "(m/s2)2/Hz"
    assert density.shape == (window_s.size, frequency.size)
    is_lost = np.abs(window_s - 25.0) <= 2.0
    assert np.isnan(density[is_lost]).all()
    for expected_hz, is_inside in ((5.0, window_s < 13.0), (12.5, (window_s > 17.0) & ~is_lost)):
        part = density[is_inside]
        assert part.shape[0] >= 3
        assert (frequency[np.argmax(part, axis=1)] == expected_hz).all()
        np.testing.assert_allclose(part.sum(axis=1) * frequency[1], 0.5 * 3.0**2, rtol=1e-6)


def test_a_crate_describes_the_files_beside_it(both: tuple[Path, Path], tmp_path: Path) -> None:
    log, _ = both
    options = ExportOptions(log, ("csv", "mat"), tmp_path / "out", has_crate=True)
    export_log(options)
    crate = json.loads((tmp_path / "ro-crate-metadata.json").read_text())
    assert crate["@context"] == "https://w3id.org/ro/crate/1.1/context"
    entities = {entity["@id"]: entity for entity in crate["@graph"]}
    assert len(entities) == len(crate["@graph"])
    assert entities["ro-crate-metadata.json"]["about"] == {"@id": "./"}
    root = entities["./"]
    assert {part["@id"] for part in root["hasPart"]} == {"out.csv", "out.mat"}
    assert root["datePublished"] == start_record().started_at
    for name in ("out.csv", "out.mat"):
        content = (tmp_path / name).read_bytes()
        assert entities[name]["contentSize"] == str(len(content))
        assert entities[name]["identifier"] == f"sha256:{hashlib.sha256(content).hexdigest()}"
    assert entities["#mass_acc_m_s2"]["unitText"] == "m/s2"
    with raises_input_error(where=tmp_path / "ro-crate-metadata.json"):
        export_log(ExportOptions(log, ("parquet",), tmp_path / "other", has_crate=True))
