"""Backend for NI-DAQmx devices, on the local driver or through NI's gRPC Device Server."""

from table_io.errors import InputError

try:
    import nidaqmx  # noqa: F401
except ImportError:
    raise InputError(
        "NI's client library is not installed",
        key="backend",
        value="ni",
        remedy="pip install shaketwin[ni]",
    ) from None

from table_io.backends.ni.backend import NiBackend
from table_io.backends.ni.probe import check_reachable

__all__ = ["NiBackend", "check_reachable"]
