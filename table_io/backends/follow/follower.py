"""What a follower knows: nothing yet, where the controller is in the drive, or that it left it.

A follower is a value, and looks at chunks that end at fixed samples: however the same samples are
cut into blocks, it says the same of each. A place is the drive index of a measured sample; before
the drive is found all samples are at rest, and they are told of HOLD_S late, for a soft start is
seen after it began.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from table_io.backends.follow.alignment import Fit, Plan, astray, begins, followed, found
from table_io.block import Float1D, Int1D

CHUNK_S = 0.25
HOLD_S = 1.5  # that a soft start may go unseen
LOOK_S, LAST_LOOK_S = 1.0, 3.0  # of motion: the first try to find it in the drive, and the last
SURE = 0.05  # of a sample: known so well, the drive is found before the last look
ALIKE = 0.9  # correlation below which it is another drive
LEFT = 0.3  # of the drive's amplitude, beside it: it is not this drive any more
MOST_PPM = 500.0  # no clock runs so wrong: what drags the place along is not the drive
SIGMAS, STEPS = 6.0, 4.0  # beyond the noise, beyond steps of the converter
REST = -1  # place of a sample before the drive
QUIET_S = 0.4  # in which no motion of a stepped sine is still


@dataclass(frozen=True, eq=False)
class Follower:
    """State before sample `end`; `heard` is the command in m from sample `first` on."""

    plan: Plan
    rate_hz: float
    sigma_m: float  # noise of the command at rest
    lsb_m: float  # of its read-back
    state: str = "waiting"  # playing, left, other
    fit: Fit | None = None
    clean: Fit | None = None  # after the last chunk with nothing but noise beside the drive
    why: str = ""  # what is played is not the drive
    left_at: int = 0  # sample from which it was not
    beside_m: tuple[float, float] = (0.0, 0.0)  # by how much, and what is allowed
    onset: int | None = None  # sample at which motion was seen
    done: int = 0  # samples that were looked at
    first: int = 0
    heard: Float1D = field(default_factory=lambda: np.empty(0))
    places: Int1D = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    given: int = 0  # samples whose places were taken

    @property
    def end(self) -> int:
        return self.first + self.heard.size

    @property
    def chunk(self) -> int:
        return round(CHUNK_S * self.rate_hz)

    @property
    def threshold_m(self) -> float:
        """A command beyond this moves."""
        return SIGMAS * self.sigma_m + STEPS * self.lsb_m

    @property
    def told(self) -> int:
        """Samples whose place is known."""
        return self.given + self.places.size

    @property
    def quiet(self) -> bool:
        """True where the command has been still for QUIET_S."""
        last = self.heard[-round(QUIET_S * self.rate_hz) :]
        known = last[~np.isnan(last)]
        if last.size < QUIET_S * self.rate_hz:
            return False
        return not known.size or float(np.ptp(known)) <= 2.0 * self.threshold_m

    @property
    def still(self) -> bool:
        """True where the command rests, and does so however the controller goes on.

        A drive that is searched for moves, and one that is played rests in between too.
        """
        if self.state == "waiting":
            return self.onset is None
        if self.state == "playing" and self.fit is not None:
            place = float(self.fit.at(np.array([self.done]))[0])
            return self.quiet and place >= self.plan.rest_from
        return self.quiet


def advance(now: Follower, command_m: Float1D) -> Follower:
    """The follower after more samples of the measured command, (sample,); NaN where lost."""
    now = replace(now, heard=np.concatenate([now.heard, command_m]))
    while now.end - now.done >= now.chunk:
        now = _looked(now)
    keep = round((HOLD_S + LAST_LOOK_S) * now.rate_hz) + 2 * now.chunk
    drop = max(now.heard.size - keep, 0)
    return replace(now, heard=now.heard[drop:], first=now.first + drop)


def taken(now: Follower, count: int) -> tuple[Follower, Int1D]:
    """(the follower, places of the next `count` samples); ValueError where they are not told."""
    if now.given + count > now.told:
        raise ValueError(f"the places are told up to sample {now.told}, not {now.given + count}")
    rest = replace(now, places=now.places[count:], given=now.given + count)
    return rest, now.places[:count]


def ended(now: Follower) -> Follower:
    """The follower that tells of every sample that it has heard: there will be no more."""
    return _placed(now, now.end)


def _looked(now: Follower) -> Follower:
    """The follower after its next chunk."""
    first, edge = now.done, now.done + now.chunk
    chunk = now.heard[first - now.first : edge - now.first]
    now = replace(now, done=edge)
    if now.state == "waiting":
        return _waited(now, first, chunk)
    if now.state == "playing":
        fit = now.fit
        assert fit is not None
        off, swing = astray(fit, now.plan, first, chunk, now.rate_hz)
        limit = LEFT * swing + SIGMAS * max(fit.noise, now.sigma_m) + STEPS * now.lsb_m
        after = followed(fit, now.plan, first, chunk, now.rate_hz)
        why, beside = _wrong(after), (off, limit)
        if off > limit:
            why = (
                f"the command is {off * 1e3:.3g} mm (rms) off the drive from sample {first} on; "
                f"allowed: {limit * 1e3:.3g} mm"
            )
        elif abs(after.ppm) > MOST_PPM:
            why = (
                f"the command is {off * 1e3:.3g} mm (rms) off the drive from sample {first} on, "
                f"and goes through it at {after.ppm:+.0f} ppm; allowed: {MOST_PPM:g} ppm"
            )
        elif abs(after.gain - 1.0) > LEFT and swing > 0.0:
            whole = swing / abs(fit.gain)
            beside = abs(after.gain - 1.0) * whole, LEFT * whole
        if why:
            last = now.clean or fit  # the later ones were dragged along
            now = replace(now, state="left", why=why, left_at=first, beside_m=beside, fit=last)
        else:
            noise = SIGMAS * max(fit.noise, now.sigma_m) + STEPS * now.lsb_m
            now = replace(now, fit=after, clean=after if off <= noise else now.clean)
    return _placed(now, edge + now.chunk)


def _waited(now: Follower, first: int, chunk: Float1D) -> Follower:
    """A chunk while the drive is waited for."""
    if now.onset is None:
        middle = np.median([chunk[:-2], chunk[1:-1], chunk[2:]], axis=0)  # one spike is no motion
        moving = np.flatnonzero(np.abs(middle - _level(now)) > now.threshold_m)
        if not moving.size:
            return _placed(now, now.done - round(HOLD_S * now.rate_hz))
        now = replace(now, onset=first + 1 + int(moving[0]))
    assert now.onset is not None
    seen_s = (now.done - now.onset) / now.rate_hz
    if seen_s < LOOK_S:
        return now
    start = max(now.first, now.onset - round(HOLD_S * now.rate_hz))
    heard = now.heard[start - now.first : now.done - now.first]
    guess = begins(now.plan, now.threshold_m, now.rate_hz) - now.onset
    fit = found(now.plan, start, heard, guess, now.rate_hz, now.lsb_m)
    good = fit is not None and fit.correlation >= ALIKE
    wrong = _wrong(fit) if fit is not None and good else ""
    ours = fit if good and not wrong else None
    if ours is not None and (ours.sd(ours.pivot) <= SURE or seen_s >= LAST_LOOK_S):
        playing = replace(now, state="playing", fit=ours, clean=ours)
        return _placed(playing, now.done + now.chunk)
    if seen_s < LAST_LOOK_S:
        return now
    correlation = fit.correlation if fit is not None else 0.0
    why = f"what moves since sample {now.onset} is not this drive (correlation {correlation:.2f})"
    if correlation <= -ALIKE:
        why = f"the drive is played with the other sign (correlation {correlation:.2f})"
    why = wrong or why
    now = replace(now, state="other", why=why, left_at=now.onset)
    return _placed(now, now.done + now.chunk)


def _wrong(fit: Fit) -> str:
    """Why what fits is still not the drive: its amplitude; empty where it is."""
    if abs(fit.gain - 1.0) > LEFT + 3.0 * fit.covariance[2, 2] ** 0.5:
        return (
            f"the amplitude is {fit.gain:.3g} of the drive's; allowed: {1.0 - LEFT:.2g} to "
            f"{1.0 + LEFT:.2g}"
        )
    return ""


def _level(now: Follower) -> float:
    """The command at rest, m: the median of what was heard before."""
    before = now.heard[: max(now.done - now.chunk - now.first, round(0.1 * now.rate_hz))]
    known = before[~np.isnan(before)]
    return float(np.median(known)) if known.size else 0.0


def _placed(now: Follower, until: int) -> Follower:
    """The follower that tells the places of the samples before `until`."""
    index = np.arange(now.told, until)
    if not index.size:
        return now
    if now.fit is None:
        places = np.full(index.size, REST)
    else:
        places = np.rint(now.fit.at(index)).astype(np.int64)
        if now.places.size:  # a better fit never goes back in the drive
            places = np.maximum(places, now.places[-1])
    return replace(now, places=np.concatenate([now.places, places]))
