"""Names that commands share, each from its own file."""

from twin.service.bundle import warm
from twin.service.driving import real_time as _real_time
from twin.service.folders import new_folder
from twin.service.kernels import COMPILING
from twin.service.outcome import EXIT_ABORTED, EXIT_GAPS, EXIT_INTERRUPTED
from twin.service.recordings import recorded_bundle
from twin.service.terminal import console, said_if_long
from twin.service.terminal import interruptible as _interruptible

__all__ = [
    "EXIT_ABORTED", "EXIT_GAPS", "EXIT_INTERRUPTED", "_compile_once", "_interruptible",
    "_real_time", "console", "new_folder", "recorded_bundle",
]  # fmt: skip


def _compile_once() -> None:
    with said_if_long(COMPILING):
        warm("plant")
        warm("twin")
