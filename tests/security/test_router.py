"""A router between the rig and the people: it checks them as the rig does, and takes no part."""

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.builders.ports import free_port
from tests.input_errors import raises_input_error
from tests.security.laboratory import (
    COMPONENTS,
    RIG,
    ROOT,
    alive,
    answers,
    door,
    laboratory,
    own,
)
from tests.security.laboratory import person as raw_person
from twin.rig.keys import add_person, print_router_settings
from twin.security.credentials import read_credentials
from twin.transport.zenoh_link import BusLink, open_spoke

TRIES, PAUSE_S = 200, 0.02


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = laboratory(tmp_path_factory.mktemp("keys") / "lab")
    add_person(folder, "relay", "router", ["127.0.0.1"])
    return folder


@pytest.fixture
def between(
    lab: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Iterator[tuple[BusLink, str]]:
    """(the rig's hub, the endpoint of a router to which it is connected)."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    capsys.readouterr()
    print_router_settings(lab, "relay", endpoint, RIG)
    monkeypatch.chdir(own(lab, "relay"))  # where its keys lie
    printed = json.loads(capsys.readouterr().out)
    del printed["downsampling"]  # these tests ask faster than anybody may
    router = zenoh.open(zenoh.Config.from_json5(json.dumps(printed)))
    also = {"connect": {"endpoints": [endpoint]}}
    with door(
        f"tls/127.0.0.1:{free_port()}", extra_settings=also, keys=read_credentials(lab)
    ) as hub:
        yield hub, endpoint
    router.close()


@pytest.fixture
def behind(between: tuple[BusLink, str], lab: Path) -> Iterator[Any]:
    """Opens a session behind the router, once rig and router know each other."""
    with ExitStack() as stack:

        def come(name: str) -> Any:
            session = raw_person(lab, name, between[1])
            stack.callback(session.close)
            for _ in range(TRIES):
                if answers(session, "state/role/none"):
                    return session
                time.sleep(PAUSE_S)
            raise AssertionError("the router does not reach the rig")

        yield come


def test_names_are_authenticated_behind_a_router(behind: Any) -> None:
    anna, bob, gone = behind("anna"), behind("bob"), behind("gone")
    assert answers(anna, "state/role/anna") == [b"command"]
    assert answers(anna, "cmd/stop/anna") == [b"refused: this is run run"]
    assert b"need the role command" in answers(bob, "cmd/stop/bob")[0]
    for other in ("anna", "relay", "*"):
        assert answers(bob, f"cmd/stop/{other}") == []
    assert answers(gone, "state/status") == answers(gone, "state/role/gone") == []
    tokens = [
        bob.liveliness().declare_token(f"{ROOT}/alive/observer.{name}.1")
        for name in ("bob", "anna", "relay")
    ]
    assert answers(bob, "state/status")
    assert alive(anna) == {*COMPONENTS, "observer.bob.1"}
    assert tokens


def test_behind_a_router_nobody_publishes_in_the_rigs_name(
    between: tuple[BusLink, str], behind: Any
) -> None:
    anna, bob = behind("anna"), behind("bob")
    got: list[bytes] = []
    anna.declare_subscriber(
        f"{ROOT}/stream/rig/meas", lambda sample: got.append(bytes(sample.payload))
    )
    bob.declare_queryable(f"{ROOT}/state/**", lambda query: query.reply(query.key_expr, b"false"))
    for _ in range(TRIES):  # until the subscription has reached the rig
        between[0]._session.put(f"{ROOT}/stream/rig/meas", b"true")
        bob.put(f"{ROOT}/stream/rig/meas", b"false")
        if answers(bob, "state/status") and got:
            break
        time.sleep(PAUSE_S)
    assert set(got) == {b"true"}
    assert answers(anna, "state/status") == [b"state/status"]


def test_open_spoke_connects_through_a_router(
    between: tuple[BusLink, str], behind: Any, lab: Path
) -> None:
    behind("anna")
    link = open_spoke(RIG, between[1], 5.0, read_credentials(own(lab, "anna")))
    assert link.query("state/status") == b"state/status"
    link.close()
    with raises_input_error(key="endpoint", value=between[1], problem="gone"):
        open_spoke(RIG, between[1], 5.0, read_credentials(own(lab, "gone")))


def test_a_router_has_that_role_and_listens_with_keys(lab: Path) -> None:
    with raises_input_error(
        where=lab / "access.toml", key="NAME", value="anna", problem="router", remedy="relay"
    ):
        print_router_settings(lab, "anna", "tls/0.0.0.0:7447", RIG)
    with raises_input_error(key="endpoint", value="tcp/0.0.0.0:7447", remedy="tls/"):
        print_router_settings(lab, "relay", "tcp/0.0.0.0:7447", RIG)


def test_printed_settings_name_no_local_path(lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    print_router_settings(lab, "relay", "tls/0.0.0.0:7447", RIG)
    printed = capsys.readouterr().out
    assert json.loads(printed)["transport"]["link"]["tls"]["listen_private_key"] == "key.pem"
    assert str(lab.parent) not in printed
