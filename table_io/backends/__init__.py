"""The contract of every backend, in words and as a Protocol.

A backend owns one machine: an analogue output (the displacement command) and analogue inputs (the
sensors), on one sample clock. It speaks volts and sample indices; it knows nothing of sweeps.

Life, in this order, all calls from one thread:
1. `open()` claims the machine. Nothing moves. Errors are BadInput: what is missing,
   what to do.
2. `tare(samples)` returns the inputs at rest, before bumpers are precompressed.
3. `queue(0, volts)` hands over the first command.
4. `start()` starts output and input together: output sample i leaves when input sample i is taken.
5. `read(samples)` waits until the next samples are taken and returns them in order. A sample that
   was lost is NaN in every lost channel: it keeps its place, none is ever invented.
6. `queue(index, volts)` at any time replaces everything queued from `index` on. After the last
   queued sample the output holds its value. The session always queues a command that ends at rest,
   so whatever dies, a table in motion comes to rest smoothly.
   `index` must lie at least `replace_after` samples after the newest acquired one: what comes
   earlier is in the device and plays as it was queued. ValueError otherwise.
7. `close()` releases the machine; safe to call twice and after any error.
"""

from typing import Protocol

from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.profile import Profile
from table_io.rig import Rig


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


def open_backend(rig: Rig, profile: Profile, clock: Clock) -> Backend:
    """The backend that the machine card names. Adding a backend = one file and one line here."""
    from table_io.backends.simulated import SimulatedBackend

    kinds = {"simulated": SimulatedBackend}
    return kinds[rig.backend](rig, profile.specimen, profile.acquisition.rate_hz, clock)
