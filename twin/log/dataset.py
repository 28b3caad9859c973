"""Conversion of a log to an xarray.Dataset; only this file imports xarray (extra `notebook`)."""

from typing import TYPE_CHECKING

from table_io.block import Label
from table_io.channels import Channel
from table_io.config.channel import read_channels
from table_io.errors import InputError, format_pip_line
from twin.compare import TWIN_CHANNELS
from twin.recording.tabular import channel_unit

if TYPE_CHECKING:
    from xarray import Dataset as Dataset  # noqa: PLC0414

    from twin.log import Log

LABEL_MEANINGS = ", ".join(f"{int(label)} {label.name.lower()}" for label in Label)


def build_dataset(log: "Log") -> "Dataset":
    """Build a Dataset of all channels over `time` in s, with units and run as attributes."""
    try:
        import xarray
    except ImportError:
        raise InputError(
            "to_xarray needs xarray, which is not installed",
            remedy=format_pip_line("notebook"),
        ) from None
    channels = read_channels(log.start.rig_toml)
    data = {name: ("time", log[name], _channel_attributes(name, channels)) for name in log.channels}
    for row, name in zip(log.predicted, TWIN_CHANNELS, strict=True):
        data[f"twin_{name.replace('/', '_')}"] = (
            "time",
            row,
            _channel_attributes(name.split("/")[1], channels),
        )
    coordinates = {
        "time": ("time", log.time_s, {"units": "s"}),
        "step": ("time", log.step_index, {"meaning": "index of the step, -1 outside"}),
        "label": ("time", log.label, {"meaning": f"what the drive did: {LABEL_MEANINGS}"}),
        "cycle": ("time", log.cycle, {"meaning": "held cycle within the step, -1 outside"}),
    }
    run = log.start
    attributes = {
        "run": run.run, "name": run.name, "title": log.profile.title, "rate_hz": run.rate_hz,
        "started_at": run.started_at, "host": run.host, "profile_toml": run.profile_toml,
        "rig_toml": run.rig_toml, "model_toml": run.model_toml,
    }  # fmt: skip
    return xarray.Dataset(data, coordinates, attributes)


def _channel_attributes(name: str, channels: dict[str, Channel]) -> dict[str, str]:
    channel = channels.get(name)
    details = {"positive": channel.positive, "meaning": channel.meaning} if channel else {}
    return {"units": channel_unit(name, channels), **details}
