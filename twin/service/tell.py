"""`shaketwin tell`: hold, resume, stop or abort a test that runs in another terminal."""

import getpass
import re

from table_io.card import BadInput
from twin.service.terminal import say
from twin.stream.endpoint import running
from twin.stream.keys import Keys
from twin.stream.zenoh_link import open_spoke

CONNECT_S = 3.0
ANSWER_S = 2.0


def person() -> str:
    """Under which name whoever uses this machine gives orders where there are no keys."""
    return re.sub(r"[^A-Za-z0-9_.-]", "_", getpass.getuser())[:64] or "somebody"


def tell(order: str, why: str, connect: str, rig: str, keys: Keys | None = None) -> None:
    """Hand an order to the rig that runs at the endpoint; BadInput where it does not take it."""
    link = open_spoke(rig, connect, CONNECT_S, keys)
    try:
        runs = running(link.components())
        if not runs:
            raise BadInput(f"endpoint {connect}: no test runs there; `shaketwin run` starts one")
        who = person() if keys is None else keys.name
        answer = link.request(f"{order}/{who}", f"{runs[0]}\n{why}", ANSWER_S)
    finally:
        link.close()
    if answer != "yes":
        raise BadInput(
            f"{order}: {answer or f'the rig did not answer within {ANSWER_S:g} s'}; "
            "in need use the machine's own emergency stop"
        )
    say(f"{runs[0]}: told to {order}")
