/* Target side of the UDP packets in PACKETS.md; interface in target.h.
 * States: free, claimed, running, ending, free. */
#include "target.h"

#include "bytes.h"
#include "landing.h"

#include <math.h>

enum { BEAT = 1, CLAIM, QUEUE, START, RELEASE };
enum { FREE, CLAIMED, RUNNING, ENDING };
enum { NONE, BUSY, WRONG_RATE, WRONG_CHANNELS, SILENCE, RELEASED, SWITCHED_OFF };
enum { ARRIVING, PLAYS, LATE, NONSENSE };
enum { RIG_HEADER_BYTES = 64, TARGET_HEADER_BYTES = 144 };
enum { MAX_RESENT_SAMPLES = 16 * (VALUES_PER_PACKET / CHANNELS) };

static const double rates[] = RATES;

static struct {
    int phase, reason;
    uint64_t session, ended;          /* present session; previous one */
    struct peer rig, stranger;
    int stranger_waits, stranger_reason;
    uint32_t sequence, heard, ignored, missed;
    double rate_hz;
    int64_t taken, sent;              /* samples */
    int64_t again_from, again_to;     /* to be resent */
    int64_t silence, quiet, beats;    /* samples since last received, last sent, power-on */
    int answer;
    uint32_t queue, verdict, samples; /* newest queue and its status */
    uint32_t pieces;                  /* of it, still missing */
    uint8_t arrived[RING_SAMPLES / VALUES_PER_PACKET / 8];
    int64_t end;                      /* sample from which the last value is held */
    int64_t landing, rest_from;       /* first sample of a stop, -1: none; of rest */
    struct landing home;
} t;

static double ring[RING_SAMPLES], staged[RING_SAMPLES], history[HISTORY_SAMPLES][CHANNELS];

/* ---- command ---- */

static double command(int64_t index) {
    if (index < 0) return 0.0;
    if (index < t.end) return ring[index % RING_SAMPLES];
    if (t.landing < 0 || index < t.landing)
        return t.end > 0 ? ring[(t.end - 1) % RING_SAMPLES] : 0.0;
    double s = fmin((double)(index - t.landing + 1) / t.rate_hz, t.home.seconds);
    if (s >= t.home.seconds) return 0.0;
    return within_span(landing_at(&t.home, s));
}

/* Plan the smooth stop of landing.h from sample `first` on. */
static void land(int64_t first, double x, double v, double a) {
    land_from(&t.home, x, v, a);
    t.landing = first;
    t.rest_from = first + (int64_t)ceil(t.home.seconds * t.rate_hz);
}

/* Replace everything from sample `index` on by the complete queue; return the verdict. */
static uint32_t commit(int64_t index) {
    int64_t last = t.samples, first = t.end;
    int64_t played = t.phase == RUNNING ? t.taken : 0; /* before the start, 0 V */
    /* the last 3 samples played are kept in the ring */
    int64_t room = t.phase == RUNNING ? t.taken + RING_SAMPLES - 4 : RING_SAMPLES;
    for (uint32_t k = 0; k < t.samples; k++)
        if (!(fabs(staged[k]) <= SPAN_V * (1.0 + 1e-9))) return NONSENSE; /* also if NaN */
    if (index < 0 || index > room - last) return NONSENSE;
    last += index;
    if (t.phase == RUNNING && index < t.taken + LEAST_AHEAD) return LATE;
    if (first < played - 3) first = played - 3;
    for (int64_t i = first; i < index; i++) ring[i % RING_SAMPLES] = command(i);
    for (uint32_t k = 0; k < t.samples; k++) ring[(index + k) % RING_SAMPLES] = staged[k];
    t.end = t.rest_from = last;
    t.landing = -1;
    double x = command(last - 1), y = command(last - 2), z = command(last - 3), r = t.rate_hz;
    if (fabs(x - y) * r * r * METRES_PER_VOLT > 0.02) { /* it ends in motion */
        double a = (x - 2.0 * y + z) * r * r;
        land(last, x, (x - y) * r + a / (2.0 * r), a);
    }
    return PLAYS;
}

static void end(int reason) {
    t.reason = reason;
    t.answer = 1;
    if (t.phase == RUNNING) {
        double held = t.end > 0 ? ring[(t.end - 1) % RING_SAMPLES] : 0.0;
        if (t.landing < 0 && fabs(held) * METRES_PER_VOLT > 1e-6) { /* held away from its mean */
            int64_t first = t.taken + LEAST_AHEAD;
            land(first > t.end ? first : t.end, held, 0.0, 0.0);
        }
    } else {
        t.rest_from = t.taken - (int64_t)(SETTLED_S * t.rate_hz); /* the table has not moved */
    }
    t.phase = ENDING;
}

/* ---- packets from the rig ---- */

static void reply_to_stranger(struct peer from, int reason) {
    t.stranger = from;
    t.stranger_reason = reason;
    t.stranger_waits = 1;
}

static void hear_claim(const uint8_t *p, struct peer from) {
    double rate_hz = get_double(p + RIG_HEADER_BYTES);
    double channels = get_double(p + RIG_HEADER_BYTES + 8);
    int known = 0;
    for (size_t k = 0; k < sizeof rates / sizeof *rates; k++) known |= rates[k] == rate_hz;
    if (!known || channels != CHANNELS) {
        reply_to_stranger(from, known ? WRONG_CHANNELS : WRONG_RATE);
        return;
    }
    t.phase = CLAIMED;
    t.reason = NONE;
    t.session = get(p + 8, 8);
    t.rig = from;
    t.heard = (uint32_t)get(p + 16, 4);
    t.rate_hz = rate_hz;
    t.taken = t.sent = t.again_from = t.again_to = t.silence = t.end = t.rest_from = 0;
    t.missed = t.queue = 0;
    t.verdict = PLAYS;
    t.landing = -1;
    t.answer = 1;
}

static void hear_queue(const uint8_t *p) {
    uint32_t count = (uint32_t)get(p + 20, 4), number = (uint32_t)get(p + 32, 4);
    uint32_t piece = (uint32_t)get(p + 36, 4), samples = (uint32_t)get(p + 40, 4);
    if (samples > RING_SAMPLES || piece >= RING_SAMPLES / VALUES_PER_PACKET) return;
    if (piece * VALUES_PER_PACKET >= samples) return;
    uint32_t left = samples - piece * VALUES_PER_PACKET;
    if (count != (left < VALUES_PER_PACKET ? left : VALUES_PER_PACKET)) return;
    if (number > t.queue) {
        t.queue = number;
        t.verdict = ARRIVING;
        t.samples = samples;
        t.pieces = (samples + VALUES_PER_PACKET - 1) / VALUES_PER_PACKET;
        memset(t.arrived, 0, sizeof t.arrived);
    }
    if (number != t.queue || t.verdict != ARRIVING || samples != t.samples) return;
    if (t.arrived[piece / 8] >> piece % 8 & 1) return;
    t.arrived[piece / 8] |= (uint8_t)(1 << piece % 8);
    for (uint32_t k = 0; k < count; k++)
        staged[piece * VALUES_PER_PACKET + k] = get_double(p + RIG_HEADER_BYTES + 8 * k);
    if (--t.pieces == 0) t.verdict = commit((int64_t)get(p + 24, 8));
}

int target_hear(const uint8_t *p, size_t bytes, struct peer from) {
    int kind = 0, starts = 0;
    if (bytes == RIG_PACKET_BYTES && memcmp(p, "STUR\1\0", 6) == 0 &&
        get(p + bytes - 4, 4) == crc32(p, bytes - 4) && get(p + 20, 4) <= VALUES_PER_PACKET)
        kind = (int)get(p + 6, 2);
    if (kind < BEAT || kind > RELEASE) {
        t.ignored++;
        return 0;
    }
    uint64_t session = get(p + 8, 8);
    uint32_t sequence = (uint32_t)get(p + 16, 4);
    int64_t from_sample = (int64_t)get(p + 48, 8), to_sample = (int64_t)get(p + 56, 8);
    if (t.phase == FREE && kind == CLAIM && session != 0 && session != t.ended) {
        hear_claim(p, from);
        return 0;
    }
    if (t.phase == FREE || session != t.session || from.host != t.rig.host ||
        from.port != t.rig.port) {
        t.ignored += session != 0;
        reply_to_stranger(from, t.phase == CLAIMED || t.phase == RUNNING ? BUSY : t.reason);
        return 0;
    }
    if ((int32_t)(sequence - t.heard) > 0) { /* an old packet is no sign of life */
        t.missed += sequence - t.heard - 1;
        t.heard = sequence;
        t.silence = 0;
    }
    if (t.phase == ENDING) return 0;
    if (kind == QUEUE) hear_queue(p);
    if (kind == RELEASE) end(RELEASED);
    if (kind == START && t.phase == CLAIMED) {
        t.phase = RUNNING;
        t.taken = t.sent = t.again_from = t.again_to = 0;
        starts = 1;
    }
    if (to_sample == 0) {
        t.answer = 1;
    } else if (from_sample < to_sample && from_sample >= 0) {
        t.again_from = from_sample;
        t.again_to = to_sample < t.sent ? to_sample : t.sent;
        if (t.again_to - from_sample > MAX_RESENT_SAMPLES)
            t.again_to = from_sample + MAX_RESENT_SAMPLES;
    }
    return starts;
}

/* ---- each sample ---- */

void target_sample(void) {
    write_heartbeat((int)((int64_t)((double)t.beats++ * 20.0 / t.rate_hz) & 1));
    if (t.phase == FREE) return;
    double *row = history[t.taken % HISTORY_SAMPLES];
    write_output(t.phase == CLAIMED ? 0.0 : within_span(command(t.taken)));
    if (!read_inputs(row))
        for (int k = 0; k < CHANNELS; k++) row[k] = NAN;
    t.taken++;
    t.quiet++;
    t.silence++;
    if (t.phase == RUNNING && (double)t.silence > HEARTBEAT_TIMEOUT_S * t.rate_hz) end(SILENCE);
    if (t.phase == CLAIMED && (double)t.silence > IDLE_S * t.rate_hz) end(SILENCE);
}

/* ---- packets to the rig ---- */

static void write_state(uint8_t *p, uint64_t session, int reason, int64_t first, int64_t count) {
    uint8_t *at = p + 4;
    int64_t oldest = t.taken > HISTORY_SAMPLES ? t.taken - HISTORY_SAMPLES : 0;
    memset(p, 0, TARGET_PACKET_BYTES);
    memcpy(p, "STUT", 4);
    at = put(put(put(at, 1, 2), (uint64_t)t.phase, 1), (uint64_t)reason, 1);
    at = put(put(put(at, session, 8), ++t.sequence, 4), (uint64_t)count * CHANNELS, 4);
    at = put(put(put(at, (uint64_t)first, 8), (uint64_t)t.taken, 8), (uint64_t)oldest, 8);
    at = put(put(put(at, t.queue, 4), t.verdict, 4), CHANNELS, 4);
    at = put(put(put(at, LEAST_AHEAD, 4), t.ignored, 4), t.missed, 4);
    memcpy(put_double(at, t.rate_hz), t.arrived, sizeof t.arrived);
    at = p + TARGET_HEADER_BYTES;
    for (int64_t i = first; i < first + count; i++)
        for (int k = 0; k < CHANNELS; k++) at = put_double(at, history[i % HISTORY_SAMPLES][k]);
    put(p + TARGET_PACKET_BYTES - 4, crc32(p, TARGET_PACKET_BYTES - 4), 4);
}

/* Write samples first .. last - 1, as many as fit; return the next sample to send. */
static int64_t write_samples(uint8_t *p, int64_t first, int64_t last) {
    int64_t oldest = t.taken - HISTORY_SAMPLES, most = VALUES_PER_PACKET / CHANNELS;
    if (first < oldest) first = oldest;
    if (last - first < most) most = last - first;
    write_state(p, t.session, t.reason, first, most > 0 ? most : 0);
    t.quiet = t.answer = 0;
    return most > 0 ? first + most : last;
}

int target_packet(uint8_t p[TARGET_PACKET_BYTES], struct peer *to) {
    int held = t.phase == CLAIMED || t.phase == RUNNING;
    if (t.stranger_waits) {
        t.stranger_waits = 0;
        *to = t.stranger;
        write_state(p, 0, t.stranger_reason, 0, 0);
        return 1;
    }
    if (t.phase == FREE) return 0;
    *to = t.rig;
    if (held && ((double)(t.taken - t.sent) >= 0.002 * t.rate_hz || (t.answer && t.sent < t.taken))) {
        t.sent = write_samples(p, t.sent, t.taken);
        return 1;
    }
    if (held && t.again_from < t.again_to) {
        t.again_from = write_samples(p, t.again_from, t.again_to);
        return 1;
    }
    if (t.answer || (double)t.quiet >= 0.02 * t.rate_hz) {
        write_samples(p, 0, 0);
        return 1;
    }
    if (t.phase == ENDING && (double)(t.taken - t.rest_from) >= SETTLED_S * t.rate_hz) {
        t.phase = FREE;
        t.reason = NONE;
        t.ended = t.session;
        t.session = 0;
    }
    return 0;
}

void target_init(void) {
    memset(&t, 0, sizeof t);
    t.rate_hz = rates[0];
    t.landing = -1;
}

double target_rate_hz(void) { return t.rate_hz; }

int target_is_free(void) { return t.phase == FREE; }

void target_switch_off(void) {
    if (t.phase == CLAIMED || t.phase == RUNNING) end(SWITCHED_OFF);
}
