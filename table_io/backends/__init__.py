"""Backend contract: the call sequence and the guarantees of every machine driver.

A backend drives one machine: one analog output (the displacement command) and analog inputs (the
sensors) on one sample clock. It works in volts and sample indices and knows nothing of the sweep.

Terms. *Taken*: sampled by the machine, whether or not `read` has returned it yet. *Queued*: handed
over by `queue` and not yet played. *Connection*: everything between `open` and `close`.

A backend object serves one connection. All calls come from one thread, in the order below, with 5
and 6 repeated in any order; a call out of order raises RuntimeError.

1. `open()` claims the machine for this client. It waits while the machine is still coming to rest
   from the previous connection, and moves nothing. Everything that the user must correct,
   including an unsupported sample rate, raises InputError with the remedy.
2. `tare(samples)` returns input samples at rest, the specimen being as it is set up: bumpers that
   press on the mass do so (a simulation may answer as if they were clear, and then its section has
   `tares_without_bumpers`). It may be called any number of times.
3. `queue(0, volts)` hands over the first command.
4. `start()` starts output and inputs together, at once. Output sample i leaves when input sample i
   is taken, at scheduled_time_s(i) = scheduled_time_s(0) + i / rate_hz on the session's clock. The
   output is also acquired as channel `drive_disp_m`: it equals the queued command to within one
   quantization step of the output plus one of the input.
5. `read(samples)` blocks until the next samples have been taken, and returns them in order from
   sample 0 on, each exactly once, however the reads are split. A lost sample is NaN in each channel
   that lost it; it keeps its place and is never interpolated. If samples are still missing
   SAMPLE_TIMEOUT_S after the scheduled time of the last one, `read` raises MachineLost; the queued
   command plays on and the machine ends at rest.
6. `queue(index, volts)` may be called at any time. It replaces everything queued from sample
   `index` on, exactly from there. After the last queued sample the output holds its value, also up
   to an `index` beyond that sample. `index` must be at least `replace_after` samples after the
   newest sample taken: earlier output is already in the device and plays as it was queued. An
   earlier `index`, NaN or inf raises ValueError and changes nothing. The session always queues a
   command that ends at rest, so that a moving table stops smoothly whichever process fails; a
   machine that is able to do so also brings a command that ends in motion to its mean.
7. `close()` releases the machine, which plays what is queued. It may be called at any time, twice,
   and after any error.

Watchdog. A machine that monitors its rig (the process that holds this object) assumes that the
rig has died if no sign of life arrives for HEARTBEAT_TIMEOUT_S between start and close. It then
continues alone, to rest. Every call is a sign of life, and a call that waits sends more while it
waits. If the rig was only slow, its next call raises MachineLost.

Back in time. A table that is simulated in this process may have `take_back()`: what it returns
restores the present sample, with the command that is queued then. An unpaced session acquires many
blocks at once there, and goes back if one of them needs an answer.

`tests/table_io/backends/conformance.py` tests every backend against each clause.

A module makes a backend known by a `BackendDescriptor`, registered under the backend's name in the
entry-point group `shaketwin.backends`. What differs between backends is stated there; nothing else
asks which backend a rig has.

Digital inputs of a rig: the heartbeat wired back, limit switches, interlock.

Only the wiring check reads them, next to the backend; no run depends on them.

Result of device discovery, in the same form for every vendor.

A `DeviceSearch` returns a tuple of `DiscoveredDevice`. It raises InputError if it cannot search: a
library is not installed (the message has the pip line) or a server does not answer.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.profile import Profile, Specimen
from table_io.config.rig import BackendConfig, RigConfig, require_backend
from table_io.errors import InputError


class DigitalInputs(Protocol):
    """Digital inputs, open until `close`."""

    def read_levels(self) -> dict[str, bool]:
        """Return the present level of each input, by name."""

    def close(self) -> None:
        """Release the inputs."""


@dataclass(frozen=True, slots=True)
class ChannelGroup:
    """Channels of one kind on a device, with ranges in V and the highest sample rate in Hz."""

    kind: Literal["AI", "AO", "DI", "DO"]
    names: tuple[str, ...]  # as written in the rig file
    ranges_v: tuple[tuple[float, float], ...] = ()  # (low, high) in V; empty: unknown
    most_hz: float | None = None  # highest sample rate of one channel


@dataclass(frozen=True, slots=True)
class DiscoveredDevice:
    """One device that answered, and its channels."""

    kind: str  # name of its backend
    name: str  # as written in the rig file: Dev1, daq.nd://...
    where: str  # address of its server, or "local driver"
    product: str = ""
    serial: str = ""
    simulated: bool = False
    ports: tuple[ChannelGroup, ...] = ()


DeviceSearch = Callable[[], tuple[DiscoveredDevice, ...]]

SAMPLE_TIMEOUT_S = 0.5  # after its scheduled time a missing sample counts as lost
HEARTBEAT_TIMEOUT_S = 0.3  # silence after which the machine's watchdog assumes a dead rig


class MachineLost(RuntimeError):
    """Loss of the connection to the machine; the command queued in it plays to rest."""


class Backend(Protocol):
    """Output and inputs of one machine; the module docstring is the contract."""

    channels: tuple[str, ...]
    rate_hz: float
    replace_after: int  # samples after the newest taken one that can no longer be replaced

    def open(self) -> None:
        """Claim the machine; nothing moves (clause 1)."""

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample) (clause 2)."""

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, volts (sample,) (clauses 3 and 6)."""

    def start(self) -> None:
        """Start output and inputs at sample 0 (clause 4)."""

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample) (clause 5)."""

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` is taken."""

    def close(self) -> None:
        """Release the machine, which plays what is queued (clause 7)."""


class AcquisitionSource(Protocol):
    """A backend without output, for a table under an external controller.

    Clauses 1, 2, 4, 5 and 7 apply, without their parts on output. Sample 0 is the first sample that
    arrives after `start`. Losing samples or the device does not stop the table, and the message of
    MachineLost must state this.
    """

    channels: tuple[str, ...]
    rate_hz: float
    clock_description: str  # after start: clock of the device, and its time at sample 0

    def open(self) -> None:
        """Connect to the device without changing its settings."""

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample)."""

    def start(self) -> None:
        """Start acquisition: the next sample to arrive is sample 0."""

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` arrives."""

    def close(self) -> None:
        """Disconnect from the device."""


@dataclass(frozen=True, kw_only=True)
class BackendDescriptor:
    """Everything that the program knows of a backend; give `open` or `open_source`.

    Its module must import no vendor library: the functions import what they need when called.
    """

    config: type[BackendConfig]  # of the section of the rig file that has the backend's name
    open: Callable[[RigConfig, Specimen, float, Clock], Backend] | None = None  # rate in Hz
    open_source: Callable[[RigConfig, float, Clock], AcquisitionSource] | None = None  # rate in Hz
    any_speed: bool = False  # any clock may pace it: simulated in the process of the rig
    is_simulated: bool = False  # moves no real table
    external_control: bool = False  # `run` records the table while another controller drives it
    check_reachable: Callable[[RigConfig], None] | None = None  # InputError if nothing answers
    open_digital_inputs: Callable[[RigConfig], DigitalInputs | None] | None = None  # with heartbeat
    # Searches for devices by a label, at least at these addresses of rig files.
    list_searches: Callable[[Collection[str]], Mapping[str, DeviceSearch]] | None = None

    @property
    def drives(self) -> bool:
        """True if the backend has a command output; False if it only acquires."""
        return self.open is not None


def find_descriptor(rig: RigConfig) -> BackendDescriptor:
    """Return the descriptor of the rig's backend; InputError if it is not installed."""
    return get_descriptor(rig.backend, f"rig {rig.name}")


def get_descriptor(name: str, where: object, key: str = "backend") -> BackendDescriptor:
    """Return the descriptor of the backend `name`; InputError if it is not installed."""
    descriptor = require_backend(name, where, key)
    if not isinstance(descriptor, BackendDescriptor) or not (
        descriptor.drives or descriptor.open_source
    ):
        raise InputError(
            "neither drives nor acquires",
            where=where,
            key=key,
            value=name,
            allowed="a BackendDescriptor with open or open_source",
            remedy="fix or remove the package",
        )
    return descriptor


def open_source(rig: RigConfig, rate_hz: float, clock: Clock) -> AcquisitionSource:
    """Return the acquisition source of a rig without output."""
    descriptor = find_descriptor(rig)
    if descriptor.open_source is None:
        raise InputError(
            "this backend drives the table itself and is not an acquisition source",
            where=f"rig {rig.name}",
            key="backend",
            value=rig.backend,
            allowed="a backend that only acquires",
        )
    return descriptor.open_source(rig, rate_hz, clock)


def open_backend(rig: RigConfig, profile: Profile, clock: Clock) -> Backend:
    """Return the backend that the rig file selects."""
    descriptor = find_descriptor(rig)
    if descriptor.open is None:
        raise InputError(
            "this backend only acquires and cannot drive the table",
            where=f"rig {rig.name}",
            key="backend",
            value=rig.backend,
            remedy="use backend = 'follow' for a controller that plays the drive file itself",
        )
    return descriptor.open(rig, profile.specimen, profile.acquisition.rate_hz, clock)


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the machine of the rig file does not answer; claim nothing."""
    check = find_descriptor(rig).check_reachable
    if check is not None:
        check(rig)
