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
#define LONGEST_RUN 3.0
#define EVEN 1e-3f
#define FULL (1 << 20) /* a level, as a whole number: its sums are exact */
static int32_t wave[TURN + TURN / 4]; /* sine, and a quarter turn later cosine */

static void make_wave(void)
{
    if (wave[TURN / 4] != 0) return;
    for (int k = 0; k < TURN + TURN / 4; k++)
        wave[k] = (int32_t)rint(sin(2 * M_PI / TURN * k) * 16384);
}

/* The nearest whole number. Halves, which sampled times often are, go up for sure. */
static inline double rounded(double value) { return floor(value + (0.5 + 1e-6)); }

/* Where chips begin, one before the first edge, and by how much edges of the first edge's direction
 * come later than the others. time holds the edges in chips from the first one. */
HOT static double grid_of(const double *time, int edges, double *skew)
{
    int64_t sine[2] = {0, 0}, cosine[2] = {0, 0};
    double phase[2], run[2] = {0, 0};
    /* Both directions in one pass, so that neither sum waits for the other. */
    for (int k = 0; k < edges; k += 2) {
        for (int kind = 0; kind < 2 && k + kind < edges; kind++) {
            const double here = time[k + kind];
            const int at = (int)((here - (double)(int)here) * TURN + 0.5) & (TURN - 1);
            sine[kind] += wave[at];
            cosine[kind] += wave[at + TURN / 4];
            if (k + kind + 1 < edges) {
                const double length = time[k + kind + 1] - here;
                run[kind] += length < LONGEST_RUN ? length : LONGEST_RUN;
            }
        }
    }
    for (int kind = 0; kind < 2; kind++)
        phase[kind] = atan2((double)sine[kind], (double)cosine[kind]) / (2 * M_PI);
    /* Phases leave whole chips open, which the runs tell. */
    double told = 0;
    if (run[1] > 0) told = (run[1] / ((edges - 1) / 2) - run[0] / (edges / 2)) / 2;
    told = told > 0.5 ? 0.5 : told < -0.5 ? -0.5 : told;
    *skew = phase[0] - phase[1];
    *skew -= rounded(*skew - told);
    return phase[0] - 0.5 * *skew - 1;
}

/* Mean levels of all chips of a burst; returns how many there are. sign is the first edge's
 * direction; begin answers where the first chip begins. */
HOT static int chips_of(const double *time, int edges, int sign, int longest, double *begin,
                    int32_t *mean)
{
    double skew;
    *begin = grid_of(time, edges, &skew);
    const double shift[2] = {-0.5 * skew, 0.5 * skew};
    /* Times ascend, so that with their shifts the latest is one of the last two. */
    const int final = edges - 1;
    double last = time[final] + shift[final & 1];
    const double other = time[final - 1] + shift[(final - 1) & 1];
    last = other > last ? other : last;
    const double whole = rounded(last - *begin) + 1;
    const int chips = whole < longest ? (int)whole : longest;
    /* Each edge changes the mean of its own chip by a part, and of all later ones whole. */
    memset(mean, 0, (size_t)(chips + 2) * sizeof *mean);
    int32_t turn = sign < 0 ? -1 : 0; /* all ones: x ^ turn, less turn, is -x */
    last = time[0] + shift[0];
    for (int k = 0; k < edges; k++) {
        double t = time[k] + shift[k & 1];
        t = t > last ? t : last;
        last = t;
        const double place = t - *begin;
        const int chip = (int)place;
        if (chip >= chips) break;
        const int32_t late = (int32_t)((place - chip) * FULL);
        mean[chip] += (2 * (FULL - late) ^ turn) - turn;
        mean[chip + 1] += (2 * late ^ turn) - turn;
        turn = ~turn;
    }
    int32_t level = -sign * FULL;
    for (int k = 0; k < chips; k++) {
        level += mean[k];
        mean[k] = level;
    }
    return chips;
}

static inline int32_t magnitude(int32_t x) { return (x < 0 ? -x : x) >> 6; }

/* Bits of a burst from its chips; odd answers whether the first chip is the second half of one.
 * change is room for as many numbers as there are chips. */
HOT static int bits_of(const int32_t *restrict mean, int chips, int *odd,
                       int32_t *restrict change, int8_t *restrict value)
{
    int32_t middles = 0, borders = 0;
    for (int k = 0; k + 1 < chips; k += 2) middles += magnitude(mean[k + 1] - mean[k]);
    for (int k = 1; k + 1 < chips; k += 2) borders += magnitude(mean[k + 1] - mean[k]);
    *odd = middles > borders + (int32_t)(EVEN * FULL) / 64;
    const int32_t *m = mean + *odd;
    const int bits = (chips - *odd) / 2;
    if (bits < 1) return 0;
    change[0] = 2 * m[0];
    for (int k = 1; k < bits; k++) change[k] = m[2 * k] - m[2 * k - 1];
    change[bits] = -2 * m[2 * bits - 1];
    for (int k = 0; k < bits; k++) {
        float soft = (float)change[k] * (float)change[k + 1] * (16.0f / FULL / FULL);
        soft = soft > 64 ? 64 : soft < -64 ? -64 : soft;
        value[k] = (int8_t)(int32_t)rintf(soft);
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
        if (readable[i] && first[i + 1] - first[i] > most) most = first[i + 1] - first[i];
    double *time = malloc((size_t)most * sizeof *time);
    int32_t *mean = malloc(2 * (size_t)(longest + 8) * sizeof *mean);
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
            const double chips_per_tick = 1 / chip;
            for (int64_t k = 0; k < edges; k++)
                time[k] = (double)(tick[first[i] + k] - origin) * chips_per_tick;
            double begin;
            int odd;
            const int64_t room = 2 * (b[4].len - value_first[i]);
            const int chips = chips_of(time, (int)edges, rises[i] ? 1 : -1,
                                       room < longest ? (int)room : longest, &begin, mean);
            bits = bits_of(mean, chips, &odd, mean + longest + 8, value + value_first[i]);
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
#define CERTAIN 64

typedef struct {
    const int32_t *states, *index, *taps;
    int polynomials, unknown, follow;
    int32_t gain[2][2 * CERTAIN + 1]; /* evidence of a soft bit where a zero, a one is expected */
} Tables;

static void weigh(Tables *t, const int32_t *match, const int32_t *miss)
{
    for (int v = -CERTAIN; v <= CERTAIN; v++) {
        const int size = v < 0 ? -v : v;
        t->gain[0][v + CERTAIN] = v > 0 ? miss[size] : match[size];
        t->gain[1][v + CERTAIN] = v > 0 ? match[size] : miss[size];
    }
}

static int64_t most_of(const int64_t *first, Py_ssize_t bursts)
{
    int64_t most = 1;
    for (Py_ssize_t i = 0; i < bursts; i++)
        if (first[i + 1] - first[i] > most) most = first[i + 1] - first[i];
    return most;
}

/* The 17 tap places of a polynomial in three parts: for each of them, all sums of the words of
 * bits that came so many places before. A polynomial's sum is then three look-ups. */
#define PARTS 3
#define PART_BITS 6
typedef uint64_t Sums[PARTS][1 << PART_BITS];

/* Bits of a burst as words, the first bit highest, with nothing before the first so that the last
 * word is full. */
typedef struct {
    uint64_t *hard;
    uint64_t *open; /* bits that follow from nothing, as one of the 18 is unknown */
    Sums *sums;
    uint8_t *summed; /* words whose sums are there */
    int bits, words, empty; /* empty: places of the first word before the first bit */
} Text;

/* Bits of which all of the last count, with their own, are one; more holds those of the word
 * before, then the word's own. */
static inline unsigned __int128 all_of_last(unsigned __int128 more, int count)
{
    int reach = 1;
    for (; 2 * reach <= count; reach *= 2) more &= more >> reach;
    return more & more >> (count - reach);
}

HOT static void write_text(const Tables *t, const int8_t *value, int bits, Text *text)
{
    uint64_t sure_before = 0, zero_before = ~0ull;
    text->bits = bits;
    text->words = (bits + 63) / 64;
    text->empty = 64 * text->words - bits;
    for (int w = 0, next = 0; w < text->words; w++) {
        const int to = 64 * (w + 1) - text->empty;
        uint64_t hard = 0, sure = 0;
        for (; next < to; next++) {
            const int soft = value[next];
            hard = hard << 1 | (uint64_t)(soft > 0);
            sure = sure << 1 | (uint64_t)(soft > t->unknown || soft < -t->unknown);
        }
        /* Known are to be the bit and the 17 before it, which must hold a one: state 0 follows
         * from itself. */
        const unsigned __int128 known = (unsigned __int128)sure_before << 64 | sure;
        const unsigned __int128 zeros = (unsigned __int128)zero_before << 64 | (uint64_t)~hard;
        text->hard[w] = hard;
        text->open[w] = ~(uint64_t)all_of_last(known, REGISTER + 1) |
                        (uint64_t)(all_of_last(zeros, REGISTER) >> 1);
        text->summed[w] = 0;
        sure_before = sure;
        zero_before = ~hard;
    }
}

HOT static void sum_word(const Text *text, int w)
{
    const uint64_t hard = text->hard[w], last = w ? text->hard[w - 1] : 0;
    for (int part = 0; part < PARTS; part++) {
        uint64_t *sums = text->sums[w][part];
        sums[0] = 0;
        for (int bit = 0; bit < PART_BITS; bit++) {
            const int by = 1 + part * PART_BITS + bit;
            const uint64_t before = hard >> by | last << (64 - by);
            for (int k = 0; k < 1 << bit; k++) sums[(1 << bit) + k] = sums[k] ^ before;
        }
    }
    text->summed[w] = 1;
}

/* Bits of a word, whose sums are there, that do not follow from the 17 before each. */
static inline uint64_t strangers(const Text *text, uint32_t taps, int w)
{
    const uint32_t part = (1 << PART_BITS) - 1;
    const uint64_t sum = text->sums[w][0][taps & part] ^
                         text->sums[w][1][taps >> PART_BITS & part] ^
                         text->sums[w][2][taps >> 2 * PART_BITS];
    return (text->hard[w] ^ sum) | text->open[w];
}

/* The polynomial under which most bits of a word follow from those before, the first of equals. */
HOT static int likeliest(const Tables *t, const Text *text, int w)
{
    int best = 0, fewest = 65;
    sum_word(text, w);
    for (int p = 0; p < t->polynomials; p++) {
        const int number = __builtin_popcountll(strangers(text, (uint32_t)t->taps[p], w));
        best = number < fewest ? p : best;
        fewest = number < fewest ? number : fewest;
    }
    return best;
}

/* Where the longest run of bits begins that follow from the 17 before each, the first of equals,
 * among the words from first to last; answers its length, or 0 where none is long enough. */
static int longest_run(const Tables *t, const Text *text, int polynomial, int first, int last,
                       int *begin)
{
    const uint32_t taps = (uint32_t)t->taps[polynomial];
    int longest = 0, from = 64 * first;
    for (int w = first; w < last; w++) {
        if (!text->summed[w]) sum_word(text, w);
        uint64_t bad = strangers(text, taps, w);
        if (!bad) continue;
        /* A word without a long run, and that ends none, needs no look at each bit. */
        uint64_t run = ~bad & ~bad >> 1;
        run &= run >> 2;
        if (t->follow >= 8) run &= run >> 4;
        if (!run && t->follow >= 4 && 64 * w - from + __builtin_clzll(bad) < t->follow) {
            from = 64 * w + 64 - __builtin_ctzll(bad);
            continue;
        }
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
    return longest < t->follow ? 0 : longest;
}

/* Place of the first bit, if the 17 bits before place k of the words stand in the sequence of a
 * polynomial. */
static int place_of(const Tables *t, const Text *text, int polynomial, int k)
{
    const uint64_t state =
        k % 64 ? text->hard[k / 64] >> (64 - k % 64) : text->hard[k / 64 - 1];
    const uint64_t more = k % 64 && k / 64 ? text->hard[k / 64 - 1] << k % 64 : 0;
    const int32_t index =
        t->index[(size_t)polynomial * (LENGTH + 1) + ((state | more) & LENGTH)];
    const int place = (index - (k - text->empty - REGISTER)) % LENGTH;
    return place < 0 ? place + LENGTH : place;
}

/* Row of one place: polynomial, place, score, begin, end, known, wrong. expected has room for the
 * bits of the burst and a register more. */
HOT static void score_place(const Tables *t, const int8_t *value, int bits, uint8_t *expected,
                        int polynomial, int place, int32_t *row)
{
    const int32_t *states = t->states + (size_t)polynomial * LENGTH;
    for (int k = 0, at = place; k < bits; k += REGISTER) {
        const int32_t ahead = states[at];
        for (int j = 0; j < REGISTER; j++) expected[k + j] = ahead >> (REGISTER - 1 - j) & 1;
        at += REGISTER;
        if (at >= LENGTH) at -= LENGTH;
    }
    int32_t total = 0, low = 0, best = 0;
    int low_at = 0, begin = 0, end = 0;
    for (int k = 0; k < bits; k++) {
        total += t->gain[expected[k]][value[k] + CERTAIN];
        low_at = total < low ? k + 1 : low_at;
        low = total < low ? total : low;
        const int higher = total - low > best;
        best = higher ? total - low : best;
        begin = higher ? low_at : begin;
        end = higher ? k + 1 : end;
    }
    int known = 0, wrong = 0;
    for (int k = begin; k < end; k++) {
        const int sure = value[k] > t->unknown || value[k] < -t->unknown;
        known += sure;
        wrong += sure & ((value[k] > 0) ^ expected[k]);
    }
    row[0] = polynomial;
    row[1] = place;
    row[2] = best;
    row[3] = begin;
    row[4] = end;
    row[5] = known;
    row[6] = wrong;
}

/* light_places(value, first, states, index, taps, polynomials, match, miss, unknown, follow, steps,
 * fastest, rows) */
PyObject *light_places(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer b[8];
    Tables t;
    int steps, fastest;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*iy*y*iiiiw*", &b[0], &b[1], &b[2], &b[3], &b[4],
                          &t.polynomials, &b[5], &b[6], &t.unknown, &t.follow, &steps, &fastest,
                          &b[7]))
        return NULL;
    const int8_t *values = b[0].buf;
    const int64_t *first = b[1].buf;
    t.states = b[2].buf;
    t.index = b[3].buf;
    t.taps = b[4].buf;
    weigh(&t, b[5].buf, b[6].buf);
    int32_t *rows = b[7].buf;
    const Py_ssize_t bursts = b[1].len / (Py_ssize_t)sizeof *first - 1;
    const int64_t most = most_of(first, bursts);
    const size_t words = (size_t)(most / 64 + 1);
    Text text = {.hard = malloc(words * sizeof *text.hard),
                 .open = malloc(words * sizeof *text.open),
                 .sums = malloc(words * sizeof *text.sums),
                 .summed = malloc(words)};
    uint8_t *expected = malloc((size_t)most + REGISTER);
    const int stored = text.hard && text.open && text.sums && text.summed && expected;
    for (Py_ssize_t i = 0; stored && i < bursts; i++) {
        const int8_t *value = values + first[i];
        const int bits = (int)(first[i + 1] - first[i]);
        int32_t *row = rows + 7 * i;
        if (bits < REGISTER + t.follow) continue;
        write_text(&t, value, bits, &text);
        /* The word in the middle tells of most bursts; of the others each word is asked. */
        const int middle = text.words / 2, likely = likeliest(&t, &text, middle);
        int at = 0;
        if (longest_run(&t, &text, likely, middle, middle + 1, &at)) {
            score_place(&t, value, bits, expected, likely, place_of(&t, &text, likely, at), row);
            /* A bit outside of its stretch can be worth one bit of evidence for another. */
            const int outside = bits - (row[4] - row[3]);
            if (row[2] >= fastest && row[2] > outside * steps) continue;
        }
        row[0] = row[1] = -1;
        for (int k = 2; k < 7; k++) row[k] = 0;
        for (int p = 0; p < t.polynomials; p++) {
            int32_t trial[7];
            if (!longest_run(&t, &text, p, 0, text.words, &at)) continue;
            score_place(&t, value, bits, expected, p, place_of(&t, &text, p, at), trial);
            if (trial[2] > row[2]) memcpy(row, trial, sizeof trial);
        }
    }
    free(text.hard);
    free(text.open);
    free(text.sums);
    free(text.summed);
    free(expected);
    return done(b, 8, stored);
}

/* light_expected(value, first, states, polynomial, index, each, reach, match, miss, unknown, rows):
 * the best of each burst's places, and of those up to reach bits beside them. */
PyObject *light_expected(PyObject *self, PyObject *args)
{
    (void)self;
    Py_buffer b[8];
    Tables t;
    int each, reach;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*iiy*y*iw*", &b[0], &b[1], &b[2], &b[3], &b[4], &each,
                          &reach, &b[5], &b[6], &t.unknown, &b[7]))
        return NULL;
    const int8_t *values = b[0].buf;
    const int64_t *first = b[1].buf, *index = b[4].buf;
    const int32_t *polynomial = b[3].buf;
    t.states = b[2].buf;
    weigh(&t, b[5].buf, b[6].buf);
    int32_t *rows = b[7].buf;
    const Py_ssize_t bursts = b[1].len / (Py_ssize_t)sizeof *first - 1;
    uint8_t *expected = malloc((size_t)most_of(first, bursts) + REGISTER);
    for (Py_ssize_t i = 0; expected && i < bursts; i++)
        for (int k = 0; k < each; k++)
            for (int step = -reach; step <= reach; step++) {
                int32_t trial[7];
                const int64_t place = (index[i * each + k] + step) % LENGTH;
                score_place(&t, values + first[i], (int)(first[i + 1] - first[i]), expected,
                            polynomial[i * each + k], (int)(place < 0 ? place + LENGTH : place),
                            trial);
                if (trial[2] > rows[7 * i + 2]) memcpy(rows + 7 * i, trial, sizeof trial);
            }
    free(expected);
    return done(b, 8, expected != NULL);
}
