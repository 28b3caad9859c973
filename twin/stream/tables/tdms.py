"""LabVIEW's TDMS. The only file that knows npTDMS. A channel is `group/channel`."""

from pathlib import Path
from typing import Any

from nptdms import TdmsFile

from twin.stream.tables import Held, Key, Table


def read(path: Path) -> Table:
    """The channels of a file; rate and begin from the waveform properties of each."""
    with TdmsFile.open(path) as file:
        cut = file.file_status.incomplete_final_segment
        table = Table(path, said=("warning: the file ends inside a segment",) if cut else ())
        for group in file.groups():
            for channel in group.channels():
                name = f"{group.name}/{channel.name}"
                kind = "O" if channel.dtype is None else channel.dtype.kind
                if kind not in "fiub" or len(channel) < 2:
                    table.others[name] = f"{len(channel)} values of {channel.dtype}"
                    continue
                said = channel.properties
                step = float(said.get("wf_increment", 0.0))
                table.columns[name] = Held(
                    len(channel),
                    (group.name, channel.name),
                    str(said.get("unit_string", "")),
                    1.0 / step if step > 0 else None,
                    float(said.get("wf_start_offset", 0.0)),
                    group=group.name,
                )
    return table


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,), scaled as the file says."""
    group, channel = key
    with TdmsFile.open(path) as file:
        return file[group][channel][:]
