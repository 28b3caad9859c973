"""Real-time scheduling, if permitted."""

import gc
import os


def request_realtime(priority: int) -> str:
    """Request real-time scheduling and return the policy granted.

    Call it before any thread is created, so that the link's threads inherit the policy. Objects
    created by imports are frozen out of garbage collection: a full collection of them takes 15 ms
    in the middle of a run.
    """
    gc.collect()
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        return "normal"
    return f"fifo {priority}"
