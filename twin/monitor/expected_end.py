"""Expected end of a running test, corrected by holds, retries and added steps as they happen."""

from table_io.block import Block
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.trajectory import cycles_to_samples
from table_io.records import RunStart, Step
from table_io.sequencer.procedure import make_test_plan, nominal_drive


class ExpectedEnd:
    """Sample index at which a test is expected to end: as planned, then by what has happened.

    The nominal drive states how many samples are left from the first held cycle of each step. A
    step that is held by the operator or tuned again has them still ahead; an added step adds its
    own. Raises InputError or ArithmeticError if there is no nominal drive of the profile.
    """

    def __init__(self, start: RunStart, profile: Profile, rig: RigConfig) -> None:
        self.index = start.planned_samples
        self._rate_hz, self._sweep_cycles = start.rate_hz, 0
        self._left: dict[int, int] = {}  # by step, in samples
        self._approach = 0  # samples of blend and tuning before an added step
        self._is_continuation = profile.continuation is not None
        self._steps = {step.index: step for step in start.steps}
        self._measured_step = -1  # whose held cycles have begun; the last step reached by orbits
        self._cycle = (-1, -1)  # last step and held cycle
        drive = nominal_drive(make_test_plan(profile, rig))
        if drive.steps != start.steps or not start.steps:
            return  # not driven by this profile, as an imported table; or a displacement history
        if profile.continuation is not None:
            left = profile.continuation.expected_s * start.rate_hz
            self.index += round(left)
            total = sum(1.0 / step.frequency_hz for step in start.steps)
            share = left / total
            for step in start.steps:
                self._left[step.index] = round(left)
                left -= share / step.frequency_hz
            return
        self._sweep_cycles, last = profile.sweep.cycles, start.steps[-1].index
        for segment in drive.sine_segments:
            if segment.cycles:
                self._left[segment.step] = drive.planned_end - segment.start
            elif segment.step == last and last not in self._left:
                self._approach += segment.count

    def add_step(self, step: Step, index: int) -> None:
        """Add a step that was decided on at sample `index`."""
        if not self._sweep_cycles or step.index in self._left:
            return
        self._steps[step.index] = step
        self._left[step.index] = cycles_to_samples(step, self._sweep_cycles, self._rate_hz)
        self.index = max(self.index, index + self._approach + self._left[step.index])

    def add_block(self, block: Block, is_holding: bool) -> None:
        """Correct the end by a measured block; `is_holding` while the operator holds the test."""
        step, cycle = int(block.step[-1]), int(block.cycle[-1])
        if step not in self._left:
            return
        if self._is_continuation:
            self._add_orbit_block(step, block.end)
        elif is_holding or (cycle < 0 and step != self._measured_step):
            self._measured_step = -1
            self.index = max(self.index, block.end + self._left[step])
        elif cycle >= 0 and self._cycle != (step, cycle):
            begin = block.index + int(((block.step != step) | (block.cycle != cycle)).sum())
            done = round(cycle * self._rate_hz / self._steps[step].frequency_hz)
            self._measured_step = step
            self.index = begin + self._left[step] - done
        self._cycle = step, cycle

    def _add_orbit_block(self, step: int, end: int) -> None:
        """Keep the points after the one that is sought ahead, however often it is retried."""
        if step > self._measured_step:
            self._measured_step = step
            self.index = end + self._left[step]
        self.index = max(self.index, end + self._left.get(self._measured_step + 1, 0))
