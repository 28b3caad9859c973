"""HTTP server of the web page: three static files, one stream of events, commands.

A thread per client, as the standard library has it. They share `PageFeed`, which holds the newest
sections only: a slow client skips to the newest, and is dropped once it takes nothing for
`CLIENT_TIMEOUT_S`. Nothing is queued, and nothing of a client reaches the rig but a command.
"""

import io
import json
import logging
import re
import socket
import ssl
import threading
from collections import defaultdict
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.client import HTTPException
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, NamedTuple

from table_io.acquisition.session import COMMAND_NAMES
from table_io.clock import RealClock
from table_io.errors import InputError
from twin.security.page_access import PageAccess

log = logging.getLogger(__name__)
PAGE_FOLDER = Path(__file__).parent / "page"
PAGE_FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}
MAX_CONNECTIONS, MAX_STREAMS = 64, 32
CLIENT_TIMEOUT_S = 5.0  # for a whole request, and for taking what is sent
MAX_REQUEST_BYTES = 2**16  # with its headers
SEND_BUFFER_BYTES = 2**16  # in the kernel, of one client
MAX_BODY_BYTES = 1024
DROP_TIMEOUT_S = 0.5  # for the place of a silent connection
WRONG_CODE_S = 1.0  # between answers to wrong codes from one address
MAX_WRONG_CODES = 16  # that wait for their answers, of all addresses; leaves connections free
POLL_S = 0.1  # within which the server ends
HEARTBEAT_S = 2.0  # between messages to a client when nothing changes
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self' data:; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class PageCommand(NamedTuple):
    """Command of a person to the run that the page shows."""

    name: str
    run: str
    user: str


class CommandAnswer(NamedTuple):
    """Answer to a command: HTTP status, and a message for the user."""

    status: int
    message: str


CommandHandler = Callable[[PageCommand], CommandAnswer]


class PageFeed:
    """Newest sections of the page, and the role that the gateway gives to its user."""

    def __init__(self) -> None:
        self.role = ""
        self._changed = threading.Condition()
        self._sections: Mapping[str, str] = {}
        self._version = 0
        self._is_closed = False

    def publish(self, sections: Mapping[str, str]) -> None:
        """Replace the sections and wake the clients."""
        with self._changed:
            self._sections, self._version = sections, self._version + 1
            self._changed.notify_all()

    def close(self) -> None:
        """End all streams."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def wait_for_change(
        self, version: int, timeout_s: float
    ) -> tuple[int, Mapping[str, str]] | None:
        """Return (version, sections) once newer than `version`, or after the time; None: closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._version != version or self._is_closed, timeout_s)
            if self._is_closed and self._version == version:
                return None
            return self._version, self._sections


class PageServer(ThreadingHTTPServer):
    """Server of one page at (host, port) for a limited number of clients."""

    daemon_threads = True
    request_queue_size = 2 * MAX_CONNECTIONS

    def __init__(
        self,
        host: str,
        port: int,
        access: PageAccess,
        feed: PageFeed,
        handle_command: CommandHandler,
    ) -> None:
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self.access, self.feed = access, feed
        self.handle_command = handle_command
        # One command of a person at a time: no other person's command waits for it.
        self.command_locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
        self.streams = threading.BoundedSemaphore(MAX_STREAMS)
        # By address: one wrong code at a time, whatever the number of connections.
        self.code_locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
        self.wrong_codes = threading.BoundedSemaphore(MAX_WRONG_CODES)
        self._connections = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._silent: dict[Any, socket.socket] = {}  # without a request so far, oldest first
        super().__init__((host.strip("[]"), port), PageRequest)

    def server_bind(self) -> None:
        """Bind without the look-up of a host name, which may take seconds."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), self.server_address[1]

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread; of too many, the oldest that is silent is closed."""
        if not self._connections.acquire(blocking=False):
            self._drop_silent()
            if not self._connections.acquire(timeout=DROP_TIMEOUT_S):
                log.info("connection refused: %d are open", MAX_CONNECTIONS)
                self.shutdown_request(request)
                return
        self._silent[client_address] = request
        super().process_request(request, client_address)

    def _drop_silent(self) -> None:
        """Close the oldest connection on which no request has come, which ends its thread."""
        for client_address in [*self._silent][:1]:
            log.info("connection from %s closed: silent, and too many are open", client_address)
            with suppress(OSError, KeyError):
                self._silent.pop(client_address).shutdown(socket.SHUT_RDWR)

    def note_request(self, client_address: Any) -> None:
        """Take a connection from the silent ones."""
        self._silent.pop(client_address, None)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Serve a connection and release its place."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.note_request(client_address)
            self._connections.release()

    def finish_request(self, request: Any, client_address: Any) -> None:
        """Serve one request, by TLS where the page has a certificate."""
        request.settimeout(CLIENT_TIMEOUT_S)
        request.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        if self.access.tls is None:
            PageRequest(request, client_address, self)
            return
        with self.access.tls.wrap_socket(request, server_side=True) as tls_request:
            PageRequest(tls_request, client_address, self)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Log the error of a connection; the others go on."""
        log.info("connection from %s ended", client_address, exc_info=True)


class RequestReader(io.RawIOBase):
    """Bytes of one request, at most `MAX_REQUEST_BYTES` and within `CLIENT_TIMEOUT_S` in all."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection, self._clock = connection, RealClock()
        self._deadline_s = self._clock.now() + CLIENT_TIMEOUT_S
        self._bytes_left = MAX_REQUEST_BYTES

    def readable(self) -> bool:
        """Return True."""
        return True

    def readinto(self, buffer: Any) -> int:
        """Read received bytes; raise TimeoutError or HTTPException beyond the limits."""
        seconds_left = self._deadline_s - self._clock.now()
        if seconds_left <= 0:
            raise TimeoutError("the request is incomplete")
        if self._bytes_left == 0:
            raise HTTPException("the request is too large")
        self._connection.settimeout(seconds_left)
        count = self._connection.recv_into(memoryview(buffer)[: self._bytes_left])
        self._connection.settimeout(CLIENT_TIMEOUT_S)
        self._bytes_left -= count
        return count


class PageRequest(BaseHTTPRequestHandler):
    """One request; the connection is closed after it."""

    server: PageServer
    server_version, sys_version = "shaketwin", ""

    def setup(self) -> None:
        """Limit size and duration of the request: each byte restarts the timeout of a socket."""
        super().setup()
        self.rfile = io.BufferedReader(RequestReader(self.connection))

    def parse_request(self) -> bool:
        """Parse the request, which takes the connection from the silent ones."""
        is_request = super().parse_request()
        self.server.note_request(self.client_address)
        return is_request

    def do_GET(self) -> None:
        """Send a file of the page, or the stream of events."""
        if not self._check_host():
            return
        if self.path == "/events":
            if user := self._identify():
                self._send_events(user)
        elif self.path in PAGE_FILES:
            name, content_type = PAGE_FILES[self.path]
            self._reply(200, (PAGE_FOLDER / name).read_bytes(), content_type)
        else:
            self._reply_message(404, "no such page")

    def do_POST(self) -> None:
        """Send a command of a person who may, asked by this page and no other."""
        body = self._read_body()  # first: closing a connection with unread data resets it
        if not self._check_host():
            return
        origin = f"{self.server.access.scheme}://{self.headers.get('Host')}"
        if self.path != "/command":
            self._reply_message(404, "no such page")
        elif self.headers.get("Origin") != origin:
            self._reply_message(403, "refused: sent by another page")
        elif self.headers.get_content_type() != "application/json":
            self._reply_message(415, "refused: not JSON")
        elif user := self._identify():
            command = _parse_command(body, user)
            if command is None:
                self._reply_message(400, f"not a command; allowed: {', '.join(COMMAND_NAMES)}")
                return
            with self.server.command_locks[user]:
                answer = self.server.handle_command(command)
            log.info("%s by %s: %d %s", command.name, user, *answer)
            self._reply_message(*answer)

    def _check_host(self) -> bool:
        """Return whether the page is addressed by its own name: other names are rebound."""
        if self.headers.get("Host", "").lower() in self.server.access.hosts:
            return True
        self._reply_message(421, "this page does not have that name")
        return False

    def _identify(self) -> str:
        """Return the name of the user, or "" after a refusal; a wrong code is logged and slowed."""
        user = self.server.access.identify(self._code)
        if not user and self._code:
            if not self.server.wrong_codes.acquire(blocking=False):
                self._reply_message(429, "too many wrong access codes wait for their answers")
                return ""
            try:
                host = str(self.client_address[0])
                log.warning("wrong access code from %s", host)
                with self.server.code_locks[host]:
                    clock = RealClock()
                    clock.wait_until(clock.now() + WRONG_CODE_S)
            finally:
                self.server.wrong_codes.release()
        if not user:
            self._reply_message(401, "log in with your access code")
        return user

    @property
    def _code(self) -> str:
        return self.headers.get("Authorization", "").removeprefix("Bearer ")

    def _read_body(self) -> bytes:
        """Return the body, b"" if its length is not stated or not allowed."""
        length = self.headers.get("Content-Length", "0")
        if length.isascii() and length.isdigit() and int(length) <= MAX_BODY_BYTES:
            return self.rfile.read(int(length))
        self.rfile.read1(MAX_BODY_BYTES)
        return b""

    def _send_events(self, user: str) -> None:
        """Send sections as they change, until the client leaves, stalls or loses its access."""
        if not self.server.streams.acquire(blocking=False):
            self._reply_message(503, f"{MAX_STREAMS} pages are open already")
            return
        try:
            self._send_head(200, "text/event-stream; charset=utf-8")
            self._stream_sections(user)
        except (OSError, ssl.SSLError) as error:
            log.info("page of %s ended: %s", user, error or type(error).__name__)
        finally:
            self.server.streams.release()

    def _stream_sections(self, user: str) -> None:
        access, feed, clock = self.server.access, self.server.feed, RealClock()
        sent: Mapping[str, str] = {}
        version, checked_s, role = -1, float("-inf"), ""
        while (news := feed.wait_for_change(version, HEARTBEAT_S)) is not None:
            if clock.now() > checked_s + HEARTBEAT_S:
                checked_s = clock.now()
                if access.identify(self._code) != user:
                    return
                role = access.role_of(user) if access.role_of is not None else ""
            identity = {"name": user, "role": role or feed.role}
            version, sections = news[0], {**news[1], "user": json.dumps(identity)}
            changed = [name for name, text in sections.items() if sent.get(name) != text]
            messages = [f"event: {name}\ndata: {sections[name]}\n\n" for name in changed]
            self.wfile.write("".join(messages or [":\n\n"]).encode())
            sent = sections

    def _reply_message(self, status: int, message: str) -> None:
        body = json.dumps({"message": message}).encode()
        self._reply(status, body, "application/json; charset=utf-8")

    def _reply(self, status: int, body: bytes, content_type: str) -> None:
        self._send_head(status, content_type, len(body))
        self.wfile.write(body)

    def _send_head(self, status: int, content_type: str, length: int | None = None) -> None:
        self.send_response(status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", content_type)
        if length is not None:
            self.send_header("Content-Length", str(length))
        self.end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Log at the level of details, control characters escaped; an address holds no secret."""
        log.debug("%a", format % args)


def _parse_command(body: bytes, user: str) -> PageCommand | None:
    """Return the command in a JSON body, None if it is none."""
    try:
        request = json.loads(body)
        name, run = request["command"], request["run"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    if name not in COMMAND_NAMES or not isinstance(run, str):
        return None
    return PageCommand(name, run, user) if re.fullmatch(r"\w[\w.-]{0,100}", run) else None


def open_page_server(
    host: str, port: int, access: PageAccess, feed: PageFeed, handle_command: CommandHandler
) -> PageServer:
    """Open the server and serve in a thread; raise InputError if the address is not free."""
    try:
        server = PageServer(host, port, access, feed, handle_command)
    except OSError as error:
        raise InputError(
            f"cannot listen there ({error.strerror or error})",
            key="--web-listen",
            value=f"{host}:{port}",
            remedy="give another port",
        ) from None
    threading.Thread(target=server.serve_forever, args=(POLL_S,), daemon=True).start()
    return server
