"""A replay on the bus: for whoever listens it is a live run, with rig and twin alive."""

from collections.abc import Iterator
from contextlib import contextmanager

from table_io.clock import RealClock
from twin.service.bundle import Bundle
from twin.service.gate import Front
from twin.service.spec import LINGER_S, Spec
from twin.service.status import Status
from twin.service.terminal import say
from twin.stream.access import open_access
from twin.stream.endpoint import PUBLIC, merged
from twin.stream.keys import Keys
from twin.stream.questions import Question
from twin.stream.shelf import HELD_PIECES
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

    def __init__(self, link: Link, bundle: Bundle) -> None:
        self._link = link
        self._bundle = bundle
        self._run = ""
        self._clock = RealClock()
        self._front: Front | None = None

    def begin(self, run: str, at_once: bool) -> None:
        """Be alive as the run `run`; unless `at_once`, wait until somebody listens."""
        self._run = run
        texts = (self._bundle.profile_toml, self._bundle.rig_toml, self._bundle.model_toml)
        status = Status(Spec(run, self._bundle.name, "", "", *texts))
        self._front = Front(self._link, status, lambda _: "observe", _refuse)
        for component in COMPONENTS:
            self._link.alive(f"{run}.{component}")
        # At full speed the beginning would be gone before anybody came.
        if not (at_once or self._link.listeners.heard):
            say("waiting for somebody to listen, as `shaketwin view`; Ctrl-C ends it")
        while not (at_once or self._link.listeners.heard):
            self._serve()

    def put(self, item: Item) -> None:
        """Publish one item, once everybody is near enough."""
        while self._link.behind() > AHEAD:
            self._serve()
        name, payload = topic(item), encode(item, self._run)
        self._link.publish(name, payload)
        if self._front is not None:
            self._front.status.see(name, payload)
            self._front.serve()

    def finish(self) -> None:
        """Until everybody has everything, at most as long as a live run lingers."""
        until = self._clock.now() + LINGER_S
        while self._link.behind() > 0 and self._clock.now() < until:
            self._serve()

    def _serve(self) -> None:
        """Answer who asks, and wait a little."""
        if self._front is not None:
            self._front.serve()
        self._clock.wait_until(self._clock.now() + LOOK_S)


def _refuse(question: Question, *_: str) -> None:
    question.reply("refused: this is a recording that is replayed")


@contextmanager
def publishing(bundle: Bundle, endpoint: str, keys: Keys | None = None) -> Iterator[Bus]:
    """The hub of a run at an endpoint; BadInput where a run is there already."""
    rig = bundle.rig.name
    also = PUBLIC if keys is not None else merged(PUBLIC, open_access(rig))
    link = open_hub(rig, endpoint, also, None if keys is None else keys.without_twins())
    try:
        link.declare(tuple(TOPIC_TYPES))
        bus = Bus(link, bundle)
        yield bus
        bus.finish()
    finally:
        link.close()
