"""`shaketwin control`: hold, resume, stop or abort a running test from another terminal.

Every import of this module delays a stop: it needs neither numpy nor pydantic nor rich.
"""

import re
from typing import TYPE_CHECKING

from table_io.errors import InputError
from twin.security.access_control import user_name
from twin.transport.endpoint import list_runs, make_endpoint_error
from twin.transport.zenoh_link import BusLink, open_spoke

if TYPE_CHECKING:
    from twin.security.credentials import Credentials

CONNECT_TIMEOUT_S = 3.0
ANSWER_TIMEOUT_S = 2.0


def find_run(link: BusLink, connect: str, rig: str) -> str:
    """Return the id of the run of this rig at the endpoint; InputError if there is none.

    The id comes from the network and names folders, so it is validated first.
    """
    runs = list_runs(link.list_components())
    if not runs or not re.fullmatch(r"\w[\w.-]{0,100}", runs[0]):
        raise make_endpoint_error(
            connect,
            f"no test is running there on rig {rig!r}",
            "start one with `shaketwin run`, or give the `name` in the rig file of the "
            "running rig with --table",
        )
    return runs[0]


def request_command(
    command: str,
    reason: str,
    connect: str,
    rig: str,
    keys: "Credentials | None" = None,
    *,
    run: str = "",
    sender: str = "",
) -> tuple[str, str]:
    """Send a command to the rig that runs at the endpoint; return (run id, answer or "").

    The answer is "yes" if the rig accepts it. Default: the run that is there, in the user's own
    name; only a router or the rig may send in the name of another `sender`.
    """
    link = open_spoke(rig, connect, CONNECT_TIMEOUT_S, keys)
    try:
        run = run or find_run(link, connect, rig)
        key = f"{command}/{sender or user_name(keys)}"
        return run, link.send_command(key, f"{run}\n{reason}", ANSWER_TIMEOUT_S) or ""
    finally:
        link.close()


def send_command(
    command: str, reason: str, connect: str, rig: str, keys: "Credentials | None" = None
) -> str:
    """Send a command as the user; return a confirmation, InputError if it is not accepted."""
    try:
        run, answer = request_command(command, reason, connect, rig, keys)
    except InputError:
        raise
    # Whatever failed, bus or account, the operator of a moving table needs the way out, no trace.
    except Exception as error:
        answer = f"could not be sent: {error}"
    if answer != "yes":
        raise InputError(
            answer or f"the rig did not respond within {ANSWER_TIMEOUT_S:g} s",
            where=command,
            remedy="in an emergency use the machine's own emergency stop",
        )
    return f"{run}: {command} accepted"
