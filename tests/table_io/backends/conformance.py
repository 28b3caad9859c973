"""What every backend must do, clause by clause, after the words in table_io/backends/__init__.py.

A clause is a function of a Bench; a new backend is held to all of them by one more Bench. What
only acquires, a Source, is held to those of ACQUIRING. A clause fails by AssertionError and speaks
the contract's language.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from table_io.backends import Backend
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.base import parse_toml
from table_io.config.calibration import compute_tare, volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from tests.builders.drives import make_bump, make_rise
from tests.builders.rigs import read_rig_text

RATE_HZ = 2000.0
MOTION_SAMPLES = 240  # samples of a motion; short, for some machines play it in real time
LOST = range(700, 710)  # samples that a bench's machine loses, in all channels
HANDOVER_SAMPLES = 200  # samples that a person at a slow computer needs to hand something over
AWAY_S = 0.1  # a rig that is late, but not dead
LOSS = f"""
[[simulated.faults]]
kind = "dropped"
at_s = {LOST[0] / RATE_HZ}
for_s = {len(LOST) / RATE_HZ}
"""


def read_lossy_rig(name: str) -> tuple[RigConfig, str]:
    """Return a shipped rig whose machine loses LOST, and its text."""
    text = read_rig_text(name) + LOSS
    return parse_toml(text, RigConfig, name), text


@dataclass(frozen=True)
class Bench:
    """A backend under test: `make(rate_hz)` makes an unopened one whose machine loses LOST.

    `repeatable`: two lives on it see the same samples to the bit. Of what only acquires `play` has
    the controller play these volts: it starts the Source, and the next sample that is read is the
    first of them.
    """

    rig: RigConfig
    clock: Clock
    make: Callable[[float], Backend]
    repeatable: bool = False
    play: Callable[[Any, Float1D], None] | None = None

    def begin(self, backend: Backend, volts: Float1D) -> None:
        """Have it play `volts` from its next sample on."""
        if self.play is not None:
            self.play(backend, volts)
            return
        backend.queue(0, volts)
        backend.start()

    def open(self) -> Backend:
        """An open one."""
        backend = self.make(RATE_HZ)
        backend.open()
        return backend

    def start_playing(self, volts: Float1D) -> Backend:
        """One that plays `volts` from sample 0."""
        backend = self.open()
        self.begin(backend, volts)
        return backend

    def newest(self, backend: Backend) -> int:
        """The newest sample that the machine has taken by now, as near as a caller knows."""
        return int((self.clock.now() - backend.scheduled_time_s(0)) * RATE_HZ)

    def read_back_command(self, samples: Float2D) -> Float1D:
        """The command in V, (sample,), as it was acquired back."""
        drive = self.rig.sensors[self.rig.channels.index("drive_disp_m")]
        metres: Float1D = volts_to_si(samples, self.rig.sensors, {})[
            self.rig.channels.index(drive.channel)
        ]
        return metres * self.rig.output.volts_per_m

    def check_played(self, samples: Float2D, volts: Float1D, why: str) -> None:
        """The read-back is the command, to half an LSB of the output and of the input."""
        drive = self.rig.sensors[self.rig.channels.index("drive_disp_m")]
        output = self.rig.output
        lsb = output.lsb_m + 2 * drive.range_si / 2**drive.bits
        error = np.abs(self.read_back_command(samples) - volts).max() / output.volts_per_m
        assert error <= 0.501 * lsb, f"{why}: {error / output.lsb_m:.1f} LSB off"


Clause = Callable[[Bench], None]
CLAUSES: dict[str, Clause] = {}
ACQUIRING: dict[str, Clause] = {}  # those that hold without output too


def clause(check: Clause) -> Clause:
    """A clause of the contract."""
    CLAUSES[check.__name__] = check
    return check


def acquisition_clause(check: Clause) -> Clause:
    """A clause that what only acquires keeps as well."""
    ACQUIRING[check.__name__] = check
    return clause(check)


E = TypeVar("E", bound=BaseException)


def require_error(error: type[E], call: Callable[[], object], why: str) -> E:
    """The error that a call must raise."""
    try:
        call()
    except error as raised:
        return raised
    raise AssertionError(f"{why}: no {error.__name__}")


@acquisition_clause
def it_says_what_it_is(bench: Bench) -> None:
    backend = bench.make(RATE_HZ)
    assert backend.channels == bench.rig.channels
    assert backend.rate_hz == RATE_HZ
    if bench.play is not None:
        return
    assert isinstance(backend.replace_after, int)
    assert backend.replace_after > 0


@acquisition_clause
def open_refuses_a_rate_that_the_machine_has_not(bench: Bench) -> None:
    backend = bench.make(1234.5)
    error = require_error(InputError, backend.open, "a rate that the machine does not sample at")
    assert "1234.5" in str(error), "the error names the rate"
    backend.close()


@acquisition_clause
def calls_out_of_order_are_refused(bench: Bench) -> None:
    backend = bench.make(RATE_HZ)
    zero = np.zeros(2)
    for name, call in (
        ("tare", lambda: backend.tare(1)),
        ("queue", lambda: backend.queue(0, zero)),
        ("start", backend.start),
        ("read", lambda: backend.read(1)),
    ):
        if name == "queue" and bench.play is not None:
            continue
        require_error(RuntimeError, call, f"{name} before open")
    backend.open()
    require_error(RuntimeError, lambda: backend.read(1), "read before start")
    require_error(RuntimeError, lambda: backend.scheduled_time_s(0), "scheduled before start")
    bench.begin(backend, zero)
    require_error(RuntimeError, backend.start, "a second start")
    backend.close()
    require_error(RuntimeError, lambda: backend.read(1), "read after close")
    if bench.play is None:
        require_error(
            RuntimeError, lambda: backend.queue(HANDOVER_SAMPLES, zero), "queue after close"
        )


@acquisition_clause
def tare_is_the_inputs_at_rest_and_moves_nothing(bench: Bench) -> None:
    backend = bench.open()
    volts = np.concatenate([backend.tare(400), backend.tare(1), backend.tare(399)], axis=1)
    assert volts.shape == (len(backend.channels), 800)
    assert np.isfinite(volts).all()
    for sensor, line in zip(
        bench.rig.sensors, volts_to_si(volts, bench.rig.sensors, {}), strict=True
    ):
        quiet = 10 * sensor.noise_rms * sensor.si_per_unit + sensor.range_si * 1e-5
        assert np.ptp(line) <= 2 * quiet, f"{sensor.channel} moves"
    command = make_bump(0.1, MOTION_SAMPLES)
    bench.begin(backend, command)
    bench.check_played(
        backend.read(MOTION_SAMPLES), command, "the run after a tare begins at sample 0"
    )
    backend.close()


@clause
def sample_0_leaves_when_sample_0_is_taken(bench: Bench) -> None:
    """Also where the first of the command is read alone, and every sample is another value."""
    backend = bench.open()
    command = make_bump(1.0, MOTION_SAMPLES)
    backend.queue(0, command)
    before = bench.clock.now()
    backend.start()
    after = bench.clock.now()
    assert before <= backend.scheduled_time_s(0) <= after, "sample 0 is that of the start"
    bench.check_played(backend.read(1), command[:1], "sample 0")
    bench.check_played(backend.read(MOTION_SAMPLES - 1), command[1:], "the samples after it")
    backend.close()


@acquisition_clause
def samples_are_scheduled_at_the_rate(bench: Bench) -> None:
    backend = bench.start_playing(np.zeros(2))
    first = backend.scheduled_time_s(0)
    for index in (1, 7, 2000, 7_200_000):
        assert abs(backend.scheduled_time_s(index) - first - index / RATE_HZ) < 1e-6
    backend.close()


@acquisition_clause
def read_waits_for_its_last_sample(bench: Bench) -> None:
    backend = bench.start_playing(np.zeros(2))
    end = 0
    for samples in (1, 20, 3, 64):
        volts = backend.read(samples)
        end += samples
        assert volts.shape == (len(backend.channels), samples)
        assert volts.dtype == np.float64
        assert bench.clock.now() >= backend.scheduled_time_s(end - 1), "a sample of the future"
    backend.close()


@acquisition_clause
def how_reads_are_cut_changes_no_sample(bench: Bench) -> None:
    lives = []
    for cuts in ((MOTION_SAMPLES,), (1, 7, 64, 0, MOTION_SAMPLES - 72)):
        backend = bench.start_playing(make_bump(1.0, MOTION_SAMPLES))
        lives.append(np.concatenate([backend.read(samples) for samples in cuts], axis=1))
        backend.close()
        bench.check_played(lives[-1], make_bump(1.0, MOTION_SAMPLES), f"read in pieces of {cuts}")
    if bench.repeatable:
        assert lives[0].tobytes() == lives[1].tobytes()


@clause
def what_is_queued_later_is_replaced_exactly(bench: Bench) -> None:
    """Twice, the second time by less than what was queued: what lay behind is gone too."""
    volts = np.concatenate([make_rise(1.0, 2 * HANDOVER_SAMPLES), np.full(400, 1.0)])
    backend = bench.start_playing(volts)
    read = [backend.read(20)]
    index = 20 + backend.replace_after + HANDOVER_SAMPLES
    volts = np.concatenate([volts[:index], volts[index] + make_rise(-0.5, 300)])
    backend.queue(index, volts[index:])
    read.append(backend.read(1))
    index += 20
    volts = np.concatenate([volts[:index], volts[index] + make_rise(0.2, 40)])
    backend.queue(index, volts[index:])
    end = index + 340
    assert end < LOST[0]
    read.append(backend.read(end - 21))
    volts = np.pad(volts, (0, end - volts.size), "edge")
    bench.check_played(np.concatenate(read, axis=1), volts, "replaced")
    backend.close()


@clause
def the_first_sample_that_may_be_replaced_is(bench: Bench) -> None:
    backend = bench.start_playing(np.zeros(2))
    for _ in range(20):  # a clock that goes on by itself may leave too little time for a call
        index = bench.newest(backend) + backend.replace_after
        try:
            backend.queue(index + 1, np.zeros(2))
            break
        except ValueError:
            continue
    else:
        raise AssertionError(f"what lies {backend.replace_after} samples ahead is not replaced")
    backend.close()


@clause
def what_is_in_the_device_plays_as_it_was_queued(bench: Bench) -> None:
    command = make_bump(1.0, MOTION_SAMPLES)
    backend = bench.start_playing(command)
    head = backend.read(100)
    for index in (-1, 0, 50, 99, 100, 99 + backend.replace_after - 1):
        error = require_error(
            ValueError,
            lambda at=index: backend.queue(at, np.full(500, 0.7)),  # type: ignore[misc]
            f"sample {index} was replaced, 100 are read",
        )
        assert str(index) in str(error), "the error names the sample"
    whole = np.concatenate([head, backend.read(MOTION_SAMPLES - 100)], axis=1)
    bench.check_played(whole, command, "after refused replacements")
    backend.close()


@clause
def a_late_rig_cannot_rewrite_the_past(bench: Bench) -> None:
    command = make_bump(1.0, MOTION_SAMPLES)
    backend = bench.start_playing(command)
    head = backend.read(1)
    bench.clock.wait_until(bench.clock.now() + AWAY_S)
    late = round(AWAY_S * RATE_HZ)
    for index in (1 + backend.replace_after, late - 1, late + backend.replace_after - 1):
        require_error(
            ValueError,
            lambda at=index: backend.queue(at, np.full(500, 0.7)),  # type: ignore[misc]
            f"sample {index} was replaced, {late} are taken, 1 is read",
        )
    whole = np.concatenate([head, backend.read(MOTION_SAMPLES - 1)], axis=1)
    bench.check_played(whole, command, "read late")
    backend.close()


@clause
def what_is_no_voltage_is_refused(bench: Bench) -> None:
    command = make_bump(1.0, MOTION_SAMPLES)
    backend = bench.open()
    require_error(ValueError, lambda: backend.queue(0, np.array([0.0, np.nan])), "NaN")
    backend.queue(0, command)
    require_error(ValueError, lambda: backend.queue(0, np.array([np.inf])), "inf")
    backend.start()
    bench.check_played(backend.read(MOTION_SAMPLES), command, "after a refused command")
    backend.close()


@clause
def the_last_value_is_held(bench: Bench) -> None:
    """At the end of the queue, and up to an index that lies beyond it."""
    backend = bench.start_playing(make_rise(0.5, 100))
    beyond = 100 + backend.replace_after + HANDOVER_SAMPLES
    down = 0.5 - make_rise(0.3, 100)
    backend.queue(beyond, down)
    expected = np.concatenate(
        [make_rise(0.5, 100), np.full(beyond - 100, 0.5), down, np.full(50, 0.2)]
    )
    bench.check_played(backend.read(expected.size), expected, "held")
    backend.close()


@acquisition_clause
def a_lost_sample_is_nan_and_keeps_its_place(bench: Bench) -> None:
    command = make_bump(1.0, 800)
    backend = bench.start_playing(command)
    cuts = (LOST[0] - 10, 15, 40)
    volts = np.concatenate([backend.read(samples) for samples in cuts], axis=1)
    expected = np.isin(np.arange(sum(cuts)), LOST)
    assert (np.isnan(volts) == expected).all(), "what is lost is NaN, all of it, and nothing else"
    known = ~expected
    bench.check_played(volts[:, known], command[: sum(cuts)][known], "beside what was lost")
    backend.close()


@acquisition_clause
def close_is_safe_at_any_time(bench: Bench) -> None:
    unopened = bench.make(RATE_HZ)
    unopened.close()
    idle = bench.open()
    idle.close()
    idle.close()
    moving = bench.start_playing(make_bump(1.0, MOTION_SAMPLES))
    moving.read(MOTION_SAMPLES // 2)
    moving.close()
    moving.close()
    for backend in (unopened, idle, moving):
        require_error(RuntimeError, lambda backend=backend: backend.read(1), "read after close")  # type: ignore[misc]


@acquisition_clause
def the_next_life_begins_at_rest_at_sample_0(bench: Bench) -> None:
    """Also where the life before was left in motion: open() waits until the machine rests."""
    moving = bench.start_playing(make_bump(1.0, MOTION_SAMPLES))
    moving.read(MOTION_SAMPLES // 2)
    moving.close()
    backend = bench.open()
    tare = compute_tare(backend.tare(400), bench.rig.sensors)
    command = make_bump(0.5, MOTION_SAMPLES)
    bench.begin(backend, command)
    volts = backend.read(MOTION_SAMPLES)
    bench.check_played(volts, command, "the second life")
    table = volts_to_si(volts, bench.rig.sensors, tare)[bench.rig.channels.index("table_disp_m")]
    assert abs(table[:10]).max() < 1e-4, "the table moves before its command does"
    backend.close()
