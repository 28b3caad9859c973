"""Gateway of a live run: relays the internal bus to observers and admits checked commands.

Rig, twin, recorder and supervisor communicate on an internal bus that observers cannot reach. The
gateway relays every fragment unchanged to a second bus at the public endpoint and caches it there,
so that late or slow subscribers request retransmission from the gateway, never from the rig. In
the other direction it admits commands, each validated, and with --remote-twin the filtered output
of a remote twin.
"""

import contextlib
import json
import logging
import os
import re
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field
from pathlib import Path

from table_io.acquisition.session import COMMAND_NAMES
from table_io.block import Block
from table_io.clock import Clock, RealClock
from table_io.records import Comparison, Event, RunStart, RunStop, SampleGap, Step, StepAdded
from twin.live.process_config import (
    CONNECT_TIMEOUT_S,
    INBOX_CAPACITY,
    MAX_QUIET_S,
    TIMING_INTERVAL_BLOCKS,
    LatencyHistogram,
    ProcessConfig,
    is_orphaned,
    process_token,
)
from twin.live.remote_twin import (
    MAX_OFFERS_PER_TURN,
    MAX_TEXT_CHARS,
    TWIN_TOPICS,
    OfferFilter,
    is_readable,
)
from twin.security.access_control import build_open_access
from twin.security.credentials import read_credentials
from twin.transport.codec import (
    TOPIC_TYPES,
    Item,
    WireError,
    decode_item,
    encode_item,
    message_schema,
    topic_for,
)
from twin.transport.endpoint import (
    CMP_TOPIC,
    MAX_COMMAND_SESSIONS,
    MAX_OBSERVER_SESSIONS,
    MAX_SESSIONS_PER_PERSON,
    MEAS_TOPIC,
    PUBLIC_HUB_SETTINGS,
    check_endpoint,
    list_observers,
    merge_settings,
    router_settings,
    sanitize_name,
)
from twin.transport.history_cache import Fragment
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, Request, RequestQueue, open_hub, open_spoke

log = logging.getLogger(__name__)
GATEWAY_NICENESS = 5  # observers yield processor time to the rig and the twin
POLL_INTERVAL_S = 0.005
MAX_RELAYED_PER_TURN = 32  # fragments relayed before the next request is answered
MAX_COMMANDS_PER_TURN = 64  # as many as wait, so that no question delays a stop
MAX_ANSWERS_PER_TURN = 4  # retransmission requests answered per turn
COMMAND_TIMEOUT_S = 1.5  # for the rig's answer to a command
PRESENCE_INTERVAL_S = 0.25  # between updates of the mirrored presence
MAX_DRAIN_S = 5.0  # after the run, for subscribers that are still behind
ACTIVE_SUBSCRIBER_S = 2.0  # subscribers report twice a second; a silent one is not waited for
LATENCY_EVERY_BLOCKS = 10  # latency is sampled at every tenth measured block
OFFER_CAPACITY = 1000  # fragments queued; beyond it they are dropped and requested again
SESSION_LIMITS = (
    f"too many at once; allowed: {MAX_SESSIONS_PER_PERSON} of one person, {MAX_OBSERVER_SESSIONS} "
    f"of all without the role command, {MAX_COMMAND_SESSIONS} of those with it"
)
NAME_PATTERN = re.compile(r"[A-Za-z0-9_.-]{1,64}")
# Token bucket: 10 refusals are recorded at once, further ones at most every 10 s.
MAX_REFUSAL_BURST, REFUSAL_INTERVAL_S = 10, 10.0
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
            case StepAdded():
                self._decided_steps[item.step] = item.as_step

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


@dataclass(slots=True)
class RequestServer:
    """Server of requests from observers, for a live run and for a replay."""

    link: BusLink
    status: RunStatus
    role_of: Callable[[str], str]
    handle_command: Callable[[Request, str, str, str], None]  # (request, command, sender, text)
    _commands: RequestQueue = field(init=False)
    _requests: RequestQueue = field(init=False)
    _presence: set[str] = field(init=False)

    def __post_init__(self) -> None:
        self._commands = self.link.declare_requests("cmd/*/*")
        self._requests = self.link.declare_requests(*REQUEST_PATHS, "state/role/*")
        self._presence = self.link.watch_components()

    def serve(self) -> None:
        """Answer all commands, then at most one request, and some for retransmission."""
        for _ in range(MAX_COMMANDS_PER_TURN):
            command = self._commands.poll()
            if command is None:
                break
            _, order, who = command.path.split("/")
            self.handle_command(command, order, who, command.text)
        for _ in range(MAX_ANSWERS_PER_TURN):
            if not self.link.serve():
                break
        request = self._requests.poll()
        if request is None:
            return
        _, _, *sender = request.path.split("/")
        if sender:
            request.reply(self.role_of(sender[0]))
        else:
            request.reply(self.status.answer(request.path, frozenset(self._presence)))


def validate_command(command: str, sender: str, role: str, run: str, text: str) -> str:
    """Return why a command is refused, or "" if it is valid.

    `text` holds the run's id, a newline and the operator's reason.
    """
    requested_run, _, reason = text.partition("\n")
    if not NAME_PATTERN.fullmatch(sender):
        return f"{sender[:64]!r} is not a valid name; allowed: up to 64 letters, digits and _ . -"
    if command not in COMMAND_NAMES:
        return f"no such command; known: {', '.join(COMMAND_NAMES)}"
    if role != "command":
        return f"{sender} has the role {role}; commands need the role command"
    if requested_run != run:
        return f"this is run {run}"
    if not is_readable(reason):
        return f"its reason has {len(reason)} characters; allowed: {MAX_TEXT_CHARS} printable ones"
    return ""


@dataclass(slots=True)
class RefusalLimiter:
    """Rate limiter (token bucket) for recorded refusals."""

    tokens: int = MAX_REFUSAL_BURST
    suppressed: int = 0
    _refilled_s: float = 0.0

    def limit(self, sentence: str, time_s: float) -> str:
        """Return the sentence to record at `time_s`, or "" if it is suppressed."""
        new_tokens = int((time_s - self._refilled_s) / REFUSAL_INTERVAL_S)
        if new_tokens > 0:
            self.tokens, self._refilled_s = min(MAX_REFUSAL_BURST, self.tokens + new_tokens), time_s
        if self.tokens == 0:
            self.suppressed += 1
            return ""
        suffix = (
            f" (and {self.suppressed} more since the last one recorded)" if self.suppressed else ""
        )
        self.tokens, self.suppressed = self.tokens - 1, 0
        return sentence + suffix


@dataclass(slots=True)
class Gateway:
    """Relay between the buses `internal` and `external`."""

    config: ProcessConfig
    internal: BusLink
    external: BusLink
    inbox: ReliableSubscriber
    clock: Clock
    role_of: Callable[[str], str]
    refusal_limiter: RefusalLimiter = field(default_factory=RefusalLimiter)
    mirrored_names: set[str] = field(default_factory=set)
    status: RunStatus = field(init=False)
    latency: LatencyHistogram = field(init=False)
    block_count: int = 0
    offers: OfferFilter | None = None  # output of a remote twin

    def __post_init__(self) -> None:
        self.status = RunStatus(self.config)
        self.latency = LatencyHistogram("gate", self.clock, float("inf"))  # it has no deadline
        self.latency.start()

    def run(self) -> None:
        """Relay until the run is over or orphaned and active subscribers have received it all."""
        server = RequestServer(self.external, self.status, self.role_of, self.handle_command)
        presence = self.internal.watch_components()
        presence_checked_s = last_message_s = self.clock.now()
        while not (is_orphaned() and self.clock.now() - last_message_s > self._silence_limit_s()):
            if self._relay_pending():
                last_message_s = self.clock.now()
            if self.offers is not None:
                self._admit_offers(self.offers)
            server.serve()
            if self.clock.now() - presence_checked_s > PRESENCE_INTERVAL_S:
                self._mirror_presence(set(presence))
                self._report_closed_sessions()
                presence_checked_s = self.clock.now()
        deadline_s = self.clock.now() + MAX_DRAIN_S
        while (
            self.clock.now() < deadline_s
            and self.external.max_subscriber_lag(ACTIVE_SUBSCRIBER_S) > 0
        ):
            server.serve()
            self.clock.wait_until(self.clock.now() + POLL_INTERVAL_S)

    def _silence_limit_s(self) -> float:
        """Return the silence in s after which an orphaned run counts as over."""
        return 0.3 if self.status.stop is not None else MAX_QUIET_S

    def _relay_pending(self) -> bool:
        """Relay queued fragments, ahead of any request; True if there were any."""
        timeout_s = POLL_INTERVAL_S
        for count in range(MAX_RELAYED_PER_TURN):
            fragment = self.inbox.get_fragment(timeout_s)
            if fragment is None:
                return count > 0
            if self.offers is not None:
                self.offers.run_publishers.add(fragment.publisher)
            self._forward(fragment)
            timeout_s = 0.0
        return True

    def _forward(self, fragment: Fragment) -> None:
        self.external.relay(fragment)
        payload = self.inbox.reassemble(fragment)
        if payload is not None:
            self.status.update(fragment.topic, payload)
            if fragment.topic == MEAS_TOPIC:
                self._measure_latency()

    def _admit_offers(self, offers: OfferFilter) -> None:
        """Admit output of a remote twin; it waits until the rig's current sample is known."""
        rig_end = 0 if self.inbox.is_behind else self.status.end
        for _ in range(MAX_OFFERS_PER_TURN if rig_end else 0):
            fragments = offers.take(rig_end)
            if fragments is None:
                return
            for fragment in fragments:
                self.inbox.excluded_publishers.add(fragment.publisher)
                self.internal.relay(fragment)
                self._forward(fragment)

    def _measure_latency(self) -> None:
        """Sample the relay latency at every tenth block and publish a Timing once a second."""
        self.block_count += 1
        start = self.status.start
        block = self.block_count % LATENCY_EVERY_BLOCKS == 0 and self.status.block
        if not start or not block:
            return
        latency_s = self.clock.now() - start.epoch_s - (block.end - 1) / block.rate_hz
        self.latency.add(latency_s)
        if self.block_count % TIMING_INTERVAL_BLOCKS == 0:
            timing = self.latency.to_timing(block.end)
            self.internal.publish(topic_for(timing), encode_item(timing, self.config.run))

    def _mirror_presence(self, alive: set[str]) -> None:
        """Declare on the external bus the components that are alive on the internal one."""
        for name in alive - self.mirrored_names:
            self.external.declare_alive(name)
        for name in self.mirrored_names - alive:
            self.external.undeclare_alive(name)
        self.mirrored_names = alive

    def handle_command(self, request: Request, command: str, sender: str, text: str) -> None:
        """Forward a command to the rig or refuse it; both are recorded with the sender's name."""
        refusal = validate_command(command, sender, self.role_of(sender), self.config.run, text)
        if refusal:
            request.reply(f"refused: {refusal}")
            sentence = f"{sanitize_name(command)[:16]} by {sanitize_name(sender)[:64]}: {refusal}"
            self._publish_event("refused", self.refusal_limiter.limit(sentence, self.clock.now()))
            return
        reason = text.partition("\n")[2] or f"asked to {command}"
        signed_reason = f"{reason} by {sender}"
        self.internal.forward_command(
            command, f"{self.config.run}\n{signed_reason}", request, COMMAND_TIMEOUT_S
        )
        self._publish_event("order", f"{command}: {signed_reason}")

    def _report_closed_sessions(self) -> None:
        """Record whose sessions were closed because they were too many."""
        for name in self.external.drain_closed_sessions():
            sentence = f"session of {sanitize_name(name)}: {SESSION_LIMITS}"
            self._publish_event("refused", self.refusal_limiter.limit(sentence, self.clock.now()))

    def _publish_event(self, kind: str, text: str) -> None:
        if text:
            event = Event(self.status.end, kind, text)
            self.internal.publish(topic_for(event), encode_item(event, self.config.run))


def run_gateway(config: ProcessConfig, _: str) -> None:
    """Run the gateway process between a run and its observers."""
    with contextlib.suppress(OSError):
        os.nice(GATEWAY_NICENESS)
    rig_name = config.rig_name
    internal = open_spoke(rig_name, config.endpoint, CONNECT_TIMEOUT_S)
    keys = read_credentials(Path(config.keys)) if config.keys else None
    if keys is not None and not config.remote_twin:
        keys = keys.without_twin_roles()
    access = {} if keys is not None else build_open_access(rig_name, remote_twin=config.remote_twin)
    settings = merge_settings(PUBLIC_HUB_SETTINGS, access)
    if config.router:
        check_endpoint(rig_name, config.router, keys is not None)
        settings = merge_settings(settings, router_settings(config.router))
    external = open_hub(rig_name, config.listen, settings, keys)
    log.info("observers reach the run at %s", config.listen)
    internal.declare(tuple(TOPIC_TYPES))
    external.declare(tuple(TOPIC_TYPES))
    inbox = internal.subscribe(tuple(TOPIC_TYPES), history=True, capacity=INBOX_CAPACITY)
    offers = _open_offers(config, external) if config.remote_twin else None
    internal.declare_alive(process_token(config, "gate"))
    # Without keys every user of this computer may send commands, under any name.
    role_of = keys.role_of if keys is not None else lambda _: "command"
    Gateway(config, internal, external, inbox, RealClock(), role_of, offers=offers).run()
    external.close()
    internal.close()


def _open_offers(config: ProcessConfig, external: BusLink) -> OfferFilter:
    # Slow import, needed for a remote twin only.
    from twin.compare.pipeline import EVENT_KINDS

    inbox = external.subscribe(TWIN_TOPICS, history=True, capacity=OFFER_CAPACITY, offered=True)
    return OfferFilter(inbox, config.run, frozenset(EVENT_KINDS))
