"""A log as an xarray.Dataset. The only file that knows xarray (extra `notebook`)."""

from typing import TYPE_CHECKING

from table_io.block import Label
from table_io.card import BadInput
from table_io.channels import BY_NAME
from twin.compare import PREDICTED
from twin.stream.rows import unit

if TYPE_CHECKING:
    from xarray import Dataset as Dataset  # noqa: PLC0414

    from twin.log import Log

LABELS = ", ".join(f"{int(one)} {one.name.lower()}" for one in Label)


def dataset(log: "Log") -> "Dataset":
    """All channels of a log over `time` in s, with what they and the run are as attributes."""
    try:
        import xarray
    except ImportError:
        raise BadInput(
            "to_xarray needs xarray, which is not installed: pip install 'shaketwin[notebook]'"
        ) from None
    data = {name: ("time", log[name], _attributes(name)) for name in log.channels}
    for row, name in zip(log.predicted, PREDICTED, strict=True):
        data[f"twin_{name.replace('/', '_')}"] = ("time", row, _attributes(name.split("/")[1]))
    coordinates = {
        "time": ("time", log.time_s, {"units": "s"}),
        "step": ("time", log.step_index, {"meaning": "index of the step, -1 outside"}),
        "label": ("time", log.label, {"meaning": f"what the drive did: {LABELS}"}),
        "cycle": ("time", log.cycle, {"meaning": "held cycle within the step, -1 outside"}),
    }
    run = log.start
    about = {
        "run": run.run, "name": run.name, "title": log.profile.title, "rate_hz": run.rate_hz,
        "started_at": run.started_at, "host": run.host, "profile_toml": run.profile_toml,
        "rig_toml": run.rig_toml, "model_toml": run.model_toml,
    }  # fmt: skip
    return xarray.Dataset(data, coordinates, about)


def _attributes(name: str) -> dict[str, str]:
    known = BY_NAME.get(name)
    more = {"positive": known.positive, "meaning": known.meaning} if known else {}
    return {"units": unit(name), **more}
