/* Target side of the UDP packets in PACKETS.md, for porting to dSPACE, Speedgoat, LabVIEW-RT or a
 * PLC. target.c needs no memory allocation, operating system or clock: time is counted in samples.
 * One task calls everything, once per sample period:
 *
 *     while (a packet is waiting)            target_hear(packet, bytes, from);
 *     target_sample();                       (plays one sample, takes one sample)
 *     while (target_packet(packet, &to))     send it;
 */
#ifndef TARGET_H
#define TARGET_H

#include <stddef.h>
#include <stdint.h>

/* ---- change these for your table ---- */
#define CHANNELS 9            /* [[sensors]] of the rig file, in its order; at most 128 */
#define RATES {2000.0, 1000.0, 4000.0} /* Hz, rates of your task; the first at power-on */
#define METRES_PER_VOLT 0.006 /* [output] span_mm / span_v / 1000, for the smooth stop */
#define SPAN_V 10.0           /* [output] span_v: a larger command is refused */
#define LEAST_AHEAD 4         /* samples after the newest one that cannot be replaced */
#define SETTLED_S 0.3         /* for your table to come to rest after its command */

/* ---- fixed by the protocol ---- */
#define VALUES_PER_PACKET 128    /* float64 in a packet */
#define RING_SAMPLES 65536       /* samples of command; a power of two */
#define HISTORY_SAMPLES 8192     /* samples that can be resent; a power of two */
#define RIG_PACKET_BYTES 1092    /* length of a packet from the rig */
#define TARGET_PACKET_BYTES 1172 /* length of a packet to the rig */
#define HEARTBEAT_TIMEOUT_S 0.3  /* silence after which the rig is assumed dead */
#define IDLE_S 30.0              /* the same while nothing moves */

struct peer {
    uint32_t host;
    uint16_t port;
};

/* ---- write these functions ---- */
int read_inputs(double volts[CHANNELS]); /* all channels, incl. the command wired back; 0: lost */
void write_output(double volts);         /* the command, to the converter; 0 V is the mean */
void write_heartbeat(int level);         /* the 10 Hz line to the interlock: see CONNECT.md */

/* ---- call these functions ---- */
void target_init(void);
int target_hear(const uint8_t *packet, size_t bytes, struct peer from); /* 1: next is sample 0 */
void target_sample(void);
int target_packet(uint8_t packet[TARGET_PACKET_BYTES], struct peer *to); /* 0: nothing to send */
double target_rate_hz(void);
void target_switch_off(void); /* drop the rig; the queued command plays to rest */
int target_is_free(void);

#endif
