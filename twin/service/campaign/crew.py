"""The processes that play the runs of a campaign on the simulated table, each one at a time."""

import json
import os
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from types import TracebackType
from typing import Any

from twin.service.spec import Spec

MOST = 2  # each holds a whole recording in memory while it writes the report


@dataclass(slots=True)
class Player:
    """A process and the run that it plays; `heard` is the unfinished line of what it says."""

    process: subprocess.Popen[bytes]
    run: str = ""
    heard: bytes = b""

    @property
    def pipe(self) -> int:
        """Descriptor of what it says."""
        assert self.process.stdout is not None
        return self.process.stdout.fileno()


class Crew:
    """Players of runs; use as a context manager."""

    def __init__(self, lock: int) -> None:
        self._lock = lock
        self._players: list[Player] = []

    def __enter__(self) -> "Crew":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let everybody go: a run that is still played is stopped, its table comes to rest."""
        self.stop()
        for player in self._players:
            assert player.process.stdin is not None
            player.process.stdin.close()
            player.process.wait()

    @property
    def free(self) -> bool:
        """True where another run can be given."""
        most = min(MOST, len(os.sched_getaffinity(0)))
        return sum(bool(player.run) for player in self._players) < most

    @property
    def busy(self) -> bool:
        return any(player.run for player in self._players)

    def give(self, run: str, spec: Spec) -> None:
        """Have a run played."""
        idle = (one for one in self._players if not one.run and one.process.poll() is None)
        player = next(idle, None) or self._another()
        player.run = run
        assert player.process.stdin is not None
        player.process.stdin.write(json.dumps(asdict(spec)).encode() + b"\n")
        player.process.stdin.flush()

    def stop(self) -> None:
        """Bring every table to rest; what is only being reported goes on."""
        for player in self._players:
            if player.run and player.process.poll() is None:
                player.process.send_signal(signal.SIGTERM)

    def listen(self, seconds: float) -> Iterator[tuple[str, dict[str, Any]]]:
        """(run, what its player says) of all that was said; waits for at most so long."""
        by_pipe = {player.pipe: player for player in self._players if player.run}
        for pipe in select.select(list(by_pipe), [], [], seconds)[0]:
            player = by_pipe[pipe]
            new = os.read(pipe, 65536)
            *lines, player.heard = (player.heard + new).split(b"\n")
            for line in lines:
                words = json.loads(line)
                run = player.run
                if "reported" in words or "failed" in words:
                    player.run = ""
                yield run, words
            if not new:
                run, code = player.run, player.process.wait()
                self._players.remove(player)
                how = signal.Signals(-code).name if code < 0 else f"exit {code}"
                yield run, {"failed": f"the process that played it died ({how})"}

    def _another(self) -> Player:
        process = subprocess.Popen(
            [sys.executable, "-m", "twin.service.campaign.worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=(self._lock,),
            start_new_session=True,
        )
        self._players.append(Player(process))
        return self._players[-1]
