/* The search for maps: twin of locatk.core.landmarks.search.search_python, which says why. */
#include "_kernels.h"
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* What is searched: `items` of `length` cells each, whose words must differ. */
typedef struct {
    Py_ssize_t cells, items, uses;
    int length, letters;
    const int32_t *item_cells; /* (items, length) */
    const int32_t *first;      /* (cells + 1): the uses of a cell */
    const int32_t *use_item, *use_row;
    const uint64_t *parts;   /* (rows, letters): what a letter adds to a word */
    const uint32_t *weights; /* (heats): of a letter that adds so many conflicts */
    int heats;
    uint8_t *values;  /* (cells) */
    uint64_t *words;  /* (items) */
    uint32_t *counts; /* (possible words): items with a word, */
    uint32_t *mixed;  /* and all their numbers, xor */
    int32_t *listed;  /* items that may be in conflict */
    uint8_t *is_listed;
    Py_ssize_t suspects;
    Py_ssize_t possible;
    uint64_t state;
} Search;

/* Splitmix64 (Steele, Lea and Flood, OOPSLA 2014); a number below `limit` of its upper half. */
static inline uint64_t below(Search *s, uint64_t limit)
{
    uint64_t z = s->state += 0x9E3779B97F4A7C15u;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return ((z ^ z >> 31) >> 32) * limit >> 32;
}

static inline void put(Search *s, int32_t item, uint64_t word)
{
    const size_t at = (size_t)word;
    s->words[item] = word;
    s->mixed[at] ^= (uint32_t)item;
    if (s->counts[at]++ && !s->is_listed[item]) {
        s->is_listed[item] = 1;
        s->listed[s->suspects++] = item;
    }
}

static inline void take(Search *s, int32_t item)
{
    const size_t at = (size_t)s->words[item];
    s->mixed[at] ^= (uint32_t)item;
    s->counts[at]--;
}

/* An item in conflict, or -1 where there is none. */
static int32_t conflict(Search *s)
{
    while (s->suspects) {
        const Py_ssize_t pick = (Py_ssize_t)below(s, (uint64_t)s->suspects);
        const int32_t item = s->listed[pick];
        const size_t at = (size_t)s->words[item];
        if (s->counts[at] == 2 && below(s, 2)) return (int32_t)(s->mixed[at] ^ (uint32_t)item);
        if (s->counts[at] > 1) return item;
        s->is_listed[item] = 0;
        s->listed[pick] = s->listed[--s->suspects];
    }
    return -1;
}

/* Gives a cell a letter by the heat of the conflicts that each letter would make. */
static void redraw(Search *s, int32_t cell)
{
    const int32_t from = s->first[cell], to = s->first[cell + 1];
    const int letters = s->letters, old = s->values[cell];
    uint32_t cost[16], least = UINT32_MAX;
    for (int32_t k = from; k < to; k++) take(s, s->use_item[k]);
    for (int v = 0; v < letters; v++) {
        uint32_t sum = 0;
        for (int32_t k = from; k < to; k++) {
            const uint64_t *part = s->parts + (size_t)s->use_row[k] * letters;
            sum += s->counts[s->words[s->use_item[k]] + part[v] - part[old]]++;
        }
        for (int32_t k = from; k < to; k++) {
            const uint64_t *part = s->parts + (size_t)s->use_row[k] * letters;
            s->counts[s->words[s->use_item[k]] + part[v] - part[old]]--;
        }
        cost[v] = sum;
        if (sum < least) least = sum;
    }
    uint64_t total = 0;
    for (int v = 0; v < letters; v++) {
        const uint32_t more = cost[v] - least;
        total += cost[v] = more < (uint32_t)s->heats ? s->weights[more] : 0;
    }
    uint64_t pick = below(s, total);
    int chosen = 0;
    while (pick >= cost[chosen]) pick -= cost[chosen++];
    s->values[cell] = (uint8_t)chosen;
    for (int32_t k = from; k < to; k++) {
        const int32_t item = s->use_item[k];
        const uint64_t *part = s->parts + (size_t)s->use_row[k] * letters;
        put(s, item, s->words[item] + part[chosen] - part[old]);
    }
}

/* Conflicts that are left after at most `steps`. */
static int64_t search(Search *s, int64_t steps)
{
    for (int64_t step = 0; step < steps; step++) {
        const int32_t item = conflict(s);
        if (item < 0) break;
        redraw(s, s->item_cells[(size_t)item * s->length + below(s, (uint64_t)s->length)]);
    }
    int64_t left = 0;
    for (Py_ssize_t at = 0; at < s->possible; at++)
        if (s->counts[at] > 1) left += s->counts[at] - 1;
    return left;
}

PyObject *search_map(PyObject *self, PyObject *args)
{
    enum { ITEM_CELLS, FIRST, USE_ITEM, USE_ROW, PARTS, WEIGHTS, VALUES, WORDS, LEFT, BUFFERS };
    Py_buffer b[BUFFERS];
    Search s;
    unsigned long long seed;
    long long steps;
    memset(&s, 0, sizeof s);
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*y*w*w*w*nniiinKL", &b[ITEM_CELLS], &b[FIRST],
                          &b[USE_ITEM], &b[USE_ROW], &b[PARTS], &b[WEIGHTS], &b[VALUES], &b[WORDS],
                          &b[LEFT], &s.cells, &s.items, &s.length, &s.letters, &s.heats,
                          &s.possible, &seed, &steps))
        return NULL;
    s.item_cells = b[ITEM_CELLS].buf;
    s.first = b[FIRST].buf;
    s.use_item = b[USE_ITEM].buf;
    s.use_row = b[USE_ROW].buf;
    s.parts = b[PARTS].buf;
    s.weights = b[WEIGHTS].buf;
    s.values = b[VALUES].buf;
    s.words = b[WORDS].buf;
    s.state = seed;
    s.counts = calloc(2 * (size_t)s.possible, sizeof(uint32_t));
    s.listed = malloc((size_t)s.items * sizeof(int32_t) + 1);
    s.is_listed = calloc((size_t)s.items + 1, 1);
    const int stored = s.counts && s.listed && s.is_listed;
    if (stored) {
        s.mixed = s.counts + s.possible;
        Py_BEGIN_ALLOW_THREADS
        for (int32_t item = 0; item < s.items; item++) put(&s, item, s.words[item]);
        *(int64_t *)b[LEFT].buf = search(&s, steps);
        Py_END_ALLOW_THREADS
    }
    free(s.counts);
    free(s.listed);
    free(s.is_listed);
    return done(b, BUFFERS, stored);
}
