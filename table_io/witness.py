"""What would have stopped a table that can be stopped: seen, and said.

The protection and the loop check of a session that follows. They hold what was measured against the
drive, sample by sample at its place, and change nothing.
"""

from dataclasses import replace

import numpy as np

from table_io import conductor as conducting
from table_io import loop_check, protection
from table_io.block import Block, Bool2D, Float2D, Int1D, join
from table_io.calibration import noise_from
from table_io.drive import Drive
from table_io.protection import Seen
from table_io.records import Event, Record
from table_io.session import Setup

ELSEWHERE = "the table cannot be stopped from here: stop it at its controller"


class Witness:
    """Protection and loop check beside a controller that nobody here can stop.

    `tare_v` are the volts at rest, (channel, sample). Without the command there is no protection.
    """

    def __init__(self, setup: Setup, tare_v: Float2D) -> None:
        self.setup = setup
        self.tripped = False
        profile, rig = setup.profile, setup.rig
        noise = noise_from(tare_v, rig.sensors)
        self.noise = {name: rms for name, (rms, _) in noise.items()}
        self.guards = "drive_disp_m" in rig.channels
        self._guard = protection.begin(profile, rig, noise) if self.guards else None
        self._checked_at = conducting.start(conducting.score(profile, rig)).stage.last
        self._heard: list[tuple[Block, int]] = []
        self._checks = profile.loop_check.enabled

    def protect(
        self, block: Block, clipped: Bool2D, places: Int1D, drive: Drive
    ) -> tuple[Record, ...]:
        """What protection says of a block whose samples lie at these places of the drive.

        The first finding that would stop the table is a Trip, what comes later an Event.
        """
        if self._guard is None:
            return ()
        first, count, at = span(places)
        asked = (drive.command(first, count), drive.phase(first, count), drive.level(first, count))
        seen = Seen(block, clipped, *(row[at] for row in asked))
        self._guard, findings = protection.inspect(self._guard, seen)
        said: list[Record] = []
        for one in findings:
            if one.stop and not self.tripped:
                self.tripped = True
                trip = one.trip(block.end)
                said.append(replace(trip, text=f"{trip.text}; {ELSEWHERE}"))
            else:
                said.append(one.event())
        return tuple(said)

    def check(self, block: Block, places: Int1D, drive: Drive) -> tuple[Record, ...]:
        """What the loop check shows, once its motions and the rest after them have been heard."""
        last = int(places[-1])
        if not self._checks or last < 0:
            return ()
        self._heard.append((block, int(places[0])))
        if last < self._checked_at:
            return ()
        heard, self._heard, self._checks = self._heard, [], False
        # Two clocks: in the middle of the check its samples lie where they belong.
        middle, place = heard[len(heard) // 2]
        whole = join([one for one, _ in heard])
        first = place - (middle.index - whole.index)
        if first > drive.segments[0].start or first + len(whole) < self._checked_at:
            return (Event(block.end, "check", "not all of the loop check was heard: not judged"),)
        return self._judged(replace(whole, index=first), drive, block.end)

    def _judged(self, heard: Block, drive: Drive, index: int) -> tuple[Record, ...]:
        """Its lines and the response, told at sample `index`."""
        profile, rig = self.setup.profile, self.setup.rig
        heard = heard.cut(max(heard.index, 0), self._checked_at)
        if not self.guards:
            return (Event(index, "check", "no command is wired: the loop check is not judged"),)
        checks, response = loop_check.evaluate(heard, drive, profile, rig, self.noise)
        said: list[Record] = [replace(one, index=index) for one in checks]
        if response is not None:
            response = replace(response, index=index)
            said.append(response)
            if self._guard is not None:
                self._guard = protection.identified(self._guard, response)
        if not all(one.passed for one in checks):
            text = f"the loop check failed, and the test goes on; {ELSEWHERE}"
            said.append(Event(index, "check", text))
        return tuple(said)


def span(places: Int1D) -> tuple[int, int, Int1D]:
    """(first, count) of the drive's samples that places span, and where each place is in them."""
    first = int(places[0])
    return first, int(places[-1]) - first + 1, np.asarray(places - first)
