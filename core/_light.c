/* Hot loops of core/lighthouse: edges of sampled light, soft bits of bursts, the identification of
 * their sequences, epochs, and positions. The numpy twins in locatk.core.lighthouse document the
 * methods.
 */
#include "_kernels.h"
#include <math.h>
#include <stdlib.h>
#include <string.h>

#define PI 3.14159265358979323846

/* ---- Bits of words ---------------------------------------------------------------------- */

/* Number of zeros before the first one of a word that is not 0, from its highest bit, and after
 * the last one. */
#ifdef _MSC_VER
#include <intrin.h>
static inline int leading_zeros(uint64_t word)
{
    unsigned long bit;
    _BitScanReverse64(&bit, word);
    return 63 - (int)bit;
}

static inline int trailing_zeros(uint64_t word)
{
    unsigned long bit;
    _BitScanForward64(&bit, word);
    return (int)bit;
}
#else
static inline int leading_zeros(uint64_t word) { return __builtin_clzll(word); }

static inline int trailing_zeros(uint64_t word) { return __builtin_ctzll(word); }
#endif

/* Number of ones of a word. Compilers replace the sum of pairs, fours and bytes of bits by the
 * instruction of the processor, if it has one. */
static inline int count_ones(uint64_t word)
{
    word -= word >> 1 & 0x5555555555555555u;
    word = (word & 0x3333333333333333u) + (word >> 2 & 0x3333333333333333u);
    word = (word + (word >> 4)) & 0x0F0F0F0F0F0F0F0Fu;
    return (int)(word * 0x0101010101010101u >> 56);
}

/* ---- Edges of windows of samples -------------------------------------------------------- */

static inline uint64_t big_endian(const uint8_t *bytes)
{
    uint64_t word = 0;
    for (int k = 0; k < 8; k++) word = word << 8 | bytes[k];
    return word;
}

/* Write the edges of one packed row of `width` bytes to `tick`; return their number. `base` is the
 * tick of the first sample, and `first_level` receives its level. */
static int64_t row_edges(const uint8_t *row, int width, int64_t base, int64_t *tick,
                         int *first_level)
{
    const int words = (width + 7) / 8;
    int64_t count = 0;
    uint64_t last = row[0] >> 7;
    *first_level = (int)last;
    for (int w = 0; w < words; w++) {
        uint8_t padded[8];
        const uint8_t *bytes = row + 8 * w;
        const int available = width - 8 * w < 8 ? width - 8 * w : 8;
        if (available < 8) {
            /* Beyond the end of the row the level does not change. */
            memset(padded, row[width - 1] & 1 ? 0xFF : 0, 8);
            memcpy(padded, bytes, (size_t)available);
            bytes = padded;
        }
        const uint64_t word = big_endian(bytes);
        uint64_t changed = word ^ (word >> 1 | last << 63);
        last = word & 1;
        while (changed) {
            const int bit = leading_zeros(changed);
            tick[count++] = base + 64 * w + bit;
            changed &= ~(0x8000000000000000ull >> bit);
        }
    }
    return count;
}

/* Largest number of bytes of a window, so that an index of its samples fits into an int. */
enum { MAX_WINDOW_BYTES = INT_MAX / 64 };

PyObject *window_edges(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *windows_array, *tick_array, *first_array, *rises_array;
    long long width;
    if (!parse_arguments(args, "OLOOO:window_edges", &windows_array, &width, &tick_array,
                         &first_array, &rises_array))
        return NULL;
    check_range(&call, "width", width, 1, MAX_WINDOW_BYTES);
    if (call.failed) return NULL;
    Py_ssize_t rows;
    const uint8_t *windows =
        input_rows(&call, windows_array, "windows", ITEM_UINT8, (Py_ssize_t)width, &rows);
    /* A row of 8 * width samples has fewer edges than samples. */
    int64_t *tick = output(&call, tick_array, "tick", ITEM_INT64, ITEMS(rows, width, 8));
    int64_t *first = output(&call, first_array, "first", ITEM_INT64, rows + 1);
    uint8_t *rises = output(&call, rises_array, "rises", ITEM_UINT8, rows);
    if (call.failed) return finish_call(&call, 1);
    first[0] = 0;
    for (Py_ssize_t i = 0; i < rows; i++) {
        int first_level;
        const int64_t count = row_edges(windows + i * width, (int)width, (int64_t)i * 8 * width,
                                        tick + first[i], &first_level);
        rises[i] = count > 0 && !first_level;
        first[i + 1] = first[i] + count;
    }
    return finish_call(&call, 1);
}

/* ---- Soft bits -------------------------------------------------------------------------- */

#define SINE_STEPS 4096      /* steps of one period in the table of sines */
#define MAX_RUN_CHIPS 3.0    /* longer runs between edges are limited to this */
#define MIN_ODD_EXCESS 1e-3f /* bits start at the second chip only beyond this evidence */
#define FULL_LEVEL (1 << 20) /* a level as a whole number, so that sums are exact */
static int32_t sines[SINE_STEPS + SINE_STEPS / 4]; /* sine; a quarter of a period later cosine */

static void make_sines(void)
{
    if (sines[SINE_STEPS / 4] != 0) return;
    for (int k = 0; k < SINE_STEPS + SINE_STEPS / 4; k++)
        sines[k] = (int32_t)rint(sin(2 * PI / SINE_STEPS * k) * 16384);
}

/* Round to the nearest whole number. Sampled times are often halves: these round up despite small
 * numeric errors. */
static inline double round_half_up(double value) { return floor(value + (0.5 + 1e-6)); }

/* Start of the chip before the first edge, and the delay (skew) of edges in the first edge's
 * direction relative to the others. `time` holds the edges [chips since the first edge]. */
HOT static double fit_chip_grid(const double *time, int edges, double *skew)
{
    int64_t sine[2] = {0, 0}, cosine[2] = {0, 0};
    double phase[2], run[2] = {0, 0};
    /* Both directions in one pass, so that their sums are computed in parallel. */
    for (int k = 0; k < edges; k += 2) {
        for (int kind = 0; kind < 2 && k + kind < edges; kind++) {
            const double chips = time[k + kind];
            const int step =
                (int)((chips - (double)(int)chips) * SINE_STEPS + 0.5) & (SINE_STEPS - 1);
            sine[kind] += sines[step];
            cosine[kind] += sines[step + SINE_STEPS / 4];
            if (k + kind + 1 < edges) {
                const double length = time[k + kind + 1] - chips;
                run[kind] += length < MAX_RUN_CHIPS ? length : MAX_RUN_CHIPS;
            }
        }
    }
    for (int kind = 0; kind < 2; kind++)
        phase[kind] = atan2((double)sine[kind], (double)cosine[kind]) / (2 * PI);
    /* Phases are ambiguous by whole chips. The mean lengths of the runs resolve the ambiguity. */
    double run_skew = 0;
    if (run[1] > 0) run_skew = (run[1] / ((edges - 1) / 2) - run[0] / (edges / 2)) / 2;
    run_skew = run_skew > 0.5 ? 0.5 : run_skew < -0.5 ? -0.5 : run_skew;
    *skew = phase[0] - phase[1];
    *skew -= round_half_up(*skew - run_skew);
    return phase[0] - 0.5 * *skew - 1;
}

/* Compute the mean levels of all chips of a burst and return their number. `sign` is the direction
 * of the first edge; `begin` receives the start of the first chip. */
HOT static int chip_levels(const double *time, int edges, int sign, int max_chips, double *begin,
                           int32_t *mean)
{
    double skew;
    *begin = fit_chip_grid(time, edges, &skew);
    const double shift[2] = {-0.5 * skew, 0.5 * skew};
    /* Times ascend, so that the latest shifted edge is one of the last two. */
    const int final = edges - 1;
    double last = time[final] + shift[final & 1];
    const double other = time[final - 1] + shift[(final - 1) & 1];
    last = other > last ? other : last;
    const double whole = round_half_up(last - *begin) + 1;
    const int chips = whole < max_chips ? (int)whole : max_chips;
    /* An edge changes the mean of its own chip in part, and that of all later chips fully. */
    memset(mean, 0, (size_t)(chips + 2) * sizeof *mean);
    int32_t negate = sign < 0 ? -1 : 0; /* (x ^ -1) - -1 is -x */
    last = time[0] + shift[0];
    for (int k = 0; k < edges; k++) {
        double t = time[k] + shift[k & 1];
        t = t > last ? t : last;
        last = t;
        const double position = t - *begin;
        const int chip = (int)position;
        if (chip >= chips) break;
        const int32_t late = (int32_t)((position - chip) * FULL_LEVEL);
        mean[chip] += (2 * (FULL_LEVEL - late) ^ negate) - negate;
        mean[chip + 1] += (2 * late ^ negate) - negate;
        negate = ~negate;
    }
    int32_t level = -sign * FULL_LEVEL;
    for (int k = 0; k < chips; k++) {
        level += mean[k];
        mean[k] = level;
    }
    return chips;
}

static inline int32_t magnitude(int32_t x) { return (x < 0 ? -x : x) >> 6; }

/* Compute the soft bits of a burst from its chips and return their number. `odd` receives 1 if the
 * first chip is the second half of a bit. `change` is scratch memory for one number per chip. */
HOT static int soft_bits_of_chips(const int32_t *restrict mean, int chips, int *odd,
                                  int32_t *restrict change, int8_t *restrict value)
{
    int32_t middles = 0, borders = 0;
    for (int k = 0; k + 1 < chips; k += 2) middles += magnitude(mean[k + 1] - mean[k]);
    for (int k = 1; k + 1 < chips; k += 2) borders += magnitude(mean[k + 1] - mean[k]);
    *odd = middles > borders + (int32_t)(MIN_ODD_EXCESS * FULL_LEVEL) / 64;
    const int32_t *m = mean + *odd;
    const int bits = (chips - *odd) / 2;
    if (bits < 1) return 0;
    change[0] = 2 * m[0];
    for (int k = 1; k < bits; k++) change[k] = m[2 * k] - m[2 * k - 1];
    change[bits] = -2 * m[2 * bits - 1];
    for (int k = 0; k < bits; k++) {
        float soft = (float)change[k] * (float)change[k + 1] * (16.0f / FULL_LEVEL / FULL_LEVEL);
        soft = soft > 64 ? 64 : soft < -64 ? -64 : soft;
        value[k] = (int8_t)(int32_t)rintf(soft);
    }
    return bits;
}

/* Most chips of a burst that are demodulated: the sums of their changes fit into an int32. */
enum { MAX_CHIPS = 1 << 16 };

/* Longest duration of a burst that is demodulated [chips]: its edges, in chips, fit into an int.
 */
#define MAX_BURST_CHIPS ((double)(1 << 30))

/* Check the edges of the bursts that are demodulated. Return the largest number of edges. */
static int64_t check_bursts(Call *call, const int64_t *tick, const int64_t *first,
                            const uint8_t *readable, Py_ssize_t bursts, double ticks_per_chip)
{
    int64_t max_edges = 1;
    for (Py_ssize_t i = 0; i < bursts && !call->failed; i++) {
        if (!readable[i]) continue;
        const int64_t edges = first[i + 1] - first[i];
        if (edges < 2 || edges > INT_MAX) {
            reject(call, "readable[%zd] is set for a burst of %lld edges", i, (long long)edges);
            return max_edges;
        }
        int descends = 0;
        for (int64_t k = first[i] + 1; k < first[i + 1]; k++) descends |= tick[k] < tick[k - 1];
        const uint64_t duration = (uint64_t)tick[first[i + 1] - 1] - (uint64_t)tick[first[i]];
        if (descends)
            reject(call, "tick descends within burst %zd", i);
        else if (duration > INT64_MAX || (double)duration / ticks_per_chip > MAX_BURST_CHIPS)
            reject(call, "tick: burst %zd is too long to be demodulated", i);
        max_edges = edges > max_edges ? edges : max_edges;
    }
    return max_edges;
}

PyObject *light_bits(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *tick_array, *first_array, *rises_array, *readable_array, *value_array,
        *value_first_array, *start_array;
    double ticks_per_chip;
    long long max_chips;
    if (!parse_arguments(args, "OOOOdLOOO:light_bits", &tick_array, &first_array, &rises_array,
                         &readable_array, &ticks_per_chip, &max_chips, &value_array,
                         &value_first_array, &start_array))
        return NULL;
    check_positive(&call, "ticks_per_chip", ticks_per_chip);
    check_positive(&call, "1 / ticks_per_chip", 1 / ticks_per_chip);
    check_range(&call, "max_chips", max_chips, 1, MAX_CHIPS);
    if (call.failed) return NULL;
    Py_ssize_t ticks, bursts, capacity;
    const int64_t *tick = input_rows(&call, tick_array, "tick", ITEM_INT64, 1, &ticks);
    const uint8_t *rises = input_rows(&call, rises_array, "rises", ITEM_FLAG, 1, &bursts);
    const uint8_t *readable = input(&call, readable_array, "readable", ITEM_FLAG, bursts);
    const int64_t *first = input(&call, first_array, "first", ITEM_INT64, bursts + 1);
    int8_t *value = output_any(&call, value_array, "value", ITEM_INT8, &capacity);
    int64_t *value_first = output(&call, value_first_array, "value_first", ITEM_INT64, bursts + 1);
    double *start = output(&call, start_array, "start", ITEM_FLOAT64, bursts);
    check_offsets(&call, "first", first, bursts + 1, ticks);
    const int64_t max_edges =
        check_bursts(&call, tick, first, readable, call.failed ? 0 : bursts, ticks_per_chip);
    if (call.failed) return finish_call(&call, 1);
    double *time = malloc((size_t)max_edges * sizeof *time);
    int32_t *mean = malloc(2 * (size_t)(max_chips + 8) * sizeof *mean);
    if (!time || !mean) {
        free(time);
        free(mean);
        return finish_call(&call, 0);
    }
    make_sines();
    value_first[0] = 0;
    for (Py_ssize_t i = 0; i < bursts; i++) {
        const int64_t edges = first[i + 1] - first[i];
        int bits = 0;
        start[i] = 0;
        if (readable[i]) {
            const int64_t origin = tick[first[i]];
            const double chips_per_tick = 1 / ticks_per_chip;
            for (int64_t k = 0; k < edges; k++)
                time[k] = (double)(tick[first[i] + k] - origin) * chips_per_tick;
            double begin;
            int odd;
            /* Bits that the array has no memory for are dropped. */
            const int64_t free_chips = 2 * (capacity - value_first[i]);
            const int limit = free_chips < max_chips ? (int)free_chips : (int)max_chips;
            const int chips =
                chip_levels(time, (int)edges, rises[i] ? 1 : -1, limit, &begin, mean);
            bits = soft_bits_of_chips(mean, chips, &odd, mean + max_chips + 8,
                                      value + value_first[i]);
            start[i] = (double)origin + (begin + odd) * ticks_per_chip;
        }
        value_first[i + 1] = value_first[i] + bits;
    }
    free(time);
    free(mean);
    return finish_call(&call, 1);
}

/* ---- Polynomial and index --------------------------------------------------------------- */

#define REGISTER_BITS 17
#define SEQUENCE_LENGTH 131071 /* also the mask of a register's bits */
#define MAX_SOFT_BIT 64        /* magnitude of a soft bit that is certain */
#define ROW_COLUMNS 7          /* polynomial, index, evidence, begin, end, known, wrong */

/* Most bits of a burst, so that an index over them fits into an int. */
#define MAX_BURST_BITS (INT_MAX / 64)

typedef struct {
    const int32_t *states, *index, *taps;
    int polynomials, unknown, min_run;
    int32_t gain[2][2 * MAX_SOFT_BIT + 1]; /* evidence of a soft bit if 0 and if 1 is expected */
} Tables;

/* Fill the table of gains from the evidence of a soft bit of each size that matches or misses. */
static void fill_gains(Tables *t, const int32_t *match, const int32_t *miss)
{
    for (int v = -MAX_SOFT_BIT; v <= MAX_SOFT_BIT; v++) {
        const int size = v < 0 ? -v : v;
        t->gain[0][v + MAX_SOFT_BIT] = v > 0 ? miss[size] : match[size];
        t->gain[1][v + MAX_SOFT_BIT] = v > 0 ? match[size] : miss[size];
    }
}

/* Soft bits of bursts: burst i has the values first[i] to first[i + 1]. */
typedef struct {
    const int8_t *value;
    const int64_t *first;
    Py_ssize_t bursts;
    int64_t max_bits;
} Bursts;

/* Check soft bits and their offsets, and fill the table of gains. */
static Bursts take_bursts(Call *call, PyObject *value_array, PyObject *first_array,
                          PyObject *match_array, PyObject *miss_array, long long unknown,
                          Tables *t)
{
    const int sizes = MAX_SOFT_BIT + 1;
    Bursts b = {.max_bits = 1};
    Py_ssize_t values, offsets;
    b.value = input_rows(call, value_array, "value", ITEM_INT8, 1, &values);
    check_items(call, "value", b.value, ITEM_INT8, values, -MAX_SOFT_BIT, MAX_SOFT_BIT);
    b.first = input_rows(call, first_array, "first", ITEM_INT64, 1, &offsets);
    check_range(call, "number of first", offsets, 1, PY_SSIZE_T_MAX);
    check_offsets(call, "first", b.first, offsets, values);
    const int32_t *match = input(call, match_array, "match", ITEM_INT32, sizes);
    const int32_t *miss = input(call, miss_array, "miss", ITEM_INT32, sizes);
    check_range(call, "unknown", unknown, 0, MAX_SOFT_BIT);
    if (call->failed) return b;
    b.bursts = offsets - 1;
    for (Py_ssize_t i = 0; i < b.bursts; i++) {
        const int64_t bits = b.first[i + 1] - b.first[i];
        b.max_bits = bits > b.max_bits ? bits : b.max_bits;
    }
    check_range(call, "number of bits of a burst", b.max_bits, 0, MAX_BURST_BITS);
    /* The evidence of all bits of a burst fits into an int32. */
    const long long max_gain = INT32_MAX / b.max_bits;
    check_items(call, "match", match, ITEM_INT32, sizes, -max_gain, max_gain);
    check_items(call, "miss", miss, ITEM_INT32, sizes, -max_gain, max_gain);
    if (call->failed) return b;
    t->unknown = (int)unknown;
    fill_gains(t, match, miss);
    return b;
}

/* The 17 taps of a polynomial are divided into three parts. For each part, all sums (exclusive or)
 * of delayed words are tabulated; the sum of a polynomial is then three table accesses. */
#define PARTS 3
#define PART_BITS 6
typedef uint64_t Sums[PARTS][1 << PART_BITS];

/* Bits of a burst as words, the first bit highest. The first word is padded so that the last is
 * full. */
typedef struct {
    uint64_t *hard;
    uint64_t *open; /* bits that cannot be predicted: one of the 18 involved is unknown */
    Sums *sums;
    uint8_t *summed;          /* 1 for words whose sums are computed */
    int bits, words, padding; /* padding: bits of the first word before the first bit */
} BitWords;

/* A word of bits and the one before it. */
typedef struct {
    uint64_t previous, word;
} Pair;

/* Delay a pair by 0 to 63 bits. */
static inline Pair delay_bits(Pair bits, int delay)
{
    const Pair result = {bits.previous >> delay,
                         bits.word >> delay | bits.previous << 1 << (63 - delay)};
    return result;
}

/* Bits for which the last `count` bits, including their own, are all one. */
static inline Pair all_of_last(Pair bits, int count)
{
    for (int span = 1, step; span < count; span += step) {
        step = 2 * span <= count ? span : count - span;
        const Pair earlier = delay_bits(bits, step);
        bits.previous &= earlier.previous;
        bits.word &= earlier.word;
    }
    return bits;
}

HOT static void write_words(const Tables *t, const int8_t *value, int bits, BitWords *text)
{
    uint64_t known_before = 0, zero_before = ~0ull;
    text->bits = bits;
    text->words = (bits + 63) / 64;
    text->padding = 64 * text->words - bits;
    for (int w = 0, next = 0; w < text->words; w++) {
        const int to = 64 * (w + 1) - text->padding;
        uint64_t hard = 0, known = 0;
        for (; next < to; next++) {
            const int soft = value[next];
            hard = hard << 1 | (uint64_t)(soft > 0);
            known = known << 1 | (uint64_t)(soft > t->unknown || soft < -t->unknown);
        }
        /* A bit is predicted if it and the 17 before it are known, and if these hold a one: state
         * 0 is not part of the sequence. */
        const Pair known_pair = {known_before, known}, zero_pair = {zero_before, ~hard};
        text->hard[w] = hard;
        text->open[w] = ~all_of_last(known_pair, REGISTER_BITS + 1).word
                        | delay_bits(all_of_last(zero_pair, REGISTER_BITS), 1).word;
        text->summed[w] = 0;
        known_before = known;
        zero_before = ~hard;
    }
}

HOT static void sum_word(const BitWords *text, int w)
{
    const uint64_t hard = text->hard[w], previous = w ? text->hard[w - 1] : 0;
    for (int part = 0; part < PARTS; part++) {
        uint64_t *sums = text->sums[w][part];
        sums[0] = 0;
        for (int bit = 0; bit < PART_BITS; bit++) {
            const int delay = 1 + part * PART_BITS + bit;
            const uint64_t delayed = hard >> delay | previous << (64 - delay);
            for (int k = 0; k < 1 << bit; k++) sums[(1 << bit) + k] = sums[k] ^ delayed;
        }
    }
    text->summed[w] = 1;
}

/* Bits of a word that do not follow from the 17 bits before them. The word's sums are computed. */
static inline uint64_t mispredictions(const BitWords *text, uint32_t taps, int w)
{
    const uint32_t part = (1 << PART_BITS) - 1;
    const uint64_t sum = text->sums[w][0][taps & part] ^ text->sums[w][1][taps >> PART_BITS & part]
                         ^ text->sums[w][2][taps >> 2 * PART_BITS];
    return (text->hard[w] ^ sum) | text->open[w];
}

/* First of the polynomials that predict the most bits of a word. */
HOT static int best_polynomial(const Tables *t, const BitWords *text, int w)
{
    int best = 0, min_mispredictions = 65;
    sum_word(text, w);
    for (int p = 0; p < t->polynomials; p++) {
        const int number = count_ones(mispredictions(text, (uint32_t)t->taps[p], w));
        best = number < min_mispredictions ? p : best;
        min_mispredictions = number < min_mispredictions ? number : min_mispredictions;
    }
    return best;
}

/* Find the first of the longest runs of predicted bits in the words from `first` up to `last`.
 * Return its length and write its start to `begin`; return 0 if it is shorter than min_run. */
static int longest_run(const Tables *t, const BitWords *text, int polynomial, int first, int last,
                       int *begin)
{
    const uint32_t taps = (uint32_t)t->taps[polynomial];
    int max_run = 0, run_begin = 64 * first;
    for (int w = first; w < last; w++) {
        if (!text->summed[w]) sum_word(text, w);
        uint64_t wrong = mispredictions(text, taps, w);
        if (!wrong) continue;
        /* A word that neither contains nor ends a long run is skipped. */
        uint64_t run = ~wrong & ~wrong >> 1;
        run &= run >> 2;
        if (t->min_run >= 8) run &= run >> 4;
        if (!run && t->min_run >= 4 && 64 * w - run_begin + leading_zeros(wrong) < t->min_run) {
            run_begin = 64 * w + 64 - trailing_zeros(wrong);
            continue;
        }
        while (wrong) {
            const int bit = leading_zeros(wrong), position = 64 * w + bit;
            if (position - run_begin > max_run) {
                max_run = position - run_begin;
                *begin = run_begin;
            }
            run_begin = position + 1;
            wrong &= ~(0x8000000000000000ull >> bit);
        }
    }
    if (64 * last - run_begin > max_run) {
        max_run = 64 * last - run_begin;
        *begin = run_begin;
    }
    return max_run < t->min_run ? 0 : max_run;
}

/* Index of the first bit in the sequence of a polynomial, from the 17 bits before position k of
 * the words. */
static int index_of_first_bit(const Tables *t, const BitWords *text, int polynomial, int k)
{
    const uint64_t state = k % 64 ? text->hard[k / 64] >> (64 - k % 64) : text->hard[k / 64 - 1];
    const uint64_t previous = k % 64 && k / 64 ? text->hard[k / 64 - 1] << k % 64 : 0;
    const int32_t index = t->index[(size_t)polynomial * (SEQUENCE_LENGTH + 1)
                                   + ((state | previous) & SEQUENCE_LENGTH)];
    const int64_t steps = k - text->padding - REGISTER_BITS;
    const int index_at_start = (int)((index - steps) % SEQUENCE_LENGTH);
    return index_at_start < 0 ? index_at_start + SEQUENCE_LENGTH : index_at_start;
}

/* Score one index of a burst and write its row. `expected` is scratch memory for the bits of the
 * burst and of one register. */
HOT static void score_index(const Tables *t, const int8_t *value, int bits, uint8_t *expected,
                            int polynomial, int index, int32_t *row)
{
    const int32_t *states = t->states + (size_t)polynomial * SEQUENCE_LENGTH;
    for (int k = 0, state_index = index; k < bits; k += REGISTER_BITS) {
        const int32_t next_bits = states[state_index];
        for (int j = 0; j < REGISTER_BITS; j++)
            expected[k + j] = next_bits >> (REGISTER_BITS - 1 - j) & 1;
        state_index += REGISTER_BITS;
        if (state_index >= SEQUENCE_LENGTH) state_index -= SEQUENCE_LENGTH;
    }
    int32_t total = 0, lowest = 0, best = 0;
    int lowest_at = 0, begin = 0, end = 0;
    for (int k = 0; k < bits; k++) {
        total += t->gain[expected[k]][value[k] + MAX_SOFT_BIT];
        lowest_at = total < lowest ? k + 1 : lowest_at;
        lowest = total < lowest ? total : lowest;
        const int is_better = total - lowest > best;
        best = is_better ? total - lowest : best;
        begin = is_better ? lowest_at : begin;
        end = is_better ? k + 1 : end;
    }
    int known = 0, wrong = 0;
    for (int k = begin; k < end; k++) {
        const int is_known = value[k] > t->unknown || value[k] < -t->unknown;
        known += is_known;
        wrong += is_known & ((value[k] > 0) ^ expected[k]);
    }
    row[0] = polynomial;
    row[1] = index;
    row[2] = best;
    row[3] = begin;
    row[4] = end;
    row[5] = known;
    row[6] = wrong;
}

/* Check the table of states and return its number of polynomials. */
static Py_ssize_t take_states(Call *call, PyObject *states_array, Tables *t)
{
    Py_ssize_t polynomials;
    t->states =
        input_rows(call, states_array, "states", ITEM_INT32, SEQUENCE_LENGTH, &polynomials);
    check_range(call, "number of polynomials in states", polynomials, 1, INT_MAX);
    return polynomials;
}

/* Identify one burst: its polynomial, index and score as a row. */
static void identify_burst(const Tables *t, const int8_t *value, int bits, BitWords *text,
                           uint8_t *expected, int64_t steps, int64_t min_evidence, int32_t *row)
{
    write_words(t, value, bits, text);
    /* The central word is usually sufficient; otherwise all words are examined. */
    const int middle = text->words / 2, likely = best_polynomial(t, text, middle);
    int begin = 0;
    if (longest_run(t, text, likely, middle, middle + 1, &begin)) {
        score_index(t, value, bits, expected, likely, index_of_first_bit(t, text, likely, begin),
                    row);
        /* A bit outside of the stretch adds at most one bit to the evidence of another index. */
        const int outside = bits - (row[4] - row[3]);
        if (row[2] >= min_evidence && row[2] > outside * steps) return;
    }
    row[0] = row[1] = -1;
    for (int k = 2; k < ROW_COLUMNS; k++) row[k] = 0;
    for (int p = 0; p < t->polynomials; p++) {
        int32_t trial[ROW_COLUMNS];
        if (!longest_run(t, text, p, 0, text->words, &begin)) continue;
        score_index(t, value, bits, expected, p, index_of_first_bit(t, text, p, begin), trial);
        if (trial[2] > row[2]) memcpy(row, trial, sizeof trial);
    }
}

PyObject *light_places(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *value_array, *first_array, *states_array, *index_array, *taps_array, *match_array,
        *miss_array, *rows_array;
    long long polynomials, unknown, min_run, steps, min_evidence;
    if (!parse_arguments(args, "OOOOOLOOLLLLO:light_places", &value_array, &first_array,
                         &states_array, &index_array, &taps_array, &polynomials, &match_array,
                         &miss_array, &unknown, &min_run, &steps, &min_evidence, &rows_array))
        return NULL;
    Tables t;
    const Bursts b =
        take_bursts(&call, value_array, first_array, match_array, miss_array, unknown, &t);
    const Py_ssize_t known = take_states(&call, states_array, &t);
    t.index = input(&call, index_array, "index", ITEM_INT32, ITEMS(known, SEQUENCE_LENGTH + 1));
    t.taps = input(&call, taps_array, "taps", ITEM_INT32, known);
    check_items(&call, "taps", t.taps, ITEM_INT32, known, 0, SEQUENCE_LENGTH);
    check_range(&call, "polynomials", polynomials, 1, known);
    check_range(&call, "min_run", min_run, 1, MAX_BURST_BITS);
    check_range(&call, "steps", steps, 0, INT_MAX);
    check_range(&call, "min_evidence", min_evidence, INT_MIN, INT_MAX);
    int32_t *rows = output(&call, rows_array, "rows", ITEM_INT32, ITEMS(b.bursts, ROW_COLUMNS));
    if (call.failed) return finish_call(&call, 1);
    t.polynomials = (int)polynomials;
    t.min_run = (int)min_run;
    const size_t words = (size_t)(b.max_bits / 64 + 1);
    BitWords text = {.hard = malloc(words * sizeof *text.hard),
                     .open = malloc(words * sizeof *text.open),
                     .sums = malloc(words * sizeof *text.sums),
                     .summed = malloc(words)};
    uint8_t *expected = malloc((size_t)b.max_bits + REGISTER_BITS);
    const int has_memory = text.hard && text.open && text.sums && text.summed && expected;
    for (Py_ssize_t i = 0; has_memory && i < b.bursts; i++) {
        const int bits = (int)(b.first[i + 1] - b.first[i]);
        if (bits >= REGISTER_BITS + t.min_run)
            identify_burst(&t, b.value + b.first[i], bits, &text, expected, steps, min_evidence,
                           rows + ROW_COLUMNS * i);
    }
    free(text.hard);
    free(text.open);
    free(text.sums);
    free(text.summed);
    free(expected);
    return finish_call(&call, has_memory);
}

/* Write the best score of each burst among its candidate indices and those up to `search_range`
 * bits before and after them. */
PyObject *light_expected(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *value_array, *first_array, *states_array, *polynomial_array, *index_array,
        *match_array, *miss_array, *rows_array;
    long long candidates, search_range, unknown;
    if (!parse_arguments(args, "OOOOOLLOOLO:light_expected", &value_array, &first_array,
                         &states_array, &polynomial_array, &index_array, &candidates,
                         &search_range, &match_array, &miss_array, &unknown, &rows_array))
        return NULL;
    Tables t;
    const Bursts b =
        take_bursts(&call, value_array, first_array, match_array, miss_array, unknown, &t);
    const Py_ssize_t known = take_states(&call, states_array, &t);
    check_range(&call, "candidates", candidates, 0, INT_MAX);
    check_range(&call, "search_range", search_range, 0, SEQUENCE_LENGTH);
    const Py_ssize_t pairs = ITEMS(b.bursts, candidates);
    const int32_t *polynomial = input(&call, polynomial_array, "polynomial", ITEM_INT32, pairs);
    check_items(&call, "polynomial", polynomial, ITEM_INT32, pairs, 0, known - 1);
    const int64_t *index = input(&call, index_array, "index", ITEM_INT64, pairs);
    int32_t *rows = output(&call, rows_array, "rows", ITEM_INT32, ITEMS(b.bursts, ROW_COLUMNS));
    if (call.failed) return finish_call(&call, 1);
    uint8_t *expected = malloc((size_t)b.max_bits + REGISTER_BITS);
    for (Py_ssize_t k = 0; expected && k < pairs; k++) {
        const Py_ssize_t i = k / (Py_ssize_t)candidates;
        const int64_t centre = index[k] % SEQUENCE_LENGTH;
        int32_t *row = rows + ROW_COLUMNS * i;
        for (int64_t step = -search_range; step <= search_range; step++) {
            int32_t trial[ROW_COLUMNS];
            const int64_t trial_index = (centre + step) % SEQUENCE_LENGTH;
            score_index(&t, b.value + b.first[i], (int)(b.first[i + 1] - b.first[i]), expected,
                        polynomial[k],
                        (int)(trial_index < 0 ? trial_index + SEQUENCE_LENGTH : trial_index),
                        trial);
            if (trial[2] > row[2]) memcpy(row, trial, sizeof trial);
        }
    }
    free(expected);
    return finish_call(&call, expected != NULL);
}

/* ---- Epochs of sweeps --------------------------------------------------------------------- */

/* Number the epochs of pairs of sweeps, which are sorted by photodiode and time. */
PyObject *light_epochs(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *starts_array, *time_array, *planes_array, *epoch_array;
    long long n;
    double max_epoch_ns;
    if (!parse_arguments(args, "OOOLdO:light_epochs", &starts_array, &time_array, &planes_array,
                         &n, &max_epoch_ns, &epoch_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_positive(&call, "max_epoch_ns", max_epoch_ns);
    const uint8_t *starts = input(&call, starts_array, "starts", ITEM_FLAG, ITEMS(n));
    const double *time_ns = input(&call, time_array, "time_ns", ITEM_FLOAT64, ITEMS(n));
    const int64_t *planes = input(&call, planes_array, "planes", ITEM_INT64, ITEMS(n));
    int64_t *epoch = output(&call, epoch_array, "epoch", ITEM_INT64, ITEMS(n));
    if (call.failed) return finish_call(&call, 1);
    int64_t number = -1, epoch_planes = 0;
    double epoch_start_ns = 0;
    for (long long k = 0; k < n; k++) {
        if (k == 0 || starts[k] || epoch_planes & planes[k]
            || time_ns[k] - epoch_start_ns > max_epoch_ns) {
            number++;
            epoch_planes = 0;
            epoch_start_ns = time_ns[k];
        }
        epoch_planes |= planes[k];
        epoch[k] = number;
    }
    return finish_call(&call, 1);
}

/* ---- Positions of photodiodes ------------------------------------------------------------- */

/* Position, rotation to the frame (row by row) and tangents of both tilts of one station. */
enum { STATION_NUMBERS = 14 };
enum { MAX_STATIONS = 1 << 10, MAX_PASSES = 100 };

/* Light plane of one sweep: its normal in the frame, its product with the position of its station,
 * and the distance of the photodiode from the axis on which it rotates. */
typedef struct {
    double normal[3], offset, lever_arm;
    int station, plane;
} LightPlane;

static inline double dot(const double *a, const double *b)
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

/* Write the light planes of the angles (s, 2) of one epoch; return their number. */
static int observed_planes(const double *angle, const double *stations, int s, LightPlane *planes)
{
    int count = 0;
    for (int k = 0; k < 2 * s; k++) {
        if (!isfinite(angle[k])) continue;
        const double *station = stations + STATION_NUMBERS * (k / 2), *rotation = station + 3;
        const double local[3] = {-sin(angle[k]), cos(angle[k]), -station[12 + k % 2]};
        LightPlane *plane = planes + count++;
        for (int i = 0; i < 3; i++) plane->normal[i] = dot(rotation + 3 * i, local);
        plane->offset = dot(plane->normal, station);
        plane->lever_arm = 1;
        plane->station = k / 2;
        plane->plane = k % 2;
    }
    return count;
}

/* Solve a symmetric system of `dims` unknowns by cofactors. The solution is nan if the matrix is
 * singular to rounding. */
static void solve_symmetric(const double matrix[3][3], const double *right, int dims,
                            double *solution)
{
    const double(*m)[3] = matrix;
    double inverse[3][3] = {{0}}, determinant, size = m[0][0] + m[1][1], limit;
    if (dims == 2) {
        inverse[0][0] = m[1][1];
        inverse[0][1] = inverse[1][0] = -m[0][1];
        inverse[1][1] = m[0][0];
        determinant = m[0][0] * m[1][1] - m[0][1] * m[0][1];
        limit = 1e-12 * size * size;
    } else {
        for (int i = 0; i < 3; i++)
            for (int j = 0; j < 3; j++) {
                const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
                inverse[i][j] = m[a][c] * m[b][d] - m[a][d] * m[b][c];
            }
        determinant = dot(m[0], inverse[0]);
        size += m[2][2];
        limit = 1e-12 * size * size * size;
    }
    for (int i = 0; i < dims; i++)
        solution[i] = fabs(determinant) <= limit ? NAN : dot(inverse[i], right) / determinant;
}

/* Distance of a point from the rotor of a station's plane, across that plane. */
static double lever_arm(const double *point, const double *station, int plane)
{
    const double *rotation = station + 3;
    const double offset[3] = {point[0] - station[0], point[1] - station[1], point[2] - station[2]};
    const double height =
        offset[0] * rotation[2] + offset[1] * rotation[5] + offset[2] * rotation[8];
    const double radius_squared = dot(offset, offset) - height * height;
    const double slope = station[12 + plane] * height;
    const double squared = radius_squared - slope * slope;
    const double floor = 1e-12 * (radius_squared > 1e-30 ? radius_squared : 1e-30);
    return sqrt(squared > floor ? squared : floor);
}

/* Return whether the point is in front of all stations of the planes. */
static int is_in_front(const LightPlane *planes, int count, const double *stations,
                       const double *point)
{
    for (int k = 0; k < count; k++) {
        const double *station = stations + STATION_NUMBERS * planes[k].station;
        const double *rotation = station + 3;
        const double depth = (point[0] - station[0]) * rotation[0]
                             + (point[1] - station[1]) * rotation[3]
                             + (point[2] - station[2]) * rotation[6];
        if (!(depth > 0)) return 0;
    }
    return 1;
}

/* Intersect the light planes of one epoch. `point` and `information` receive the result. */
static void intersect_planes(LightPlane *planes, int count, const double *stations, int has_floor,
                             int passes, double *point, double *information)
{
    const int dims = has_floor ? 2 : 3;
    for (int pass = 0; pass < passes; pass++) {
        double matrix[3][3] = {{0}}, right[3] = {0};
        for (int k = 0; k < count; k++) {
            const LightPlane *plane = planes + k;
            const double target =
                has_floor ? plane->offset - plane->normal[2] * point[2] : plane->offset;
            double row[3] = {0};
            for (int i = 0; i < dims; i++) row[i] = plane->normal[i] / plane->lever_arm;
            for (int i = 0; i < dims; i++) {
                right[i] += row[i] * (target / plane->lever_arm);
                for (int j = i; j < dims; j++) matrix[i][j] += row[i] * row[j];
            }
        }
        for (int i = 1; i < 3; i++)
            for (int j = 0; j < i; j++) matrix[i][j] = matrix[j][i];
        memcpy(information, matrix, sizeof matrix);
        solve_symmetric((const double(*)[3])matrix, right, dims, point);
        if (isnan(point[0])) {
            for (int i = 0; i < 9; i++) information[i] = NAN;
            return;
        }
        for (int k = 0; k < count; k++)
            planes[k].lever_arm = lever_arm(
                point, stations + STATION_NUMBERS * planes[k].station, planes[k].plane);
    }
}

PyObject *light_positions(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *angle_array, *stations_array, *position_array, *information_array, *residual_array,
        *redundancy_array;
    long long m, s, passes;
    double floor_z;
    if (!parse_arguments(args, "OLLOdLOOOO:light_positions", &angle_array, &m, &s, &stations_array,
                         &floor_z, &passes, &position_array, &information_array, &residual_array,
                         &redundancy_array))
        return NULL;
    check_range(&call, "m", m, 0, INT_MAX);
    check_range(&call, "s", s, 1, MAX_STATIONS);
    check_range(&call, "passes", passes, 1, MAX_PASSES);
    const double *angle = input(&call, angle_array, "angle", ITEM_FLOAT64, ITEMS(m, s, 2));
    const double *stations =
        input(&call, stations_array, "stations", ITEM_FLOAT64, ITEMS(s, STATION_NUMBERS));
    double *position = output(&call, position_array, "position", ITEM_FLOAT64, ITEMS(m, 3));
    double *information =
        output(&call, information_array, "information", ITEM_FLOAT64, ITEMS(m, 3, 3));
    double *residual = output(&call, residual_array, "residual", ITEM_FLOAT64, ITEMS(m, s, 2));
    int64_t *redundancy = output(&call, redundancy_array, "redundancy", ITEM_INT64, ITEMS(m));
    if (call.failed) return finish_call(&call, 1);
    const int has_floor = isfinite(floor_z);
    LightPlane *planes = malloc((size_t)(2 * s + 1) * sizeof *planes);
    for (long long e = 0; planes && e < m; e++) {
        double *point = position + 3 * e;
        point[0] = point[1] = 0;
        point[2] = has_floor ? floor_z : 0;
        const int count = observed_planes(angle + 2 * s * e, stations, (int)s, planes);
        intersect_planes(planes, count, stations, has_floor, (int)passes, point,
                         information + 9 * e);
        for (long long k = 0; k < 2 * s; k++) residual[2 * s * e + k] = NAN;
        for (int k = 0; k < count; k++)
            residual[2 * s * e + 2 * planes[k].station + planes[k].plane] =
                (dot(planes[k].normal, point) - planes[k].offset) / planes[k].lever_arm;
        redundancy[e] = count - (has_floor ? 2 : 3);
        const int is_finite = isfinite(point[0]) && isfinite(point[1]) && isfinite(point[2]);
        if (redundancy[e] < 0 || !is_finite || !is_in_front(planes, count, stations, point))
            point[0] = point[1] = point[2] = NAN;
    }
    free(planes);
    return finish_call(&call, planes != NULL);
}
