"""The loop check: steady motions at low level before every run, and what they must show.

    aims(profile, rig) -> the motions, in the order in which they are driven
    cycles_at(aim, profile) -> cycles to hold there, SETTLE_CYCLES of them before those that count
    evaluate(heard, drive, profile, rig, tare_noise=None) -> (checks, response or None)
    transfer_at(response, frequency_hz) -> acceleration over command, complex

No line judges the specimen: it may resonate, and touch its bumpers.
"""

import math

import numpy as np

from table_io.block import Block
from table_io.course import Aim
from table_io.drive import Drive
from table_io.loop_check.cells import cells
from table_io.loop_check.heard import Heard
from table_io.loop_check.lines import (
    alive,
    at_rest,
    consistent,
    lost,
    mass,
    noise,
    read_back,
    table,
    unwrapped,
)
from table_io.profile import Profile
from table_io.records import Check, Response
from table_io.response import gain_at, transfer_at
from table_io.rig import Rig

__all__ = ["aims", "cycles_at", "evaluate", "gain_at", "remedy", "transfer_at"]

SETTLE_CYCLES = 1
LEAST_S = 2.0  # held at least: noise then moves a gain by 0.2 % at 10 Hz, five cycles by 0.5 %
MOST_LEVEL = 0.1  # of the test's
LOW_HZ = 1.0
ALIKE = 1.1  # frequencies closer than this factor are one
ORDERS = 5  # of the table's harmonics that may be cancelled
LINES = (lost, alive, read_back, table, mass, consistent, noise, at_rest, cells)
REMEDIES = {
    "lost samples": "look at the cable and at the acquisition",
    "alive": "look at its cable, its supply and its range",
    "command read back": "wire the command back, and compare span_mm and span_v with the output",
    "polarity": "turn the sensor round, or the sign of volts_per_unit in the machine card",
    "gain off": "look for a loose sensor, or a resonance of the table",
    "gain at": "lower sweep.stop_hz, or tune the servo",
    "gain": "compare unit and volts_per_unit in the machine card with the sensor, then the servo",
    "delay": "look at filters and at the clocks of output and input",
    "second derivative": "one of the two sensors has a wrong gain, unit, sign or filter, or is at "
    "the other's input",
    "noise": "look at earth loops and range, or raise sweep.acceleration_g",
    "offset": "tare again with the table at rest and the bumpers off",
    "motion left": "let the servo come to rest, or raise loop_check.rest_s",
    "cross-talk": "the cell feels the motion of the table, or the gap is smaller than stated",
    "force beside": "one of the two cells of this side feels nothing, or is not loaded",
}


def aims(profile: Profile, rig: Rig) -> tuple[Aim, ...]:
    """The steady motions of the check, lowest frequency first.

    Three in equal ratios between the ends of the sweep, from 1 Hz on where the sweep goes beyond
    it; with harmonics to cancel two more, up to the fifth of the highest frequency. The level is
    never raised above a tenth of the test's. So where an amplitude would have fewer DAC steps than
    the card wants, the level first rises to that tenth, and then the frequency gives way, down to
    where the steps suffice: the response beyond it is extrapolated.
    """
    sweep, card = profile.sweep, profile.loop_check
    full = sweep.steps[0].acceleration_m_s2
    least_m = rig.output.least_lsb * rig.output.lsb_m

    def within(f: float) -> float:
        coarse = math.sqrt(MOST_LEVEL * full / least_m) / (2 * math.pi)
        return min(f, coarse, rig.limits.frequency_hz)

    wanted = list(card.frequencies_hz)
    if not wanted:
        high = within(sweep.stop_hz)
        low = min(max(sweep.start_hz, LOW_HZ) if high > LOW_HZ else sweep.start_hz, high)
        wanted = [low, math.sqrt(low * high), high]
        if profile.control.harmonics:
            top = within(ORDERS * sweep.stop_hz)
            wanted += [math.sqrt(high * top), top]
    motions: list[Aim] = []
    for f in sorted(map(within, wanted)):
        if not motions or f > ALIKE * motions[-1].frequency_hz:
            motions.append(Aim(f, max(card.level * full, least_m * (2 * math.pi * f) ** 2)))
    return tuple(motions)


def cycles_at(aim: Aim, profile: Profile) -> int:
    """Cycles to hold at an aim, the settling ones included: those of the card, for LEAST_S."""
    return SETTLE_CYCLES + max(
        profile.loop_check.cycles, math.ceil(LEAST_S * aim.frequency_hz - 1e-9)
    )


def evaluate(
    heard: Block,
    drive: Drive,
    profile: Profile,
    rig: Rig,
    tare_noise: dict[str, float] | None = None,
) -> tuple[tuple[Check, ...], Response | None]:
    """(every line of the check, the table's response), from all that was measured so far, SI.

    `heard` holds the rest before, the motions and the rest after them. Only what the channels at
    hand allow is judged. No response where the table's accelerometer is lost.
    """
    whole = Heard(heard, drive, profile, rig, tare_noise or {})
    if not whole.holds:
        return (), None
    checks = tuple(check for judge in LINES for check in judge(whole))
    return checks, _response(whole)


def remedy(check: Check) -> str:
    """What to do about a line that has not passed."""
    return next((text for name, text in REMEDIES.items() if check.name.startswith(name)), "")


def _response(heard: Heard) -> Response | None:
    tones = heard.tones("table_acc_m_s2")
    if not (np.isfinite(tones).all() and np.abs(tones).all()):
        return None
    at = heard.frequencies_hz
    phase = unwrapped(tones, at)
    gain = np.abs(tones)
    return Response(
        heard.block.end, tuple(at.tolist()), tuple(gain.tolist()), tuple(phase.tolist())
    )
