"""The simulated table served as an openDAQ device, under a controller that plays a drive file.

The library's server listens on EVERY interface of the computer and asks for no password: whoever
reaches its port sees the samples. Nobody can move anything by it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from table_io.backends.follow.controller import Played
from table_io.backends.opendaq.source import library, needed
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock, wall_ns
from table_io.machine.blackbox import BlackBox
from table_io.machine.life import Life
from table_io.machine.wire import Message
from table_io.profile import Specimen
from table_io.rig import Rig
from table_io.sensor import Sensor

TICK_S = 0.004  # between two looks at the plant
AHEAD_S, PIECE_S = 0.5, 1.0  # of the file that are queued in the plant, and how much at a time
NANO = 1_000_000_000


class Device:
    """An openDAQ device with one signal for each sensor of a card, in V, on one clock."""

    def __init__(self, rig: Rig, rate_hz: float) -> None:
        wiring = needed(rig)
        self._daq = daq = library()
        builder = daq.InstanceBuilder()
        builder.global_log_level = daq.LogLevel.Off
        builder.default_root_device_local_id = rig.name
        self._instance: Any = builder.build()
        folder = next(one for one in self._instance.items if one.local_id == "Sig")
        self._delta = round(NANO / rate_hz)
        self._began_ns = wall_ns()
        self._stamps = self._stamp_descriptor()
        self._time = self._added(folder, "time", self._stamps)
        self._signals = []
        for sensor in rig.sensors:
            name = wiring.signals[sensor.channel].rsplit("/", 1)[-1]
            values = self._value_descriptor(self.unit(sensor))
            signal = self._added(folder, name, values)
            signal.domain_signal = self._time
            self._signals.append((signal, values))
        settings = daq.PropertyObject()
        port, poll = ("NativeStreamingPort", wiring.address[1]), ("StreamingDataPollingPeriod", 1)
        for key, value in (port, poll):  # ms between two looks; the library's own 20 make us late
            settings.add_property(daq.IntProperty(key, value, daq.Boolean(True)))
        try:
            self._instance.add_server("OpenDAQNativeStreaming", settings)
        except RuntimeError as error:
            raise BadInput(
                f"{wiring.device}: cannot be served here: {str(error).splitlines()[0]}; is another "
                "one there? End it, or give another port"
            ) from None

    @property
    def heard(self) -> bool:
        """True while somebody acquires."""
        return any(len(signal.connections) for signal, _ in self._signals)

    def unit(self, _: Sensor) -> str:
        """The unit of a signal."""
        return "V"

    def send(self, index: int, volts: Float2D) -> None:
        """Samples from `index` on, (channel, sample); those lost in all channels are left out."""
        there = ~np.isnan(volts).all(axis=0)
        edges = np.flatnonzero(np.diff(there, prepend=False, append=False))
        for first, last in edges.reshape(-1, 2).tolist():
            offset = self._began_ns + (index + first) * self._delta
            stamps = self._daq.DataPacket(self._stamps, last - first, offset)
            self._time.send_packet(stamps)
            for (signal, values), row in zip(self._signals, volts, strict=True):
                packet = self._daq.DataPacketWithDomain(stamps, values, last - first, 0)
                np.frombuffer(packet.raw_data, dtype=np.float64)[:] = row[first:last]
                signal.send_packet(packet)

    def _added(self, folder: Any, name: str, descriptor: Any) -> Any:
        signal = self._daq.SignalWithDescriptor(
            self._instance.context, descriptor, folder, name, None
        )
        self._daq.IFolderConfig.cast_from(folder).add_item(signal)
        return signal

    def _stamp_descriptor(self) -> Any:
        builder = self._daq.DataDescriptorBuilder()
        builder.sample_type = self._daq.SampleType.Int64
        builder.tick_resolution = self._daq.Ratio(1, NANO)
        builder.rule = self._daq.LinearDataRule(self._delta, 0)
        builder.origin = "1970-01-01T00:00:00Z"
        builder.unit = self._daq.Unit(-1, "s", "second", "time")
        return builder.build()

    def _value_descriptor(self, unit: str) -> Any:
        builder = self._daq.DataDescriptorBuilder()
        builder.sample_type = self._daq.SampleType.Float64
        builder.unit = self._daq.Unit(-1, unit, "", "")
        return builder.build()


@dataclass(frozen=True, eq=False)
class Script:
    """What the controller plays: a file in m with its rate, how fast its clock runs, and when."""

    values_m: Float1D
    rate_hz: float
    ppm: float = 0.0
    after_s: float = 5.0  # after somebody began to acquire


class Bystander:
    """The table and its controller, told the time: plays the file a while after somebody acquires.

    It plays it once for each acquisition.
    """

    def __init__(self, life: Life, rig: Rig, script: Script | None) -> None:
        self._life = life
        self._rate_hz = life.plant.rate_hz
        self._volts_per_m = rig.output.volts_per_m
        self._script = script
        self._played: Played | None = None
        self._queued = 0
        self._stopped = False

    @property
    def at_rest(self) -> bool:
        """True where the command has come to its end."""
        return self._life.taken > self._queued + round(0.5 * self._rate_hz)

    def turn(self, now: float, heard: bool) -> list[Message]:
        """Play up to `now`; the samples that were taken."""
        life = self._life
        if not heard and self.at_rest:
            self._played = None
        elif heard and self._played is None and not self._stopped and self._script is not None:
            script = self._script
            # a clock of its own: it starts between two of our samples
            start = life.taken + script.after_s * self._rate_hz + 0.37
            file = script.values_m, script.rate_hz
            self._played = Played(*file, self._rate_hz, start, script.ppm)
            self._queued = int(start)
        if self._played is not None and not self._stopped:
            self._queue(self._played, now)
        life.play(now)
        return life.handed_over(now)

    def stop(self, now: float) -> None:
        """Bring the table to its mean from where it is."""
        played, at = self._played, self._life.taken + round(0.1 * self._rate_hz)
        self._stopped = True
        if played is None or at >= self._queued:
            return
        self._life.queue(at, played.command(at, 3) * self._volts_per_m, now)  # which it lands
        self._queued = self._life.rest_from = at + round(5.0 * self._rate_hz)

    def _queue(self, played: Played, now: float) -> None:
        """Keep AHEAD_S of the file in the plant."""
        ahead = self._life.taken + round(AHEAD_S * self._rate_hz)
        while self._queued < min(ahead, played.end):
            count = min(round(PIECE_S * self._rate_hz), played.end - self._queued)
            volts = played.command(self._queued, count) * self._volts_per_m
            self._life.queue(self._queued, volts, now)
            self._queued += count


def serve(
    rig: Rig,
    specimen: Specimen,
    script: Script | None,
    box: BlackBox | None,
    clock: Clock,
    tell: Callable[[str], None],
    going: Callable[[], bool],
) -> None:
    """Be the device, and the controller beside it, while `going()`; then come to rest.

    Without a script the table stays at rest.
    """
    rate_hz = rig.rates_hz[len(rig.rates_hz) // 2]
    if script is not None and script.rate_hz in rig.rates_hz:
        rate_hz = script.rate_hz
    life = Life(rig, specimen, rate_hz, box)
    device = Device(rig, rate_hz)
    controller = Bystander(life, rig, script)
    tell(
        f"{rig.title}, at rest; an openDAQ device, waiting at {needed(rig).device} and at EVERY "
        f"interface of this computer, {rate_hz:g} Hz"
    )
    life.start(clock.now())
    heard, asked = False, False
    while not (asked and controller.at_rest):
        now = clock.now()
        if not asked and not going():
            asked = True
            controller.stop(now)
        if heard != device.heard:
            heard = device.heard
            plays = f"; the controller plays in {script.after_s:g} s" if script and heard else ""
            tell(("somebody acquires" if heard else "nobody acquires any more") + plays)
        for message in controller.turn(now, heard):
            device.send(message.index, message.values.reshape(-1, len(rig.channels)).T)
        clock.wait_until(now + TICK_S)
