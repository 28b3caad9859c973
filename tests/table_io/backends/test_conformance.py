"""Every backend keeps the contract; and each clause is seen to be broken where it is."""

import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path

import numpy as np
import pytest

from table_io.backends.machine.client import MachineBackend
from table_io.block import Float1D, Float2D
from table_io.clock import Clock, ManualClock, RealClock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import SPECIMEN
from tests.table_io.backends.conformance import CLAUSES, LOST, RATE_HZ, Bench

LOSS = f"""
[[simulated.faults]]
kind = "dropped"
at_s = {LOST[0] / RATE_HZ}
for_s = {len(LOST) / RATE_HZ}
"""


def card(name: str) -> tuple[RigConfig, str]:
    """A shipped machine card whose machine loses LOST, and its text."""
    text = (PROFILES_DIR / "rigs" / f"{name}.toml").read_text() + LOSS
    return parse_toml(text, RigConfig, name), text


def make_simulated_bench(clock: Clock, kind: type[SimulatedBackend] = SimulatedBackend) -> Bench:
    rig, _ = card("simulated")
    return Bench(rig, clock, lambda rate: kind(rig, SPECIMEN, rate, clock), repeatable=True)


@contextmanager
def machine(folder: Path) -> Iterator[Bench]:
    """The simulated machine as a process of its own."""
    text = card("machine")[1].replace("tcp/127.0.0.1:7450", f"unix/{folder / 'table'}")
    path = folder / "card.toml"
    path.write_text(text)
    rig, clock = parse_toml(text, RigConfig, str(path)), RealClock()
    command: list[str | Path] = [Path(sys.executable).parent / "shaketwin", "table", "--rig", path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert "waiting at" in process.stdout.readline()
        yield Bench(
            rig, clock, lambda rate: MachineBackend(rig, SPECIMEN, rate, clock), repeatable=True
        )
        process.terminate()


BENCHES: dict[str, Callable[[Path], AbstractContextManager[Bench]]] = {
    "simulated, manual clock": lambda _: nullcontext(make_simulated_bench(ManualClock())),
    "simulated, real clock": lambda _: nullcontext(make_simulated_bench(RealClock(2.0))),
    "machine process": machine,
}


@pytest.fixture(scope="module", params=BENCHES)
def bench(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Bench]:
    """Every backend there is; a new one is one more parameter."""
    if request.param == "machine process":
        with machine(tmp_path_factory.mktemp("machine")) as machine_bench:
            yield machine_bench
    else:
        yield make_simulated_bench(
            ManualClock() if request.param == "manual clock" else RealClock()
        )


@pytest.mark.parametrize("clause", CLAUSES)
def test_every_backend_keeps_the_contract(clause: str, bench: Bench) -> None:
    CLAUSES[clause](bench)


class EarlyByOne(SimulatedBackend):
    """Input begins one sample after output."""

    def start(self) -> None:
        super().start()
        super().read(1)


class Hasty(SimulatedBackend):
    """Does not wait."""

    def _wait_for_samples(self, first: int, last: int) -> None:
        pass


class Smoothing(SimulatedBackend):
    """Fills what is lost."""

    def read(self, samples: int) -> Float2D:
        return np.nan_to_num(super().read(samples))


class Shifting(SimulatedBackend):
    """Leaves out what was lost, so that nothing keeps its place."""

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        kept = volts[:, ~np.isnan(volts[0])]
        return np.pad(kept, ((0, 0), (0, samples - kept.shape[1])), constant_values=np.nan)


class Coarse(SimulatedBackend):
    """Cuts reads into whole pieces of 8, and loses the rest."""

    def read(self, samples: int) -> Float2D:
        volts = super().read(samples)
        super().read(-samples % 8)
        return volts


class Sloppy(SimulatedBackend):
    """Replaces a sample late."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index + (index > 0), volts)


class Appending(SimulatedBackend):
    """Replaces no more than what comes: what was queued behind it plays on."""

    def queue(self, index: int, volts: Float1D) -> None:
        behind = self._command[index + volts.size - self._origin :] * self._rig.output.volts_per_m
        super().queue(index, np.concatenate([volts, behind]))


class Slow(SimulatedBackend):
    """Needs longer than it says."""

    def queue(self, index: int, volts: Float1D) -> None:
        if self._epoch is not None and index < self._newest_sample() + 2 * self.replace_after:
            raise ValueError(f"sample {index} is in the device")
        super().queue(index, volts)


class Obliging(SimulatedBackend):
    """Takes what comes too late, for as much of it as is still to come."""

    def queue(self, index: int, volts: Float1D) -> None:
        try:
            super().queue(index, volts)
        except ValueError:
            if np.isfinite(volts).all():
                late = self._newest_sample() + self.replace_after - index
                super().queue(index + late, volts[late:])
            raise


class Silent(SimulatedBackend):
    """Takes what comes too late without a word."""

    def queue(self, index: int, volts: Float1D) -> None:
        try:
            super().queue(index, volts)
        except ValueError:
            if not np.isfinite(volts).all():
                raise


class ByWhatWasRead(SimulatedBackend):
    """Forgets that time passes while nobody reads."""

    def _newest_sample(self) -> int:
        return self._next - 1


class Trusting(SimulatedBackend):
    """Plays what is no voltage as 0 V."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index, np.nan_to_num(volts, posinf=0.0))


class Zeroing(SimulatedBackend):
    """Writes zeros to stop."""

    def queue(self, index: int, volts: Float1D) -> None:
        super().queue(index, np.append(volts, 0.0))


class Unpunctual(SimulatedBackend):
    """Schedules by another rate than it samples at."""

    def scheduled_time_s(self, index: int) -> float:
        return super().scheduled_time_s(round(1.001 * index))


class Elsewhen(SimulatedBackend):
    """Starts before it is told to."""

    def start(self) -> None:
        super().start()
        assert self._epoch is not None
        self._epoch -= 0.5


class Touchy(SimulatedBackend):
    """Closes once."""

    def close(self) -> None:
        if not self._is_open:
            raise OSError("it is closed")
        super().close()


class Eager(SimulatedBackend):
    """Cares for no order."""

    def _require(self, condition: bool, remedy: str) -> None:
        pass


class Anything(SimulatedBackend):
    """Samples at whatever rate."""

    def open(self) -> None:
        self._is_open = True


class Nervous(SimulatedBackend):
    """Moves while it is tared."""

    def tare(self, samples: int) -> Float2D:
        return super().tare(samples) + np.linspace(0.0, 0.1, samples)


class Short(SimulatedBackend):
    """Tares less than asked for."""

    def tare(self, samples: int) -> Float2D:
        return super().tare(samples // 2)


class Displaced(SimulatedBackend):
    """Begins its life off its mean."""

    def open(self) -> None:
        super().open()
        self._state[2] = 1e-3


class Anonymous(SimulatedBackend):
    """Does not say how far ahead it can be changed."""

    def __init__(self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        super().__init__(rig, specimen, rate_hz, clock)
        self.replace_after = 0


BROKEN: dict[str, list[type[SimulatedBackend]]] = {
    "it_says_what_it_is": [Anonymous],
    "open_refuses_a_rate_that_the_machine_has_not": [Anything],
    "calls_out_of_order_are_refused": [Eager],
    "tare_is_the_inputs_at_rest_and_moves_nothing": [Nervous, Short],
    "sample_0_leaves_when_sample_0_is_taken": [EarlyByOne, Elsewhen],
    "samples_are_scheduled_at_the_rate": [Unpunctual],
    "read_waits_for_its_last_sample": [Hasty],
    "how_reads_are_cut_changes_no_sample": [Coarse],
    "what_is_queued_later_is_replaced_exactly": [Sloppy, Appending],
    "the_first_sample_that_may_be_replaced_is": [Slow],
    "what_is_in_the_device_plays_as_it_was_queued": [Obliging, Silent],
    "a_late_rig_cannot_rewrite_the_past": [ByWhatWasRead],
    "what_is_no_voltage_is_refused": [Trusting],
    "the_last_value_is_held": [Zeroing],
    "a_lost_sample_is_nan_and_keeps_its_place": [Smoothing, Shifting],
    "close_is_safe_at_any_time": [Touchy],
    "the_next_life_begins_at_rest_at_sample_0": [Displaced],
}


def test_every_clause_has_its_violation() -> None:
    assert BROKEN.keys() == CLAUSES.keys()


@pytest.mark.parametrize(
    ("clause", "kind"),
    [(clause, kind) for clause, kinds in BROKEN.items() for kind in kinds],
    ids=lambda clause_or_kind: (
        clause_or_kind if isinstance(clause_or_kind, str) else clause_or_kind.__name__
    ),
)
def test_clause_fails_for_a_broken_backend(clause: str, kind: type[SimulatedBackend]) -> None:
    with pytest.raises((AssertionError, OSError)):
        CLAUSES[clause](make_simulated_bench(ManualClock(), kind))
