"""A folder of keys: looked at, and as the settings of a session that uses them.

Two kinds of folder, both made by `shaketwin keys`: the rig's, with the list of people who may come
in, and a person's. Of the files in them

| file            | is                                                     | in whose folder  |
|-----------------|--------------------------------------------------------|------------------|
| ca.pem          | certificate of the authority, by which others are told | both             |
| certificate.pem | own certificate; its common name says who this is      | both             |
| key.pem         | private key of it, readable by nobody else             | both             |
| access.toml     | the people and their roles                             | the rig's        |
| ca.key.pem      | private key of the authority, needed only by `keys`    | the rig's, or at |
|                 |                                                        | a safer place    |

A certificate is verified as a peer would, by a handshake in memory.
"""

import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator

from table_io.card import BadInput, Card, parse, read_text
from table_io.clock import today
from twin.stream.access import NOBODY, RIG, people_access

AUTHORITY, CERTIFICATE, KEY, ACCESS = "ca.pem", "certificate.pem", "key.pem", "access.toml"
SOON_DAYS = 30  # before the end of a certificate, in which it is said
LONGEST_NAME = 64  # X.509's upper bound of a common name
NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME: dates are looked at here, to say them
OTHERS, WRITING = 0o077, 0o022  # bits of a file's mode
ALPHABET = frozenset("abcdefghijklmnopqrstuvwxyz0123456789_-")


def checked_name(name: str) -> str:
    """The name itself; ValueError where it cannot be a person's.

    No dot: in alive/observer.<name>.<anything> it would let `a` be there as `a.b`.
    """
    if not (set(name) <= ALPHABET and 0 < len(name) <= LONGEST_NAME and name[0].isalnum()):
        raise ValueError(
            f"{name!r} is no name for a certificate; allowed: up to {LONGEST_NAME} of a-z 0-9 _ -, "
            "the first a letter or digit"
        )
    if name in (RIG, NOBODY):
        raise ValueError(f"{name!r} is taken; choose another name")
    return name


class Access(Card):
    """`access.toml`: the people whom the rig knows, by the name in their certificate."""

    people: dict[
        Annotated[str, AfterValidator(checked_name)],
        Literal["observe", "record", "twin", "command", "router"],
    ]


def read_people(folder: Path) -> dict[str, str]:
    """Name and role of everybody in the access list of a rig's folder."""
    path = folder / ACCESS
    _private(path, WRITING, "others may change it", "go-w")
    return dict(parse(read_text(path, "access list"), Access, str(path)).people)


@dataclass(frozen=True, slots=True)
class Keys:
    """A folder of keys that is in order; `read_keys` makes it.

    `people` is None in a person's folder.
    """

    folder: Path
    name: str  # the common name of the certificate
    until: datetime  # when it expires
    people: Mapping[str, str] | None = field(repr=False)

    @property
    def days_left(self) -> int:
        """Whole days until it expires."""
        return (self.until - today()).days

    def tls(self) -> dict[str, Any]:
        """zenoh's settings: both ends show a certificate of this authority, at all times."""
        certificate, key = str(self.folder / CERTIFICATE), str(self.folder / KEY)
        tls = {
            "root_ca_certificate": str(self.folder / AUTHORITY),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }
        return {"transport": {"link": {"tls": tls, "protocols": ["tls"]}}}

    def access(self, rig: str) -> dict[str, Any]:
        """zenoh's settings of the rig's hub: who may do what."""
        return people_access(rig, self.people or {})

    def without_twins(self) -> "Keys":
        """The same for a run with a twin of its own: one elsewhere may look on, like others."""
        people = {
            name: "observe" if role == "twin" else role
            for name, role in (self.people or {}).items()
        }
        return replace(self, people=people)

    def role(self, who: str) -> str:
        """The role that `who` has now: the list is read again, so that a removal holds at once.

        A list that cannot be read any more gives nobody a role.
        """
        try:
            return read_people(self.folder).get(who, NOBODY)
        except BadInput:
            return NOBODY


def read_keys(folder: Path) -> Keys:
    """The keys in a folder; BadInput says what is wrong with them and who can mend it."""
    folder = folder.absolute()
    for name in (AUTHORITY, CERTIFICATE, KEY):
        if not (folder / name).is_file():
            raise BadInput(
                f"--keys {folder}: {name} is missing; give a folder that `shaketwin keys new` or "
                "`shaketwin keys add` has made"
            )
    _private(folder / KEY, OTHERS, "others on this machine may read it", "go-rwx")
    shown = _shown(folder)
    begins, ends = (
        datetime.fromtimestamp(ssl.cert_time_to_seconds(shown[when]), UTC)
        for when in ("notBefore", "notAfter")
    )
    now = today()
    if not begins <= now < ends:
        remedy = "ask for new keys (`shaketwin keys renew`)" if now >= ends else "check the clock"
        raise BadInput(
            f"{folder / CERTIFICATE}: good from {begins:%Y-%m-%d} to {ends:%Y-%m-%d}, now it is "
            f"{now:%Y-%m-%d %H:%M}: {'expired' if now >= ends else 'not yet good'}; {remedy}"
        )
    names = dict(entry for part in shown["subject"] for entry in part)
    people = read_people(folder) if (folder / ACCESS).exists() else None
    return Keys(folder, names.get("commonName", ""), ends, people)


def folder_of(keys: Keys | None) -> str:
    """Path of these keys, for another process to read them; "" where there are none."""
    return "" if keys is None else str(keys.folder)


def read_rig_keys(folder: Path) -> Keys:
    """The same of a rig's folder; BadInput where it is a person's."""
    keys = read_keys(folder)
    if keys.people is None:
        raise BadInput(
            f"--keys {folder}: these are the keys of {keys.name}, who cannot listen for others; "
            "give the rig's folder, which holds access.toml"
        )
    return keys


def _private(path: Path, bits: int, why: str, remedy: str) -> None:
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise BadInput(f"{path}: cannot read it: {error.strerror}") from None
    if mode & bits:
        raise BadInput(f"{path}: mode {mode & 0o777:04o}, {why}; chmod {remedy} {path}")


def own_context(folder: Path, side: int) -> ssl.SSLContext:
    """TLS with the keys in a folder: shows the certificate, verifies the peer by the authority."""
    context = ssl.SSLContext(side)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(folder / CERTIFICATE, folder / KEY, password=lambda: "")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            what = f"{KEY} does not belong to {CERTIFICATE}"
        else:
            what = f"{CERTIFICATE} or {KEY} is damaged, encrypted or no PEM file"
        raise BadInput(f"--keys {folder}: {what}; ask for new keys") from None
    except OSError as error:
        raise BadInput(f"--keys {folder}: cannot read the keys: {error.strerror}") from None
    try:
        context.load_verify_locations(folder / AUTHORITY)
    except (ssl.SSLError, OSError):
        raise BadInput(
            f"{folder / AUTHORITY}: not the certificate of an authority; ask for it again"
        ) from None
    context.verify_mode = ssl.CERT_REQUIRED
    return context


def _shown(folder: Path) -> dict[str, Any]:
    """What a peer sees of the certificate in a folder, verified by the authority beside it."""
    guest, host = (
        own_context(folder, side) for side in (ssl.PROTOCOL_TLS_CLIENT, ssl.PROTOCOL_TLS_SERVER)
    )
    guest.check_hostname = False
    guest.verify_mode = ssl.CERT_NONE
    host.verify_flags |= NO_CHECK_TIME
    to_guest, to_host = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = [guest.wrap_bio(to_guest, to_host), host.wrap_bio(to_host, to_guest, server_side=True)]
    try:
        for end in (*ends, *ends):
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    except ssl.SSLError as error:
        why = getattr(error, "verify_message", "") or error.reason
        raise BadInput(
            f"{folder / CERTIFICATE}: not issued by the authority in {AUTHORITY} beside it "
            f"({why}); ask for both together"
        ) from None
    return ends[1].getpeercert() or {}
