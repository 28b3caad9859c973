"""Configuration passed to every process of a live run, and detection of a dead supervisor."""

import json
import os
import select
import sys
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

from twin.run.run_config import RunConfig, from_texts

CONNECT_TIMEOUT_S = 15.0
INBOX_CAPACITY = 50_000  # fragments queued in an inbox
LINGER_S = 10.0  # for which a publisher stays up after the run for retransmission
MAX_QUIET_S = 3.0  # of silence, after which a process stops waiting for final messages


@dataclass(frozen=True, slots=True)
class ProcessConfig:
    """Configuration of a run's processes; `folder` is the run's folder, the texts are TOML.

    `endpoint` is the internal bus, `listen` the public endpoint for observers, `keys` a folder of
    keys or "".
    """

    run: str
    name: str
    folder: str
    listen: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    serve_view: str = ""  # address of the live Rerun view, if requested
    keys: str = ""
    remote_twin: bool = False  # no twin is started here; a remote one may publish its output
    router: str = ""  # endpoint of a router through which observers connect, if any
    endpoint: str = ""

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> "ProcessConfig":
        return ProcessConfig(**json.loads(path.read_text()))

    @property
    def rig_name(self) -> str:
        """Name of the rig."""
        return str(tomllib.loads(self.rig_toml)["name"])

    def make_run_config(self) -> RunConfig:
        return from_texts(self.name, self.profile_toml, self.rig_toml, self.model_toml, self.name)


def process_token(config: ProcessConfig, component: str) -> str:
    """Return the liveliness token of a process, unique to this run."""
    return f"{config.run}.{component}"


def is_orphaned() -> bool:
    """Return True once the supervisor's end of our standard input is closed."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and not os.read(sys.stdin.fileno(), 64)
