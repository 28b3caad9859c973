"""Endpoints, keys and session settings of the bus, as plain values without zenoh."""

import re
import socket
from collections.abc import Iterable

from table_io.errors import InputError
from twin.security.access_control import ZenohSettings

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # at which observers reach a test
MEAS_TOPIC = "/rig/meas"
PRED_TOPIC = "/twin/pred"
CMP_TOPIC = "/twin/cmp"
HASH_TOPIC = "/twin/hash"
BLOCK_TOPICS = {"meas": MEAS_TOPIC, "pred": PRED_TOPIC}
STREAM_TOPICS = frozenset(
    (*BLOCK_TOPICS.values(), CMP_TOPIC, HASH_TOPIC)
)  # published all through a run
LOCAL_SOCKET_PREFIX = "unixsock-stream/"  # inside a run, unreachable for other accounts
OBSERVER_PREFIX = "observer."  # begins the liveliness names of observers
# Sessions with keys; `session_limits` closes what is more. zenoh's own limit leaves room meanwhile.
MAX_SESSIONS_PER_PERSON = 8  # of those who may not command
MAX_OBSERVER_SESSIONS, MAX_COMMAND_SESSIONS = 40, 24
MAX_SESSIONS = MAX_OBSERVER_SESSIONS + MAX_COMMAND_SESSIONS
MAX_CLOSING_SESSIONS = 64
MAX_HALF_OPEN = 256  # connections that have not become a session
MAX_MESSAGE_BYTES = 64 * 2**10  # of messages from outside, attachment included
# Query rate limits per session: earlier queries are dropped. A client that waits for each reply
# (0.4 ms or more) must stay below the limit.
MAX_QUERY_HZ, MAX_COMMAND_HZ = 5000.0, 10.0
MAX_RATES_HZ = {
    "state/held": MAX_QUERY_HZ,
    "state/status": MAX_QUERY_HZ,
    "state/role/*": MAX_QUERY_HZ,
    **{f"config/{name}": MAX_QUERY_HZ for name in ("run", "profile", "rig", "model", "schema")},
    **{f"cmd/{order}/*": MAX_COMMAND_HZ for order in ("hold", "resume", "stop", "abort")},
}
# Limits of the public hub, enforced by zenoh: excess messages are dropped.
PUBLIC_HUB_SETTINGS: ZenohSettings = {
    "transport": {
        "unicast": {
            "max_sessions": MAX_SESSIONS + MAX_CLOSING_SESSIONS,
            "accept_pending": 2 * MAX_HALF_OPEN,
            "accept_timeout": 5000,
        },
        "link": {"rx": {"max_message_size": 2 * MAX_MESSAGE_BYTES}},
    },
    "low_pass_filter": [
        {
            "flows": ["ingress"],
            "messages": ["put", "delete", "query", "reply"],
            "key_exprs": ["**"],
            "size_limit": MAX_MESSAGE_BYTES,
        }
    ],
    "downsampling": [
        {
            "flows": ["ingress"],
            "messages": ["query"],
            "rules": [
                {"key_expr": f"shaketwin/*/{path}", "freq": rate_hz}
                for path, rate_hz in MAX_RATES_HZ.items()
            ],
        }
    ],
}


def check_endpoint(rig: str, endpoint: str, has_keys: bool) -> None:
    """Check a rig name and an endpoint; raise InputError if either is not allowed.

    Over a network only mutual TLS is allowed: tls/ and keys.
    """
    if not re.fullmatch(r"[\w.-]+", rig):
        raise InputError(
            "not a name for the bus",
            key="rig",
            value=rig,
            allowed="letters, digits and _ . -",
            remedy="change `name` in the rig file, or --table",
        )
    if endpoint.startswith(LOCAL_SOCKET_PREFIX) and not has_keys:
        return
    match = re.fullmatch(r"(tcp|tls)/(\[[0-9A-Fa-f:]+\]|[\w.-]+):(\d{1,5})", endpoint)
    if not match or not 0 < int(match[3]) < 2**16:
        raise make_endpoint_error(
            endpoint,
            "not understood",
            allowed="tcp/<host>:<port>, as tcp/127.0.0.1:7447, or with --keys FOLDER "
            "tls/<host>:<port>",
        )
    if match[1] == "tls" and not has_keys:
        raise make_endpoint_error(
            endpoint,
            "asks for certificates",
            "give yours with --keys FOLDER (the keeper of the rig's keys makes them: "
            "`shaketwin keys add`)",
        )
    if match[1] == "tcp" and has_keys:
        raise make_endpoint_error(endpoint, "tcp/ shows no certificate", "with --keys write tls/")
    if not has_keys and not re.fullmatch(r"127\.[\d.]+|localhost|\[::1\]", match[2]):
        raise make_endpoint_error(
            endpoint,
            "would go over the network, unprotected",
            allowed="this machine only, as tcp/127.0.0.1:7447, or with --keys FOLDER "
            "tls/<host>:<port>",
        )


def make_endpoint_error(
    endpoint: str, problem: str, remedy: str = "", *, allowed: str = ""
) -> InputError:
    """Return the error of an endpoint that cannot be used."""
    return InputError(problem, key="endpoint", value=endpoint, allowed=allowed, remedy=remedy)


def key_expression(rig: str, topic: str, *, offered: bool = False) -> str:
    """Return the bus key of a topic; with `offered` the key that only the gateway subscribes to."""
    if offered:
        return f"shaketwin/{rig}/offer{topic}"
    return f"shaketwin/{rig}/{'stream' if topic in STREAM_TOPICS else 'event'}{topic}"


def history_query_path(*, offered: bool) -> str:
    """Return the path of the history query, for published or `offered` topics."""
    return "state/offers" if offered else "state/held"


def sanitize_name(name: str) -> str:
    """Return a foreign name with characters that are unsafe on a terminal replaced by ?."""
    return re.sub(r"[^\w.-]", "?", name)[:100]


def list_runs(names: Iterable[str]) -> list[str]:
    """Return the run ids of the rigs among liveliness `names`; observers' names do not count."""
    rigs = (
        name for name in names if name.endswith(".rig") and not name.startswith(OBSERVER_PREFIX)
    )
    return sorted(name.removesuffix(".rig") for name in rigs)


def list_observers(names: Iterable[str]) -> list[str]:
    """Return the observers among liveliness `names`, sorted."""
    return sorted(name for name in names if name.startswith(OBSERVER_PREFIX))


def split_host_port(endpoint: str) -> tuple[str, int]:
    """Split a checked endpoint into (host, port), without brackets around an IPv6 address."""
    host, port = endpoint.partition("/")[2].rsplit(":", 1)
    return host.strip("[]"), int(port)


def check_can_listen(rig: str, endpoint: str, has_keys: bool) -> None:
    """Check an endpoint and that its port is free; raise InputError otherwise."""
    check_endpoint(rig, endpoint, has_keys)
    host, port = split_host_port(endpoint)
    try:
        socket.create_server((host, port), family=_address_family(host)).close()
    except OSError as error:
        raise make_listen_error(endpoint, error.strerror or str(error)) from None


def zenoh_error_reason(error: Exception) -> str:
    """Extract the innermost reason from a zenoh error message, without source locations."""
    reason = re.search(r"([A-Z][^\[\]:]*) \(os error", str(error))
    return reason[1] if reason else re.sub(r" at /\S+", "", str(error))


def make_listen_error(endpoint: str, reason: str) -> InputError:
    """Return the error of an endpoint at which listening failed."""
    return make_endpoint_error(
        endpoint,
        f"cannot listen there ({reason})",
        "end the run that uses the port, or give another port",
    )


def _address_family(host: str) -> socket.AddressFamily:
    return socket.AF_INET6 if ":" in host else socket.AF_INET


def session_settings(mode: str, action: str, endpoint: str, timeout_s: float) -> ZenohSettings:
    """Return zenoh settings of a session with one endpoint, no scouting, and dropping queues."""
    endpoint_settings = {
        "endpoints": [endpoint],
        "timeout_ms": round(timeout_s * 1000),
        "exit_on_failure": True,
    }
    if action == "connect":  # reconnect soon after the hub is back
        endpoint_settings["retry"] = {
            "period_init_ms": 200,
            "period_max_ms": 1000,
            "period_increase_factor": 2,
        }
    drop = {"wait_before_drop": 0, "max_wait_before_drop_fragments": 0}
    queue = {"congestion_control": {"drop": drop}, "size": {"data": 16}}
    return {
        "mode": mode,
        "listen": {"endpoints": []},
        "connect": {"endpoints": []},
        action: endpoint_settings,
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}, "link": {"tx": {"queue": queue}}},
    }


def router_settings(router: str) -> ZenohSettings:
    """Return zenoh settings that also connect a hub to a router, retrying for ever."""
    retry = {"period_init_ms": 500, "period_max_ms": 2000, "period_increase_factor": 2}
    return {
        "connect": {
            "endpoints": [router],
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": retry,
        }
    }


def merge_settings(settings: ZenohSettings, overrides: ZenohSettings) -> ZenohSettings:
    """Merge nested settings; values of `overrides` win."""
    combined = settings | overrides
    for key in settings.keys() & overrides.keys():
        if isinstance(settings[key], dict) and isinstance(overrides[key], dict):
            combined[key] = merge_settings(settings[key], overrides[key])
    return combined
