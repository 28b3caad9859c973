"""`shaketwin keys`: certificate authority of a laboratory, keys of the rig and of people.

    FOLDER/ca.pem, ca.key.pem            the authority; its private key stays here
    FOLDER/certificate.pem, key.pem      the rig's
    FOLDER/access.toml                   access list: role by name
    FOLDER/codes.toml                    hashes of the access codes of the web page
    FOLDER/people/NAME/                  ca.pem, certificate.pem, key.pem: to be handed over
    FOLDER/issued/NAME.1.pem             every certificate issued to a person

Folders have mode 0700 and files 0600. Only `renew` replaces keys, and a name is never reused for
another person: its old certificate would become valid again.
"""

import enum
import json
import os
import re
import secrets
import socket
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from itertools import count
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from table_io.clock import local_datetime
from table_io.config.base import parse_toml
from table_io.errors import InputError, suggest
from twin.security.access_control import NO_ROLE, RIG_NAME, ROLES, ROUTER_ROLE, build_router_access
from twin.security.certificate_authority import (
    CertificateKeyPair,
    certificate_hosts,
    certificate_validity,
    create_authority,
    issue_certificate,
)
from twin.security.credentials import (
    ACCESS_FILE,
    AUTHORITY_FILE,
    CERTIFICATE_FILE,
    EXPIRY_WARNING_DAYS,
    KEY_FILE,
    AccessList,
    Credentials,
    check_name,
    read_people,
)
from twin.security.page_access import (
    CODE_DAYS,
    CODES_FILE,
    CodeEntry,
    create_code,
    hash_code,
    read_codes,
)
from twin.system.terminal import console, print_line, print_qr_code, print_table
from twin.transport.endpoint import (
    PUBLIC_HUB_SETTINGS,
    check_endpoint,
    merge_settings,
    session_settings,
)

AUTHORITY_KEY = "ca.key.pem"
PEOPLE_FOLDER, ISSUED_FOLDER = "people", "issued"
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
HOST_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
ACCESS_TEXT = f"""\
# Role of each user, by the name in the certificate. `shaketwin keys add` and `remove` edit this
# file; a role may be changed by hand: {", ".join(ROLES)}. A name that is missing here is refused.
[people]
"""

keys_app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    help="Manage credentials and roles for access over a network (twin/security/KEYS.md).",
)

FolderArgument = Annotated[
    Path, typer.Argument(metavar="FOLDER", help="The laboratory's credentials folder.")
]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of a user: a-z 0-9 _ -.")]


class Role(enum.StrEnum):
    """Role of a user at the rig."""

    observe = "observe"
    record = "record"
    twin = "twin"
    command = "command"
    router = "router"


@keys_app.command("new")
def create_keys(
    folder: FolderArgument,
    hosts: Annotated[
        list[str] | None,
        typer.Option("--host", help="Name or address of the rig's machine; repeatable."),
    ] = None,
) -> None:
    """Create an authority, the rig's credentials and an empty list of users."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(
            "exists and has content; keys are never overwritten",
            where=folder,
            remedy="give a new folder",
        )
    hostnames = [socket.gethostname(), socket.getfqdn()]
    names = [
        *LOCAL_HOSTS,
        *(hostname for hostname in hostnames if _is_host(hostname)),
        *map(_validate_host, hosts or ()),
    ]
    names = list(dict.fromkeys(name.lower() for name in names))
    issued_at = local_datetime()
    authority = create_authority(
        f"shaketwin {issued_at:%Y-%m-%d} {secrets.token_hex(4)}", issued_at
    )
    rig = issue_certificate(authority, RIG_NAME, names, issued_at)
    access = {ACCESS_FILE: ACCESS_TEXT.encode(), AUTHORITY_KEY: authority.key}
    _write_files(folder, access | _key_files(authority.certificate, rig))
    print_line(f"{folder}: an authority, and the rig's keys as {', '.join(names)}")
    print_line(f"next: shaketwin keys add {folder} NAME --role {'|'.join(ROLES)}")
    print_line(f"then: shaketwin run PROFILE --listen tls/HOST:7447 --keys {folder}")


@keys_app.command("add")
def add_command(
    folder: FolderArgument,
    name: NameArgument,
    role: Annotated[Role, typer.Option("--role", help="Role of the user.")],
    host: Annotated[
        list[str] | None, typer.Option("--host", help="Name or address of a router.")
    ] = None,
) -> None:
    """Create credentials for a user in FOLDER/people/NAME and add the user to access.toml."""
    add_person(folder, name, role.value, host or [])


def add_person(folder: Path, name: str, role: str, hosts: Sequence[str]) -> None:
    """Issue keys to a new name, to be handed over; `hosts` are those of a router."""
    check_name(name)
    if (role == ROUTER_ROLE) != bool(hosts):
        raise InputError(
            "the role router and --host go together",
            key="--role",
            value=role,
            remedy="give both for a router, and omit --host for a user",
        )
    people, person_folder = read_people(folder), folder / PEOPLE_FOLDER / name
    if _list_issued(folder, name) or name in people or person_folder.exists():
        raise InputError(
            "this name has been used, and its old certificate would become valid again",
            where=folder,
            key="NAME",
            value=name,
            remedy="choose another name, or renew the keys of the same person: "
            f"shaketwin keys renew {folder} {name}",
        )
    pair = _issue(folder, name, [_validate_host(host) for host in hosts])
    text = f'{(folder / ACCESS_FILE).read_text().rstrip()}\n{name} = "{role}"\n'
    _check_access(folder, text, people | {name: role})
    _write_handover(folder, name, pair)
    _write_files(folder, {ACCESS_FILE: text.encode()})
    print_line(
        f"{person_folder}: keys of {name}, role {role}; hand the folder over securely, and delete "
        "it here"
    )


@keys_app.command("renew")
def renew_keys(
    folder: FolderArgument,
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="User; default: the rig.")
    ] = None,
    hosts: Annotated[list[str] | None, typer.Option("--host", help="Replace its hosts.")] = None,
) -> None:
    """Renew credentials before they expire; the old ones are kept."""
    hosts = [_validate_host(host) for host in hosts or ()]
    if name is None:
        old_hosts = certificate_hosts(_read(folder / CERTIFICATE_FILE))
        rig = _issue(folder, RIG_NAME, list(dict.fromkeys([*LOCAL_HOSTS, *(hosts or old_hosts)])))
        _write_files(folder, _key_files(_read(folder / AUTHORITY_FILE), rig))
        print_line(f"{folder}: new keys of the rig; restart what uses the old ones")
        return
    people = read_people(folder)
    certificates = _list_issued(folder, name) if name in people else []
    if not certificates:
        raise _unknown_name_error(folder, name, people)
    if hosts and people[name] != ROUTER_ROLE:
        raise InputError(
            f"{name} has the role {people[name]}; only a router has hosts",
            key="--host",
            value=hosts[0],
            remedy="omit it",
        )
    old_hosts = certificate_hosts(_read(certificates[-1]))
    _write_handover(folder, name, _issue(folder, name, hosts or old_hosts))
    print_line(
        f"{folder / PEOPLE_FOLDER / name}: new keys, to be handed over; the old ones stay valid "
        "until they expire"
    )


@keys_app.command("code")
def issue_code(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="User on the access list.")],
    page: Annotated[
        str,
        typer.Option(
            "--page", metavar="URL", help="Address of the page: prints a QR code that logs in."
        ),
    ] = "",
) -> None:
    """Issue a code with which a user logs in to the web page; it replaces an earlier one."""
    if name not in read_people(folder):
        raise _unknown_name_error(folder, name, read_people(folder))
    if page and not re.fullmatch(r"https://[^/#?\s]+/?", page):
        raise InputError(
            "not the address of a page",
            key="--page",
            value=page,
            allowed="https://HOST:PORT, as printed by `shaketwin run --web-listen`",
        )
    code, last_day = create_code(), local_datetime().date() + timedelta(days=CODE_DAYS)
    codes = read_codes(folder) | {name: CodeEntry(sha256=hash_code(code), valid_until=last_day)}
    entries = [
        f'[codes.{person}]\nsha256 = "{entry.sha256}"\nvalid_until = {entry.valid_until}\n'
        for person, entry in codes.items()
    ]
    _write_files(folder, {CODES_FILE: "\n".join(entries).encode()})
    print_line(f"access code of {name} until {last_day}, shown only now: {code}")
    if page:
        url = f"{page.rstrip('/')}/#{code}"
        print_line(url)
        print_qr_code(url)


@keys_app.command("remove")
def remove_person(folder: FolderArgument, name: NameArgument) -> None:
    """Revoke a user's role: the certificate is refused from then on."""
    people = read_people(folder)
    if name not in people:
        raise _unknown_name_error(folder, name, people)
    line = re.compile(rf"""^\s*["']?{re.escape(name)}["']?\s*=.*\n?""", re.MULTILINE)
    text = line.sub("", (folder / ACCESS_FILE).read_text())
    _check_access(folder, text, {other: role for other, role in people.items() if other != name})
    _write_files(folder, {ACCESS_FILE: text.encode()})
    print_line(
        f"{name}: role revoked. Commands are refused from now on; in a running test {name} can "
        "still watch until its gateway restarts"
    )


@keys_app.command("list")
def list_keys(folder: FolderArgument) -> None:
    """List users, roles and the expiry of their certificates."""
    people = read_people(folder)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("name", "role", "valid until", ""):
        table.add_column(title)
    table.add_row("(authority)", "", *_describe_expiry(folder / AUTHORITY_FILE))
    table.add_row("(rig)", "", *_describe_expiry(folder / CERTIFICATE_FILE))
    issued = {path.name.partition(".")[0] for path in (folder / ISSUED_FOLDER).glob("*.pem")}
    for name in sorted(issued | people.keys()):
        newest = _list_issued(folder, name)[-1:] or [folder / ISSUED_FOLDER / name]
        table.add_row(name, people.get(name, NO_ROLE), *_describe_expiry(newest[0]))
    print_table(console, table)


def _describe_expiry(path: Path) -> tuple[str, str]:
    """Return (expiry date of a certificate, remark)."""
    try:
        expires_at = certificate_validity(path.read_bytes())[1]
    except OSError:
        return "?", "not issued here"
    except ValueError:
        return "?", "damaged"
    days = (expires_at - local_datetime()).days
    note = "EXPIRED" if days < 0 else f"{days} days left" if days < EXPIRY_WARNING_DAYS else ""
    return f"{expires_at:%Y-%m-%d}", note


def _issue(folder: Path, name: str, hosts: Sequence[str]) -> CertificateKeyPair:
    authority = CertificateKeyPair(_read(folder / AUTHORITY_FILE), _read(folder / AUTHORITY_KEY))
    time = local_datetime()
    try:
        expires_at = certificate_validity(authority.certificate)[1]
        if time < expires_at:
            return issue_certificate(authority, name, hosts, time)
    except (ValueError, TypeError):
        raise InputError(
            f"{AUTHORITY_FILE} or {AUTHORITY_KEY} is damaged, or they do not belong together",
            where=folder,
            remedy="restore both from a backup",
        ) from None
    raise InputError(
        f"the authority expired on {expires_at:%Y-%m-%d}",
        where=folder / AUTHORITY_FILE,
        remedy="make new keys for everyone in another folder: `shaketwin keys new`",
    )


def _list_issued(folder: Path, name: str) -> list[Path]:
    """Return the certificates issued to a name, the newest last."""
    paths = (folder / ISSUED_FOLDER).glob(f"{name}.*.pem")
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def _write_handover(folder: Path, name: str, pair: CertificateKeyPair) -> None:
    """Write the folder for a person; its certificate is listed in issued/ first."""
    issued = folder / ISSUED_FOLDER
    copies = (f"{name}.{number}.pem" for number in count(1))
    copy_name = next(copy for copy in copies if not (issued / copy).exists())
    _write_files(issued, {copy_name: pair.certificate})
    _write_files(folder / PEOPLE_FOLDER, {})
    files = _key_files(_read(folder / AUTHORITY_FILE), pair)
    _write_files(folder / PEOPLE_FOLDER / name, files)


def _key_files(authority: bytes, pair: CertificateKeyPair) -> dict[str, bytes]:
    return {AUTHORITY_FILE: authority, KEY_FILE: pair.key, CERTIFICATE_FILE: pair.certificate}


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read: {error.strerror}",
            where=path,
            remedy="give the folder made by `shaketwin keys new`, with the authority's key",
        ) from None


def _write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write files of mode 0600, each atomically, to a folder that is created with mode 0700."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as staging:
            for name, content in files.items():
                path = Path(staging) / name
                descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
                with os.fdopen(descriptor, "wb") as file:
                    file.write(content)
            for name in files:
                (Path(staging) / name).replace(folder / name)
    except OSError as error:
        raise InputError(
            f"cannot write here: {error.strerror}",
            where=folder,
            remedy="make it writable, or give another folder",
        ) from None


def _check_access(folder: Path, text: str, people: Mapping[str, str]) -> None:
    """Raise InputError if an edited, perhaps hand-written access list is not as intended."""
    path = folder / ACCESS_FILE
    if parse_toml(text, AccessList, str(path)).people != people:
        raise InputError(
            "this access list was edited so that it cannot be changed automatically",
            where=path,
            remedy="edit it by hand",
        )


def _unknown_name_error(folder: Path, name: str, people: Iterable[str]) -> InputError:
    return InputError(
        "no user of this name",
        where=folder / ACCESS_FILE,
        key="NAME",
        value=name,
        remedy=suggest(name, sorted(people)),
    )


def _is_host(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return len(host) < 254 and bool(re.fullmatch(rf"{HOST_LABEL}(\.{HOST_LABEL})*", host))
    return True


def _validate_host(host: str) -> str:
    if not _is_host(host):
        raise InputError(
            "not a host name or address",
            key="--host",
            value=host,
            allowed="a name or an IP address without port, such as rig.lab.example or 192.168.1.20",
        )
    return host


@keys_app.command("router")
def print_router_settings(
    folder: FolderArgument,
    name: Annotated[str, typer.Argument(metavar="NAME", help="User with the role router.")],
    listen: Annotated[
        str, typer.Option("--listen", help="Endpoint at which the router listens.")
    ] = "tls/0.0.0.0:7447",
    rig: Annotated[str, typer.Option("--table", help="Name of the rig.")] = "simulated",
) -> None:
    """Print the configuration of a zenoh router (zenohd) with the same access control."""
    # For a zenohd started in FOLDER/people/NAME; the access list in it is the current one.
    people = read_people(folder)
    if people.get(name) != ROUTER_ROLE:
        routers = [router for router, role in people.items() if role == ROUTER_ROLE]
        raise InputError(
            "does not have the role router",
            where=folder / ACCESS_FILE,
            key="NAME",
            value=name,
            remedy=f"{suggest(name, routers)}; or add one: shaketwin keys add {folder} NAME "
            "--role router --host HOST",
        )
    check_endpoint(rig, listen, has_keys=True)
    router_keys = Credentials(Path(), name, datetime.now(UTC), None)
    router_settings = merge_settings(
        PUBLIC_HUB_SETTINGS,
        merge_settings(router_keys.tls_settings(), build_router_access(rig, people)),
    )
    print(
        json.dumps(
            merge_settings(session_settings("router", "listen", listen, 0), router_settings),
            indent=1,
        )
    )
