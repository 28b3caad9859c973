"""Why a rig did not let us in, in words: a handshake by the standard library, with the same keys.

zenoh says only that a session could not be opened. TLS says why, but to whoever holds the socket:
a server's certificate that does not verify fails here, a client's fails there and comes back as an
alert after the handshake.
"""

import socket
import ssl
from collections.abc import Callable
from pathlib import Path

from table_io.clock import RealClock
from twin.stream.access import NOBODY
from twin.stream.keys import AUTHORITY, Keys, own_context

TRIES, PAUSE_S = 3, 0.03  # a question that comes too soon after another one is dropped
LOOK_S = 1.0  # in which the other end says what it has against us
EXPIRED, NOT_YET = 10, 9  # of OpenSSL's X509_V_ERR_...
WRONG_NAME = (62, 64)  # a host name, an address
WRONG_PURPOSE = 26
ALERTS = {
    "UNKNOWN_CA": "the rig does not know the authority that issued it",
    "DECRYPT_ERROR": "it is forged: the rig's authority did not sign it",
    "CERTIFICATE_EXPIRED": "the rig says that it has expired; compare the clocks",
    "CERTIFICATE_UNKNOWN": "it is none that the rig's authority has issued",
    "CERTIFICATE_REQUIRED": "the rig asks for one and got none",
}
ASK = "ask whoever keeps the rig's keys (`shaketwin keys`) for yours"
CLOCK = RealClock()
NO_TLS = (
    "what answers there does not speak TLS: a run without keys, or no rig; write tcp/ for a run on "
    "this machine, or start the run with --keys"
)
FULL = "it takes your certificate but begins no session: too many are connected; try again"
NO_NUMBERS = "zenoh's TLS takes names and IPv4 addresses only; give a name of that machine"


def refusal(host: str, port: int, keys: Keys | None) -> str:
    """What is wrong and what to do about it; "" where nothing speaks against another attempt."""
    try:
        plain = socket.create_connection((host, port), LOOK_S)
    except OSError as error:
        return _unreachable(error)
    with plain:
        return _plain(plain) if keys is None else _secure(plain, host, keys)


def _secure(plain: socket.socket, host: str, keys: Keys) -> str:
    """What the rig has against these keys, or they against the rig."""
    context = own_context(keys.folder, ssl.PROTOCOL_TLS_CLIENT)
    try:
        secure = context.wrap_socket(plain, server_hostname=host)
    except ssl.SSLCertVerificationError as error:
        return _rig_refused(error, host, keys.folder)
    except OSError as error:
        return _alert(error, keys.name) or NO_TLS
    with secure:
        try:
            secure.recv(1)
        except TimeoutError:  # it took us, and waits for us
            return NO_NUMBERS if ":" in host else FULL
        except OSError as error:
            return _alert(error, keys.name)
    return ""


def _alert(error: OSError, name: str) -> str:
    """What is meant by an alert of TLS; "" where the error is none."""
    reason = getattr(error, "reason", None) or ""
    if "ALERT" not in reason:
        return ""
    why = next((why for alert, why in ALERTS.items() if alert in reason), reason)
    return f"your certificate ({name}) is refused: {why}; {ASK}"


def _plain(plain: socket.socket) -> str:
    """Whether what answers there is TLS: then it shows a certificate, or an alert."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE
    try:
        context.wrap_socket(plain).close()
    except OSError as error:
        if not _alert(error, ""):
            return ""
    return (
        "the rig there takes only people with keys; write tls/ instead of tcp/ and give yours with "
        f"--keys FOLDER, or {ASK}"
    )


def _rig_refused(error: ssl.SSLCertVerificationError, host: str, folder: Path) -> str:
    if error.verify_code in (EXPIRED, NOT_YET):
        return (
            "the rig's certificate has expired or is not good yet by this machine's clock; check "
            "the clock, or renew it: `shaketwin keys renew` at the rig"
        )
    if error.verify_code in WRONG_NAME:
        return (
            f"the rig's certificate is not for {host}; connect by a name or address that it has, "
            f"or at the rig: `shaketwin keys renew FOLDER --host {host}`"
        )
    if error.verify_code == WRONG_PURPOSE:
        return (
            "it shows a person's certificate, not a rig's: somebody stands there; do not trust it"
        )
    return (
        f"the rig's certificate is not from the authority in {folder / AUTHORITY} "
        f"({error.verify_message}): another laboratory's, or somebody in between; {ASK}"
    )


def _unreachable(error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return "no machine of that name is known; check the name"
    if isinstance(error, TimeoutError):
        return "the machine does not answer; is it on, does its firewall let the port through?"
    if isinstance(error, ConnectionRefusedError):
        return ""  # nobody there
    return f"the network says: {error.strerror or error}"


def unlisted(inquire: Callable[[str], bytes | None], name: str, rig: str) -> str:
    """Why nothing is heard of a rig that let us in; "" where we have a role there."""

    def answered(who: str) -> bool:
        for attempt in range(TRIES):
            CLOCK.wait_until(CLOCK.now() + attempt * PAUSE_S)
            if inquire(f"state/role/{who}") is not None:
                return True
        return False

    if answered(name):
        return ""
    CLOCK.wait_until(CLOCK.now() + PAUSE_S)
    if answered(NOBODY):
        return (
            f"your certificate is good, but {name} is not in the rig's access list, or was removed "
            f"from it; {ASK}"
        )
    return f"nothing called {rig!r} is there; give the name of the rig with --rig"
