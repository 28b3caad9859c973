"""What a session says while it runs: its states, and the records that wait to be handed on."""

from collections.abc import Callable, Iterator

from table_io.records import Event, Record

LATE_S = 0.1  # after its schedule a block is late


class Telling:
    """The states so far, and what was said since it was asked last, at the sample `at()`."""

    def __init__(self, at: Callable[[], int]) -> None:
        self.states = ["idle"]
        self.said: list[Record] = []
        self._at = at
        self._was_late = False

    def told(self) -> Iterator[Record]:
        """What has been said since this was asked last."""
        said, self.said = self.said, []
        yield from said

    def say(self, kind: str, text: str) -> None:
        """An Event of now."""
        self.said.append(Event(self._at(), kind, text))

    def to(self, state: str) -> None:
        """Be in this state, and say so where it is another one."""
        if state != self.states[-1]:
            self.states.append(state)
            self.say("state", state)

    def late(self, late_s: float, end: int) -> None:
        """Say where the block that ends at sample `end` is the first of some that came late."""
        if late_s > LATE_S and not self._was_late:
            self.say("late", f"the block that ends at sample {end} came {late_s:.3f} s late")
        self._was_late = late_s > LATE_S
