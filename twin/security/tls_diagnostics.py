"""TLS diagnostics: why a rig refused the connection, found by a handshake with the same keys.

zenoh reports only that a session could not be opened; the TLS error is visible only at the socket.
A server certificate that does not verify fails here; a client certificate fails at the server and
comes back as a TLS alert after the handshake.
"""

import socket
import ssl
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from table_io.clock import RealClock
from twin.security.access_control import NO_ROLE
from twin.security.credentials import AUTHORITY_FILE, Credentials, create_tls_context

MAX_QUERY_ATTEMPTS, QUERY_PAUSE_S = 3, 0.03  # rate limiting drops queries in quick succession
CONNECT_TIMEOUT_S = 1.0  # also for the alert of the other end
CERTIFICATE_EXPIRED_CODE, CERTIFICATE_NOT_YET_VALID_CODE = 10, 9  # OpenSSL's X509_V_ERR_...
NAME_MISMATCH_CODES = (62, 64)  # host name, IP address
WRONG_PURPOSE_CODE = 26
ALERTS = {
    "UNKNOWN_CA": "the rig does not know the authority that issued it",
    "DECRYPT_ERROR": "it is forged: the rig's authority did not sign it",
    "CERTIFICATE_EXPIRED": "it has expired by the rig's clock; compare the clocks",
    "CERTIFICATE_UNKNOWN": "the rig's authority has not issued it",
    "CERTIFICATE_REQUIRED": "the rig asks for one and got none",
}
ASK_FOR_KEYS = "ask the keeper of the rig's keys (`shaketwin keys`) for yours"
CLOCK = RealClock()


class ConnectionProblem(NamedTuple):
    """Why a connection was refused, and what the user can do."""

    problem: str
    remedy: str


NO_TLS = ConnectionProblem(
    "the server there does not speak TLS: a run without keys, or no rig",
    "write tcp/ for a run on this machine, or start the run with --keys",
)
TOO_MANY_SESSIONS = ConnectionProblem(
    "the rig accepts your certificate but opens no session: too many are connected", "try again"
)
NO_IPV6 = ConnectionProblem(
    "zenoh's TLS takes names and IPv4 addresses only", "give a name of that computer"
)


def diagnose_refusal(host: str, port: int, keys: Credentials | None) -> ConnectionProblem | None:
    """Return the reason of a refusal with a remedy, or None if retrying may succeed."""
    try:
        tcp_socket = socket.create_connection((host, port), CONNECT_TIMEOUT_S)
    except OSError as error:
        return _describe_unreachable(error)
    with tcp_socket:
        return _diagnose_tcp(tcp_socket) if keys is None else _diagnose_tls(tcp_socket, host, keys)


def _diagnose_tls(
    tcp_socket: socket.socket, host: str, keys: Credentials
) -> ConnectionProblem | None:
    """Return why the mutual TLS handshake with these keys fails, or None."""
    context = create_tls_context(keys.folder, ssl.PROTOCOL_TLS_CLIENT)
    try:
        tls_socket = context.wrap_socket(tcp_socket, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _describe_rejected_rig(error, host, keys.folder)
    except OSError as error:
        return _describe_alert(error, keys.name) or NO_TLS
    with tls_socket:
        try:
            tls_socket.recv(1)
        except TimeoutError:  # accepted: the server waits for data
            return NO_IPV6 if ":" in host else TOO_MANY_SESSIONS
        except OSError as error:
            return _describe_alert(error, keys.name)
    return None


def _describe_alert(error: OSError, name: str) -> ConnectionProblem | None:
    """Return the meaning of a TLS alert, or None if the error is not an alert."""
    reason = getattr(error, "reason", None) or ""
    if "ALERT" not in reason:
        return None
    why = next((why for alert, why in ALERTS.items() if alert in reason), reason)
    return ConnectionProblem(f"your certificate ({name}) is refused: {why}", ASK_FOR_KEYS)


def _diagnose_tcp(tcp_socket: socket.socket) -> ConnectionProblem | None:
    """Return a hint if the server speaks TLS (certificate or alert), or None."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        context.wrap_socket(tcp_socket).close()
    except OSError as error:
        if not _describe_alert(error, ""):
            return None
    return ConnectionProblem(
        "the rig there takes only people with keys",
        f"write tls/ instead of tcp/ and give your keys with --keys FOLDER, or {ASK_FOR_KEYS}",
    )


def _describe_rejected_rig(
    error: ssl.SSLCertVerificationError, host: str, folder: Path
) -> ConnectionProblem:
    if error.verify_code in (CERTIFICATE_EXPIRED_CODE, CERTIFICATE_NOT_YET_VALID_CODE):
        return ConnectionProblem(
            "the rig's certificate has expired or is not yet valid by this computer's clock",
            "check the clock, or renew it: `shaketwin keys renew` at the rig",
        )
    if error.verify_code in NAME_MISMATCH_CODES:
        return ConnectionProblem(
            f"the rig's certificate is not for {host}",
            "connect by a name or address in it, or run at the rig: "
            f"`shaketwin keys renew FOLDER --host {host}`",
        )
    if error.verify_code == WRONG_PURPOSE_CODE:
        return ConnectionProblem(
            "the server shows a person's certificate, not a rig's: it may be an attacker",
            "do not trust it",
        )
    return ConnectionProblem(
        f"the rig's certificate is not from the authority in {folder / AUTHORITY_FILE} "
        f"({error.verify_message}): another laboratory's, or an attacker's",
        ASK_FOR_KEYS,
    )


def _describe_unreachable(error: OSError) -> ConnectionProblem | None:
    if isinstance(error, socket.gaierror):
        return ConnectionProblem("no host of that name is known", "check the name")
    if isinstance(error, TimeoutError):
        return ConnectionProblem(
            "the host does not answer", "check that it is on and that its firewall opens the port"
        )
    if isinstance(error, ConnectionRefusedError):
        return None  # not running yet
    return ConnectionProblem(f"network error: {error.strerror or error}", "check the network")


def diagnose_missing_role(
    query: Callable[[str], bytes | None], name: str, rig: str
) -> ConnectionProblem | None:
    """Return why a rig that accepted the certificate does not answer, or None if it does."""

    def has_answer(name: str) -> bool:
        for attempt in range(MAX_QUERY_ATTEMPTS):
            CLOCK.wait_until(CLOCK.now() + attempt * QUERY_PAUSE_S)
            if query(f"state/role/{name}") is not None:
                return True
        return False

    if has_answer(name):
        return None
    CLOCK.wait_until(CLOCK.now() + QUERY_PAUSE_S)
    if has_answer(NO_ROLE):
        return ConnectionProblem(
            f"your certificate is good, but {name} is not in the rig's access list, or was removed "
            "from it",
            ASK_FOR_KEYS,
        )
    return ConnectionProblem(
        f"no rig called {rig!r} answers there", "give the name of the rig with --table"
    )
