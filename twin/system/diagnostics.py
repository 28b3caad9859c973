"""Diagnostics of long-running processes, as a service manager collects them.

What a command has to tell a person is printed instead.
"""

import logging
import os

from table_io.errors import InputError

LEVEL_VARIABLE = "SHAKETWIN_LOG_LEVEL"
LEVELS = ("debug", "info", "warning", "error")


def configure_logging(component: str) -> None:
    """Log lines of time, component, level and message to standard error.

    Child processes inherit the level. Raises InputError if it is not one of LEVELS.
    """
    level = os.environ.get(LEVEL_VARIABLE, "error")
    if level not in LEVELS:
        raise InputError(
            "no such log level", key=LEVEL_VARIABLE, value=level, allowed=", ".join(LEVELS)
        )
    handler = logging.StreamHandler()
    line = "%(asctime)s %(component)s %(levelname)s %(message)s"
    handler.setFormatter(logging.Formatter(line, defaults={"component": component}))
    logger = logging.getLogger("twin")  # not the root: libraries would log here too
    logger.handlers = [handler]
    logger.setLevel(level.upper())
