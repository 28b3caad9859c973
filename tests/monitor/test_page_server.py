"""The page's server over its protocol: who gets what, and what an attacker or a slow one gets."""

import http.client
import json
import logging
import re
import socket
import ssl
import stat
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from datetime import timedelta
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from table_io.clock import local_datetime
from tests.builders.ports import free_port
from tests.input_errors import raises_input_error
from tests.security.laboratory import RIG, RUN, door, laboratory, own
from twin.monitor import page_server
from twin.monitor.page_server import (
    PAGE_FILES,
    PAGE_FOLDER,
    CommandAnswer,
    PageCommand,
    PageFeed,
    PageServer,
    open_page_server,
)
from twin.monitor.web import (
    PageRequestConfig,
    choose_page_address,
    format_page_url,
    submit_page_command,
)
from twin.rig.keys import issue_code, remove_person, renew_keys
from twin.security import page_access
from twin.security.access_control import user_name
from twin.security.credentials import read_credentials
from twin.security.page_access import grant_page_access, hash_code, identify_person

PATIENCE_S = 10.0


@dataclass
class Served:
    """A page that is served, and the commands that reached its handler."""

    port: int
    feed: PageFeed
    server: PageServer
    tls: ssl.SSLContext | None
    source: str = "127.0.0.1"  # address of the client
    commands: list[PageCommand] = field(default_factory=list)
    open: ExitStack = field(default_factory=ExitStack)

    def connect(self) -> http.client.HTTPConnection:
        place: dict[str, Any] = {
            "port": self.port,
            "timeout": PATIENCE_S,
            "source_address": (self.source, 0),
        }
        connection = (
            http.client.HTTPConnection("127.0.0.1", **place)
            if self.tls is None
            else http.client.HTTPSConnection("127.0.0.1", context=self.tls, **place)
        )
        self.open.callback(connection.close)
        return connection

    def get(self, path: str = "/", **headers: str) -> http.client.HTTPResponse:
        connection = self.connect()
        connection.request("GET", path, headers=headers)
        return self.open.enter_context(connection.getresponse())

    def post(self, body: bytes, **headers: str) -> tuple[int, str]:
        """POST a command as the page does, or with other headers; status and message."""
        connection = self.connect()
        scheme = "http" if self.tls is None else "https"
        usual = {"Content-Type": "application/json", "Origin": f"{scheme}://127.0.0.1:{self.port}"}
        changed = {name.replace("_", "-"): value for name, value in headers.items()}
        connection.request("POST", "/command", body, usual | changed)
        with connection.getresponse() as answer:
            return answer.status, json.loads(answer.read())["message"]


def as_person(code: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {code}"}


@contextmanager
def serving(keys: Path | None = None, answer: int = 200) -> Iterator[Served]:
    port, feed = free_port(), PageFeed()
    credentials = None if keys is None else read_credentials(keys)
    access = grant_page_access("127.0.0.1", port, credentials)

    def note(command: PageCommand) -> CommandAnswer:
        served.commands.append(command)
        return CommandAnswer(answer, f"{command.name} answered")

    server = open_page_server("127.0.0.1", port, access, feed, note)
    tls = None if access.tls is None else ssl.create_default_context(cafile=str(keys) + "/ca.pem")
    served = Served(port, feed, server, tls)
    try:
        with served.open:
            yield served
    finally:
        feed.close()
        server.shutdown()
        server.server_close()


@pytest.fixture
def page() -> Iterator[Served]:
    with serving() as served:
        yield served


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return laboratory(tmp_path_factory.mktemp("keys") / "lab")


def new_code(lab: Path, name: str, capsys: pytest.CaptureFixture[str], page: str = "") -> str:
    issue_code(lab, name, page)
    match = re.search(r"\b[a-z2-7]{4}(-[a-z2-7]{4}){5}\b", capsys.readouterr().out)
    assert match is not None
    return match[0]


def read_event(answer: http.client.HTTPResponse) -> tuple[str, Any]:
    """The next event of a stream, without heartbeats."""
    while not (line := answer.readline().decode()).startswith("event: "):
        assert line, "the stream has ended"
    return line[7:].strip(), json.loads(answer.readline().removeprefix(b"data: "))


def is_served(page: Served) -> bool:
    """Whether a request has an answer."""
    try:
        return page.get("/").status == 200
    except (ConnectionError, http.client.HTTPException):
        return False


def is_served_soon(page: Served) -> bool:
    """Whether a request has an answer, when the last one has given up its place."""
    for _ in range(20):
        if is_served(page):
            return True
        time.sleep(0.05)
    return False


def is_over(answer: http.client.HTTPResponse) -> bool:
    """Read a stream to its end."""
    while answer.readline():
        pass
    return True


def test_page_files_need_no_other_origin(page: Served) -> None:
    for path, (name, content_type) in PAGE_FILES.items():
        answer = page.get(path)
        assert (answer.status, answer.getheader("Content-Type")) == (200, content_type)
        assert answer.read() == (PAGE_FOLDER / name).read_bytes()
        policy = answer.getheader("Content-Security-Policy") or ""
        assert "default-src 'none'" in policy
        assert "unsafe" not in policy
        assert answer.getheader("Cache-Control") == "no-store"
    sources = "".join((PAGE_FOLDER / name).read_text() for name, _ in PAGE_FILES.values())
    assert not re.search(
        r"https?://(?!\$)|innerHTML|insertAdjacentHTML|document\.write|eval\(", sources
    )
    markup = (PAGE_FOLDER / "index.html").read_text()
    assert not re.search(r"<style|<script>|\son\w+=|style=", markup)


@pytest.mark.parametrize("path", ["/../page_server.py", "/page/index.html", "/events/", "/%2e%2e"])
def test_unknown_path_is_not_found(page: Served, path: str) -> None:
    assert page.get(path).status == 404


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", ""]
)
@pytest.mark.parametrize("path", ["/", "/events"])
def test_foreign_host_header_is_refused(page: Served, host: str, path: str) -> None:
    assert page.get(path, Host=host.format(port=page.port)).status == 421
    assert page.post(b"{}", Host=host.format(port=page.port))[0] == 421


@pytest.mark.parametrize(
    ("host", "port", "header"),
    [
        ("127.0.0.1", 7480, "localhost:7480"),
        ("127.0.0.2", 7480, "127.0.0.2:7480"),
        ("[::1]", 7480, "[::1]:7480"),
        ("127.0.0.1", 80, "127.0.0.1"),  # the port of the scheme is not sent
    ],
)
def test_host_headers_of_browsers_are_accepted(host: str, port: int, header: str) -> None:
    assert header in grant_page_access(host, port, None).hosts


def test_a_certificate_names_the_page_as_a_browser_does(tmp_path: Path) -> None:
    lab = laboratory(tmp_path / "lab")
    renew_keys(lab, None, ["Rig.lab.example"])
    keys = read_credentials(lab)
    assert "rig.lab.example" in grant_page_access("0.0.0.0", 443, keys).hosts
    names = grant_page_access("0.0.0.0", 7480, keys).hosts
    assert "rig.lab.example:7480" in names
    assert "rig.lab.example" not in names


def test_the_stream_has_all_sections_first_and_then_what_changed(page: Served) -> None:
    page.feed.publish({"state": '{"a":1}', "prc": '{"count":0}'})
    page.feed.role = "command"
    stream = page.get("/events")
    assert stream.getheader("Content-Type") == "text/event-stream; charset=utf-8"
    first = dict(read_event(stream) for _ in range(3))
    assert first["state"] == {"a": 1}
    assert first["user"] == {"name": user_name(None), "role": "command"}
    page.feed.publish({"state": '{"a":1}', "prc": '{"count":1}'})
    assert read_event(stream) == ("prc", {"count": 1})
    page.feed.publish({"state": '{"a":2}', "prc": '{"count":1}'})
    assert read_event(stream) == ("state", {"a": 2})


def test_a_quiet_stream_beats_and_ends_with_the_server(
    page: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_server, "HEARTBEAT_S", 0.05)
    stream = page.get("/events")
    read_event(stream)
    lines = {stream.readline() for _ in range(6)}
    assert lines == {b":\n", b"\n"}
    page.feed.close()
    assert is_over(stream)


def test_a_slow_client_is_dropped_and_slows_nobody(
    page: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_server, "CLIENT_TIMEOUT_S", 0.5)
    slow = socket.socket()
    slow.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    slow.connect(("127.0.0.1", page.port))
    slow.sendall(f"GET /events HTTP/1.0\r\nHost: 127.0.0.1:{page.port}\r\n\r\n".encode())
    quick = page.get("/events")
    read_event(quick)
    arrived, number, begun = 0, 0, time.monotonic()
    while time.monotonic() < begun + 1.5:
        number += 1
        page.feed.publish({"big": json.dumps({"number": number, "text": "x" * 100_000})})
        assert read_event(quick)[1]["number"] == number
        arrived += 1
    assert arrived > 20
    slow.settimeout(PATIENCE_S)
    received = 0
    with suppress(ConnectionError):
        while chunk := slow.recv(2**20):
            received += len(chunk)
    assert received < 2_000_000  # what was in the buffers, not what was published
    slow.close()


def test_a_request_that_trickles_in_is_dropped(
    page: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_server, "CLIENT_TIMEOUT_S", 0.5)
    with socket.create_connection(("127.0.0.1", page.port)) as client, suppress(ConnectionError):
        client.settimeout(0.1)
        begun = time.monotonic()
        while time.monotonic() < begun + PATIENCE_S:
            client.sendall(b"a")
            with suppress(TimeoutError):
                assert client.recv(1) == b""
                return
        pytest.fail("the connection is still open")


def test_size_of_all_headers_is_limited(page: Served) -> None:
    """Otherwise 99 headers of 64 kB from each client fill the memory of the rig's computer."""
    with socket.create_connection(("127.0.0.1", page.port), PATIENCE_S) as client:
        with suppress(ConnectionError):
            client.sendall(b"GET / HTTP/1.0\r\n" + 2 * (b"X: " + b"a" * 60_000 + b"\r\n"))
            client.sendall(f"Host: 127.0.0.1:{page.port}\r\n\r\n".encode())
        assert client.recv(12) == b"HTTP/1.0 431"
    assert is_served(page)


def test_a_request_writes_no_control_characters_to_the_log(
    page: Served, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("DEBUG", "twin")
    with socket.create_connection(("127.0.0.1", page.port), PATIENCE_S) as client:
        client.sendall(b"GET /\x1b[2J\rforged HTTP/1.0\r\n\r\n")
        client.recv(100)
    assert "forged" in caplog.text
    assert "\x1b" not in caplog.text
    assert "\r" not in caplog.text


def test_the_number_of_streams_and_of_connections_is_limited(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(page_server, "MAX_STREAMS", 2)
    monkeypatch.setattr(page_server, "MAX_CONNECTIONS", 4)
    with serving() as page:
        assert [page.get("/events").status for _ in range(3)] == [200, 200, 503]
    monkeypatch.setattr(page_server, "MAX_STREAMS", 5)
    with serving() as page:
        assert [page.get("/events").status for _ in range(4)] == [200] * 4
        assert not is_served(page)


def test_silent_connections_shut_nobody_out(page: Served) -> None:
    for _ in range(150):
        page.open.enter_context(socket.create_connection(("127.0.0.1", page.port)))
    started_s = time.monotonic()
    assert page.get("/").status == 200
    assert time.monotonic() - started_s < 0.5


def test_wrong_code_is_logged_and_slowed_and_a_right_one_is_not(
    lab: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.WARNING, page_server.log.name)
    monkeypatch.setattr(page_server, "WRONG_CODE_S", 0.4)
    with serving(own(lab, "anna")) as page, ThreadPoolExecutor(3) as threads:
        started_s = time.monotonic()
        wrong = [threads.submit(page.get, "/events", **as_person("aaaa-bbbb")) for _ in range(3)]
        assert page.get("/events", **as_person(page.server.access.code)).status == 200
        assert page.get("/events").status == 401  # without a code: the page before the login
        assert time.monotonic() - started_s < 0.35
        assert [answer.result().status for answer in wrong] == [401] * 3
        assert time.monotonic() - started_s >= 3 * 0.4
    assert caplog.text.count("wrong access code from 127.0.0.1") == 3
    assert "aaaa" not in caplog.text


@pytest.mark.parametrize("addresses", [1, 5])
def test_wrong_codes_in_great_number_shut_nobody_out(
    lab: Path, monkeypatch: pytest.MonkeyPatch, addresses: int
) -> None:
    monkeypatch.setattr(page_server, "WRONG_CODE_S", 0.01)
    sources, count = [f"127.0.0.{k + 1}" for k in range(addresses)], page_server.MAX_WRONG_CODES
    with serving(own(lab, "anna")) as page, ThreadPoolExecutor(50) as threads, ExitStack() as held:
        for source in sources:  # the flood waits
            held.enter_context(page.server.code_locks[source])
        wrong = [
            threads.submit(replace(page, source=source).get, "/events", **as_person("aaaa-bbbb"))
            for source in sources * (50 // addresses)
        ]
        refused = [*islice(as_completed(wrong, PATIENCE_S), len(wrong) - count)]
        assert {answer.result().status for answer in refused} == {429}
        right = as_person(page.server.access.code)
        statuses = [
            page.get(path, **code).status for path in ("/", "/events") for code in ({}, right)
        ]
        stopped = page.post(b'{"command": "stop", "run": "r1"}', **right)[0]
        assert (statuses, stopped) == ([200, 200, 401, 200], 200)
        held.close()
        assert [answer.result().status for answer in wrong].count(401) == count


@pytest.mark.parametrize(
    ("body", "headers", "status"),
    [
        (b'{"command": "hold", "run": "r1"}', {}, 200),
        (b'{"command": "hold", "run": "r1"}', {"Origin": "http://evil.example"}, 403),
        (b'{"command": "hold", "run": "r1"}', {"Origin": "null"}, 403),
        (b'{"command": "hold", "run": "r1"}', {"Content_Type": "text/plain"}, 415),
        (b'{"command": "start", "run": "r1"}', {}, 400),
        (b'{"command": "hold"}', {}, 400),
        (b'{"command": "hold", "run": "../r1"}', {}, 400),
        (b'{"command": ["hold"], "run": "r1"}', {}, 400),
        (b"[1]", {}, 400),
        (b"not json", {}, 400),
        (b"[" * 900, {}, 400),
        (b"{}", {"Content_Length": "-1"}, 400),
        (b"{}", {"Content_Length": "999999999"}, 400),
    ],
)
def test_only_a_command_of_the_page_itself_is_taken(
    page: Served, body: bytes, headers: dict[str, str], status: int
) -> None:
    assert page.post(body, **headers)[0] == status
    expected = [PageCommand("hold", "r1", user_name(None))] if status == 200 else []
    assert page.commands == expected


def test_a_person_opens_the_page_by_the_code_of_its_start(lab: Path) -> None:
    with serving(own(lab, "anna")) as page:
        access = page.server.access
        assert (page.get("/").status, page.get("/events").status) == (200, 401)
        assert page.get("/events", **as_person("aaaa-bbbb")).status == 401
        stream = page.get("/events", **as_person(access.code))
        assert read_event(stream)[1]["name"] == "anna"
        url = format_page_url(f"127.0.0.1:{page.port}", access, read_credentials(own(lab, "anna")))
        assert url == f"http://127.0.0.1:{page.port}/#{access.code}"  # not sent by browsers


def test_over_tls_people_log_in_with_their_codes(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = new_code(lab, "bob", capsys)
    with serving(lab) as page:
        assert page.tls is not None
        assert page.get("/events").status == 401
        stream = page.get("/events", **as_person(code.upper().replace("-", " ")))
        assert dict([read_event(stream)])["user"] == {"name": "bob", "role": "observe"}
        command = b'{"command": "stop", "run": "r1"}'
        assert page.post(command)[0] == 401
        assert page.post(command, **as_person(code))[0] == 200  # the gateway judges the role
        assert page.commands == [PageCommand("stop", "r1", "bob")]
        assert not is_served(replace(page, tls=None))


def test_a_person_who_is_removed_is_cut_off(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_server, "HEARTBEAT_S", 0.05)
    lab = laboratory(tmp_path / "lab")
    code = new_code(lab, "anna", capsys)
    with serving(lab) as page:
        stream = page.get("/events", **as_person(code))
        read_event(stream)
        remove_person(lab, "anna")
        assert is_over(stream)
        assert page.get("/events", **as_person(code)).status == 401


def test_codes_are_hashed_replaced_and_expire(
    lab: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = read_credentials(lab)
    first = new_code(lab, "rec", capsys)
    second = new_code(lab, "rec", capsys, "https://rig.lab.example:7480")
    assert (identify_person(keys, first), identify_person(keys, second)) == ("", "rec")
    file = lab / page_access.CODES_FILE
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert second not in file.read_text()
    assert hash_code(second) in file.read_text()
    later = local_datetime() + timedelta(days=page_access.CODE_DAYS + 1)
    monkeypatch.setattr(page_access, "local_datetime", lambda: later)
    assert identify_person(keys, second) == ""
    with raises_input_error(where=lab / "access.toml", key="NAME", value="nobody"):
        issue_code(lab, "nobody", "")
    with raises_input_error(key="--page", value="http://rig:7480"):
        issue_code(lab, "rec", "http://rig:7480")


def test_codes_that_others_may_change_are_not_taken(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = laboratory(tmp_path / "lab")
    code, keys, file = new_code(lab, "anna", capsys), read_credentials(lab), lab / "codes.toml"
    file.chmod(0o640)
    assert identify_person(keys, code) == "anna"
    file.chmod(0o660)
    assert identify_person(keys, code) == ""
    with raises_input_error(where=file, key="mode", value="0660"):
        issue_code(lab, "anna", "")


@pytest.mark.parametrize("name", ["", "bob"])
def test_no_page_beyond_this_computer_without_the_keys_of_the_rig(lab: Path, name: str) -> None:
    keys = read_credentials(own(lab, name)) if name else None
    for host in ("0.0.0.0", "192.0.2.1", "rig.lab.example", "::"):
        with raises_input_error(key="--web-listen", value=f"{host}:7480"):
            grant_page_access(host, 7480, keys)
    rig = grant_page_access("0.0.0.0", 7480, read_credentials(lab))
    assert "127.0.0.1:7480" in rig.hosts
    assert rig.scheme == "https"


@pytest.mark.parametrize("address", ["7480", "here", ":7480", "127.0.0.1:", "127.0.0.1:99999"])
def test_malformed_page_address_is_refused(address: str) -> None:
    with raises_input_error(key="--web-listen", value=address):
        choose_page_address(address)


def test_a_port_in_use_is_refused(page: Served) -> None:
    with raises_input_error(key="--web-listen", value=f"127.0.0.1:{page.port}"):
        open_page_server(
            "127.0.0.1", page.port, page.server.access, page.feed, lambda _: CommandAnswer(200, "")
        )


def test_the_gateway_judges_commands_of_the_page_by_the_person(lab: Path) -> None:
    place = f"tls/127.0.0.1:{free_port()}"
    keys = read_credentials(lab)
    request = PageRequestConfig("127.0.0.1:7480", place, RIG, str(lab))
    with door(place, keys=keys):
        statuses = {
            name: submit_page_command(PageCommand("hold", RUN, name), request, keys).status
            for name in ("anna", "bob", "gone")
        }
        other_run = submit_page_command(PageCommand("hold", "other", "anna"), request, keys)
    assert statuses == {"anna": 200, "bob": 403, "gone": 403}
    assert other_run.status == 403
    assert submit_page_command(PageCommand("hold", RUN, "anna"), request, keys).status == 504


def test_commands_of_others_do_not_delay_a_command(
    lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Otherwise an observer delays a stop with orders that are refused one after another."""
    anna, bob = (new_code(lab, name, capsys) for name in ("anna", "bob"))
    begun, over = threading.Event(), threading.Event()

    def slow_for_bob(command: PageCommand) -> CommandAnswer:
        if command.user == "bob":
            begun.set()
            over.wait(2 * PATIENCE_S)
        return CommandAnswer(200, command.user)

    body = b'{"command": "stop", "run": "r1"}'
    with serving(lab) as page:
        page.server.handle_command = slow_for_bob
        post = threading.Thread(target=page.post, args=(body,), kwargs=as_person(bob))
        post.start()
        assert begun.wait(PATIENCE_S)
        try:
            assert page.post(body, **as_person(anna)) == (200, "anna")
        finally:
            over.set()
            post.join()


def test_commands_of_a_person_are_serialized(page: Served) -> None:
    """One person presses several times: the handler never runs twice at the same time."""
    active, most = 0, 0

    def slow_handler(_: PageCommand) -> CommandAnswer:
        nonlocal active, most
        active += 1
        most = max(most, active)
        time.sleep(0.1)
        active -= 1
        return CommandAnswer(200, "")

    page.server.handle_command = slow_handler
    body = b'{"command": "hold", "run": "r1"}'
    posts = [threading.Thread(target=page.post, args=(body,)) for _ in range(4)]
    for post in posts:
        post.start()
    for post in posts:
        post.join()
    assert most == 1
