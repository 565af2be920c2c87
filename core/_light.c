/* The hot loops of core/lighthouse: edges of sampled light, its soft bits, and which station's
 * sequence they are. Their numpy twins say what they do and why: locatk.core.lighthouse.bursts,
 * .demodulate and .identify.
 */
#include "_kernels.h"
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* ---- Edges of windows of samples --------------------------------------------------------- */

static inline uint64_t big_endian(const uint8_t *bytes)
{
    uint64_t word = 0;
    for (int k = 0; k < 8; k++) word = word << 8 | bytes[k];
    return word;
}

/* window_edges(windows, width, tick, first, rises): packed rows of width bytes to edges. */
PyObject *window_edges(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer b[4];
    int width;
    if (!PyArg_ParseTuple(args, "y*iw*w*w*", &b[0], &width, &b[1], &b[2], &b[3])) return NULL;
    const uint8_t *windows = b[0].buf;
    int64_t *tick = b[1].buf, *first = b[2].buf;
    uint8_t *rises = b[3].buf;
    const Py_ssize_t rows = b[0].len / (width ? width : 1);
    const int words = (width + 7) / 8;
    int64_t count = 0;
    first[0] = 0;
    for (Py_ssize_t i = 0; i < rows; i++) {
        const uint8_t *row = windows + i * width;
        const int64_t begin = count, base = (int64_t)i * 8 * width;
        uint64_t last = row[0] >> 7;
        rises[i] = !last;
        for (int w = 0; w < words; w++) {
            uint8_t rest[8];
            const uint8_t *at = row + 8 * w;
            const int here = width - 8 * w < 8 ? width - 8 * w : 8;
            if (here < 8) {
                /* Beyond the end the level stays. */
                memset(rest, row[width - 1] & 1 ? 0xFF : 0, 8);
                memcpy(rest, at, (size_t)here);
                at = rest;
            }
            const uint64_t word = big_endian(at);
            uint64_t changed = word ^ (word >> 1 | last << 63);
            last = word & 1;
            while (changed) {
                const int place = __builtin_clzll(changed);
                tick[count++] = base + 64 * w + place;
                changed &= ~(0x8000000000000000ull >> place);
            }
        }
        if (count == begin) rises[i] = 0;
        first[i + 1] = count;
    }
    return done(b, 4, 1);
}

/* ---- Soft bits ----------------------------------------------------------------------------- */

#define TURN 4096
static float wave[TURN + TURN / 4]; /* sine, and a quarter turn later cosine */

static void make_wave(void)
{
    if (wave[TURN / 4] != 0) return;
    for (int k = 0; k < TURN + TURN / 4; k++) wave[k] = (float)sin(2 * M_PI * k / TURN);
}

/* Mean levels of all chips of a burst; returns how many there are. time holds its edges in chips
 * from the first one, sign the first one's direction; begin answers where the grid starts. */
static int chips_of(const double *time, int edges, float sign, int longest, double *begin,
                    float *mean)
{
    double sums[2][2] = {{0, 0}, {0, 0}};
    for (int k = 0; k < edges; k++) {
        const int at = (int)((time[k] - floor(time[k])) * TURN + 0.5) & (TURN - 1);
        sums[k & 1][0] += wave[at + TURN / 4];
        sums[k & 1][1] += wave[at];
    }
    const double own = atan2(sums[0][1], sums[0][0]), other = atan2(sums[1][1], sums[1][0]);
    double skew = (own - other) / (2 * M_PI);
    skew -= rint(skew);
    const double phase = own / (2 * M_PI) - skew / 2;
    const double shift[2] = {-skew / 2, skew / 2};
    /* Edges lie on the grid, so that rounding is safe where floor and ceil would toss a coin. */
    *begin = rint(time[0] + shift[0] - phase) - 1 + phase;
    double last = time[0] + shift[0];
    for (int k = 1; k < edges; k++) {
        const double t = time[k] + shift[k & 1];
        last = t > last ? t : last;
    }
    const double whole = rint(last - *begin) + 1;
    const int chips = whole < longest ? (int)whole : longest;
    /* Each edge changes the mean of its own chip by a part, and of all later ones whole. */
    memset(mean, 0, (size_t)(chips + 2) * sizeof *mean);
    float jump = 2 * sign;
    last = time[0] + shift[0];
    for (int k = 0; k < edges; k++) {
        double t = time[k] + shift[k & 1];
        t = t > last ? t : last;
        last = t;
        const double place = t - *begin;
        const int chip = (int)place;
        if (chip >= chips) break;
        const float late = (float)(place - chip);
        mean[chip] += jump * (1 - late);
        mean[chip + 1] += jump * late;
        jump = -jump;
    }
    float level = -sign;
    for (int k = 0; k < chips; k++) {
        level += mean[k];
        mean[k] = level;
    }
    return chips;
}

static inline float magnitude(float x) { return x < 0 ? -x : x; }

/* Bits of a burst from its chips; odd answers whether the first chip is the second half of one. */
HOT static int bits_of(const float *restrict mean, int chips, int *odd, int8_t *restrict value)
{
    float even_sum = 0, odd_sum = 0;
    for (int k = 0; k + 1 < chips; k += 2) even_sum += magnitude(mean[k + 1] - mean[k]);
    for (int k = 1; k + 1 < chips; k += 2) odd_sum += magnitude(mean[k + 1] - mean[k]);
    *odd = even_sum > odd_sum;
    const float *m = mean + *odd;
    const int bits = (chips - *odd) / 2;
    if (bits < 1) return 0;
    for (int k = 0; k < bits; k++) {
        const float a = k ? (m[2 * k] - m[2 * k - 1]) / 2 : m[0];
        const float b = k < bits - 1 ? (m[2 * k + 1] - m[2 * k + 2]) / 2 : m[2 * k + 1];
        float soft = -a * b;
        soft = soft > 1 ? 1 : soft < -1 ? -1 : soft;
        value[k] = (int8_t)rintf(soft * 64);
    }
    return bits;
}

/* light_bits(tick, first, rises, readable, ticks_per_chip, longest, value, value_first, start) */
PyObject *light_bits(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer b[7];
    double chip;
    int longest;
    if (!PyArg_ParseTuple(args, "y*y*y*y*diw*w*w*", &b[0], &b[1], &b[2], &b[3], &chip, &longest,
                          &b[4], &b[5], &b[6]))
        return NULL;
    const int64_t *tick = b[0].buf, *first = b[1].buf;
    const uint8_t *rises = b[2].buf, *readable = b[3].buf;
    int8_t *value = b[4].buf;
    int64_t *value_first = b[5].buf;
    double *start = b[6].buf;
    const Py_ssize_t bursts = b[2].len;
    int64_t most = 1;
    for (Py_ssize_t i = 0; i < bursts; i++)
        if (first[i + 1] - first[i] > most) most = first[i + 1] - first[i];
    double *time = malloc((size_t)most * sizeof *time);
    float *mean = malloc((size_t)(longest + 8) * sizeof *mean);
    if (!time || !mean) {
        free(time);
        free(mean);
        return done(b, 7, 0);
    }
    make_wave();
    value_first[0] = 0;
    for (Py_ssize_t i = 0; i < bursts; i++) {
        const int64_t edges = first[i + 1] - first[i];
        int bits = 0;
        start[i] = 0;
        if (readable[i]) {
            const int64_t origin = tick[first[i]];
            for (int64_t k = 0; k < edges; k++)
                time[k] = (double)(tick[first[i] + k] - origin) / chip;
            double begin;
            int odd;
            const int chips = chips_of(time, (int)edges, rises[i] ? 1.0f : -1.0f, longest, &begin, mean);
            bits = bits_of(mean, chips, &odd, value + value_first[i]);
            start[i] = (double)origin + (begin + odd) * chip;
        }
        value_first[i + 1] = value_first[i] + bits;
    }
    free(time);
    free(mean);
    return done(b, 7, 1);
}

/* ---- Polynomial and place ------------------------------------------------------------------ */

#define REGISTER 17
#define LENGTH 131071

typedef struct {
    const int32_t *states, *index, *taps, *match, *miss;
    int polynomials, unknown;
} Tables;

/* Row of one place: polynomial, place, score, begin, end, known, wrong. */
static void score_place(const Tables *t, const int8_t *value, int bits, int polynomial, int place,
                        int32_t *row)
{
    const int32_t *states = t->states + (size_t)polynomial * LENGTH;
    int64_t total = 0, low = 0, best = 0;
    int low_at = 0, begin = 0, end = 0, at = place, left = 0;
    int32_t ahead = 0;
    for (int k = 0; k < bits; k++) {
        if (!left) {
            ahead = states[at];
            at += REGISTER;
            if (at >= LENGTH) at -= LENGTH;
            left = REGISTER;
        }
        const int expected = ahead >> --left & 1;
        const int strength = value[k] < 0 ? -value[k] : value[k];
        total += (value[k] > 0) == expected ? t->match[strength] : t->miss[strength];
        if (total < low) {
            low = total;
            low_at = k + 1;
        }
        if (total - low > best) {
            best = total - low;
            begin = low_at;
            end = k + 1;
        }
    }
    int known = 0, wrong = 0;
    for (int k = begin; k < end; k++) {
        const int strength = value[k] < 0 ? -value[k] : value[k];
        if (strength <= t->unknown) continue;
        const int64_t here = ((int64_t)place + k) % LENGTH;
        known++;
        wrong += (value[k] > 0) != (states[here] >> (REGISTER - 1) & 1);
    }
    row[0] = polynomial;
    row[1] = place;
    row[2] = (int32_t)best;
    row[3] = begin;
    row[4] = end;
    row[5] = known;
    row[6] = wrong;
}

/* Bits of a burst as words, the first bit highest. */
typedef struct {
    uint64_t *hard, *open; /* open: bits that follow from nothing, as one of 18 is unknown */
    int bits, words;
} Text;

static void write_text(const Tables *t, const int8_t *value, int bits, Text *text)
{
    const int words = (bits + 63) / 64;
    int sure = 0, ones = 0;
    text->bits = bits;
    text->words = words;
    for (int w = 0; w < words; w++) {
        uint64_t hard = 0, open = 0;
        for (int k = 64 * w; k < 64 * w + 64; k++) {
            const int soft = k < bits ? value[k] : 0;
            const int strength = soft < 0 ? -soft : soft;
            sure = strength > t->unknown ? sure + 1 : 0;
            hard = hard << 1 | (soft > 0);
            /* The 17 before must hold a one: state 0 follows from itself. */
            open = open << 1 | (sure <= REGISTER || ones <= 0);
            ones = soft > 0 ? REGISTER : ones - 1;
        }
        text->hard[w] = hard;
        text->open[w] = open;
    }
}

static inline uint64_t word_before(const uint64_t *words, int w, int by)
{
    return words[w] >> by | (w ? words[w - 1] << (64 - by) : 0);
}

/* Where the longest run of bits begins that follow from the 17 before each, the first of equals,
 * among the words from first to last; answers its length. */
static int longest_run(const Text *text, uint32_t taps, int first, int last, int *begin)
{
    int longest = 0, from = 64 * first;
    for (int w = first; w < last; w++) {
        uint64_t bad = text->hard[w];
        for (uint32_t left = taps; left; left &= left - 1)
            bad ^= word_before(text->hard, w, 1 + __builtin_ctz(left));
        bad |= text->open[w];
        while (bad) {
            const int place = __builtin_clzll(bad), at = 64 * w + place;
            if (at - from > longest) {
                longest = at - from;
                *begin = from;
            }
            from = at + 1;
            bad &= ~(0x8000000000000000ull >> place);
        }
    }
    if (64 * last - from > longest) {
        longest = 64 * last - from;
        *begin = from;
    }
    return longest;
}

/* Place of the first bit, if the 17 bits before bit k stand in the sequence of a polynomial. */
static int place_of(const Tables *t, const Text *text, int polynomial, int k)
{
    const int last = k - 1, w = last / 64, over = 63 - last % 64;
    uint64_t state = text->hard[w] >> over;
    if (w && over > 64 - REGISTER) state |= text->hard[w - 1] << (64 - over);
    const int32_t index =
        t->index[(size_t)polynomial * (LENGTH + 1) + (state & ((1 << REGISTER) - 1))];
    const int place = (index - (k - REGISTER)) % LENGTH;
    return place < 0 ? place + LENGTH : place;
}

/* light_places(value, first, states, index, taps, polynomials, match, miss, unknown, follow,
 * fastest, rows) */
PyObject *light_places(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer b[8];
    Tables t;
    int follow, fastest;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*iy*y*iiiw*", &b[0], &b[1], &b[2], &b[3], &b[4],
                          &t.polynomials, &b[5], &b[6], &t.unknown, &follow, &fastest, &b[7]))
        return NULL;
    const int8_t *values = b[0].buf;
    const int64_t *first = b[1].buf;
    t.states = b[2].buf;
    t.index = b[3].buf;
    t.taps = b[4].buf;
    t.match = b[5].buf;
    t.miss = b[6].buf;
    int32_t *rows = b[7].buf;
    const Py_ssize_t bursts = b[1].len / (Py_ssize_t)sizeof *first - 1;
    int64_t most = 1;
    for (Py_ssize_t i = 0; i < bursts; i++)
        if (first[i + 1] - first[i] > most) most = first[i + 1] - first[i];
    Text text = {malloc((size_t)(most / 64 + 1) * 8), malloc((size_t)(most / 64 + 1) * 8), 0, 0};
    const int stored = text.hard && text.open;
    for (Py_ssize_t i = 0; stored && i < bursts; i++) {
        const int8_t *value = values + first[i];
        const int bits = (int)(first[i + 1] - first[i]);
        int32_t *row = rows + 7 * i;
        if (bits < REGISTER + follow) continue;
        write_text(&t, value, bits, &text);
        /* The word in the middle tells of most bursts; of the others each word is asked. */
        const int middle = text.words / 2;
        int best = -1, longest = 0, begin = 0, at = 0;
        for (int p = 0; p < t.polynomials; p++) {
            const int run = longest_run(&text, (uint32_t)t.taps[p], middle, middle + 1, &at);
            if (run > longest) {
                longest = run;
                best = p;
                begin = at;
            }
        }
        if (longest >= follow) {
            score_place(&t, value, bits, best, place_of(&t, &text, best, begin), row);
            if (row[2] >= fastest) continue;
        }
        row[0] = row[1] = -1;
        for (int k = 2; k < 7; k++) row[k] = 0;
        for (int p = 0; p < t.polynomials; p++) {
            int32_t trial[7];
            const int run = longest_run(&text, (uint32_t)t.taps[p], 0, text.words, &at);
            if (run < follow) continue;
            score_place(&t, value, bits, p, place_of(&t, &text, p, at), trial);
            if (trial[2] > row[2]) memcpy(row, trial, sizeof trial);
        }
    }
    free(text.hard);
    free(text.open);
    return done(b, 8, stored);
}
