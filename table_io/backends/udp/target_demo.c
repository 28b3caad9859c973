/* Demonstration target for POSIX: a table that follows its command exactly, to test the protocol.
 *
 *     cc -O2 target.c target_demo.c -lm -o target && ./target 127.0.0.1 7460
 *
 * Optional arguments FIRST COUNT: samples of all channels to lose. For your table, rewrite the
 * first section, and the second if there is no POSIX. */
#define _POSIX_C_SOURCE 200809L
#include "target.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

/* ---- your table: converters and the line to the interlock ---- */

static double played[3];        /* command of this sample and of the two before it, V */
static long sample, lost_from, lost_to;

void write_output(double volts) {
    played[2] = played[1], played[1] = played[0], played[0] = volts;
}

static double noise(double rms) { /* the loop check rejects a sensor without noise as dead */
    static uint32_t state = 1;
    state = state * 1664525u + 1013904223u;
    return rms * 1.732 * ((double)state / 2147483648.0 - 1.0);
}

int read_inputs(double volts[CHANNELS]) {
    double rate = target_rate_hz(), g = 9.80665;
    double metres = played[0] * METRES_PER_VOLT;
    double acc = (played[0] - 2.0 * played[1] + played[2]) * METRES_PER_VOLT * rate * rate;
    volts[0] = played[0];                            /* drive_disp_m, the command wired back */
    volts[1] = metres * 1e3 / 7.5 + noise(5e-4);     /* table_disp_m, 75 mm on 10 V */
    volts[2] = acc / g * 5.0 + noise(2e-3);          /* table_acc_m_s2, 2 g on 10 V */
    volts[3] = metres * 1e3 / 10.0 + noise(5e-4);    /* mass_disp_m, 100 mm on 10 V: fixed */
    volts[4] = acc / g * 2.0 + noise(1e-3);          /* mass_acc_m_s2, 5 g: to the table, */
    for (int k = 5; k < CHANNELS; k++) volts[k] = noise(1e-3); /* and touching no bumper */
    sample++;
    return !(lost_from < sample && sample <= lost_to);
}

void write_heartbeat(int level) { (void)level; }

/* ---- operating system: socket and clock ---- */

static volatile sig_atomic_t asked;

static void ask(int number) { asked = number; }

static double now_s(void) {
    struct timespec at;
    clock_gettime(CLOCK_MONOTONIC, &at);
    return (double)at.tv_sec + 1e-9 * (double)at.tv_nsec;
}

static int heard(int fd, uint8_t *packet, size_t *bytes, struct peer *from) {
    struct sockaddr_in address;
    socklen_t size = sizeof address;
    ssize_t got =
        recvfrom(fd, packet, RIG_PACKET_BYTES + 1, 0, (struct sockaddr *)&address, &size);
    if (got < 0) return 0;
    *bytes = (size_t)got;
    from->host = address.sin_addr.s_addr;
    from->port = address.sin_port;
    return 1;
}

static void send_to(int fd, const uint8_t *packet, struct peer to) {
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = to.port};
    address.sin_addr.s_addr = to.host;
    (void)!sendto(fd, packet, TARGET_PACKET_BYTES, 0, (struct sockaddr *)&address, sizeof address);
}

static int bound(const char *host, const char *port) {
    struct sockaddr_in address = {.sin_family = AF_INET};
    int fd = socket(AF_INET, SOCK_DGRAM, 0);
    address.sin_port = htons((uint16_t)atoi(port));
    if (fd < 0 || inet_pton(AF_INET, host, &address.sin_addr) != 1 ||
        bind(fd, (struct sockaddr *)&address, sizeof address) != 0 ||
        fcntl(fd, F_SETFL, O_NONBLOCK) != 0) {
        fprintf(stderr, "cannot listen at %s:%s; give an address of this computer and a free "
                "port\n", host, port);
        exit(2);
    }
    return fd;
}

int main(int count, char **given) {
    if (count != 3 && count != 5) {
        fprintf(stderr, "usage: %s HOST PORT [FIRST COUNT]\n", given[0]);
        return 2;
    }
    int fd = bound(given[1], given[2]);
    if (count == 5) lost_from = atol(given[3]), lost_to = lost_from + atol(given[4]);
    signal(SIGTERM, ask);
    signal(SIGINT, ask);
    target_init();
    printf("waiting at %s:%s\n", given[1], given[2]);
    fflush(stdout);
    uint8_t packet[TARGET_PACKET_BYTES];
    double next_s = now_s();
    while (!asked || !target_is_free()) {
        struct pollfd ready = {.fd = fd, .events = POLLIN};
        struct peer peer;
        size_t bytes;
        poll(&ready, 1, 1);
        if (asked) target_switch_off();
        if (target_is_free()) sample = lost_to; /* no losses before a start */
        while (heard(fd, packet, &bytes, &peer))
            if (target_hear(packet, bytes, peer)) next_s = now_s(), sample = 0;
        for (; next_s <= now_s(); next_s += 1.0 / target_rate_hz()) target_sample();
        while (target_packet(packet, &peer)) send_to(fd, packet, peer);
    }
    close(fd);
    return 0;
}
