"""The lines of a loop check: each function yields what it can judge from the channels at hand.

A value that is not known (NaN) has not passed. Where a specimen's own motion could explain a
value there is no line, or one without limits.
"""

import math
from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D
from table_io.channels import BY_NAME, LEFT_CELLS, RIGHT_CELLS
from table_io.loop_check.heard import Complex1D, Heard, mismatch
from table_io.records import Check

TABLE = ("table_disp_m", "table_acc_m_s2")
MASS = ("mass_disp_m", "mass_acc_m_s2")
MOVING = (*TABLE, *MASS, "rel_disp_m")

LOST = 1.0  # per cent of the samples
CLEAR = 10.0  # tone over its standard error
GAIN = (0.8, 1.2)  # where a servo still follows
TOP_GAIN = (0.5, 1.25)  # at the end of the sweep: amplitude control doubles a command at most
SMOOTH = 10.0  # per cent off a straight line of ln gain over f^2
DELAY_MS = (-2.0, 100.0)
DELAY_SPREAD_MS, DELAY_SPREAD = 5.0, 0.5  # the larger of this and of this share of the delay
READ_BACK_LSB, READ_BACK = 4.0, 0.005  # of the converter, and of the command
MATCH = 10.0  # per cent
KNOWN = 0.02  # of a ratio: noise beyond it makes a frequency unfit to compare sensors at
UNDER_DB = 20.0
OFFSET = 0.05  # of the test's motion, or of the gap
STILL, STILL_NOISE = 0.02, 2.0  # of the test's motion, and of the noise
LAGS, LEADS = 0.2, -0.5  # sines that tell by themselves; a transient may look like a small lead
IN_PHASE, AGAINST = 0.5, 0.9  # tone of the mass: more, with the table; less, against it


def line(
    heard: Heard, name: str, channel: str, value: float, low: float, high: float, unit: str
) -> Check:
    """One line of the check."""
    value = float(value)
    return Check(heard.block.end, name, channel, value, low, high, unit, low <= value <= high)


def lost(heard: Heard) -> Iterator[Check]:
    """Samples that did not come."""
    for name, values in zip(heard.block.channels, heard.block.values, strict=True):
        share = 100.0 * float(np.isnan(values).mean())
        yield line(heard, "lost samples", name, share, 0.0, LOST, "%")


def alive(heard: Heard) -> Iterator[Check]:
    """The tone of a motion stands out of the noise; what is not alive is judged no further.

    An isolated mass hardly moves: its sensors need only show 2 % of what the table's show.
    """
    for name in filter(heard.has, (*TABLE, *MASS)):
        table = name.replace("mass", "table")
        low = (
            CLEAR
            if name in TABLE or not heard.has(table)
            else min(CLEAR, 0.02 * heard.clear(table))
        )
        yield line(heard, "alive, tone over noise", name, heard.clear(name), low, math.inf, "")


def read_back(heard: Heard) -> Iterator[Check]:
    """The command as acquired against the command as computed."""
    command = heard.drive.command(heard.block.index, len(heard.block))
    lsb = heard.rig.output.lsb_m
    off = heard.block.channel("drive_disp_m") - command
    allowed = READ_BACK_LSB + READ_BACK * _rms(command) / lsb
    yield line(heard, "command read back", "drive_disp_m", _rms(off) / lsb, 0.0, allowed, "LSB")


def table(heard: Heard) -> Iterator[Check]:
    """Polarity, gain and delay of the table's sensors against the command.

    A servo rolls off, so +-20 % hold at the lowest frequency; above it the gain has to follow a
    smooth curve, within what amplitude control can make good.
    """
    at = heard.frequencies_hz
    for name in TABLE:
        if not _seen(heard, name):
            continue
        tones = heard.tones(name)
        polarity = float(np.cos(np.angle(tones[0])))
        yield line(heard, "polarity against the command", name, polarity, 0.0, 1.0, "")
        yield line(heard, "gain", name, abs(tones[0]), *GAIN, "")
        driven = np.flatnonzero(at <= heard.profile.sweep.stop_hz * (1 + 1e-9))
        if driven.size > 1:
            top = abs(tones[driven[-1]])
            yield line(heard, "gain at the highest frequency", name, top, *TOP_GAIN, "")
        if driven.size > 2:
            off = 100.0 * _residual(at[driven] ** 2, np.log(np.abs(tones[driven])))
            yield line(heard, "gain off a smooth curve", name, off, 0.0, SMOOTH, "%")
        delays = -1e3 * unwrapped(tones * np.sign(polarity), at) / (2 * math.pi * at)
        late = delays[np.argmax(np.abs(delays))]
        yield line(heard, "delay", name, late, *DELAY_MS, "ms")
        if at.size > 1:
            most = max(DELAY_SPREAD_MS, DELAY_SPREAD * abs(float(delays.mean())))
            spread = float(np.ptp(delays))
            yield line(heard, "delay over the frequencies", name, spread, 0.0, most, "ms")


def _seen(heard: Heard, *names: str) -> bool:
    """True where each of these channels has a clear tone and lost none of them altogether."""
    return heard.has(*names) and all(
        heard.clear(name) > CLEAR and bool(np.isfinite(heard.tones(name)).all()) for name in names
    )


def _residual(z: Float1D, values: Float1D) -> float:
    """Largest distance of values from their straight line over z."""
    return float(np.abs(np.polyval(np.polyfit(z, values, 1), z) - values).max())


def unwrapped(tones: Complex1D, frequencies_hz: Float1D) -> Float1D:
    """Phase in rad, (hold,), each on the branch nearest to the delay of the one below it."""
    phase = np.angle(tones)
    for k in range(1, phase.size):
        expected = phase[k - 1] * frequencies_hz[k] / frequencies_hz[k - 1]
        if math.isfinite(expected - phase[k]):
            phase[k] += 2 * math.pi * round((expected - phase[k]) / (2 * math.pi))
    return phase


def mass(heard: Heard) -> Iterator[Check]:
    """Polarity of the mass's sensors, without knowing the specimen."""
    for name in filter(heard.has, MASS):
        sine = lag(heard, name)
        if sine is not None:
            yield line(heard, "polarity, lag behind the table", name, sine, 0.0, 1.0, "")


def lag(heard: Heard, name: str) -> float | None:
    """Sine of the lag of the mass behind the table, at the lowest frequency where both are clear.

    Work flows from the table into a passive specimen, so its acceleration lags that of the table by
    0 to 180 degrees: the sine is positive. Where the lag is near 0 or 180 degrees, a mass that
    moves as much as the table moves with it, one that moves less is isolated and moves against it:
    then 1 if that is so, -1 if not. (Just above the resonance of a specimen with a few per cent of
    damping that is wrong: check it at a lower frequency.)
    """
    if not _seen(heard, "table_acc_m_s2"):
        return None
    tones = heard.tones(name)
    seen = np.flatnonzero(np.abs(tones) > CLEAR * heard.errors(name))
    if not seen.size:
        return None
    table = heard.tones("table_acc_m_s2")
    # The table's own polarity has its own line.
    tone = complex(tones[seen[0]] / table[seen[0]]) * float(np.sign(table[0].real))
    sine, moves = -tone.imag / abs(tone), abs(tones[seen[0]])
    if sine > LAGS or sine < LEADS:
        return sine
    right = moves > IN_PHASE if tone.real > 0 else moves < AGAINST
    return 1.0 if right else -1.0


def consistent(heard: Heard) -> Iterator[Check]:
    """Second derivative of every displacement against the acceleration that belongs to it.

    One number for gain, sign, unit and time: |ratio - 1| of the weak form, the worst of the
    frequencies at which noise lets them be compared. The specimen may do what it likes meanwhile.
    """
    pairs = (
        ("table_disp_m", (), "table_acc_m_s2"),
        ("mass_disp_m", (), "mass_acc_m_s2"),
        ("rel_disp_m", ("table_disp_m",), "mass_acc_m_s2"),
    )
    for displacement, added, acceleration in pairs:
        if not _seen(heard, displacement, *added, acceleration):
            continue
        found = []
        for hold in heard.holds:
            window = heard.window(hold)
            x = sum((window.channel(one) for one in added), window.channel(displacement))
            error, scatter = mismatch(
                (x, math.hypot(*map(heard.noise, (displacement, *added)))),
                (window.channel(acceleration), heard.noise(acceleration)),
                heard.phase(window),
                2 * math.pi * hold.f0,
                heard.block.rate_hz,
            )
            if scatter <= KNOWN:
                found.append(100.0 * error)
        if found:
            name = f"second derivative against {acceleration}"
            yield line(heard, name, displacement, max(found), 0.0, MATCH, "%")


def noise(heard: Heard) -> Iterator[Check]:
    """Noise at rest: 20 dB under the test's level, at every frequency of it.

    So displacements are held against the smallest amplitude, that at the end of the sweep; a load
    cell against a fifth of the force that counts as contact.
    """
    full = heard.level
    smallest = full / (2 * math.pi * heard.profile.sweep.stop_hz) ** 2
    for name in filter(heard.has, MOVING):
        amplitude = smallest if BY_NAME[name].unit == "m" else full
        under = 20.0 * math.log10(amplitude / math.sqrt(2.0) / heard.noise(name))
        yield line(heard, "noise under the level", name, under, UNDER_DB, math.inf, "dB")
    for name in filter(heard.has, RIGHT_CELLS + LEFT_CELLS):
        most = heard.profile.comparison.contact_n / 5.0
        yield line(heard, "noise", name, heard.noise(name), 0.0, most, "N")


def at_rest(heard: Heard) -> Iterator[Check]:
    """What the sensors show where nothing should move: their offset before, motion after.

    Bumpers pressed in by a negative gap may shift the mass, so its position is not judged then; nor
    is how long it rings.
    """
    full, sweep = heard.level, heard.profile.sweep
    least_gap = min(heard.profile.specimen.gaps_m)
    largest = full / (2 * math.pi * sweep.start_hz) ** 2
    largest = min(largest, least_gap) if least_gap > 0 else largest
    for name in filter(heard.has, MOVING):
        length = BY_NAME[name].unit == "m"
        unit, amplitude = ("m", largest) if length else ("m/s2", full)
        rms = heard.noise(name)
        if not (length and name not in TABLE and least_gap <= 0):
            most = max(OFFSET * amplitude, 4.0 * rms)
            yield line(heard, "offset", name, mean(heard.before.channel(name)), -most, most, unit)
        left = _rms(heard.after.channel(name) - mean(heard.after.channel(name)))
        most = STILL * amplitude / math.sqrt(2.0) + STILL_NOISE * rms
        most = most if name in TABLE else math.inf
        yield line(heard, "motion left after the check", name, left, 0.0, most, unit)


def _rms(values: Float1D) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def mean(values: Float1D) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else math.nan
