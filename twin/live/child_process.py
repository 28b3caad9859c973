"""Child process of a live run, as held by the supervisor."""

import os
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path


@dataclass(slots=True)
class ChildProcess:
    """Child process of the run; its output goes to a log file in the run's folder."""

    component: str
    process: subprocess.Popen[bytes]
    log_path: Path
    restarts: int = 0

    @property
    def has_exited(self) -> bool:
        return self.process.poll() is not None

    @property
    def exit_reason(self) -> str:
        """Signal name or exit code with which the process ended."""
        code = self.process.returncode
        return signal.Signals(-code).name if code < 0 else f"exit {code}"

    @property
    def last_output_line(self) -> str:
        """Last line that the process wrote to its log file."""
        lines = self.log_path.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"

    def close_input(self) -> None:
        """Close the standard input of the process, which tells it to finish."""
        stdin = self.process.stdin
        if stdin is not None and not stdin.closed:
            stdin.close()

    def kill(self) -> None:
        os.killpg(self.process.pid, signal.SIGKILL)


def start_process(component: str, parts_folder: Path, argument: str) -> ChildProcess:
    """Start a process in its own session, so that Ctrl-C does not reach it."""
    log_path = parts_folder / f"{component}.log"
    command = [sys.executable, "-m", "twin.live.processes", component]
    command += [str(parts_folder / "spec.json"), argument]
    with log_path.open("ab") as out:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=out, stderr=out, start_new_session=True
        )
    return ChildProcess(component, process, log_path)
