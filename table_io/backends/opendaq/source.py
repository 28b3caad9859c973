"""Acquisition from an openDAQ device: the Source half of the contract.

The samples stay as they come: a signal in V is handed on, one in the card's unit for its channel
becomes the volts that the card's sensor would give. Time stamps put every sample in its place, so
what the device or the network lost is NaN there. A read with no thread of ours polls.
"""

from typing import Any

import numpy as np

from table_io.backends import PATIENCE_S, MachineLost
from table_io.backends.opendaq.assembly import Assembly, JumpError, UnevenError, places
from table_io.backends.opendaq.stamps import Ticking, one_clock, together
from table_io.block import Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.rig import Rig
from table_io.wiring.opendaq import OpenDaqWiring

POLL_S = 0.001
FIRST_S = 3.0  # in which the first sample must have come
MOST = 1 << 16  # samples that one look takes of a channel
FAR_S = 5.0  # that stamps run ahead: their clock was set
FOLLOWS = 0.1  # of what a look shows of a clock that is disciplined against its own rate
STEADY_S = 10.0  # over which the device's clock is held against ours
SAME = {"m/s²": "m/s2", "m/s^2": "m/s2", "g_n": "g", "gn": "g", "µm": "um", "μm": "um"}


def needed(rig: Rig) -> OpenDaqWiring:
    """The card's wiring; BadInput where it is missing, incomplete, or the library is."""
    wiring = rig.opendaq
    if wiring is None:
        raise BadInput(f"rig {rig.name}: no [opendaq] table; say what is wired where")
    missing = [name for name in rig.channels if name not in wiring.signals]
    if missing:
        raise BadInput(
            f"rig {rig.name}: opendaq.signals lacks {', '.join(missing)}; name a signal of the "
            "device for each sensor of the card, or take the sensor out"
        )
    library()
    return wiring


def library() -> Any:
    """The vendor's module; BadInput where it is not installed."""
    try:
        import opendaq
    except ImportError as error:
        raise BadInput(
            f"openDAQ is not installed ({error}); pip install shaketwin[opendaq]"
        ) from None
    return opendaq


class OpenDaqSource:
    """The inputs of one openDAQ device; who moves the table is somebody else."""

    def __init__(self, rig: Rig, rate_hz: float, clock: Clock) -> None:
        self._wiring = needed(rig)
        self._daq = library()
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.clock_says = ""  # whose clock took sample 0, and when; known after start
        self._rig = rig
        self._clock = clock
        self._instance: Any = None
        self._device: Any = None
        self._readers: list[Any] = []
        self._gain = np.ones(len(rig.sensors))
        self._ticks_per_sample = 1.0
        self._ticking: Ticking | None = None
        self._newest_tick: int | None = None
        self._first_tick = 0
        self._drifted = 0.0  # ticks by which the stamps ran ahead since then
        self._ticks: dict[int, int] = {}  # newest of each channel
        self._assembly: Assembly | None = None
        self._epoch: float | None = None
        self._steady = (0.0, 0.0)  # until when the clocks are compared, earliest epoch seen

    def open(self) -> None:
        """Connect, find the signals, check units and rate; nothing of the device is changed."""
        self._rig.refuse_rate(self.rate_hz)
        builder = self._daq.InstanceBuilder()
        builder.global_log_level = self._daq.LogLevel.Off
        self._instance = builder.build()
        try:
            self._device = self._instance.add_device(self._wiring.device)
        except RuntimeError as error:
            raise BadInput(
                f"opendaq.device = {self._wiring.device}: {str(error).splitlines()[0]}; is it "
                "switched on, and reached from here?"
            ) from None
        found = {str(one.global_id): one for one in self._device.signals_recursive}
        signals = [self._signal(name, found) for name in self.channels]
        for row, signal in enumerate(signals):
            self._gain[row] = self._volts_per(row, signal)
        self._ticking = one_clock(self._daq, signals, self.rate_hz, self._wiring.device)
        self._ticks_per_sample = self._ticking.per_sample
        float64, int64 = self._daq.SampleType.Float64, self._daq.SampleType.Int64
        self._readers = [
            self._daq.StreamReader(one, value_type=float64, domain_type=int64) for one in signals
        ]
        until = self._clock.now() + FIRST_S
        while self._newest_tick is None:
            self._look()
            if self._clock.now() > until:
                raise BadInput(
                    f"{self._wiring.device} has sent no sample for {FIRST_S:g} s; start its "
                    "acquisition"
                )
            self._clock.wait_until(self._clock.now() + POLL_S)
        until = self._clock.now() + PATIENCE_S
        while len(self._ticks) < len(self.channels) and self._clock.now() < until:
            self._look()
            self._clock.wait_until(self._clock.now() + POLL_S)
        at = {self.channels[row]: tick for row, tick in self._ticks.items()}
        together(at, self._ticks_per_sample, self._wiring.device)

    def tare(self, samples: int) -> Float2D:
        """Volts at rest, (channel, sample): the next samples."""
        self._begin()
        volts = self._await(samples, self._clock.now() + samples / self.rate_hz)
        self._assembly = None
        return volts

    def start(self) -> None:
        """Sample 0 is the next that comes."""
        if self._epoch is not None:
            raise RuntimeError("openDAQ: it runs already; one start() a life")
        self._begin()
        self._epoch = self._clock.now()
        self._steady = (self._epoch + STEADY_S, np.inf)
        assert self._ticking is not None
        stamp = self._ticking.said(self._first_tick)
        self.clock_says = f"openDAQ clock of {self._wiring.device}, sample 0 at {stamp}"

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have come."""
        if self._assembly is None or self._epoch is None or not self._readers:
            raise RuntimeError("openDAQ: it is closed, or start() was not called")
        due = self.scheduled(max(self._assembly.first + samples - 1, 0))
        volts = self._await(samples, due)
        self._clock.wait_until(self.scheduled(max(self._assembly.first - 1, 0)))
        return volts

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` comes, in s.

        The device's clock is not ours: its earliest samples of the last seconds keep this right.
        """
        if self._epoch is None:
            raise RuntimeError("openDAQ: start() comes first")
        return self._epoch + index / self.rate_hz

    def close(self) -> None:
        """Let the device go; safe to call twice."""
        self._readers = []
        if self._device is not None:
            device, self._device = self._device, None
            self._instance.remove_device(device)
        self._instance = None

    def _signal(self, channel: str, found: dict[str, Any]) -> Any:
        """The signal that is wired to a channel."""
        wanted = self._wiring.signals[channel].strip("/")
        there = [one for name, one in found.items() if f"/{name}".endswith(f"/{wanted}")]
        if len(there) == 1 and there[0].domain_signal is not None:
            return there[0]
        values = sorted(name for name, one in found.items() if one.domain_signal is not None)
        why = "has no time stamps" if there else "is no signal of the device"
        why = "is the end of several signals" if len(there) > 1 else why
        raise BadInput(
            f"opendaq.signals.{channel} = {wanted!r} {why}; there are: {', '.join(values)}"
        )

    def _volts_per(self, row: int, signal: Any) -> float:
        """Volts per unit of a signal: 1 where it is in V."""
        sensor = self._rig.sensors[row]
        unit = signal.descriptor.unit
        symbol = str(unit.symbol) if unit is not None else ""
        if symbol == "V":
            return 1.0
        if SAME.get(symbol, symbol) == sensor.unit:
            return sensor.volts_per_unit
        raise BadInput(
            f"signal {signal.global_id} of {sensor.channel} is in {symbol or 'no unit'}; allowed: "
            f"V, or {sensor.unit} as the sensor in the card. Set it in the device, or mend the card"
        )

    def _begin(self) -> None:
        """What comes from now on counts from sample 0."""
        if not self._readers or self._newest_tick is None:
            raise RuntimeError("openDAQ: it is closed, or open() was not called")
        if self._epoch is not None:
            raise RuntimeError("openDAQ: it runs; tare() comes before start()")
        self._assembly = None
        self._look()
        self._first_tick = self._newest_tick + round(self._ticks_per_sample)
        self._drifted = 0.0
        self._assembly = Assembly(len(self.channels), round(FAR_S * self.rate_hz))

    def _await(self, samples: int, due: float) -> Float2D:
        """The next samples, when they have come."""
        assembly = self._assembly
        assert assembly is not None
        last, heard = assembly.first + samples, self._clock.now()
        while assembly.complete < last:
            if self._look():
                heard = self._clock.now()
            late = self._clock.now() - max(due, heard)
            if late > PATIENCE_S and assembly.end < last:
                raise MachineLost(
                    f"the openDAQ device at {self._wiring.device} has sent nothing for "
                    f"{PATIENCE_S:g} s; who plays is not stopped by this: stop it at its "
                    "controller, then look after the device and its cable"
                )
            if self._clock.now() - due > PATIENCE_S and assembly.end >= last:
                assembly.give_up(last)  # a channel that has stopped is lost; the others go on
            self._clock.wait_until(self._clock.now() + POLL_S)
        return assembly.take(samples)

    def _look(self) -> bool:
        """Put what has come in its place; False where nothing did."""
        if all(reader.empty for reader in self._readers):
            return False
        came = False
        for row, reader in enumerate(self._readers):
            values, ticks = reader.read_with_domain(MOST)
            if not len(ticks):
                continue
            came, newest = True, int(ticks[-1])
            self._newest_tick = max(self._newest_tick or newest, newest)
            self._ticks[row] = newest
            if self._assembly is None:
                continue
            clock = self._first_tick, self._ticks_per_sample, self._drifted
            try:
                index = places(ticks, *clock)
                self._assembly.put(row, index, values * self._gain[row])
            except JumpError as error:
                raise MachineLost(
                    f"the clock of {self._wiring.device} jumped by "
                    f"{error.samples / self.rate_hz:.1f} s: it was set while it ran; who plays is "
                    "not stopped by this: stop it at its controller"
                ) from None
            except UnevenError as error:
                raise MachineLost(
                    f"the clock of {self._wiring.device} is not even any more: {error}; who plays "
                    "is not stopped by this: stop it at its controller"
                ) from None
            beside = ticks - self._first_tick - self._drifted - index * self._ticks_per_sample
            self._drifted += FOLLOWS * float(beside.mean())
        if came:
            self._keep_time()
        return came

    def _keep_time(self) -> None:
        """Move the schedule with the device's clock: no sample comes before it was taken."""
        if self._epoch is None or self._assembly is None:
            return
        now = self._clock.now()
        until, earliest = self._steady
        earliest = min(earliest, now - (self._assembly.end - 1) / self.rate_hz)
        if now > until:
            self._epoch, until, earliest = earliest, now + STEADY_S, np.inf
        self._epoch = min(self._epoch, earliest)
        self._steady = (until, earliest)
