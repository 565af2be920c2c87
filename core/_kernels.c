/* The extension module locatk.core._kernels: hot loops in C, each with a twin in numpy.
 *
 * This file holds the module, the checks of arguments that all kernels share, the loops of
 * core/dots (detection of dots, lattice, soft bits, reading of windows, pose) and of core/polaris
 * (dynamic time warping). The twins document the algorithms; they are used if the module was not
 * built, and tests compare both. Constants are passed as arguments, so that each is defined once,
 * in Python. Only the stable ABI of Python 3.11 is used, and the buffer protocol instead of
 * numpy's own C API.
 */
#include "_kernels.h"
#include <float.h>
#include <math.h>
#include <stdarg.h>
#include <stdlib.h>
#include <string.h>

/* ---- Checks of arguments ---------------------------------------------------------------- */

int parse_arguments(PyObject *args, const char *format, ...)
{
    va_list pointers;
    va_start(pointers, format);
    const int parsed = PyArg_VaParse(args, format, pointers);
    va_end(pointers);
    if (!parsed && PyErr_ExceptionMatches(PyExc_OverflowError))
        PyErr_SetString(PyExc_ValueError, "an integer is outside of 64 bits");
    return parsed;
}

void reject(Call *call, const char *format, ...)
{
    va_list values;
    va_start(values, format);
    PyErr_FormatV(PyExc_ValueError, format, values);
    va_end(values);
    call->failed = 1;
}

void check_range(Call *call, const char *name, long long value, long long low, long long high)
{
    if (!call->failed && (value < low || value > high))
        reject(call, "%s is %lld, expected %lld to %lld", name, value, low, high);
}

void check_positive(Call *call, const char *name, double value)
{
    if (!call->failed && !(value > 0 && isfinite(value)))
        reject(call, "%s is not a finite number above zero", name);
}

Py_ssize_t count_items(const long long *dimensions, int count)
{
    /* The widest items have 8 bytes: with this limit, sizes in bytes do not overflow either. */
    const Py_ssize_t limit = PY_SSIZE_T_MAX / 8;
    Py_ssize_t product = 1;
    for (int k = 0; k < count; k++)
        if (dimensions[k] == 0) return 0;
    for (int k = 0; k < count; k++) {
        if (dimensions[k] < 0 || dimensions[k] > limit / product) return -1;
        product *= (Py_ssize_t)dimensions[k];
    }
    return product;
}

static Py_ssize_t item_size(ItemType type)
{
    switch (type) {
    case ITEM_INT32:
    case ITEM_UINT32:
    case ITEM_FLOAT32:
        return 4;
    case ITEM_INT64:
    case ITEM_UINT64:
    case ITEM_FLOAT64:
        return 8;
    default:
        return 1;
    }
}

/* Struct codes that denote a type if their items have the right size. C's long, code l, has 32 or
 * 64 bits by platform. */
static const char *struct_codes(ItemType type)
{
    switch (type) {
    case ITEM_FLAG:
        return "?B";
    case ITEM_INT32:
        return "il";
    case ITEM_UINT32:
        return "IL";
    case ITEM_INT64:
        return "ql";
    case ITEM_UINT64:
        return "QL";
    case ITEM_INT8:
        return "b";
    case ITEM_UINT8:
        return "B";
    case ITEM_FLOAT32:
        return "f";
    default:
        return "d";
    }
}

static const char *type_name(ItemType type)
{
    switch (type) {
    case ITEM_FLAG:
        return "bool or uint8";
    case ITEM_INT8:
        return "int8";
    case ITEM_UINT8:
        return "uint8";
    case ITEM_INT32:
        return "int32";
    case ITEM_UINT32:
        return "uint32";
    case ITEM_INT64:
        return "int64";
    case ITEM_UINT64:
        return "uint64";
    case ITEM_FLOAT32:
        return "float32";
    default:
        return "float64";
    }
}

static int has_type(const Py_buffer *view, ItemType type)
{
    const uint16_t one = 1;
    const char native = *(const char *)&one ? '<' : '>';
    const char *format = view->format ? view->format : "B";
    if (*format == '@' || *format == '=' || *format == native) format++;
    return view->itemsize == item_size(type) && format[0] && strchr(struct_codes(type), format[0])
           && !format[1];
}

/* Add an array to the call and check all but its size; its view, or NULL. */
static const Py_buffer *take_array(Call *call, PyObject *array, const char *name, ItemType type,
                                   int is_output)
{
    if (call->failed) return NULL;
    if (call->count == MAX_ARRAYS) {
        reject(call, "%s: a function takes %d arrays at most", name, MAX_ARRAYS);
        return NULL;
    }
    Py_buffer *view = &call->views[call->count];
    if (!PyObject_CheckBuffer(array)) {
        PyErr_Format(PyExc_TypeError, "%s is no array: it has no buffer", name);
        call->failed = 1;
        return NULL;
    }
    if (PyObject_GetBuffer(array, view, PyBUF_FULL_RO) != 0) {
        call->failed = 1;
        return NULL;
    }
    call->names[call->count] = name;
    call->is_output[call->count] = is_output;
    call->count++;
    if (!has_type(view, type))
        reject(call, "%s has items of format '%s' (%zd bytes), expected %s (%zd)", name,
               view->format ? view->format : "B", view->itemsize, type_name(type),
               item_size(type));
    else if (!PyBuffer_IsContiguous(view, 'C'))
        reject(call, "%s is not contiguous in C order", name);
    else if (view->len && (uintptr_t)view->buf % (uintptr_t)view->itemsize)
        reject(call, "%s is not aligned to its items of %zd bytes", name, view->itemsize);
    else if (is_output && view->readonly)
        reject(call, "%s is read-only, but results are written to it", name);
    for (int k = 0; k + 1 < call->count && !call->failed; k++) {
        const Py_buffer *other = &call->views[k];
        const uintptr_t begin = (uintptr_t)view->buf, other_begin = (uintptr_t)other->buf;
        if ((is_output || call->is_output[k]) && view->len && other->len
            && begin < other_begin + (uintptr_t)other->len
            && other_begin < begin + (uintptr_t)view->len)
            reject(call, "%s shares memory with %s", name, call->names[k]);
    }
    return call->failed ? NULL : view;
}

static void *take_items(Call *call, PyObject *array, const char *name, ItemType type,
                        int is_output, Py_ssize_t items)
{
    const Py_buffer *view = take_array(call, array, name, type, is_output);
    if (!view) return NULL;
    if (items < 0)
        reject(call, "%s: its dimensions are negative or too large", name);
    else if (view->len != items * item_size(type))
        reject(call, "%s has %zd items, expected %zd", name, view->len / item_size(type), items);
    return call->failed ? NULL : view->buf;
}

const void *input(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t items)
{
    return take_items(call, array, name, type, 0, items);
}

void *output(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t items)
{
    return take_items(call, array, name, type, 1, items);
}

const void *input_rows(Call *call, PyObject *array, const char *name, ItemType type,
                       Py_ssize_t row_items, Py_ssize_t *rows)
{
    *rows = 0;
    const Py_buffer *view = take_array(call, array, name, type, 0);
    if (!view) return NULL;
    const Py_ssize_t items = view->len / item_size(type);
    if (row_items < 1 || items % row_items) {
        reject(call, "%s has %zd items, expected a multiple of %zd", name, items, row_items);
        return NULL;
    }
    *rows = items / row_items;
    return view->buf;
}

void *output_any(Call *call, PyObject *array, const char *name, ItemType type, Py_ssize_t *items)
{
    *items = 0;
    const Py_buffer *view = take_array(call, array, name, type, 1);
    if (!view) return NULL;
    *items = view->len / item_size(type);
    return view->buf;
}

/* Index of the first item outside of low to high, or -1. The first loop has no exit, so that it is
 * compiled for wide registers. */
#define DEFINE_FIND_OUTSIDE(TYPE)                                                                 \
    HOT static Py_ssize_t find_outside_##TYPE(const TYPE *items, Py_ssize_t count, TYPE low,      \
                                              TYPE high)                                          \
    {                                                                                             \
        int outside = 0;                                                                          \
        for (Py_ssize_t k = 0; k < count; k++) outside |= (items[k] < low) | (items[k] > high);   \
        if (!outside) return -1;                                                                  \
        Py_ssize_t first = 0;                                                                     \
        while (items[first] >= low && items[first] <= high) first++;                              \
        return first;                                                                             \
    }
DEFINE_FIND_OUTSIDE(int8_t)
DEFINE_FIND_OUTSIDE(uint8_t)
DEFINE_FIND_OUTSIDE(int32_t)
DEFINE_FIND_OUTSIDE(int64_t)

void check_items(Call *call, const char *name, const void *items, ItemType type, Py_ssize_t count,
                 long long low, long long high)
{
    if (call->failed || count == 0) return;
    if (high < low) {
        reject(call, "%s has %zd items, but no value is valid", name, count);
        return;
    }
    /* Limits beyond those of the type are clamped, so that the conversions below are exact. */
    const long long type_low = type == ITEM_INT8    ? INT8_MIN
                               : type == ITEM_UINT8 ? 0
                               : type == ITEM_INT32 ? INT32_MIN
                                                    : INT64_MIN;
    const long long type_high = type == ITEM_INT8    ? INT8_MAX
                                : type == ITEM_UINT8 ? UINT8_MAX
                                : type == ITEM_INT32 ? INT32_MAX
                                                     : INT64_MAX;
    low = low > type_low ? low : type_low;
    high = high < type_high ? high : type_high;
    Py_ssize_t index;
    long long value;
    if (type == ITEM_INT8) {
        index = find_outside_int8_t(items, count, (int8_t)low, (int8_t)high);
        value = index < 0 ? 0 : ((const int8_t *)items)[index];
    } else if (type == ITEM_UINT8) {
        index = find_outside_uint8_t(items, count, (uint8_t)low, (uint8_t)high);
        value = index < 0 ? 0 : ((const uint8_t *)items)[index];
    } else if (type == ITEM_INT32) {
        index = find_outside_int32_t(items, count, (int32_t)low, (int32_t)high);
        value = index < 0 ? 0 : ((const int32_t *)items)[index];
    } else {
        index = find_outside_int64_t(items, count, low, high);
        value = index < 0 ? 0 : ((const int64_t *)items)[index];
    }
    if (index >= 0)
        reject(call, "%s[%zd] is %lld, expected %lld to %lld", name, index, value, low, high);
}

void check_offsets(Call *call, const char *name, const int64_t *offsets, Py_ssize_t count,
                   Py_ssize_t end)
{
    check_items(call, name, offsets, ITEM_INT64, count, 0, end);
    for (Py_ssize_t k = 1; k < count && !call->failed; k++)
        if (offsets[k] < offsets[k - 1])
            reject(call, "%s[%zd] is less than its predecessor", name, k);
}

PyObject *finish_call(Call *call, int has_memory)
{
    for (int k = 0; k < call->count; k++) PyBuffer_Release(&call->views[k]);
    if (call->failed) return NULL;
    if (!has_memory) return PyErr_NoMemory();
    Py_RETURN_NONE;
}

/* ---- Sorting ---------------------------------------------------------------------------- */

/* Sort in ascending order by Shell's method, for the few hundred numbers of a frame. */
static void sort_floats(float *values, int count)
{
    static const int gaps[] = {301, 132, 57, 23, 10, 4, 1};
    for (int g = 0; g < 7; g++) {
        const int gap = gaps[g];
        for (int i = gap; i < count; i++) {
            const float value = values[i];
            int j = i;
            for (; j >= gap && values[j - gap] > value; j -= gap) values[j] = values[j - gap];
            values[j] = value;
        }
    }
}

/* Sort positive numbers in ascending order, digit by digit: their bits are in the order of their
 * values. `scratch` has as many items. */
static void sort_positive(float *values, float *scratch, int count)
{
    enum { DIGIT_BITS = 8, DIGITS = 4, BINS = 1 << DIGIT_BITS };
    for (int digit = 0; digit < DIGITS; digit++) {
        const int shift = digit * DIGIT_BITS;
        int starts[BINS + 1] = {0};
        uint32_t bits;
        for (int k = 0; k < count; k++) {
            memcpy(&bits, &values[k], sizeof(bits));
            starts[(bits >> shift & (BINS - 1)) + 1]++;
        }
        for (int bin = 0; bin < BINS; bin++) starts[bin + 1] += starts[bin];
        for (int k = 0; k < count; k++) {
            memcpy(&bits, &values[k], sizeof(bits));
            scratch[starts[bits >> shift & (BINS - 1)]++] = values[k];
        }
        float *swap = values;
        values = scratch;
        scratch = swap;
    }
}

/* Value of rank `rank` in ascending order (Hoare's selection); reorders `values`. */
static float nth_smallest(float *values, int count, int rank)
{
    int low = 0, high = count - 1;
    while (low < high) {
        const float pivot = values[(low + high) / 2];
        int i = low, j = high;
        while (i <= j) {
            while (values[i] < pivot) i++;
            while (values[j] > pivot) j--;
            if (i <= j) {
                const float swap = values[i];
                values[i++] = values[j];
                values[j--] = swap;
            }
        }
        if (rank <= j)
            high = j;
        else if (rank >= i)
            low = i;
        else
            break;
    }
    return values[rank];
}

/* ---- Detection of dots ------------------------------------------------------------------ */

/* Reflect an index beyond the border at the outermost pixel. */
static inline int mirror_index(int i, int count)
{
    if (count == 1) return 0;
    while (i < 0 || i >= count) i = i < 0 ? -i : 2 * (count - 1) - i;
    return i;
}

static inline float lesser(float a, float b) { return a < b ? a : b; }

/* Smooth an image with a separable, symmetric filter of five taps (outer, inner, centre). */
HOT static void smooth_image(const uint8_t *restrict image, int h, int w, const float *taps,
                             float *restrict line, float *restrict smooth)
{
    const float outer = taps[0], inner = taps[1], centre = taps[2];
    for (int y = 0; y < h; y++) {
        const uint8_t *a = image + (size_t)mirror_index(y - 2, h) * w;
        const uint8_t *b = image + (size_t)mirror_index(y - 1, h) * w;
        const uint8_t *c = image + (size_t)y * w;
        const uint8_t *d = image + (size_t)mirror_index(y + 1, h) * w;
        const uint8_t *e = image + (size_t)mirror_index(y + 2, h) * w;
        float *restrict in = line + 2;
        for (int x = 0; x < w; x++)
            in[x] =
                outer * (float)(a[x] + e[x]) + inner * (float)(b[x] + d[x]) + centre * (float)c[x];
        for (int k = 1; k <= 2; k++) {
            in[-k] = in[mirror_index(-k, w)];
            in[w - 1 + k] = in[mirror_index(w - 1 + k, w)];
        }
        float *restrict out = smooth + (size_t)y * w;
        for (int x = 0; x < w; x++)
            out[x] =
                outer * (in[x - 2] + in[x + 2]) + inner * (in[x - 1] + in[x + 1]) + centre * in[x];
    }
}

/* Mark with 1 each pixel that is the minimum of the 5 x 5 pixels around it, and the first of equal
 * ones. Marks within two pixels of the border are left unchanged. */
HOT static void mark_minima(const float *restrict smooth, int h, int w, float *restrict across,
                            uint8_t *restrict marks)
{
    for (int y = 0; y < h; y++) {
        const float *restrict s = smooth + (size_t)y * w;
        float *restrict m = across + (size_t)y * w;
        for (int x = 2; x < w - 2; x++)
            m[x] = lesser(lesser(lesser(s[x - 2], s[x - 1]), lesser(s[x + 1], s[x + 2])), s[x]);
    }
    for (int y = 2; y < h - 2; y++) {
        const float *restrict a = across + (size_t)(y - 2) * w, *restrict b = a + w;
        const float *restrict d = a + 3 * w, *restrict e = a + 4 * w;
        const float *restrict s = smooth + (size_t)y * w;
        uint8_t *restrict mark = marks + (size_t)y * w;
        for (int x = 2; x < w - 2; x++) {
            const float before = lesser(lesser(a[x], b[x]), lesser(s[x - 2], s[x - 1]));
            const float after = lesser(lesser(d[x], e[x]), lesser(s[x + 1], s[x + 2]));
            mark[x] = (s[x] < before) & (s[x] <= after);
        }
    }
}

/* Moving sums over `window` values of a line with a stride, mirrored at its ends. */
static void moving_sum(const float *line, int count, int stride, int window, float *out)
{
    const int half = window / 2;
    float sum = 0;
    for (int k = -half; k <= half; k++) sum += line[mirror_index(k, count) * stride];
    for (int k = 0; k < count; k++) {
        out[k * stride] = sum;
        const int is_inside = k >= half && k + half + 1 < count;
        const int next = is_inside ? k + half + 1 : mirror_index(k + half + 1, count);
        const int last = is_inside ? k - half : mirror_index(k - half, count);
        sum += line[next * stride] - line[last * stride];
    }
}

/* Brightness of the paper: means of blocks, averaged over squares of `window` blocks a side. */
static void paper_image(const uint8_t *image, int w, int rows, int columns, int block, int window,
                        int *restrict sums, float *means, float *across, float *paper)
{
    for (int r = 0; r < rows; r++) {
        memset(sums, 0, (size_t)w * sizeof(int));
        for (int y = 0; y < block; y++) {
            const uint8_t *restrict row = image + (size_t)(r * block + y) * w;
            for (int x = 0; x < w; x++) sums[x] += row[x];
        }
        for (int c = 0; c < columns; c++) {
            int sum = 0;
            for (int x = 0; x < block; x++) sum += sums[c * block + x];
            /* Rounded to whole grey levels like the 8-bit image of the numpy twin. */
            means[r * columns + c] = (float)((2 * sum + block * block) / (2 * block * block));
        }
    }
    for (int r = 0; r < rows; r++)
        moving_sum(means + r * columns, columns, 1, window, across + r * columns);
    for (int c = 0; c < columns; c++) moving_sum(across + c, rows, columns, window, paper + c);
    const float scale = 1.0f / (float)(window * window);
    for (int k = 0; k < rows * columns; k++) paper[k] *= scale;
}

/* Median contrast of the dots, which are the minima above the split by Otsu's criterion. If fewer
 * than `min_dots` are above it, they are dirt, darker than any dot, and the rest is split again.
 */
static float median_contrast(float *contrasts, float *scratch, int count, int min_dots,
                             int splits)
{
    if (count == 0) return 0;
    sort_positive(contrasts, scratch, count);
    for (int split = 0; split < splits && count > 1; split++) {
        float total = 0, sum = 0, best = -1;
        int dots = 0;
        for (int k = 0; k < count; k++) total += contrasts[k];
        for (int above = 1; above < count; above++) {
            sum += contrasts[count - above];
            const float rest = total - sum;
            const float between = sum * sum / (float)above + rest * rest / (float)(count - above);
            if (between > best) {
                best = between;
                dots = above;
            }
        }
        if (dots >= min_dots) return contrasts[count - 1 - (dots - 1) / 2];
        count -= dots;
    }
    return contrasts[count - 1 - (count - 1) / 2];
}

/* Slope of the paper's brightness along one axis about a block, relative to it [1 / pixel], from
 * the blocks `reach` before and after. They are moved inwards where the windows of `window` blocks
 * over which they are averaged would leave the image. */
static float paper_slope(const float *paper, int index, int count, int step, int block, int window,
                         int reach, float limit)
{
    const int first = window / 2 + reach, last = count - 1 - first;
    int middle = index > first ? index : first;
    if (middle > last) middle = last;
    int before = middle - reach, after = middle + reach;
    before = before > 0 ? before : 0;
    after = after < count - 1 ? after : count - 1;
    if (before >= middle || middle >= after || !(*paper > 0)) return 0;
    const float here = paper[(middle - index) * step];
    const float low = (here - paper[(before - index) * step]) / (float)((middle - before) * block);
    const float high = (paper[(after - index) * step] - here) / (float)((after - middle) * block);
    if (!(low * high > 0)) return 0;
    /* At an edge of the light, the slope is at most twice that of the flatter side. */
    const float mean = 0.5f * (low + high), least = 2 * (fabsf(low) < fabsf(high) ? low : high);
    const float slope = (fabsf(least) < fabsf(mean) ? least : mean) / *paper;
    return slope < -limit ? -limit : slope > limit ? limit : slope;
}

/* Offset of a minimum along one axis [pixels]: top of the Gaussian through the ink at it and its
 * neighbours, where `slope` is that of the light, relative to it. */
static float minimum_offset(const float *minimum, int step, float brightness, float slope,
                            float ink, float top, float smoothing_variance)
{
    const float floor = 0.05f * ink;
    const float before = 1 - minimum[-step] / (brightness * (1 - slope)),
                after = 1 - minimum[step] / (brightness * (1 + slope));
    const float a = logf(before > floor ? before : floor);
    const float b = logf(after > floor ? after : floor);
    float curvature = 2 * top - a - b;
    curvature = curvature > 1e-6f ? curvature : 1e-6f;
    const float offset = 0.5f * (b - a) / curvature + smoothing_variance * slope;
    return offset < -1.0f ? -1.0f : offset > 1.0f ? 1.0f : offset;
}

/* Read the grey levels on a ring of four pixels about a minimum, within the image, in ascending
 * order; return 0 if three of them are not brighter than `least`. */
enum { RING_SAMPLES = 8, MAX_DARK_SAMPLES = 2, RING_RADIUS = 4 };

static inline void order(float *values, int i, int j)
{
    const float a = values[i], b = values[j];
    values[i] = a < b ? a : b;
    values[j] = a < b ? b : a;
}

static int sample_ring(const float *smooth, int h, int w, int x, int y, float least, float *ring)
{
    static const int steps[RING_SAMPLES][2] = {{4, 0},  {3, 3},   {0, 4},  {-3, 3},
                                               {-4, 0}, {-3, -3}, {0, -4}, {3, -3}};
    const float *centre = smooth + (size_t)y * w + x;
    const int is_inside =
        x >= RING_RADIUS && x < w - RING_RADIUS && y >= RING_RADIUS && y < h - RING_RADIUS;
    int dark = 0;
    for (int k = 0; k < RING_SAMPLES; k++) {
        int dx = steps[k][0], dy = steps[k][1];
        if (!is_inside) {
            dx = x + dx < 0 ? -x : x + dx >= w ? w - 1 - x : dx;
            dy = y + dy < 0 ? -y : y + dy >= h ? h - 1 - y : dy;
        }
        ring[k] = centre[(Py_ssize_t)dy * w + dx];
        dark += !(ring[k] > least);
    }
    if (dark > MAX_DARK_SAMPLES) return 0;
    /* A sorting network of eight values, without branches. */
    float *r = ring;
    order(r, 0, 1), order(r, 2, 3), order(r, 4, 5), order(r, 6, 7), order(r, 0, 2);
    order(r, 1, 3), order(r, 4, 6), order(r, 5, 7), order(r, 1, 2), order(r, 5, 6);
    order(r, 0, 4), order(r, 3, 7), order(r, 1, 5), order(r, 2, 6), order(r, 1, 4);
    order(r, 3, 6), order(r, 2, 4), order(r, 3, 5), order(r, 3, 4);
    return 1;
}

typedef struct {
    float x, y, square_radius; /* square_radius: from the centre of the image */
} Dot;

/* Order of dots from the centre outwards. NaN comes last: qsort requires a total order. */
static int by_square_radius(const void *a, const void *b)
{
    const float x = ((const Dot *)a)->square_radius, y = ((const Dot *)b)->square_radius;
    return isnan(x) || isnan(y) ? isnan(x) - isnan(y) : (x > y) - (x < y);
}

typedef struct {
    int h, w, block, window, slope_reach, min_dots, splits, max_dots, rows, columns;
    float max_slope, min_contrast, contrast_fraction;
    const float *taps;
    float *smooth, *across, *line, *means, *blurred, *paper, *contrasts, *brightnesses;
    int *sums;
    uint8_t *marks;
    Dot *dots;
} Detector;

/* Detect the dots of an image, write their positions to `xy` and return their number. */
static int detect_dots(const Detector *d, const uint8_t *image, float *xy)
{
    const int h = d->h, w = d->w;
    Dot *dots = d->dots;
    smooth_image(image, h, w, d->taps, d->line, d->smooth);
    paper_image(image, w, d->rows, d->columns, d->block, d->window, d->sums, d->means, d->blurred,
                d->paper);
    mark_minima(d->smooth, h, w, d->across, d->marks);
    int minima = 0;
    for (int y = 2; y < h - 2; y++) {
        const uint8_t *mark = d->marks + (size_t)y * w, *end = mark + w - 2;
        for (const uint8_t *pixel = mark + 2; (pixel = memchr(pixel, 1, (size_t)(end - pixel)));
             pixel++) {
            const int x = (int)(pixel - mark);
            float ring[RING_SAMPLES];
            /* Two of the samples may be on neighbouring dots. */
            const float grey = d->smooth[(size_t)y * w + x];
            if (!sample_ring(d->smooth, h, w, x, y, grey + d->min_contrast, ring)) continue;
            const float contrast = ring[MAX_DARK_SAMPLES] - grey;
            d->brightnesses[minima] = 0.5f * (ring[4] + ring[5]);
            d->contrasts[minima] = contrast / ring[2];
            dots[minima].x = (float)x;
            dots[minima++].y = (float)y;
        }
    }
    memcpy(d->across, d->contrasts, (size_t)minima * sizeof(float));
    const float threshold =
        d->contrast_fraction
        * median_contrast(d->across, d->across + minima, minima, d->min_dots, d->splits);
    const int rows = d->rows, columns = d->columns;
    float smoothing_variance = 0;
    for (int k = 0; k < 2; k++) smoothing_variance += 2 * d->taps[k] * (float)((2 - k) * (2 - k));
    int kept = 0;
    for (int k = 0; k < minima; k++) {
        if (!(d->contrasts[k] > threshold)) continue;
        const float brightness = d->brightnesses[k];
        const int px = (int)dots[k].x, py = (int)dots[k].y;
        const float *minimum = d->smooth + (size_t)py * w + (size_t)px;
        const float ink = 1 - *minimum / brightness, top = logf(ink);
        const int row = py / d->block < rows ? py / d->block : rows - 1;
        const int column = px / d->block < columns ? px / d->block : columns - 1;
        const float *paper = d->paper + row * columns + column;
        const float slope_x = paper_slope(paper, column, columns, 1, d->block, d->window,
                                          d->slope_reach, d->max_slope);
        const float slope_y = paper_slope(paper, row, rows, columns, d->block, d->window,
                                          d->slope_reach, d->max_slope);
        const float x = dots[k].x
                        + minimum_offset(minimum, 1, brightness, slope_x, ink, top,
                                         smoothing_variance);
        const float y = dots[k].y
                        + minimum_offset(minimum, w, brightness, slope_y, ink, top,
                                         smoothing_variance);
        const float dx = x - 0.5f * (float)(w - 1), dy = y - 0.5f * (float)(h - 1);
        dots[kept].x = x;
        dots[kept].y = y;
        dots[kept++].square_radius = dx * dx + dy * dy;
    }
    if (kept > d->max_dots) {
        qsort(dots, (size_t)kept, sizeof(Dot), by_square_radius);
        kept = d->max_dots;
    }
    for (int k = 0; k < kept; k++) {
        xy[2 * k] = dots[k].x;
        xy[2 * k + 1] = dots[k].y;
    }
    return kept;
}

/* Largest sides of images and blocks [pixels]. Below them, indices and sums of grey levels fit
 * into an int: 2 * 255 * MAX_BLOCK^2 + MAX_BLOCK^2 < 2^31. */
enum { MIN_SIDE = 5, MAX_SIDE = 1 << 15, MAX_BLOCK = 2048, MAX_WINDOW = 1023, MAX_SPLITS = 1000 };

static PyObject *find_dots(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *images_array, *taps_array, *xy_array, *counts_array;
    long long n, h, w, block, window, reach, min_dots, splits, max_dots;
    Detector d;
    if (!parse_arguments(args, "OLLLOLLLfffLLLOO:find_dots", &images_array, &n, &h, &w,
                         &taps_array, &block, &window, &reach, &d.max_slope, &d.min_contrast,
                         &d.contrast_fraction, &min_dots, &splits, &max_dots, &xy_array,
                         &counts_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "height", h, MIN_SIDE, MAX_SIDE);
    check_range(&call, "width", w, MIN_SIDE, MAX_SIDE);
    /* At least one block fits into the image, since each pixel needs the brightness of one. */
    check_range(&call, "block", block, 1, h < w ? h : w);
    check_range(&call, "block", block, 1, MAX_BLOCK);
    check_range(&call, "window", window, 1, MAX_WINDOW);
    check_range(&call, "slope_reach", reach, 1, MAX_WINDOW);
    check_range(&call, "min_dots", min_dots, 0, INT_MAX);
    check_range(&call, "splits", splits, 0, MAX_SPLITS);
    check_range(&call, "max_dots", max_dots, 0, INT_MAX);
    if (call.failed) return NULL;
    const uint8_t *images = input(&call, images_array, "images", ITEM_UINT8, ITEMS(n, h, w));
    d.taps = input(&call, taps_array, "taps", ITEM_FLOAT32, 3);
    float *xy = output(&call, xy_array, "xy", ITEM_FLOAT32, ITEMS(n, max_dots, 2));
    int64_t *counts = output(&call, counts_array, "counts", ITEM_INT64, n);
    if (call.failed) return finish_call(&call, 1);
    d.h = (int)h;
    d.w = (int)w;
    d.block = (int)block;
    d.window = (int)window;
    d.slope_reach = (int)reach;
    d.min_dots = (int)min_dots;
    d.splits = (int)splits;
    d.max_dots = (int)max_dots;
    d.rows = d.h / d.block;
    d.columns = d.w / d.block;
    const size_t area = (size_t)d.h * (size_t)d.w, blocks = (size_t)d.rows * (size_t)d.columns;
    d.smooth = malloc((4 * area + (size_t)d.w + 4 + 3 * blocks) * sizeof(float));
    d.dots = malloc(area * sizeof(Dot));
    d.sums = malloc((size_t)d.w * sizeof(int));
    d.marks = malloc(area);
    const int has_memory = d.smooth && d.dots && d.sums && d.marks;
    if (has_memory) {
        d.across = d.smooth + area;
        d.contrasts = d.across + area;
        d.brightnesses = d.contrasts + area;
        d.line = d.brightnesses + area;
        d.means = d.line + d.w + 4;
        d.blurred = d.means + blocks;
        d.paper = d.blurred + blocks;
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++)
            counts[k] = detect_dots(&d, images + k * area, xy + 2 * k * (size_t)d.max_dots);
        Py_END_ALLOW_THREADS
    }
    free(d.smooth);
    free(d.dots);
    free(d.sums);
    free(d.marks);
    return finish_call(&call, has_memory);
}

/* ---- Lattice of dots -------------------------------------------------------------------- */

enum { A_U = 0, C_U = 2, A_V = 3, C_V = 5, PERSPECTIVE = 6, LENS = 8, PARAMETERS = 9 };

typedef struct {
    int seeds, min_dots, rings, passes; /* passes: steps in each ring */
    int is_thorough;                    /* seeds from spectra of patches instead of the centre */
    const double *ring, *prior;          /* radii; inverse variances of the parameters */
    double min_neighbour, max_neighbour; /* of square distances of neighbours [square pitches] */
    double cell_gate, cell_sigma;        /* gate and sigma of dots about cell centres [pitches] */
    double symbol_gate, symbol_sigma;    /* gate and sigma of dots about their symbols [pitches] */
    double lens_radius, offset; /* radius from which the lens is fitted; of a symbol [pitches] */
    double min_seed_power;      /* least power of both peaks of a spectrum */
    double min_sigmas;          /* least number of dots, in standard deviations beyond chance */
} LatticeOptions;

enum { LANES = 8 };

/* Dots of a frame, one array per quantity, padded with zeros to a multiple of LANES. */
typedef struct {
    int count;
    float *x, *y, *valid;                     /* position p; 1 for a dot, 0 for padding */
    float *u, *v, *lens_slope, *depth, *q[2]; /* |p|^2 / (1 + lens |p|^2), 1 / (1 + g q), q */
    float *use, *residual[2];                 /* 1 for a dot in use; residuals */
} Dots;

static int new_dots(Dots *d, int m)
{
    d->count = (m + LANES - 1) / LANES * LANES;
    float **arrays[] = {&d->x,     &d->y,    &d->valid, &d->u,   &d->v,           &d->lens_slope,
                        &d->depth, &d->q[0], &d->q[1],  &d->use, &d->residual[0], &d->residual[1]};
    const int number = (int)(sizeof(arrays) / sizeof(*arrays));
    float *store = calloc((size_t)number * (size_t)d->count, sizeof(float));
    for (int k = 0; store && k < number; k++) *arrays[k] = store + (size_t)k * d->count;
    return store != NULL;
}

static void load_dots(const Dots *d, const float *points, const uint8_t *valid, int m)
{
    for (int i = 0; i < m; i++) {
        d->x[i] = points[2 * i];
        d->y[i] = points[2 * i + 1];
        d->valid[i] = valid[i] ? 1.0f : 0.0f;
    }
}

HOT static void project(const double *parameters, const Dots *d)
{
    float t[PARAMETERS];
    for (int k = 0; k < PARAMETERS; k++) t[k] = (float)parameters[k];
    const float *restrict px = d->x, *restrict py = d->y;
    float *restrict us = d->u, *restrict vs = d->v, *restrict lens_slopes = d->lens_slope;
    float *restrict depths = d->depth, *restrict q0 = d->q[0], *restrict q1 = d->q[1];
    for (int i = 0; i < d->count; i++) {
        const float x = px[i], y = py[i], square = x * x + y * y;
        const float lens_slope = 1 / (1 + t[LENS] * square), qx = x * lens_slope,
                    qy = y * lens_slope;
        const float depth = 1 / (1 + t[PERSPECTIVE] * qx + t[PERSPECTIVE + 1] * qy);
        us[i] = (t[A_U] * qx + t[A_U + 1] * qy + t[C_U]) * depth;
        vs[i] = (t[A_V] * qx + t[A_V + 1] * qy + t[C_V]) * depth;
        lens_slopes[i] = square * lens_slope;
        depths[i] = depth;
        q0[i] = qx;
        q1[i] = qy;
    }
}

/* Use the dots that are near a cell centre and within a ring; return whether any are beyond it. */
HOT static int match_cells(const Dots *d, float ring, float cell_gate)
{
    const float *restrict us = d->u, *restrict vs = d->v, *restrict valid = d->valid;
    float *restrict use = d->use, *restrict du = d->residual[0], *restrict dv = d->residual[1];
    int beyond = 0;
    for (int i = 0; i < d->count; i++) {
        const float u = rintf(us[i]), v = rintf(vs[i]);
        const int is_dot = valid[i] > 0, is_near = u * u + v * v < ring;
        du[i] = us[i] - u;
        dv[i] = vs[i] - v;
        beyond |= is_dot & !is_near;
        const int is_used =
            is_dot & is_near & (fabsf(du[i]) < cell_gate) & (fabsf(dv[i]) < cell_gate);
        use[i] = is_used ? 1.0f : 0.0f;
    }
    return beyond;
}

/* Displacement of the nearest symbol from the cell centre. */
static inline void nearest_symbol(const float *rest, float offset, float *symbol)
{
    const int along_x = fabsf(rest[0]) > fabsf(rest[1]);
    symbol[0] = along_x ? copysignf(offset, rest[0]) : 0;
    symbol[1] = along_x ? 0 : copysignf(offset, rest[1]);
}

/* Use the dots that are near a symbol. */
HOT static void match_symbols(const Dots *d, float offset, float symbol_gate)
{
    const float *restrict us = d->u, *restrict vs = d->v, *restrict valid = d->valid;
    float *restrict use = d->use, *restrict du = d->residual[0], *restrict dv = d->residual[1];
    for (int i = 0; i < d->count; i++) {
        const float rest[2] = {us[i] - rintf(us[i]), vs[i] - rintf(vs[i])};
        float symbol[2];
        nearest_symbol(rest, offset, symbol);
        du[i] = rest[0] - symbol[0];
        dv[i] = rest[1] - symbol[1];
        const int is_used =
            (valid[i] > 0) & (fabsf(du[i]) < symbol_gate) & (fabsf(dv[i]) < symbol_gate);
        use[i] = is_used ? 1.0f : 0.0f;
    }
}

/* Solve a x = b in place by Gaussian elimination with row pivots, for `sides` columns b[k][side].
 * Return 0 if a is singular. */
static int solve_linear(double a[PARAMETERS][PARAMETERS], double *b, int sides)
{
    for (int k = 0; k < PARAMETERS; k++) {
        int pivot = k;
        for (int i = k + 1; i < PARAMETERS; i++)
            if (fabs(a[i][k]) > fabs(a[pivot][k])) pivot = i;
        if (!(fabs(a[pivot][k]) > 0)) return 0;
        if (pivot != k) {
            for (int j = k; j < PARAMETERS; j++) {
                const double swap = a[k][j];
                a[k][j] = a[pivot][j];
                a[pivot][j] = swap;
            }
            for (int j = 0; j < sides; j++) {
                const double swap = b[k * sides + j];
                b[k * sides + j] = b[pivot * sides + j];
                b[pivot * sides + j] = swap;
            }
        }
        for (int i = k + 1; i < PARAMETERS; i++) {
            const double factor = a[i][k] / a[k][k];
            for (int j = k; j < PARAMETERS; j++) a[i][j] -= factor * a[k][j];
            for (int j = 0; j < sides; j++) b[i * sides + j] -= factor * b[k * sides + j];
        }
    }
    for (int k = PARAMETERS - 1; k >= 0; k--)
        for (int side = 0; side < sides; side++) {
            for (int j = k + 1; j < PARAMETERS; j++)
                b[k * sides + side] -= a[k][j] * b[j * sides + side];
            b[k * sides + side] /= a[k][k];
        }
    return 1;
}

static double sum_lanes(const float *lanes)
{
    double sum = 0;
    for (int l = 0; l < LANES; l++) sum += lanes[l];
    return sum;
}

/* Normal equations of the residuals of the dots in use and of the priors. Sums run in LANES
 * independent parts, since a compiler must not reorder a single floating-point sum. */
HOT static void normal_equations(const double *parameters, const Dots *d, double sigma, int lens,
                                 const double *prior, double normal[PARAMETERS][PARAMETERS],
                                 double *right)
{
    float s_shared[6][LANES] = {{0}}, s_cross[2][9][LANES] = {{{0}}}, s_corner[6][LANES] = {{0}};
    float s_right[PARAMETERS][LANES] = {{0}};
    const float g0 = (float)parameters[PERSPECTIVE], g1 = (float)parameters[PERSPECTIVE + 1];
    for (int i = 0; i < d->count; i += LANES) {
        float o[LANES], b[2][LANES];
        for (int l = 0; l < LANES; l++) {
            o[l] = d->depth[i + l] * d->use[i + l];
            b[0][l] = d->q[0][i + l] * o[l];
            b[1][l] = d->q[1][i + l] * o[l];
        }
        for (int l = 0; l < LANES; l++) s_shared[0][l] += b[0][l] * b[0][l];
        for (int l = 0; l < LANES; l++) s_shared[1][l] += b[0][l] * b[1][l];
        for (int l = 0; l < LANES; l++) s_shared[2][l] += b[0][l] * o[l];
        for (int l = 0; l < LANES; l++) s_shared[3][l] += b[1][l] * b[1][l];
        for (int l = 0; l < LANES; l++) s_shared[4][l] += b[1][l] * o[l];
        for (int l = 0; l < LANES; l++) s_shared[5][l] += o[l] * o[l];
        for (int axis = 0; axis < 2; axis++) {
            const float *value = (axis ? d->v : d->u) + i, *residual = d->residual[axis] + i;
            const float *q0 = d->q[0] + i, *q1 = d->q[1] + i, *lens_slope = d->lens_slope + i;
            const float a0 = (float)parameters[3 * axis], a1 = (float)parameters[3 * axis + 1];
            float c[3][LANES], w[LANES];
            for (int l = 0; l < LANES; l++) {
                c[0][l] = -value[l] * b[0][l];
                c[1][l] = -value[l] * b[1][l];
                const float slope = a0 * q0[l] + a1 * q1[l] - value[l] * (g0 * q0[l] + g1 * q1[l]);
                c[2][l] = lens ? -slope * lens_slope[l] * o[l] : 0;
                w[l] = -residual[l] * d->use[i + l];
            }
            for (int k = 0; k < 3; k++) {
                const float *column = c[k];
                float(*x)[LANES] = s_cross[axis];
                for (int l = 0; l < LANES; l++) x[k][l] += b[0][l] * column[l];
                for (int l = 0; l < LANES; l++) x[3 + k][l] += b[1][l] * column[l];
                for (int l = 0; l < LANES; l++) x[6 + k][l] += o[l] * column[l];
                for (int l = 0; l < LANES; l++) s_right[6 + k][l] += column[l] * w[l];
            }
            for (int l = 0; l < LANES; l++) s_corner[0][l] += c[0][l] * c[0][l];
            for (int l = 0; l < LANES; l++) s_corner[1][l] += c[0][l] * c[1][l];
            for (int l = 0; l < LANES; l++) s_corner[2][l] += c[0][l] * c[2][l];
            for (int l = 0; l < LANES; l++) s_corner[3][l] += c[1][l] * c[1][l];
            for (int l = 0; l < LANES; l++) s_corner[4][l] += c[1][l] * c[2][l];
            for (int l = 0; l < LANES; l++) s_corner[5][l] += c[2][l] * c[2][l];
            for (int l = 0; l < LANES; l++) s_right[3 * axis][l] += b[0][l] * w[l];
            for (int l = 0; l < LANES; l++) s_right[3 * axis + 1][l] += b[1][l] * w[l];
            for (int l = 0; l < LANES; l++) s_right[3 * axis + 2][l] += o[l] * w[l];
        }
    }
    double shared[6], cross[2][9], corner[6];
    for (int k = 0; k < 6; k++) {
        shared[k] = sum_lanes(s_shared[k]);
        corner[k] = sum_lanes(s_corner[k]);
    }
    for (int k = 0; k < 9; k++) {
        cross[0][k] = sum_lanes(s_cross[0][k]);
        cross[1][k] = sum_lanes(s_cross[1][k]);
        right[k] = sum_lanes(s_right[k]);
    }
    static const int packed[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    memset(normal, 0, PARAMETERS * sizeof(*normal));
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            normal[i][j] = normal[3 + i][3 + j] = shared[packed[i][j]];
            normal[6 + i][6 + j] = corner[packed[i][j]];
            normal[i][6 + j] = normal[6 + j][i] = cross[0][3 * i + j];
            normal[3 + i][6 + j] = normal[6 + j][3 + i] = cross[1][3 * i + j];
        }
    for (int k = 0; k < PARAMETERS; k++) {
        const double weight = (k == LENS && !lens ? 1e12 : prior[k]) * sigma * sigma;
        normal[k][k] += weight + 1e-9;
        right[k] -= weight * parameters[k];
    }
}

/* Take one Gauss-Newton step; return 0 if the equations are singular. */
static int gauss_newton_step(double *parameters, const Dots *d, double sigma, int lens,
                             const double *prior)
{
    double normal[PARAMETERS][PARAMETERS], right[PARAMETERS];
    normal_equations(parameters, d, sigma, lens, prior, normal, right);
    if (!solve_linear(normal, right, 1)) return 0;
    for (int k = 0; k < PARAMETERS; k++) parameters[k] += right[k];
    return 1;
}

/* Square distance of each point to its third nearest neighbour. The loop has no branch, since none
 * could be predicted. */
HOT static void third_nearest(const float *restrict x, const float *restrict y, int count,
                              float *restrict first, float *restrict second, float *restrict third)
{
    for (int i = 0; i < count; i++) first[i] = second[i] = third[i] = FLT_MAX;
    for (int j = 0; j < count; j++)
        for (int i = 0; i < count; i++) {
            const float dx = x[i] - x[j], dy = y[i] - y[j];
            const float square = i == j ? FLT_MAX : dx * dx + dy * dy;
            const float a = first[i], b = second[i], c = third[i];
            third[i] = lesser(c, b > square ? b : square);
            second[i] = lesser(b, a > square ? a : square);
            first[i] = lesser(a, square);
        }
}

/* Estimate pitch, direction and shift from the dots in the centre; return 0 if there are too few.
 * `scratch` holds m + 1 floats, 7 for each seed, and seeds * (seeds + 1) for pairs. */
static int estimate_seed(const float *points, const uint8_t *valid, int m,
                         const LatticeOptions *options, float *scratch, double *parameters)
{
    float *squares = scratch, *x = squares + m + 1, *y = x + options->seeds,
          *work = y + options->seeds;
    float *dxs = work + 5 * options->seeds, *dys = dxs + options->seeds * (options->seeds + 1) / 2;
    int dots = 0, count = 0;
    for (int i = 0; i < m; i++) {
        const float px = points[2 * i], py = points[2 * i + 1];
        squares[dots] = px * px + py * py;
        dots += valid[i] != 0;
    }
    if (dots < options->min_dots) return 0;
    const int wanted = dots < options->seeds ? dots : options->seeds;
    const float threshold = nth_smallest(squares, dots, wanted - 1);
    for (int i = 0; i < m && count < wanted; i++) {
        const float px = points[2 * i], py = points[2 * i + 1];
        if (!valid[i] || px * px + py * py > threshold) continue;
        x[count] = px;
        y[count++] = py;
    }
    float *third = work + 2 * options->seeds;
    third_nearest(x, y, count, work, work + options->seeds, third);
    sort_floats(third, count);
    const float pitch_square = 0.5f * (third[(count - 1) / 2] + third[count / 2]);
    const float low = (float)options->min_neighbour * pitch_square;
    const float high = (float)options->max_neighbour * pitch_square;
    int pairs = 0;
    for (int i = 0; i < count; i++)
        for (int j = 0; j < i; j++) {
            const float dx = x[i] - x[j], dy = y[i] - y[j], square = dx * dx + dy * dy;
            dxs[pairs] = dx;
            dys[pairs] = dy;
            pairs += (square > low) & (square < high);
        }
    if (!pairs) return 0;
    double sine = 0, cosine = 0, sum = 0;
    for (int k = 0; k < pairs; k++) {
        const float dx = dxs[k], dy = dys[k], square = dx * dx + dy * dy;
        const float re = (dx * dx - dy * dy) / square, im = 2 * dx * dy / square;
        sine += 2 * re * im;
        cosine += re * re - im * im;
    }
    const double angle = 0.25 * atan2(sine, cosine), c = cos(angle), s = sin(angle);
    for (int k = 0; k < pairs; k++) {
        const float a = fabsf((float)c * dxs[k] + (float)s * dys[k]);
        const float b = fabsf((float)c * dys[k] - (float)s * dxs[k]);
        sum += a > b ? a : b;
    }
    const double pitch = sum / pairs;
    memset(parameters, 0, PARAMETERS * sizeof(double));
    parameters[A_U] = parameters[A_V + 1] = c / pitch;
    parameters[A_U + 1] = s / pitch;
    parameters[A_V] = -s / pitch;
    const double two_pi = 2 * 3.14159265358979323846;
    for (int axis = 0; axis < 2; axis++) {
        const double *a = parameters + 3 * axis;
        double re = 0, im = 0;
        for (int i = 0; i < count; i++) {
            const double phase = two_pi * (a[0] * x[i] + a[1] * y[i]);
            re += cos(phase);
            im += sin(phase);
        }
        parameters[C_U + 3 * axis] = -atan2(im, re) / two_pi;
    }
    return 1;
}

/* Number of frequencies along an axis of a spectrum; the other has half of them and zero. */
enum { MAX_FREQUENCIES = 48 };

/* Power of dots at the frequencies (column, row) and (-column, row) in multiples of `step`, from 0
 * to `half` each; 1 if all dots have the same phase. `waves` holds 2 MAX_FREQUENCIES floats for each
 * dot. */
HOT static void spectrum(const float *restrict x, const float *restrict y, int count, float step,
                         int half, float *restrict waves, float *restrict power)
{
    enum { ROW = MAX_FREQUENCIES / 2 };
    for (int i = 0; i < count; i++) {
        float *wave = waves + i * 4 * ROW;
        for (int axis = 0; axis < 2; axis++, wave += 2 * ROW) {
            const float phase = 6.2831853f * step * (axis ? y[i] : x[i]);
            const float c = cosf(phase), s = sinf(phase);
            wave[0] = 1;
            wave[ROW] = 0;
            for (int k = 1; k < ROW; k++) {
                wave[k] = wave[k - 1] * c - wave[ROW + k - 1] * s;
                wave[ROW + k] = wave[k - 1] * s + wave[ROW + k - 1] * c;
            }
        }
    }
    const float scale = 1 / (float)(count * count);
    for (int row = 0; row <= half; row++) {
        float sums[4][ROW] = {{0}};
        for (int i = 0; i < count; i++) {
            const float *restrict a = waves + i * 4 * ROW, *restrict b = a + ROW;
            const float c = a[2 * ROW + row], d = a[3 * ROW + row];
            for (int k = 0; k < ROW; k++) sums[0][k] += a[k] * c;
            for (int k = 0; k < ROW; k++) sums[1][k] += b[k] * d;
            for (int k = 0; k < ROW; k++) sums[2][k] += a[k] * d;
            for (int k = 0; k < ROW; k++) sums[3][k] += b[k] * c;
        }
        for (int k = 0; k <= half; k++)
            for (int side = 0; side < 2; side++) {
                const float re = side ? sums[0][k] + sums[1][k] : sums[0][k] - sums[1][k];
                const float im = side ? sums[2][k] - sums[3][k] : sums[2][k] + sums[3][k];
                power[(row * (half + 1) + k) * 2 + side] = (re * re + im * im) * scale;
            }
    }
}

/* Estimate the lattice of the dots nearest to `middle` from the two highest peaks of their spectrum
 * in different directions, which no tilt and few foreign dots change; node (0, 0) is at the median
 * of the dots. Return 0 if the peaks are weak. `scratch` holds m floats and, for each seed, 10 and
 * 6 for each frequency. */
static int spectral_seed(const float *points, const uint8_t *valid, int m, const float *middle,
                         const LatticeOptions *options, float *scratch, double *parameters)
{
    const int seeds = options->seeds;
    float *squares = scratch, *x = squares + m, *y = x + seeds, *work = y + seeds;
    int dots = 0, count = 0;
    for (int i = 0; i < m; i++) {
        const float dx = points[2 * i] - middle[0], dy = points[2 * i + 1] - middle[1];
        if (valid[i]) squares[dots++] = dx * dx + dy * dy;
    }
    if (dots < options->min_dots) return 0;
    const int wanted = dots < seeds ? dots : seeds;
    const float threshold = nth_smallest(squares, dots, wanted - 1);
    for (int i = 0; i < m && count < wanted; i++) {
        const float dx = points[2 * i] - middle[0], dy = points[2 * i + 1] - middle[1];
        if (!valid[i] || dx * dx + dy * dy > threshold) continue;
        x[count] = points[2 * i];
        y[count++] = points[2 * i + 1];
    }
    float centre[2];
    memcpy(work, x, (size_t)count * sizeof(float));
    centre[0] = nth_smallest(work, count, count / 2);
    memcpy(work, y, (size_t)count * sizeof(float));
    centre[1] = nth_smallest(work, count, count / 2);
    float radius = 0;
    for (int i = 0; i < count; i++) {
        x[i] -= centre[0];
        y[i] -= centre[1];
        const float square = x[i] * x[i] + y[i] * y[i];
        radius = square > radius ? square : radius;
    }
    radius = sqrtf(radius);
    float *third = work + 2 * seeds;
    third_nearest(x, y, count, work, work + seeds, third);
    const float pitch = sqrtf(nth_smallest(third, count, count / 2));
    if (!(pitch > 0)) return 0;
    /* Frequencies up to 1.7 per pitch, so near to each other that no peak is missed. */
    const int half = (int)lesser(ceilf(1.7f / pitch / (0.3f / radius)), MAX_FREQUENCIES / 2 - 1);
    const float step = 1.7f / pitch / (float)half;
    float *power = work + 4 * (MAX_FREQUENCIES / 2) * seeds;
    spectrum(x, y, count, step, half, work, power);
    float best[2] = {0, 0}, frequency[2][2] = {{0}};
    double phasor[2][2] = {{0}};
    for (int peak = 0; peak < 2; peak++) {
        int index = -1;
        for (int k = 0; k < 2 * (half + 1) * (half + 1); k++) {
            if (!(power[k] > best[peak])) continue;
            const float fx = (float)(k / 2 % (half + 1)) * step * (k % 2 ? -1.0f : 1.0f);
            const float fy = (float)(k / 2 / (half + 1)) * step, size = hypotf(fx, fy);
            if (size < 0.5f / pitch || size > 1.700001f / pitch) continue;
            if (peak) {
                const float first = hypotf(frequency[0][0], frequency[0][1]);
                const float sine =
                    fabsf(fx * frequency[0][1] - fy * frequency[0][0]) / (size * first);
                if (sine < 0.6f || size < 0.5f * first || size > 2 * first) continue;
            }
            best[peak] = power[k];
            frequency[peak][0] = fx;
            frequency[peak][1] = fy;
            index = k;
        }
        if (index < 0 || best[peak] < options->min_seed_power) return 0;
        for (int i = 0; i < count; i++) {
            const double turns = frequency[peak][0] * x[i] + frequency[peak][1] * y[i];
            const double phase = 6.283185307179586 * turns;
            phasor[peak][0] += cos(phase);
            phasor[peak][1] += sin(phase);
        }
    }
    memset(parameters, 0, PARAMETERS * sizeof(double));
    const int is_swapped = fabsf(frequency[0][0]) < fabsf(frequency[1][0]);
    for (int axis = 0; axis < 2; axis++) {
        const int peak = is_swapped ? 1 - axis : axis;
        const double sign = frequency[peak][axis] < 0 ? -1 : 1;
        double *a = parameters + 3 * axis;
        a[0] = sign * frequency[peak][0];
        a[1] = sign * frequency[peak][1];
        a[2] = -sign * atan2(phasor[peak][1], phasor[peak][0]) / 6.283185307179586
               - a[0] * centre[0] - a[1] * centre[1];
    }
    return 1;
}

/* Grow the lattice from a seed about node (0, 0) over all dots; return the number of dots near the
 * offset of a symbol, or -1 if a step fails. */
static int grow_lattice(const Dots *d, int lens, const LatticeOptions *options, double *parameters)
{
    for (int r = 0, beyond = 1; r < options->rings && beyond; r++) {
        const double ring = options->ring[r] * options->ring[r];
        const int with_lens = lens && options->ring[r] > options->lens_radius;
        for (int pass = 0; pass < options->passes; pass++) {
            project(parameters, d);
            beyond = match_cells(d, (float)ring, (float)options->cell_gate);
            if (!gauss_newton_step(parameters, d, options->cell_sigma, with_lens, options->prior))
                return -1;
        }
    }
    for (int pass = 0; pass < 2; pass++) {
        project(parameters, d);
        match_symbols(d, (float)options->offset, (float)options->symbol_gate);
        if (!gauss_newton_step(parameters, d, options->symbol_sigma, lens, options->prior))
            return -1;
    }
    project(parameters, d);
    match_symbols(d, (float)options->offset, (float)options->symbol_gate);
    for (int k = 0; k < PARAMETERS; k++)
        if (!isfinite(parameters[k])) return -1;
    int count = 0;
    for (int i = 0; i < d->count; i++) count += d->use[i] > 0;
    return count;
}

/* Grow lattices from patches of the frame, and return the count of the one with most dots. */
static int grow_from_patches(const Dots *d, const float *points, const uint8_t *valid, int m,
                             int lens, const LatticeOptions *options, float *scratch,
                             double *parameters)
{
    float low[2], high[2];
    int dots = 0;
    for (int axis = 0; axis < 2; axis++) {
        dots = 0;
        for (int i = 0; i < m; i++)
            if (valid[i]) scratch[dots++] = points[2 * i + axis];
        if (dots < options->min_dots) return -1;
        low[axis] = nth_smallest(scratch, dots, dots / 10);
        high[axis] = nth_smallest(scratch, dots, dots - 1 - dots / 10);
    }
    static const float fractions[][2] = {
        {0.5f, 0.5f}, {0.15f, 0.15f}, {0.85f, 0.15f}, {0.15f, 0.85f}, {0.85f, 0.85f}};
    int most = -1;
    for (int patch = 0; patch < 5; patch++) {
        const float middle[2] = {low[0] + (high[0] - low[0]) * fractions[patch][0],
                                 low[1] + (high[1] - low[1]) * fractions[patch][1]};
        double candidate[PARAMETERS];
        if (!spectral_seed(points, valid, m, middle, options, scratch, candidate)) continue;
        const int count = grow_lattice(d, lens, options, candidate);
        if (count <= most) continue;
        most = count;
        memcpy(parameters, candidate, sizeof(candidate));
        /* Of dots without a lattice, a quarter are near an offset. */
        if (2 * count > dots) break;
    }
    if (most < 0) return -1;
    project(parameters, d);
    match_symbols(d, (float)options->offset, (float)options->symbol_gate);
    return most;
}

/* Fit the lattice of the dots of a frame; return 0 if there is none. */
static int fit_lattice(const Dots *d, const float *points, const uint8_t *valid, int m, int lens,
                       const LatticeOptions *options, float *scratch, double *parameters,
                       float *uv, float *cells, double *sigma)
{
    int count;
    if (options->is_thorough) {
        count = grow_from_patches(d, points, valid, m, lens, options, scratch, parameters);
    } else {
        if (!estimate_seed(points, valid, m, options, scratch, parameters)) return 0;
        count = grow_lattice(d, lens, options, parameters);
    }
    if (count < 0) return 0;
    /* The central cell becomes the origin. */
    double shift[2];
    for (int axis = 0; axis < 2; axis++) {
        double *a = parameters + 3 * axis;
        shift[axis] = rint(a[2]);
        a[0] -= shift[axis] * parameters[PERSPECTIVE];
        a[1] -= shift[axis] * parameters[PERSPECTIVE + 1];
        a[2] -= shift[axis];
    }
    double squares = 0;
    for (int i = 0; i < m && i < d->count; i++) {
        uv[2 * i] = d->u[i] - (float)shift[0];
        uv[2 * i + 1] = d->v[i] - (float)shift[1];
        cells[2 * i] = rintf(uv[2 * i]);
        cells[2 * i + 1] = rintf(uv[2 * i + 1]);
        if (d->use[i] > 0)
            squares += (double)(d->residual[0][i] * d->residual[0][i]
                                + d->residual[1][i] * d->residual[1][i]);
    }
    *sigma = sqrt(squares / (2 * count - 8 > 1 ? 2 * count - 8 : 1));
    /* Some of any dots are near the offset of a symbol. */
    int dots = 0;
    for (int i = 0; i < m; i++) dots += valid[i] != 0;
    const double chance = 16 * options->symbol_gate * options->symbol_gate;
    const double least =
        chance * dots
        + options->min_sigmas * sqrt(chance * (1 - chance > 0 ? 1 - chance : 0) * dots);
    /* Root mean square of values that are uniform within the gate, and its spread. */
    const double random_sigma = options->symbol_gate / sqrt(3.0);
    const double spread = sqrt(0.2 / (count > 0 ? 2 * count : 1));
    return count >= options->min_dots && count >= least
           && *sigma < random_sigma * (1 - options->min_sigmas * spread);
}

/* Largest numbers of dots of a frame and of dots that seed a lattice. Pairs of seeds are stored.
 */
enum { MAX_DOTS = 1 << 24, MAX_SEEDS = 4096, MAX_PASSES = 100 };

static PyObject *fit_lattices(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *points_array, *valid_array, *ring_array, *prior_array, *parameters_array, *uv_array,
        *cells_array, *sigma_array, *found_array;
    long long n, m, passes, seeds, min_dots;
    int lens;
    LatticeOptions options;
    if (!parse_arguments(args, "OOLLppLOOLLddddddddddOOOOO:fit_lattices", &points_array,
                         &valid_array, &n, &m, &lens, &options.is_thorough, &passes, &ring_array,
                         &prior_array, &seeds, &min_dots, &options.min_sigmas,
                         &options.min_neighbour, &options.max_neighbour, &options.cell_gate,
                         &options.cell_sigma, &options.symbol_gate, &options.symbol_sigma,
                         &options.lens_radius, &options.offset, &options.min_seed_power,
                         &parameters_array, &uv_array,
                         &cells_array, &sigma_array, &found_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "m", m, 0, MAX_DOTS);
    check_range(&call, "passes", passes, 1, MAX_PASSES);
    check_range(&call, "seeds", seeds, 1, MAX_SEEDS);
    check_range(&call, "min_dots", min_dots, 1, INT_MAX);
    if (call.failed) return NULL;
    Py_ssize_t rings;
    const float *points = input(&call, points_array, "points", ITEM_FLOAT32, ITEMS(n, m, 2));
    const uint8_t *valid = input(&call, valid_array, "valid", ITEM_FLAG, ITEMS(n, m));
    options.ring = input_rows(&call, ring_array, "ring_radii", ITEM_FLOAT64, 1, &rings);
    options.prior = input(&call, prior_array, "prior", ITEM_FLOAT64, PARAMETERS);
    double *parameters =
        output(&call, parameters_array, "parameters", ITEM_FLOAT64, ITEMS(n, PARAMETERS));
    float *uv = output(&call, uv_array, "uv", ITEM_FLOAT32, ITEMS(n, m, 2));
    float *cells = output(&call, cells_array, "cells", ITEM_FLOAT32, ITEMS(n, m, 2));
    double *sigma = output(&call, sigma_array, "sigma", ITEM_FLOAT64, n);
    uint8_t *found = output(&call, found_array, "found", ITEM_FLAG, n);
    check_range(&call, "number of ring_radii", rings, 0, INT_MAX);
    if (call.failed) return finish_call(&call, 1);
    options.passes = (int)passes;
    options.seeds = (int)seeds;
    options.min_dots = (int)min_dots;
    options.rings = (int)rings;
    Dots d;
    const int has_dots = new_dots(&d, (int)m);
    const size_t pairs = (size_t)(7 * seeds + seeds * (seeds + 1));
    const size_t spectrum = (size_t)(2 * seeds) + (size_t)(2 * MAX_FREQUENCIES * seeds)
                            + (size_t)(MAX_FREQUENCIES * MAX_FREQUENCIES / 2) + 3 * (size_t)seeds;
    const size_t items = (size_t)m + 1 + (pairs > spectrum ? pairs : spectrum);
    float *scratch = malloc(items * sizeof(float));
    const int has_memory = has_dots && scratch;
    if (has_memory) {
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++) {
            const size_t dot = k * (size_t)m;
            load_dots(&d, points + 2 * dot, valid + dot, (int)m);
            /* Other frames of the batch may have more dots, which are padding in this one. */
            size_t last = (size_t)m;
            while (last && !valid[dot + last - 1]) last--;
            d.count = (int)(last + LANES - 1) / LANES * LANES;
            found[k] = (uint8_t)fit_lattice(&d, points + 2 * dot, valid + dot, (int)m, lens,
                                            &options, scratch, parameters + k * PARAMETERS,
                                            uv + 2 * dot, cells + 2 * dot, sigma + k);
        }
        Py_END_ALLOW_THREADS
    }
    if (has_dots) free(d.x);
    free(scratch);
    return finish_call(&call, has_memory);
}

/* ---- Soft bits -------------------------------------------------------------------------- */

/* Distance of a dot's offset from the nearest symbol, the larger of both axes. */
static inline float symbol_distance(const float *rest, float offset)
{
    float symbol[2];
    nearest_symbol(rest, offset, symbol);
    const float a = fabsf(rest[0] - symbol[0]), b = fabsf(rest[1] - symbol[1]);
    return a > b ? a : b;
}

/* Soft bits of a frame's dots in the central square of 2 half_width cells a side. If several dots
 * are in one cell, the one nearest to a symbol counts. */
static void frame_soft_bits(const float *uv, const float *cells, const uint8_t *valid, int m,
                            int half_width, float sigma, float offset, float symbol_gate,
                            float wrong_symbol, float *distances, float *x_bits, float *y_bits)
{
    const int length = 2 * half_width;
    const float exponent = -0.5f / (sigma * sigma);
    for (int k = 0; k < length * length; k++) {
        distances[k] = FLT_MAX;
        x_bits[k] = y_bits[k] = 0;
    }
    int dots = 0, outliers = 0;
    for (int i = 0; i < m; i++) {
        if (!valid[i]) continue;
        const float rest[2] = {uv[2 * i] - cells[2 * i], uv[2 * i + 1] - cells[2 * i + 1]};
        dots++;
        outliers += symbol_distance(rest, offset) >= symbol_gate;
    }
    /* One outlier in a cell, relative to the peak of the Gaussian; a bit has two symbols. */
    const float outlier_fraction = (float)(outliers + 1) / (float)(dots + 2);
    const float floor = 2 * 6.2831853f * sigma * sigma * outlier_fraction + wrong_symbol;
    for (int i = 0; i < m; i++) {
        if (!valid[i]) continue;
        const float u = cells[2 * i], v = cells[2 * i + 1];
        /* Outside of the square, and for NaN, a conversion to int may be undefined. */
        if (!(fabsf(u) <= (float)half_width && fabsf(v) <= (float)half_width)) continue;
        const int column = (int)u + half_width, row = (int)v + half_width;
        if (column < 0 || column >= length || row < 0 || row >= length) continue;
        const float rest[2] = {uv[2 * i] - u, uv[2 * i + 1] - v};
        const float distance = symbol_distance(rest, offset);
        const int cell = row * length + column;
        if (distance >= distances[cell]) continue;
        distances[cell] = distance;
        const float square = rest[0] * rest[0] + rest[1] * rest[1] + offset * offset;
        const float up = expf(exponent * (square + 2 * offset * rest[1]));
        const float left = expf(exponent * (square + 2 * offset * rest[0]));
        const float right = expf(exponent * (square - 2 * offset * rest[0]));
        const float down = expf(exponent * (square - 2 * offset * rest[1]));
        x_bits[cell] = logf((left + down + floor) / (up + right + floor));
        y_bits[cell] = logf((right + down + floor) / (up + left + floor));
    }
}

/* Largest half width of a window of cells; the number of its cells fits into an int. */
enum { MAX_HALF_WIDTH = 8192 };

static PyObject *soft_bits(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *uv_array, *cells_array, *valid_array, *found_array, *sigma_array, *x_array, *y_array;
    long long n, m, half_width;
    float offset, symbol_gate, wrong_symbol;
    if (!parse_arguments(args, "OOOOOLLLfffOO:soft_bits", &uv_array, &cells_array, &valid_array,
                         &found_array, &sigma_array, &n, &m, &half_width, &offset,
                         &symbol_gate, &wrong_symbol, &x_array, &y_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "m", m, 0, MAX_DOTS);
    check_range(&call, "half_width", half_width, 1, MAX_HALF_WIDTH);
    if (call.failed) return NULL;
    const long long length = 2 * half_width;
    const float *uv = input(&call, uv_array, "uv", ITEM_FLOAT32, ITEMS(n, m, 2));
    const float *cells = input(&call, cells_array, "cells", ITEM_FLOAT32, ITEMS(n, m, 2));
    const uint8_t *valid = input(&call, valid_array, "valid", ITEM_FLAG, ITEMS(n, m));
    const uint8_t *found = input(&call, found_array, "found", ITEM_FLAG, n);
    const double *sigma = input(&call, sigma_array, "sigma", ITEM_FLOAT64, n);
    float *x_bits = output(&call, x_array, "x_bits", ITEM_FLOAT32, ITEMS(n, length, length));
    float *y_bits = output(&call, y_array, "y_bits", ITEM_FLOAT32, ITEMS(n, length, length));
    if (call.failed) return finish_call(&call, 1);
    const size_t size = (size_t)(length * length);
    float *distances = malloc(size * sizeof(float));
    if (distances) {
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++) {
            const size_t dot = k * (size_t)m;
            frame_soft_bits(uv + 2 * dot, cells + 2 * dot, valid + dot, found[k] ? (int)m : 0,
                            (int)half_width, (float)sigma[k], offset, symbol_gate,
                            wrong_symbol, distances,
                            x_bits + k * size, y_bits + k * size);
        }
        Py_END_ALLOW_THREADS
    }
    free(distances);
    return finish_call(&call, distances != NULL);
}

/* ---- First reading of windows ----------------------------------------------------------- */

enum { PERIOD = 63, SEQUENCES = 4, BASE = 3, MAX_WINDOW_CELLS = 1024 };

typedef struct {
    const int64_t *lengths, *weights, *crt; /* of the four secondary sequences */
    const int64_t *prefixes; /* cumulative sums of the sequences, one after the other */
    const float *signs;      /* main sequence as -1 and 1, repeated beyond its period */
    const int8_t *digits;    /* (4, 63) digit of each phase difference; -1: none */
    const float
        *masks; /* (4, 3, widest) 1 where the sequence has a digit, repeated beyond its end */
    int64_t range, smallest_shift, widest;
    double log_hypotheses;             /* logarithm of the number of hypotheses per axis */
    double phase_log_odds[PERIOD + 1]; /* log odds of a line by its number of likely phases */
} Codec;

typedef struct {
    int64_t position, shift, wrong, first, last;
    double log_odds, order_log_odds, margin;
} Axis;

static inline int64_t remainder_of(int64_t a, int64_t b)
{
    const int64_t r = a % b;
    return r < 0 ? r + b : r;
}

/* Phase of the main sequence at the start of a column or row; see Codec.phases in Python. */
static int64_t phase_at(const Codec *codec, int64_t position)
{
    int64_t total = codec->smallest_shift * position;
    const int64_t *prefix = codec->prefixes;
    for (int k = 0; k < SEQUENCES; k++) {
        const int64_t length = codec->lengths[k];
        total +=
            codec->weights[k] * (position / length * prefix[length] + prefix[position % length]);
        prefix += length + 1;
    }
    return remainder_of(total, PERIOD);
}

/* Phases of lines from a position on, across the end of the section. */
static void following_phases(const Codec *codec, int64_t position, int length, int *phases)
{
    int64_t residues[SEQUENCES], phase = phase_at(codec, position);
    for (int k = 0; k < SEQUENCES; k++) residues[k] = position % codec->lengths[k];
    for (int i = 0; i < length; i++) {
        phases[i] = (int)phase;
        const int64_t *prefix = codec->prefixes;
        phase += codec->smallest_shift;
        for (int k = 0; k < SEQUENCES; k++) {
            phase += codec->weights[k] * (prefix[residues[k] + 1] - prefix[residues[k]]);
            residues[k] = residues[k] + 1 < codec->lengths[k] ? residues[k] + 1 : 0;
            prefix += codec->lengths[k] + 1;
        }
        phase = remainder_of(phase, PERIOD);
        if (++position == codec->range) position = phase = 0;
    }
}

/* Find the most likely position and shift of one axis by votes of the most likely phase of each
 * line. */
HOT static void vote_position(const Codec *codec, const float *const *scores, int lines,
                              float *votes, int *phase, float *margin, Axis *axis)
{
    for (int i = 0; i < lines; i++) {
        const float *s = scores[i];
        float top = s[0], next = -FLT_MAX;
        int best = 0;
        for (int k = 1; k < PERIOD; k++) {
            if (s[k] > top) {
                next = top;
                top = s[k];
                best = k;
            } else if (s[k] > next)
                next = s[k];
        }
        phase[i] = best;
        margin[i] = top - next;
    }
    int64_t position = 0;
    axis->margin = DBL_MAX;
    for (int k = 0; k < SEQUENCES; k++) {
        const int length = (int)codec->lengths[k];
        memset(votes, 0, (size_t)length * sizeof(float));
        for (int i = 0; i + 1 < lines; i++) {
            const float weight = lesser(margin[i], margin[i + 1]);
            const int difference = (phase[i + 1] - phase[i] + PERIOD) % PERIOD;
            const int digits = codec->digits[k * PERIOD + difference];
            if (digits < 0 || weight <= 0) continue;
            const float *restrict mask =
                codec->masks + (k * BASE + digits) * codec->widest + i % length;
            for (int q = 0; q < length; q++) votes[q] += weight * mask[q];
        }
        int best = 0;
        float second = -1;
        for (int q = 1; q < length; q++) {
            if (votes[q] > votes[best]) {
                second = votes[best];
                best = q;
            } else if (votes[q] > second)
                second = votes[q];
        }
        if (votes[best] - second < axis->margin) axis->margin = votes[best] - second;
        position = (position + codec->crt[k] * best) % codec->range;
    }
    axis->position = position;
    float shift_votes[PERIOD] = {0};
    int expected[MAX_WINDOW_CELLS];
    following_phases(codec, position, lines, expected);
    for (int i = 0; i < lines; i++)
        shift_votes[(phase[i] - expected[i] + PERIOD) % PERIOD] += margin[i];
    int best = 0;
    for (int k = 1; k < PERIOD; k++)
        if (shift_votes[k] > shift_votes[best]) best = k;
    axis->shift = best;
    /* The alternative hypothesis: lines in any order, each at one of its likely phases. */
    axis->order_log_odds = -codec->log_hypotheses;
    for (int i = 0; i < lines; i++) {
        const float top = scores[i][phase[i]];
        if (top <= 0) continue;
        int likely = 0;
        for (int k = 0; k < PERIOD; k++) likely += scores[i][k] > top - 2;
        const float score = scores[i][(expected[i] + best) % PERIOD];
        axis->order_log_odds += codec->phase_log_odds[likely] - 0.5 * (double)(top - score);
    }
}

/* Log odds of the position. Dot j of line i of the axis is at
 * bits[start + i * across + j * along]. */
static void score_position(const Codec *codec, const float *bits, float sign, int start,
                           int across, int along, int length, Axis *axis)
{
    double log_odds = 0;
    axis->wrong = 0;
    axis->first = length;
    axis->last = -1;
    int phases[MAX_WINDOW_CELLS];
    following_phases(codec, axis->position, length, phases);
    for (int i = 0; i < length; i++) {
        const float *line = bits + start + i * across;
        const int64_t phase = (phases[i] + axis->shift) % PERIOD;
        int has_dots = 0;
        for (int j = 0; j < length; j++) {
            const float bit = line[j * along];
            if (bit == 0) continue;
            has_dots = 1;
            const float agreement = sign * bit * codec->signs[phase + j];
            axis->wrong += agreement < 0;
            log_odds -= logf(0.5f + 0.5f * expf(-agreement));
        }
        if (has_dots) {
            if (i < axis->first) axis->first = i;
            axis->last = i;
        }
    }
    axis->log_odds = log_odds - codec->log_hypotheses;
}

/* Add a bit, number `step` of its line, to the line's scores at all phases in both directions. */
static inline void correlate(float bit, const float *signs, int step, int length,
                             float *restrict forwards, float *restrict backwards)
{
    const float *restrict f = signs + step, *restrict g = signs + length - 1 - step;
    for (int k = 0; k < PERIOD; k++) forwards[k] += bit * f[k];
    for (int k = 0; k < PERIOD; k++) backwards[k] -= bit * g[k];
}

HOT static void read_window(const Codec *codec, const float *x_bits, const float *y_bits,
                            int length, float *scores, const float **lines, float *votes,
                            int *phase, float *margin, int64_t *rotation, Axis *x, Axis *y)
{
    const size_t size = (size_t)length * PERIOD;
    float *table[4] = {scores, scores + size, scores + 2 * size, scores + 3 * size};
    memset(scores, 0, 4 * size * sizeof(float));
    for (int row = 0; row < length; row++)
        for (int column = 0; column < length; column++) {
            const float a = x_bits[row * length + column], b = y_bits[row * length + column];
            const int down = row * PERIOD, right = column * PERIOD;
            if (a != 0)
                correlate(a, codec->signs, row, length, table[0] + right, table[1] + right);
            if (b != 0)
                correlate(b, codec->signs, column, length, table[2] + down, table[3] + down);
        }
    float sums[4] = {0};
    for (int t = 0; t < 4; t++)
        for (int i = 0; i < length; i++) {
            const float *s = table[t] + i * PERIOD;
            float top = s[0];
            for (int k = 1; k < PERIOD; k++) top = top > s[k] ? top : s[k];
            sums[t] += top;
        }
    /* Tables that hold the scores of columns and rows at each rotation, and their directions. */
    static const int column_table[4] = {0, 2, 1, 3}, row_table[4] = {2, 1, 3, 0};
    static const int column_reversed[4] = {0, 1, 1, 0}, row_reversed[4] = {0, 0, 1, 1};
    int best = 0;
    for (int r = 1; r < 4; r++)
        if (sums[column_table[r]] + sums[row_table[r]]
            > sums[column_table[best]] + sums[row_table[best]])
            best = r;
    *rotation = best;
    const int last = length - 1, width = length;
    for (int i = 0; i < length; i++)
        lines[i] = table[column_table[best]] + (column_reversed[best] ? last - i : i) * PERIOD;
    vote_position(codec, lines, length, votes, phase, margin, x);
    for (int i = 0; i < length; i++)
        lines[i] = table[row_table[best]] + (row_reversed[best] ? last - i : i) * PERIOD;
    vote_position(codec, lines, length, votes, phase, margin, y);
    /* Steps in the observed window for a step along x and y of the printed pattern. */
    static const int sign_x[4] = {1, 1, -1, -1}, sign_y[4] = {1, -1, -1, 1};
    const int start[4] = {0, last * width, last * width + last, last};
    const int step_x[4] = {1, -width, -1, width}, step_y[4] = {width, 1, -width, -1};
    const float *columns = best % 2 ? y_bits : x_bits, *rows = best % 2 ? x_bits : y_bits;
    score_position(codec, columns, (float)sign_x[best], start[best], step_x[best], step_y[best],
                   length, x);
    score_position(codec, rows, (float)sign_y[best], start[best], step_y[best], step_x[best],
                   length, y);
}

/* Limits of a codec. They bound indices into its tables and keep sums of phases within 64 bits. */
enum { MAX_SEQUENCE = 512, MAX_WEIGHT = 1000 };
#define MAX_POSITIONS (1LL << 40)
#define MAX_COORDINATE (1LL << 60)

/* Arrays of a codec as core/dots/identification/phase_voting.py passes them: lengths, weights,
 * prefixes, crt, signs, digits and masks. */
typedef struct {
    PyObject *lengths, *weights, *prefixes, *crt, *signs, *digits, *masks;
} CodecArrays;

/* Check the tables of a codec for windows of `length` cells a side. */
static void take_codec(Call *call, const CodecArrays *arrays, long long range,
                       long long smallest_shift, long long length, Codec *codec)
{
    check_range(call, "range", range, 1, MAX_POSITIONS);
    check_range(call, "smallest_shift", smallest_shift, 0, PERIOD);
    if (call->failed) return;
    const int64_t *lengths = input(call, arrays->lengths, "lengths", ITEM_INT64, SEQUENCES);
    check_items(call, "lengths", lengths, ITEM_INT64, SEQUENCES, 1, MAX_SEQUENCE);
    const int64_t *weights = input(call, arrays->weights, "weights", ITEM_INT64, SEQUENCES);
    check_items(call, "weights", weights, ITEM_INT64, SEQUENCES, 0, MAX_WEIGHT);
    Py_ssize_t longest = 0, prefix_items = 0, n_signs, widest;
    for (int k = 0; k < SEQUENCES && !call->failed; k++) {
        longest = lengths[k] > longest ? (Py_ssize_t)lengths[k] : longest;
        prefix_items += (Py_ssize_t)lengths[k] + 1;
    }
    const int64_t *prefixes = input(call, arrays->prefixes, "prefixes", ITEM_INT64, prefix_items);
    check_items(call, "prefixes", prefixes, ITEM_INT64, prefix_items, 0, BASE * MAX_SEQUENCE);
    const int64_t *crt = input(call, arrays->crt, "crt", ITEM_INT64, SEQUENCES);
    check_items(call, "crt", crt, ITEM_INT64, SEQUENCES, 0, range - 1);
    const float *signs = input_rows(call, arrays->signs, "signs", ITEM_FLOAT32, 1, &n_signs);
    check_range(call, "number of signs", n_signs, length + PERIOD - 1, PY_SSIZE_T_MAX);
    const int8_t *digits = input(call, arrays->digits, "digits", ITEM_INT8, SEQUENCES * PERIOD);
    check_items(call, "digits", digits, ITEM_INT8, SEQUENCES * PERIOD, -1, BASE - 1);
    const float *masks =
        input_rows(call, arrays->masks, "masks", ITEM_FLOAT32, SEQUENCES * BASE, &widest);
    check_range(call, "width of masks", widest, 2 * longest - 1, INT_MAX);
    if (call->failed) return;
    *codec = (Codec){.lengths = lengths,
                     .weights = weights,
                     .prefixes = prefixes,
                     .crt = crt,
                     .signs = signs,
                     .digits = digits,
                     .masks = masks,
                     .range = range,
                     .smallest_shift = smallest_shift,
                     .widest = widest};
    for (int k = 1; k <= PERIOD; k++) codec->phase_log_odds[k] = log((double)PERIOD / k);
}

static PyObject *read_windows(PyObject *self, PyObject *args)
{
    (void)self;
    enum { POSITION_COLUMNS = 11, EVIDENCE_COLUMNS = 6 };
    Call call = {0};
    PyObject *x_array, *y_array, *positions_array, *evidence_array;
    CodecArrays arrays;
    long long n, length, range, smallest_shift;
    double log_hypotheses;
    if (!parse_arguments(args, "OOLLOOOOOOOLLdOO:read_windows", &x_array, &y_array, &n, &length,
                         &arrays.lengths, &arrays.weights, &arrays.prefixes, &arrays.crt,
                         &arrays.signs, &arrays.digits, &arrays.masks, &range, &smallest_shift,
                         &log_hypotheses, &positions_array, &evidence_array))
        return NULL;
    Codec codec = {0};
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "length", length, 1, MAX_WINDOW_CELLS);
    if (call.failed) return NULL;
    const float *x_bits = input(&call, x_array, "x_bits", ITEM_FLOAT32, ITEMS(n, length, length));
    const float *y_bits = input(&call, y_array, "y_bits", ITEM_FLOAT32, ITEMS(n, length, length));
    take_codec(&call, &arrays, range, smallest_shift, length, &codec);
    int64_t *positions =
        output(&call, positions_array, "positions", ITEM_INT64, ITEMS(n, POSITION_COLUMNS));
    double *evidence =
        output(&call, evidence_array, "evidence", ITEM_FLOAT64, ITEMS(n, EVIDENCE_COLUMNS));
    if (call.failed) return finish_call(&call, 1);
    codec.log_hypotheses = log_hypotheses;
    const size_t lines_count = (size_t)length, size = lines_count * lines_count;
    float *scores =
        malloc((4 * lines_count * PERIOD + lines_count + MAX_SEQUENCE) * sizeof(float));
    const float **lines = malloc(lines_count * sizeof(float *));
    int *phase = malloc(lines_count * sizeof(int));
    const int has_memory = scores && lines && phase;
    if (has_memory) {
        float *margin = scores + 4 * lines_count * PERIOD, *votes = margin + lines_count;
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++) {
            int64_t *position = positions + k * POSITION_COLUMNS;
            double *odds = evidence + k * EVIDENCE_COLUMNS;
            Axis axes[2];
            read_window(&codec, x_bits + k * size, y_bits + k * size, (int)length, scores, lines,
                        votes, phase, margin, position, axes, axes + 1);
            for (int axis = 0; axis < 2; axis++) {
                const Axis *a = axes + axis;
                const int64_t row[5] = {a->position, a->shift, a->wrong, a->first, a->last};
                memcpy(position + 1 + 5 * axis, row, sizeof(row));
                odds[axis] = a->log_odds;
                odds[2 + axis] = a->order_log_odds;
                odds[4 + axis] = a->margin;
            }
        }
        Py_END_ALLOW_THREADS
    }
    free(scores);
    free((void *)lines);
    free(phase);
    return finish_call(&call, has_memory);
}

/* ---- Search of positions ---------------------------------------------------------------- */

/* Largest number of lines of a window; votes of its lines are counted in a byte. */
enum { MAX_SEARCH_LINES = 255, MAX_BEAM = 1 << 16, MAX_MISREAD = 6, MAX_RANKS = 4 };

/* Combinations of digits of the first sequence, of the first two and so on. */
enum { DIGITS_1 = BASE, DIGITS_2 = DIGITS_1 * BASE, DIGITS_3 = DIGITS_2 * BASE,
       DIGITS_4 = DIGITS_3 * BASE, ALL_DIGITS = DIGITS_1 + DIGITS_2 + DIGITS_3 + DIGITS_4 };

/* Row of doubled scores: those of all shifts from each phase on are contiguous. */
enum { DOUBLED = 2 * PERIOD + 2 };

/* Candidates this much less likely than the best one do not count as rivals. */
#define NEGLIGIBLE_LOG_LIKELIHOOD 40.0f

typedef struct {
    float votes;
    int entry, residue;
} Choice;

typedef struct {
    int width, misread, ranks;   /* of the beam; misread lines, and phases of each */
    float min_probability;       /* added to the probability of a digit */
    int steps;                   /* from one line with dots to the next */
    int *step;                   /* the first line of each step */
    float *doubled, *odds;       /* (length, DOUBLED) scores; (steps, ALL_DIGITS) log odds */
    float *votes, *sorted;       /* (MAX_SEQUENCE), (2 width) */
    Choice *pool;                /* (2 width) */
    int *residues[2];            /* (width, SEQUENCES) of the entries of the beam */
    uint8_t *digits[2];          /* (width, steps) combination of the digits of the entries */
    uint8_t *masks, *counts;     /* masks of the codec as bytes; votes (SEQUENCES + 1, MAX_SEQUENCE) */
    uint8_t *chosen;             /* (2, length) steps whose votes are counted */
    int64_t *candidates;
    int *phase;                  /* (length) */
} Search;

/* Logarithms of the probabilities of digits for the step between two lines: of those of the first
 * sequence, of the first two and so on. The probability of a shift is the circular correlation of
 * those of both phases. */
HOT static void step_odds(const Codec *codec, const float *line, const float *following,
                          float min_probability, float *odds)
{
    float first[PERIOD], second[DOUBLED], shifts[PERIOD] = {0}, tops[2] = {line[0], following[0]};
    float sums[2] = {0};
    for (int k = 1; k < PERIOD; k++) {
        tops[0] = tops[0] > line[k] ? tops[0] : line[k];
        tops[1] = tops[1] > following[k] ? tops[1] : following[k];
    }
    for (int k = 0; k < PERIOD; k++) {
        sums[0] += first[k] = expf(0.5f * (line[k] - tops[0]));
        sums[1] += second[k] = second[k + PERIOD] = expf(0.5f * (following[k] - tops[1]));
    }
    for (int phase = 0; phase < PERIOD; phase++) {
        if (!(first[phase] > 1e-9f)) continue;
        const float *restrict shifted = second + phase;
        for (int k = 0; k < PERIOD; k++) shifts[k] += first[phase] * shifted[k];
    }
    const float scale = 1 / (sums[0] * sums[1]);
    for (int k = 0; k < ALL_DIGITS; k++) odds[k] = 0;
    for (int shift = 0; shift < PERIOD; shift++) {
        float *level = odds;
        for (int k = 0, index = 0, size = BASE; k < SEQUENCES; k++, level += size, size *= BASE) {
            const int digit = codec->digits[k * PERIOD + shift];
            if (digit < 0) break;
            index = BASE * index + digit;
            level[index] += scale * shifts[shift];
        }
    }
    for (int k = 0; k < ALL_DIGITS; k++) odds[k] = logf(odds[k] + min_probability);
}

/* Add the votes of the three digits of a step for all residues of a sequence. */
HOT static void add_votes(const float *restrict odds, const float *restrict masks, int64_t widest,
                          int length, float *restrict votes)
{
    const float zero = odds[0], one = odds[1] - odds[0], two = odds[2] - odds[0];
    const float *restrict ones = masks + widest, *restrict twos = masks + 2 * widest;
    for (int q = 0; q < length; q++) votes[q] += zero + one * ones[q] + two * twos[q];
}

HOT static int any_above(const float *values, int count, float limit)
{
    int any = 0;
    for (int i = 0; i < count; i++) any |= values[i] > limit;
    return any;
}

/* Order of choices by falling votes; none is NaN. */
static int by_votes(const void *a, const void *b)
{
    const Choice *x = a, *y = b;
    return (x->votes < y->votes) - (x->votes > y->votes);
}

/* Keep the choices of most votes; return the least of these. */
static float shrink_pool(const Search *s, int *count)
{
    if (*count < s->width) return -INFINITY;
    for (int i = 0; i < *count; i++) s->sorted[i] = s->pool[i].votes;
    const float least = nth_smallest(s->sorted, *count, *count - s->width);
    int kept = 0, equal = s->width;
    for (int i = 0; i < *count; i++) equal -= s->pool[i].votes > least;
    for (int i = 0; i < *count; i++) {
        const float votes = s->pool[i].votes;
        if (votes > least || (votes == least && equal-- > 0)) s->pool[kept++] = s->pool[i];
    }
    *count = kept;
    return least;
}

/* Write the positions that the shifts between adjacent lines make likely; return their number. A
 * beam search selects the residue of one sequence after the other. */
static int likely_candidates(const Codec *codec, const Search *s)
{
    int entries = 1;
    memset(s->residues[0], 0, SEQUENCES * sizeof(int));
    memset(s->digits[0], 0, (size_t)s->steps);
    const float *odds = s->odds;
    const int64_t *prefix = codec->prefixes;
    for (int k = 0, size = BASE; k < SEQUENCES; k++, odds += size, size *= BASE) {
        const int length = (int)codec->lengths[k];
        const uint8_t *digits = s->digits[k % 2];
        const float *masks = codec->masks + (size_t)(k * BASE) * (size_t)codec->widest;
        float least = -INFINITY;
        int count = 0;
        for (int entry = 0; entry < entries; entry++) {
            memset(s->votes, 0, (size_t)length * sizeof(float));
            for (int i = 0; i < s->steps; i++)
                add_votes(odds + i * ALL_DIGITS + BASE * digits[entry * s->steps + i],
                          masks + s->step[i] % length, codec->widest, length, s->votes);
            if (!any_above(s->votes, length, least)) continue;
            for (int q = 0; q < length; q++) {
                if (!(s->votes[q] > least)) continue;
                s->pool[count++] = (Choice){s->votes[q], entry, q};
                if (count == 2 * s->width) least = shrink_pool(s, &count);
            }
        }
        shrink_pool(s, &count);
        /* The best first, so that soon few of the next choices are better than the least one. */
        qsort(s->pool, (size_t)count, sizeof(Choice), by_votes);
        for (int i = 0; i < count; i++) {
            const Choice *choice = s->pool + i;
            int *residues = s->residues[(k + 1) % 2] + i * SEQUENCES;
            uint8_t *chosen = s->digits[(k + 1) % 2] + i * s->steps;
            memcpy(residues, s->residues[k % 2] + choice->entry * SEQUENCES,
                   SEQUENCES * sizeof(int));
            residues[k] = choice->residue;
            for (int j = 0; j < s->steps; j++) {
                const int64_t *sum = prefix + (choice->residue + s->step[j]) % length;
                chosen[j] = (uint8_t)(BASE * digits[choice->entry * s->steps + j]
                                      + remainder_of(sum[1] - sum[0], BASE));
            }
        }
        entries = count;
        prefix += length + 1;
    }
    for (int i = 0; i < entries; i++) {
        int64_t position = 0;
        for (int k = 0; k < SEQUENCES; k++)
            position = (position
                        + codec->crt[k] * s->residues[SEQUENCES % 2][i * SEQUENCES + k])
                       % codec->range;
        s->candidates[i] = position;
    }
    return entries;
}

HOT static uint8_t largest_byte(const uint8_t *bytes, int count)
{
    uint8_t largest = 0;
    for (int i = 0; i < count; i++) largest = bytes[i] > largest ? bytes[i] : largest;
    return largest;
}

/* Add one vote of each chosen step for the residues that have its digit. */
HOT static void count_votes(const Codec *codec, const Search *s, int k, const uint8_t *chosen,
                            const int *phase, uint8_t *restrict counts)
{
    const int length = (int)codec->lengths[k];
    for (int i = 0; i < s->steps; i++) {
        if (!chosen[i]) continue;
        const int line = s->step[i];
        const int difference = (phase[line + 1] - phase[line] + PERIOD) % PERIOD;
        const int digit = codec->digits[k * PERIOD + difference];
        if (digit < 0) continue;
        const uint8_t *restrict mask =
            s->masks + (k * BASE + digit) * codec->widest + line % length;
        for (int q = 0; q < length; q++) counts[q] = (uint8_t)(counts[q] + mask[q]);
    }
}

/* Write the positions of all combinations of the likeliest phases of the least certain lines;
 * return their number. The other lines have their likeliest phase. `used` are the lines with dots.
 */
static int misread_candidates(const Codec *codec, const Search *s, const uint8_t *used, int length,
                              int64_t *candidates)
{
    int misread[MAX_MISREAD], ranked[MAX_MISREAD][MAX_RANKS], count = 0, combinations = 1;
    float gaps[MAX_MISREAD];
    for (int i = 0; i < length; i++) {
        if (!used[i]) continue;
        const float *score = s->doubled + (size_t)i * DOUBLED;
        int top[MAX_RANKS] = {0}, ranks = 0;
        for (int k = 0; k < PERIOD; k++) {
            if (ranks == s->ranks && !(score[k] > score[top[ranks - 1]])) continue;
            int rank = ranks < s->ranks ? ranks++ : ranks - 1;
            for (; rank > 0 && score[k] > score[top[rank - 1]]; rank--) top[rank] = top[rank - 1];
            top[rank] = k;
        }
        s->phase[i] = top[0];
        const float gap = score[top[0]] - score[top[1]];
        if (count == s->misread && !(gap < gaps[count - 1])) continue;
        int rank = count < s->misread ? count++ : count - 1;
        for (; rank > 0 && gap < gaps[rank - 1]; rank--) {
            gaps[rank] = gaps[rank - 1];
            misread[rank] = misread[rank - 1];
            memcpy(ranked[rank], ranked[rank - 1], sizeof(*ranked));
        }
        gaps[rank] = gap;
        misread[rank] = i;
        memcpy(ranked[rank], top, sizeof(top));
    }
    /* Steps that no combination changes are counted once. */
    uint8_t *is_fixed = s->chosen, *is_changing = is_fixed + s->steps;
    for (int i = 0; i < s->steps; i++) {
        is_changing[i] = 0;
        for (int j = 0; j < count; j++)
            is_changing[i] |= misread[j] == s->step[i] || misread[j] == s->step[i] + 1;
        is_fixed[i] = !is_changing[i];
    }
    uint8_t *fixed = s->counts, *votes = fixed + SEQUENCES * MAX_SEQUENCE;
    memset(fixed, 0, SEQUENCES * MAX_SEQUENCE);
    for (int k = 0; k < SEQUENCES; k++)
        count_votes(codec, s, k, is_fixed, s->phase, fixed + k * MAX_SEQUENCE);
    for (int j = 0; j < count; j++) combinations *= s->ranks;
    for (int c = 0; c < combinations; c++) {
        for (int j = 0, rest = c; j < count; j++, rest /= s->ranks)
            s->phase[misread[j]] = ranked[j][rest % s->ranks];
        int64_t position = 0;
        for (int k = 0; k < SEQUENCES; k++) {
            const size_t size = (size_t)codec->lengths[k];
            memcpy(votes, fixed + k * MAX_SEQUENCE, size);
            count_votes(codec, s, k, is_changing, s->phase, votes);
            const uint8_t *first = memchr(votes, largest_byte(votes, (int)size), size);
            position = (position + codec->crt[k] * (first - votes)) % codec->range;
        }
        candidates[c] = position;
    }
    return combinations;
}

static int by_position(const void *a, const void *b)
{
    const int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

/* Add the scores of all lines at the phases of a candidate, for each shift. */
HOT static void add_scores(const float *doubled, const int *phase, const uint8_t *used, int length,
                           float *restrict joint)
{
    float sums[PERIOD + 1] = {0};
    for (int i = 0; i < length; i++) {
        if (!used[i]) continue;
        const float *restrict score = doubled + (size_t)i * DOUBLED + phase[i];
        for (int k = 0; k < PERIOD + 1; k++) sums[k] += score[k];
    }
    memcpy(joint, sums, sizeof(sums));
}

/* Search the likeliest position and shift of a window on one axis, and the likelihood of the other
 * candidates relative to it. */
static void search_position(const Codec *codec, const Search *s, const float *scores, int length,
                            uint8_t *used, int64_t *position, int64_t *shift, double *rivals)
{
    for (int i = 0; i < length; i++) {
        const float *score = scores + (size_t)i * PERIOD;
        float *row = s->doubled + (size_t)i * DOUBLED;
        memcpy(row, score, PERIOD * sizeof(float));
        memcpy(row + PERIOD, score, PERIOD * sizeof(float));
        row[2 * PERIOD] = row[2 * PERIOD + 1] = 0;
        used[i] = 0;
        for (int k = 0; k < PERIOD; k++) used[i] |= score[k] != 0;
    }
    Search part = *s;
    part.steps = 0;
    for (int i = 0; i + 1 < length; i++)
        if (used[i] && used[i + 1]) {
            step_odds(codec, s->doubled + (size_t)i * DOUBLED,
                      s->doubled + (size_t)(i + 1) * DOUBLED, s->min_probability,
                      s->odds + (size_t)part.steps * ALL_DIGITS);
            part.step[part.steps++] = i;
        }
    int count = likely_candidates(codec, &part);
    if (s->misread) count += misread_candidates(codec, &part, used, length, s->candidates + count);
    qsort(s->candidates, (size_t)count, sizeof(int64_t), by_position);
    *position = *shift = 0;
    float best = -INFINITY;
    double sum = INFINITY;
    for (int c = 0; c < count; c++) {
        if (c && s->candidates[c] == s->candidates[c - 1]) continue;
        float joint[PERIOD + 1];
        following_phases(codec, s->candidates[c], length, s->phase);
        add_scores(s->doubled, s->phase, used, length, joint);
        for (int k = 0; k < PERIOD; k++) {
            const float log_likelihood = 0.5f * joint[k];
            if (log_likelihood > best) {
                sum = best > -INFINITY ? sum * exp(best - log_likelihood) + 1 : 1;
                best = log_likelihood;
                *position = s->candidates[c];
                *shift = k;
            } else if (log_likelihood > best - NEGLIGIBLE_LOG_LIKELIHOOD)
                sum += exp((double)log_likelihood - best);
        }
    }
    *rivals = sum - 1;
}

static PyObject *search_positions(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *scores_array, *positions_array, *rivals_array;
    CodecArrays arrays;
    long long n, length, range, smallest_shift, beam_width, misread, ranks;
    Search s = {0};
    if (!parse_arguments(args, "OLLOOOOOOOLLLLLfOO:search_positions", &scores_array, &n, &length,
                         &arrays.lengths, &arrays.weights, &arrays.prefixes, &arrays.crt,
                         &arrays.signs, &arrays.digits, &arrays.masks, &range, &smallest_shift,
                         &beam_width, &misread, &ranks, &s.min_probability, &positions_array,
                         &rivals_array))
        return NULL;
    Codec codec = {0};
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "length", length, 1, MAX_SEARCH_LINES);
    check_range(&call, "beam_width", beam_width, 1, MAX_BEAM);
    check_range(&call, "misread", misread, 0, MAX_MISREAD);
    check_range(&call, "ranks", ranks, 2, MAX_RANKS);
    if (call.failed) return NULL;
    const float *scores = input(&call, scores_array, "scores", ITEM_FLOAT32, ITEMS(n, length, PERIOD));
    take_codec(&call, &arrays, range, smallest_shift, length, &codec);
    int64_t *positions = output(&call, positions_array, "positions", ITEM_INT64, ITEMS(n, 2));
    double *rivals = output(&call, rivals_array, "rivals", ITEM_FLOAT64, n);
    if (call.failed) return finish_call(&call, 1);
    s.width = (int)beam_width;
    s.misread = (int)misread;
    s.ranks = (int)ranks;
    const size_t lines = (size_t)length, width = (size_t)beam_width;
    const size_t mask_items = (size_t)(SEQUENCES * BASE) * (size_t)codec.widest;
    size_t combinations = 1;
    for (int k = 0; k < s.misread; k++) combinations *= (size_t)s.ranks;
    float *floats =
        malloc((lines * (DOUBLED + ALL_DIGITS) + MAX_SEQUENCE + 2 * width) * sizeof(float));
    int *integers = malloc((2 * lines + 2 * width * SEQUENCES) * sizeof(int));
    uint8_t *bytes = malloc(2 * width * lines + 3 * lines + mask_items
                            + (SEQUENCES + 1) * MAX_SEQUENCE);
    s.pool = malloc(2 * width * sizeof(Choice));
    s.candidates = malloc((width + combinations) * sizeof(int64_t));
    const int has_memory = floats && integers && bytes && s.pool && s.candidates;
    if (has_memory) {
        s.doubled = floats;
        s.odds = s.doubled + lines * DOUBLED;
        s.votes = s.odds + lines * ALL_DIGITS;
        s.sorted = s.votes + MAX_SEQUENCE;
        s.step = integers;
        s.phase = s.step + lines;
        s.residues[0] = s.phase + lines;
        s.residues[1] = s.residues[0] + width * SEQUENCES;
        s.digits[0] = bytes;
        s.digits[1] = s.digits[0] + width * lines;
        s.chosen = s.digits[1] + width * lines;
        s.counts = s.chosen + 2 * lines;
        s.masks = s.counts + (SEQUENCES + 1) * MAX_SEQUENCE;
        uint8_t *used = s.masks + mask_items;
        for (size_t k = 0; k < mask_items; k++) s.masks[k] = codec.masks[k] > 0;
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++)
            search_position(&codec, &s, scores + k * lines * PERIOD, (int)length, used,
                            positions + 2 * k, positions + 2 * k + 1, rivals + k);
        Py_END_ALLOW_THREADS
    }
    free(floats);
    free(integers);
    free(bytes);
    free(s.pool);
    free(s.candidates);
    return finish_call(&call, has_memory);
}

/* ---- Poses ------------------------------------------------------------------------------ */

/* Constants of the robust fit; those of locatk.core.dots.localization.pose. */
typedef struct {
    int half_width, lens, max_steps, fitted_parameters;
    const double *prior;
    double offset, symbol_gate, min_sigma, higher_lens_sigma, higher_lens_odds, gate_sigmas,
        gated_variance, square_radius, square_radius_sigma;
} PoseOptions;

static const int ROTATIONS[4][2][2] = {
    {{1, 0}, {0, 1}}, {{0, -1}, {1, 0}}, {{-1, 0}, {0, -1}}, {{0, 1}, {-1, 0}}};
static const int CORNERS[4][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};

/* Residuals of the projected dots from the symbols at their cells in the decoded window. Squared
 * residuals of the dots that agree with their symbol are written to `squares`, -1 for others. */
static void match_pattern(const Codec *codec, const PoseOptions *options, const int64_t *columns,
                          const int64_t *rows, int quarter, const Dots *d, int m, float *squares)
{
    const int(*rotation)[2] = ROTATIONS[quarter], *corner = CORNERS[quarter];
    const int half_width = options->half_width, length = 2 * half_width;
    const float offset = (float)options->offset, gate = (float)options->symbol_gate;
    for (int i = 0; i < m; i++) {
        squares[i] = -1;
        if (d->valid[i] == 0) continue;
        const float u = rintf(d->u[i]), v = rintf(d->v[i]);
        /* Outside of the window, and for NaN, a conversion to int may be undefined. */
        if (!(fabsf(u) <= (float)half_width && fabsf(v) <= (float)half_width)) continue;
        const int a = (int)u + half_width, b = (int)v + half_width;
        const int column = rotation[0][0] * a + rotation[0][1] * b + corner[0] * (length - 1);
        const int row = rotation[1][0] * a + rotation[1][1] * b + corner[1] * (length - 1);
        if (column < 0 || column >= length || row < 0 || row >= length) continue;
        const int column_bit = codec->signs[columns[column] + row] > 0;
        const int row_bit = codec->signs[rows[row] + column] > 0;
        /* Up 00, left 10, right 01, down 11 (column bit, row bit). */
        const int dx = row_bit - column_bit, dy = row_bit + column_bit - 1;
        const float du =
            d->u[i] - u - offset * (float)(rotation[0][0] * dx + rotation[1][0] * dy);
        const float dv =
            d->v[i] - v - offset * (float)(rotation[0][1] * dx + rotation[1][1] * dy);
        if (!(fabsf(du) < gate && fabsf(dv) < gate)) continue;
        d->residual[0][i] = du;
        d->residual[1][i] = dv;
        squares[i] = du * du + dv * dv;
    }
}

/* Variance of the dots per axis from the median of their squared residuals (-1: no residual). */
static double median_variance(const float *squares, int m, int parameters, float *ordered)
{
    int count = 0;
    for (int i = 0; i < m; i++)
        if (squares[i] >= 0) ordered[count++] = squares[i];
    if (!count) return 0;
    const double median = nth_smallest(ordered, count, (count - 1) / 2);
    const int degrees = 2 * count - parameters > 1 ? 2 * count - parameters : 1;
    return median / (2 * log(2.0)) * (2.0 * count / degrees);
}

/* Second and third radial coefficients c, e of an unknown lens, which move the points p to
 * p (1 + c |p|^4 + e |p|^6), and their part of the solved normal equations. */
enum { HIGHER_TERMS = 2 };
/* Least part of the third coefficient's effect that is not one of the second; below it, single
 * precision does not distinguish them. */
static const double MIN_DISTINCTION = 1e-6;
typedef struct {
    int is_fitted;
    double value[HIGHER_TERMS], coupling[HIGHER_TERMS][PARAMETERS];
    double inverse[HIGHER_TERMS][HIGHER_TERMS];
} HigherLens;

/* Derivatives by the second radial coefficient along an axis, negative. */
HOT static void second_lens_column(const double *parameters, const Dots *d, int axis,
                                   float *restrict column)
{
    const float a0 = (float)parameters[3 * axis], a1 = (float)parameters[3 * axis + 1];
    const float g0 = (float)parameters[PERSPECTIVE], g1 = (float)parameters[PERSPECTIVE + 1];
    const float *restrict value = axis ? d->v : d->u;
    const float *restrict x = d->x, *restrict y = d->y, *restrict q0 = d->q[0];
    const float *restrict q1 = d->q[1], *restrict lens_slope = d->lens_slope;
    const float *restrict depth = d->depth, *restrict use = d->use;
    for (int k = 0; k < d->count; k++) {
        const float slope = a0 * q0[k] + a1 * q1[k] - value[k] * (g0 * q0[k] + g1 * q1[k]);
        column[k] = -slope * lens_slope[k] * depth[k] * (x[k] * x[k] + y[k] * y[k]) * use[k];
    }
}

/* Sum of the products of two arrays. */
HOT static double sum_products(const float *restrict a, const float *restrict b, int count)
{
    float sums[LANES] = {0};
    for (int i = 0; i < count; i += LANES)
        for (int l = 0; l < LANES; l++) sums[l] += a[i + l] * b[i + l];
    return sum_lanes(sums);
}

/* Add the higher radial coefficients to solved normal equations of the dots in use: correct the
 * step `solved`, and change the coefficients. They are fitted if a first change of the second alone
 * is beyond `threshold`, in squares of residuals. `columns` are scratch (4 d->count). */
static int fit_higher_lens(const double *parameters, const Dots *d, double normal[][PARAMETERS],
                           double prior, double threshold, float *columns, double *step,
                           HigherLens *lens)
{
    static const double no_prior[PARAMETERS] = {0};
    double weight[HIGHER_TERMS][HIGHER_TERMS], gain[HIGHER_TERMS];
    for (int term = 0; term < HIGHER_TERMS; term++) {
        float *own = columns + 2 * term * d->count;
        Dots other = *d;
        gain[term] = -prior * lens->value[term];
        for (int other_term = 0; other_term <= term; other_term++)
            weight[term][other_term] = other_term == term ? prior : 0;
        for (int axis = 0; axis < 2; axis++) {
            float *column = own + axis * d->count;
            if (term == 0)
                second_lens_column(parameters, d, axis, column);
            else
                for (int k = 0; k < d->count; k++)
                    column[k] = columns[axis * d->count + k]
                                * (d->x[k] * d->x[k] + d->y[k] * d->y[k]);
            other.residual[axis] = column;
            gain[term] += sum_products(column, d->residual[axis], d->count);
            for (int other_term = 0; other_term <= term; other_term++)
                weight[term][other_term] += sum_products(
                    column, columns + (2 * other_term + axis) * d->count, d->count);
        }
        double unused[PARAMETERS][PARAMETERS], copy[PARAMETERS][PARAMETERS], cross[PARAMETERS];
        normal_equations(parameters, &other, 0, 1, no_prior, unused, cross);
        memcpy(copy, normal, sizeof(copy));
        memcpy(lens->coupling[term], cross, sizeof(cross));
        if (!solve_linear(copy, lens->coupling[term], 1)) return 0;
        for (int k = 0; k < PARAMETERS; k++) {
            gain[term] -= cross[k] * step[k];
            for (int other_term = 0; other_term <= term; other_term++)
                weight[term][other_term] -= cross[k] * lens->coupling[other_term][k];
        }
        lens->is_fitted = lens->is_fitted || gain[0] * gain[0] > threshold * weight[0][0];
        if (!lens->is_fitted) return 1;
    }
    const double product = weight[0][0] * weight[1][1];
    const double area = product - weight[1][0] * weight[1][0];
    const int is_distinct = area > MIN_DISTINCTION * product;
    lens->inverse[0][0] = is_distinct ? weight[1][1] / area : 1 / weight[0][0];
    lens->inverse[1][1] = is_distinct ? weight[0][0] / area : 0;
    lens->inverse[0][1] = lens->inverse[1][0] = is_distinct ? -weight[1][0] / area : 0;
    for (int term = 0; term < HIGHER_TERMS; term++) {
        const double *row = lens->inverse[term];
        const double change = row[0] * gain[0] + row[1] * gain[1];
        lens->value[term] += change;
        for (int k = 0; k < PARAMETERS; k++) step[k] -= lens->coupling[term][k] * change;
    }
    return 1;
}

/* Index of the cell of a dot among the grid positions of the window with a margin. Coordinates from
 * the margin's corner are positive, so that a conversion to int rounds down. */
static int cell_of(const Dots *d, int i, int half_width)
{
    const float corner = (float)half_width + 1.5f;
    return (int)(d->v[i] + corner) * (2 * half_width + 3) + (int)(d->u[i] + corner);
}

/* Sum of the correlations of the error of a dot in use with those of its eight neighbours on the
 * grid; see locatk.core.dots.localization.pose. `cells` are scratch, three for each cell. */
static double neighbour_correlation(const Dots *d, int m, int half_width, int parameters,
                                    double variance, float *cells)
{
    const int width = 2 * half_width + 3;
    const int steps[4] = {1, width - 1, width, width + 1};
    memset(cells, 0, 3 * (size_t)width * (size_t)width * sizeof(float));
    for (int i = 0; i < m; i++) {
        if (d->use[i] == 0) continue;
        float *cell = cells + 3 * cell_of(d, i, half_width);
        cell[0] += d->residual[0][i];
        cell[1] += d->residual[1][i];
        cell[2] += 1;
    }
    double products = 0, pairs = 0, count = 0;
    for (int i = 0; i < m; i++) {
        if (d->use[i] == 0) continue;
        const float *cell = cells + 3 * cell_of(d, i, half_width);
        for (int k = 0; k < 4; k++) {
            const float *other = cell + 3 * steps[k];
            products += d->residual[0][i] * other[0] + d->residual[1][i] * other[1];
            pairs += other[2];
        }
        count++;
    }
    return count > 0 ? products / (count * variance) + parameters * pairs / (count * count) : 0;
}

/* Remove the component of residuals along the displacement by the lens, and correct their
 * `squares`. `columns` are scratch (2 d->count). */
static void keep_across(const double *parameters, const Dots *d, int m, float *columns,
                        float *squares)
{
    float *along[2] = {columns, columns + d->count};
    Dots all = *d;
    all.use = d->valid;
    for (int axis = 0; axis < 2; axis++) second_lens_column(parameters, &all, axis, along[axis]);
    for (int i = 0; i < m; i++) {
        if (squares[i] < 0) continue;
        const float c = along[0][i], s = along[1][i], square = c * c + s * s;
        const float ratio = (d->residual[0][i] * c + d->residual[1][i] * s)
                            / (square > 1e-30f ? square : 1e-30f);
        const float du = d->residual[0][i] - ratio * c, dv = d->residual[1][i] - ratio * s;
        d->residual[0][i] = du;
        d->residual[1][i] = dv;
        squares[i] = du * du + dv * dv;
    }
}

/* Refit the lattice robustly to the dots that agree with the decoded pattern, and derive the pose
 * and its covariance from it. Return 0 if the equations are singular. */
static int estimate_pose(const Codec *codec, const PoseOptions *options, const int64_t *window,
                         const float *points, const Dots *d, int m, int64_t *phases, float *scratch,
                         float *cells, double *parameters, double *pose, double *covariance)
{
    static const double no_prior[PARAMETERS] = {0};
    const int64_t x = window[0], y = window[1], section[2] = {window[2], window[3]};
    const int half_width = options->half_width, length = 2 * half_width;
    int64_t *rows = phases + length;
    for (int k = 0; k < length; k++) {
        const int64_t column_position = remainder_of(x + k, codec->range);
        const int64_t row_position = remainder_of(y + k, codec->range);
        phases[k] = remainder_of(phase_at(codec, column_position) + section[0] + y, PERIOD);
        rows[k] = remainder_of(phase_at(codec, row_position) + section[1] + x, PERIOD);
    }
    const double min_variance = options->min_sigma * options->min_sigma;
    double normal[PARAMETERS][PARAMETERS], copy[PARAMETERS][PARAMETERS], step[PARAMETERS];
    double variance = min_variance, gate_square = 0;
    float *squares = scratch, *ordered = squares + m, *columns = ordered + m;
    HigherLens lens = {0};
    memset(d->use, 0, (size_t)d->count * sizeof(float));
    for (int k = 0; k < options->max_steps; k++) {
        project(parameters, d);
        match_pattern(codec, options, phases, rows, (int)window[4], d, m, squares);
        variance = median_variance(squares, m, options->fitted_parameters, ordered);
        if (!(variance > min_variance)) variance = min_variance;
        gate_square = options->gate_sigmas * options->gate_sigmas * variance;
        int is_changed = 0;
        for (int i = 0; i < m; i++) {
            const float use = squares[i] >= 0 && squares[i] < gate_square;
            is_changed |= use != d->use[i];
            d->use[i] = use;
        }
        normal_equations(parameters, d, sqrt(variance), options->lens, options->prior, normal,
                         step);
        memcpy(copy, normal, sizeof(normal));
        if (!solve_linear(copy, step, 1)) return 0;
        if (options->lens && (k == 0 || lens.is_fitted)) {
            const double prior =
                variance / (options->higher_lens_sigma * options->higher_lens_sigma);
            const double threshold = options->higher_lens_odds * variance;
            if (!fit_higher_lens(parameters, d, normal, prior, threshold, columns, step, &lens))
                return 0;
        }
        if (!is_changed || k + 1 == options->max_steps) break;
        for (int j = 0; j < PARAMETERS; j++) parameters[j] += step[j];
        for (int i = 0; lens.is_fitted && i < m; i++) {
            const double px = points[2 * i], py = points[2 * i + 1], square = px * px + py * py;
            const double factor =
                1 + square * square * (lens.value[0] + lens.value[1] * square);
            d->x[i] = (float)(px * factor);
            d->y[i] = (float)(py * factor);
        }
    }
    /* Across the displacement by the lens, residuals have half of their degrees of freedom. */
    if (lens.is_fitted) keep_across(parameters, d, m, columns, squares);
    const double dimensions_ratio = lens.is_fitted ? 2 : 1;
    const int fitted = options->fitted_parameters;
    int inliers = 0;
    double sum = 0;
    for (int i = 0; i < m; i++)
        if (d->use[i] != 0) {
            inliers++;
            sum += dimensions_ratio * squares[i];
        }
    const int degrees = 2 * inliers - fitted > 1 ? 2 * inliers - fitted : 1;
    double inlier_variance = sum / (options->gated_variance * degrees);
    if (!(inlier_variance > min_variance)) inlier_variance = min_variance;
    const double correlation =
        neighbour_correlation(d, m, half_width, fitted, inlier_variance / dimensions_ratio,
                             cells);
    if (correlation > 0) inlier_variance *= 1 + correlation;
    /* Outliers count as if at the gate: in directions of their own, and all together. */
    for (int i = 0; i < m; i++) {
        const int is_outlier = d->use[i] == 0 && squares[i] >= gate_square;
        d->use[i] = is_outlier;
        if (!is_outlier) continue;
        const float scale = (float)sqrt(gate_square / squares[i]);
        d->residual[0][i] *= scale;
        d->residual[1][i] *= scale;
    }
    double outliers[PARAMETERS][PARAMETERS], together[PARAMETERS];
    normal_equations(parameters, d, 0, options->lens, no_prior, outliers, together);
    for (int k = 0; k < PARAMETERS; k++) parameters[k] += step[k];

    const double *t = parameters, *g = t + PERSPECTIVE;
    const double slope[2][2] = {{t[A_U] - t[C_U] * g[0], t[A_U + 1] - t[C_U] * g[1]},
                                {t[A_V] - t[C_V] * g[0], t[A_V + 1] - t[C_V] * g[1]}};
    const double area = slope[0][0] * slope[1][1] - slope[0][1] * slope[1][0];
    if (!(fabs(area) > 0)) return 0;
    /* Slope of the logarithm of the inverse depth on the paper. */
    const double depth_slope[2] = {(g[0] * slope[1][1] - g[1] * slope[1][0]) / area,
                                   (g[1] * slope[0][0] - g[0] * slope[0][1]) / area};
    const double centre[2] = {t[C_U] + half_width + options->square_radius * depth_slope[0],
                              t[C_V] + half_width + options->square_radius * depth_slope[1]};
    const int(*rotation)[2] = ROTATIONS[window[4]], *corner = CORNERS[window[4]];
    const double u = slope[0][0], v = slope[1][0];
    double right_of[2], spread[3] = {0};
    for (int axis = 0; axis < 2; axis++) {
        const int *r = rotation[axis];
        pose[axis] = r[0] * centre[0] + r[1] * centre[1] + corner[axis] * (length - 1)
                     + (double)(axis ? y : x);
        right_of[axis] = r[0] * u + r[1] * v;
        spread[axis] =
            options->square_radius_sigma * (r[0] * depth_slope[0] + r[1] * depth_slope[1]);
    }
    pose[2] = atan2(-right_of[1], right_of[0]);
    double jacobian[3][PARAMETERS] = {{0}}, solved[PARAMETERS * 3];
    for (int axis = 0; axis < 2; axis++) {
        jacobian[axis][C_U] = rotation[axis][0];
        jacobian[axis][C_V] = rotation[axis][1];
    }
    jacobian[2][A_U] = v / (u * u + v * v);
    jacobian[2][A_V] = -u / (u * u + v * v);
    for (int k = 0; k < PARAMETERS; k++)
        for (int side = 0; side < 3; side++) solved[3 * k + side] = jacobian[side][k];
    if (!solve_linear(normal, solved, 3)) return 0;
    for (int side = 0; lens.is_fitted && side < 3; side++) {
        double along[HIGHER_TERMS] = {0};
        for (int term = 0; term < HIGHER_TERMS; term++)
            for (int k = 0; k < PARAMETERS; k++)
                along[term] += jacobian[side][k] * lens.coupling[term][k];
        for (int term = 0; term < HIGHER_TERMS; term++) {
            const double *row = lens.inverse[term];
            const double change = row[0] * along[0] + row[1] * along[1];
            for (int k = 0; k < PARAMETERS; k++)
                solved[3 * k + side] += lens.coupling[term][k] * change;
        }
    }
    double coherent[3] = {0}, apart[PARAMETERS * 3] = {0};
    for (int k = 0; k < PARAMETERS; k++)
        for (int side = 0; side < 3; side++) {
            coherent[side] += solved[3 * k + side] * together[k];
            for (int l = 0; l < PARAMETERS; l++)
                apart[3 * k + side] += 0.5 * gate_square * outliers[k][l] * solved[3 * l + side];
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double known = 0, hidden = coherent[i] * coherent[j];
            for (int k = 0; k < PARAMETERS; k++) {
                known += jacobian[i][k] * solved[3 * k + j];
                hidden += solved[3 * k + i] * apart[3 * k + j];
            }
            covariance[3 * i + j] = inlier_variance * known + hidden + spread[i] * spread[j];
        }
    return 1;
}

static PyObject *poses(PyObject *self, PyObject *args)
{
    (void)self;
    enum { WINDOW_COLUMNS = 5, MAX_REFIT_STEPS = 1000 };
    Call call = {0};
    PyObject *points_array, *valid_array, *prior_array, *windows_array, *parameters_array,
        *pose_array, *covariance_array;
    CodecArrays arrays;
    long long n, m, half_width, range, smallest_shift, steps, fitted;
    PoseOptions options = {0};
    if (!parse_arguments(args, "OOLLLpOOOOOOOOOLLdddLLddddddOOO:poses", &points_array, &valid_array,
                         &n, &m, &half_width, &options.lens, &prior_array, &windows_array,
                         &arrays.lengths, &arrays.weights, &arrays.prefixes, &arrays.crt,
                         &arrays.signs, &arrays.digits, &arrays.masks, &range, &smallest_shift,
                         &options.offset, &options.symbol_gate, &options.min_sigma, &steps, &fitted,
                         &options.higher_lens_sigma, &options.higher_lens_odds,
                         &options.gate_sigmas, &options.gated_variance, &options.square_radius,
                         &options.square_radius_sigma, &parameters_array, &pose_array,
                         &covariance_array))
        return NULL;
    Codec codec = {0};
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "m", m, 0, MAX_DOTS);
    check_range(&call, "half_width", half_width, 1, MAX_WINDOW_CELLS / 2);
    check_range(&call, "max_steps", steps, 1, MAX_REFIT_STEPS);
    check_range(&call, "fitted_parameters", fitted, 1, PARAMETERS);
    if (call.failed) return NULL;
    const float *points = input(&call, points_array, "points", ITEM_FLOAT32, ITEMS(n, m, 2));
    const uint8_t *valid = input(&call, valid_array, "valid", ITEM_FLAG, ITEMS(n, m));
    options.prior = input(&call, prior_array, "prior", ITEM_FLOAT64, PARAMETERS);
    const int64_t *windows =
        input(&call, windows_array, "windows", ITEM_INT64, ITEMS(n, WINDOW_COLUMNS));
    check_items(&call, "windows", windows, ITEM_INT64, (Py_ssize_t)n * WINDOW_COLUMNS,
                -MAX_COORDINATE, MAX_COORDINATE);
    for (Py_ssize_t k = 0; k < n && !call.failed; k++)
        check_range(&call, "rotation in windows", windows[k * WINDOW_COLUMNS + 4], 0, 3);
    take_codec(&call, &arrays, range, smallest_shift, 2 * half_width, &codec);
    double *parameters =
        output(&call, parameters_array, "parameters", ITEM_FLOAT64, ITEMS(n, PARAMETERS));
    double *pose = output(&call, pose_array, "pose", ITEM_FLOAT64, ITEMS(n, 3));
    double *covariance = output(&call, covariance_array, "covariance", ITEM_FLOAT64, ITEMS(n, 9));
    if (call.failed) return finish_call(&call, 1);
    options.half_width = (int)half_width;
    options.max_steps = (int)steps;
    options.fitted_parameters = (int)fitted;
    Dots d;
    const int has_dots = new_dots(&d, (int)m);
    int64_t *phases = malloc(4 * (size_t)half_width * sizeof(int64_t));
    const size_t scratch_items = 2 * ((size_t)m + 1) + 2 * HIGHER_TERMS * (size_t)d.count;
    float *scratch = has_dots ? malloc(scratch_items * sizeof(float)) : NULL;
    const size_t width = 2 * (size_t)half_width + 3;
    float *cells = malloc(3 * width * width * sizeof(float));
    const int has_memory = has_dots && phases && scratch && cells;
    if (has_memory) {
        Py_BEGIN_ALLOW_THREADS
        for (size_t k = 0; k < (size_t)n; k++) {
            const size_t dot = k * (size_t)m;
            load_dots(&d, points + 2 * dot, valid + dot, (int)m);
            if (!estimate_pose(&codec, &options, windows + k * WINDOW_COLUMNS, points + 2 * dot, &d,
                               (int)m, phases, scratch, cells, parameters + k * PARAMETERS,
                               pose + 3 * k, covariance + 9 * k)) {
                for (int i = 0; i < 3; i++) pose[3 * k + i] = NAN;
                for (int i = 0; i < 9; i++) covariance[9 * k + i] = NAN;
            }
        }
        Py_END_ALLOW_THREADS
    }
    if (has_dots) free(d.x);
    free(phases);
    free(cells);
    free(scratch);
    return finish_call(&call, has_memory);
}

/* ---- Derivative dynamic time warping ---------------------------------------------------- */

/* Templates that are compared at the same time, one per lane. The cells of one template depend on
 * each other; those of different templates do not. */
enum { DDTW_LANES = 32 };

/* Costs of the cheapest warping paths between one query (n, 3) and DDTW_LANES templates
 * (length, 3, DDTW_LANES). `column` (n, DDTW_LANES) is the last column of the cost matrices. */
HOT static void ddtw_lanes(const float *restrict query, int n, const float *restrict slopes,
                           int length, float *restrict column, float *restrict cost)
{
    for (int i = 0; i < n * DDTW_LANES; i++) column[i] = INFINITY;
    for (int j = 0; j < length; j++) {
        const float *restrict x = slopes + (size_t)j * 3 * DDTW_LANES;
        const float *restrict y = x + DDTW_LANES, *restrict z = y + DDTW_LANES;
        float above[DDTW_LANES], corner[DDTW_LANES];
        for (int k = 0; k < DDTW_LANES; k++) {
            above[k] = INFINITY;
            corner[k] = j ? INFINITY : 0;
        }
        for (int i = 0; i < n; i++) {
            const float a = query[3 * i], b = query[3 * i + 1], c = query[3 * i + 2];
            float *restrict cost_so_far = column + (size_t)i * DDTW_LANES;
            for (int k = 0; k < DDTW_LANES; k++) {
                const float dx = a - x[k], dy = b - y[k], dz = c - z[k];
                const float previous = lesser(cost_so_far[k], corner[k]);
                corner[k] = cost_so_far[k];
                above[k] = lesser(previous, above[k]) + sqrtf(dx * dx + dy * dy + dz * dz);
                cost_so_far[k] = above[k];
            }
        }
        memcpy(cost, above, sizeof(above));
    }
}

/* Largest length of query and templates, so that an index over their lanes fits into an int. */
enum { MAX_SERIES = INT_MAX / (3 * DDTW_LANES) };

static PyObject *ddtw(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *query_array, *slopes_array, *cost_array;
    long long n, length, count;
    if (!parse_arguments(args, "OOLLLO:ddtw", &query_array, &slopes_array, &n, &length, &count,
                         &cost_array))
        return NULL;
    check_range(&call, "n", n, 0, MAX_SERIES);
    check_range(&call, "length", length, 0, MAX_SERIES);
    check_range(&call, "count", count, 0, INT_MAX - DDTW_LANES);
    if (call.failed) return NULL;
    const float *query = input(&call, query_array, "query", ITEM_FLOAT32, ITEMS(n, 3));
    const float *slopes =
        input(&call, slopes_array, "slopes", ITEM_FLOAT32, ITEMS(length, 3, count));
    float *cost = output(&call, cost_array, "cost", ITEM_FLOAT32, count);
    if (call.failed) return finish_call(&call, 1);
    const size_t block = (size_t)length * 3 * DDTW_LANES;
    /* One byte more, since calloc may return NULL for a size of 0. */
    float *lanes = calloc(block + (size_t)n * DDTW_LANES + 1, sizeof(float));
    if (lanes) {
        Py_BEGIN_ALLOW_THREADS
        for (int first = 0; first < count; first += DDTW_LANES) {
            const long long rest = count - first;
            const size_t used = rest < DDTW_LANES ? (size_t)rest : DDTW_LANES;
            float lane_cost[DDTW_LANES] = {0};
            for (size_t row = 0; row < 3 * (size_t)length; row++)
                memcpy(lanes + row * DDTW_LANES, slopes + row * (size_t)count + first,
                       used * sizeof(float));
            ddtw_lanes(query, (int)n, lanes, (int)length, lanes + block, lane_cost);
            memcpy(cost + first, lane_cost, used * sizeof(float));
        }
        Py_END_ALLOW_THREADS
    }
    free(lanes);
    return finish_call(&call, lanes != NULL);
}

/* ---- Module ----------------------------------------------------------------------------- */

/* The first line of a docstring is the signature that Python's inspect module reads. */
static PyMethodDef methods[] = {
    {"find_dots", find_dots, METH_VARARGS,
     "find_dots($module, images, n, height, width, taps, block, window, slope_reach, max_slope,"
     " min_contrast, contrast_fraction, min_dots, splits, max_dots, xy, counts, /)\n--\n\n"
     "Detect the dots of images; twin of locatk.core.dots.detection.blobs.detect_dots_numpy."},
    {"fit_lattices", fit_lattices, METH_VARARGS,
     "fit_lattices($module, points, valid, n, m, lens, is_thorough, passes, ring_radii, prior,"
     " seeds, min_dots, min_sigmas, min_neighbour, max_neighbour, cell_gate, cell_sigma, symbol_gate,"
     " symbol_sigma, lens_radius, offset, min_seed_power, parameters, uv, cells, sigma, found, /)\n--\n\n"
     "Fit lattices to dots; twin of locatk.core.dots.detection.lattice.fit_lattices_numpy."},
    {"soft_bits", soft_bits, METH_VARARGS,
     "soft_bits($module, uv, cells, valid, found, sigma, n, m, half_width, offset,"
     " symbol_gate, wrong_symbol, x_bits, y_bits, /)\n--\n\n"
     "Compute the soft bits of dots; twin of locatk.core.dots.identification.soft_bits.soft_bits_numpy."},
    {"read_windows", read_windows, METH_VARARGS,
     "read_windows($module, x_bits, y_bits, n, length, lengths, weights, prefixes, crt, signs,"
     " digits, masks, range, smallest_shift, log_hypotheses, positions, evidence, /)\n--\n\n"
     "Read positions from windows of soft bits; twin of locatk.core.dots.identification.phase_voting.estimate_windows_numpy."},
    {"search_positions", search_positions, METH_VARARGS,
     "search_positions($module, scores, n, length, lengths, weights, prefixes, crt, signs, digits,"
     " masks, range, smallest_shift, beam_width, misread, ranks, min_probability, positions, rivals,"
     " /)\n--\n\n"
     "Search positions among many candidates; twin of locatk.core.dots.identification.decoding.search_position_numpy."},
    {"poses", poses, METH_VARARGS,
     "poses($module, points, valid, n, m, half_width, lens, prior, windows, lengths, weights,"
     " prefixes, crt, signs, digits, masks, range, smallest_shift, offset, symbol_gate, min_sigma,"
     " max_steps, fitted_parameters, higher_lens_sigma, higher_lens_odds, gate_sigmas, gated_variance,"
     " square_radius, square_radius_sigma, parameters, pose, covariance, /)\n--\n\n"
     "Estimate poses from decoded dots; twin of locatk.core.dots.localization.pose.localize_windows_numpy."},
    {"ddtw", ddtw, METH_VARARGS,
     "ddtw($module, query, slopes, n, length, count, cost, /)\n--\n\n"
     "Compute distances by derivative dynamic time warping; twin of"
     " locatk.core.polaris.published.ddtw.distances_numpy."},
    {"bar_fields", bar_fields, METH_VARARGS,
     "bar_fields($module, points, count, half_length, half_width, height, radius, remanence,"
     " min_distance, gradient, field, slope, /)\n--\n\n"
     "Compute the fields of a landmark's four bars; twin of"
     " locatk.core.landmarks.field.evaluate_numpy."},
    {"scan_landmarks", scan_landmarks, METH_VARARGS,
     "scan_landmarks($module, points, values, weights, count, centres, n_centres, headings,"
     " n_headings, table, size, step, min_gain, max_gain, strengths, n_strengths, cost, /)"
     "\n--\n\n"
     "Compute the cost of candidate landmark poses; twin of"
     " locatk.core.landmarks.detection.scan.scan_numpy."},
    {"search_map", search_map, METH_VARARGS,
     "search_map($module, item_cells, first, use_item, use_row, parts, weights, values, words,"
     " conflicts, cells, items, length, letters, n_weights, possible, seed, steps, /)\n--\n\n"
     "Search a map whose words all differ; twin of"
     " locatk.core.landmarks.design.search.search_python."},
    {"window_edges", window_edges, METH_VARARGS,
     "window_edges($module, windows, width, tick, first, rises, /)\n--\n\n"
     "Find the edges of packed windows of light samples; twin of window_edges_numpy in"
     " locatk.core.lighthouse.demodulation."},
    {"light_bits", light_bits, METH_VARARGS,
     "light_bits($module, tick, first, rises, readable, ticks_per_chip, max_chips, value,"
     " value_first, start, /)\n--\n\n"
     "Demodulate bursts of light into soft bits; twin of soft_bits_numpy in"
     " locatk.core.lighthouse.demodulation."},
    {"light_places", light_places, METH_VARARGS,
     "light_places($module, value, first, states, index, taps, polynomials, match, miss,"
     " unknown, min_run, steps, min_evidence, rows, /)\n--\n\n"
     "Identify the polynomial and index of bursts; twin of identify_numpy in"
     " locatk.core.lighthouse.demodulation."},
    {"light_expected", light_expected, METH_VARARGS,
     "light_expected($module, value, first, states, polynomial, index, candidates,"
     " search_range, match, miss, unknown, rows, /)\n--\n\n"
     "Score expected polynomials and indices of bursts; twin of expect_numpy in"
     " locatk.core.lighthouse.demodulation."},
    {"light_epochs", light_epochs, METH_VARARGS,
     "light_epochs($module, starts, time_ns, planes, n, max_epoch_ns, epoch, /)\n--\n\n"
     "Number the epochs of pairs of sweeps; twin of"
     " locatk.core.lighthouse.epochs.number_epochs_python."},
    {"light_positions", light_positions, METH_VARARGS,
     "light_positions($module, angle, m, s, stations, floor_z, passes, position, information,"
     " residual, redundancy, /)\n--\n\n"
     "Intersect the light planes of epochs; twin of"
     " locatk.core.lighthouse.localization.positions.intersect_planes_numpy."},
    {"solve_band", solve_band, METH_VARARGS,
     "solve_band($module, factor, n, band, m, is_half, solution, /)\n--\n\n"
     "Solve banded systems in place by their Cholesky factor; twin of LAPACK's dpbtrs and dtbtrs in"
     " locatk.core.block_tridiagonal."},
    {"couple_sweeps", couple_sweeps, METH_VARARGS,
     "couple_sweeps($module, knot, jacobian, column, value, n, k, d, width, m, coupling,"
     " information, /)\n--\n\n"
     "Sum the products of the derivatives of sweeps; twin of"
     " locatk.core.lighthouse.motion.equations.couple_numpy."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    "_kernels",
    "Hot loops of locatk.core, each with a twin in numpy.",
    -1,
    methods,
    NULL,
    NULL,
    NULL,
    NULL,
};

PyMODINIT_FUNC PyInit__kernels(void) { return PyModule_Create(&module); }
