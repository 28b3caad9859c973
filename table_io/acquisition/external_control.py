"""Recording of a test under an external controller that plays our drive file by itself.

Like `run_session`, a generator of Blocks and records, but it commands nothing: it finds the drive
in the measured command, labels each sample by its drive index and reports protection trips. The
table cannot be stopped from here.

States: idle, checking, waiting, following, astray (drive lost), at rest (or left: ended in motion),
fault.

Protection and loop check are passive here. They compare each measured
sample with the drive at its drive index and command nothing.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from table_io.acquisition.drive_follower import (
    REST_INDEX,
    DriveFollower,
    advance_follower,
    flush_follower,
    format_alignment,
    refuse_motion,
    take_drive_indices,
)
from table_io.acquisition.session import (
    ACCEPTED,
    TARE_S,
    CommandSource,
    EventLog,
    LatenessLog,
    OperatorCommand,
    RunDescriber,
    SessionOutput,
    SessionSetup,
    find_gaps,
)
from table_io.adaptive.policy import make_policy
from table_io.backends import AcquisitionSource, MachineLost
from table_io.backends.follow import FollowWiring
from table_io.block import Block, Bool2D, Float1D, Float2D, Int1D, join_blocks
from table_io.clock import Clock, local_datetime
from table_io.config.calibration import (
    find_overdue_calibrations,
    measure_noise,
    resolve_tare,
    volts_to_si,
)
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.drive import Drive
from table_io.records import Event, Record, RunStop, Trip
from table_io.safety import loop_check, protection
from table_io.safety.protection import Observation
from table_io.sequencer import procedure

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
        self._check_end = procedure.start_test(procedure.make_test_plan(profile, rig)).stage.last
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
        records = loop_check.list_check_records(checks, index)
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


MAX_STOP_WAIT_S = 10.0  # from a stop request until the recording ends in any case


def plan_open_loop_drive(profile: Profile, rig: RigConfig) -> Drive:
    """Return the open-loop drive for an external controller, the loop check included.

    InputError for an adaptive test, a swept sine or a continuation, which decide while they run.
    """
    own_drive = "use a rig that this program drives"
    for excitation, problem, remedy in (
        (
            profile.swept_sine,
            "its level is corrected while the frequency moves, which another controller cannot do",
            own_drive,
        ),
        (
            profile.continuation,
            "orbits are held by a feedback to the command, which another controller cannot give",
            f"{own_drive}, with a command queue it can replace",
        ),
    ):
        if excitation is not None:
            raise InputError(
                problem,
                where=f"rig {rig.name}",
                key="excitation.kind",
                value=profile.excitation.kind,
                remedy=remedy,
            )
    plan = procedure.make_test_plan(profile, rig)
    if make_policy(profile) is not None:
        tables = [name for name in ("dwell", "track", "refine") if getattr(profile, name)]
        raise InputError(
            "the test decides while it runs which steps follow, so another controller cannot play "
            "it from a file",
            key=f"[{tables[0]}]",
            remedy="remove this table from the profile",
        )
    return procedure.nominal_drive(plan)


def record_external(
    setup: SessionSetup,
    source: AcquisitionSource,
    clock: Clock,
    describe: RunDescriber,
    commands: CommandSource,
    punctuality: LatenessLog | None = None,
) -> SessionOutput:
    """Yield RunStart, every Block since the start of acquisition with its records, and RunStop.

    Until the drive is found, blocks are held back for their labels; the reported lateness is that
    of their acquisition.
    """
    run = _ExternalSession(setup, source, clock)
    try:
        yield describe(run.begin(), source.scheduled_time_s(0))
        yield from run.event_log.drain()
        while not run.is_finished:
            late_s = run.acquire()
            run.event_log.report_lateness(late_s, run.end)
            for block, clipped in run.take_blocks():
                if punctuality is not None:
                    punctuality.late_s.append(late_s)
                yield block
                yield from find_gaps(block, clipped)
                run.check_block(block, clipped)
            run.execute(commands())
            yield from run.event_log.drain()
        run.finish()
    except MachineLost as error:
        run.report_machine_loss(str(error))
    finally:
        source.close()
    for block, clipped in run.flush_blocks():
        if punctuality is not None:
            punctuality.late_s.append(0.0)
        yield block
        yield from find_gaps(block, clipped)
    yield from run.event_log.drain()
    yield RunStop(run.delivered, run.verdict, run.reason, tuple(run.event_log.states))


class _ExternalSession:
    """Mutable state of the recording: samples, follower, passive protection and event log."""

    def __init__(self, setup: SessionSetup, source: AcquisitionSource, clock: Clock) -> None:
        profile, rig = setup.profile, setup.rig
        self.setup, self.source, self.clock = setup, source, clock
        self.rate_hz = profile.acquisition.rate_hz
        self.drive = plan_open_loop_drive(profile, rig)
        self.wiring = rig.get_section(FollowWiring) or FollowWiring()
        self.verdict, self.reason = "complete", "the whole drive was played"
        self.delivered = 0  # samples that were delivered
        self.is_finished = False
        self._rest_samples = round(profile.acquisition.rest_s * self.rate_hz)
        self._max_samples = self.drive.rest_start + self._rest_samples
        self._lost_samples = 0  # of the command
        self._clipping_v = np.array([sensor.clipping_level_v for sensor in rig.sensors])
        self._command_row = rig.channels.index(self.wiring.command)
        self._pending_v = np.empty((len(rig.channels), 0))  # volts not delivered yet
        self._tare: dict[str, float] = {}
        self._follower = DriveFollower(self.drive, self.rate_hz, 0.0, 0.0)
        self._drive_indices, self._last_index = np.empty(0, dtype=np.int64), REST_INDEX
        self._stop_deadline: int | None = None
        self.event_log = EventLog(lambda: self.delivered)
        self._sweep_started = False

    def begin(self) -> dict[str, float]:
        """Open the source and start acquisition; return the tare per channel in SI."""
        self.event_log.enter_state("checking")
        for sentence in find_overdue_calibrations(self.setup.rig, local_datetime().date()):
            self.event_log.add_event("calibration", sentence)
        self.source.open()
        volts = self.source.tare(int(TARE_S * self.rate_hz))
        self._protection = PassiveProtection(self.setup, volts)
        rig = self.setup.rig
        tare = resolve_tare(volts, rig, self.setup.profile.specimen.gaps_m)
        self._tare = tare.offsets
        if tare.note:
            self.event_log.add_event("tare", tare.note)
        sensor = self.setup.rig.sensors[self._command_row]
        refuse_motion(self._command_m(volts), sensor, self.drive, self.rate_hz)
        lsb = 2 * sensor.range_si / 2**sensor.bits
        noise = self._protection.noise.get(sensor.channel)
        self._follower = DriveFollower(self.drive, self.rate_hz, noise or 0.0, lsb)
        self.source.start()
        self.event_log.enter_state("waiting")
        self.event_log.add_event(
            "clock", f"{self.source.clock_description}; the controller runs on its own clock"
        )
        if not self._protection.has_command:
            self.event_log.add_event(
                "follow", "no command is wired: protection and loop check are off"
            )
        if self.wiring.command == "table_disp_m":
            self.event_log.add_event(
                "follow", "the drive is searched for in table_disp_m, which lags behind it"
            )
        text = f"play the drive file on the controller NOW; waiting for {self.wiring.wait_s:g} s"
        self.event_log.add_event("follow", text)
        return self._tare

    @property
    def end(self) -> int:
        """Number of acquired samples."""
        return self.delivered + self._pending_v.shape[1]

    def acquire(self) -> float:
        """Read the next block and advance the follower; return the lateness of the block in s."""
        volts = self.source.read(self.setup.profile.acquisition.block_samples)
        self._pending_v = np.concatenate([self._pending_v, volts], axis=1)
        end = self.end
        late_s = self.clock.now() - self.source.scheduled_time_s(end - 1)
        before = self._follower
        command = self._command_m(volts)
        self._lost_samples += int(np.isnan(command).sum())
        self._follower = follower = advance_follower(before, command)
        if follower.onset is not None and before.onset is None:
            self.event_log.add_event("motion", "motion detected: searching for the drive")
        if follower.state != before.state:
            self._handle_state_change(follower)
        self._check_end(end)
        return late_s

    def _command_m(self, volts: Float2D) -> Float1D:
        """Return the measured command in m, (sample,)."""
        row = slice(self._command_row, self._command_row + 1)
        return volts_to_si(volts[row], self.setup.rig.sensors[row], self._tare)[0]

    def _handle_state_change(self, follower: DriveFollower) -> None:
        """Log that the drive was found or lost; a loss without a stop request is a Trip."""
        if follower.state == "playing":
            self.event_log.enter_state("following")
            self.event_log.add_event("aligned", format_alignment(self._follower))
            return
        self.event_log.enter_state("astray")
        if self._stop_deadline is None:  # otherwise the operator requested it
            self.verdict = "aborted"
            self.reason = f"the controller does not play the drive: {follower.reason}"
            text, where = f"{self.reason}; the recording continues until rest", self.wiring.command
            self.event_log.pending.append(
                Trip(
                    follower.lost_at,
                    follower.processed_end,
                    "plan",
                    where,
                    *follower.deviation_m,
                    text,
                )
            )
        if follower.drive_indices.size and follower.fit is not None:
            self.drive = self.drive.decay_from(int(follower.drive_indices[0]))

    def _check_end(self, end: int) -> None:
        """Finish the recording if nothing was played in time or the command is at rest again."""
        follower, state = self._follower, self._follower.state
        if (
            state == "waiting"
            and follower.onset is None
            and end > self.wiring.wait_s * self.rate_hz
        ):
            self.verdict = "aborted"
            self.reason = f"nothing was played within {self.wiring.wait_s:g} s"
            if self._lost_samples > end / 2:
                self.reason = "the command was lost, so it is not known whether it was played"
            self.is_finished = True
        elif state in ("left", "other"):
            self.is_finished = follower.is_quiet and end - follower.lost_at > 2 * self.rate_hz
            if (
                not follower.is_quiet
                and end > (follower.onset or follower.lost_at) + self._max_samples
            ):
                self.is_finished = True
                text = f"{self.wiring.command} still moves, or its noise hides whether it rests"
                self.event_log.add_event(
                    "stop", f"{text}: the recording ends; {EXTERNAL_STOP_TEXT}"
                )
        if self._stop_deadline is not None:
            self.is_finished = self.is_finished or end >= self._stop_deadline or follower.is_still
            if end >= self._stop_deadline and not follower.is_still:
                self.event_log.add_event(
                    "stop", f"the recording ends while the table still moves; {EXTERNAL_STOP_TEXT}"
                )

    def take_blocks(self) -> Iterator[tuple[Block, Bool2D]]:
        """Yield (block in SI, mask of clipped samples) as far as drive indices are known.

        The recording is finished after the rest behind the drive.
        """
        count = self.setup.profile.acquisition.block_samples
        while min(self._follower.located_end - self.delivered, self._pending_v.shape[1]) >= count:
            yield self._take_block(count)
            if (
                self._follower.state == "playing"
                and self._last_index >= self.drive.rest_start + self._rest_samples
            ):
                self.is_finished = True

    def flush_blocks(self) -> Iterator[tuple[Block, Bool2D]]:
        """Yield the blocks that were still held back at the end."""
        if self._pending_v.size:
            self._follower = flush_follower(self._follower)
        block_samples = self.setup.profile.acquisition.block_samples
        while count := min(self._pending_v.shape[1], block_samples):
            yield self._take_block(count)

    def _take_block(self, count: int) -> tuple[Block, Bool2D]:
        volts, self._pending_v = self._pending_v[:, :count], self._pending_v[:, count:]
        self._follower, places = take_drive_indices(self._follower, count)
        self._drive_indices, self._last_index = places, int(places[-1])
        rig = self.setup.rig
        first, samples, positions = drive_span(places)
        labels = (row[positions] for row in self.drive.labels(first, samples))
        values = volts_to_si(volts, rig.sensors, self._tare)
        block = Block("meas", self.delivered, self.rate_hz, rig.channels, values, *labels)
        self.delivered = block.end
        return block, np.abs(volts) >= self._clipping_v[:, None]

    def check_block(self, block: Block, clipped: Bool2D) -> None:
        """Apply protection and loop check to a block, and log the start of the sweep."""
        arguments = block, clipped, self._drive_indices, self.drive
        self.event_log.pending.extend(self._protection.protect(*arguments))
        if self._follower.state != "playing":
            return
        self.event_log.pending.extend(
            self._protection.check(block, self._drive_indices, self.drive)
        )
        if not self._sweep_started and block.step[-1] >= 0:
            self._sweep_started = True
            self.event_log.add_event("aligned", format_alignment(self._follower))

    def execute(self, command: OperatorCommand | None) -> None:
        """Log that the table cannot be controlled from here; a stop ends the recording."""
        if command is None:
            return
        if command.name in ("hold", "resume"):
            refusal = f"{command.name} is not possible from here: use the external controller"
            self.event_log.add_event("refused", refusal)
            command.answer(f"refused: {refusal}")
            return
        command.answer(ACCEPTED)
        if self._stop_deadline is not None:
            return
        self.verdict = "stopped" if command.name == "stop" else "aborted"
        self.reason = command.reason
        self.event_log.add_event(
            "stop", f"{command.reason}: STOP THE TABLE AT ITS CONTROLLER, not possible from here"
        )
        self._stop_deadline = self.end + round(MAX_STOP_WAIT_S * self.rate_hz)

    def finish(self) -> None:
        """Log the final alignment and state of a recording."""
        if self._follower.fit is not None:
            self.event_log.add_event("aligned", format_alignment(self._follower))
        if self._protection.tripped and self.verdict == "complete":
            self.reason += "; protection would have stopped it, see the trip"
        self.event_log.enter_state("at rest" if self._follower.is_quiet else "left")

    def report_machine_loss(self, why: str) -> None:
        """Log the loss of a device that no longer answers."""
        self.event_log.enter_state("fault")
        end = self.end
        self.event_log.pending.append(Trip(end, end, "machine", "", 0.0, 0.0, why))
        self.verdict, self.reason = "halted", why
