"""TLS diagnostics: why a rig refused the connection, found by a handshake with the same keys.

zenoh reports only that a session could not be opened; the TLS error is visible only at the socket.
A server certificate that does not verify fails here; a client certificate fails at the server and
comes back as a TLS alert after the handshake.
"""

import socket
import ssl
from collections.abc import Callable
from pathlib import Path

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
NO_TLS_MESSAGE = (
    "the server there does not speak TLS: a run without keys, or no rig; write tcp/ for a run on "
    "this machine, or start the run with --keys"
)
TOO_MANY_SESSIONS_MESSAGE = (
    "the rig accepts your certificate but opens no session: too many are connected; try again"
)
NO_IPV6_MESSAGE = "zenoh's TLS takes names and IPv4 addresses only; give a name of that computer"


def diagnose_refusal(host: str, port: int, keys: Credentials | None) -> str:
    """Return the reason of a refusal with a remedy, or "" if retrying may succeed."""
    try:
        tcp_socket = socket.create_connection((host, port), CONNECT_TIMEOUT_S)
    except OSError as error:
        return _describe_unreachable(error)
    with tcp_socket:
        return _diagnose_tcp(tcp_socket) if keys is None else _diagnose_tls(tcp_socket, host, keys)


def _diagnose_tls(tcp_socket: socket.socket, host: str, keys: Credentials) -> str:
    """Return why the mutual TLS handshake with these keys fails, or ""."""
    context = create_tls_context(keys.folder, ssl.PROTOCOL_TLS_CLIENT)
    try:
        tls_socket = context.wrap_socket(tcp_socket, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _describe_rejected_rig(error, host, keys.folder)
    except OSError as error:
        return _describe_alert(error, keys.name) or NO_TLS_MESSAGE
    with tls_socket:
        try:
            tls_socket.recv(1)
        except TimeoutError:  # accepted: the server waits for data
            return NO_IPV6_MESSAGE if ":" in host else TOO_MANY_SESSIONS_MESSAGE
        except OSError as error:
            return _describe_alert(error, keys.name)
    return ""


def _describe_alert(error: OSError, name: str) -> str:
    """Return the meaning of a TLS alert, or "" if the error is not an alert."""
    reason = getattr(error, "reason", None) or ""
    if "ALERT" not in reason:
        return ""
    why = next((why for alert, why in ALERTS.items() if alert in reason), reason)
    return f"your certificate ({name}) is refused: {why}; {ASK_FOR_KEYS}"


def _diagnose_tcp(tcp_socket: socket.socket) -> str:
    """Return a hint if the server speaks TLS (certificate or alert), or ""."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        context.wrap_socket(tcp_socket).close()
    except OSError as error:
        if not _describe_alert(error, ""):
            return ""
    return (
        "the rig there takes only people with keys; write tls/ instead of tcp/ and give yours with "
        f"--keys FOLDER, or {ASK_FOR_KEYS}"
    )


def _describe_rejected_rig(error: ssl.SSLCertVerificationError, host: str, folder: Path) -> str:
    if error.verify_code in (CERTIFICATE_EXPIRED_CODE, CERTIFICATE_NOT_YET_VALID_CODE):
        return (
            "the rig's certificate has expired or is not yet valid by this computer's clock; check "
            "the clock, or renew it: `shaketwin keys renew` at the rig"
        )
    if error.verify_code in NAME_MISMATCH_CODES:
        return (
            f"the rig's certificate is not for {host}; connect by a name or address in it, or run "
            f"at the rig: `shaketwin keys renew FOLDER --host {host}`"
        )
    if error.verify_code == WRONG_PURPOSE_CODE:
        return (
            "the server shows a person's certificate, not a rig's: it may be an attacker; do not "
            "trust it"
        )
    return (
        f"the rig's certificate is not from the authority in {folder / AUTHORITY_FILE} "
        f"({error.verify_message}): another laboratory's, or an attacker's; {ASK_FOR_KEYS}"
    )


def _describe_unreachable(error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return "no host of that name is known; check the name"
    if isinstance(error, TimeoutError):
        return "the host does not answer; check that it is on and that its firewall opens the port"
    if isinstance(error, ConnectionRefusedError):
        return ""  # not running yet
    return f"network error: {error.strerror or error}"


def diagnose_missing_role(query: Callable[[str], bytes | None], name: str, rig: str) -> str:
    """Return why a rig that accepted the certificate does not answer, or "" if it does."""

    def has_answer(name: str) -> bool:
        for attempt in range(MAX_QUERY_ATTEMPTS):
            CLOCK.wait_until(CLOCK.now() + attempt * QUERY_PAUSE_S)
            if query(f"state/role/{name}") is not None:
                return True
        return False

    if has_answer(name):
        return ""
    CLOCK.wait_until(CLOCK.now() + QUERY_PAUSE_S)
    if has_answer(NO_ROLE):
        return (
            f"your certificate is good, but {name} is not in the rig's access list, or was removed "
            f"from it; {ASK_FOR_KEYS}"
        )
    return f"no rig called {rig!r} answers there; give the name of the rig with --rig"
