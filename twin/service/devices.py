"""`shaketwin devices`: the machine cards at hand and whether each answers, hardware that is found.

Everybody is asked at once; who does not answer in time is said so, and not waited for.
"""

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.backends import answers
from table_io.backends.device import Device
from table_io.card import PROFILES, BadInput
from table_io.clock import RealClock
from table_io.rig import Rig
from table_io.rig_file import load_rig
from twin.service.summary import dumps
from twin.service.terminal import console, print_table, say

PATIENCE_S = 6.0  # for all of them together
HERE = "in the process of the run"  # where a simulated table is


@dataclass(frozen=True, slots=True)
class Reached:
    """A machine card, and whether its machine answers; `why` not, or why the card is none."""

    card: str
    backend: str
    where: str
    answers: bool
    why: str


def devices(ni: str | None, as_json: bool) -> None:
    """Prints what is reachable."""
    rigs, bad = _rigs(machine_cards(Path.cwd()))
    named = {rig.ni.endpoint for rig in rigs.values() if rig.ni and rig.ni.endpoint} - {ni}
    searches: dict[str, Callable[[], tuple[Device, ...]]] = {"NI, local driver": lambda: _ni(None)}
    for server in (*([ni] if ni else []), *sorted(named)):
        searches[f"NI, server {server}"] = partial(_ni, server)
    addresses = sorted({rig.opendaq.device for rig in rigs.values() if rig.opendaq})
    searches["openDAQ"] = partial(_opendaq, tuple(addresses))
    asked = {name: partial(answers, rig) for name, rig in rigs.items()}
    heard = at_once({**asked, **searches}, PATIENCE_S)
    reached = [_reached(name, rig, heard[name]) for name, rig in rigs.items()] + bad
    silent = {f"NI, server {one}" for one in named}  # where its card says already that it is
    found = {
        name: heard[name]
        for name in searches
        if not (name in silent and isinstance(heard[name], BadInput))
    }
    if as_json:
        print(dumps(_json(reached, found)))
    else:
        _print(reached, found)


def _rigs(paths: list[Path]) -> tuple[dict[str, Rig], list[Reached]]:
    """(machine cards by name, those that cannot be read)."""
    rigs, bad = {}, []
    for path in paths:
        name = path.stem if path.parent == PROFILES / "rigs" else str(path)
        try:
            rigs[name] = load_rig(path)[0]
        except BadInput as error:
            bad.append(Reached(name, "", "", False, str(error)))
    return rigs, bad


def _reached(name: str, rig: Rig, heard: object) -> Reached:
    why = str(heard) if isinstance(heard, BadInput) else ""
    return Reached(name, rig.backend, where(rig), not why, why)


def machine_cards(folder: Path) -> list[Path]:
    """The machine cards that are shipped and those in a folder: what names a backend."""
    there = sorted((PROFILES / "rigs").glob("*.toml"))
    for path in sorted(folder.glob("*.toml")):
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            continue
        own = path.resolve() not in {one.resolve() for one in there}
        if own and any(line.strip().startswith("backend") for line in text.splitlines()):
            there.append(path)
    return there


def at_once(asked: Mapping[str, Callable[[], object]], seconds: float) -> dict[str, object]:
    """What each has answered, in their order; BadInput for one that fails, or takes too long.

    Threads, for a driver may hang in a call that nothing ends; one that does is left behind.
    """
    answered: queue.Queue[tuple[str, object]] = queue.Queue()

    def ask(name: str, question: Callable[[], object]) -> None:
        try:
            answered.put((name, question()))
        except BadInput as error:
            answered.put((name, error))
        except Exception as error:  # of a driver: whatever it is, it is no answer
            answered.put((name, BadInput(f"{type(error).__name__}: {error}")))

    for name, question in asked.items():
        threading.Thread(target=ask, args=(name, question), daemon=True).start()
    clock = RealClock()
    until, heard = clock.now() + seconds, dict[str, object]()
    while len(heard) < len(asked) and (left := until - clock.now()) > 0:
        try:
            name, answer = answered.get(timeout=left)
        except queue.Empty:
            break
        heard[name] = answer
    late = BadInput(f"no answer within {seconds:g} s")
    return {name: heard.get(name, late) for name in asked}


def where(rig: Rig) -> str:
    """Where a card says that its machine is."""
    wired = rig.opendaq if rig.follow is not None else getattr(rig, rig.backend, None)
    for key in ("endpoint", "target", "server", "device"):
        if place := getattr(wired, key, None):
            return str(place)
    return HERE if rig.any_speed else ""


def _ni(server: str | None) -> tuple[Device, ...]:
    from table_io.backends.ni.found import found

    return found(server)


def _opendaq(addresses: tuple[str, ...]) -> tuple[Device, ...]:
    from table_io.backends.opendaq.found import found

    return found(addresses)


def _json(reached: list[Reached], found: Mapping[str, object]) -> dict[str, Any]:
    those = [one for one in found.values() if isinstance(one, tuple)]
    return {
        "cards": [asdict(one) for one in reached],
        "devices": [asdict(device) for devices in those for device in devices],
        "not_found": {name: str(one) for name, one in found.items() if isinstance(one, BadInput)},
    }


def _print(reached: list[Reached], found: Mapping[str, object]) -> None:
    table = Table(title="machine cards", box=SIMPLE_HEAD, title_justify="left")
    for head in ("card", "backend", "where", "answers"):
        table.add_column(head)
    for one in reached:
        table.add_row(one.card, one.backend, one.where, "yes" if one.answers else "no")
    print_table(console, table)
    for one in reached:
        if one.why:
            say(f"{one.card}: {one.why}")
    for name, those in found.items():
        if isinstance(those, tuple) and those:
            print_table(console, _devices(name, those))
        else:
            say(f"{name}: {those or 'answers, and has no device'}")


def _devices(name: str, those: tuple[Device, ...]) -> Table:
    table = Table(title=name, box=SIMPLE_HEAD, title_justify="left")
    for head in ("device", "product", "serial", "has"):
        table.add_column(head)
    for one in those:
        product = f"{one.product} (simulated)" if one.simulated else one.product
        table.add_row(one.name, product, one.serial, _ports(one))
    return table


def _ports(device: Device) -> str:
    """What it has, in a few words."""
    said = []
    for one in device.ports:
        widest = max(one.ranges_v, key=lambda pair: pair[1] - pair[0], default=None)
        volts = f" {widest[0]:g} to {widest[1]:g} V" if widest else ""
        rate = f" up to {one.most_hz:g} Hz" if one.most_hz else ""
        said.append(f"{len(one.names)} {one.kind}{volts}{rate}")
    return ", ".join(said)
