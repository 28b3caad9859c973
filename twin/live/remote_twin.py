"""Validation of a remote twin's output before it is admitted to a run."""

from dataclasses import dataclass, field

from table_io.block import Block
from table_io.records import Comparison, Event, Fault, PredictionHash, Timing
from twin.transport.codec import TOPIC_TYPES, Item, WireError, decode_item
from twin.transport.history_cache import FIRST_FLAG, LAST_FLAG, Fragment
from twin.transport.reliable_subscriber import ReliableSubscriber

TWIN_TOPICS = (
    *(name for name in TOPIC_TYPES if name.startswith("/twin/")),
    "/run/fault",
    "/run/timing",
    "/run/event",
)
MAX_OFFERS_PER_TURN = 8  # fragments taken per turn of the gateway's loop
MAX_LEAD_SAMPLES = 10_000  # by which a twin may be ahead of the rig's known sample
MAX_TEXT_CHARS = 1000
MAX_TWINS, MAX_PARTIAL_PAYLOADS = 256, 64  # publishers; incomplete payloads
MAX_PAYLOAD_FRAGMENTS = 8  # a twin's largest payload has one


def is_valid_offer(
    topic: str, payload: bytes, run: str, rig_end: int, event_kinds: frozenset[str]
) -> bool:
    """Return True if the payload decodes as its topic requires and is twin output of this run.

    `rig_end` is the end sample of the rig's newest block, `event_kinds` the kinds of events that a
    twin may publish.
    """
    try:
        item_run, item = decode_item(topic, payload)
    except WireError:
        return False
    return (
        item_run == run
        and _last_sample(item) <= rig_end + MAX_LEAD_SAMPLES
        and _is_twin_item(item, event_kinds)
    )


def _last_sample(item: Item) -> int:
    """Return the last sample index to which an item refers."""
    match item:
        case Block(end=end):
            return end
        case Comparison() | PredictionHash():
            return item.index + item.count
        case Fault(index=index, to_index=to_index):
            return max(index, to_index)
    return item.index


def _is_twin_item(item: Item, event_kinds: frozenset[str]) -> bool:
    """Return True if a twin may publish this item; its texts must be one readable line."""
    match item:
        case Event(kind=kind, text=text):
            return kind in event_kinds and is_readable(text)
        case Fault(component=component, reason=reason):
            return component == "twin" and is_readable(reason)
        case Timing(component=component):
            return component == "twin"
    return True


def is_readable(text: str) -> bool:
    """Return True if a text is short and printable, so that it can be shown as one line."""
    return len(text) <= MAX_TEXT_CHARS and text.isprintable()


@dataclass(slots=True)
class OfferFilter:
    """Filter of fragments published by a remote twin: reassembles and validates payloads.

    Publisher names are not authenticated, and the run's own names are public: fragments under a
    publisher name first seen inside the run are discarded as forged.
    """

    inbox: ReliableSubscriber
    run: str
    event_kinds: frozenset[str]
    run_publishers: set[str] = field(default_factory=set)  # the run's own publishers
    _twin_publishers: set[str] = field(default_factory=set)
    _partial_payloads: dict[tuple[str, str], list[Fragment]] = field(default_factory=dict)

    def take(self, rig_end: int) -> list[Fragment] | None:
        """Return the fragments of the next complete, valid payload.

        [] if the fragment taken does not complete one or is refused, None if the inbox is empty.
        `rig_end` is the end sample of the rig's newest block.
        """
        fragment = self.inbox.get_fragment(0.0)
        if fragment is None:
            return None
        fragments = [] if self._is_refused(fragment.publisher) else self._assemble(fragment)
        payload = b"".join(part.body for part in fragments)
        if not fragments or not is_valid_offer(
            fragment.topic, payload, self.run, rig_end, self.event_kinds
        ):
            return []
        self._twin_publishers.add(fragment.publisher)
        return fragments

    def _is_refused(self, source: str) -> bool:
        if source in self._twin_publishers:
            return False
        return source in self.run_publishers or len(self._twin_publishers) >= MAX_TWINS

    def _assemble(self, fragment: Fragment) -> list[Fragment]:
        """Return the fragments of the payload that this one completes; [] otherwise."""
        key = (fragment.topic, fragment.publisher)
        fragments = self._partial_payloads.pop(key, [])
        if fragment.flags & FIRST_FLAG:
            fragments = []
        elif (
            not fragments
            or fragment.sequence != fragments[-1].sequence + 1
            or len(fragments) == MAX_PAYLOAD_FRAGMENTS
        ):
            return []
        fragments.append(fragment)
        if fragment.flags & LAST_FLAG:
            return fragments
        while len(self._partial_payloads) >= MAX_PARTIAL_PAYLOADS:
            del self._partial_payloads[next(iter(self._partial_payloads))]  # the oldest
        self._partial_payloads[key] = fragments
        return []
