"""What every process of a live run is told, and how it knows that nobody is there any more."""

import json
import os
import select
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from twin.service.bundle import Bundle, from_texts

CONNECT_S = 15.0
CAPACITY = 50_000  # pieces that wait in an inbox
QUIET_S = 3.0  # after which a process stops waiting for another's last word


@dataclass(frozen=True, slots=True)
class Spec:
    """What every process of a run is told. `folder` is the run's; the texts are TOML."""

    run: str
    name: str
    folder: str
    endpoint: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    serve_view: str = ""  # address of the live Rerun view, if one is wanted

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> "Spec":
        return Spec(**json.loads(path.read_text()))

    def bundle(self) -> Bundle:
        return from_texts(self.name, self.profile_toml, self.rig_toml, self.model_toml, self.name)


def token(spec: Spec, component: str) -> str:
    """Under which a process of this run is alive on the bus; another run's are others."""
    return f"{spec.run}.{component}"


def orphaned() -> bool:
    """True once the supervisor's end of our standard input is closed."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and not os.read(sys.stdin.fileno(), 64)
