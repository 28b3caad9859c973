"""Where a bus is and what stands where on it; settings of a session: plain values, no zenoh."""

import re
import socket
from collections.abc import Iterable
from typing import Any

from table_io.card import BadInput
from twin.stream.wire import BLOCK_TOPICS, CMP_TOPIC

Settings = dict[str, Any]

STREAMS = frozenset((*BLOCK_TOPICS.values(), CMP_TOPIC))  # what comes with every block
INSIDE = "unixsock-stream/"  # of a run: nobody else on the machine can reach it
OBSERVER = "observer."  # begins the names under which those who only look are alive
MOST_SESSIONS = 64
LARGEST_MESSAGE = 64 * 2**10  # from outside, its attachment included
# Questions of a session a second. What comes sooner after the one before is dropped, so that who
# waits for one answer before the next question (0.4 ms and more) must never be too fast.
ASKED_HZ, TOLD_HZ = 5000.0, 10.0
MOST_OFTEN = {
    "state/held": ASKED_HZ,
    "state/status": ASKED_HZ,
    "state/role/*": ASKED_HZ,
    **{f"config/{one}": ASKED_HZ for one in ("run", "profile", "rig", "model", "schema")},
    **{f"cmd/{order}/*": TOLD_HZ for order in ("hold", "resume", "stop", "abort")},
}
PUBLIC: Settings = {  # of a hub that others reach: what is more or too often is dropped by zenoh
    "transport": {
        "unicast": {"max_sessions": MOST_SESSIONS, "accept_pending": 16, "accept_timeout": 5000},
        "link": {"rx": {"max_message_size": 2 * LARGEST_MESSAGE}},
    },
    "low_pass_filter": [
        {
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": ["**"],
            "size_limit": LARGEST_MESSAGE,
        }
    ],
    "downsampling": [
        {
            "flows": ["ingress"],
            "messages": ["query"],
            "rules": [
                {"key_expr": f"shaketwin/*/{path}", "freq": often}
                for path, often in MOST_OFTEN.items()
            ],
        }
    ],
}


def check(rig: str, endpoint: str, keyed: bool) -> None:
    """BadInput where these are not the name of a rig and an endpoint at which a bus may be.

    Over a network it may be only where both ends show certificates: tls/ and keys.
    """
    if not re.fullmatch(r"[\w.-]+", rig):
        raise BadInput(f"rig {rig!r}: not a name for the bus; allowed: letters, digits and _ . -")
    if endpoint.startswith(INSIDE) and not keyed:
        return
    match = re.fullmatch(r"(tcp|tls)/(\[[0-9A-Fa-f:]+\]|[\w.-]+):(\d{1,5})", endpoint)
    if not match or not 0 < int(match[3]) < 2**16:
        raise BadInput(
            f"endpoint {endpoint!r}: not understood; write tcp/<host>:<port>, as "
            "tcp/127.0.0.1:7447, or with --keys FOLDER tls/<host>:<port>"
        )
    if match[1] == "tls" and not keyed:
        raise BadInput(
            f"endpoint {endpoint}: shows and asks for certificates; give yours with --keys FOLDER "
            "(whoever keeps the rig's keys makes them: `shaketwin keys add`)"
        )
    if match[1] == "tcp" and keyed:
        raise BadInput(f"endpoint {endpoint}: tcp/ shows no certificate; with --keys write tls/")
    if not keyed and not re.fullmatch(r"127\.[\d.]+|localhost|\[::1\]", match[2]):
        raise BadInput(
            f"endpoint {endpoint}: would go over the network, unprotected; allowed: this machine "
            "only, as tcp/127.0.0.1:7447, or with --keys FOLDER tls/<host>:<port>"
        )


def key(rig: str, topic: str, *, offered: bool = False) -> str:
    """Key on the bus of a wire topic; of what is `offered` from outside, for the gate alone."""
    if offered:
        return f"shaketwin/{rig}/offer{topic}"
    return f"shaketwin/{rig}/{'stream' if topic in STREAMS else 'event'}{topic}"


def held(*, offered: bool) -> str:
    """Under which path somebody is asked for what he holds of what he published, or offered."""
    return "state/offers" if offered else "state/held"


def safe(name: str) -> str:
    """A name that somebody else chose, as it may stand on a terminal."""
    return re.sub(r"[^\w.-]", "?", name)[:100]


def running(names: Iterable[str]) -> list[str]:
    """Ids of the runs whose rig is among those who are alive; what a person chose is no run."""
    rigs = (name for name in names if name.endswith(".rig") and not name.startswith(OBSERVER))
    return sorted(name.removesuffix(".rig") for name in rigs)


def observers(names: Iterable[str]) -> list[str]:
    """The names among them under which those who only look are alive."""
    return sorted(name for name in names if name.startswith(OBSERVER))


def host_and_port(endpoint: str) -> tuple[str, int]:
    """Of a checked endpoint, as sockets want them."""
    host, port = endpoint.partition("/")[2].rsplit(":", 1)
    return host.strip("[]"), int(port)


def refuse_taken(rig: str, endpoint: str, keyed: bool) -> None:
    """BadInput where nobody can listen at an endpoint now; a check as above included."""
    check(rig, endpoint, keyed)
    host, port = host_and_port(endpoint)
    try:
        socket.create_server((host, port), family=_family(host)).close()
    except OSError as error:
        raise BadInput(cannot_listen(endpoint, error.strerror or str(error))) from None


def innermost(error: Exception) -> str:
    """The innermost reason in a message of zenoh, without its source files."""
    reason = re.search(r"([A-Z][^\[\]:]*) \(os error", str(error))
    return reason[1] if reason else re.sub(r" at /\S+", "", str(error))


def cannot_listen(endpoint: str, why: str) -> str:
    """In words."""
    return (
        f"endpoint {endpoint}: cannot listen there ({why}); "
        "end the run that holds the port, or give another one"
    )


def _family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def settings(mode: str, way: str, endpoint: str, timeout_s: float) -> Settings:
    """zenoh's settings for a session with one endpoint and no other; full queues drop at once."""
    end = {"endpoints": [endpoint], "timeout_ms": round(timeout_s * 1000), "exit_on_failure": True}
    if way == "connect":  # again too: a hub that is gone for a while is found as soon as it is back
        end["retry"] = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
    drop = {"wait_before_drop": 0, "max_wait_before_drop_fragments": 0}
    queue = {"congestion_control": {"drop": drop}, "size": {"data": 16}}
    return {
        "mode": mode,
        "listen": {"endpoints": []},
        "connect": {"endpoints": []},
        way: end,
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"queue": queue}}},
    }


def through(router: str) -> Settings:
    """Settings of a hub that others also reach through a router, which may come and go."""
    retry = {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2}
    return {
        "connect": {
            "endpoints": [router],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": retry,
        }
    }


def merged(settings: Settings, more: Settings) -> Settings:
    """Both; where a key is in both, tables are merged and other values are those of `more`."""
    both = settings | more
    for key in settings.keys() & more.keys():
        if isinstance(settings[key], dict) and isinstance(more[key], dict):
            both[key] = merged(settings[key], more[key])
    return both
