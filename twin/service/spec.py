"""What every process of a live run is told, and how it knows that nobody is there any more."""

import json
import os
import select
import sys
import tempfile
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

from twin.service.bundle import Bundle, from_texts

CONNECT_S = 15.0
CAPACITY = 50_000  # pieces that wait in an inbox
LONGEST_FOLDER = 70  # characters, of about 100
LINGER_S = 10.0  # that a publisher stays up after the run, so that late readers can recover
QUIET_S = 3.0  # after which a process stops waiting for another's last word


@dataclass(frozen=True, slots=True)
class Spec:
    """What every process of a run is told. `folder` is the run's; the texts are TOML.

    The run's own processes meet at `endpoint`, whoever is outside at `listen`, with `keys` where
    these are a folder of keys.
    """

    run: str
    name: str
    folder: str
    listen: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    serve_view: str = ""  # address of the live Rerun view, if one is wanted
    keys: str = ""
    remote_twin: bool = False  # none is started here; one outside may publish what it computes
    router: str = ""  # a router that the outside reaches too, if there is one
    endpoint: str = ""

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> "Spec":
        return Spec(**json.loads(path.read_text()))

    @property
    def rig(self) -> str:
        """The name of the rig."""
        return str(tomllib.loads(self.rig_toml)["name"])

    def bundle(self) -> Bundle:
        return from_texts(self.name, self.profile_toml, self.rig_toml, self.model_toml, self.name)


def token(spec: Spec, component: str) -> str:
    """Under which a process of this run is alive on the bus; another run's are others."""
    return f"{spec.run}.{component}"


def orphaned() -> bool:
    """True once the supervisor's end of our standard input is closed."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and not os.read(sys.stdin.fileno(), 64)


def private_folder() -> Path:
    """A new folder that nobody else can enter; its name is short, a socket's has little room."""
    long = len(tempfile.gettempdir()) > LONGEST_FOLDER
    return Path(tempfile.mkdtemp(prefix="shaketwin-", dir="/tmp" if long else None))
