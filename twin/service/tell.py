"""`shaketwin tell`: hold, resume, stop or abort a test that runs in another terminal."""

import getpass
import re

from table_io.card import BadInput
from twin.service.terminal import say
from twin.stream.endpoint import running
from twin.stream.keys import Keys
from twin.stream.zenoh_link import Link, open_spoke

CONNECT_S = 3.0
ANSWER_S = 2.0


def person(keys: Keys | None) -> str:
    """Whose keys they are; without keys the name of whoever uses this machine."""
    if keys is not None:
        return keys.name
    return re.sub(r"[^A-Za-z0-9_.-]", "_", getpass.getuser())[:64] or "somebody"


def run_of(link: Link, connect: str, rig: str) -> str:
    """Id of the run of this rig there, looked at first: it names folders. BadInput if none."""
    runs = running(link.components())
    if not runs or not re.fullmatch(r"\w[\w.-]{0,100}", runs[0]):
        raise BadInput(
            f"endpoint {connect}: no test runs there on rig {rig!r}; `shaketwin run` starts one, "
            "--rig NAME names another rig (`name` in its machine card)"
        )
    return runs[0]


def tell(order: str, why: str, connect: str, rig: str, keys: Keys | None = None) -> None:
    """Hand an order to the rig that runs at the endpoint; BadInput where it does not take it."""
    link = open_spoke(rig, connect, CONNECT_S, keys)
    try:
        run = run_of(link, connect, rig)
        answer = link.request(f"{order}/{person(keys)}", f"{run}\n{why}", ANSWER_S)
    finally:
        link.close()
    if answer != "yes":
        raise BadInput(
            f"{order}: {answer or f'the rig did not answer within {ANSWER_S:g} s'}; "
            "in need use the machine's own emergency stop"
        )
    say(f"{run}: told to {order}")
