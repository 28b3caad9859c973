"""A laboratory with keys for everybody, sessions as its people open them, a rig that answers."""

import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import zenoh

from table_io.clock import local_datetime
from twin.live.gateway import validate_command
from twin.rig.keys import add_person, create_keys, remove_person
from twin.security.access_control import ZenohSettings
from twin.security.certificate_authority import CertificateKeyPair, issue_certificate
from twin.security.credentials import read_credentials
from twin.transport.endpoint import merge_settings, session_settings
from twin.transport.zenoh_link import BusLink, open_hub

RIG = "simulated"
ROOT = f"shaketwin/{RIG}"
RUN = "run"
COMPONENTS = ("run.gate", "run.rig")
PEOPLE = {"anna": "command", "bob": "observe", "rec": "record", "tina": "twin", "gone": "observe"}


def laboratory(folder: Path) -> Path:
    """The keys of a rig and of everybody in `PEOPLE`, of whom gone has left."""
    create_keys(folder, [])
    for name, role in PEOPLE.items():
        add_person(folder, name, role, [])
    remove_person(folder, "gone")
    return folder


def own(lab: Path, name: str) -> Path:
    """A person's folder."""
    return lab / "people" / name


def aged(lab: Path, folder: Path, name: str, days: float, hosts: tuple[str, ...] = ()) -> Path:
    """Keys issued so many days ago."""
    authority = CertificateKeyPair((lab / "ca.pem").read_bytes(), (lab / "ca.key.pem").read_bytes())
    return write_keys(
        folder,
        lab,
        issue_certificate(authority, name, hosts, local_datetime() - timedelta(days=days)),
    )


def write_keys(folder: Path, lab: Path, pair: CertificateKeyPair) -> Path:
    """A folder of keys with this pair, and the authority of a laboratory."""
    folder.mkdir()
    shutil.copy(lab / "ca.pem", folder)
    (folder / "certificate.pem").write_bytes(pair.certificate)
    (folder / "key.pem").write_bytes(pair.key)
    (folder / "key.pem").chmod(0o600)
    return folder


def session(endpoint: str, also: ZenohSettings, open_s: float = 2.0) -> Any:
    """A client of zenoh's own, which does what ours never would; ZError where it is refused."""
    config = merge_settings(session_settings("client", "connect", endpoint, open_s), also)
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def person(lab: Path, name: str, endpoint: str) -> Any:
    """The same with the keys of somebody."""
    return session(endpoint, read_credentials(own(lab, name)).tls_settings())


def put(by: Any, key: str, body: bytes = b"") -> None:
    """Publish, waiting where the queue is full: what does not arrive was denied."""
    block = zenoh.CongestionControl.BLOCK
    by.put(f"{ROOT}/{key}", body, congestion_control=block)
    by.delete(f"{ROOT}/{key}", congestion_control=block)


def note_keys(where: list[str]) -> Any:
    """What writes down the keys of samples or queries before anything later is heard."""
    return zenoh.handlers.Callback(
        lambda sample: where.append(str(sample.key_expr)), indirect=False
    )


def answers(of: Any, key: str) -> list[bytes]:
    """What others answer to a session's question."""
    away, everyone = zenoh.Locality.REMOTE, zenoh.QueryTarget.ALL
    replies = of.get(f"{ROOT}/{key}", timeout=10.0, target=everyone, allowed_destination=away)
    return [bytes(reply.ok.payload) for reply in replies if reply.ok is not None]


def alive(of: Any) -> set[str]:
    """The tokens that a session sees."""
    replies = of.liveliness().get(f"{ROOT}/alive/*", timeout=10.0)
    return {str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok is not None}


@contextmanager
def door(endpoint: str, **settings: Any) -> Iterator[BusLink]:
    """A hub as the gate opens it: obeys as the gate does, says "<path>" to other questions."""
    link = open_hub(RIG, endpoint, **settings)
    keys = settings.get("keys")
    questions = link.declare_requests("state/status", "config/run", "state/role/*", "cmd/*/*")
    for component in COMPONENTS:
        link.declare_alive(component)
    over = threading.Event()

    def answer() -> None:
        while not over.wait(0.001):
            if (question := questions.poll()) is not None:
                kind, what, *who = question.path.split("/")
                if keys is None or not who:
                    question.reply(question.path)
                elif kind == "state":
                    question.reply(keys.role_of(who[0]))
                else:
                    why = validate_command(what, who[0], keys.role_of(who[0]), RUN, question.text)
                    question.reply(f"refused: {why}" if why else "yes")

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        yield link
    finally:
        over.set()
        thread.join()
        link.close()
