"""The contract of every backend, in words and as a Protocol.

A backend owns one machine: an analogue output (the displacement command) and analogue inputs (the
sensors), on one sample clock. It speaks volts and sample indices; it knows nothing of sweeps.

One object is one life of the machine: these calls in this order, all from one thread. A call out of
order is RuntimeError.
1. `open()` claims the machine, and waits where it still comes to rest after its last life. Nothing
   moves. Errors are BadInput: what is missing (also a sample rate), what to do.
2. `tare(samples)` returns the inputs at rest, before bumpers are precompressed, as often as asked.
3. `queue(0, volts)` hands over the first command.
4. `start()` starts output and input together, now: output sample i leaves when input sample i is
   taken, at `scheduled(i)` = scheduled(0) + i / rate_hz of the session's clock. The command is
   acquired back as `drive_disp_m`: what was queued, to a step of the output and of the input.
5. `read(samples)` waits until the next samples are taken and returns them in order, each once, from
   sample 0 on, however reads are cut. A sample that was lost is NaN in every lost channel: it keeps
   its place, none is ever invented. MachineLost where they have not come PATIENCE_S after the
   schedule of the last of them: what is queued plays on, and it ends at rest.
6. `queue(index, volts)` at any time replaces everything queued from `index` on, exactly there.
   After the last queued sample the output holds its value, also up to an `index` that lies beyond
   it. The session always queues a command that ends at rest, so whatever dies, a table in motion
   comes to rest smoothly; a machine that can brings one that ends in motion to its mean by itself.
   `index` must lie at least `replace_after` samples after the newest one that the machine has taken
   by now, read or not: what comes earlier is in the device and plays as it was queued. ValueError
   otherwise, as for NaN and inf, and nothing is changed.
7. `close()` releases the machine, which plays what is queued; safe at any time, twice, after any
   error.

A machine that watches its rig takes a silence of HEARTBEAT_S between start and close for its death,
and goes on without it, to rest. Every call is a sign of life; one that waits gives more while it
waits. The next call of a rig that was only slow is MachineLost.

`tests/table_io/conformance.py` holds every backend to this, clause by clause.
"""

from typing import Protocol

from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.profile import Profile
from table_io.rig import Rig

PATIENCE_S = 0.5  # after its schedule a sample that has not come is not coming
HEARTBEAT_S = 0.3  # without a word from its rig a machine that watches goes on alone


class MachineLost(RuntimeError):
    """The machine does not answer; what is queued in it plays to rest."""


class Backend(Protocol):
    """What the session needs of a machine; see the module for who calls what, when."""

    channels: tuple[str, ...]
    rate_hz: float
    replace_after: int

    def open(self) -> None:
        """Claim the machine; nothing moves."""

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample)."""

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, (sample,); the last value is held."""

    def start(self) -> None:
        """Start output and input at sample 0."""

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` is taken, in s."""

    def close(self) -> None:
        """Release the machine."""


class Source(Protocol):
    """A backend that only acquires: clauses 1, 2, 4 and 5 without output, and 7.

    Sample 0 is the next that comes after start(). Who moves the table is somebody else, and lost
    samples, or a lost device, do not stop it: so the words of its MachineLost say.
    """

    channels: tuple[str, ...]
    rate_hz: float
    clock_says: str  # once started: whose clock took sample 0, and when by that clock

    def open(self) -> None:
        """Connect; nothing of the device is changed."""

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample)."""

    def start(self) -> None:
        """Sample 0 is the next."""

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` comes, in s."""

    def close(self) -> None:
        """Let the device go."""


def open_source(rig: Rig, rate_hz: float, clock: Clock) -> Source:
    """What acquires where a card only follows; another kind of input = one more case here."""
    match rig.follow.source if rig.follow is not None else rig.backend:
        case "opendaq":
            from table_io.backends.opendaq import OpenDaqSource

            return OpenDaqSource(rig, rate_hz, clock)
        case _:
            raise BadInput(f"rig {rig.name}: backend {rig.backend!r} does not only acquire")


def open_backend(rig: Rig, profile: Profile, clock: Clock) -> Backend:
    """The backend that the machine card names. Adding a backend = one folder and one case here."""
    asked = (rig, profile.specimen, profile.acquisition.rate_hz, clock)
    match rig.backend:
        case "simulated":
            from table_io.backends.simulated import SimulatedBackend

            return SimulatedBackend(*asked)
        case "machine":
            from table_io.backends.machine import MachineBackend

            return MachineBackend(*asked)
        case "ni":
            from table_io.backends.ni import NiBackend

            return NiBackend(*asked)
        case "udp":
            from table_io.backends.udp import UdpBackend

            return UdpBackend(*asked)
        case "opendaq" | "follow":
            raise BadInput(
                f"rig {rig.name}: backend {rig.backend!r} only acquires, so it moves nothing; a "
                "controller that plays our drive is followed by backend = 'follow'"
            )


def answers(rig: Rig) -> None:
    """BadInput where the card names a machine of its own and none answers; claims nothing."""
    match rig.backend:
        case "machine":
            from table_io.backends import machine

            machine.answers(rig)
        case "opendaq" | "follow":
            from table_io.backends import opendaq

            opendaq.answers(rig)
        case "udp":
            from table_io.backends import udp

            udp.answers(rig)
        case "ni":
            from table_io.backends import ni

            ni.answers(rig)
