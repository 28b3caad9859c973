"""Event log of a session: its states and the pending records."""

from collections.abc import Callable, Iterator

from table_io.records import Event, Record

MAX_LATENESS_S = 0.1  # a block later than this after its schedule is reported


class EventLog:
    """States so far and records pending since the last drain; `at()` gives the sample index."""

    def __init__(self, at: Callable[[], int]) -> None:
        self.states = ["idle"]
        self.pending: list[Record] = []
        self._sample_index = at
        self._was_late = False

    def drain(self) -> Iterator[Record]:
        """Yield the records that are pending since the last call."""
        records, self.pending = self.pending, []
        yield from records

    def add_event(self, kind: str, text: str) -> None:
        """Add an Event at the current sample."""
        self.pending.append(Event(self._sample_index(), kind, text))

    def enter_state(self, state: str) -> None:
        """Enter a state and add an Event if it is a new one."""
        if state != self.states[-1]:
            self.states.append(state)
            self.add_event("state", state)

    def report_lateness(self, late_s: float, end: int) -> None:
        """Add an Event for the first late block of a series; the block ends at sample `end`."""
        if late_s > MAX_LATENESS_S and not self._was_late:
            self.add_event("late", f"the block that ends at sample {end} came {late_s:.3f} s late")
        self._was_late = late_s > MAX_LATENESS_S
