"""What a run says of itself to whoever asks: where it stands, and its configuration."""

import json
from collections.abc import Collection
from dataclasses import asdict, dataclass, field

from table_io.block import Block
from table_io.records import Comparison, Decided, Event, Gap, RunStart, RunStop, Step
from twin.service.spec import Spec
from twin.stream.endpoint import observers
from twin.stream.wire import CMP_TOPIC, MEAS_TOPIC, Item, WireError, decode, schema

FOLLOWED = frozenset(("/run/start", "/run/stop", "/run/event", "/rig/gap", "/rig/decided"))
TEXTS = ("profile_toml", "rig_toml", "model_toml")
STATUS = "state/status"
PATHS = (STATUS, *(f"config/{one}" for one in ("run", "profile", "rig", "model", "schema")))


@dataclass(slots=True)
class Status:
    """Where a run stands, from what it publishes."""

    spec: Spec
    state: str = "idle"
    gaps: int = 0
    start: RunStart | None = None
    stop: RunStop | None = None
    _newest: bytes = b""  # measured block
    _compared: bytes = b""  # newest comparison
    _decided: dict[int, Step] = field(default_factory=dict)

    def see(self, topic: str, payload: bytes) -> None:
        """Take in what was published; what comes often is looked into only when somebody asks."""
        if topic == MEAS_TOPIC:
            self._newest = payload
            return
        if topic == CMP_TOPIC:
            self._compared = payload
            return
        item = self._read(topic, payload) if topic in FOLLOWED else None
        match item:
            case RunStart():
                self.start = item
            case RunStop():
                self.stop = item
            case Event(kind="state", text=text):
                self.state = text
            case Gap():
                self.gaps += 1
            case Decided(step=step, direction=direction, frequency_hz=f, acceleration_m_s2=a):
                self._decided[step] = Step(step, direction, f, a)

    def _read(self, topic: str, payload: bytes) -> Item | None:
        """What these bytes say, if it is of this run."""
        try:
            run, item = decode(topic, payload)
        except WireError:
            return None
        return item if run == self.spec.run else None

    @property
    def block(self) -> Block | None:
        """The newest measured block."""
        item = self._read(MEAS_TOPIC, self._newest) if self._newest else None
        return item if isinstance(item, Block) else None

    @property
    def end(self) -> int:
        """The sample up to which the run has come."""
        block = self.block
        return 0 if block is None else block.end

    @property
    def compared(self) -> int:
        """The sample up to which a twin has come."""
        item = self._read(CMP_TOPIC, self._compared) if self._compared else None
        return item.index + item.count if isinstance(item, Comparison) else 0

    def answer(self, path: str, present: Collection[str]) -> bytes:
        """What stands under one of `PATHS`; `present` are the names of those who are alive."""
        match path:
            case "state/status":
                return json.dumps(self._summary(present)).encode()
            case "config/run":
                known = {"run": self.spec.run, "name": self.spec.name}
                record = asdict(self.start) if self.start is not None else known
                return json.dumps({k: v for k, v in record.items() if k not in TEXTS}).encode()
            case "config/schema":
                return schema(Block)[1]
        return str(getattr(self.spec, f"{path.removeprefix('config/')}_toml")).encode()

    def _summary(self, present: Collection[str]) -> dict[str, object]:
        block = self.block
        number = int(block.step[-1]) if block is not None else -1
        steps = {one.index: one for one in self.start.steps} if self.start else {}
        step = (steps | self._decided).get(number)
        return {
            "run": self.spec.run,
            "name": self.spec.name,
            "state": self.state,
            "step": number,
            "frequency_hz": step and step.frequency_hz,
            "direction": step and step.direction,
            "index": block.end if block is not None else 0,
            "compared": self.compared,
            "rate_hz": self.start and self.start.rate_hz,
            "planned_samples": self.start and self.start.planned_samples,
            "gaps": self.gaps,
            "remote_twin": self.spec.remote_twin,
            "components": sorted({*present}.difference(observers(present))),
            "observers": observers(present),
            "verdict": self.stop and self.stop.verdict,
            "reason": self.stop and self.stop.reason,
        }
