/* Encoding of packet fields, little-endian on every processor, and CRC-32. */
#ifndef BYTES_H
#define BYTES_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

static uint64_t get(const uint8_t *at, int bytes) {
    uint64_t value = 0;
    while (bytes-- > 0) value = value << 8 | at[bytes];
    return value;
}

static uint8_t *put(uint8_t *at, uint64_t value, int bytes) {
    for (int k = 0; k < bytes; k++) *at++ = (uint8_t)(value >> 8 * k);
    return at;
}

static double get_double(const uint8_t *at) {
    uint64_t bits = get(at, 8);
    double value;
    memcpy(&value, &bits, 8);
    return value;
}

static uint8_t *put_double(uint8_t *at, double value) {
    uint64_t bits;
    memcpy(&bits, &value, 8);
    return put(at, bits, 8);
}

static uint32_t crc32(const uint8_t *at, size_t bytes) {
    uint32_t crc = 0xFFFFFFFFu;
    for (size_t k = 0; k < bytes; k++) {
        crc ^= at[k];
        for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (0xEDB88320u & (0u - (crc & 1u)));
    }
    return ~crc;
}

#endif
