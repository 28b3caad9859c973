"""Where a sweep turns round, two steps of one frequency follow each other and look like one."""

import pytest

from table_io.config.excitation.stepped_sine import Sweep
from twin.compare.step_detection import Hold, split_turns

RATE_HZ = 1000.0
SWEEP = Sweep(start_hz=1.0, stop_hz=3.0, step_hz=1.0, cycles=6, measured_cycles=2)


def holds(tuned: float) -> list[Hold]:
    """Up to 3 Hz and back to 1, each held for `tuned` cycles before its held ones."""
    stretches, at = [], 0.0
    half = 0.5 * SWEEP.blend_cycles  # of the blend between the two, in which nothing changes
    for hz in (1.0, 2.0, 3.0, 2.0, 1.0):
        cycles = SWEEP.cycles + tuned
        if hz == 3.0:
            cycles = 2 * cycles + (2 * half if tuned else 0.0)
        length = cycles * RATE_HZ / hz
        stretches.append(Hold(at, at + length, hz, 0.5))
        at += length + 100.0
    return stretches


@pytest.mark.parametrize("tuned", [0.0, 2.5, 7.0])
def test_the_first_of_them_ends_where_it_was_driven(tuned: float) -> None:
    steps = split_turns(holds(tuned), RATE_HZ, SWEEP, on_grid=True)
    assert [step.frequency_hz for step in steps] == [1.0, 2.0, 3.0, 3.0, 2.0, 1.0]
    first, second = steps[2], steps[3]
    assert first.end == second.start
    held = (second.end - second.start) * 3.0 / RATE_HZ
    blended = SWEEP.blend_cycles / 2 if tuned else 0.0
    assert held == pytest.approx(SWEEP.cycles + tuned + blended)
