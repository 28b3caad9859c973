"""Simulated openDAQ device: the simulated table under a controller that plays a drive file.

The server of the openDAQ library listens on EVERY interface of the computer without a password:
any client that reaches its port can read the samples. No client can move the table.

The controller has its own clock. Between the values of the file its output is a cubic spline.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from table_io.backends.machine.protocol import MachineMessage
from table_io.backends.opendaq.source import load_library, require_opendaq_wiring
from table_io.block import Float1D, Float2D, find_stretches
from table_io.clock import wall_clock_ns
from table_io.config.rig import RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.sim.machine.table import MachineSession, PlaybackPlan, TableService

SPLINE_MARGIN = 16  # values on either side of a segment that enter its spline


@dataclass(frozen=True, eq=False)
class DrivePlayback:
    """Playback in m of a file whose value 0 is output at sample `start`, which may be fractional.

    `rate_hz` is the rate of the samples; the controller's clock is fast by `ppm`.
    """

    values_m: Float1D
    file_rate_hz: float
    rate_hz: float
    start: float
    ppm: float = 0.0

    @property
    def values_per_sample(self) -> float:
        """Values of the file per sample."""
        return self.file_rate_hz / self.rate_hz * (1.0 + 1e-6 * self.ppm)

    @property
    def end(self) -> int:
        """First sample after the end of the playback."""
        return int(np.ceil(self.start + (self.values_m.size - 1) / self.values_per_sample)) + 1

    def command(self, first: int, count: int) -> Float1D:
        """Return displacement in m at samples first .. first + count - 1; file ends are held."""
        positions = (np.arange(first, first + count) - self.start) * self.values_per_sample
        positions = np.clip(positions, 0.0, self.values_m.size - 1.0)
        if not positions.size:
            return positions
        first_value = max(int(positions[0]) - SPLINE_MARGIN, 0)
        piece = self.values_m[first_value : int(positions[-1]) + SPLINE_MARGIN + 2]
        if piece.size < 4:
            return np.interp(positions, np.arange(self.values_m.size), self.values_m)
        spline: Float1D = CubicSpline(np.arange(first_value, first_value + piece.size), piece)(
            positions
        )
        return spline


TICK_S = 0.004  # between two updates of the plant
MAX_QUEUED_S = 0.5  # of the file, queued in the plant
QUEUE_STEP_S = 1.0  # of the file, per call
NS_PER_S = 1_000_000_000


class OpenDaqServer:
    """openDAQ device with one signal in V for each sensor of the rig, all on one clock."""

    def __init__(self, rig: RigConfig, rate_hz: float) -> None:
        wiring = require_opendaq_wiring(rig)
        self._daq = daq = load_library()
        builder = daq.InstanceBuilder()
        builder.global_log_level = daq.LogLevel.Off
        builder.default_root_device_local_id = rig.name
        self._instance: Any = builder.build()
        folder = next(
            component for component in self._instance.items if component.local_id == "Sig"
        )
        self._delta = round(NS_PER_S / rate_hz)
        self._start_ns = wall_clock_ns()
        self._stamps = self._stamp_descriptor()
        self._time = self._add_signal(folder, "time", self._stamps)
        self._signals = []
        for sensor in rig.sensors:
            name = wiring.signals[sensor.channel].rsplit("/", 1)[-1]
            values = self._value_descriptor(self.unit(sensor))
            signal = self._add_signal(folder, name, values)
            signal.domain_signal = self._time
            self._signals.append((signal, values))
        settings = daq.PropertyObject()
        port, poll = ("NativeStreamingPort", wiring.address[1]), ("StreamingDataPollingPeriod", 1)
        for key, value in (port, poll):  # in ms; the library's default of 20 would delay samples
            settings.add_property(daq.IntProperty(key, value, daq.Boolean(True)))
        try:
            self._instance.add_server("OpenDAQNativeStreaming", settings)
        except RuntimeError as error:
            raise InputError(
                f"cannot be served on this computer: {str(error).splitlines()[0]}",
                where=wiring.device,
                remedy="end another device that uses this port, or give another port",
            ) from None

    @property
    def has_client(self) -> bool:
        """True while a client acquires."""
        return any(len(signal.connections) for signal, _ in self._signals)

    def unit(self, _: SensorConfig) -> str:
        """Return the unit of a signal."""
        return "V"

    def send(self, index: int, volts: Float2D) -> None:
        """Send volts, (channel, sample), from `index` on, without samples lost in all channels."""
        present = ~np.isnan(volts).all(axis=0)
        for first, last in find_stretches(present):
            offset = self._start_ns + (index + first) * self._delta
            stamps = self._daq.DataPacket(self._stamps, last - first, offset)
            self._time.send_packet(stamps)
            for (signal, values), row in zip(self._signals, volts, strict=True):
                packet = self._daq.DataPacketWithDomain(stamps, values, last - first, 0)
                np.frombuffer(packet.raw_data, dtype=np.float64)[:] = row[first:last]
                signal.send_packet(packet)

    def _add_signal(self, folder: Any, name: str, descriptor: Any) -> Any:
        signal = self._daq.SignalWithDescriptor(
            self._instance.context, descriptor, folder, name, None
        )
        self._daq.IFolderConfig.cast_from(folder).add_item(signal)
        return signal

    def _stamp_descriptor(self) -> Any:
        builder = self._daq.DataDescriptorBuilder()
        builder.sample_type = self._daq.SampleType.Int64
        builder.tick_resolution = self._daq.Ratio(1, NS_PER_S)
        builder.rule = self._daq.LinearDataRule(self._delta, 0)
        builder.origin = "1970-01-01T00:00:00Z"
        builder.unit = self._daq.Unit(-1, "s", "second", "time")
        return builder.build()

    def _value_descriptor(self, unit: str) -> Any:
        builder = self._daq.DataDescriptorBuilder()
        builder.sample_type = self._daq.SampleType.Float64
        builder.unit = self._daq.Unit(-1, unit, "", "")
        return builder.build()


class SimulatedController:
    """Table and controller: plays the file once per acquisition, `after_s` after its start."""

    def __init__(self, session: MachineSession, rig: RigConfig, plan: PlaybackPlan | None) -> None:
        self._session = session
        self._rate_hz = session.plant.rate_hz
        self._volts_per_m = rig.output.volts_per_m
        self._plan = plan
        self._playback: DrivePlayback | None = None
        self._queued = 0
        self._stopped = False

    @property
    def at_rest(self) -> bool:
        """True once the command has ended."""
        return self._session.taken > self._queued + round(0.5 * self._rate_hz)

    def advance(self, now_s: float, has_client: bool) -> list[MachineMessage]:
        """Play up to `now_s` and return the samples taken."""
        session = self._session
        if not has_client and self.at_rest:
            self._playback = None
        elif has_client and self._playback is None and not self._stopped and self._plan is not None:
            plan = self._plan
            # the controller has its own clock: it starts between two samples
            start = session.taken + plan.after_s * self._rate_hz + 0.37
            file = plan.values_m, plan.rate_hz
            self._playback = DrivePlayback(*file, self._rate_hz, start, plan.ppm)
            self._queued = int(start)
        if self._playback is not None and not self._stopped:
            self._queue(self._playback, now_s)
        session.play(now_s)
        return session.pop_arrived(now_s)

    def stop(self, now_s: float) -> None:
        """Bring the table to its mean from its present position."""
        playback, at = self._playback, self._session.taken + round(0.1 * self._rate_hz)
        self._stopped = True
        if playback is None or at >= self._queued:
            return
        # `session` extends a command that ends in motion by a smooth stop.
        self._session.queue(at, playback.command(at, 3) * self._volts_per_m, now_s)
        self._queued = self._session.rest_from = at + round(5.0 * self._rate_hz)

    def _queue(self, playback: DrivePlayback, now_s: float) -> None:
        """Keep MAX_QUEUED_S of the file queued in the plant."""
        ahead = self._session.taken + round(MAX_QUEUED_S * self._rate_hz)
        while self._queued < min(ahead, playback.end):
            count = min(round(QUEUE_STEP_S * self._rate_hz), playback.end - self._queued)
            volts = playback.command(self._queued, count) * self._volts_per_m
            self._session.queue(self._queued, volts, now_s)
            self._queued += count


def serve_opendaq(service: TableService) -> None:
    """Serve device and controller, and finally bring the table to rest."""
    rig, plan, clock = service.rig, service.plan, service.clock
    rate_hz = rig.rates_hz[len(rig.rates_hz) // 2]
    if plan is not None and plan.rate_hz in rig.rates_hz:
        rate_hz = plan.rate_hz
    session = MachineSession(rig, service.specimen, rate_hz, service.open_recorder())
    device = OpenDaqServer(rig, rate_hz)
    controller = SimulatedController(session, rig, plan)
    service.begin(
        f"{require_opendaq_wiring(rig).device} and on EVERY interface of this computer, "
        f"{rate_hz:g} Hz"
    )
    session.start(clock.now())
    has_client, stopping = False, False
    while not (stopping and controller.at_rest):
        now_s = clock.now()
        if not stopping and not service.keep_running():
            stopping = True
            controller.stop(now_s)
        if has_client != device.has_client:
            has_client = device.has_client
            plays = f"; the controller plays in {plan.after_s:g} s" if plan and has_client else ""
            service.notify(("acquisition started" if has_client else "acquisition ended") + plays)
        for message in controller.advance(now_s, has_client):
            device.send(message.index, message.values.reshape(-1, len(rig.channels)).T)
        clock.wait_until(now_s + TICK_S)
