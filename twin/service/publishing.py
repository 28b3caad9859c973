"""A replay on the bus: for whoever listens it is a live run, with rig and twin alive."""

from collections.abc import Iterator
from contextlib import contextmanager

from table_io.clock import RealClock
from twin.service.bundle import Bundle
from twin.service.processes import LINGER_S
from twin.service.terminal import say
from twin.stream.resend import HELD_PIECES
from twin.stream.wire import TOPIC_TYPES, Item, encode, topic
from twin.stream.zenoh_link import Link, open_hub

AHEAD = HELD_PIECES * 4 // 5  # pieces of a topic that anybody who listens may lack
LOOK_S = 0.002
COMPONENTS = ("rig", "twin")  # that a replay stands for


class Bus:
    """Publishes items; waits for the slowest of those who listen, so that none loses anything.

    A publisher holds its newest pieces for those who ask again. Whoever listens asks every half
    second and so says how far it is; one that has not asked for ten seconds is waited for no more.
    """

    def __init__(self, link: Link) -> None:
        self._link = link
        self._run = ""
        self._clock = RealClock()

    def begin(self, run: str, at_once: bool) -> None:
        """Be alive as the run `run`; unless `at_once`, wait until somebody listens."""
        self._run = run
        for component in COMPONENTS:
            self._link.alive(f"{run}.{component}")
        # At full speed the beginning would be gone before anybody came.
        if not (at_once or self._link.listeners.heard):
            say("waiting for somebody to listen, as `shaketwin view`; Ctrl-C ends it")
        while not (at_once or self._link.listeners.heard):
            self._link.serve()
            self._clock.wait_until(self._clock.now() + LOOK_S)

    def put(self, item: Item) -> None:
        """Publish one item, once everybody is near enough."""
        while self._link.behind > AHEAD:
            self._link.serve()
            self._clock.wait_until(self._clock.now() + LOOK_S)
        self._link.publish(topic(item), encode(item, self._run))

    def finish(self) -> None:
        """Until everybody has everything, at most as long as a live run lingers."""
        until = self._clock.now() + LINGER_S
        while self._link.behind > 0 and self._clock.now() < until:
            self._link.serve()
            self._clock.wait_until(self._clock.now() + LOOK_S)


@contextmanager
def publishing(bundle: Bundle, endpoint: str) -> Iterator[Bus]:
    """The hub of a run at an endpoint; BadInput where a run is there already."""
    link = open_hub(bundle.rig.name, endpoint)
    try:
        link.declare(tuple(TOPIC_TYPES))
        bus = Bus(link)
        yield bus
        bus.finish()
    finally:
        link.close()
