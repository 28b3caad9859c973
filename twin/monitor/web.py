"""`--web`: the page of a running test in a browser, an observer of the gateway like the monitor.

`monitor --web` serves it in this process, `run --web` in a child of the run that ends with it.
"""

import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, NamedTuple, cast

from table_io.errors import InputError
from twin.live.control import request_command
from twin.live.gateway import GATEWAY_NICENESS
from twin.live.process_config import is_orphaned
from twin.monitor.app import FRAME_S, LIVE_TOPICS, MonitorClient, connect_observer
from twin.monitor.page_data import build_sections
from twin.monitor.page_server import CommandAnswer, PageCommand, PageFeed, open_page_server
from twin.security.access_control import user_name
from twin.security.certificate_authority import certificate_hosts
from twin.security.credentials import (
    CERTIFICATE_FILE,
    Credentials,
    credentials_folder,
    read_credentials,
)
from twin.security.page_access import PageAccess, grant_page_access, is_loopback_host
from twin.system.diagnostics import configure_logging
from twin.system.terminal import print_line, print_qr_code
from twin.transport.endpoint import PRED_TOPIC, split_host_port
from twin.viewer.address import find_free_address

PAGE_ADDRESS = "127.0.0.1:7480"
START_TIMEOUT_S = 20.0  # of the process of a page
END_TIMEOUT_S = 10.0  # of the same process
FINAL_FRAMES_S = 1.0  # for which the last state is shown before the server ends


class PageRequestConfig(NamedTuple):
    """Where a page is served, and which run it shows; strings, to be passed to a process."""

    address: str  # HOST:PORT
    connect: str
    rig: str
    keys: str = ""  # folder

    @property
    def credentials(self) -> Credentials | None:
        return read_credentials(Path(self.keys)) if self.keys else None


def choose_page_address(web_listen: str) -> str:
    """Return a checked HOST:PORT; without one a free port on loopback."""
    if not web_listen:
        return find_free_address(PAGE_ADDRESS)
    host, _, port = web_listen.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 2**16:
        raise InputError(
            "not understood",
            key="--web-listen",
            value=web_listen,
            allowed="HOST:PORT, as 127.0.0.1:7480 or, with the rig's --keys, 0.0.0.0:7480",
        )
    return web_listen


def format_page_url(address: str, access: PageAccess, keys: Credentials | None) -> str:
    """Return the address to open, with the code of the user who starts the page, if any."""
    host, port = split_host_port(f"/{address}")
    if not is_loopback_host(host) and keys is not None:
        names = certificate_hosts((keys.folder / CERTIFICATE_FILE).read_bytes())
        if host not in names:  # all interfaces, as 0.0.0.0
            host = next((name for name in names if not is_loopback_host(name)), names[0])
    host = f"[{host}]" if ":" in host else host
    return f"{access.scheme}://{host}:{port}/" + (f"#{access.code}" if access.code else "")


def serve_page(
    request: PageRequestConfig, announce: Callable[[str], None], should_stop: Callable[[], bool]
) -> None:
    """Serve the page until `should_stop()`, from now on and across runs; `announce` its URL."""
    keys = request.credentials
    host, port = split_host_port(f"/{request.address}")
    access, feed = grant_page_access(host, port, keys), PageFeed()
    feed.publish({})

    def handle_command(command: PageCommand) -> CommandAnswer:
        return submit_page_command(command, request, keys)

    server = open_page_server(host, port, access, feed, handle_command)
    announce(format_page_url(request.address, access, keys))
    user = user_name(keys)
    try:
        link = connect_observer(request.connect, request.rig, True, keys, should_stop)
        if link is None:
            return
        link.declare_alive(f"observer.{user}.web-{os.getpid()}")
        client = MonitorClient(link, user, (*LIVE_TOPICS, PRED_TOPIC))
        while not should_stop():
            client.listen(FRAME_S)
            feed.role = client.role
            feed.publish(build_sections(client.view()))
        client.listen(FINAL_FRAMES_S)
        feed.publish(build_sections(client.view()))
        link.close()
    finally:
        feed.close()
        server.shutdown()
        server.server_close()


def submit_page_command(
    command: PageCommand, request: PageRequestConfig, keys: Credentials | None
) -> CommandAnswer:
    """Send a command in the name of the person who gave it; the gateway checks the role."""
    reason = "requested from the page"
    try:
        _, answer = request_command(
            command.name, reason, request.connect, request.rig, keys,
            run=command.run, sender=command.user,
        )  # fmt: skip
    except InputError as error:
        return CommandAnswer(504, str(error))
    if answer == "yes":
        return CommandAnswer(200, f"{command.name} accepted")
    if answer:
        return CommandAnswer(403, answer)
    return CommandAnswer(504, "the rig did not respond; use the machine's own emergency stop")


def serve_monitor_page(
    web_listen: str, connect: str, rig: str, credentials: Credentials | None
) -> None:
    """Serve the page in this process until Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    folder = credentials_folder(credentials)
    request = PageRequestConfig(choose_page_address(web_listen), connect, rig, folder)
    try:
        serve_page(request, announce_page, lambda: False)
    except KeyboardInterrupt:
        print_line("page closed; the test continues")


def announce_page(url: str) -> None:
    """Print the address of a page, for other devices also as a QR code."""
    print_line(f"page: {url}")
    host = url.partition("://")[2].partition("/")[0].rpartition(":")[0]
    if not is_loopback_host(host):
        print_qr_code(url)


@contextmanager
def start_page_process(
    web_listen: str, listen: str, credentials: Credentials | None, rig: str
) -> Iterator[None]:
    """Run the page of a run in a process of its own and print its address; ends with the block.

    The address comes from the process: another server may listen where the page could not.
    """
    address = choose_page_address(web_listen)
    keys = credentials_folder(credentials)
    request = PageRequestConfig(address, _reach_endpoint(listen), rig, keys)
    host, port = split_host_port(f"/{address}")
    grant_page_access(host, port, credentials)  # refuses before a process starts
    command = [sys.executable, "-P", "-m", "twin.monitor.web", *request]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        start_new_session=True,
        # glibc gives each thread of the bus a heap of its own, which fills up over an hour.
        env=os.environ | {"MALLOC_ARENA_MAX": "1"},
    )
    try:
        announce_page(_read_page_url(process))
        yield
    finally:
        _end_process(process)


def _read_page_url(process: "subprocess.Popen[bytes]") -> str:
    """Return the URL that the process prints once it serves, within `START_TIMEOUT_S`."""
    output = cast("IO[bytes]", process.stdout)
    is_ready = bool(select.select([output], [], [], START_TIMEOUT_S)[0])
    url = output.readline().decode().strip() if is_ready else ""
    if not url:
        raise InputError("the page did not start", key="--web", remedy="run without it")
    return url


def _end_process(process: "subprocess.Popen[bytes]") -> None:
    """End the process by closing its input; kill it after `END_TIMEOUT_S`."""
    try:
        process.communicate(timeout=END_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _reach_endpoint(listen: str) -> str:
    """Return the endpoint at which this computer reaches a run that listens at `listen`."""
    return re.sub(r"/(0\.0\.0\.0|\[::\]):", "/127.0.0.1:", listen)


def main() -> None:
    """Run the child process of `run --web`."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with suppress(OSError):
        os.nice(GATEWAY_NICENESS)
    configure_logging("page")
    try:
        request = PageRequestConfig(*sys.argv[1:])
        serve_page(request, lambda url: print(url, flush=True), is_orphaned)
    except InputError as error:
        print(f"the page ended: {error}", file=sys.stderr)


if __name__ == "__main__":
    main()
