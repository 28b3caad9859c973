"""The page as an observer of a bus: it waits for a run, shows it, and outlives its gateway."""

import http.client
import json
import signal
import socket
import ssl
import subprocess
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.builders.ports import free_endpoint, free_port
from tests.input_errors import raises_input_error
from tests.monitor.monitored import point, records
from tests.monitor.test_app import hub_at, publish
from tests.monitor.test_page_server import PATIENCE_S, as_person, new_code, read_event
from tests.security.laboratory import RIG, RUN, door, laboratory
from twin.cli.table import app
from twin.live.run_command import run_test
from twin.monitor import web
from twin.monitor.web import PageRequestConfig, serve_page, start_page_process
from twin.security.credentials import read_credentials
from twin.transport.zenoh_link import BusLink


@contextmanager
def page_of(place: str) -> Iterator[http.client.HTTPResponse]:
    """The events of a page that watches this endpoint, in a thread."""
    port, is_served, over = free_port(), threading.Event(), threading.Event()
    request = PageRequestConfig(f"127.0.0.1:{port}", place, "simulated")
    thread = threading.Thread(
        target=serve_page, args=(request, lambda url: is_served.set(), over.is_set)
    )
    thread.start()
    try:
        assert is_served.wait(PATIENCE_S)
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.request("GET", "/events")
        with connection.getresponse() as answer:
            yield answer
    finally:
        over.set()
        thread.join()


def wait_for(
    events: http.client.HTTPResponse, hub: BusLink, section: str, test: Callable[[Any], bool]
) -> None:
    """Read events until a section is as expected, while the hub answers."""
    over = threading.Event()

    def answer() -> None:
        while not over.wait(0.01):
            hub.serve()

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        while (event := read_event(events))[0] != section or not test(event[1]):
            pass
    finally:
        over.set()
        thread.join()


def test_a_page_waits_for_a_run_and_outlives_its_gateway() -> None:
    place = free_endpoint()
    with page_of(place) as events:
        with hub_at(place) as hub:
            publish(hub, records())
            wait_for(events, hub, "prc", lambda prc: prc["count"] == 3)
        with hub_at(place) as hub:
            publish(hub, [*records(), point(3)])
            wait_for(events, hub, "prc", lambda prc: prc["count"] == 4)


def is_free(port: int) -> bool:
    with suppress(OSError), socket.create_server(("127.0.0.1", port)):
        return True
    return False


def test_the_page_of_a_run_is_a_process_that_ends_with_it(
    capsys: pytest.CaptureFixture[str],
) -> None:
    port = free_port()
    with start_page_process(f"127.0.0.1:{port}", free_endpoint(), None, "simulated"):
        assert f"page: http://127.0.0.1:{port}/" in capsys.readouterr().out
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.request("GET", "/")
        with connection.getresponse() as answer:
            assert answer.status == 200
    assert is_free(port)


def test_foreign_server_is_not_announced_as_the_page(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other, raises_input_error(key="--web"):
        address = f"127.0.0.1:{other.getsockname()[1]}"
        with start_page_process(address, free_endpoint(), None, "simulated"):
            pass
    assert "page:" not in capsys.readouterr().out


@pytest.mark.parametrize("host", ["0.0.0.0", "[::]"])
def test_the_page_of_a_run_reaches_a_gateway_on_all_interfaces(
    host: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lab, port, place = laboratory(tmp_path / "lab"), free_port(), f"tls/{host}:{free_port()}"
    keys, code = read_credentials(lab), new_code(lab, "anna", capsys)
    headers = {"Content-Type": "application/json", "Origin": f"https://127.0.0.1:{port}"}
    with door(place, keys=keys), start_page_process(f"127.0.0.1:{port}", place, keys, RIG):
        tls = ssl.create_default_context(cafile=str(lab / "ca.pem"))
        connection = http.client.HTTPSConnection("127.0.0.1", port, context=tls)
        body = json.dumps({"command": "hold", "run": RUN})
        connection.request("POST", "/command", body, headers | as_person(code))
        with connection.getresponse() as answer:
            assert json.loads(answer.read())["message"] == "hold accepted"


def test_a_page_that_hangs_does_not_keep_the_run(monkeypatch: pytest.MonkeyPatch) -> None:
    processes: list[subprocess.Popen[bytes]] = []

    def note_process(*args: Any, **options: Any) -> "subprocess.Popen[bytes]":
        processes.append(popen(*args, **options))
        return processes[-1]

    popen = subprocess.Popen
    monkeypatch.setattr(subprocess, "Popen", note_process)
    monkeypatch.setattr(web, "END_TIMEOUT_S", 0.5)
    with start_page_process(f"127.0.0.1:{free_port()}", free_endpoint(), None, "simulated"):
        processes[0].send_signal(signal.SIGSTOP)
        rescue = threading.Timer(PATIENCE_S, processes[0].kill)
        rescue.start()
    assert rescue.is_alive()
    rescue.cancel()
    assert processes[0].returncode == -signal.SIGKILL


def test_a_page_goes_with_a_test_in_real_time_only() -> None:
    with raises_input_error(key="--web"):
        run_test(
            Path("quickstart"),
            None,
            True,
            None,
            None,
            False,
            "",
            start_page=lambda _: nullcontext(),
        )


@pytest.mark.parametrize("option", ["--once", "--picture=now.svg"])
def test_a_page_is_not_printed(option: str) -> None:
    with raises_input_error(key="--web"):
        CliRunner().invoke(app, ["monitor", "--web", option], catch_exceptions=False)
