"""`shaketwin devices`: list rig files with the state of their machines, and discovered hardware.

All machines are queried in parallel with one timeout.
"""

import queue
import threading
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, NoReturn

from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.backends import DeviceSearch, DiscoveredDevice, check_reachable, get_descriptor
from table_io.clock import RealClock
from table_io.config.folders import list_configs
from table_io.config.plugins import list_entry_points
from table_io.config.rig import BACKEND_GROUP, RigConfig
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from twin.results.contract import format_json
from twin.system.terminal import console, print_line, print_table

ANSWER_TIMEOUT_S = 1.8  # for all queries together
IN_PROCESS = "in the process of the run"  # address of a simulated table


@dataclass(frozen=True, slots=True)
class MachineStatus:
    """Rig file and whether its machine answers; `why` is the fault of the machine or file."""

    card: str
    backend: str
    where: str
    answers: bool
    why: str


def print_devices(ni: str | None, as_json: bool) -> None:
    """Print the rig files with the state of their machines, and discovered devices."""
    rigs, unreadable = _read_rigs(list_rig_files(Path.cwd()))
    searches, rig_searches = _list_searches(rigs.values(), {"ni": [ni] if ni else []})
    questions = {name: partial(check_reachable, rig) for name, rig in rigs.items()}
    replies = ask_all({**questions, **searches}, ANSWER_TIMEOUT_S)
    statuses = [_make_status(name, rig, replies[name]) for name, rig in rigs.items()] + unreadable
    # A silent server of a rig file is reported with that file already.
    discovered = {
        name: replies[name]
        for name in searches
        if not (name in rig_searches and isinstance(replies[name], InputError))
    }
    if as_json:
        print(format_json(_to_json(statuses, discovered)))
    else:
        _print_tables(statuses, discovered)


def _read_rigs(paths: list[Path]) -> tuple[dict[str, RigConfig], list[MachineStatus]]:
    """Read rig files; return (rigs by name, statuses of unreadable files)."""
    rigs, unreadable, by_name = {}, [], list_configs("rigs").values()
    for path in paths:
        name = path.stem if path in by_name else str(path)
        try:
            rigs[name] = load_rig(path)[0]
        except InputError as error:
            unreadable.append(MachineStatus(name, "", "", False, str(error)))
    return rigs, unreadable


def _make_status(name: str, rig: RigConfig, reply: object) -> MachineStatus:
    reason = str(reply) if isinstance(reply, InputError) else ""
    return MachineStatus(name, rig.backend, machine_address(rig), not reason, reason)


def list_rig_files(folder: Path) -> list[Path]:
    """Return the rig files with a bare name and those in a folder: files that name a backend."""
    paths = [*list_configs("rigs").values()]
    for path in sorted(folder.glob("*.toml")):
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            continue
        is_new = path.resolve() not in {known.resolve() for known in paths}
        if is_new and any(line.strip().startswith("backend") for line in text.splitlines()):
            paths.append(path)
    return paths


def ask_all(questions: Mapping[str, Callable[[], object]], timeout_s: float) -> dict[str, object]:
    """Ask all questions in parallel; return the answers by name, InputError for a failed one.

    Each question has a thread, because a driver call may hang; a hung thread is abandoned.
    """
    results: queue.Queue[tuple[str, object]] = queue.Queue()

    def ask(name: str, question: Callable[[], object]) -> None:
        try:
            results.put((name, question()))
        except InputError as error:
            results.put((name, error))
        except Exception as error:  # a driver may raise anything
            results.put((name, InputError(f"{type(error).__name__}: {error}")))

    for name, question in questions.items():
        threading.Thread(target=ask, args=(name, question), daemon=True).start()
    clock = RealClock()
    deadline_s, replies = clock.now() + timeout_s, dict[str, object]()
    while len(replies) < len(questions) and (remaining_s := deadline_s - clock.now()) > 0:
        try:
            name, answer = results.get(timeout=remaining_s)
        except queue.Empty:
            break
        replies[name] = answer
    no_answer = InputError(f"no answer within {timeout_s:g} s")
    return {name: replies.get(name, no_answer) for name in questions}


def machine_address(rig: RigConfig) -> str:
    """Return the address of a rig's machine, or "" if it has none."""
    return rig.backend_section.find_address(rig) or (IN_PROCESS if rig.runs_at_any_speed else "")


def _list_searches(
    rigs: Collection[RigConfig], given: Mapping[str, list[str]]
) -> tuple[dict[str, DeviceSearch], set[str]]:
    """Return (searches by label, labels of those that only a rig file asks for).

    `given` has the addresses that the user gives, by backend.
    """
    searches: dict[str, DeviceSearch] = {}
    rig_searches: set[str] = set()
    for name in list_entry_points(BACKEND_GROUP):
        try:
            list_searches = get_descriptor(name, BACKEND_GROUP, name).list_searches
        except InputError as error:
            searches[f"backend {name}"] = partial(_refuse, error)
            continue
        if list_searches is not None:
            sections = [(rig, rig.sections[name]) for rig in rigs if name in rig.sections]
            addresses = {section.find_address(rig) for rig, section in sections}
            addresses -= {"", *given.get(name, ())}
            backend_searches = list_searches([*given.get(name, ()), *sorted(addresses)])
            rig_searches |= backend_searches.keys() - list_searches(given.get(name, ())).keys()
            searches |= backend_searches
    return searches, rig_searches


def _refuse(error: InputError) -> NoReturn:
    raise error


def _to_json(statuses: list[MachineStatus], discovered: Mapping[str, object]) -> dict[str, Any]:
    device_groups = [result for result in discovered.values() if isinstance(result, tuple)]
    return {
        "cards": [asdict(status) for status in statuses],
        "devices": [asdict(device) for devices in device_groups for device in devices],
        "not_found": {
            name: str(result)
            for name, result in discovered.items()
            if isinstance(result, InputError)
        },
    }


def _print_tables(statuses: list[MachineStatus], discovered: Mapping[str, object]) -> None:
    table = Table(title="rig files", box=SIMPLE_HEAD, title_justify="left")
    for header in ("rig", "backend", "address", "responds"):
        table.add_column(header)
    for status in statuses:
        table.add_row(status.card, status.backend, status.where, "yes" if status.answers else "no")
    print_table(console, table)
    for status in statuses:
        if status.why:
            print_line(f"{status.card}: {status.why}")
    for name, result in discovered.items():
        if isinstance(result, tuple) and result:
            print_table(console, _make_device_table(name, result))
        else:
            print_line(f"{name}: {result or 'responds, but has no device'}")


def _make_device_table(name: str, devices: tuple[DiscoveredDevice, ...]) -> Table:
    table = Table(title=name, box=SIMPLE_HEAD, title_justify="left")
    for header in ("device", "product", "serial", "has"):
        table.add_column(header)
    for device in devices:
        product = f"{device.product} (simulated)" if device.simulated else device.product
        table.add_row(device.name, product, device.serial, _format_ports(device))
    return table


def _format_ports(device: DiscoveredDevice) -> str:
    """Format the ports of a device with their ranges in V and rates in Hz."""
    parts = []
    for port in device.ports:
        widest = max(port.ranges_v, key=lambda pair: pair[1] - pair[0], default=None)
        volts = f" {widest[0]:g} to {widest[1]:g} V" if widest else ""
        rate = f" up to {port.most_hz:g} Hz" if port.most_hz else ""
        parts.append(f"{len(port.names)} {port.kind}{volts}{rate}")
    return ", ".join(parts)
