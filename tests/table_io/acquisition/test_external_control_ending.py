"""When a session that follows ends, and what it says then: stops, noise, and who played before."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.block import Float1D, Label
from table_io.config.folders import find_config
from table_io.excitation.drive import Drive
from tests.builders.drives import sine_segments
from tests.input_errors import raises_input_error
from tests.table_io.acquisition.external_controller import Bystander, whole
from tests.table_io.acquisition.test_external_control import (
    DRIVE_START_SAMPLE,
    SWEEP,
    no_command,
    order,
    run,
    setup,
    stop_early,
)


class Floating(Bystander):
    """The cable of the command falls off in mid-test: what is left is noise."""

    def take(self, samples: int) -> np.ndarray:
        volts = super().take(samples)
        if self._next > 12000:
            draw = np.random.default_rng(self._next).standard_normal(samples)
            volts[self.channels.index("drive_disp_m")] = 1e-4 * draw
        return volts


def test_command_that_never_rests_again_ends_the_recording() -> None:
    """As long after the motion began as the drive takes, not at the operator's patience."""
    recording = run(
        setup(), kind=Floating, orders=lambda n: pytest.fail("for ever") if n > 5000 else None
    )
    assert recording.stop.verdict == "aborted"
    assert any("drive_disp_m still moves" in line for line in recording.event_texts("stop"))
    assert recording.block.end <= DRIVE_START_SAMPLE + recording.drive.rest_start + 4000
    assert recording.stop.states[-1] == "left"


def test_stop_in_the_rest_before_the_sweep_does_not_end_a_controller_that_plays_on() -> None:
    long = setup(check=True, excitation=SWEEP | {"cycles": 12})
    drive = plan_open_loop_drive(long.profile, long.rig)
    sweep = next(segment.start for segment in sine_segments(drive) if segment.step == 0)
    asked = round((DRIVE_START_SAMPLE + sweep - 900) / 20)
    recording = run(long, orders=partial(order, "stop", asked))
    assert recording.stop.verdict == "stopped"
    assert recording.block.end == pytest.approx((asked + 1) * 20 + 20000, abs=40)
    assert recording.stop.states[-1] == "left"
    assert (recording.block.label == Label.MEASURE).any()


def test_stop_while_the_drive_is_searched_for_does_not_end_in_motion() -> None:
    asked = round(DRIVE_START_SAMPLE + 2200) // 20
    recording = run(setup(), stop_early, orders=partial(order, "stop", asked))
    assert recording.event_texts("motion")
    assert recording.stop.states[-1] == "at rest"
    assert recording.block.end > DRIVE_START_SAMPLE + 8000
    assert np.abs(recording.block.channel("drive_disp_m")[-300:]).max() < 1e-6


class Before(Bystander):
    """Its controller plays while the tare is taken."""

    def tare(self, samples: int) -> np.ndarray:
        volts = super().tare(samples)
        moved = self.file.command(-samples, samples) * self._rig.sensors[0].volts_per_si
        volts[self.channels.index("drive_disp_m")] += moved
        return volts


class Early(Before):
    """The same, well in the drive."""

    def __init__(self, *words: Any) -> None:
        rig, specimen, rate_hz, clock, file_m, _, ppm = words
        super().__init__(rig, specimen, rate_hz, clock, file_m, -9000.4, ppm)


def test_controller_that_plays_before_the_start_is_refused() -> None:
    with raises_input_error(key="drive_disp_m"):
        run(setup(), kind=Early)
    assert run(setup(), kind=Before).stop.verdict == "complete"


class Lost(Bystander):
    """Its command never comes."""

    def take(self, samples: int) -> np.ndarray:
        volts = super().take(samples)
        volts[self.channels.index("drive_disp_m")] = np.nan
        return volts


def test_lost_command_is_not_taken_for_rest() -> None:
    text = (
        find_config("follow_simulated", "rigs")
        .read_text()
        .replace("wait_s = 300.0", "wait_s = 6.0")
    )
    recording = run(setup(text=text), kind=Lost)
    assert recording.stop.verdict == "aborted"
    assert "the command was lost, so it is not known" in recording.stop.reason


def test_half_the_amplitude_aborts_without_a_wired_command() -> None:
    def half(drive: Drive) -> Float1D:
        return 0.5 * whole(drive)

    recording = run(setup(text=no_command()), half)
    assert recording.stop.verdict == "aborted"
    assert "of the drive's; allowed: 0.7 to 1.3" in recording.stop.reason
