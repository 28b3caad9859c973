"""A process of a live run, as its supervisor holds it."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(slots=True)
class Child:
    """A process of the run: its output goes to a file in the run's folder."""

    component: str
    process: subprocess.Popen[bytes]
    log: Path
    restarts: int = 0

    @property
    def died(self) -> bool:
        return self.process.poll() is not None

    @property
    def how(self) -> str:
        """In which way it died."""
        code = self.process.returncode
        return signal.Signals(-code).name if code < 0 else f"exit {code}"

    @property
    def words(self) -> str:
        """Its last words."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def dismiss(self) -> None:
        """Close its input: it is free to end."""
        stdin = self.process.stdin
        if stdin is not None and not stdin.closed:
            stdin.close()

    def kill(self) -> None:
        os.killpg(self.process.pid, signal.SIGKILL)


def begin(component: str, parts: Path, argument: str) -> Child:
    """A new process, in a session of its own, so that Ctrl-C passes it by."""
    log = parts / f"{component}.log"
    command = [sys.executable, "-m", "twin.service.processes", component]
    command += [str(parts / "spec.json"), argument]
    with log.open("ab") as out:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=out, start_new_session=True
        )
    return Child(component, process, log)
