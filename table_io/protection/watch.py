"""What is watched at every sample: limits, broken sensors, the command and the table against it.

One compiled pass moves from sample to sample, so the cut into blocks changes nothing. Limits are
judged on the median of the three newest samples: an electric spike of one sample is no motion, and
a real excess is seen one sample late.
"""

import math

from numba import njit

# What the pass can find.
STROKE, VELOCITY, ACCELERATION, FORCE, RAIL, LOST, BLIND = range(7)
STUCK, SILENT, SPIKE, REPEATED, COMMAND, FOLLOWING, DROPPED = range(7, 14)
CODES = 14
# Rows of what is remembered of each channel, and places of what is remembered once.
RUN, ORIGIN, MOVED, POWER, REST_POWER, REST_COUNT, LOSSES, AT_RANGE = range(8)
PEAK, TURNED, KEY, BEGUN, GAIN, LAG, BEHIND, SAMES, OFF, ASTRAY, MARKED, PUSH = range(12)
PER, ONCE = 8, 12
UNKNOWN = -1.0  # lag of a table that has not been looked at yet
CHECKING = -1.0  # key of a loop check
SWEEPING = 1.0  # BEGUN from the first step on; before it only what is grossly wrong stops
HALF, OTHER = 1, 2  # marks: half a cycle is complete, another motion begins


@njit(cache=True, nogil=True)
def _median(row, i):  # type: ignore[no-untyped-def]
    """Median of the samples i - 2 .. i; NaN where one of them is."""
    a, b, c = row[i - 2], row[i - 1], row[i]
    if math.isnan(a) or math.isnan(b) or math.isnan(c):
        return math.nan
    return max(min(a, b), min(max(a, b), c))


@njit(cache=True, nogil=True)
def _tell(memory, found, count, index, code, channel, value, limit, law):  # type: ignore[no-untyped-def]
    """Notes a finding, once an episode; how many there are now."""
    before = memory.told[code, channel]
    memory.told[code, channel] = index
    if index - before <= law.episode or count == found.shape[0]:
        return count
    found[count, 0], found[count, 1], found[count, 2] = index, code, channel
    found[count, 3], found[count, 4] = value, limit
    return count + 1


@njit(cache=True, nogil=True)
def _delivered(values, railed, i, index, repeated, law, memory, found, count):  # type: ignore[no-untyped-def]
    """Samples that are no measurement: at their sensor's range, lost, or old ones once more."""
    per, dropped = memory.per, True
    for c in range(values.shape[0]):
        dropped = dropped and math.isnan(values[c, i])
    if dropped:
        count = _tell(memory, found, count, index, DROPPED, law.drive, math.nan, 0.0, law)
    for c in range(values.shape[0]):
        x = values[c, i]
        per[AT_RANGE, c] = per[AT_RANGE, c] + 1.0 if railed[c] else 0.0
        if per[AT_RANGE, c] >= law.railed:
            count = _tell(memory, found, count, index, RAIL, c, x, law.full[c], law)
        lost = math.isnan(x)
        if lost and not dropped:
            count = _tell(memory, found, count, index, LOST, c, x, 0.0, law)
        per[LOSSES, c] = max(per[LOSSES, c] + (1.0 if lost or repeated else -law.leak), 0.0)
        if per[LOSSES, c] > law.blind:
            lost_s, most_s = per[LOSSES, c] / law.rate, law.blind / law.rate
            count = _tell(memory, found, count, index, BLIND, c, lost_s, most_s, law)
    return count


@njit(cache=True, nogil=True)
def _stuck(values, i, index, command, demanded, law, memory, found, count):  # type: ignore[no-untyped-def]
    """Samples that equal the one before them, once more."""
    per = memory.per
    for c in range(values.shape[0]):
        expected = demanded if c == law.acc else command
        if values[c, i] != values[c, i - 1]:
            per[RUN, c], per[ORIGIN, c], per[MOVED, c] = 1.0, expected, 0.0
            continue
        per[RUN, c] += 1.0
        per[MOVED, c] = max(per[MOVED, c], abs(expected - per[ORIGIN, c]))
        must = per[MOVED, c] >= law.moves[c] and per[RUN, c] >= law.must
        if must or per[RUN, c] >= law.stuck[c]:
            run, limit = per[RUN, c], min(law.stuck[c], per[RUN, c])
            count = _tell(memory, found, count, index, STUCK, c, run, limit, law)
    return count


@njit(cache=True, nogil=True)
def _silent(values, i, index, law, memory, found, count):  # type: ignore[no-untyped-def]
    """The noise in second differences, against that at rest before the first motion."""
    per = memory.per
    for c in range(values.shape[0]):
        power = (values[c, i] - 2.0 * values[c, i - 1] + values[c, i - 2]) ** 2
        if math.isnan(power):
            continue
        if memory.one[BEGUN] == 0.0:
            per[REST_POWER, c] += power
            per[REST_COUNT, c] += 1.0
        if not law.noisy[c] or per[REST_COUNT, c] < law.rest_enough:
            continue
        rest = per[REST_POWER, c] / per[REST_COUNT, c]
        if per[POWER, c] == 0.0:
            per[POWER, c] = rest
        per[POWER, c] += (min(power, law.loudest * rest) - per[POWER, c]) / law.quiet_samples
        if per[POWER, c] < law.quiet * rest:
            # The second difference of white noise has six times its power.
            value, limit = math.sqrt(per[POWER, c] / 6.0), math.sqrt(law.quiet * rest / 6.0)
            count = _tell(memory, found, count, index, SILENT, c, value, limit, law)
    return count


@njit(cache=True, nogil=True)
def _spikes(values, i, index, law, memory, found, count):  # type: ignore[no-untyped-def]
    """A sample i - 1 off both its neighbours in one channel alone: what is real shows in others."""
    which, off, many = -1, 0.0, 0
    for c in range(values.shape[0]):
        apart = abs(values[c, i - 1] - _median(values[c], i))
        if apart > law.spike[c]:
            which, off, many = c, apart, many + 1
    if many == 1:
        limit = law.spike[which]
        return _tell(memory, found, count, index - 1, SPIKE, which, off, limit, law)
    return count


@njit(cache=True, nogil=True)
def _limits(values, i, index, law, memory, found, count):  # type: ignore[no-untyped-def]
    """Stroke, velocity, acceleration and force of the table."""
    at = _median(values[law.table], i)
    if abs(at) > law.stroke:
        count = _tell(memory, found, count, index, STROKE, law.table, at, law.stroke, law)
    v = (at - _median(values[law.table], i - law.span)) * law.rate / law.span
    if abs(v) > law.velocity:
        count = _tell(memory, found, count, index, VELOCITY, law.table, v, law.velocity, law)
    a = _median(values[law.acc], i)
    if abs(a) > law.acceleration:
        count = _tell(memory, found, count, index, ACCELERATION, law.acc, a, law.acceleration, law)
    force = law.table_kg * a
    if law.mass >= 0:
        on_mass = _median(values[law.mass], i)
        force += 0.0 if math.isnan(on_mass) else law.mass_kg * on_mass
    if abs(force) > law.force:
        count = _tell(memory, found, count, index, FORCE, law.acc, force, law.force, law)
    return count


@njit(cache=True, nogil=True)
def _repeated(values, i, law, one):  # type: ignore[no-untyped-def]
    """True where this sample and those before equal earlier ones in every noisy channel."""
    for back in range(max(int(one[BEHIND]), 1), law.past):
        noisy, same = 0, True
        for c in range(values.shape[0]):
            if law.noisy[c]:
                noisy += 1
                if values[c, i] != values[c, i - back]:
                    same = False
                    break
        if same and noisy >= 2:
            one[SAMES] = one[SAMES] + 1.0 if back == one[BEHIND] else 1.0
            one[BEHIND] = back
            return one[SAMES] >= law.same
    one[BEHIND], one[SAMES] = 0.0, 0.0
    return False


@njit(cache=True, nogil=True)
def _commanded(values, command, i, index, law, memory, found, count):  # type: ignore[no-untyped-def]
    """The command that was read back, and the table, against what was queued."""
    one, before, gross = memory.one, command[i - 1], memory.one[BEGUN] < SWEEPING
    off = _median(values[law.drive], i) - before
    share = law.gross if gross else law.read_gain
    limit = law.read_back + share * one[PEAK] + 2.0 * abs(before - command[i - 2])
    limit += law.rough if gross else 0.0
    one[OFF] = one[OFF] + 1.0 if abs(off) > limit else 0.0
    if one[OFF] >= law.wrong:
        count = _tell(memory, found, count, index, COMMAND, law.drive, off, limit, law)
    astray = _astray(_median(values[law.table], i), command, i, law, one)
    share = law.unseen if one[LAG] == UNKNOWN else law.following
    limit = law.astray + (law.gross if gross else share) * one[PEAK]
    limit += law.rough if gross else _pushed(values, i, law, one)
    one[ASTRAY] = one[ASTRAY] + 1.0 if astray > limit else 0.0
    if one[ASTRAY] >= law.wrong:
        count = _tell(memory, found, count, index, FOLLOWING, law.table, astray, limit, law)
    return count


@njit(cache=True, nogil=True)
def _astray(at, command, i, law, one):  # type: ignore[no-untyped-def]
    """How far the table is from where its command asks it to be, m.

    Until its gain and lag are known it may be anywhere that the command has been lately.
    """
    if one[LAG] == UNKNOWN:
        low, high = command[i - 1], command[i - 1]
        for back in range(2, law.lagging + 1):
            low, high = min(low, command[i - back]), max(high, command[i - back])
        return max(low - at, at - high, 0.0)
    ago = min(one[LAG] * law.rate, law.lagging) + 1.0
    whole = int(ago)
    part = ago - whole
    return abs(at - one[GAIN] * ((1.0 - part) * command[i - whole] + part * command[i - whole - 1]))


@njit(cache=True, nogil=True)
def _pushed(values, i, law, one):  # type: ignore[no-untyped-def]
    """How far the specimen can push the table aside, m: M / m a / p^2, with the pole p = 2 / lag
    of a servo of two equal ones, and a the largest of about the last cycle.
    """
    if law.mass < 0 or one[LAG] == UNKNOWN:
        return 0.0
    a = _median(values[law.mass], i)
    if not math.isnan(a):
        one[PUSH] = max(abs(a), one[PUSH] * (1.0 - 1.0 / law.episode))
    return law.mass_kg / law.table_kg * one[PUSH] * (0.5 * one[LAG]) ** 2


@njit(cache=True, nogil=True)
def _turn(command, phase, i, key, one, law):  # type: ignore[no-untyped-def]
    """HALF where half a cycle is complete, OTHER where another motion begins, 0 elsewhere.

    Keeps the largest command of about the last cycle.
    """
    turned = phase[i] - phase[i - 1]
    turned -= math.floor(turned + 0.5)
    one[PEAK] = max(abs(command[i]), one[PEAK] * math.exp(-max(abs(turned), 1.0 / law.rate)))
    if key != one[KEY]:
        one[KEY], one[TURNED] = key, 0.0
        one[BEGUN] = max(one[BEGUN], SWEEPING if key > 0.0 else 0.5 if key < 0.0 else 0.0)
        return OTHER
    one[TURNED] += turned
    if one[TURNED] >= 0.5:
        one[TURNED] -= 0.5
        return HALF
    return 0


@njit(cache=True, nogil=True)
def watch(  # type: ignore[no-untyped-def]
    values, clipped, command, phase, level, keys, index, start, law, memory, found
):
    """(sample, mark, findings): goes from sample `start` to the end, or to the first mark.

    It stops before the sample that it names, where the mark is not 0; called again from there it
    goes on. values (channel, past + sample), command and phase (past + sample,), clipped (channel,
    sample), level and keys (sample,); `index` is that of the first sample after `past`. Rows of
    `found`: sample, code, channel, value, limit.
    """
    count, one = 0, memory.one
    for k in range(start, keys.size):
        i, now = law.past + k, index + k
        if now != one[MARKED]:
            mark = _turn(command, phase, i, keys[k], one, law)
            if mark:
                one[MARKED] = now
                return k, mark, count
        demanded = level[k] * math.sin(2.0 * math.pi * phase[i])
        repeated = _repeated(values, i, law, one)
        count = _delivered(values, clipped[:, k], i, now, repeated, law, memory, found, count)
        count = _stuck(values, i, now, command[i], demanded, law, memory, found, count)
        count = _silent(values, i, now, law, memory, found, count)
        if repeated:
            back = one[BEHIND] / law.rate
            count = _tell(memory, found, count, now, REPEATED, law.drive, back, 0.0, law)
            one[OFF] = one[ASTRAY] = 0.0
            continue
        count = _spikes(values, i, now, law, memory, found, count)
        count = _limits(values, i, now, law, memory, found, count)
        count = _commanded(values, command, i, now, law, memory, found, count)
    return keys.size, 0, count
