/* Search of landmark maps. The twin locatk.core.landmarks.design.search.search_python documents the
 * method: min-conflicts with a heat bath.
 */
#include "_kernels.h"
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Limits: a letter has four bits; of the tables of counts, each word takes 8 bytes. */
enum { MAX_LETTERS = 16, MAX_LENGTH = 1 << 16 };
#define MAX_WORDS (1LL << 30)

/* State of a search. Each of `items` reads `length` cells and has a word, which must be unique. */
typedef struct {
    Py_ssize_t cells, items;
    int length, letters;
    const int32_t *item_cells; /* (items, length) */
    const int32_t *first;      /* (cells + 1): first use of each cell */
    const int32_t *use_item;   /* (items * length), ascending within a cell */
    const int32_t *use_row;    /* (items * length): row of `parts` */
    const uint64_t *parts;     /* (rows, letters): what each letter adds to a word */
    const uint32_t *weights;   /* (n_weights): of a letter, by its conflicts beyond the fewest */
    int n_weights;
    uint8_t *values;  /* (cells) */
    uint64_t *words;  /* (items) */
    uint32_t *counts; /* (possible): number of items with a word */
    uint32_t *mixed;  /* (possible): exclusive or of their indices */
    int32_t *listed;  /* (items): items that may be in conflict */
    uint8_t *is_listed;
    Py_ssize_t suspects;
    Py_ssize_t possible;
    uint64_t state;
} Search;

/* Draw a number below `limit` from the upper half of SplitMix64 (Steele, Lea and Flood, Fast
 * Splittable Pseudorandom Number Generators, OOPSLA 2014). */
static inline uint64_t draw_below(Search *s, uint64_t limit)
{
    uint64_t z = s->state += 0x9E3779B97F4A7C15u;
    z = (z ^ z >> 30) * 0xBF58476D1CE4E5B9u;
    z = (z ^ z >> 27) * 0x94D049BB133111EBu;
    return ((z ^ z >> 31) >> 32) * limit >> 32;
}

/* Give a word to an item, and list the item if another one has the same word. */
static inline void add_word(Search *s, int32_t item, uint64_t word)
{
    const size_t slot = (size_t)word;
    s->words[item] = word;
    s->mixed[slot] ^= (uint32_t)item;
    if (s->counts[slot]++ && !s->is_listed[item]) {
        s->is_listed[item] = 1;
        s->listed[s->suspects++] = item;
    }
}

/* Withdraw the word of an item. */
static inline void remove_word(Search *s, int32_t item)
{
    const size_t slot = (size_t)s->words[item];
    s->mixed[slot] ^= (uint32_t)item;
    s->counts[slot]--;
}

/* Draw an item in conflict; -1 if there is none. */
static int32_t draw_conflict(Search *s)
{
    while (s->suspects) {
        const Py_ssize_t pick = (Py_ssize_t)draw_below(s, (uint64_t)s->suspects);
        const int32_t item = s->listed[pick];
        const size_t slot = (size_t)s->words[item];
        if (s->counts[slot] == 2 && draw_below(s, 2))
            return (int32_t)(s->mixed[slot] ^ (uint32_t)item);
        if (s->counts[slot] > 1) return item;
        s->is_listed[item] = 0;
        s->listed[pick] = s->listed[--s->suspects];
    }
    return -1;
}

/* Draw a new letter for a cell, weighted by the number of conflicts that each letter causes. */
static void redraw(Search *s, int32_t cell)
{
    const int32_t from = s->first[cell], to = s->first[cell + 1];
    const int letters = s->letters, old = s->values[cell];
    uint32_t cost[MAX_LETTERS], min_cost = UINT32_MAX;
    for (int32_t k = from; k < to; k++) remove_word(s, s->use_item[k]);
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
        if (sum < min_cost) min_cost = sum;
    }
    uint64_t total = 0;
    for (int v = 0; v < letters; v++) {
        const uint32_t excess = cost[v] - min_cost;
        total += cost[v] = excess < (uint32_t)s->n_weights ? s->weights[excess] : 0;
    }
    uint64_t pick = draw_below(s, total);
    int chosen = 0;
    while (pick >= cost[chosen]) pick -= cost[chosen++];
    s->values[cell] = (uint8_t)chosen;
    for (int32_t k = from; k < to; k++) {
        const int32_t item = s->use_item[k];
        const uint64_t *part = s->parts + (size_t)s->use_row[k] * letters;
        add_word(s, item, s->words[item] + part[chosen] - part[old]);
    }
}

/* Search for at most `steps` and return the number of conflicts that remain. */
static int64_t search(Search *s, int64_t steps)
{
    for (int64_t step = 0; step < steps; step++) {
        const int32_t item = draw_conflict(s);
        if (item < 0) break;
        redraw(s, s->item_cells[(size_t)item * s->length + draw_below(s, (uint64_t)s->length)]);
    }
    int64_t conflicts = 0;
    for (Py_ssize_t word = 0; word < s->possible; word++)
        if (s->counts[word] > 1) conflicts += s->counts[word] - 1;
    return conflicts;
}

/* Check that the words stay within the tables of counts whatever letters are drawn.
 *
 * Without the parts of its letters, the word of an item is its base. For each item, the base and
 * the sum of the largest parts of its uses are computed in `base` and `largest` (items each).
 */
static void check_words(Call *call, const Search *s, Py_ssize_t rows, uint64_t *base,
                        uint64_t *largest)
{
    const uint64_t possible = (uint64_t)s->possible;
    for (Py_ssize_t k = 0; k < rows * s->letters; k++)
        if (s->parts[k] >= possible) {
            reject(call, "parts[%zd] is not less than the number of possible words", k);
            return;
        }
    for (Py_ssize_t item = 0; item < s->items; item++) {
        base[item] = s->words[item];
        largest[item] = 0;
        if (base[item] >= possible) {
            reject(call, "words[%zd] is not less than the number of possible words", item);
            return;
        }
    }
    for (Py_ssize_t cell = 0; cell < s->cells; cell++)
        for (int32_t k = s->first[cell]; k < s->first[cell + 1]; k++) {
            const uint64_t *part = s->parts + (size_t)s->use_row[k] * (size_t)s->letters;
            const int32_t item = s->use_item[k];
            /* An item that read a cell twice would be counted twice under one word. */
            if (k > s->first[cell] && item <= s->use_item[k - 1]) {
                reject(call, "use_item[%zd] does not ascend within its cell", (Py_ssize_t)k);
                return;
            }
            uint64_t largest_part = 0;
            for (int v = 0; v < s->letters; v++)
                largest_part = part[v] > largest_part ? part[v] : largest_part;
            largest[item] += largest_part;
            if (part[s->values[cell]] > base[item]) {
                reject(call, "words[%zd] is less than the parts of its letters", (Py_ssize_t)item);
                return;
            }
            base[item] -= part[s->values[cell]];
        }
    for (Py_ssize_t item = 0; item < s->items; item++)
        if (base[item] + largest[item] >= possible) {
            reject(call, "words[%zd] may exceed the number of possible words", item);
            return;
        }
}

PyObject *search_map(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *item_cells_array, *first_array, *use_item_array, *use_row_array, *parts_array,
        *weights_array, *values_array, *words_array, *conflicts_array;
    Search s = {0};
    long long cells, items, length, letters, n_weights, possible, steps;
    unsigned long long seed;
    if (!parse_arguments(args, "OOOOOOOOOLLLLLLKL:search_map", &item_cells_array, &first_array,
                         &use_item_array, &use_row_array, &parts_array, &weights_array,
                         &values_array, &words_array, &conflicts_array, &cells, &items, &length,
                         &letters, &n_weights, &possible, &seed, &steps))
        return NULL;
    check_range(&call, "cells", cells, 0, INT32_MAX - 1);
    check_range(&call, "items", items, 0, INT32_MAX);
    check_range(&call, "length", length, 1, MAX_LENGTH);
    check_range(&call, "letters", letters, 1, MAX_LETTERS);
    check_range(&call, "n_weights", n_weights, 1, INT32_MAX);
    check_range(&call, "possible", possible, 1, MAX_WORDS);
    check_range(&call, "steps", steps, 0, LLONG_MAX);
    if (call.failed) return NULL;
    const Py_ssize_t uses = ITEMS(items, length);
    Py_ssize_t rows;
    check_range(&call, "items * length", uses, 0, INT32_MAX);
    s.item_cells = input(&call, item_cells_array, "item_cells", ITEM_INT32, uses);
    s.first = input(&call, first_array, "first", ITEM_INT32, (Py_ssize_t)cells + 1);
    s.use_item = input(&call, use_item_array, "use_item", ITEM_INT32, uses);
    s.use_row = input(&call, use_row_array, "use_row", ITEM_INT32, uses);
    s.parts = input_rows(&call, parts_array, "parts", ITEM_UINT64, (Py_ssize_t)letters, &rows);
    s.weights = input(&call, weights_array, "weights", ITEM_UINT32, n_weights);
    s.values = output(&call, values_array, "values", ITEM_UINT8, cells);
    s.words = output(&call, words_array, "words", ITEM_UINT64, items);
    int64_t *conflicts = output(&call, conflicts_array, "conflicts", ITEM_INT64, 1);
    check_items(&call, "item_cells", s.item_cells, ITEM_INT32, uses, 0, cells - 1);
    check_items(&call, "first", s.first, ITEM_INT32, (Py_ssize_t)cells + 1, 0, uses);
    for (Py_ssize_t cell = 0; cell < cells && !call.failed; cell++)
        if (s.first[cell + 1] < s.first[cell])
            reject(&call, "first[%zd] is less than its predecessor", cell + 1);
    check_items(&call, "use_item", s.use_item, ITEM_INT32, uses, 0, items - 1);
    check_items(&call, "use_row", s.use_row, ITEM_INT32, uses, 0, rows - 1);
    check_items(&call, "values", s.values, ITEM_UINT8, (Py_ssize_t)cells, 0, letters - 1);
    /* The best letter has the first weight: with 0, no letter could be drawn. */
    if (!call.failed && s.weights[0] == 0) reject(&call, "weights[0] is 0");
    if (call.failed) return finish_call(&call, 1);
    s.cells = (Py_ssize_t)cells;
    s.items = (Py_ssize_t)items;
    s.length = (int)length;
    s.letters = (int)letters;
    s.n_weights = (int)n_weights;
    s.possible = (Py_ssize_t)possible;
    s.state = seed;
    s.counts = calloc(2 * (size_t)possible, sizeof(uint32_t));
    s.listed = malloc((size_t)items * sizeof(int32_t) + 1);
    s.is_listed = calloc((size_t)items + 1, 1);
    uint64_t *sums = malloc((2 * (size_t)items + 1) * sizeof(uint64_t));
    const int has_memory = s.counts && s.listed && s.is_listed && sums;
    if (has_memory) check_words(&call, &s, rows, sums, sums + items);
    if (has_memory && !call.failed) {
        s.mixed = s.counts + s.possible;
        Py_BEGIN_ALLOW_THREADS
        for (int32_t item = 0; item < s.items; item++) add_word(&s, item, s.words[item]);
        *conflicts = search(&s, steps);
        Py_END_ALLOW_THREADS
    }
    free(s.counts);
    free(s.listed);
    free(s.is_listed);
    free(sums);
    return finish_call(&call, has_memory);
}
