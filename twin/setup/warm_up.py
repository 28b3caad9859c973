"""Warm-up: compilation or loading of a command's kernels before time matters.

Whether a kernel is cached is known only to numba, by loading it.
"""

from twin.setup.run_config import RunConfig, compile_rig_kernels, compile_twin_kernels
from twin.system.terminal import announce_if_slow

COMPILING_MESSAGE = "compiling the kernels: once, the next start finds them"


def compile_kernels(config: RunConfig, table: bool = False) -> None:
    """Compile or load the kernels of the twin and, with `table`, of the simulated table.

    Call it before creating files or moving the table, so that an interrupt leaves nothing behind.
    """
    with announce_if_slow(COMPILING_MESSAGE):
        if table:
            compile_rig_kernels(config)
        compile_twin_kernels()
        config.prepare_twin()
