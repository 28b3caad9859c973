"""Credentials: a folder of keys, verified, and the TLS and access settings made from it.

`shaketwin keys` makes two kinds of folder: the rig's, with the access list, and a person's.

| file            | content                                                | folder           |
|-----------------|--------------------------------------------------------|------------------|
| ca.pem          | certificate of the authority, verifies the peer        | both             |
| certificate.pem | own certificate; its common name is the user name      | both             |
| key.pem         | private key of that certificate, mode 0600             | both             |
| access.toml     | people and their roles                                 | the rig's        |
| ca.key.pem      | private key of the authority, needed only by `keys`    | the rig's, or at |
|                 |                                                        | a safer place    |

A certificate is verified against the authority before it is used.
"""

import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator

from table_io.clock import local_datetime
from table_io.config.base import ConfigModel, parse_toml, read_text
from table_io.errors import InputError
from twin.security.access_control import (
    NO_ROLE,
    RIG_NAME,
    ROUTER_ROLE,
    ZenohSettings,
    build_people_access,
)
from twin.security.certificate_authority import certificate_validity, verify_certificate

AUTHORITY_FILE = "ca.pem"
CERTIFICATE_FILE = "certificate.pem"
KEY_FILE = "key.pem"
ACCESS_FILE = "access.toml"
EXPIRY_WARNING_DAYS = 30  # before a certificate expires
MAX_NAME_LENGTH = 64  # X.509's upper bound of a common name
OTHERS_MODE_BITS, WRITE_BY_OTHERS_MODE_BITS = 0o077, 0o022
NAME_ALPHABET = frozenset("abcdefghijklmnopqrstuvwxyz0123456789_-")


def check_name(name: str) -> str:
    """Return `name` if it is valid for a person's certificate; raise InputError otherwise.

    Dots are not allowed: in alive/observer.<name>.<anything> `a` could pass for `a.b`.
    """
    if not (set(name) <= NAME_ALPHABET and 0 < len(name) <= MAX_NAME_LENGTH and name[0].isalnum()):
        raise InputError(
            "not a valid user name",
            value=name,
            allowed=f"up to {MAX_NAME_LENGTH} of a-z 0-9 _ -, starting with a letter or digit",
        )
    if name in (RIG_NAME, NO_ROLE):
        raise InputError("a reserved name", value=name, remedy="choose another")
    return name


class AccessList(ConfigModel):
    """Access list `access.toml`: role by the common name of a certificate."""

    people: dict[
        Annotated[str, AfterValidator(check_name)],
        Literal["observe", "record", "twin", "command", "router"],
    ]


def read_people(folder: Path) -> dict[str, str]:
    """Read the access list of a rig's folder; return role by name."""
    path = folder / ACCESS_FILE
    check_file_mode(path, WRITE_BY_OTHERS_MODE_BITS, "others may change it", "go-w")
    return dict(parse_toml(read_text(path, "access list"), AccessList, str(path)).people)


@dataclass(frozen=True, slots=True)
class Credentials:
    """Verified folder of keys, made by `read_credentials`.

    `people` maps name to role in the rig's folder and is None in a person's.
    """

    folder: Path
    name: str  # common name of the certificate
    valid_until: datetime  # expiry of the certificate
    people: Mapping[str, str] | None = field(repr=False)

    @property
    def days_left(self) -> int:
        """Whole days until the certificate expires."""
        return (self.valid_until - local_datetime()).days

    def tls_settings(self) -> ZenohSettings:
        """Return zenoh's settings for mutual TLS with certificates of this authority."""
        certificate, key = str(self.folder / CERTIFICATE_FILE), str(self.folder / KEY_FILE)
        tls = {
            "root_ca_certificate": str(self.folder / AUTHORITY_FILE),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        }
        return {"transport": {"link": {"tls": tls, "protocols": ["tls"]}}}

    def access_settings(self, rig: str) -> ZenohSettings:
        """Return zenoh's access-control settings of the rig's hub."""
        return build_people_access(rig, self.people or {})

    def without_twin_roles(self) -> "Credentials":
        """Return credentials in which role `twin` is `observe`, for a run with its own twin."""
        people = {
            name: "observe" if role == "twin" else role
            for name, role in (self.people or {}).items()
        }
        return replace(self, people=people)

    def role_of(self, name: str) -> str:
        """Return the current role of `name`, reading the list again so that removals take effect.

        Every role is `NO_ROLE` if the list cannot be read.
        """
        try:
            return read_people(self.folder).get(name, NO_ROLE)
        except InputError:
            return NO_ROLE

    def may_command(self, name: str) -> bool:
        """Return whether commands come from `name`: a person, a router, or the page of the rig."""
        return name == RIG_NAME or self.role_of(name) in ("command", ROUTER_ROLE)


def read_credentials(folder: Path) -> Credentials:
    """Read and verify the keys in a folder; raise InputError if they cannot be used."""
    # imported here, so that a run without keys does not load cryptography
    folder = folder.absolute()
    for name in (AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE):
        if not (folder / name).is_file():
            raise InputError(
                f"{name} is missing",
                key="--keys",
                value=str(folder),
                remedy="give a folder made by `shaketwin keys new` or `shaketwin keys add`",
            )
    check_file_mode(
        folder / KEY_FILE, OTHERS_MODE_BITS, "others on this machine may read it", "go-rwx"
    )
    create_tls_context(folder, ssl.PROTOCOL_TLS_CLIENT)  # the files are sound, the key matches
    path = folder / CERTIFICATE_FILE
    certificate, authority = path.read_bytes(), (folder / AUTHORITY_FILE).read_bytes()
    valid_from, valid_until = certificate_validity(certificate)
    time = local_datetime()
    if not valid_from <= time < valid_until:
        is_expired = time >= valid_until
        raise InputError(
            f"{'expired' if is_expired else 'not yet valid'}: it is now {time:%Y-%m-%d %H:%M}",
            where=path,
            allowed=f"{valid_from:%Y-%m-%d} to {valid_until:%Y-%m-%d}",
            remedy="ask for new keys (`shaketwin keys renew`)" if is_expired else "check the clock",
        )
    try:
        name = verify_certificate(certificate, authority, time)
    except ValueError as error:
        raise InputError(
            f"not issued by the authority in {AUTHORITY_FILE} of the same folder ({error})",
            where=path,
            remedy="ask for both together",
        ) from None
    people = read_people(folder) if (folder / ACCESS_FILE).exists() else None
    return Credentials(folder, name, valid_until, people)


def credentials_folder(keys: Credentials | None) -> str:
    """Return the path of the keys, to pass to another process, or "" without keys."""
    return "" if keys is None else str(keys.folder)


def read_rig_credentials(folder: Path) -> Credentials:
    """Read the keys of a rig; raise InputError for a person's folder."""
    keys = read_credentials(folder)
    if keys.people is None:
        raise InputError(
            f"the keys of {keys.name} are a person's and cannot open an endpoint",
            key="--keys",
            value=str(folder),
            remedy="give the rig's folder, which holds access.toml",
        )
    return keys


def check_file_mode(path: Path, bits: int, reason: str, remedy: str) -> None:
    """Raise InputError with a reason if the mode of a file has one of these bits."""
    try:
        mode = path.stat().st_mode
    except OSError as error:
        raise InputError(
            f"cannot read: {error.strerror}",
            where=path,
            remedy="give a folder made by `shaketwin keys`",
        ) from None
    if mode & bits:
        raise InputError(
            reason,
            where=path,
            key="mode",
            value=f"{mode & 0o777:04o}",
            remedy=f"chmod {remedy} {path}",
        )


def create_tls_context(folder: Path, side: int) -> ssl.SSLContext:
    """Return a TLS 1.3 context that presents the certificate and verifies the peer's."""
    context = ssl.SSLContext(side)
    context.minimum_version = ssl.TLSVersion.TLSv1_3
    try:
        context.load_cert_chain(folder / CERTIFICATE_FILE, folder / KEY_FILE, password=lambda: "")
    except ssl.SSLError as error:
        if error.reason == "KEY_VALUES_MISMATCH":
            problem = f"{KEY_FILE} does not belong to {CERTIFICATE_FILE}"
        else:
            problem = f"{CERTIFICATE_FILE} or {KEY_FILE} is damaged, encrypted or no PEM file"
        raise InputError(
            problem, key="--keys", value=str(folder), remedy="ask for new keys"
        ) from None
    except OSError as error:
        raise InputError(
            f"cannot read the keys: {error.strerror}",
            key="--keys",
            value=str(folder),
            remedy="check the permissions of the folder and its files",
        ) from None
    try:
        context.load_verify_locations(folder / AUTHORITY_FILE)
    except (ssl.SSLError, OSError):
        raise InputError(
            "not the certificate of an authority",
            where=folder / AUTHORITY_FILE,
            remedy="ask for it again",
        ) from None
    context.verify_mode = ssl.CERT_REQUIRED
    return context
