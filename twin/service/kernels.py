"""The compiled kernels of a command, compiled or loaded before anything waits for them.

Whether they are cached is not asked: only numba knows, and it knows by loading them.
"""

from twin.service.bundle import Bundle, warm_rig, warm_twin
from twin.service.terminal import said_if_long

COMPILING = "compiling the kernels: once, the next start finds them"


def ready(bundle: Bundle, table: bool = False) -> None:
    """Has the kernels of the bundle's twin, and of its simulated table where it is asked for.

    Called before anything is made or moved: who interrupts it leaves nothing behind.
    """
    with said_if_long(COMPILING):
        if table:
            warm_rig(bundle)
        warm_twin()
        bundle.twin()
