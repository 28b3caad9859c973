"""Status and configuration of a run, as answered to requests."""

import json
from collections.abc import Collection
from dataclasses import asdict, dataclass, field

from table_io.block import Block
from table_io.records import Comparison, Event, RunStart, RunStop, SampleGap, Step, StepAdded
from twin.live.process_config import ProcessConfig
from twin.transport.codec import Item, WireError, decode_item, message_schema
from twin.transport.endpoint import CMP_TOPIC, MEAS_TOPIC, list_observers

STATUS_TOPICS = frozenset(("/run/start", "/run/stop", "/run/event", "/rig/gap", "/rig/decided"))
TOML_FIELDS = ("profile_toml", "rig_toml", "model_toml")
STATUS_PATH = "state/status"
REQUEST_PATHS = (
    STATUS_PATH,
    *(f"config/{section}" for section in ("run", "profile", "rig", "model", "schema")),
)


@dataclass(slots=True)
class RunStatus:
    """Current status of a run, collected from its published messages."""

    config: ProcessConfig
    state: str = "idle"
    gaps: int = 0
    start: RunStart | None = None
    stop: RunStop | None = None
    _block_payload: bytes = b""  # newest measured block
    _comparison_payload: bytes = b""  # newest comparison
    _decided_steps: dict[int, Step] = field(default_factory=dict)

    def update(self, topic: str, payload: bytes) -> None:
        """Update from a published message; blocks and comparisons are decoded only on request."""
        if topic == MEAS_TOPIC:
            self._block_payload = payload
            return
        if topic == CMP_TOPIC:
            self._comparison_payload = payload
            return
        item = self._decode(topic, payload) if topic in STATUS_TOPICS else None
        match item:
            case RunStart():
                self.start = item
            case RunStop():
                self.stop = item
            case Event(kind="state", text=text):
                self.state = text
            case SampleGap():
                self.gaps += 1
            case StepAdded(step=step, direction=direction, frequency_hz=f, acceleration_m_s2=a):
                self._decided_steps[step] = Step(step, direction, f, a)

    def _decode(self, topic: str, payload: bytes) -> Item | None:
        """Return the decoded item, or None if it is invalid or of another run."""
        try:
            run, item = decode_item(topic, payload)
        except WireError:
            return None
        return item if run == self.config.run else None

    @property
    def block(self) -> Block | None:
        """Newest measured block."""
        item = self._decode(MEAS_TOPIC, self._block_payload) if self._block_payload else None
        return item if isinstance(item, Block) else None

    @property
    def end(self) -> int:
        """End sample of the newest measured block, 0 before the first."""
        block = self.block
        return 0 if block is None else block.end

    @property
    def compared_to(self) -> int:
        """End sample of the newest comparison by a twin, 0 before the first."""
        item = (
            self._decode(CMP_TOPIC, self._comparison_payload) if self._comparison_payload else None
        )
        return item.index + item.count if isinstance(item, Comparison) else 0

    def answer(self, path: str, alive: Collection[str]) -> bytes:
        """Answer a request for one of `REQUEST_PATHS`; `alive` names the live components."""
        match path:
            case "state/status":
                return json.dumps(self._summarize(alive)).encode()
            case "config/run":
                identity = {"run": self.config.run, "name": self.config.name}
                fields = asdict(self.start) if self.start is not None else identity
                return json.dumps(
                    {k: v for k, v in fields.items() if k not in TOML_FIELDS}
                ).encode()
            case "config/schema":
                return message_schema(Block)[1]
        return str(getattr(self.config, f"{path.removeprefix('config/')}_toml")).encode()

    def _summarize(self, alive: Collection[str]) -> dict[str, object]:
        block = self.block
        step_index = int(block.step[-1]) if block is not None else -1
        steps = {planned.index: planned for planned in self.start.steps} if self.start else {}
        step = (steps | self._decided_steps).get(step_index)
        return {
            "run": self.config.run,
            "name": self.config.name,
            "state": self.state,
            "step": step_index,
            "frequency_hz": step and step.frequency_hz,
            "direction": step and step.direction,
            "index": block.end if block is not None else 0,
            "compared": self.compared_to,
            "rate_hz": self.start and self.start.rate_hz,
            "planned_samples": self.start and self.start.planned_samples,
            "gaps": self.gaps,
            "remote_twin": self.config.remote_twin,
            "components": sorted({*alive}.difference(list_observers(alive))),
            "observers": list_observers(alive),
            "verdict": self.stop and self.stop.verdict,
            "reason": self.stop and self.stop.reason,
        }
