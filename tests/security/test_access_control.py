"""What each role can and cannot do to a rig, tried with sessions of zenoh's own."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.builders.ports import free_port
from tests.input_errors import raises_input_error
from tests.security.laboratory import (
    COMPONENTS,
    PEOPLE,
    RIG,
    ROOT,
    alive,
    answers,
    door,
    laboratory,
    note_keys,
    own,
    put,
)
from tests.security.laboratory import person as raw_person
from tests.security.laboratory import session as raw_session
from twin.security.access_control import ZenohSettings, build_open_access
from twin.security.credentials import read_credentials
from twin.transport.codec import TOPIC_TYPES
from twin.transport.endpoint import PUBLIC_HUB_SETTINGS, key_expression
from twin.transport.zenoh_link import BusLink, open_spoke

KNOWN = [name for name in PEOPLE if name != "gone"]
NOT_THEIRS = ("stream/rig/meas", "event/run/start", "cmd/stop/anna", "state/status", "**")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return laboratory(tmp_path_factory.mktemp("keys") / "lab")


@pytest.fixture(scope="module")
def endpoint() -> str:
    return f"tls/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def hub(lab: Path, endpoint: str) -> Iterator[BusLink]:
    with door(endpoint, keys=read_credentials(lab)) as link:
        yield link


@pytest.fixture
def closing() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def person(hub: BusLink, lab: Path, endpoint: str, closing: ExitStack) -> Any:
    """Opens a session with the keys of somebody."""

    def come(name: str) -> Any:
        session = raw_person(lab, name, endpoint)
        closing.callback(session.close)
        return session

    return come


def settle(session: Any) -> None:
    """Whatever the session sent before has been seen by the hub, and the other way round."""
    assert answers(session, "state/role/none")


def collect_keys(session: Any, *keys: str) -> list[str]:
    """The keys of what a session gets for these subscriptions, growing."""
    got: list[str] = []
    for key in keys:
        where = f"{ROOT}/{key}"
        session.declare_subscriber(where, note_keys(got))
    settle(session)
    return got


@pytest.mark.parametrize("who", KNOWN)
def test_every_listed_person_receives_every_topic(hub: BusLink, person: Any, who: str) -> None:
    session = person(who)
    got = collect_keys(
        session, *(key_expression(RIG, topic).removeprefix(f"{ROOT}/") for topic in TOPIC_TYPES)
    )
    for topic in TOPIC_TYPES:
        put(hub._session, key_expression(RIG, topic).removeprefix(f"{ROOT}/"))
    settle(session)
    assert sorted(got) == sorted(key_expression(RIG, topic) for topic in TOPIC_TYPES)


@pytest.mark.parametrize("who", [*KNOWN, "gone"])
def test_no_person_receives_commands_or_wider_keys(hub: BusLink, person: Any, who: str) -> None:
    session = person(who)
    got = collect_keys(session, "**", "*/rig/meas", "cmd/**", "state/**", "../**")
    for where in ("stream/rig/meas", "event/run/start", "cmd/stop/anna", "state/held"):
        put(hub._session, where)
    settle(session)
    assert got == []


def test_unlisted_person_receives_nothing(hub: BusLink, person: Any) -> None:
    asked: list[str] = []
    rig = hub._session.declare_queryable(f"{ROOT}/**", note_keys(asked))
    session = person("gone")
    got = collect_keys(session, "stream/rig/meas", "event/run/start")
    put(hub._session, "stream/rig/meas")
    settle(session)
    assert (got, alive(session)) == ([], set())
    for path in ("state/status", "state/role/gone", "state/role/*", "config/run", "cmd/stop/gone"):
        assert answers(session, path) == []
    rig.undeclare()
    assert set(asked) == {f"{ROOT}/state/role/none"}


def test_remote_twin_is_received_without_loss(
    hub: BusLink, lab: Path, endpoint: str, closing: ExitStack
) -> None:
    """What it published before anybody asked comes too: the hub may ask for what it holds."""
    twin = open_spoke(RIG, endpoint, 5.0, read_credentials(own(lab, "tina")))
    closing.callback(twin.close)
    twin.declare(("/twin/point",), offered=True)
    twin.publish("/twin/point", b"before")
    inbox = hub.subscribe(("/twin/point",), history=True, capacity=10, offered=True)
    got = []
    for _ in range(200):
        twin.serve()
        if (message := inbox.get(0.05)) is not None:
            got.append(message[1])
            if len(got) == 2:
                break
            twin.publish("/twin/point", b"after")
    assert got == [b"before", b"after"]


@pytest.mark.parametrize("who", [*KNOWN, "gone"])
def test_only_a_twin_publishes_and_only_what_a_twin_computes(
    hub: BusLink, person: Any, who: str
) -> None:
    got: list[str] = []
    listener = hub._session.declare_subscriber("**", note_keys(got))
    session = person(who)
    for where in (*NOT_THEIRS, "stream/twin/pred", "event/twin/point", "offer/twin/pred"):
        put(session, where)
    settle(session)
    listener.undeclare()
    assert got == ([f"{ROOT}/offer/twin/pred"] if who == "tina" else [])


@pytest.mark.parametrize("who", KNOWN)
def test_command_carries_the_authenticated_sender(person: Any, who: str) -> None:
    session = person(who)
    (answer,) = answers(session, f"cmd/stop/{who}")
    assert (b"need the role command" in answer) == (PEOPLE[who] != "command")
    others = [other for other in PEOPLE if other != who]
    for forged in (*others, "*", f"{who}/{who}", f"{who}$*", "rig"):
        assert answers(session, f"cmd/stop/{forged}") == []
    assert answers(session, "cmd/**") == []
    assert answers(session, "**") == []


@pytest.mark.parametrize("who", KNOWN)
def test_every_listed_person_queries_state_and_configuration(person: Any, who: str) -> None:
    session = person(who)
    assert answers(session, "state/status") == [b"state/status"]
    assert answers(session, "config/run") == [b"config/run"]
    assert answers(session, f"state/role/{who}") == [PEOPLE[who].encode()]


@pytest.mark.parametrize("who", [*KNOWN, "gone"])
def test_nobody_answers_or_listens_in_the_rigs_place(hub: BusLink, person: Any, who: str) -> None:
    """A false rig gets no question; a twin only the rig's own, for what it offers."""
    asked: list[str] = []
    false_rig = person(who)
    for where in ("cmd/**", "cmd/stop/anna", "state/**", "state/status", "config/**", "state/held"):
        false_rig.declare_queryable(f"{ROOT}/{where}", note_keys(asked))
    false_rig.declare_queryable(f"{ROOT}/state/offers", note_keys(asked))
    collect_keys(false_rig, "cmd/**", "cmd/stop/anna")
    honest = person("anna")
    assert answers(honest, "cmd/stop/anna") == [b"refused: this is run run"]
    assert answers(honest, "state/status") == [b"state/status"]
    assert answers(honest, "config/run") == [b"config/run"]
    assert answers(honest, "state/held") == []
    assert answers(honest, "state/offers") == []
    settle(false_rig)
    assert asked == []
    answers(hub._session, "state/offers")
    settle(false_rig)
    assert set(asked) == ({f"{ROOT}/state/offers"} if who == "tina" else set())


@pytest.mark.parametrize("who", [*KNOWN, "gone"])
def test_no_person_declares_another_name_alive(hub: BusLink, person: Any, who: str) -> None:
    session = person(who)
    false = (
        "run.twin",
        "run.rig.2",
        "observer",
        "observer.rig.1",
        "observer.ann",
        "observer.zoe.1",
    )
    others = [f"observer.{other}.1" for other in PEOPLE if other != who]
    kept = [
        session.liveliness().declare_token(f"{ROOT}/alive/{name}")
        for name in (*false, *others, f"observer.{who}x.1", f"observer.{who}.1")
    ]
    settle(session)
    theirs = {f"observer.{who}.1"} if who in KNOWN else set()
    assert alive(hub._session) == {*COMPONENTS} | theirs
    assert alive(person("bob")) == {*COMPONENTS} | theirs
    assert kept


def test_open_spoke_reports_a_missing_role(lab: Path) -> None:
    """By a hub that drops what comes too fast, as the gate's does."""
    endpoint = f"tls/127.0.0.1:{free_port()}"
    with door(endpoint, extra_settings=PUBLIC_HUB_SETTINGS, keys=read_credentials(lab)):
        said_to_whom(lab, endpoint)


def said_to_whom(lab: Path, endpoint: str) -> None:
    with raises_input_error(key="endpoint", value=endpoint, problem="gone"):
        open_spoke(RIG, endpoint, 5.0, read_credentials(own(lab, "gone")))
    with raises_input_error(key="endpoint", value=endpoint, problem="'other'"):
        open_spoke("other", endpoint, 5.0, read_credentials(own(lab, "anna")))
    link = open_spoke(RIG, endpoint, 5.0, read_credentials(own(lab, "anna")))
    assert link.query("state/status") == b"state/status"
    link.close()


def test_a_run_with_a_twin_of_its_own_takes_no_other(lab: Path, closing: ExitStack) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    link = closing.enter_context(door(endpoint, keys=read_credentials(lab).without_twin_roles()))
    session = raw_person(lab, "tina", endpoint)
    closing.callback(session.close)
    got: list[str] = []
    link._session.declare_subscriber("**", note_keys(got))
    put(session, "offer/twin/pred")
    assert answers(session, "state/role/tina") == [b"twin"]
    assert got == []


@pytest.mark.parametrize("twin", [False, True])
def test_on_this_machine_everybody_asks_and_nobody_publishes(
    closing: ExitStack, twin: bool
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    also: ZenohSettings = build_open_access(RIG, remote_twin=twin)
    link = closing.enter_context(door(endpoint, extra_settings=also))
    session, false_rig, honest = (raw_session(endpoint, {}) for _ in range(3))
    for peer in (session, false_rig, honest):
        closing.callback(peer.close)
    published: list[str] = []
    link._session.declare_subscriber("**", note_keys(published))
    got, too_wide = collect_keys(session, "stream/rig/meas"), collect_keys(honest, "**", "cmd/**")
    asked: list[str] = []
    false_rig.declare_queryable(f"{ROOT}/cmd/**", note_keys(asked))
    kept = [
        false_rig.liveliness().declare_token(f"{ROOT}/alive/{name}")
        for name in ("run.twin", "observer.me.1")
    ]
    for where in (*NOT_THEIRS, "stream/twin/pred", "offer/twin/pred"):
        put(false_rig, where)
    settle(false_rig)
    assert published == ([f"{ROOT}/offer/twin/pred"] if twin else [])
    put(link._session, "stream/rig/meas")
    put(link._session, "cmd/stop/me")
    assert answers(honest, "cmd/stop/me") == [b"cmd/stop/me"]
    settle(session)
    assert (got, too_wide, asked) == ([f"{ROOT}/stream/rig/meas"], [], [])
    assert alive(session) == {*COMPONENTS, "observer.me.1"}
    assert kept
