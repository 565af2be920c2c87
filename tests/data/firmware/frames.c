/* Frames of all types and lengths from random numbers, through locatk_frame.h: bytes to the file
 * that is named, and what they say to stdout, a line a record. Compiles as C99 and as C++11. */
#include <inttypes.h>
#include <stdio.h>
#include <stdlib.h>

#include "locatk_frame.h"

#define NODES 3
#define LARGEST 4200

static FILE *wire;
static unsigned long sent, frames, lost;
static uint32_t state = 0x12345678;
static locatk_writer writers[NODES];
static uint8_t memory[NODES][LARGEST];
static uint32_t hz[NODES];

static uint32_t draw(void)
{
    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state;
}

static uint32_t below(uint32_t limit)
{
    return draw() % limit;
}

/* A float of any size with zero bytes more often than chance has them; never infinite. */
static float number(void)
{
    float value = (float)(int32_t)draw() / (float)(1 << below(31));
    return below(8) ? value : (float)(int32_t)below(100);
}

static const char *bits(float value)
{
    static char text[9];
    uint32_t as;
    memcpy(&as, &value, sizeof as);
    sprintf(text, "%08" PRIx32, as);
    return text;
}

/* Sends a frame and prints the start of the line of each of its records. */
static void finish(locatk_writer *w, size_t length)
{
    if (!length) {
        lost++;
        return;
    }
    frames++;
    sent += (unsigned long)length;
    fwrite(w->memory, 1, length, wire);
}

static void start(const locatk_writer *w, const char *kind, unsigned sensors, uint32_t tick,
                  uint16_t sequence, size_t length)
{
    printf("%s %u %u %" PRIu32 " %lu %u %" PRIu32, kind, w->node, sensors, hz[w->node],
           sent + (unsigned long)length, sequence, tick);
}

static void greet(locatk_writer *w)
{
    hz[w->node] = below(2) ? 1000000 : 1 + below(16000000);
    finish(w, locatk_hello(w, draw(), hz[w->node], "test \xC2\xB5"));
}

/* A text of one character all through, so that blocks of COBS are as long as they get, or with
 * zeros in it; it is the payload whose length is free. */
static void text(locatk_writer *w, unsigned length)
{
    static char words[LARGEST];
    uint32_t tick = draw();
    uint8_t level = (uint8_t)(1 + below(5));
    unsigned kind = below(4), n;
    uint16_t sequence = w->sequence;
    size_t count;
    for (n = 0; n < length; n++)
        words[n] = (char)(kind == 0 ? 'x' : kind == 1 ? 0 : kind == 2 ? below(2) : below(128));
    locatk_begin(w, LOCATK_TEXT, tick);
    locatk_put_u8(w, level);
    locatk_put_bytes(w, words, length);
    count = locatk_end(w);
    if (count) {
        start(w, "log", 0, tick, sequence, count);
        printf(" %u t", level);
        for (n = 0; n < length; n++) printf("%02x", (unsigned)words[n]);
        printf("\n");
    }
    finish(w, count);
}

static void series(locatk_writer *w, uint8_t type)
{
    static float values[8 * 255 * 3], temperatures[8];
    static int16_t counts[8 * 255 * 3];
    const char *kind = type == LOCATK_MAGNETOMETERS ? "magnetometers"
                       : type == LOCATK_HALLS       ? "halls"
                                                    : "odometry";
    uint8_t flags = (uint8_t)(type == LOCATK_MAGNETOMETERS ? below(4)
                              : type == LOCATK_HALLS       ? below(2)
                                                           : 0);
    uint8_t sensors = (uint8_t)(type == LOCATK_ODOMETRY ? 1 : 1 + below(below(20) ? 9 : 255));
    uint8_t samples = (uint8_t)(1 + below(8));
    unsigned width = sensors * (type == LOCATK_HALLS ? 1u : 3u), n, k;
    uint32_t tick = draw(), step = samples > 1 ? 1 + below(1u << 28) : below(2);
    float scale = 0.25f + (float)below(1000) / 7;
    uint16_t sequence = w->sequence;
    size_t count;
    locatk_series(w, type, tick, sensors, samples, flags, step);
    if (flags & LOCATK_COUNTS) locatk_put_f32(w, scale);
    for (n = 0; n < width * samples; n++) {
        values[n] = number();
        counts[n] = (int16_t)(below(30) ? (int)below(65536) - 32768 : LOCATK_MISSING);
        if (flags & LOCATK_COUNTS)
            locatk_put_i16(w, counts[n]);
        else
            locatk_put_f32(w, values[n]);
    }
    for (k = 0; k < samples; k++) {
        temperatures[k] = number();
        if (flags & LOCATK_TEMPERATURE) locatk_put_f32(w, temperatures[k]);
    }
    count = locatk_end(w);
    for (k = 0; count && k < samples; k++) {
        start(w, kind, type == LOCATK_ODOMETRY ? 0 : sensors, tick + k * step, sequence, count);
        if (flags & LOCATK_COUNTS) printf(" s%s", bits(scale));
        for (n = k * width; n < (k + 1) * width; n++) {
            if (flags & LOCATK_COUNTS)
                printf(" %d", counts[n]);
            else
                printf(" %s", bits(values[n]));
        }
        if (flags & LOCATK_TEMPERATURE) printf(" w%s", bits(temperatures[k]));
        printf("\n");
    }
    finish(w, count);
}

static void light(locatk_writer *w, int captures)
{
    static uint32_t ticks[24], ids[24], parts[24];
    static uint64_t states[24];
    unsigned records = 1 + below(24), n;
    uint32_t tick = draw();
    uint16_t sequence = w->sequence;
    size_t count;
    locatk_begin(w, captures ? LOCATK_LIGHTHOUSE_CAPTURE : LOCATK_LIGHTHOUSE_SWEEP, tick);
    for (n = 0; n < records; n++) {
        ticks[n] = tick + n * 1000;
        ids[n] = draw();
        parts[n] = below(1u << 25);
        states[n] = (uint64_t)draw() << 32 | draw();
        if (captures)
            locatk_put_capture(w, ticks[n], (uint8_t)(ids[n] & 3), (int8_t)((ids[n] >> 2) % 33) - 1,
                               (int8_t)(ids[n] >> 24), states[n]);
        else
            locatk_put_sweep(w, ticks[n], (uint8_t)(ids[n] & 3), (uint8_t)(1 + (ids[n] >> 8) % 16),
                             (int8_t)((ids[n] >> 2) % 33) - 1, (int8_t)((ids[n] >> 24) % 3) - 1,
                             parts[n]);
    }
    count = locatk_end(w);
    for (n = 0; count && n < records; n++) {
        int polynomial = (int)((ids[n] >> 2) % 33) - 1;
        start(w, captures ? "captures" : "lighthouse", 0, ticks[n], sequence, count);
        if (captures)
            printf(" %" PRIu32 " %d %d %" PRIu64 "\n", ids[n] & 3, polynomial,
                   (int8_t)(ids[n] >> 24), states[n]);
        else
            printf(" %" PRIu32 " %" PRIu32 " %d %d %" PRIu32 "\n", ids[n] & 3,
                   1 + (ids[n] >> 8) % 16, polynomial, (int)((ids[n] >> 24) % 3) - 1, parts[n]);
    }
    finish(w, count);
}

static void any(locatk_writer *w)
{
    switch (below(7)) {
    case 0: greet(w); break;
    case 1: text(w, below(40)); break;
    case 2: light(w, 0); break;
    case 3: light(w, 1); break;
    case 4: series(w, LOCATK_HALLS); break;
    case 5: series(w, LOCATK_ODOMETRY); break;
    default: series(w, LOCATK_MAGNETOMETERS); break;
    }
}

int main(int count, char **arguments)
{
    unsigned n, length;
    if (count != 2 || !(wire = fopen(arguments[1], "wb"))) return 2;
    for (n = 0; n < NODES; n++) {
        /* The last has room for short frames only, so that it loses some. */
        size_t size = n < NODES - 1 ? LARGEST : LOCATK_MEMORY(180);
        locatk_init(&writers[n], memory[n], size, (uint8_t)(n ? 100 + n : 0));
        writers[n].node = (uint8_t)n;
        greet(&writers[n]);
    }
    for (n = 0; n < 1500; n++) any(&writers[below(NODES)]);
    /* Every length of content around 254, 256, 508 and the longest. */
    for (length = 0; length < 530; length++)
        for (n = 0; n < 2; n++) text(&writers[1], length);
    for (length = LOCATK_LONGEST_PAYLOAD - 20; length < LOCATK_LONGEST_PAYLOAD + 3; length++)
        for (n = 0; n < 4; n++) text(&writers[0], length - 1);
    for (n = 0; n < NODES; n++) greet(&writers[n]);
    fclose(wire);
    printf("totals %lu %lu %lu\n", sent, frames, lost);
    return 0;
}
