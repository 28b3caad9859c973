"""Live view of a running test: draws the data from the bus in Rerun until the run ends."""

from collections.abc import Callable, Sequence

from table_io.clock import RealClock
from table_io.records import RunStart, RunStop
from twin.transport.codec import TOPIC_TYPES, Item, WireError, decode_item
from twin.transport.endpoint import STREAM_TOPICS, list_runs
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import BusLink
from twin.viewer.view import RerunView

BATCH_S = 0.1
POLL_S = 0.02
QUEUE_CAPACITY = 15_000  # fragments; more are dropped, so that a viewer never slows a test
MAX_ITEMS = 1000  # per drain, so that a replay at full speed leaves time to draw
MAX_SILENCE_S = 5.0  # without data, before checking whether the rig is still connected
DRAIN_S = 0.3  # wait for the last blocks after the end of the run
HISTORY_TOPICS = tuple(topic for topic in TOPIC_TYPES if topic not in STREAM_TOPICS)


def serve_live_view(link: BusLink, address: str, should_stop: Callable[[], bool]) -> None:
    """Serve a live view at `address` until the run ends or `should_stop()` is true."""
    live = LiveView(link, address)
    while not live.is_over and not should_stop():
        live.listen(BATCH_S)
    live.close()


class LiveView:
    """Live view of a running test: configuration, events and PRC so far, samples from now on.

    Past samples are not fetched, so that the view appears at once.
    """

    def __init__(self, link: BusLink, address: str, max_silence_s: float = MAX_SILENCE_S) -> None:
        self.view: RerunView | None = None
        self.end_reason = ""  # message for the user once the run has ended
        self.ignored = 0  # invalid payloads and items of other runs
        self._link = link
        self._address = address
        self._max_silence_s = max_silence_s
        self._run = ""
        self._blocks = link.subscribe(tuple(STREAM_TOPICS), history=False, capacity=QUEUE_CAPACITY)
        self._records = link.subscribe(HISTORY_TOPICS, history=True, capacity=QUEUE_CAPACITY)
        self._clock = RealClock()
        self._last_arrival_s = self._clock.now()
        self._early_items: list[tuple[str, Item]] = []  # (run, item) before the run is known

    @property
    def is_over(self) -> bool:
        return bool(self.end_reason)

    def listen(self, seconds: float) -> None:
        """Receive items for `seconds` and draw them."""
        deadline = self._clock.now() + seconds
        arrived: list[tuple[str, Item]] = []
        history_pending = self.view is None  # history arrives in chunks
        while (remaining_s := deadline - self._clock.now()) > 0:
            records = self._drain(
                self._records, min(remaining_s, POLL_S) if history_pending else 0.0
            )
            history_pending = bool(records)
            arrived += records
            arrived += self._drain(
                self._blocks, 0.0 if history_pending else min(remaining_s, POLL_S)
            )
        if any(isinstance(item, RunStop) for _, item in arrived):
            while blocks := self._drain(self._blocks, DRAIN_S):
                arrived += blocks
        self._feed(arrived)
        if self._clock.now() > self._last_arrival_s + self._max_silence_s:
            self._last_arrival_s = self._clock.now()
            if not list_runs(self._link.list_components()):
                self.end_reason = "the rig has disconnected"

    def _drain(self, subscriber: ReliableSubscriber, seconds: float) -> list[tuple[str, Item]]:
        """Return (run, item) of queued messages; wait at most `seconds` for the first."""
        items: list[tuple[str, Item]] = []
        while len(items) < MAX_ITEMS and (arrived := subscriber.get(seconds)) is not None:
            self._last_arrival_s, seconds = self._clock.now(), 0.0
            try:
                items.append(decode_item(*arrived))
            except WireError:
                self.ignored += 1
        return items

    def _feed(self, arrived: Sequence[tuple[str, Item]]) -> None:
        """Feed the view with the items of its run; the first RunStart opens the view."""
        for _, item in arrived:
            if self.view is None and isinstance(item, RunStart):
                self._run, self.view = item.run, RerunView(item, serve=self._address)
        if self.view is None:
            self._early_items += arrived
            return
        items = [item for run, item in (*self._early_items, *arrived) if run == self._run]
        self.ignored += len(self._early_items) + len(arrived) - len(items)
        self._early_items = []
        self.view.feed(items)
        for stop in (item for item in items if isinstance(item, RunStop)):
            self.end_reason = f"the test has ended: {stop.verdict}, {stop.reason}"

    def close(self) -> None:
        """Stop serving."""
        if self.view is not None:
            self.view.close()
