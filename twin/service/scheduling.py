"""Real-time scheduling, where it is permitted."""

import gc
import os


def urgent(priority: int) -> str:
    """Ask for real-time scheduling; what was granted.

    Asked before any thread is made, so that those in which a link sends and receives inherit it.
    What the imports made is taken out of the garbage collector's sight: a full collection of it
    costs 15 ms in the middle of a run.
    """
    gc.collect()
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        return "normal"
    return f"fifo {priority}"
