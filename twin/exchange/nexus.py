"""Export to HDF5 in the layout of NeXus: an NXentry with what belongs to a run."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from table_io.channels import TIME_COLUMN
from table_io.formats.hdf5 import Attributes, Fields, write_nexus
from twin.exchange.response_functions import (
    REFERENCE,
    compute_spectrograms,
    compute_sweep_responses,
    list_measured_channels,
)
from twin.recording.tabular import TWIN_PREFIX, LogTable


def write_hdf5(rows: LogTable, path: Path) -> None:
    """Write a run as one HDF5 file: measurement, twin, configuration, responses, spectrograms."""
    write_nexus(path, _iter_groups(rows))


def _iter_groups(rows: LogTable) -> Iterator[tuple[str, Attributes, Fields]]:
    start, units = rows.start, rows.units
    twins = [name for name in units if name.startswith(TWIN_PREFIX)]
    measured = [name for name in units if name not in (TIME_COLUMN, *twins)]
    channels = list_measured_channels(rows) or measured
    program = {"version": start.versions["shaketwin"]} if "shaketwin" in start.versions else {}
    entry: list[tuple[str, Any, Attributes]] = [
        ("title", start.name, {}),
        ("experiment_identifier", start.run, {}),
        ("start_time", start.started_at, {}),
        ("program_name", "shaketwin", program),
        ("sampling_rate", start.rate_hz, {"units": "Hz"}),
    ]
    yield "entry", {"NX_class": "NXentry", "default": "measured"}, entry
    texts: Fields = ((name, text, {}) for name, text in rows.toml_texts.items())
    yield "entry/configuration", {"NX_class": "NXcollection"}, texts
    yield _make_data("measured", channels[0], [TIME_COLUMN], _read_fields(rows, measured))
    if twins:
        yield _make_data("twin", twins[0], [TIME_COLUMN], _read_fields(rows, twins))
    for response in compute_sweep_responses(rows):
        fields: Fields = (
            ("frequency", response.frequency_hz, {"units": "Hz"}),
            *(
                (name, ratio, {"units": f"({units[name]})/({units[REFERENCE]})"})
                for name, ratio in response.ratios.items()
            ),
        )
        name = f"frf_{response.direction}"
        yield _make_data(name, channels[0], ["frequency"], fields, reference=REFERENCE)
    if (spectrograms := compute_spectrograms(rows)) is not None:
        time_s, frequency_hz, densities = spectrograms
        axes: Fields = (
            (TIME_COLUMN, time_s, {"units": "s", "start": start.started_at}),
            ("frequency", frequency_hz, {"units": "Hz"}),
        )
        values = ((name, each, {"units": f"({units[name]})2/Hz"}) for name, each in densities)
        names = [TIME_COLUMN, "frequency"]
        yield _make_data("spectrogram", channels[0], names, (*axes, *values))


def _make_data(
    name: str, signal: str, axes: list[str], fields: Fields, **more: str
) -> tuple[str, Attributes, Fields]:
    return f"entry/{name}", {"NX_class": "NXdata", "signal": signal, "axes": axes, **more}, fields


def _read_fields(rows: LogTable, names: Iterable[str]) -> Fields:
    for name in (TIME_COLUMN, *names):
        attributes = {"units": rows.units[name]} if rows.units[name] else {}
        if name == TIME_COLUMN:
            attributes["start"] = rows.start.started_at
        yield name, rows.read_columns(slice(None), name)[name], attributes
