"""No TOML file makes a command crash: it is read, or refused with its name and one of its keys."""

import random
import re
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import pytest

from table_io.config.base import PROFILES_DIR, load_config
from table_io.errors import InputError
from twin.campaign.config import read_plan
from twin.discovery.features.config import FeatureSet
from twin.earthquakes.result import load_table_twin
from twin.model.config import load_model_config
from twin.setup.run_config import read_run_config
from twin.studies.maps.study import Study

# Short ones, of every kind of excitation and backend.
FILES = {
    "tests": ["quickstart", "gm2", "record_example", "refine_g4", "dwell", "track", "rehearsal"],
    "rigs": ["simulated", "hydraulic", "udp_simulated", "ni_simulated", "machine"],
    "models": ["snm"],
    "campaigns": ["paper"],
    "studies": ["bumper_design", "discovery_power", "fold_sensitivity"],
    "features": ["paper"],
    "effects": ["softening"],
    "twins": ["delayed"],
}
OWN = {  # of kinds that are not shipped
    "effects": """
id = "softening"
title = "A spring that softens"
place = "damper"
force = "-k * u * abs(u) / (1 + abs(u) / w)"
citation = "by hand"
[parameters]
k = { unit = "N/m2", low = 0.0, high = 1e9, vanishing = 0.0, typical = 1e6 }
[parameters.w]
unit = "m"
low = 1e-4
high = 1.0
typical = 1e-2
[range]
u = [-0.006, 0.006]
""",
    "twins": """
title = "A table that is late"
mass_kg = 1000.0
residual = 0.02
structure = "delay_gain"
[response]
delay_s = 0.012
band_hz = [0.5, 30.0]
lags_s = [0.0, 0.01]
[response.coefficients]
command = [1.0, 0.1]
""",
}
FAST_COUNT, SLOW_COUNT = 40, 1400
HANGS_S = 30  # of one file
VALUES = (
    "0", "-1", "1", "3", "1e9", "1e308", "-1e308", "1e-308", "1e-9", "nan", "inf", "-inf", '""',
    '"x"', '"\\u001b[31m"', "true", "false", "[]", "[1.0]", "[[]]", "{}", '["x", 1]',
    "9223372036854775807", "99999999999999999999", "1979-05-27", "0.5",
    '"nan"', '"../x"', "1000000", '"x\\u0000.toml"',
)  # fmt: skip
KEY_LINE = re.compile(r"^(\s*)([\w.\"-]+)(\s*=\s*)(.+)$")
TABLE_LINE = re.compile(r"^\[+[\w.\"-]+\]+\s*$")


def change_value(lines: list[str], chance: random.Random) -> None:
    number = chance.choice([k for k, line in enumerate(lines) if KEY_LINE.match(line)])
    lines[number] = KEY_LINE.sub(r"\g<1>\g<2>\g<3>{}", lines[number]).replace(
        "{}", chance.choice(VALUES)
    )


def scale_number(lines: list[str], chance: random.Random) -> None:
    numbers = [k for k, line in enumerate(lines) if re.search(r"=\s*-?[\d.]+\s*$", line)]
    if numbers:
        number = chance.choice(numbers)
        key, _, value = lines[number].partition("=")
        factor = chance.choice((-1.0, 0.0, 1e-6, 1e-3, 0.1, 0.999, 1.001, 10.0, 1e3, 1e6))
        lines[number] = f"{key}= {float(value) * factor!r}"


def delete_line(lines: list[str], chance: random.Random) -> None:
    del lines[chance.randrange(len(lines))]


def repeat_line(lines: list[str], chance: random.Random) -> None:
    lines.insert(chance.randrange(len(lines)), chance.choice(lines))


def rename_key(lines: list[str], chance: random.Random) -> None:
    number = chance.choice([k for k, line in enumerate(lines) if KEY_LINE.match(line)])
    lines[number] = chance.choice("xyz_") + lines[number].lstrip()


def rename_table(lines: list[str], chance: random.Random) -> None:
    tables = [k for k, line in enumerate(lines) if TABLE_LINE.match(line)]
    if tables:
        number = chance.choice(tables)
        lines[number] = chance.choice(("[x]", "[[x]]", f"[{lines[number]}]", lines[number] * 2))


def move_line(lines: list[str], chance: random.Random) -> None:
    line = lines.pop(chance.randrange(len(lines)))
    lines.insert(chance.randrange(len(lines) + 1), line)


CHANGES: tuple[Callable[[list[str], random.Random], None], ...] = (
    change_value, change_value, change_value, change_value, scale_number, scale_number, delete_line,
    repeat_line, rename_key, rename_table, move_line,
)  # fmt: skip


def mutate_text(content: bytes, chance: random.Random) -> bytes:
    """Return the file with one or two keys, lines or bytes changed."""
    if chance.random() < 0.1:
        changed = bytearray(content)
        for _ in range(chance.choice((1, 1, 5))):
            changed[chance.randrange(len(changed))] = chance.randrange(256)
        return bytes(changed[: chance.choice((None, chance.randrange(len(changed))))])
    lines = content.decode().splitlines()
    for _ in range(chance.choice((1, 1, 1, 2))):
        chance.choice(CHANGES)(lines, chance)
    return ("\n".join(lines) + "\n").encode()


def load(kind: str, path: Path) -> None:
    """Read a file as the commands do."""
    if kind == "campaigns":
        read_plan(path, None, None, lambda _config, _path: None)
    elif kind == "tests":
        read_run_config(path)
    elif kind == "studies":
        Study.read(path)
    elif kind == "features":
        load_config(path, FeatureSet, "features file")
    elif kind == "twins":
        load_table_twin(path).build_model()
    elif kind == "effects":
        model = path.with_name(f"model_of_{path.name}")
        entry = f'[[effects]]\nfile = "{path.name}"\nparameters = {{ k = 1e3, w = 0.01 }}\n'
        model.write_text((PROFILES_DIR / "models" / "snm.toml").read_text() + entry)
        load_model_config(model)
    else:
        option = {"rigs": "table", "models": "model"}[kind]
        read_run_config(Path("quickstart"), **{option: str(path)})


def find_keys(error: InputError) -> list[str]:
    """Return the keys that an error and its faults name."""
    return [key for fault in error.faults for key in find_keys(fault)] + [error.key] * bool(
        error.key
    )


def describe_failure(kind: str, path: Path) -> str:
    """Return what is wrong with the answer to a file, "" if it is read or refused in order."""
    try:
        load(kind, path)
    except InputError as error:
        message = str(error)
        if path.name not in message:
            return f"names no file: {message}"
        is_unreadable = "TOML" in message or "cannot read" in message or "nested" in message
        return "" if is_unreadable or find_keys(error) else f"names no key: {message}"
    except BaseException as error:
        return f"{type(error).__name__}: {error}"
    return ""


def fail_late(_signal: int, _frame: FrameType | None) -> None:
    raise TimeoutError(f"more than {HANGS_S} s")


def try_files(folder: Path, numbers: range) -> list[str]:
    """Return the failures of the mutants of these numbers, each with what was changed."""
    shutil.copytree(PROFILES_DIR, folder / "profiles")
    names = [(kind, name) for kind in FILES for name in FILES[kind]]
    failures = []
    signal.signal(signal.SIGVTALRM, fail_late)
    for number in numbers:
        kind, name = names[number % len(names)]
        if kind in OWN:
            original = OWN[kind].encode()
        else:
            original = (PROFILES_DIR / kind / f"{name}.toml").read_bytes()
        content = mutate_text(original, random.Random(number))
        path = folder / "profiles" / kind / f"mutant{number}.toml"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        signal.setitimer(signal.ITIMER_VIRTUAL, HANGS_S)
        failure = describe_failure(kind, path)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        path.unlink()
        if failure:
            before = set(original.splitlines())
            changed = [line for line in content.splitlines() if line not in before]
            failures.append(f"{number} {kind}/{name} {changed}: {failure}")
    return failures


def test_a_hostile_toml_file_is_refused_with_its_name_and_a_key(tmp_path: Path) -> None:
    assert try_files(tmp_path, range(FAST_COUNT)) == []


def test_a_file_that_is_refused_without_its_name_would_be_seen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, expected in (
        (InputError("bad"), "names no file"),
        (InputError("bad", where="a.toml"), "names no key"),
        (KeyError("bad"), "KeyError"),
    ):

        def fail(*_: object, raised: Exception = error, **__: object) -> None:
            raise raised

        monkeypatch.setattr(f"{__name__}.load", fail)
        assert describe_failure("tests", tmp_path / "a.toml").startswith(expected)


@pytest.mark.slow
def test_many_hostile_toml_files_are_refused_with_their_names_and_keys(tmp_path: Path) -> None:
    assert try_files(tmp_path, range(FAST_COUNT, SLOW_COUNT)) == []
