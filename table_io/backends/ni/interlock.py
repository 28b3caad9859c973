"""The simulated table behind a DAQ device: its output drives it, its heartbeat line is watched.

It is told the time. The voltage is a command to the table's servo, also one that freezes in motion.
A heartbeat line that does not change for HEARTBEAT_S while an output drives means that the rig is
gone: what the device still plays is played, then the table is brought to its mean by a landing of
its own. An output that ends at the mean is the end of a run, and no alarm.
"""

from collections.abc import Callable

import numpy as np

from table_io.backends import HEARTBEAT_S
from table_io.backends.ni.task import Code, DriverError
from table_io.backends.simulated import SimulatedBackend
from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.machine.blackbox import BlackBox
from table_io.machine.life import REST_M, REST_S, Life
from table_io.machine.queued import landing
from table_io.profile import Specimen
from table_io.rig import Rig

NEVER = -(1 << 40)  # sample
NEAR_M = 1e-4  # so near its mean, with the command there, a table may start anew


class GuardedTable:
    """The table of a card that has a [simulated] table; `tell` shows a line to people."""

    def __init__(
        self, rig: Rig, specimen: Specimen, tell: Callable[[str], None], box: BlackBox | None = None
    ) -> None:
        self._rig, self._specimen, self._tell, self._box = rig, specimen, tell, box
        self._resting: dict[float, SimulatedBackend] = {}
        self._life: Life | None = None
        self._place_m, self._moved = 0.0, NEVER  # where the table is; the sample at which it came
        self._fed = np.zeros(1)  # the last that the device hands on
        self._now = self._heard_s = 0.0
        self._frozen = ""  # why the voltage stands still
        self._alarm = ""
        self._rest_from: int | None = None  # from here on the command is at its mean for good

    @property
    def moving(self) -> bool:
        """True from a start until rest."""
        return self._life is not None and self._life.started

    def prepare(self) -> None:
        """Compile what a run needs."""
        for rate in self._rig.rates_hz:
            self.resting(rate, 1)

    def log(self, box: BlackBox | None) -> None:
        """From the next start on, write here."""
        self._box = box

    def resting(self, rate_hz: float, samples: int) -> Float2D:
        """Volts of the inputs at rest, (channel, sample)."""
        if rate_hz not in self._resting:
            plant = SimulatedBackend(self._rig, self._specimen, rate_hz, ManualClock())
            plant.open()
            self._resting[rate_hz] = plant
        return self._resting[rate_hz].tare(samples)

    def arm(self, rate_hz: float) -> None:
        """Be ready to start at this rate; DriverError where it still moves."""
        self.play(self._now)  # it may be over
        over = self._rest_from is not None and abs(self._place_m) <= NEAR_M
        if self._life is not None and over and self._life.taken >= (self._rest_from or 0):
            self._leave(self._life, self._now)
        if self.moving:
            raise DriverError(Code.RESERVED)
        self._life = Life(self._rig, self._specimen, rate_hz, self._box)
        plant = self._life.plant
        plant.replace_after = 1  # what cannot be replaced any more lies in the device before it
        note, self._place_m, self._moved = plant.witness, 0.0, NEVER

        def witness(first: int, command_m: Float1D, signals: Float2D) -> None:
            if note is not None:
                note(first, command_m, signals)
            if np.abs(signals[0] - self._place_m).max() > REST_M:
                self._place_m, self._moved = float(signals[0, -1]), first + command_m.size

        plant.witness = witness
        self._frozen = self._alarm = ""
        self._rest_from = None

    def feed(self, index: int, volts: Float1D) -> None:
        """The output plays these from sample `index` on, and then holds the last."""
        if self._life is not None:
            self._fed = volts[-1:]
            held = np.append(volts, self._fed)  # twice: for a table, that is no motion to end
            self._life.queue(index, held, self._now)

    def start(self, now: float) -> None:
        """Output sample 0 is now."""
        if self._life is not None:
            self._life.start(now)
            self._now = self._heard_s = now
            self._tell("the output drives the table")

    def freeze(self, why: str) -> None:
        """The output holds its voltage from now on; no task drives it."""
        self._frozen = self._frozen or why
        if self._life is not None:
            self._life.note(why)

    def beat(self, now: float) -> None:
        """The heartbeat line has changed."""
        self._heard_s = now

    def play(self, now: float) -> list[Float2D]:
        """Move up to now; the volts of the inputs that have come, (channel, sample)."""
        self._now, life = now, self._life
        if life is None or not life.started:
            return []
        life.play(now)
        width = len(self._rig.channels)
        come = [np.asarray(one.values).reshape(-1, width).T for one in life.handed_over(now)]
        if (
            not self._alarm
            and now - self._heard_s > HEARTBEAT_S
            and not (self._frozen and self._at_mean)
        ):
            self._alarm = f"no heartbeat for {HEARTBEAT_S:g} s at sample {life.taken}"
            life.note(self._alarm)
            self._tell(f"{self._alarm}; what the device holds plays on, then the table is landed")
        if self._frozen and self._rest_from is None and (self._alarm or self._at_mean):
            self._rest_from = NEVER if self._at_mean else self._land(life)
        if self._rest_from is not None:
            still = life.taken - max(self._rest_from, self._moved)
            if still >= REST_S * life.plant.rate_hz:
                self._leave(life, now)
        return come

    @property
    def _at_mean(self) -> bool:
        """True where the output plays no more than its mean."""
        return abs(float(self._fed[-1])) <= 0.5 * self._rig.output.lsb_m * self._volts_per_m

    @property
    def _volts_per_m(self) -> float:
        return self._rig.output.volts_per_m

    def _land(self, life: Life) -> int:
        """Bring the command to its mean; the sample from which on it rests there."""
        held_m = np.repeat(self._fed / self._volts_per_m, 3)
        path = landing(held_m, life.plant.rate_hz) * self._volts_per_m
        life.queue(life.taken, path, self._now)
        life.note("landed by the machine's interlock")
        return life.taken + path.size

    def _leave(self, life: Life, now: float) -> None:
        why = "; ".join(one for one in (self._alarm, self._frozen) if one)
        life.end(why, now)
        life.note("at rest")
        self._tell(f"at rest; {why}")
        life.plant.close()
        self._life = None
