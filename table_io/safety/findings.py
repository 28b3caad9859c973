"""Findings of the protection and their messages."""

from dataclasses import dataclass
from typing import NamedTuple

from table_io.channels import CONTROL_CHANNELS, Channel
from table_io.config.profile import Profile
from table_io.records import Event, Trip
from table_io.safety import sample_checks as codes
from table_io.units import GRAVITY_M_S2

MACHINE_ALARM_KINDS = frozenset({"level", "response", "limit"})  # all other kinds are sensor faults
# Checks are half a cycle apart, so the first and the last of three share no sample.
CONFIRMATION_CHECKS = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """Fault at sample `index`; `stop`: it latches a trip, otherwise it raises an alarm."""

    index: int
    kind: str  # one word: stroke, velocity, lost, stuck, level, ...
    channel: str
    value: float  # SI
    limit: float  # SI
    text: str
    stop: bool

    def to_trip(self, decided_at: int) -> Trip:
        """Return the trip of this finding; `decided_at` is the last sample known by then."""
        return Trip(
            self.index, decided_at, self.kind, self.channel, self.value, self.limit, self.text
        )

    def to_event(self) -> Event:
        """Return the alarm event of a finding that does not stop the table."""
        return Event(
            self.index, "alarm" if self.kind in MACHINE_ALARM_KINDS else "sensor", self.text
        )


@dataclass(frozen=True, slots=True)
class Suspicion:
    """Suspected fault from one cycle check, SI.

    `severity` is "stop", "alarm" or "sensor" (stop or alarm, depending on the channel).
    """

    kind: str
    channel: str
    value: float
    limit: float
    text: str
    severity: str = "sensor"
    required_checks: int = CONFIRMATION_CHECKS
    group: str = ""  # key shared by successive suspicions where the channel may change

    @property
    def key(self) -> tuple[str, str, str]:
        """Key by which successive suspicions count as the same."""
        return self.kind, self.group or self.channel, self.severity


class Wording(NamedTuple):
    """Kind, severity and message template of a code of `sample_checks`.

    `severity` is "stop", "alarm" or "sensor" (depending on the channel); `unit` is that of value
    and limit ("": unit of the channel), `scale` its factor from SI.
    """

    kind: str
    severity: str
    sentence: str
    unit: str = ""
    scale: float = 1.0


_BEYOND = "{channel}: {value} at sample {at} exceeds {limit}"
WORDINGS = {
    codes.STROKE: Wording("stroke", "stop", _BEYOND, "mm", 1e3),
    codes.VELOCITY: Wording("velocity", "stop",
        "the table moves at {value} at sample {at}; allowed: {limit}", "mm/s", 1e3),
    codes.ACCELERATION: Wording("acceleration", "stop", _BEYOND, "g", 1 / GRAVITY_M_S2),
    codes.FORCE: Wording("force", "stop",
        "the actuator force is {value} at sample {at}; allowed: {limit}", "kN", 1e-3),
    codes.RAIL: Wording("rail", "sensor", "{channel} saturates at {limit} at sample {at}"),
    codes.LOST: Wording("lost", "alarm", "{channel} is lost at sample {at}"),
    codes.DROPPED: Wording("lost", "alarm", "all channels are lost at sample {at}"),
    codes.BLIND: Wording("lost", "sensor",
        "{channel} is lost for {value} at sample {at}; allowed: {limit}", "ms", 1e3),
    codes.STUCK: Wording("stuck", "sensor",
        "{channel} has not changed for {value} samples at sample {at}", " "),
    codes.SILENT: Wording("silent", "sensor",
        "{channel} shows less noise than at rest at sample {at}: {value} rms; expected: at least "
        "{limit}; check its cable"),
    codes.SPIKE: Wording("spike", "alarm",
        "{channel}: sample {at} deviates by {value} from its neighbors"),
    codes.REPEATED: Wording("repeated", "alarm",
        "the samples up to {at} repeat those {value} earlier; they are not new measurements",
        "ms", 1e3),
    codes.COMMAND: Wording("command", "stop",
        "the command read back differs by {value} from the queued one at sample {at}; "
        "allowed: {limit}", "mm", 1e3),
    codes.FOLLOWING: Wording("following", "stop",
        "the table deviates by {value} from its command at sample {at}; allowed: {limit}",
        "mm", 1e3),
}  # fmt: skip


def to_finding(
    code: int, index: int, channel: Channel, value: float, limit: float, profile: Profile
) -> Finding:
    """Make the finding of a sample check, with its message."""
    wording = WORDINGS[code]
    unit = wording.unit or channel.unit
    text = wording.sentence.format(
        channel=channel.name,
        at=index,
        value=format_si(value * wording.scale, unit),
        limit=format_si(limit * wording.scale, unit),
    )
    stop = _is_stop(wording.severity, channel.name, profile)
    return Finding(index, wording.kind, channel.name, value, limit, text, stop)


def confirm_suspicion(suspicion: Suspicion, index: int, profile: Profile) -> Finding:
    """Make the finding of a suspicion that is confirmed before sample `index`."""
    stop = _is_stop(suspicion.severity, suspicion.channel, profile)
    text = f"{suspicion.text} (before sample {index})"
    return Finding(
        index, suspicion.kind, suspicion.channel, suspicion.value, suspicion.limit, text, stop
    )


def _is_stop(severity: str, channel: str, profile: Profile) -> bool:
    if severity == "sensor":
        swept = profile.swept_sine
        needed = {*CONTROL_CHANNELS, *(swept.control_channels if swept is not None else ())}
        return channel in needed or profile.protection.sensor == "stop"
    return severity == "stop"


def format_si(value: float, unit: str) -> str:
    """Format a value with its unit, m as mm."""
    return f"{1e3 * value:.4g} mm" if unit == "m" else f"{value:.4g} {unit}".strip()


def suspect_drift(channel: str, value: float, limit: float, unit: str) -> Suspicion:
    """Make the suspicion that a sensor has drifted by `value`."""
    text = f"{channel} has drifted by {format_si(value, unit)}; allowed: {format_si(limit, unit)}"
    return Suspicion("drift", channel, value, limit, text)
