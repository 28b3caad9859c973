"""Processes of a live run, each a small loop around a pure step; listed in `PROCESSES`.

The supervisor starts them as `python -m twin.live.processes COMPONENT SPEC`, each in its own
session so that Ctrl-C reaches only the supervisor. Standard input is a pipe; end of file on it
means that the supervisor has ended.
"""

import contextlib
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from table_io.acquisition.external_control import record_external
from table_io.acquisition.session import (
    ACCEPTED,
    COMMAND_NAMES,
    LatenessLog,
    OperatorCommand,
    run_session,
)
from table_io.backends import open_backend, open_source
from table_io.block import Block
from table_io.clock import RealClock
from table_io.errors import InputError
from table_io.records import Event, RunStart, RunStop
from twin.live.gateway import GATEWAY_NICENESS, run_gateway
from twin.live.process_config import (
    CONNECT_TIMEOUT_S,
    LINGER_S,
    TIMING_INTERVAL_BLOCKS,
    LatencyHistogram,
    ProcessConfig,
    is_orphaned,
    process_token,
    request_realtime,
)
from twin.live.recorder import run_recorder
from twin.setup.run_config import compile_rig_kernels
from twin.system.diagnostics import configure_logging
from twin.system.exit_codes import EXIT_FAILED
from twin.transport.codec import TOPIC_TYPES, Item, encode_item, topic_for
from twin.transport.endpoint import LOCAL_SOCKET_PREFIX
from twin.transport.zenoh_link import RequestQueue, open_hub, open_spoke

log = logging.getLogger("twin.live.processes")  # not __main__, as which it runs
RIG_PRIORITY = 50  # real-time scheduling priority, if permitted
RIG_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/rig/")),
    "/run/start",
    "/run/stop",
    "/run/event",
    "/run/timing",
)


def run_rig(config: ProcessConfig, _: str) -> None:
    """Drive the table and publish, without other Python threads; opens the internal hub."""
    run_config = config.make_run_config()
    compile_rig_kernels(run_config)
    clock = RealClock()
    scheduler = request_realtime(RIG_PRIORITY)
    log.info("scheduling: %s", scheduler)
    link = open_hub(run_config.rig.name, config.endpoint)
    link.declare(RIG_TOPICS)
    commands = _CommandQueue(
        link.declare_commands(), config.run, run_config.profile.on_death.supervisor == "stop"
    )
    link.declare_alive(process_token(config, "rig"))
    while (command := commands.poll_request()) is None or command.name != "start":
        if command is not None:
            command.answer("refused: the test has not begun")
        if is_orphaned():
            return
        clock.wait_until(clock.now() + 0.01)
    block_s = run_config.profile.acquisition.block_samples / run_config.drive.rate_hz
    latency = LatencyHistogram("rig", clock, block_s, scheduler)
    punctuality = LatenessLog()
    latency.start()
    start = run_config.make_start_factory(config.run, "table")
    session_args = (clock, start, commands.poll_command, punctuality)
    if run_config.rig.under_external_control:
        device = open_source(run_config.rig, run_config.drive.rate_hz, clock)
        source = record_external(run_config.session_setup, device, *session_args)
    else:
        source = run_session(
            run_config.session_setup,
            open_backend(run_config.rig, run_config.profile, clock),
            *session_args,
        )
    for item in _add_timing(source, latency, punctuality):
        link.publish(topic_for(item), encode_item(item, config.run))
    deadline_s = clock.now() + LINGER_S
    while clock.now() < deadline_s and not is_orphaned():
        commands.requests.poll()  # also serves retransmission requests
        clock.wait_until(clock.now() + 0.005)
    link.close()
    with contextlib.suppress(OSError):  # usually removed by the supervisor
        Path(config.endpoint.removeprefix(LOCAL_SOCKET_PREFIX)).parent.rmdir()


@dataclass(slots=True)
class _CommandQueue:
    """Commands to the rig of a run; one to the session is answered once it is executed."""

    requests: RequestQueue
    run: str
    stop_if_orphaned: bool

    def poll_request(self) -> OperatorCommand | None:
        """Return the next command, or "start"; one for another run is refused."""
        request = self.requests.poll()
        if request is None:
            return None
        run, _, reason = request.text.partition("\n")
        if run != self.run or request.name not in ("start", *COMMAND_NAMES):
            log.info("command %s, refused", request.name)
            request.reply(f"refused: this is run {self.run}")
            return None

        def answer(text: str) -> None:
            log.info("command %s, %s", request.name, "accepted" if text == ACCEPTED else text)
            request.reply(text)

        command = OperatorCommand(request.name, reason or f"asked to {request.name}", answer)
        if command.name == "start":
            answer(ACCEPTED)
        return command

    def poll_command(self) -> OperatorCommand | None:
        """Return the next command to the session; stop if orphaned and so configured."""
        command = self.poll_request()
        if command is not None and command.name in COMMAND_NAMES:
            return command
        must_stop = self.stop_if_orphaned and is_orphaned()
        return OperatorCommand("stop", "the supervisor is gone") if must_stop else None


def _add_timing(
    source: Iterator[Item], latency: LatencyHistogram, punctuality: LatenessLog
) -> Iterator[Item]:
    """Yield the items of a session, with the rig's Timing every second and before the end."""
    block_count = 0
    for item in source:
        if isinstance(item, RunStop):
            yield latency.to_timing(item.index)
        yield item
        if isinstance(item, Block):
            latency.add(punctuality.late_s.pop())
            block_count += 1
            if block_count % TIMING_INTERVAL_BLOCKS == 0:
                yield latency.to_timing(item.end)
        elif isinstance(item, RunStart) or (isinstance(item, Event) and item.kind == "motion"):
            # With an external controller no block follows for a while.
            yield latency.to_timing(item.index)


def run_twin(config: ProcessConfig, missed_from: str) -> None:
    """Run the twin on the measured blocks."""
    from twin.live.twin_process import run_pipeline  # slow import, needed here only

    run_pipeline(config, missed_from)


def run_viewer(config: ProcessConfig, _: str) -> None:
    """Feed the live Rerun view; the run does not depend on it."""
    from twin.viewer.live_view import serve_live_view

    os.nice(GATEWAY_NICENESS)
    link = open_spoke(config.make_run_config().rig.name, config.endpoint, CONNECT_TIMEOUT_S)
    link.declare_alive(process_token(config, "viewer"))
    serve_live_view(link, config.serve_view, is_orphaned)
    link.close()


PROCESSES: dict[str, Callable[[ProcessConfig, str], None]] = {
    "rig": run_rig,
    "twin": run_twin,
    "recorder": run_recorder,
    "viewer": run_viewer,
    "gate": run_gateway,
}


def main() -> None:
    """Run a child process from its command line: COMPONENT SPEC [ARGUMENT]."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    component, config_path, *arguments = sys.argv[1:]
    try:
        configure_logging(component)
        PROCESSES[component](
            ProcessConfig.read(Path(config_path)), arguments[0] if arguments else ""
        )
        log.info("process %d ends", os.getpid())
    except InputError as error:
        print(error, file=sys.stderr)
        raise SystemExit(EXIT_FAILED) from None


if __name__ == "__main__":
    main()
