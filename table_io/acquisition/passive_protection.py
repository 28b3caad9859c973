"""Passive protection: reports trips when the table cannot be stopped from here.

Protection and loop check of a recording under an external controller. They compare each measured
sample with the drive at its drive index and command nothing.
"""

from dataclasses import replace

import numpy as np

from table_io import sequencer
from table_io.acquisition.session import SessionSetup
from table_io.block import Block, Bool2D, Float2D, Int1D, join_blocks
from table_io.config.calibration import measure_noise
from table_io.excitation.drive import Drive
from table_io.records import Event, Record
from table_io.safety import loop_check, protection
from table_io.safety.protection import Observation

EXTERNAL_STOP_TEXT = "the table cannot be stopped from here: stop it at its controller"


class PassiveProtection:
    """Protection and loop check that only report, for a table under an external controller.

    `tare_v` are the volts at rest, (channel, sample). Without a measured command there is no
    protection.
    """

    def __init__(self, setup: SessionSetup, tare_v: Float2D) -> None:
        self.setup = setup
        self.tripped = False
        profile, rig = setup.profile, setup.rig
        noise = measure_noise(tare_v, rig.sensors)
        self.noise = {name: rms for name, (rms, _) in noise.items()}
        self.has_command = "drive_disp_m" in rig.channels
        self._protection = (
            protection.start_protection(profile, rig, noise) if self.has_command else None
        )
        self._check_end = sequencer.start_test(sequencer.make_test_plan(profile, rig)).stage.last
        self._check_blocks: list[tuple[Block, int]] = []
        self._check_pending = profile.loop_check.enabled

    def protect(
        self, block: Block, clipped: Bool2D, places: Int1D, drive: Drive
    ) -> tuple[Record, ...]:
        """Return the protection records of a block whose samples have drive indices `places`.

        The first finding that would stop the table is a Trip, every later one an Event.
        """
        if self._protection is None:
            return ()
        first, count, positions = drive_span(places)
        nominal = protection.sample_demand(drive, first, count)
        observation = Observation(block, clipped, *(row[positions] for row in nominal))
        self._protection, findings = protection.inspect_samples(self._protection, observation)
        records: list[Record] = []
        for finding in findings:
            if finding.stop and not self.tripped:
                self.tripped = True
                trip = finding.to_trip(block.end)
                records.append(replace(trip, text=f"{trip.text}; {EXTERNAL_STOP_TEXT}"))
            else:
                records.append(finding.to_event())
        return tuple(records)

    def check(self, block: Block, places: Int1D, drive: Drive) -> tuple[Record, ...]:
        """Return the records of the loop check once it and the rest after it are recorded."""
        last = int(places[-1])
        if not self._check_pending or last < 0:
            return ()
        self._check_blocks.append((block, int(places[0])))
        if last < self._check_end:
            return ()
        blocks, self._check_blocks, self._check_pending = self._check_blocks, [], False
        # Two clocks: align the check at its middle, where the deviation is balanced.
        middle_block, place = blocks[len(blocks) // 2]
        joined = join_blocks([block for block, _ in blocks])
        first = place - (middle_block.index - joined.index)
        if first > drive.segments[0].start or first + len(joined) < self._check_end:
            return (Event(block.end, "check", "the loop check is incomplete: not evaluated"),)
        return self._evaluate_check(replace(joined, index=first), drive, block.end)

    def _evaluate_check(self, block: Block, drive: Drive, index: int) -> tuple[Record, ...]:
        """Evaluate the loop check into records at sample `index`."""
        profile, rig = self.setup.profile, self.setup.rig
        block = block.cut(max(block.index, 0), self._check_end)
        if not self.has_command:
            return (Event(index, "check", "no command is wired: the loop check is not evaluated"),)
        checks, response = loop_check.evaluate(block, drive, profile, rig, self.noise)
        records: list[Record] = [replace(check, index=index) for check in checks]
        if response is not None:
            response = replace(response, index=index)
            records.append(response)
            if self._protection is not None:
                self._protection = protection.set_response(self._protection, response)
        if not all(check.passed for check in checks):
            text = f"the loop check failed, but the test continues; {EXTERNAL_STOP_TEXT}"
            records.append(Event(index, "check", text))
        return tuple(records)


def drive_span(places: Int1D) -> tuple[int, int, Int1D]:
    """Return (first, count) of the drive samples that `places` span, and positions in them."""
    first = int(places[0])
    return first, int(places[-1]) - first + 1, np.asarray(places - first)
