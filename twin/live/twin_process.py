"""Twin of a live run, local or remote: runs the model on the measured blocks."""

import logging
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from table_io.block import Block
from table_io.clock import Clock, RealClock
from table_io.records import Fault, RunStart, RunStop, StepAdded
from twin.compare import pipeline
from twin.live.process_config import (
    CONNECT_TIMEOUT_S,
    INBOX_CAPACITY,
    LINGER_S,
    MAX_QUIET_S,
    TIMING_INTERVAL_BLOCKS,
    LatencyHistogram,
    ProcessConfig,
    is_orphaned,
    process_token,
    request_realtime,
)
from twin.live.remote_twin import TWIN_TOPICS
from twin.setup.run_config import compile_twin_kernels
from twin.transport.codec import Item, decode_item, encode_item, topic_for
from twin.transport.endpoint import MEAS_TOPIC
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink, open_spoke

log = logging.getLogger(__name__)
TWIN_PRIORITY = 40  # real-time scheduling priority, if permitted
CONTROL_TOPICS = ("/run/start", "/run/stop", "/rig/decided")


def run_pipeline(
    config: ProcessConfig,
    missed_from: str,
    remote_link: BusLink | None = None,
    is_abandoned: Callable[[], bool] = is_orphaned,
) -> None:
    """Publish predictions and comparisons until the run is over or `is_abandoned`.

    `missed_from` is set after a restart: the sample from which comparisons are missing. On another
    computer `remote_link` is the connection to the gateway.
    """
    run_config = config.make_run_config()
    compile_twin_kernels()
    clock = RealClock()
    scheduler = request_realtime(TWIN_PRIORITY)
    log.info("run %s, scheduling: %s", config.run, scheduler)
    link = remote_link or open_spoke(run_config.rig.name, config.endpoint, CONNECT_TIMEOUT_S)
    link.declare(TWIN_TOPICS, offered=remote_link is not None)
    control = link.subscribe(CONTROL_TOPICS, history=True, capacity=INBOX_CAPACITY)
    blocks = link.subscribe((MEAS_TOPIC,), history=not missed_from, capacity=INBOX_CAPACITY)
    if remote_link is None:
        link.declare_alive(process_token(config, "twin"))
    block_s = run_config.profile.acquisition.block_samples / run_config.drive.rate_hz
    latency = LatencyHistogram("twin", clock, block_s, scheduler)
    twin = TwinProcess(config.run, link, run_config.prepare_twin(), latency, clock, missed_from)
    twin.external_clock = run_config.rig.under_external_control
    twin.run(control, blocks, is_abandoned)
    deadline_s = clock.now() + LINGER_S
    while clock.now() < deadline_s and not is_abandoned():
        control.get(0.02)  # also serves retransmission requests
    link.close()


@dataclass(slots=True)
class TwinProcess:
    """Twin loop: steps the pipeline and publishes its output."""

    run_id: str
    link: BusLink
    setup: pipeline.PipelineSetup
    latency: LatencyHistogram
    clock: Clock
    missed_from: str
    state: pipeline.PipelineState | None = None
    epoch_s: float | None = None
    end: int | None = None
    # The samples follow the device's own clock and are labeled later, so no latency is measured.
    external_clock: bool = False

    def run(
        self,
        control: ReliableSubscriber,
        blocks: ReliableSubscriber,
        is_abandoned: Callable[[], bool],
    ) -> None:
        """Compare until the end of the run, or until the run is abandoned."""
        received_s = self.clock.now()
        while self.end is None or self.state is None or self.state.twins.index < self.end:
            for record in _drain_records(control, self.run_id):
                self.handle_record(record)
            message = blocks.get(0.2)
            if message is None:
                if is_abandoned() and self.clock.now() - received_s > MAX_QUIET_S:
                    break
                continue
            received_s = self.clock.now()
            run, block = decode_item(*message)
            if run == self.run_id and isinstance(block, Block):
                self.step(block)
        self.publish([self.latency.to_timing(self.end or 0)])

    def handle_record(self, record: Item) -> None:
        """Update from a record: start, added step, or end of the run."""
        if (
            isinstance(record, RunStart)
            and record.host == platform.node()
            and not self.external_clock
        ):
            self.epoch_s = record.epoch_s  # valid on this computer's clock only
        elif isinstance(record, RunStop):
            self.end = record.index
        elif isinstance(record, StepAdded):
            self.setup = pipeline.add_steps(self.setup, record)

    def step(self, block: Block) -> None:
        """Step the pipeline with a measured block and publish its output."""
        state = self.state if self.state is not None else self.start(block.index)
        self.state, items = pipeline.step(self.setup, state, block)
        self.publish(items)
        if self.epoch_s is not None:
            self.latency.add(self.clock.now() - self.epoch_s - (block.end - 1) / block.rate_hz)
        if block.index // len(block) % TIMING_INTERVAL_BLOCKS == TIMING_INTERVAL_BLOCKS - 1:
            self.publish([self.latency.to_timing(block.end)])

    def start(self, index: int) -> pipeline.PipelineState:
        """Start the pipeline at sample `index` and publish a Fault for samples missed before."""
        state, items = pipeline.start_pipeline(self.setup, index)
        self.publish(list(items))
        self.latency.start()
        if self.missed_from or index > 0:
            reason = "the process died and was restarted" if self.missed_from else "it joined late"
            self.publish([Fault(index, "twin", int(self.missed_from or 0), index, reason)])
        return state

    def publish(self, items: list[Item]) -> None:
        for item in items:
            self.link.publish(topic_for(item), encode_item(item, self.run_id))


def _drain_records(control: ReliableSubscriber, run: str) -> Iterator[Item]:
    """Yield the records of a run queued in an inbox, without waiting."""
    while (message := control.get(0.0)) is not None:
        record_run, record = decode_item(*message)
        if record_run == run:
            yield record
