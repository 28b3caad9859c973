"""Whether a rig is wired as its card says, without motion: what is judged, not how it is taken.

at_rest(resting) -> the lines of the inputs at rest
zero(resting) -> the line of the command at the output's 0 V
hands(rig) -> what to ask a person for; restless(hand, felt), moved(hand, felt) -> whether somebody
came too early, and when; proven(hand, felt) -> its lines
"""

from table_io.wiring_check.hand import Felt, Hand, hands, moved, proven, restless
from table_io.wiring_check.line import Line, judged, untested
from table_io.wiring_check.lines import watched
from table_io.wiring_check.rest import Resting, at_rest, zero

__all__ = [
    "Felt", "Hand", "Line", "Resting",
    "at_rest", "hands", "judged", "moved", "proven", "restless", "untested", "watched",
    "zero",
]  # fmt: skip
