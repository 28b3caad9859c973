"""Publication of a replay on the bus, as a live run with rig and twin alive."""

from collections.abc import Iterator
from contextlib import contextmanager

from table_io.clock import RealClock
from twin.live.gateway import RequestServer, RunStatus
from twin.live.process_config import LINGER_S, ProcessConfig
from twin.security.access_control import build_open_access
from twin.security.credentials import Credentials
from twin.setup.run_config import RunConfig
from twin.system.terminal import print_line
from twin.transport.codec import TOPIC_TYPES, Item, encode_item, topic_for
from twin.transport.endpoint import PUBLIC_HUB_SETTINGS, merge_settings
from twin.transport.history_cache import MAX_CACHED_FRAGMENTS
from twin.transport.zenoh_link import BusLink, Request, open_hub

MAX_LEAD_FRAGMENTS = MAX_CACHED_FRAGMENTS * 4 // 5  # of a topic, ahead of the slowest subscriber
POLL_INTERVAL_S = 0.002
REPLAYED_COMPONENTS = ("rig", "twin")  # declared alive by a replay


class ReplayPublisher:
    """Publisher with flow control: waits for the slowest subscriber, so that none loses data.

    The history cache holds the newest fragments for retransmission. Subscribers report their
    position every half second; one that is silent for ten seconds is no longer waited for.
    """

    def __init__(self, link: BusLink, config: RunConfig) -> None:
        self._link = link
        self._config = config
        self._run = ""
        self._clock = RealClock()
        self._server: RequestServer | None = None

    def start(self, run: str, at_once: bool) -> None:
        """Declare the run `run` alive; unless `at_once`, wait for the first subscriber."""
        self._run = run
        toml_texts = (self._config.profile_toml, self._config.rig_toml, self._config.model_toml)
        status = RunStatus(ProcessConfig(run, self._config.name, "", "", *toml_texts))
        self._server = RequestServer(self._link, status, lambda _: "observe", _refuse)
        for component in REPLAYED_COMPONENTS:
            self._link.declare_alive(f"{run}.{component}")
        # At full speed the beginning would have left the cache before anyone subscribed.
        if not (at_once or self._link.subscriber_progress.positions):
            print_line("waiting for a subscriber, such as `shaketwin view`; Ctrl-C to quit")
        while not (at_once or self._link.subscriber_progress.positions):
            self._serve()

    def publish(self, item: Item) -> None:
        """Publish one item once no subscriber lags by more than `MAX_LEAD_FRAGMENTS`."""
        while self._link.max_subscriber_lag() > MAX_LEAD_FRAGMENTS:
            self._serve()
        name, payload = topic_for(item), encode_item(item, self._run)
        self._link.publish(name, payload)
        if self._server is not None:
            self._server.status.update(name, payload)
            self._server.serve()

    def finish(self) -> None:
        """Wait until every subscriber has received everything, at most `LINGER_S`."""
        deadline_s = self._clock.now() + LINGER_S
        while self._link.max_subscriber_lag() > 0 and self._clock.now() < deadline_s:
            self._serve()

    def _serve(self) -> None:
        """Answer a request, then wait `POLL_INTERVAL_S`."""
        if self._server is not None:
            self._server.serve()
        self._clock.wait_until(self._clock.now() + POLL_INTERVAL_S)


def _refuse(request: Request, *_: str) -> None:
    request.reply("refused: this is a recording that is replayed")


@contextmanager
def open_publisher(
    config: RunConfig, endpoint: str, keys: Credentials | None = None
) -> Iterator[ReplayPublisher]:
    """Open the hub of a replay at an endpoint; InputError if a run is there already."""
    rig = config.rig.name
    settings = (
        PUBLIC_HUB_SETTINGS
        if keys is not None
        else merge_settings(PUBLIC_HUB_SETTINGS, build_open_access(rig))
    )
    link = open_hub(rig, endpoint, settings, None if keys is None else keys.without_twin_roles())
    try:
        link.declare(tuple(TOPIC_TYPES))
        publisher = ReplayPublisher(link, config)
        yield publisher
        publisher.finish()
    finally:
        link.close()
