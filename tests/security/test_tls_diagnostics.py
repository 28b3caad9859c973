"""Every way not to be let in says which it is and what to do."""

import re
import shutil
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import zenoh

from table_io.clock import local_datetime
from table_io.errors import InputError
from tests.builders.ports import free_port
from tests.input_errors import raises_input_error
from tests.security.laboratory import (
    RIG,
    aged,
    door,
    laboratory,
    own,
    session,
    write_keys,
)
from twin.live.control import send_command
from twin.security import tls_diagnostics as refusal_module
from twin.security.access_control import ZenohSettings
from twin.security.certificate_authority import CertificateKeyPair, issue_certificate
from twin.security.credentials import Credentials, read_credentials
from twin.security.tls_diagnostics import (
    NO_IPV6,
    TOO_MANY_SESSIONS,
    diagnose_refusal,
)
from twin.transport.zenoh_link import open_hub, open_spoke

SHORT_S = 0.3
HERE = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Doors:
    """What stands in a laboratory, and in one that is not its own."""

    folder: Path
    lab: Path
    other: Path
    keyed: str  # the rig's endpoint
    plain: str  # one without keys
    aged: str  # one whose certificate has expired
    elsewhere: str  # one whose certificate is for rig.lab.example
    false: str  # one that shows a person's certificate

    def keys(self, name: str = "anna") -> Credentials:
        return read_credentials(own(self.lab, name))

    def without_checks(self, folder: Path) -> Credentials:
        """Keys that nobody looked at, as another program would use them."""
        return replace(self.keys(), folder=folder)


@contextmanager
def standing(folder: Path) -> Iterator[Doors]:
    """A rig with keys, and beside it what one may take for it."""
    lab, other = laboratory(folder / "lab"), laboratory(folder / "other")
    authority = CertificateKeyPair((lab / "ca.pem").read_bytes(), (lab / "ca.key.pem").read_bytes())
    rig = read_credentials(lab)
    away = write_keys(
        folder / "away",
        lab,
        issue_certificate(authority, "rig", ["rig.lab.example"], local_datetime()),
    )
    old = aged(lab, folder / "old", "rig", 400.0, (HERE,))
    secure = [f"tls/{HERE}:{free_port()}" for _ in range(4)]
    plain = f"tcp/{HERE}:{free_port()}"
    with (
        door(secure[0], keys=rig),
        door(secure[1], keys=replace(rig, folder=old)),
        door(secure[2], keys=replace(rig, folder=away)),
        door(secure[3], keys=replace(rig, folder=own(lab, "bob"))),
        door(plain),
    ):
        yield Doors(folder, lab, other, secure[0], plain, *secure[1:])


@pytest.fixture(scope="module")
def doors(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Doors]:
    with standing(tmp_path_factory.mktemp("keys")) as doors:
        yield doors


def test_the_right_certificate_comes_in(doors: Doors) -> None:
    for endpoint in (doors.keyed, doors.keyed.replace(HERE, "localhost")):
        link = open_spoke(RIG, endpoint, 5.0, doors.keys())
        assert link.query("state/status") == b"state/status"
        link.close()


def forge_credentials(doors: Doors) -> Credentials:
    """A certificate of anna by another authority, beside the right ca.pem."""
    folder = doors.folder / "forged"
    if not folder.exists():
        shutil.copytree(own(doors.other, "anna"), folder)
        shutil.copy(doors.lab / "ca.pem", folder)
    return doors.without_checks(folder)


def issued_by_bob(doors: Doors) -> Credentials:
    """A certificate of anna, signed by bob, and his behind it."""
    folder = doors.folder / "issued"
    if not folder.exists():
        bob = CertificateKeyPair(
            *(
                (own(doors.lab, "bob") / name).read_bytes()
                for name in ("certificate.pem", "key.pem")
            )
        )
        false = issue_certificate(bob, "anna", [], local_datetime())
        write_keys(
            folder, doors.lab, CertificateKeyPair(false.certificate + bob.certificate, false.key)
        )
    return doors.without_checks(folder)


def make_expired(doors: Doors) -> Credentials:
    folder = doors.folder / "expired"
    return doors.without_checks(
        folder if folder.exists() else aged(doors.lab, folder, "anna", 400.0)
    )


def nowhere(_: Doors) -> str:
    return f"tls/{HERE}:{free_port()}"


Case = tuple[Callable[[Doors], str], Callable[[Doors], Credentials | None], tuple[str, str]]
REFUSED: dict[str, Case] = {
    "no certificate": (
        lambda doors: doors.keyed,
        lambda _: None,
        ("asks for certificates", "give yours with --keys FOLDER"),
    ),
    "plain TCP against TLS": (
        lambda doors: doors.keyed.replace("tls/", "tcp/"),
        lambda _: None,
        ("takes only people with keys", "write tls/ .* --keys FOLDER"),
    ),
    "TLS against plain TCP": (
        lambda doors: doors.plain.replace("tcp/", "tls/"),
        lambda doors: doors.keys(),
        ("does not speak TLS", "write tcp/ for a run on this machine"),
    ),
    "keys with tcp/": (
        lambda doors: doors.plain,
        lambda doors: doors.keys(),
        ("tcp/ shows no certificate", "with --keys write tls/"),
    ),
    "plain TCP over the network": (
        lambda _: "tcp/192.0.2.1:7447",
        lambda _: None,
        ("would go over the network, unprotected", "--keys FOLDER tls/"),
    ),
    "another laboratory's keys": (
        lambda doors: doors.keyed,
        lambda doors: read_credentials(own(doors.other, "anna")),
        (r"not from the authority in .*ca\.pem", "`shaketwin keys`"),
    ),
    "a forged certificate": (
        lambda doors: doors.keyed,
        forge_credentials,
        (r"certificate \(anna\) is refused: the rig does not know the authority", "keys`"),
    ),
    "a certificate issued by a person": (
        lambda doors: doors.keyed,
        issued_by_bob,
        (r"certificate \(anna\) is refused: .*issued", "`shaketwin keys`"),
    ),
    "an expired certificate": (
        lambda doors: doors.keyed,
        make_expired,
        (r"certificate \(anna\) is refused: it has expired", "`shaketwin keys`"),
    ),
    "the rig's certificate expired": (
        lambda doors: doors.aged,
        lambda doors: doors.keys(),
        ("rig's certificate has expired", "`shaketwin keys renew`"),
    ),
    "another host's certificate": (
        lambda doors: doors.elsewhere,
        lambda doors: doors.keys(),
        (r"rig's certificate is not for 127\.0\.0\.1", r"keys renew FOLDER --host 127\.0\.0\.1"),
    ),
    "a person in the rig's place": (
        lambda doors: doors.false,
        lambda doors: doors.keys(),
        ("shows a person's certificate, not a rig's", "do not trust it"),
    ),
    "not in the access list": (
        lambda doors: doors.keyed,
        lambda doors: doors.keys("gone"),
        ("certificate is good, but gone is not in the rig's access list", "`shaketwin keys`"),
    ),
    "nobody there": (
        nowhere,
        lambda doors: doors.keys(),
        ("no rig answers", "start the run first"),
    ),
    "no such machine": (
        lambda _: "tls/no-such-machine.invalid:7447",
        lambda doors: doors.keys(),
        ("no host of that name", "check the name"),
    ),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refusal_states_problem_and_remedy(what: str, doors: Doors) -> None:
    where, whose, (problem, remedy) = REFUSED[what]
    endpoint = where(doors)
    with pytest.raises(InputError) as refusal:
        open_spoke(RIG, endpoint, SHORT_S, whose(doors)).close()
    error = refusal.value
    assert (error.key, error.value) == ("endpoint", endpoint)
    assert re.search(problem, error.problem), error
    assert re.search(remedy, error.remedy or error.allowed), error


@pytest.mark.parametrize("who", ["bob", "rec", "tina"])
def test_command_without_the_role_is_refused_by_name(doors: Doors, who: str) -> None:
    with raises_input_error(problem=who):
        send_command("stop", "", doors.keyed, RIG, doors.keys(who))


def test_command_with_the_role_is_accepted(doors: Doors) -> None:
    assert "stop accepted" in send_command("stop", "", doors.keyed, RIG, doors.keys("anna"))


def test_a_foreign_client_without_a_certificate_is_refused(doors: Doors) -> None:
    only_authority: ZenohSettings = {
        "transport": {"link": {"tls": {"root_ca_certificate": str(doors.lab / "ca.pem")}}}
    }
    with pytest.raises(zenoh.ZError):
        session(doors.keyed, only_authority, SHORT_S)


def test_a_rig_without_keys_does_not_listen_to_the_network() -> None:
    for endpoint in ("tcp/0.0.0.0:7447", "tcp/192.168.1.5:7447", "tcp/[::]:7447", "tcp/rig:7447"):
        with raises_input_error(key="endpoint", value=endpoint, allowed="this machine only"):
            open_hub(RIG, endpoint)
    with raises_input_error(key="endpoint", value="tls/0.0.0.0:7447", remedy="--keys"):
        open_hub(RIG, "tls/0.0.0.0:7447")


def test_a_rig_with_keys_listens_on_every_interface(doors: Doors) -> None:
    port = free_port()
    with door(f"tls/0.0.0.0:{port}", keys=read_credentials(doors.lab)):
        link = open_spoke(RIG, f"tls/{HERE}:{port}", 5.0, doors.keys())
        assert link.query("state/status") == b"state/status"
        link.close()


def test_full_rig_reports_too_many_sessions(doors: Doors) -> None:
    endpoint = f"tls/{HERE}:{free_port()}"
    settings: ZenohSettings = {"transport": {"unicast": {"max_sessions": 1}}}
    with door(endpoint, extra_settings=settings, keys=read_credentials(doors.lab)):
        first = open_spoke(RIG, endpoint, 5.0, doors.keys())
        with raises_input_error(key="endpoint", value=endpoint, problem=TOO_MANY_SESSIONS.problem):
            open_spoke(RIG, endpoint, SHORT_S, doors.keys("bob"))
        first.close()


def test_ipv6_address_over_tls_is_reported(doors: Doors) -> None:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError as error:
        pytest.skip(f"no IPv6 here: {error}")
    endpoint = f"tls/[::1]:{free_port()}"
    with (
        door(endpoint, keys=read_credentials(doors.lab)),
        raises_input_error(key="endpoint", value=endpoint, problem=NO_IPV6.problem),
    ):
        open_spoke(RIG, endpoint, SHORT_S, doors.keys())


@pytest.mark.parametrize("says", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", None])
@pytest.mark.parametrize("with_keys", [True, False])
def test_other_servers_are_distinguished_in_time(
    doors: Doors, says: bytes | None, with_keys: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that closes, one that speaks otherwise, one that is silent."""
    monkeypatch.setattr(refusal_module, "CONNECT_TIMEOUT_S", 0.2)
    with socket.create_server((HERE, 0)) as server:

        def answer() -> None:
            guest, _ = server.accept()
            with guest:
                if says is not None:
                    guest.sendall(says)
                else:
                    while guest.recv(4096):
                        pass

        thread = threading.Thread(target=answer)
        thread.start()
        message = diagnose_refusal(
            HERE, server.getsockname()[1], doors.keys() if with_keys else None
        )
        thread.join()
    assert message == (refusal_module.NO_TLS if with_keys else None)
