"""Reader of LabVIEW TDMS files, with columns `group/channel`; only this file imports npTDMS."""

from pathlib import Path
from typing import Any

import numpy as np
from nptdms import TdmsFile

from table_io.formats.table import ColumnKey, ForeignColumn, ForeignTable
from table_io.formats.words import UNIT_FIELDS, add_fact, find_fact

UNIT_KEYS = ("unit_string", "NI_UnitDescription", *UNIT_FIELDS)
SECOND = np.timedelta64(1, "s")


def scan_columns(path: Path) -> ForeignTable:
    """Scan the channels of a file; rate and start are their properties, from the first start."""
    with TdmsFile.open(path) as file:
        is_truncated = file.file_status.incomplete_final_segment
        notes = ("warning: the file ends inside a segment",) if is_truncated else ()
        table = ForeignTable(path, "", notes=notes, loader="tdms")
        begins = {
            (group.name, channel.name): np.datetime64(channel.properties["wf_start_time"])
            for group in file.groups()
            for channel in group.channels()
            if "wf_start_time" in channel.properties
        }
        for place in (file, *file.groups()):
            for key, value in place.properties.items():
                if (fact := find_fact(key)) and isinstance(value, (int, float)):
                    add_fact(table.facts, fact, float(value))
        first = min(begins.values(), default=np.datetime64(0, "us"))
        for group in file.groups():
            for channel in group.channels():
                name = f"{group.name}/{channel.name}"
                kind = "O" if channel.dtype is None else channel.dtype.kind
                if kind not in "fiubM" or len(channel) < 2:
                    table.dropped[name] = f"{len(channel)} values of {channel.dtype}"
                    continue
                properties = channel.properties
                step = float(properties.get("wf_increment", 0.0))
                table.columns[name] = ForeignColumn(
                    len(channel),
                    (group.name, channel.name),
                    next((str(properties[key]) for key in UNIT_KEYS if key in properties), ""),
                    1.0 / step if step > 0 else None,
                    (begins.get((group.name, channel.name), first) - first) / SECOND
                    + float(properties.get("wf_start_offset", 0.0)),
                    group=group.name,
                )
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,), with the scaling in the file."""
    group, channel = key
    with TdmsFile.open(path) as file:
        return file[group][channel][:]
