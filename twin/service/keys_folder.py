"""`shaketwin keys`: a laboratory's authority, the rig's keys, and those of the people.

    FOLDER/ca.pem, ca.key.pem            the authority; the second is needed only here
    FOLDER/certificate.pem, key.pem      the rig's
    FOLDER/access.toml                   who may do what
    FOLDER/people/NAME/                  ca.pem, certificate.pem, key.pem: to be handed over
    FOLDER/issued/NAME.1.pem             every certificate that a person was given
    FOLDER/replaced/NAME.1/              what `renew` has replaced

Folders are 0700 and private keys 0600. Nothing is ever overwritten, and a name that was given out
is never given to somebody else: its old certificate would be good again.
"""

import os
import re
import secrets
import socket
import tempfile
from collections.abc import Mapping, Sequence
from ipaddress import ip_address
from itertools import count
from pathlib import Path

from rich.table import Table

from table_io.card import BadInput, parse
from table_io.clock import today
from twin.service.authority import Pair, expiry, found, hosts_of, issue
from twin.service.terminal import console, print_table, say
from twin.stream.access import NOBODY, RIG, ROLES, ROUTER
from twin.stream.keys import (
    ACCESS,
    AUTHORITY,
    CERTIFICATE,
    KEY,
    SOON_DAYS,
    Access,
    checked_name,
    read_people,
)

AUTHORITY_KEY = "ca.key.pem"
PEOPLE, ISSUED, REPLACED = "people", "issued", "replaced"
HERE = ("localhost", "127.0.0.1", "::1")
LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
ACCESS_TEXT = f"""\
# Who may come in, by the name in the certificate. `shaketwin keys add` and `remove` write here; a
# role may be changed by hand: {", ".join(ROLES)}. Whoever is not here is refused.
[people]
"""


def new_keys(folder: Path, hosts: Sequence[str]) -> None:
    """An authority and the rig's keys in a new folder; the rig answers as this machine and `hosts`.

    BadInput where the folder has content.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise BadInput(
            f"{folder}: exists and has content; keys are never overwritten; name another"
        )
    own = [socket.gethostname(), socket.getfqdn()]
    names = [*HERE, *(one for one in own if _is_host(one)), *map(_checked_host, hosts)]
    names = list(dict.fromkeys(name.lower() for name in names))
    now = today()
    authority = found(f"shaketwin {now:%Y-%m-%d} {secrets.token_hex(4)}", now)
    rig = issue(authority, RIG, names, now)
    made = {AUTHORITY: authority.certificate, CERTIFICATE: rig.certificate}
    made[ACCESS] = ACCESS_TEXT.encode()
    _make_folder(folder, made, {AUTHORITY_KEY: authority.key, KEY: rig.key})
    say(f"{folder}: an authority, and the rig's keys as {', '.join(names)}")
    say(f"next: shaketwin keys add {folder} NAME --role {'|'.join(ROLES)}")
    say(f"then: shaketwin run PROFILE --listen tls/HOST:7447 --keys {folder}")


def add_person(folder: Path, name: str, role: str, hosts: Sequence[str]) -> None:
    """Keys of a person who was not known, to be handed over; `hosts` are those of a router."""
    try:
        checked_name(name)
    except ValueError as error:
        raise BadInput(str(error)) from None
    if (role == ROUTER) != bool(hosts):
        raise BadInput(f"--role {role}: a router, and nobody else, answers at a --host; give both")
    people = read_people(folder)
    if _given(folder, name) or name in people:
        raise BadInput(
            f"{name}: this name was given out, and its old certificate would be good again; choose "
            f"another one, or for new keys of the same person: shaketwin keys renew {folder} {name}"
        )
    pair = _issue(folder, name, [_checked_host(host) for host in hosts])
    text = f'{(folder / ACCESS).read_text().rstrip()}\n{name} = "{role}"\n'
    _check_access(folder, text, people | {name: role})
    _hand(folder, name, pair)
    _write_access(folder, text)
    say(
        f"{folder / PEOPLE / name}: keys of {name}, role {role}; hand the folder over by a safe "
        "way, and delete it here"
    )


def renew(folder: Path, name: str | None, hosts: Sequence[str]) -> None:
    """New keys of a person or, without a name, of the rig; what they replace is kept.

    Without `hosts` the new ones are for those of the old.
    """
    if name is None:
        _renew_rig(folder, [_checked_host(host) for host in hosts])
        return
    people = read_people(folder)
    given = _given(folder, name) if name in people else []
    if not given:
        raise BadInput(_unknown(folder, name))
    if hosts and people[name] != ROUTER:
        raise BadInput(f"--host: {name} may {people[name]}; only a router answers at a host")
    names = [_checked_host(host) for host in hosts] or hosts_of(_read(given[-1]))
    pair = _issue(folder, name, names)
    old = folder / PEOPLE / name
    if old.exists():
        old.rename(_place_of_replaced(folder, name))
    _hand(folder, name, pair)
    say(f"{old}: new keys; the old ones stay good until they expire")


def _renew_rig(folder: Path, hosts: Sequence[str]) -> None:
    old = {name: _read(folder / name) for name in (CERTIFICATE, KEY)}
    pair = _issue(folder, RIG, list(dict.fromkeys([*HERE, *(hosts or hosts_of(old[CERTIFICATE]))])))
    kept = _place_of_replaced(folder, RIG)
    _make_folder(kept, {CERTIFICATE: old[CERTIFICATE]}, {KEY: old[KEY]})
    with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new:
        _write(Path(new), {CERTIFICATE: pair.certificate}, {KEY: pair.key})
        for file in (KEY, CERTIFICATE):
            (Path(new) / file).replace(folder / file)
    say(f"{folder}: new keys of the rig; the old ones, in {kept}, stay good until they expire")


def remove_person(folder: Path, name: str) -> None:
    """Take the role away: from the next start of the gate on nothing answers this certificate."""
    people = read_people(folder)
    if name not in people:
        raise BadInput(_unknown(folder, name))
    line = re.compile(rf"""^\s*["']?{re.escape(name)}["']?\s*=.*\n?""", re.MULTILINE)
    text = line.sub("", (folder / ACCESS).read_text())
    _check_access(folder, text, {one: role for one, role in people.items() if one != name})
    _write_access(folder, text)
    say(
        f"{name}: has no role any more. Commands are refused at once; a run that is on lets "
        "connected people watch until its gate starts anew"
    )


def list_keys(folder: Path) -> None:
    """Prints everybody with role and expiry, the rig and the authority too."""
    people = read_people(folder)
    table = Table(box=None, padding=(0, 2, 0, 0))
    for title in ("name", "role", "good until", ""):
        table.add_column(title)
    table.add_row("(authority)", "", *_until(folder / AUTHORITY))
    table.add_row("(rig)", "", *_until(folder / CERTIFICATE))
    issued = {one.name.partition(".")[0] for one in (folder / ISSUED).glob("*.pem")}
    for name in sorted(issued | people.keys()):
        newest = _given(folder, name)[-1:] or [folder / ISSUED / name]
        table.add_row(name, people.get(name, NOBODY), *_until(newest[0]))
    print_table(console, table)


def _until(path: Path) -> tuple[str, str]:
    """(date until which a certificate is good, what is to be said about it)."""
    try:
        until = expiry(path.read_bytes())
    except OSError:
        return "?", "not issued here"
    except ValueError:
        return "?", "damaged"
    days = (until - today()).days
    note = "EXPIRED" if days < 0 else f"{days} days left" if days < SOON_DAYS else ""
    return f"{until:%Y-%m-%d}", note


def _issue(folder: Path, name: str, hosts: Sequence[str]) -> Pair:
    certificate, key = _read(folder / AUTHORITY), _read(folder / AUTHORITY_KEY)
    try:
        return issue(Pair(certificate, key), name, hosts, today())
    except BadInput as error:
        raise BadInput(f"{folder}: {error}") from None
    except (ValueError, TypeError):
        raise BadInput(
            f"{folder}: {AUTHORITY} or {AUTHORITY_KEY} is damaged; restore them"
        ) from None


def _given(folder: Path, name: str) -> list[Path]:
    """The certificates that somebody was given, the newest last."""
    found = (folder / ISSUED).glob(f"{name}.*.pem")
    return sorted(found, key=lambda one: (len(one.name), one.name))


def _hand(folder: Path, name: str, pair: Pair) -> None:
    """The folder that a person gets; that there is one is noted first."""
    for place in (PEOPLE, ISSUED):
        (folder / place).mkdir(mode=0o700, exist_ok=True)
    note = _next_free(folder / ISSUED, name, ".pem")
    _write(note.parent, {note.name: pair.certificate}, {})
    known = {AUTHORITY: _read(folder / AUTHORITY), CERTIFICATE: pair.certificate}
    _make_folder(folder / PEOPLE / name, known, {KEY: pair.key})


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise BadInput(
            f"{path}: cannot read it: {error.strerror}; give the folder that `shaketwin keys new` "
            "made, with the authority's key in it"
        ) from None


def _make_folder(folder: Path, public: Mapping[str, bytes], private: Mapping[str, bytes]) -> None:
    """A folder with these files, there with all of them or not at all."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".new-") as new:
            made = Path(new) / folder.name
            made.mkdir(mode=0o700)
            _write(made, public, private)
            made.rename(folder)  # fails where there is one with content
    except OSError as error:
        raise BadInput(f"{folder}: cannot write here: {error.strerror}") from None


def _write(folder: Path, public: Mapping[str, bytes], private: Mapping[str, bytes]) -> None:
    modes = [(0o644, public), (0o600, private)]
    for mode, name, content in ((mode, *one) for mode, files in modes for one in files.items()):
        descriptor = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)


def _check_access(folder: Path, text: str, people: Mapping[str, str]) -> None:
    """BadInput where a list that was written by hand, changed by us, would not say this."""
    path = folder / ACCESS
    if parse(text, Access, str(path)).people != people:
        raise BadInput(f"{path}: not written as `shaketwin keys` would; change it by hand")


def _write_access(folder: Path, text: str) -> None:
    """The list, changed at one blow: whoever reads it sees the old or the new one."""
    try:
        with tempfile.TemporaryDirectory(dir=folder, prefix=".new-") as new:
            _write(Path(new), {ACCESS: text.encode()}, {})
            (Path(new) / ACCESS).replace(folder / ACCESS)
    except OSError as error:
        raise BadInput(f"{folder / ACCESS}: cannot write: {error.strerror}") from None


def _place_of_replaced(folder: Path, name: str) -> Path:
    """Where the keys of `name` go that new ones replace."""
    place = folder / REPLACED
    try:
        place.mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise BadInput(f"{place}: cannot write here: {error.strerror}") from None
    return _next_free(place, name)


def _next_free(folder: Path, name: str, end: str = "") -> Path:
    return next(free for n in count(1) if not (free := folder / f"{name}.{n}{end}").exists())


def _unknown(folder: Path, name: str) -> str:
    known = ", ".join(sorted(read_people(folder))) or "nobody"
    return f"{folder / ACCESS}: knows no {name!r}; known: {known}"


def _is_host(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return len(host) < 254 and bool(re.fullmatch(rf"{LABEL}(\.{LABEL})*", host))
    return True


def _checked_host(host: str) -> str:
    if not _is_host(host):
        raise BadInput(
            f"--host {host!r}: no name or address of a machine; allowed: as rig.lab.example or "
            "192.168.1.20, without port"
        )
    return host
