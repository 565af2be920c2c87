/* Shared declarations of the C files of locatk.core._kernels.
 *
 * Every exported function has the same parts:
 *   1. parse_arguments() takes the arguments, integers as long long and arrays as objects.
 *   2. check_range() and check_positive() check the numbers. On failure the function returns
 * before it computes with them.
 *   3. input(), output() and input_rows() take the memory of each array and check its item type,
 *      layout and size against the numbers; check_items() and check_offsets() check the contents
 *      that the loops use as an index. On failure the function returns before it reads an array.
 *   4. The loops run.
 *   5. finish_call() releases the memory and returns None or raises.
 *
 * The first check that fails sets the exception and `failed`; later checks then return at once,
 * and those that take memory return NULL.
 */
#ifndef LOCATK_KERNELS_H
#define LOCATK_KERNELS_H
#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>
#include <limits.h>
#include <stdint.h>

/* If compiler and C library support it, loops over arrays are also compiled for wide registers.
 * The version that suits the processor is selected at run time. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define HOT __attribute__((target_clones("avx2", "default")))
#else
#define HOT
#endif

/* Largest number of arrays that a function takes. */
enum { MAX_ARRAYS = 16 };

/* Item types of arrays, by their codes in Python's module struct. ITEM_FLAG is one byte that is 0
 * or not: a bool or a uint8. */
typedef enum {
    ITEM_FLAG = '?',
    ITEM_INT8 = 'b',
    ITEM_UINT8 = 'B',
    ITEM_INT32 = 'i',
    ITEM_UINT32 = 'I',
    ITEM_INT64 = 'q',
    ITEM_UINT64 = 'Q',
    ITEM_FLOAT32 = 'f',
    ITEM_FLOAT64 = 'd'
} ItemType;

/* Arrays of one call. `failed` is 1 after the first failed check, with a Python exception set. */
typedef struct {
    Py_buffer views[MAX_ARRAYS];
    const char *names[MAX_ARRAYS];
    int is_output[MAX_ARRAYS];
    int count, failed;
} Call;

/* Parse positional arguments like PyArg_ParseTuple, but raise ValueError instead of OverflowError
 * for an integer that does not fit. Return 0 on failure. */
int parse_arguments(PyObject *args, const char *format, ...);

/* Raise ValueError with a formatted message. */
void reject(Call *call, const char *format, ...);

/* Require low <= value <= high. */
void check_range(Call *call, const char *name, long long value, long long low, long long high);

/* Require a finite number above zero. */
void check_positive(Call *call, const char *name, double value);

/* Product of dimensions, or -1 if one is negative or if as many items do not fit into memory. */
Py_ssize_t count_items(const long long *dimensions, int count);
#define ITEMS(...)                                                                                \
    count_items((const long long[]){__VA_ARGS__},                                                 \
                (int)(sizeof((const long long[]){__VA_ARGS__}) / sizeof(long long)))

/* Memory of an array that is read and has exactly `items` items; NULL if a check failed. */
const void *input(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t items);

/* Memory of an array that is read and has any number of rows of `row_items` items each. */
const void *input_rows(Call *call, PyObject *array, const char *name, ItemType type,
                       Py_ssize_t row_items, Py_ssize_t *rows);

/* Memory of an array that is written and has exactly `items` items. It must not overlap any other
 * array of the call. */
void *output(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t items);

/* The same for any number of items. */
void *output_any(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t *items);

/* Require low <= item <= high for all items of an array of integers. */
void check_items(Call *call, const char *name, const void *items, ItemType type, Py_ssize_t count,
                 long long low, long long high);

/* Require that offsets do not descend and that all of them are within 0 to `end`. */
void check_offsets(Call *call, const char *name, const int64_t *offsets, Py_ssize_t count,
                   Py_ssize_t end);

/* Release the arrays. Return None; NULL if a check failed, or with MemoryError if `has_memory` is
 * 0. */
PyObject *finish_call(Call *call, int has_memory);

/* core/_landmarks.c */
PyObject *bar_fields(PyObject *self, PyObject *args);
PyObject *scan_landmarks(PyObject *self, PyObject *args);
/* core/_maps.c */
PyObject *search_map(PyObject *self, PyObject *args);
/* core/_paths.c */
PyObject *solve_band(PyObject *self, PyObject *args);
PyObject *couple_sweeps(PyObject *self, PyObject *args);
/* core/_light.c */
PyObject *window_edges(PyObject *self, PyObject *args);
PyObject *light_bits(PyObject *self, PyObject *args);
PyObject *light_places(PyObject *self, PyObject *args);
PyObject *light_expected(PyObject *self, PyObject *args);
PyObject *light_epochs(PyObject *self, PyObject *args);
PyObject *light_positions(PyObject *self, PyObject *args);

#endif
