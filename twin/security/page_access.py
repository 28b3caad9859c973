"""Access to the web page: who may open it, under which names, and how a person logs in.

| credentials of the page | address     | a person                                      |
|-------------------------|-------------|-----------------------------------------------|
| none                    | loopback    | is the user of this process, as for `control` |
| a person's              | loopback    | is that person, by a code made at the start   |
| the rig's               | any, by TLS | logs in with a code of `shaketwin keys code`  |

A code travels in the fragment of an address, which browsers do not send, and then in a header.
There are no cookies, so no other page can act in a person's name. The rig's folder holds hashes of
the codes in codes.toml; the role is read from access.toml at each request.
"""

import base64
import hashlib
import hmac
import secrets
import ssl
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import date
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated

from pydantic import AfterValidator, Field

from table_io.clock import local_datetime
from table_io.config.base import ConfigModel, parse_toml, read_text
from table_io.errors import InputError
from twin.security.access_control import NO_ROLE, user_name
from twin.security.certificate_authority import certificate_hosts
from twin.security.credentials import (
    CERTIFICATE_FILE,
    WRITE_BY_OTHERS_MODE_BITS,
    Credentials,
    check_file_mode,
    check_name,
    create_tls_context,
)

CODES_FILE = "codes.toml"
CODE_BYTES = 15  # 120 bits, 24 characters
CODE_DAYS = 90  # for which a code is valid
LOOPBACK_HOSTS = ("127.0.0.1", "localhost", "::1")
HTTP_PORT, HTTPS_PORT = 80, 443


class CodeEntry(ConfigModel):
    """Access code of a person: its hash and last day."""

    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    valid_until: date


class CodeList(ConfigModel):
    """Access codes `codes.toml` by the name of the person."""

    codes: dict[Annotated[str, AfterValidator(check_name)], CodeEntry] = Field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class PageAccess:
    """Access rules of a page; `identify` returns the name that belongs to a code, or ""."""

    hosts: frozenset[str]  # accepted in the header Host
    tls: ssl.SSLContext | None
    identify: Callable[[str], str]
    role_of: Callable[[str], str] | None  # None: ask the gateway
    code: str = ""  # of the person who started the page

    @property
    def scheme(self) -> str:
        return "http" if self.tls is None else "https"


def create_code() -> str:
    """Return a new access code in groups of four characters."""
    text = base64.b32encode(secrets.token_bytes(CODE_BYTES)).decode().lower()
    return "-".join(text[k : k + 4] for k in range(0, len(text), 4))


def hash_code(code: str) -> str:
    """Return the SHA-256 of a code as typed: case, blanks and dashes do not matter."""
    plain = code.replace("-", "").replace(" ", "").lower()
    return hashlib.sha256(plain.encode(errors="replace")).hexdigest()


def read_codes(folder: Path) -> dict[str, CodeEntry]:
    """Return the access codes of a rig's folder by name; empty if none was issued."""
    path = folder / CODES_FILE
    if not path.exists():
        return {}
    check_file_mode(path, WRITE_BY_OTHERS_MODE_BITS, "others may change it", "go-w")
    return parse_toml(read_text(path, "access codes"), CodeList, str(path)).codes


def identify_person(keys: Credentials, code: str) -> str:
    """Return the person on the access list to whom a valid code was issued, or ""."""
    try:
        codes = read_codes(keys.folder)
    except InputError:
        return ""
    digest, today, name = hash_code(code), local_datetime().date(), ""
    for person, entry in codes.items():
        if hmac.compare_digest(entry.sha256, digest) and today <= entry.valid_until:
            name = person
    return name if name and keys.role_of(name) != NO_ROLE else ""


def grant_page_access(host: str, port: int, keys: Credentials | None) -> PageAccess:
    """Return the access rules of a page at this address.

    Raises InputError beyond loopback without the rig's credentials.
    """
    is_loopback = is_loopback_host(host)
    if keys is not None and keys.people is not None:
        names = certificate_hosts((keys.folder / CERTIFICATE_FILE).read_bytes())
        tls = create_tls_context(keys.folder, ssl.PROTOCOL_TLS_SERVER)
        tls.verify_mode = ssl.CERT_NONE  # browsers log in with a code
        hosts = _host_headers(names, port, HTTPS_PORT)
        return PageAccess(hosts, tls, lambda code: identify_person(keys, code), keys.role_of)
    if not is_loopback:
        raise InputError(
            "would be open to the network without login",
            key="--web-listen",
            value=f"{host}:{port}",
            allowed="127.0.0.1:PORT, or any address with the rig's --keys FOLDER",
            remedy="make keys with `shaketwin keys new FOLDER --host HOST`",
        )
    hosts = _host_headers((*LOOPBACK_HOSTS, host.strip("[]")), port, HTTP_PORT)
    name = user_name(keys)
    if keys is None:
        return PageAccess(hosts, None, lambda _: name, None)
    code = create_code()
    digest = hash_code(code)
    return PageAccess(
        hosts,
        None,
        lambda typed: name if hmac.compare_digest(hash_code(typed), digest) else "",
        None,
        code,
    )


def is_loopback_host(host: str) -> bool:
    """Return whether a host name or address is this computer's loopback interface."""
    if host == "localhost":
        return True
    try:
        return ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _host_headers(names: Iterable[str], port: int, default_port: int) -> frozenset[str]:
    """Return the values of the header Host for these names; browsers omit a default port."""
    suffixes = (f":{port}", "") if port == default_port else (f":{port}",)
    return frozenset(_bracket(name).lower() + suffix for name in names for suffix in suffixes)


def _bracket(host: str) -> str:
    return f"[{host}]" if ":" in host else host
