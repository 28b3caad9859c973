"""The Backend contract on an NI-DAQmx device: the local driver, or NI's gRPC Device Server."""

from table_io.card import BadInput

try:
    import nidaqmx  # noqa: F401
except ImportError:
    raise BadInput("backend 'ni' needs NI's client: pip install shaketwin[ni]") from None

from table_io.backends.ni.backend import NiBackend
from table_io.backends.ni.entry import answers

__all__ = ["NiBackend", "answers"]
