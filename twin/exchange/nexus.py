"""Export to HDF5 in the layout of NeXus: an NXentry with what belongs to a run."""

from collections.abc import Iterable, Iterator
from pathlib import Path

from table_io.channels import TIME_COLUMN
from table_io.formats.hdf5 import NexusField, NexusGroup, write_nexus
from twin.exchange.response_functions import REFERENCE, compute_sweep_responses
from twin.recording.tabular import LABEL_UNITS, TWIN_PREFIX, LogTable


def write_hdf5(rows: LogTable, path: Path) -> None:
    """Write a run as one HDF5 file in the layout of NeXus: an NXentry with what belongs to it."""
    start = rows.start
    twins = [name for name in rows.units if name.startswith(TWIN_PREFIX)]
    measured = [name for name in rows.units if name not in (TIME_COLUMN, *twins)]
    signal = next((name for name in measured if name not in LABEL_UNITS), measured[0])
    groups = [
        NexusGroup(
            "entry",
            "NXentry",
            {"default": "measured"},
            [
                NexusField("title", start.name),
                NexusField("experiment_identifier", start.run),
                NexusField("start_time", start.started_at),
                NexusField("program_name", "shaketwin", {"version": start.versions["shaketwin"]})
                if "shaketwin" in start.versions
                else NexusField("program_name", "shaketwin"),
                NexusField("sampling_rate", start.rate_hz, {"units": "Hz"}),
            ],
        ),
        NexusGroup(
            "entry/measured",
            "NXdata",
            {"signal": signal, "axes": [TIME_COLUMN]},
            _list_fields(rows, [TIME_COLUMN, *measured]),
        ),
        NexusGroup(
            "entry/configuration",
            "NXcollection",
            {},
            [NexusField(name, text) for name, text in rows.toml_texts.items()],
        ),
    ]
    if twins:
        groups.append(
            NexusGroup(
                "entry/twin",
                "NXdata",
                {"signal": twins[0], "axes": [TIME_COLUMN]},
                _list_fields(rows, [TIME_COLUMN, *twins]),
            )
        )
    for response in compute_sweep_responses(rows):
        fields = [NexusField("frequency", response.frequency_hz, {"units": "Hz"})]
        for name, ratio in response.ratios.items():
            fields.append(NexusField(name, ratio, {"units": _divide_unit(rows, name)}))
        attributes: dict[str, str | list[str]] = {
            "signal": next(iter(response.ratios)),
            "axes": ["frequency"],
            "reference": REFERENCE,
        }
        groups.append(NexusGroup(f"entry/frf_{response.direction}", "NXdata", attributes, fields))
    write_nexus(path, groups)


def _list_fields(rows: LogTable, names: Iterable[str]) -> Iterator[NexusField]:
    for name in names:
        attributes = {"units": rows.units[name]} if rows.units[name] else {}
        if name == TIME_COLUMN:
            attributes["start"] = rows.start.started_at
        yield NexusField(name, rows.read_columns(slice(None), name)[name], attributes)


def _divide_unit(rows: LogTable, name: str) -> str:
    return f"({rows.units[name]})/({rows.units[REFERENCE]})"
