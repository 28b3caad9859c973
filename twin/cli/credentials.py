"""`shaketwin keys`: certificate authority of a laboratory, keys of the rig and of people.

    FOLDER/ca.pem, ca.key.pem            the authority; its private key stays here
    FOLDER/certificate.pem, key.pem      the rig's
    FOLDER/access.toml                   access list: role by name
    FOLDER/people/NAME/                  ca.pem, certificate.pem, key.pem: to be handed over
    FOLDER/issued/NAME.1.pem             every certificate issued to a person
    FOLDER/replaced/NAME.1/              keys replaced by `renew`

Folders have mode 0700 and private keys 0600. Nothing is ever overwritten, and a name is never
reused for another person: its old certificate would become valid again.
"""

import json
import os
import re
import secrets
import socket
import tempfile
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from ipaddress import ip_address
from itertools import count
from pathlib import Path

from rich.table import Table

from table_io.clock import local_datetime
from table_io.config.base import parse_toml
from table_io.errors import InputError, suggest
from twin.run.terminal import console, print_line, print_table
from twin.security.access_control import NO_ROLE, RIG_NAME, ROLES, ROUTER_ROLE, build_router_access
from twin.security.certificate_authority import (
    CertificateKeyPair,
    certificate_expiry,
    certificate_hosts,
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
from twin.transport.endpoint import (
    PUBLIC_HUB_SETTINGS,
    check_endpoint,
    merge_settings,
    session_settings,
)

AUTHORITY_KEY = "ca.key.pem"
PEOPLE_FOLDER, ISSUED_FOLDER, REPLACED_FOLDER = "people", "issued", "replaced"
LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
HOST_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
ACCESS_TEXT = f"""\
# Role of each user, by the name in the certificate. `shaketwin keys add` and `remove` edit this
# file; a role may be changed by hand: {", ".join(ROLES)}. A name that is missing here is refused.
[people]
"""


def create_keys(folder: Path, hosts: Sequence[str]) -> None:
    """Create an authority and the rig's keys in a new folder; InputError if it has content.

    The rig's certificate is valid for this computer's names and `hosts`.
    """
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
        *map(_validate_host, hosts),
    ]
    names = list(dict.fromkeys(name.lower() for name in names))
    issued_at = local_datetime()
    authority = create_authority(
        f"shaketwin {issued_at:%Y-%m-%d} {secrets.token_hex(4)}", issued_at
    )
    rig = issue_certificate(authority, RIG_NAME, names, issued_at)
    public = {AUTHORITY_FILE: authority.certificate, CERTIFICATE_FILE: rig.certificate}
    public[ACCESS_FILE] = ACCESS_TEXT.encode()
    _make_folder(folder, public, {AUTHORITY_KEY: authority.key, KEY_FILE: rig.key})
    print_line(f"{folder}: an authority, and the rig's keys as {', '.join(names)}")
    print_line(f"next: shaketwin keys add {folder} NAME --role {'|'.join(ROLES)}")
    print_line(f"then: shaketwin run PROFILE --listen tls/HOST:7447 --keys {folder}")


def add_person(folder: Path, name: str, role: str, hosts: Sequence[str]) -> None:
    """Issue keys to a new name, to be handed over; `hosts` are those of a router."""
    try:
        check_name(name)
    except ValueError as error:
        raise InputError(str(error)) from None
    if (role == ROUTER_ROLE) != bool(hosts):
        raise InputError(
            "the role router and --host go together",
            where=f"--role {role}",
            remedy="give both for a router, and omit --host for a user",
        )
    people = read_people(folder)
    if _list_issued(folder, name) or name in people:
        raise InputError(
            "this name has been used, and its old certificate would become valid again",
            where=name,
            remedy="choose another name, or renew the keys of the same person: "
            f"shaketwin keys renew {folder} {name}",
        )
    pair = _issue(folder, name, [_validate_host(host) for host in hosts])
    text = f'{(folder / ACCESS_FILE).read_text().rstrip()}\n{name} = "{role}"\n'
    _check_access(folder, text, people | {name: role})
    _write_handover(folder, name, pair)
    _write_access(folder, text)
    print_line(
        f"{folder / PEOPLE_FOLDER / name}: keys of {name}, role {role}; hand the folder over "
        "securely, and delete it here"
    )


def renew_keys(folder: Path, name: str | None, hosts: Sequence[str]) -> None:
    """Renew the keys of a person or, without a name, of the rig; the old ones are kept.

    Without `hosts` the new certificate is valid for those of the old one.
    """
    if name is None:
        _renew_rig(folder, [_validate_host(host) for host in hosts])
        return
    people = read_people(folder)
    certificates = _list_issued(folder, name) if name in people else []
    if not certificates:
        raise _unknown_name_error(folder, name)
    if hosts and people[name] != ROUTER_ROLE:
        raise InputError(
            f"{name} has the role {people[name]}; only a router has hosts",
            where="--host",
            remedy="omit it",
        )
    names = [_validate_host(host) for host in hosts] or certificate_hosts(_read(certificates[-1]))
    pair = _issue(folder, name, names)
    person_folder = folder / PEOPLE_FOLDER / name
    if person_folder.exists():
        person_folder.rename(_next_replaced_folder(folder, name))
    _write_handover(folder, name, pair)
    print_line(f"{person_folder}: new keys; the old ones stay valid until they expire")


def _renew_rig(folder: Path, hosts: Sequence[str]) -> None:
    old = {name: _read(folder / name) for name in (CERTIFICATE_FILE, KEY_FILE)}
    pair = _issue(
        folder,
        RIG_NAME,
        list(dict.fromkeys([*LOCAL_HOSTS, *(hosts or certificate_hosts(old[CERTIFICATE_FILE]))])),
    )
    replaced_folder = _next_replaced_folder(folder, RIG_NAME)
    _make_folder(
        replaced_folder, {CERTIFICATE_FILE: old[CERTIFICATE_FILE]}, {KEY_FILE: old[KEY_FILE]}
    )
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new_folder:
        _write_files(Path(new_folder), {CERTIFICATE_FILE: pair.certificate}, {KEY_FILE: pair.key})
        for file in (KEY_FILE, CERTIFICATE_FILE):
            (Path(new_folder) / file).replace(folder / file)
    print_line(
        f"{folder}: new keys of the rig; the old ones, in {replaced_folder}, stay valid until "
        "they expire"
    )


def remove_person(folder: Path, name: str) -> None:
    """Revoke a person's role; the gateway rejects the certificate from its next start on."""
    people = read_people(folder)
    if name not in people:
        raise _unknown_name_error(folder, name)
    line = re.compile(rf"""^\s*["']?{re.escape(name)}["']?\s*=.*\n?""", re.MULTILINE)
    text = line.sub("", (folder / ACCESS_FILE).read_text())
    _check_access(folder, text, {other: role for other, role in people.items() if other != name})
    _write_access(folder, text)
    print_line(
        f"{name}: role revoked. Commands are refused from now on; in a running test {name} can "
        "still watch until its gateway restarts"
    )


def list_keys(folder: Path) -> None:
    """Print role and expiry of every name, of the rig and of the authority."""
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
        expires_at = certificate_expiry(path.read_bytes())
    except OSError:
        return "?", "not issued here"
    except ValueError:
        return "?", "damaged"
    days = (expires_at - local_datetime()).days
    note = "EXPIRED" if days < 0 else f"{days} days left" if days < EXPIRY_WARNING_DAYS else ""
    return f"{expires_at:%Y-%m-%d}", note


def _issue(folder: Path, name: str, hosts: Sequence[str]) -> CertificateKeyPair:
    certificate, key = _read(folder / AUTHORITY_FILE), _read(folder / AUTHORITY_KEY)
    try:
        return issue_certificate(
            CertificateKeyPair(certificate, key), name, hosts, local_datetime()
        )
    except InputError as error:
        raise InputError(f"{folder}: {error}") from None
    except (ValueError, TypeError):
        raise InputError(
            f"{AUTHORITY_FILE} or {AUTHORITY_KEY} is damaged",
            where=folder,
            remedy="restore both from a backup",
        ) from None


def _list_issued(folder: Path, name: str) -> list[Path]:
    """Return the certificates issued to a name, the newest last."""
    paths = (folder / ISSUED_FOLDER).glob(f"{name}.*.pem")
    return sorted(paths, key=lambda path: (len(path.name), path.name))


def _write_handover(folder: Path, name: str, pair: CertificateKeyPair) -> None:
    """Write the folder for a person; its certificate is listed in issued/ first."""
    for subfolder in (PEOPLE_FOLDER, ISSUED_FOLDER):
        (folder / subfolder).mkdir(mode=0o700, exist_ok=True)
    copy_path = _next_free_path(folder / ISSUED_FOLDER, name, ".pem")
    _write_files(copy_path.parent, {copy_path.name: pair.certificate}, {})
    public = {AUTHORITY_FILE: _read(folder / AUTHORITY_FILE), CERTIFICATE_FILE: pair.certificate}
    _make_folder(folder / PEOPLE_FOLDER / name, public, {KEY_FILE: pair.key})


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(
            f"cannot read: {error.strerror}",
            where=path,
            remedy="give the folder made by `shaketwin keys new`, with the authority's key",
        ) from None


def _make_folder(folder: Path, public: Mapping[str, bytes], private: Mapping[str, bytes]) -> None:
    """Create a folder with these files atomically."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".new-") as new_folder:
            staging = Path(new_folder) / folder.name
            staging.mkdir(mode=0o700)
            _write_files(staging, public, private)
            staging.rename(folder)  # fails if the target has content
    except OSError as error:
        raise InputError(f"{folder}: cannot write here: {error.strerror}") from None


def _write_files(folder: Path, public: Mapping[str, bytes], private: Mapping[str, bytes]) -> None:
    modes = [(0o644, public), (0o600, private)]
    for mode, name, content in ((mode, *item) for mode, files in modes for item in files.items()):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)


def _check_access(folder: Path, text: str, people: Mapping[str, str]) -> None:
    """Raise InputError if an edited, perhaps hand-written access list is not as intended."""
    path = folder / ACCESS_FILE
    if parse_toml(text, AccessList, str(path)).people != people:
        raise InputError(
            "this access list was edited so that it cannot be changed automatically",
            where=path,
            remedy="edit it by hand",
        )


def _write_access(folder: Path, text: str) -> None:
    """Replace the access list atomically."""
    try:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new_folder:
            _write_files(Path(new_folder), {ACCESS_FILE: text.encode()}, {})
            (Path(new_folder) / ACCESS_FILE).replace(folder / ACCESS_FILE)
    except OSError as error:
        raise InputError(f"{folder / ACCESS_FILE}: cannot write: {error.strerror}") from None


def _next_replaced_folder(folder: Path, name: str) -> Path:
    """Return the folder to which the replaced keys of `name` are moved."""
    replaced_folder = folder / REPLACED_FOLDER
    try:
        replaced_folder.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise InputError(f"{replaced_folder}: cannot write here: {error.strerror}") from None
    return _next_free_path(replaced_folder, name)


def _next_free_path(folder: Path, name: str, suffix: str = "") -> Path:
    return next(
        candidate for n in count(1) if not (candidate := folder / f"{name}.{n}{suffix}").exists()
    )


def _unknown_name_error(folder: Path, name: str) -> InputError:
    return InputError(
        f"no user {name!r}",
        where=folder / ACCESS_FILE,
        remedy=suggest(name, sorted(read_people(folder))),
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
            where=f"--host {host!r}",
            allowed="a name or an IP address without port, such as rig.lab.example or 192.168.1.20",
        )
    return host


def print_router_settings(folder: Path, name: str, listen: str, rig: str) -> None:
    """Print the settings for a zenohd started in the router's folder, FOLDER/people/NAME.

    They contain the current access list: print them again when it changes.
    """
    people = read_people(folder)
    if people.get(name) != ROUTER_ROLE:
        routers = [router for router, role in people.items() if role == ROUTER_ROLE]
        raise InputError(
            f"{name} is not a router",
            where=folder / ACCESS_FILE,
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
