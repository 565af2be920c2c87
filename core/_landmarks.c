/* Hot loops of core/landmarks: the fields of a landmark's bars, and the cost of candidate poses.
 * The twins locatk.core.landmarks.field.evaluate_numpy and .scan.scan_numpy document the methods.
 */
#include "_kernels.h"
#include <math.h>
#include <stddef.h>

typedef struct {
    double half_length, half_width, height, radius, scale, min_square;
} Bars;

/* Field of one bar in the bar's frame and, if `slope` is not NULL, its gradient. */
static inline double bar_field(const Bars *b, double across, double along, double z, double *slope)
{
    double upper = 1, lower = 1, du = 0, dv = 0, dz = 0;
    for (int end = -1; end <= 1; end += 2) {
        const double v = along + end * b->half_length;
        for (int depth = 0; depth < 2; depth++) {
            const double s = z + depth * b->height;
            const double square = fmax(v * v + s * s, b->min_square);
            for (int side = -1; side <= 1; side += 2) {
                const double u = across - side * b->half_width;
                const double rho = sqrt(u * u + square);
                const double rest = u > 0 ? square / (rho + u) : rho - u;
                const int sign = -end * side * (1 - 2 * depth);
                if (sign > 0)
                    upper *= rest;
                else
                    lower *= rest;
                if (slope) {
                    const double inverse = sign / rho, factor = inverse / rest;
                    du -= inverse;
                    dv += v * factor;
                    dz += s * factor;
                }
            }
        }
    }
    if (slope) {
        slope[0] = b->scale * du;
        slope[1] = b->scale * dv;
        slope[2] = b->scale * dz;
    }
    return b->scale * log(upper / lower);
}

PyObject *bar_fields(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *points_array, *field_array, *slope_array;
    long long count;
    Bars bars;
    double remanence, min_distance;
    int gradient;
    if (!parse_arguments(args, "OLddddddpOO:bar_fields", &points_array, &count, &bars.half_length,
                         &bars.half_width, &bars.height, &bars.radius, &remanence, &min_distance,
                         &gradient, &field_array, &slope_array))
        return NULL;
    check_range(&call, "count", count, 0, PY_SSIZE_T_MAX);
    if (call.failed) return NULL;
    const double *point = input(&call, points_array, "points", ITEM_FLOAT64, ITEMS(count, 3));
    double *field = output(&call, field_array, "field", ITEM_FLOAT64, ITEMS(count, 4));
    double *slope =
        output(&call, slope_array, "slope", ITEM_FLOAT64, gradient ? ITEMS(count, 4, 3) : 0);
    if (call.failed) return finish_call(&call, 1);
    bars.scale = remanence / (4 * 3.14159265358979323846);
    bars.min_square = min_distance * min_distance;
    Py_BEGIN_ALLOW_THREADS
    for (long long i = 0; i < count; i++, point += 3, field += 4) {
        double cos = 1, sin = 0;
        for (int k = 0; k < 4; k++) {
            const double u = cos * point[0] + sin * point[1], v = cos * point[1] - sin * point[0];
            double bar_slope[3];
            field[k] = bar_field(&bars, u - bars.radius, v, point[2], gradient ? bar_slope : NULL);
            if (gradient) {
                slope[0] = cos * bar_slope[0] - sin * bar_slope[1];
                slope[1] = sin * bar_slope[0] + cos * bar_slope[1];
                slope[2] = bar_slope[2];
                slope += 3;
            }
            const double next_cos = -sin;
            sin = cos;
            cos = next_cos;
        }
    }
    Py_END_ALLOW_THREADS
    return finish_call(&call, 1);
}

/* Bilinear interpolation of the four bars' fields at (i, j), 0 to size - 1, in a square table.
 * A float sum may round up to size - 1; the last cell then gives the value at its border. */
static inline void interpolate(const float *table, int size, float i, float j, float *unit)
{
    const int last = size - 2;
    const int a = (int)i < last ? (int)i : last, b = (int)j < last ? (int)j : last;
    const float di = i - (float)a, dj = j - (float)b;
    const float low = (1 - di) * (1 - dj), right = (1 - di) * dj, up = di * (1 - dj),
                high = di * dj;
    const float *cell = table + 4 * ((ptrdiff_t)a * size + b), *next = cell + 4 * (ptrdiff_t)size;
    for (int k = 0; k < 4; k++)
        unit[k] = low * cell[k] + right * cell[k + 4] + up * next[k] + high * next[k + 4];
}

/* Costs of the candidate strengths of the bars, from the normal matrix of the four bars. */
static void costs(const float *normal, const float *right, double power, double min_gain,
                  double max_gain, const double *strengths, int n_strengths, double *out)
{
    for (int candidate = 0; candidate < n_strengths; candidate++, strengths += 4) {
        double top = 0, square = 0;
        for (int k = 0; k < 4; k++) {
            top += strengths[k] * right[k];
            for (int l = 0; l < 4; l++) square += strengths[k] * strengths[l] * normal[4 * k + l];
        }
        const double gain = fmin(fmax(top / fmax(square, 1e-300), min_gain), max_gain);
        out[candidate] = power - 2 * gain * top + gain * gain * square;
    }
}

/* Samples and field table of a scan; see locatk.core.landmarks.detection.scan.scan_numpy. */
typedef struct {
    const double *points, *values, *weights;
    const float *table;
    int count, size;
    double step;
} Scan;

/* 4 x 4 normal matrix and right-hand side of the four bars at one candidate pose, over all samples. */
HOT static void sum_samples(const Scan *scan, const double *centre, double heading,
                            float *restrict normal, float *restrict right)
{
    const double c = cos(heading) / scan->step, s = sin(heading) / scan->step;
    const float middle = (float)(scan->size - 1) / 2;
    for (int k = 0; k < 16; k++) normal[k] = 0;
    for (int k = 0; k < 4; k++) right[k] = 0;
    for (int i = 0; i < scan->count; i++) {
        const double x = scan->points[2 * i] - centre[0];
        const double y = scan->points[2 * i + 1] - centre[1];
        const float u = (float)(c * x + s * y), v = (float)(c * y - s * x);
        /* Also skips NaN, which has no index. */
        if (!(fabsf(u) < middle && fabsf(v) < middle)) continue;
        float unit[4], weighted[4];
        interpolate(scan->table, scan->size, u + middle, v + middle, unit);
        const float weight = (float)scan->weights[i], value = (float)scan->values[i];
        for (int k = 0; k < 4; k++) weighted[k] = weight * unit[k];
        for (int k = 0; k < 4; k++) right[k] += weighted[k] * value;
        for (int k = 0; k < 4; k++)
            for (int l = 0; l < 4; l++) normal[4 * k + l] += weighted[k] * unit[l];
    }
}

/* Largest side of a table: up to it, its indices are exact as float32. */
enum { MAX_TABLE_SIZE = 1 << 20 };

PyObject *scan_landmarks(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *points_array, *values_array, *weights_array, *centres_array, *headings_array,
        *table_array, *strengths_array, *cost_array;
    Scan scan;
    long long count, n_centres, n_headings, size, n_strengths;
    double min_gain, max_gain;
    if (!parse_arguments(args, "OOOLOLOLOLdddOLO:scan_landmarks", &points_array, &values_array,
                         &weights_array, &count, &centres_array, &n_centres, &headings_array,
                         &n_headings, &table_array, &size, &scan.step, &min_gain, &max_gain,
                         &strengths_array, &n_strengths, &cost_array))
        return NULL;
    check_range(&call, "count", count, 0, INT_MAX);
    check_range(&call, "n_centres", n_centres, 0, INT_MAX);
    check_range(&call, "n_headings", n_headings, 0, INT_MAX);
    check_range(&call, "size", size, 2, MAX_TABLE_SIZE);
    check_range(&call, "n_strengths", n_strengths, 0, INT_MAX);
    check_positive(&call, "step", scan.step);
    if (call.failed) return NULL;
    scan.points = input(&call, points_array, "points", ITEM_FLOAT64, ITEMS(count, 2));
    scan.values = input(&call, values_array, "values", ITEM_FLOAT64, count);
    scan.weights = input(&call, weights_array, "weights", ITEM_FLOAT64, count);
    const double *centres =
        input(&call, centres_array, "centres", ITEM_FLOAT64, ITEMS(n_centres, 2));
    const double *headings = input(&call, headings_array, "headings", ITEM_FLOAT64, n_headings);
    scan.table = input(&call, table_array, "table", ITEM_FLOAT32, ITEMS(size, size, 4));
    const double *strengths =
        input(&call, strengths_array, "strengths", ITEM_FLOAT64, ITEMS(n_strengths, 4));
    double *cost =
        output(&call, cost_array, "cost", ITEM_FLOAT64, ITEMS(n_headings, n_centres, n_strengths));
    if (call.failed) return finish_call(&call, 1);
    scan.count = (int)count;
    scan.size = (int)size;
    Py_BEGIN_ALLOW_THREADS
    double power = 0;
    for (int i = 0; i < scan.count; i++)
        power += scan.weights[i] * scan.values[i] * scan.values[i];
    for (long long heading = 0; heading < n_headings; heading++) {
        for (long long centre = 0; centre < n_centres; centre++, cost += n_strengths) {
            float normal[16], right[4];
            sum_samples(&scan, centres + 2 * centre, headings[heading], normal, right);
            costs(normal, right, power, min_gain, max_gain, strengths, (int)n_strengths, cost);
        }
    }
    Py_END_ALLOW_THREADS
    return finish_call(&call, 1);
}
