"""Damaged and lying files through the commands that read recordings: what comes of each.

    python -m tests.studies.hostile_files COUNT [FIRST]     mutants FIRST to FIRST + COUNT - 1

A process makes them and calls the commands as the command line does; another watches that it goes
on, and goes on itself after a crash. Its memory is limited. What is not an exit code of the
contract is told, with the number of the mutant that brought it, and so is a message that does not
name the file.
"""

import contextlib
import io
import os
import random
import resource
import select
import shutil
import signal
import subprocess
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from typer.main import get_command

from tests.builders.profiles import format_test
from tests.exchange.csv_tables import write_csv
from tests.recording import mutants

ALLOWED = {0, 2, 3, 4, 5}
MEMORY = 2 * 2**30  # bytes a process may have
HANGS_S = 60.0  # of computing for one mutant
SILENT_S = 600.0  # of the clock, which others may slow
REPORT_INTERVAL = 50  # one in so many replays makes its report too
EXPORT_FORMATS = ("--csv", "--parquet", "--mat", "--foxglove")
PROFILE = format_test(3.4, 3.6, 0.2)


class Trials:
    """A whole log and a table, and what the commands say to mutants of them."""

    def __init__(self, folder: Path) -> None:
        from twin.recording.reader import read_recording
        from twin.setup.run_config import read_run_config
        from twin.setup.unpaced import play_unpaced
        from twin.transport.codec import encode_item, topic_for

        self.folder = folder
        profile, run = folder / "short.toml", folder / "run.mcap"
        profile.write_text(PROFILE)
        play_unpaced(read_run_config(profile), "run", run, lambda: None, lambda _: None)
        recording = read_recording(run)
        end = recording.stop.index if recording.stop else 0
        # The loop check and the sweep are long: their beginnings, a step and the end are enough.
        kept = [item for item in recording.items if item.index < 500 or item.index > end - 600]
        self.items, self.start = kept, recording.start
        self.messages = [(topic_for(item), encode_item(item, "run"), item.index) for item in kept]
        self.whole = mutants.whole(folder / "whole.mcap", kept, recording.start).read_bytes()
        self.compared = folder / "compared"
        self.compared.mkdir()
        (self.compared / "run.mcap").write_bytes(self.whole)
        call_command(("report", self.compared), report=False)
        self.summary = (self.compared / "summary.json").read_bytes()
        write_csv(recording, folder / "table.csv")
        lines = (folder / "table.csv").read_bytes().split(b"\n")
        self.table = b"\n".join(lines[:1500])
        self.foreign = [(Path(name).suffix, made(folder / name)) for name, made in _formats()]

    def mutant(self, number: int) -> tuple[str, bytes]:
        """(its ending, its bytes)."""
        chance, kind = random.Random(number), number % 10
        if kind < 4:
            return ".mcap", mutants.damage(self.whole, chance)
        if kind < 8:
            path = self.folder / f"{number}.lie.mcap"
            messages = mutants.lied(self.messages, self.items, "run", chance)
            content = mutants.write_messages(path, messages, self.start).read_bytes()
            path.unlink()
            return ".mcap", content
        if kind == 8 and number % 100 == 8:
            return ".mcap", mutants.bomb(number // 100)
        if number % 40 == 19 and self.foreign:
            ending, content = chance.choice(self.foreign)
            return ending, mutants.damage(content, chance)
        return ".csv", mutants.scrawl(self.table, chance)

    def run(self, number: int) -> Counter[str]:
        """What each command said: its name and exit code, or how it failed."""
        ending, content = self.mutant(number)
        place = self.folder / f"{number}"
        place.mkdir()
        file = place / f"a{ending}"
        file.write_bytes(content)
        folder = place / "a"
        folder.mkdir()
        (folder / "run.mcap").write_bytes(content)
        altered = place / "b"
        altered.mkdir()
        (altered / "run.mcap").write_bytes(self.whole)
        (altered / "summary.json").write_bytes(mutants.damage(self.summary, random.Random(number)))
        outcomes: Counter[str] = Counter()
        calls: list[tuple[object, ...]] = [
            ("verify", file, "--repair", place / "repaired.mcap"),
            ("verify", file, "--json"),
            ("prc", file, "--json"),
            ("replay", file, "--out", place / "again"),
            ("import", file, "-o", place / "taken.mcap"),
            ("export", file, *EXPORT_FORMATS, "-o", place / "out"),
            ("report", folder),
            ("compare", self.compared, folder, "--out", place / "compared"),
            ("compare", self.compared, altered, "--out", place / "altered"),
        ]
        if number % 10 == 8:  # bombs: one command of each reader
            calls = calls[:-4]
        for words in calls if number % 20 == 0 else [calls[0], *calls[2:]]:
            code, error = call_command(
                words,
                report=number % REPORT_INTERVAL == 0,
                names=tuple(map(str, (file, folder, altered))),
            )
            outcomes[f"{words[0]} {code}"] += 1
            if error:
                print(f"CRASH {number} {words[0]}\n{error}", flush=True)
        shutil.rmtree(place)
        return outcomes


def _formats() -> list[tuple[str, Callable[[Path], bytes]]]:
    """(name, what writes such a file and reads it back) of each format of other tools."""
    try:
        from tests.table_io.formats.test_formats import FORMATS
    except (ModuleNotFoundError, pytest.skip.Exception):
        return []  # without their libraries

    def write_and_read(write: Callable[[Path], None], path: Path) -> bytes:
        write(path)
        return path.read_bytes()

    return [(name, partial(write_and_read, write)) for name, write, _ in FORMATS.values()]


def call_command(
    words: tuple[object, ...], report: bool, names: tuple[str, ...] = ()
) -> tuple[str, str]:
    """(exit code, what is wrong with the answer) of the command line.

    Wrong is a traceback, another exit code than those of the contract, and a refusal whose message
    has none of `names` in it.
    """
    from twin.cli import table as cli
    from twin.report import report as reports

    kept, argv = reports.write_report, sys.argv
    sys.argv = ["shaketwin", *map(str, words)]
    if not report:
        reports.write_report = lambda folder, recording=None: folder
    code: object = 0
    message = io.StringIO()
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(message):
            cli.main()
    except SystemExit as end:
        code = end.code or 0
    except BaseException:
        return "crashed", traceback.format_exc()
    finally:
        reports.write_report, sys.argv = kept, argv
    if code not in ALLOWED:
        return str(code), f"exit code {code}"
    is_named = code != 2 or not names or any(name in message.getvalue() for name in names)
    return str(code), "" if is_named else f"names no file: {message.getvalue()}"


def work(first: int, last: int) -> None:
    """Mutants first to last - 1 in this process, a line before and after each."""
    from twin.cli import table as cli

    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    vars(cli)["app"] = get_command(cli.app)  # built once, not for each of thousands of calls
    with TemporaryDirectory() as folder:
        trials = Trials(Path(folder))
        for number in range(first, last):
            print(f"BEGIN {number}", flush=True)
            signal.setitimer(signal.ITIMER_PROF, HANGS_S)  # its signal ends a process that hangs
            for what, count in trials.run(number).items():
                print(f"SAID {count} {what}", flush=True)
    print(f"MEMORY {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024}", flush=True)


def watch(first: int, last: int) -> tuple[Counter[str], list[str]]:
    """(how often each command ended how, what should not have happened)."""
    outcomes: Counter[str] = Counter()
    wrong = []
    while first < last:
        command = [
            sys.executable,
            "-m",
            "tests.studies.hostile_files",
            "--work",
            str(first),
            str(last),
        ]
        child = subprocess.Popen(command, stdout=subprocess.PIPE)
        for line in _lines(child):
            word, _, rest = line.partition(" ")
            if word == "BEGIN":
                first = int(rest) + 1
                if first % 100 == 0:
                    print(f"{first} ...", flush=True)
            elif word == "SAID":
                outcomes[rest.partition(" ")[2]] += int(rest.partition(" ")[0])
            elif word == "MEMORY":
                print(f"largest memory {rest} MB")
            else:
                wrong.append(line)
                print(line, flush=True)
        if child.poll() is None:
            child.kill()
            wrong.append(f"HUNG {first - 1}")
            print(wrong[-1], flush=True)
        elif child.returncode == -signal.SIGPROF:
            wrong.append(f"HUNG {first - 1}")
            print(wrong[-1], flush=True)
        elif child.returncode != 0:
            wrong.append(f"DIED {first - 1}: {child.returncode}")
            print(wrong[-1], flush=True)
        else:
            break
        child.wait()
    return outcomes, wrong


def _lines(child: subprocess.Popen[bytes]) -> Iterator[str]:
    """What a process says, until it ends or says nothing for too long."""
    assert child.stdout is not None
    held = b""
    while select.select([child.stdout], [], [], SILENT_S)[0]:
        more = os.read(child.stdout.fileno(), 2**16)
        if not more:
            child.wait()
            return
        *lines, held = (held + more).split(b"\n")
        yield from (line.decode() for line in lines)


if __name__ == "__main__":
    if sys.argv[1] == "--work":
        work(int(sys.argv[2]), int(sys.argv[3]))
    else:
        begin = int(sys.argv[2]) if len(sys.argv) > 2 else 0
        outcomes, faults = watch(begin, begin + int(sys.argv[1]))
        for name, times in sorted(outcomes.items()):
            print(f"{name:>16} {times}")
        print(f"{sum(text.startswith(('CRASH', 'DIED')) for text in faults)} crashes,",
              f"{sum(text.startswith('HUNG') for text in faults)} hangs")  # fmt: skip
        raise SystemExit(1 if faults else 0)
