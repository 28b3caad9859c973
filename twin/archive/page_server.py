"""Local page of runs on which notes and tags are edited: a file cannot write, its server can.

It listens on this machine alone, under an address with a secret in it that other pages and users
do not know, and writes notes of the runs that it lists, nothing else.
"""

import json
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated
from urllib.parse import unquote

from pydantic import BaseModel, ConfigDict, StringConstraints, ValidationError

from table_io.errors import InputError
from twin.archive.notes import note_run, read_notes
from twin.archive.page import render_run_index
from twin.archive.query import index_runs

HOST = "127.0.0.1"
CLIENT_TIMEOUT_S = 5.0
POLL_S = 0.1  # within which the server ends
MAX_NOTE_CHARS, MAX_BODY_BYTES = 10_000, 2**17
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; connect-src 'self'; img-src data:; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}
Text = Annotated[str, StringConstraints(max_length=MAX_NOTE_CHARS)]


class NoteChange(BaseModel):
    """What a page asks for: a note in place of another one, tags to add and to remove."""

    model_config = ConfigDict(extra="forbid", strict=True)
    folder: Text
    before: Text
    note: Text
    tags: list[Text]
    untag: list[Text]


class RunsServer(ThreadingHTTPServer):
    """Server of the index page of the runs in a folder."""

    daemon_threads = True

    def __init__(self, folder: Path, where: str | None) -> None:
        self.folder, self.where = folder, where
        self.secret = secrets.token_urlsafe(16)
        self.note_lock = threading.Lock()
        super().__init__((HOST, 0), RunsRequest)

    def server_bind(self) -> None:
        """Bind without the look-up of a host name, which may take seconds."""
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = HOST, self.socket.getsockname()[1]

    @property
    def address(self) -> str:
        return f"http://{HOST}:{self.server_port}/{self.secret}/"

    def render(self, path: str) -> bytes | None:
        """Return the page of the runs as they are now, or the report of one; None for no page."""
        rows = index_runs(self.folder, self.where)
        if path == "":
            text = render_run_index(rows, self.folder, self.where or "", is_served=True)
            return text.encode()
        name = unquote(path.removeprefix("report?"))
        report = self.folder / name / "report.html"
        is_listed = any(row.folder == name for row in rows)
        return report.read_bytes() if is_listed and report.is_file() else None

    def change_note(self, change: NoteChange) -> dict[str, object]:
        """Change note and tags of a run; InputError if it is not listed, or was noted on since."""
        folder = self.folder / change.folder
        with self.note_lock:
            if all(row.folder != change.folder for row in index_runs(self.folder, self.where)):
                raise InputError("this run is not listed", where=folder)
            if read_notes(folder).note != change.before:
                raise InputError("noted on since the page was loaded: load it again", where=folder)
            text = change.note if change.note != change.before else None
            notes = note_run(folder, text, tuple(change.tags), tuple(change.untag))
        return {"note": notes.note, "tags": [*notes.tags]}


class RunsRequest(BaseHTTPRequestHandler):
    """One request; the connection is closed after it."""

    server: RunsServer
    server_version, sys_version = "shaketwin", ""
    timeout = CLIENT_TIMEOUT_S

    def do_GET(self) -> None:
        """Send the page of the runs, or the report of one."""
        page = self.server.render(self._path) if self._check_address() else None
        if page is None:
            self._reply(404, b"no such page", "text/plain")
        else:
            self._reply(200, page, "text/html; charset=utf-8")

    def do_POST(self) -> None:
        """Change note and tags of a run, asked by this page and no other."""
        length = self.headers.get("Content-Length", "")
        is_bounded = length.isascii() and length.isdigit() and int(length) <= MAX_BODY_BYTES
        body = self.rfile.read(int(length)) if is_bounded else b""
        origin = f"http://{HOST}:{self.server.server_port}"
        is_ours = self.headers.get("Origin") == origin and self._check_address()
        if not is_ours or self._path != "note":
            self._reply(404, b"no such page", "text/plain")
            return
        try:
            answer = self.server.change_note(NoteChange.model_validate_json(body))
        except ValidationError as error:
            self._reply(400, str(error).encode(), "text/plain; charset=utf-8")
        except (InputError, OSError) as error:
            self._reply(409, str(error).encode(), "text/plain; charset=utf-8")
        else:
            self._reply(200, json.dumps(answer).encode(), "application/json")

    @property
    def _path(self) -> str:
        return self.path.removeprefix(f"/{self.server.secret}/")

    def _check_address(self) -> bool:
        """Return whether the request has the secret, and a name that was not rebound."""
        has_secret = self.path.startswith(f"/{self.server.secret}/")
        return has_secret and self.headers.get("Host") == f"{HOST}:{self.server.server_port}"

    def _reply(self, status: int, body: bytes, content_type: str) -> None:
        self.send_response(status)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", content_type)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing: an address holds the secret."""


@contextmanager
def serve_runs(folder: Path, where: str | None) -> Iterator[str]:
    """Serve the page of the runs in a folder while the body runs; yield its address.

    InputError if the folder or the expression is faulty.
    """
    index_runs(folder, where)
    with RunsServer(folder, where) as server:
        threading.Thread(target=server.serve_forever, args=(POLL_S,), daemon=True).start()
        try:
            yield server.address
        finally:
            server.shutdown()
