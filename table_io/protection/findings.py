"""Findings, and the sentences in which they speak."""

from dataclasses import dataclass
from typing import NamedTuple

from table_io.channels import BY_NAME
from table_io.profile import Profile
from table_io.protection import watch
from table_io.protection.cycle import Doubt, spoken
from table_io.records import Event, Trip
from table_io.units import GRAVITY_M_S2

NEEDED = frozenset({"drive_disp_m", "table_disp_m", "table_acc_m_s2"})  # by the controller
ALARMS = frozenset({"level", "response"})  # of the machine; all others are of sensors


@dataclass(frozen=True, slots=True)
class Finding:
    """Something wrong at sample `index`: `stop` latches a trip, else it is an alarm."""

    index: int
    kind: str  # one word: stroke, velocity, lost, stuck, level, ...
    channel: str
    value: float  # SI
    limit: float  # SI
    text: str
    stop: bool

    def trip(self, decided: int) -> Trip:
        """The trip that it latches, when the session had looked up to sample `decided`."""
        return Trip(self.index, decided, self.kind, self.channel, self.value, self.limit, self.text)

    def event(self) -> Event:
        """The alarm that it raises where it does not stop."""
        return Event(self.index, "alarm" if self.kind in ALARMS else "sensor", self.text)


class Wording(NamedTuple):
    """What a code is called, how severe it is ("stop", "alarm", "sensor": as for its channel), its
    sentence, and the unit of value and limit ("": that of the channel) with its scale from SI.
    """

    kind: str
    severity: str
    sentence: str
    unit: str = ""
    scale: float = 1.0


_BEYOND = "{channel}: {value} at sample {at} exceeds {limit}"
WORDINGS = {
    watch.STROKE: Wording("stroke", "stop", _BEYOND, "mm", 1e3),
    watch.VELOCITY: Wording(
        "velocity",
        "stop",
        "the table moves at {value} at sample {at}; allowed: {limit}",
        "mm/s",
        1e3,
    ),
    watch.ACCELERATION: Wording("acceleration", "stop", _BEYOND, "g", 1 / GRAVITY_M_S2),
    watch.FORCE: Wording(
        "force",
        "stop",
        "the actuator has to push with {value} at sample {at}; allowed: {limit}",
        "kN",
        1e-3,
    ),
    watch.RAIL: Wording("rail", "sensor", "{channel} is at its range, {limit}, at sample {at}"),
    watch.LOST: Wording("lost", "alarm", "{channel} is lost at sample {at}"),
    watch.DROPPED: Wording("lost", "alarm", "all channels are lost at sample {at}"),
    watch.BLIND: Wording(
        "lost",
        "sensor",
        "{channel} is lost for {value} at sample {at}; allowed: {limit}",
        "ms",
        1e3,
    ),
    watch.STUCK: Wording(
        "stuck", "sensor", "{channel} has not changed for {value} samples at sample {at}", " ", 1.0
    ),
    watch.SILENT: Wording(
        "silent",
        "sensor",
        "{channel} has lost its noise at sample {at}: {value} rms, at rest more than {limit}; is "
        "its cable off?",
    ),
    watch.SPIKE: Wording(
        "spike", "alarm", "{channel}: one sample is {value} off its neighbours, sample {at}"
    ),
    watch.REPEATED: Wording(
        "repeated",
        "alarm",
        "the samples up to {at} repeat those of {value} before; they are no measurement",
        "ms",
        1e3,
    ),
    watch.COMMAND: Wording(
        "command",
        "stop",
        "the command read back is {value} off what was queued at sample {at}; allowed: {limit}",
        "mm",
        1e3,
    ),
    watch.FOLLOWING: Wording(
        "following",
        "stop",
        "the table is {value} off what its command asks for at sample {at}; allowed: {limit}",
        "mm",
        1e3,
    ),
}


def worded(
    code: int, index: int, channel: str, value: float, limit: float, profile: Profile
) -> Finding:
    """The finding of the pass over every sample, in words."""
    wording = WORDINGS[code]
    unit = wording.unit or BY_NAME[channel].unit
    said = wording.sentence.format(
        channel=channel,
        at=index,
        value=spoken(value * wording.scale, unit),
        limit=spoken(limit * wording.scale, unit),
    )
    stop = _stops(wording.severity, channel, profile)
    return Finding(index, wording.kind, channel, value, limit, said, stop)


def confirmed(doubt: Doubt, index: int, profile: Profile) -> Finding:
    """The finding that a doubt has become before sample `index`."""
    stop = _stops(doubt.severity, doubt.channel, profile)
    text = f"{doubt.text} (before sample {index})"
    return Finding(index, doubt.kind, doubt.channel, doubt.value, doubt.limit, text, stop)


def _stops(severity: str, channel: str, profile: Profile) -> bool:
    if severity == "sensor":
        return channel in NEEDED or profile.protection.sensor == "stop"
    return severity == "stop"
