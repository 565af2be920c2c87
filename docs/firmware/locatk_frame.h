/* Encoder for frames of the locatk protocol; README.md in this folder specifies them.
 *
 * C99 or C++11, without memory allocation or other files. Part of locatk, BSD-3-Clause.
 *
 *     static uint8_t memory[LOCATK_MEMORY(200)];    // room for payloads up to 200 bytes
 *     static locatk_writer out;
 *
 *     locatk_init(&out, memory, sizeof memory, 0);
 *     send(out.memory, locatk_hello(&out, micros(), 1000000, "my robot 1.0"));
 *     ...
 *     locatk_series(&out, LOCATK_HALLS, tick, 4, 1, 0, 0);
 *     for (int i = 0; i < 4; i++) locatk_put_f32(&out, microtesla[i]);
 *     send(out.memory, locatk_end(&out));
 */
#ifndef LOCATK_FRAME_H
#define LOCATK_FRAME_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#define LOCATK_VERSION 1

/* Types of frames. */
#define LOCATK_HELLO 1
#define LOCATK_TEXT 2
#define LOCATK_MAGNETOMETERS 3
#define LOCATK_HALLS 4
#define LOCATK_ODOMETRY 5
#define LOCATK_LIGHTHOUSE_CAPTURE 6
#define LOCATK_LIGHTHOUSE_SWEEP 7
#define LOCATK_IMU 8
#define LOCATK_POSE 9
#define LOCATK_LIGHTHOUSE_DECK 10

/* Flags of a series. */
#define LOCATK_COUNTS 1
#define LOCATK_TEMPERATURE 2

/* Count of a sensor without a value or with a saturated one; the float for it is NAN. */
#define LOCATK_MISSING (-32768)

/* Levels of a text. */
#define LOCATK_DEBUG 1
#define LOCATK_INFO 2
#define LOCATK_WARNING 3
#define LOCATK_ERROR 4
#define LOCATK_FATAL 5

/* Largest payload, and the bytes of memory for payloads up to a size. */
#define LOCATK_LONGEST_PAYLOAD 4084
#define LOCATK_MEMORY(payload) ((payload) + 15 + ((payload) + 14) / 253)

/* Sizes of payloads: text or HELLO by its characters, samples by their values (3 per magnetometer,
 * 1 per hall sensor, 3 per odometry pose, 6 per IMU, 7 per pose), captures, sweeps. */
#define LOCATK_TEXT_PAYLOAD(characters) ((characters) + 8)
#define LOCATK_SERIES_PAYLOAD(samples, values) (12 + 4 * (samples) * ((values) + 1))
#define LOCATK_CAPTURES_PAYLOAD(captures) (16 * (captures))
#define LOCATK_SWEEPS_PAYLOAD(sweeps) (12 * (sweeps))

/* A float must be an IEEE 754 number of 32 bits, as on every processor with an Arduino core. */
typedef char locatk_float_has_32_bits[sizeof(float) == 4 ? 1 : -1];

/* Writer of the frames of one node; a gateway has one for each node. */
typedef struct {
    uint8_t *memory;   /* the finished frame, after locatk_end() */
    uint16_t lead;     /* start of the content; COBS needs the space before it */
    uint16_t end;      /* after the last byte of the content */
    uint16_t limit;    /* after the last byte that fits */
    uint16_t sequence; /* number of the next frame */
    uint8_t node;
    uint8_t full; /* the content did not fit */
} locatk_writer;

/* node: 0 if the port has one device, otherwise the number of the device. */
static inline void locatk_init(locatk_writer *w, uint8_t *memory, size_t size, uint8_t node)
{
    uint16_t most = LOCATK_MEMORY(LOCATK_LONGEST_PAYLOAD);
    uint16_t usable = size < most ? (uint16_t)size : most;
    w->memory = memory;
    w->lead = (uint16_t)(1 + usable / 254);
    /* CRC and delimiter follow the content. */
    w->limit = usable > w->lead + 5 ? (uint16_t)(usable - 5) : w->lead;
    if (w->limit > w->lead + LOCATK_LONGEST_PAYLOAD + 8)
        w->limit = (uint16_t)(w->lead + LOCATK_LONGEST_PAYLOAD + 8);
    w->end = w->lead;
    w->sequence = 0;
    w->node = node;
    w->full = 0;
}

static inline void locatk_put_u8(locatk_writer *w, uint8_t value)
{
    if (w->end < w->limit)
        w->memory[w->end++] = value;
    else
        w->full = 1;
}

static inline void locatk_put_u16(locatk_writer *w, uint16_t value)
{
    locatk_put_u8(w, (uint8_t)(value & 0xFF));
    locatk_put_u8(w, (uint8_t)(value >> 8));
}

static inline void locatk_put_i16(locatk_writer *w, int16_t value)
{
    locatk_put_u16(w, (uint16_t)value);
}

static inline void locatk_put_u32(locatk_writer *w, uint32_t value)
{
    locatk_put_u16(w, (uint16_t)(value & 0xFFFF));
    locatk_put_u16(w, (uint16_t)(value >> 16));
}

static inline void locatk_put_u64(locatk_writer *w, uint64_t value)
{
    locatk_put_u32(w, (uint32_t)(value & 0xFFFFFFFF));
    locatk_put_u32(w, (uint32_t)(value >> 32));
}

static inline void locatk_put_f32(locatk_writer *w, float value)
{
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    locatk_put_u32(w, bits);
}

static inline void locatk_put_bytes(locatk_writer *w, const void *bytes, size_t count)
{
    const uint8_t *from = (const uint8_t *)bytes;
    while (count--) locatk_put_u8(w, *from++);
}

/* Start a frame; tick: time of its first sample. */
static inline void locatk_begin(locatk_writer *w, uint8_t type, uint32_t tick)
{
    w->end = w->lead;
    w->full = 0;
    locatk_put_u8(w, type);
    locatk_put_u8(w, w->node);
    locatk_put_u16(w, w->sequence);
    locatk_put_u32(w, tick);
}

/* CRC-16/CCITT-FALSE. The polynomial 0x1021 has few terms, so that a byte needs no table. */
static inline uint16_t locatk_crc16(const uint8_t *bytes, size_t count)
{
    uint16_t crc = 0xFFFF;
    while (count--) {
        uint8_t x = (uint8_t)((crc >> 8) ^ *bytes++);
        x = (uint8_t)(x ^ (x >> 4));
        crc = (uint16_t)((uint16_t)(crc << 8) ^ (uint16_t)((uint16_t)x << 12) ^
                         (uint16_t)((uint16_t)x << 5) ^ x);
    }
    return crc;
}

/* CRC-32 as in Ethernet and zlib. */
static inline uint32_t locatk_crc32(const uint8_t *bytes, size_t count)
{
    uint32_t crc = 0xFFFFFFFF;
    while (count--) {
        uint8_t bit;
        crc ^= *bytes++;
        for (bit = 0; bit < 8; bit++) crc = (crc >> 1) ^ ((crc & 1) ? 0xEDB88320UL : 0UL);
    }
    return ~crc;
}

/* Finish the frame in w->memory and return the number of bytes to send. If the frame did not fit,
 * return 0; its sequence number is used up, so that the receiver detects the loss. */
static inline size_t locatk_end(locatk_writer *w)
{
    uint8_t *out = w->memory;
    uint8_t *code = out++; /* code byte of the current block */
    const uint8_t *from = w->memory + w->lead;
    uint16_t size = (uint16_t)(w->end - w->lead);
    w->sequence++;
    if (w->full) return 0;
    w->limit = (uint16_t)(w->limit + 4);
    if (size <= 256)
        locatk_put_u16(w, locatk_crc16(from, size));
    else
        locatk_put_u32(w, locatk_crc32(from, size));
    w->limit = (uint16_t)(w->limit - 4);
    size = (uint16_t)(w->end - w->lead);
    /* COBS moves the content to the front; writing never overtakes reading. */
    while (size--) {
        uint8_t byte = *from++;
        if (byte) {
            *out++ = byte;
            if (out - code < 255) continue;
            *code = 255;
            if (!size) { /* a full block at the end needs no empty block after it */
                *out++ = 0;
                return (size_t)(out - w->memory);
            }
        } else {
            *code = (uint8_t)(out - code);
        }
        code = out++;
    }
    *code = (uint8_t)(out - code);
    *out++ = 0;
    return (size_t)(out - w->memory);
}

/* HELLO: name and version of the firmware, and ticks per second of its clock. Send it first, and
 * then every second. */
static inline size_t locatk_hello(locatk_writer *w, uint32_t tick, uint32_t tick_hz,
                                  const char *name)
{
    locatk_begin(w, LOCATK_HELLO, tick);
    locatk_put_u32(w, LOCATK_VERSION);
    locatk_put_u32(w, tick_hz);
    locatk_put_bytes(w, name, strlen(name));
    return locatk_end(w);
}

/* A line of text for the log, in UTF-8. */
static inline size_t locatk_text(locatk_writer *w, uint32_t tick, uint8_t level,
                                 const char *words)
{
    locatk_begin(w, LOCATK_TEXT, tick);
    locatk_put_u8(w, level);
    locatk_put_bytes(w, words, strlen(words));
    return locatk_end(w);
}

/* Start a frame of MAGNETOMETERS or HALLS, or of ODOMETRY, IMU or POSE (`sensors` is 1), with `step`
 * ticks between two samples. Then put: with LOCATK_COUNTS the scale (f32, microtesla per count); sample by
 * sample all values (f32, or i16 with LOCATK_COUNTS); with LOCATK_TEMPERATURE the temperature of
 * each sample (f32). */
static inline void locatk_series(locatk_writer *w, uint8_t type, uint32_t tick, uint8_t sensors,
                                 uint8_t samples, uint8_t flags, uint32_t step)
{
    locatk_begin(w, type, tick);
    locatk_put_u8(w, sensors);
    locatk_put_u8(w, samples);
    locatk_put_u8(w, flags);
    locatk_put_u8(w, 0);
    locatk_put_u32(w, step);
}

/* Put one record of a LIGHTHOUSE_CAPTURE frame; polynomial: -1 if unknown. */
static inline void locatk_put_capture(locatk_writer *w, uint32_t tick, uint8_t sensor,
                                      int8_t polynomial, int8_t bit_offset, uint64_t bits)
{
    locatk_put_u32(w, tick);
    locatk_put_u8(w, sensor);
    locatk_put_u8(w, (uint8_t)polynomial);
    locatk_put_u8(w, (uint8_t)bit_offset);
    locatk_put_u8(w, 0);
    locatk_put_u64(w, bits);
}

/* Put one record of a LIGHTHOUSE_SWEEP frame; polynomial, sweep: -1 if unknown; count_256: steps
 * of the 6 MHz bit clock since rotor zero, times 256. */
static inline void locatk_put_sweep(locatk_writer *w, uint32_t tick, uint8_t sensor,
                                    uint8_t channel, int8_t polynomial, int8_t sweep,
                                    uint32_t count_256)
{
    locatk_put_u32(w, tick);
    locatk_put_u8(w, sensor);
    locatk_put_u8(w, channel);
    locatk_put_u8(w, (uint8_t)polynomial);
    locatk_put_u8(w, (uint8_t)sweep);
    locatk_put_u32(w, count_256);
}

#endif
