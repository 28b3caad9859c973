"""One person opens all sessions that there are: whoever may command comes in, and is obeyed."""

import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from table_io.records import Event
from tests.builders.ports import free_port
from tests.builders.profiles import NO_LOOP_CHECK, format_test
from tests.live.test_live import SHAKETWIN, running
from tests.security.laboratory import (
    answers,
    door,
    laboratory,
    own,
    person,
)
from twin.recording.reader import read_recording
from twin.security.credentials import read_credentials
from twin.transport.endpoint import MAX_SESSIONS_PER_PERSON, PUBLIC_HUB_SETTINGS

PATIENCE_S = 20.0
PROFILE = format_test(3.6, 4.0, 0.2, cycles=1000, directions=["forward"], tables=NO_LOOP_CHECK)
FILL = """
import sys, time
from contextlib import suppress
from pathlib import Path
from tests.security.laboratory import person
kept, begin = [], time.monotonic()
while len(kept) < 100 and time.monotonic() - begin < 10:
    with suppress(Exception):
        kept.append(person(Path(sys.argv[1]), "bob", sys.argv[2]))
print("full", flush=True)
time.sleep(600)
"""


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return laboratory(tmp_path_factory.mktemp("keys") / "lab")


def test_a_person_has_so_many_sessions_and_no_more(lab: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with ExitStack() as closing:
        hub = closing.enter_context(
            door(endpoint, extra_settings=PUBLIC_HUB_SETTINGS, keys=read_credentials(lab))
        )
        first = person(lab, "bob", endpoint)
        closing.callback(first.close)
        for _ in range(MAX_SESSIONS_PER_PERSON + 2):
            closing.callback(person(lab, "bob", endpoint).close)
        anna = person(lab, "anna", endpoint)
        closing.callback(anna.close)
        names: list[str] = []
        deadline_s = time.monotonic() + PATIENCE_S
        while names.count("bob") != MAX_SESSIONS_PER_PERSON or "anna" not in names:
            assert time.monotonic() < deadline_s, names
            names = [str(link.auth_identifier) for link in hub._session.info.links()]
            time.sleep(0.02)
        assert answers(first, "state/status") == [b"state/status"]
        assert answers(anna, "cmd/stop/anna") == [b"refused: this is run run"]
        assert hub.drain_closed_sessions() == {"bob"}


@pytest.mark.slow
def test_an_operator_stops_a_run_whose_sessions_an_observer_fills(
    lab: Path, tmp_path: Path
) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    (tmp_path / "test.toml").write_text(PROFILE)
    out = tmp_path / "out"
    command = [SHAKETWIN, "run", str(tmp_path / "test.toml"), "--out", str(out)]
    run = subprocess.Popen(
        [*command, "--listen", endpoint, "--keys", str(lab)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    running(run)
    filling = subprocess.Popen(
        [sys.executable, "-c", FILL, str(lab), endpoint], stdout=subprocess.PIPE, text=True
    )
    assert filling.stdout is not None
    assert filling.stdout.readline() == "full\n"
    control = [SHAKETWIN, "control", "--connect", endpoint, "--keys", str(own(lab, "anna"))]
    orders = ("hold", "stop")
    try:
        for order in orders:
            subprocess.run([*control, order], check=True)
    finally:
        filling.kill()
        filling.wait()
        run.terminate()  # again, if it has stopped
        run.communicate()
    events = read_recording(out / "run.mcap").records(Event)
    assert any(event.text.startswith("session of bob: too many") for event in events)
    assert sum(event.kind == "order" for event in events) == len(orders)
