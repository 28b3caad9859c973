"""Every way not to be let in, tried on real sessions, and what is said: a table for the note.

python -m tests.studies.tls_refusals
"""

import contextlib
import io
import socket
import ssl
import tempfile
from pathlib import Path

import zenoh

from table_io.errors import InputError
from tests.security.laboratory import RIG, session
from tests.security.test_tls_diagnostics import REFUSED, SHORT_S, Doors, standing
from twin.live.control import send_command
from twin.transport.endpoint import split_host_port
from twin.transport.zenoh_link import open_spoke


def main() -> None:
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        with contextlib.redirect_stdout(io.StringIO()):
            doors = stack.enter_context(standing(Path(name)))
        print("| access | what is said |\n|---|---|")
        for what, (where, whose, _) in REFUSED.items():
            try:
                open_spoke(RIG, where(doors), SHORT_S, whose(doors)).close()
                row(what, "LET IN", doors)
            except InputError as error:
                row(what, str(error), doors)
        for who in ("bob", "rec", "tina", "anna"):
            stream = io.StringIO()
            try:
                with contextlib.redirect_stdout(stream):
                    send_command("stop", "", doors.keyed, RIG, doors.keys(who))
                row(f"`tell stop` by {who}", "obeyed", doors)
            except InputError as error:
                row(f"`tell stop` by {who}", str(error), doors)
        tls = {"root_ca_certificate": str(doors.lab / "ca.pem")}
        try:
            session(doors.keyed, {"transport": {"link": {"tls": tls}}}, SHORT_S).close()
            row("zenoh, no certificate", "LET IN", doors)
        except zenoh.ZError as error:
            row("zenoh, no certificate", str(error).split(" at /")[0], doors)
        context = ssl.create_default_context(cafile=doors.lab / "ca.pem")
        address = split_host_port(doors.keyed)
        with (
            socket.create_connection(address) as plain,
            context.wrap_socket(plain, server_hostname=address[0]) as secure,
        ):
            try:
                row("TLS, no certificate", f"LET IN, {secure.recv(1)!r}", doors)
            except ssl.SSLError as error:
                row("TLS, no certificate", str(error.reason), doors)


def row(what: str, text: str, doors: Doors) -> None:
    print(f"| {what} | {text.replace(str(doors.folder), '...')} |", flush=True)


if __name__ == "__main__":
    main()
