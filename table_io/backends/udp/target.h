/* The far side of our UDP packets (PACKETS.md), to be carried to dSPACE, Speedgoat, LabVIEW-RT or a
 * PLC. target.c has no memory but its own, no call of an operating system, no clock: time is counted
 * in samples. One task calls everything, each sample period:
 *
 *     while (a packet lies there)            target_hear(packet, bytes, from);
 *     target_sample();                       (plays one sample, takes one sample)
 *     while (target_packet(packet, &to))     send it;
 */
#ifndef TARGET_H
#define TARGET_H

#include <stddef.h>
#include <stdint.h>

/* ---- what to change for your table ---- */
#define CHANNELS 9            /* of [[sensors]] in the machine card, in its order; at most 128 */
#define RATES {2000.0, 1000.0, 4000.0} /* Hz that your task can run at; the first at power-on */
#define METRES_PER_VOLT 0.006 /* [output] span_mm / span_v / 1000, for the landing */
#define SPAN_V 10.0           /* [output] span_v: more is neither taken nor played */
#define LEAST_AHEAD 4         /* samples after the newest one that cannot be replaced any more */
#define SETTLED_S 0.3         /* that your table needs to stand still after its command does */

/* ---- fixed by the protocol ---- */
#define VALUES 128            /* float64 in a packet */
#define RING 65536            /* samples of command ahead; a power of two */
#define HISTORY 8192          /* samples that can be sent again; a power of two */
#define WORD_BYTES 1092       /* of a packet of the rig */
#define STATE_BYTES 1172      /* of a packet of the target */
#define HEARTBEAT_S 0.3       /* without a word of the rig: it is dead */
#define IDLE_S 30.0           /* the same where nothing moves */

struct peer {
    uint32_t host;
    uint16_t port;
};

/* ---- yours to write ---- */
int read_inputs(double volts[CHANNELS]); /* all channels, the command wired back too; 0: lost */
void write_output(double volts);         /* the command, to the converter; 0 V is the mean */
void write_heartbeat(int level);         /* the 10 Hz line to the interlock: see CONNECT.md */

/* ---- yours to call ---- */
void target_init(void);
int target_hear(const uint8_t *packet, size_t bytes, struct peer from); /* 1: sample 0 is next */
void target_sample(void);
int target_packet(uint8_t packet[STATE_BYTES], struct peer *to); /* 0: nothing more to send */
double target_rate_hz(void);
void target_switch_off(void); /* end: it plays what is queued, to rest */
int target_is_free(void);

#endif
