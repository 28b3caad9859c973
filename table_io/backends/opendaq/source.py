"""Acquisition from an openDAQ device, an `AcquisitionSource`, and discovery of devices.

A signal in V is passed on unchanged; one in the unit of the sensor is converted to the volts that
this sensor would give. Time stamps assign every sample to its index, so samples lost by the device
or the network are NaN. `read` polls; there is no thread.
"""

import socket
from typing import Any

import numpy as np

from table_io.backends import SAMPLE_TIMEOUT_S, ChannelGroup, DiscoveredDevice, MachineLost
from table_io.backends.opendaq.config import OpenDaqWiring
from table_io.backends.opendaq.timestamps import (
    Assembly,
    ClockJumpError,
    TickClock,
    UnevenClockError,
    require_common_clock,
    require_simultaneous,
    sample_indices,
)
from table_io.block import Float2D
from table_io.clock import Clock
from table_io.config.rig import RigConfig
from table_io.errors import InputError, format_pip_line

CONNECT_TIMEOUT_S = 2.0
POLL_S = 0.001
FIRST_SAMPLE_TIMEOUT_S = 3.0
MAX_READ_SAMPLES = 1 << 16  # per channel and poll
MAX_CLOCK_JUMP_S = 5.0  # a longer jump of the stamps means that their clock was set
DRIFT_GAIN = 0.1  # of the filter that follows the drift of a disciplined clock, per poll
CLOCK_WINDOW_S = 10.0  # over which the device's clock is compared with the session's
UNIT_SYNONYMS = {
    "m/s²": "m/s2", "m/s^2": "m/s2", "g_n": "g", "gn": "g", "µm": "um", "μm": "um", "°C": "degC",
}  # fmt: skip


def require_opendaq_wiring(rig: RigConfig) -> OpenDaqWiring:
    """Return the [opendaq] wiring; InputError if it is incomplete or the library is missing."""
    wiring = rig.require_section("opendaq", OpenDaqWiring)
    missing = [name for name in rig.channels if name not in wiring.signals]
    if missing:
        raise InputError(
            f"no signal for {', '.join(missing)}",
            where=f"rig {rig.name}",
            key="opendaq.signals",
            remedy="name a signal of the device for each sensor, or remove the sensor",
        )
    load_library()
    return wiring


def load_library() -> Any:
    """Import the vendor's module; InputError if it is not installed."""
    try:
        import opendaq
    except ImportError as error:
        raise InputError(
            f"openDAQ is not installed ({error})", remedy=format_pip_line("opendaq")
        ) from None
    return opendaq


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the device does not answer or the library is not installed."""
    wiring = require_opendaq_wiring(rig)
    try:
        socket.create_connection(wiring.address, CONNECT_TIMEOUT_S).close()
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or error
        hint = (
            f"for a simulated one: shaketwin table --table {rig.name}" if rig.is_simulated else ""
        )
        raise InputError(
            f"no openDAQ device answers there ({reason})",
            where=wiring.device,
            remedy="switch it on, or correct opendaq.device in the rig file"
            f"{'; ' if hint else ''}{hint}",
        ) from None


class OpenDaqSource:
    """Inputs of one openDAQ device; an external controller moves the table."""

    def __init__(self, rig: RigConfig, rate_hz: float, clock: Clock) -> None:
        self._wiring = require_opendaq_wiring(rig)
        self._daq = load_library()
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.clock_description = ""  # clock of the device, and its time at sample 0; set by start
        self._rig = rig
        self._clock = clock
        self._instance: Any = None
        self._device: Any = None
        self._readers: list[Any] = []
        self._gain = np.ones(len(rig.sensors))
        self._ticks_per_sample = 1.0
        self._tick_clock: TickClock | None = None
        self._newest_tick: int | None = None
        self._first_tick = 0
        self._drift_ticks = 0.0  # drift of the stamps since then
        self._ticks: dict[int, int] = {}  # newest stamp of each row
        self._assembly: Assembly | None = None
        self._epoch_s: float | None = None
        self._clock_window = (0.0, 0.0)  # end of the window, earliest epoch in it

    def open(self) -> None:
        """Connect, find the signals, check units and rate; change no setting of the device."""
        self._rig.check_rate(self.rate_hz)
        builder = self._daq.InstanceBuilder()
        builder.global_log_level = self._daq.LogLevel.Off
        self._instance = builder.build()
        try:
            self._device = self._instance.add_device(self._wiring.device)
        except RuntimeError as error:
            raise InputError(
                str(error).splitlines()[0],
                key="opendaq.device",
                value=self._wiring.device,
                remedy="check that it is switched on and can be reached from this computer",
            ) from None
        signals_by_id = {str(signal.global_id): signal for signal in self._device.signals_recursive}
        signals = [self._find_signal(name, signals_by_id) for name in self.channels]
        for row, signal in enumerate(signals):
            self._gain[row] = self._volts_per(row, signal)
        self._tick_clock = require_common_clock(
            self._daq, signals, self.rate_hz, self._wiring.device
        )
        self._ticks_per_sample = self._tick_clock.ticks_per_sample
        float64, int64 = self._daq.SampleType.Float64, self._daq.SampleType.Int64
        self._readers = [
            self._daq.StreamReader(signal, value_type=float64, domain_type=int64)
            for signal in signals
        ]
        deadline_s = self._clock.now() + FIRST_SAMPLE_TIMEOUT_S
        while self._newest_tick is None:
            self._poll()
            if self._clock.now() > deadline_s:
                raise InputError(
                    f"no sample within {FIRST_SAMPLE_TIMEOUT_S:g} s",
                    where=self._wiring.device,
                    remedy="start its acquisition",
                )
            self._clock.wait_until(self._clock.now() + POLL_S)
        deadline_s = self._clock.now() + SAMPLE_TIMEOUT_S
        while len(self._ticks) < len(self.channels) and self._clock.now() < deadline_s:
            self._poll()
            self._clock.wait_until(self._clock.now() + POLL_S)
        newest_by_channel = {self.channels[row]: tick for row, tick in self._ticks.items()}
        require_simultaneous(newest_by_channel, self._ticks_per_sample, self._wiring.device)

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample): the next samples."""
        self._start_counting()
        volts = self._wait_samples(samples, self._clock.now() + samples / self.rate_hz)
        self._assembly = None
        return volts

    def start(self) -> None:
        """Start acquisition: the next sample to arrive is sample 0."""
        if self._epoch_s is not None:
            raise RuntimeError("openDAQ: start() was called already; one start() a connection")
        self._start_counting()
        self._epoch_s = self._clock.now()
        self._clock_window = (self._epoch_s + CLOCK_WINDOW_S, np.inf)
        assert self._tick_clock is not None
        stamp = self._tick_clock.format_tick(self._first_tick)
        self.clock_description = f"openDAQ clock of {self._wiring.device}, sample 0 at {stamp}"

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""
        if self._assembly is None or self._epoch_s is None or not self._readers:
            raise RuntimeError("openDAQ: closed, or start() was not called")
        due_s = self.scheduled_time_s(max(self._assembly.first + samples - 1, 0))
        volts = self._wait_samples(samples, due_s)
        self._clock.wait_until(self.scheduled_time_s(max(self._assembly.first - 1, 0)))
        return volts

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` arrives.

        It follows the drift of the device's clock by the earliest arrivals of each window.
        """
        if self._epoch_s is None:
            raise RuntimeError("openDAQ: call start() first")
        return self._epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Disconnect from the device; safe to call twice."""
        self._readers = []
        if self._device is not None:
            device, self._device = self._device, None
            self._instance.remove_device(device)
        self._instance = None

    def _find_signal(self, channel: str, signals_by_id: dict[str, Any]) -> Any:
        """Return the signal of a channel; InputError if none or several match."""
        wanted = self._wiring.signals[channel].strip("/")
        matches = [
            signal for name, signal in signals_by_id.items() if f"/{name}".endswith(f"/{wanted}")
        ]
        if len(matches) == 1 and matches[0].domain_signal is not None:
            return matches[0]
        values = sorted(
            name for name, signal in signals_by_id.items() if signal.domain_signal is not None
        )
        reason = "the signal has no time stamps" if matches else "not a signal of the device"
        reason = "matches the end of several signals" if len(matches) > 1 else reason
        raise InputError(
            reason, key=f"opendaq.signals.{channel}", value=wanted, allowed=", ".join(values)
        )

    def _volts_per(self, row: int, signal: Any) -> float:
        """Return volts per unit of a signal: 1 if it is in V; InputError for another unit."""
        sensor = self._rig.sensors[row]
        unit = signal.descriptor.unit
        symbol = str(unit.symbol) if unit is not None else ""
        if symbol == "V":
            return 1.0
        if UNIT_SYNONYMS.get(symbol, symbol) == sensor.unit:
            return sensor.volts_per_unit
        raise InputError(
            f"signal {signal.global_id} is in {symbol or 'no unit'}",
            key=sensor.channel,
            allowed=f"V, or {sensor.unit} as for this sensor in the rig file",
            remedy="change the unit in the device, or the sensor in the rig file",
        )

    def _start_counting(self) -> None:
        """Count samples from 0, starting with the next one."""
        if not self._readers or self._newest_tick is None:
            raise RuntimeError("openDAQ: closed, or open() was not called")
        if self._epoch_s is not None:
            raise RuntimeError("openDAQ: start() was called already; tare before start()")
        self._assembly = None
        self._poll()
        self._first_tick = self._newest_tick + round(self._ticks_per_sample)
        self._drift_ticks = 0.0
        self._assembly = Assembly(len(self.channels), round(MAX_CLOCK_JUMP_S * self.rate_hz))

    def _wait_samples(self, samples: int, due_s: float) -> Float2D:
        """Wait for the next samples, (channel, sample); MachineLost if none arrive."""
        assembly = self._assembly
        assert assembly is not None
        last, last_received_s = assembly.first + samples, self._clock.now()
        while assembly.complete < last:
            if self._poll():
                last_received_s = self._clock.now()
            overdue_s = self._clock.now() - max(due_s, last_received_s)
            if overdue_s > SAMPLE_TIMEOUT_S and assembly.end < last:
                raise MachineLost(
                    f"the openDAQ device at {self._wiring.device} has sent nothing for "
                    f"{SAMPLE_TIMEOUT_S:g} s; this does not stop the table: stop it at its "
                    "controller, then check the device and its cable"
                )
            if self._clock.now() - due_s > SAMPLE_TIMEOUT_S and assembly.end >= last:
                assembly.give_up(last)  # a channel that has stopped is lost; the others continue
            self._clock.wait_until(self._clock.now() + POLL_S)
        return assembly.take(samples)

    def _poll(self) -> bool:
        """Assign arrived samples to their indices; return False if none arrived."""
        if all(reader.empty for reader in self._readers):
            return False
        received = False
        for row, reader in enumerate(self._readers):
            values, ticks = reader.read_with_domain(MAX_READ_SAMPLES)
            if not len(ticks):
                continue
            received, newest = True, int(ticks[-1])
            self._newest_tick = max(self._newest_tick or newest, newest)
            self._ticks[row] = newest
            if self._assembly is None:
                continue
            clock = self._first_tick, self._ticks_per_sample, self._drift_ticks
            try:
                index = sample_indices(ticks, *clock)
                self._assembly.put(row, index, values * self._gain[row])
            except ClockJumpError as error:
                raise MachineLost(
                    f"the clock of {self._wiring.device} jumped by "
                    f"{error.samples / self.rate_hz:.1f} s, as it was set while it ran; this does "
                    "not stop the table: stop it at its controller"
                ) from None
            except UnevenClockError as error:
                raise MachineLost(
                    f"the time stamps of {self._wiring.device} are uneven: {error}; this does not "
                    "stop the table: stop it at its controller"
                ) from None
            stamp_errors = (
                ticks - self._first_tick - self._drift_ticks - index * self._ticks_per_sample
            )
            self._drift_ticks += DRIFT_GAIN * float(stamp_errors.mean())
        if received:
            self._update_schedule()
        return received

    def _update_schedule(self) -> None:
        """Correct the schedule for clock drift: no sample arrives before it is taken."""
        if self._epoch_s is None or self._assembly is None:
            return
        now_s = self._clock.now()
        deadline_s, earliest_epoch_s = self._clock_window
        earliest_epoch_s = min(earliest_epoch_s, now_s - (self._assembly.end - 1) / self.rate_hz)
        if now_s > deadline_s:
            self._epoch_s = earliest_epoch_s
            deadline_s = now_s + CLOCK_WINDOW_S
            earliest_epoch_s = np.inf
        self._epoch_s = min(self._epoch_s, earliest_epoch_s)
        self._clock_window = (deadline_s, earliest_epoch_s)


NETWORK_SCHEMES = ("daq.nd://", "daq.opcua://")
SIMULATED_SCHEME = "daqref://"  # the library's own simulated devices


def discover_devices(addresses: tuple[str, ...] = ()) -> tuple[DiscoveredDevice, ...]:
    """Return the discovered devices and those at `addresses` that answer.

    The channels are the signals of native streaming. InputError if the library is not installed.
    """
    daq = load_library()
    builder = daq.InstanceBuilder()
    builder.global_log_level = daq.LogLevel.Off
    instance = builder.build()
    devices = []
    for info in instance.available_devices:
        address = str(info.connection_string)
        if not address.startswith((*NETWORK_SCHEMES, SIMULATED_SCHEME)):
            continue  # not a data acquisition device, but a sound card for example
        product = " ".join(filter(None, (str(info.manufacturer), str(info.model))))
        simulated = address.startswith(SIMULATED_SCHEME)
        serial, ports = str(info.serial_number), _input_ports(instance, address)
        devices.append(
            DiscoveredDevice("opendaq", address, "discovery", product, serial, simulated, ports)
        )
    for address in addresses:
        if address not in {device.name for device in devices} and (
            ports := _input_ports(instance, address)
        ):
            devices.append(DiscoveredDevice("opendaq", address, "rig file", ports=ports))
    return tuple(devices)


def _input_ports(instance: Any, address: str) -> tuple[ChannelGroup, ...]:
    """Return the signals of a device that have time stamps; empty if it cannot be opened."""
    try:
        device = instance.add_device(address)
    except RuntimeError:
        return ()
    try:
        signals = [
            signal for signal in device.signals_recursive if signal.domain_signal is not None
        ]
        names = tuple(str(signal.global_id) for signal in signals)
        ranges = {
            pair for signal in signals if (pair := _voltage_range(signal.descriptor)) is not None
        }
        return (ChannelGroup("AI", names, tuple(sorted(ranges))),) if names else ()
    except RuntimeError:
        return ()
    finally:
        instance.remove_device(device)


def _voltage_range(descriptor: Any) -> tuple[float, float] | None:
    """Return (low, high) of a signal in V; None if unknown or in another unit."""
    if descriptor is None or descriptor.unit is None or descriptor.value_range is None:
        return None
    if str(descriptor.unit.symbol) != "V":
        return None
    return float(descriptor.value_range.low_value), float(descriptor.value_range.high_value)
