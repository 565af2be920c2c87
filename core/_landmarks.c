/* The hot loops of core/landmarks: the field of bars, and the search for where a landmark lies.
 * Twins of locatk.core.landmarks.bars.evaluate_numpy and .scan.scan_numpy, which say why.
 */
#include "_kernels.h"
#include <math.h>
#include <stddef.h>

typedef struct {
    double half_length, half_width, height, radius, scale, least;
} Bars;

/* Field and, where it is asked for, gradient of one bar of a landmark in its own frame. */
static inline double bar(const Bars *b, double across, double along, double z, double *slope)
{
    double upper = 1, lower = 1, du = 0, dv = 0, dz = 0;
    for (int end = -1; end <= 1; end += 2) {
        const double v = along + end * b->half_length;
        for (int depth = 0; depth < 2; depth++) {
            const double s = z + depth * b->height;
            const double square = fmax(v * v + s * s, b->least);
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
                    const double over = sign / rho, way = over / rest;
                    du -= over;
                    dv += v * way;
                    dz += s * way;
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
    enum { AT, FIELD, SLOPE, BUFFERS };
    Py_buffer b[BUFFERS];
    Py_ssize_t count;
    Bars bars;
    double remanence, nearest;
    int gradient;
    if (!PyArg_ParseTuple(args, "y*nddddddpw*w*", &b[AT], &count, &bars.half_length,
                          &bars.half_width, &bars.height, &bars.radius, &remanence, &nearest,
                          &gradient, &b[FIELD], &b[SLOPE]))
        return NULL;
    bars.scale = remanence / (4 * 3.14159265358979323846);
    bars.least = nearest * nearest;
    const double *at = b[AT].buf;
    double *field = b[FIELD].buf, *slope = b[SLOPE].buf;
    Py_BEGIN_ALLOW_THREADS
    for (Py_ssize_t i = 0; i < count; i++, at += 3, field += 4)
    {
        double cos = 1, sin = 0;
        for (int k = 0; k < 4; k++) {
            const double u = cos * at[0] + sin * at[1], v = cos * at[1] - sin * at[0];
            double own[3];
            field[k] = bar(&bars, u - bars.radius, v, at[2], gradient ? own : NULL);
            if (gradient) {
                slope[0] = cos * own[0] - sin * own[1];
                slope[1] = sin * own[0] + cos * own[1];
                slope[2] = own[2];
                slope += 3;
            }
            const double turned = -sin;
            sin = cos;
            cos = turned;
        }
    }
    Py_END_ALLOW_THREADS
    return done(b, BUFFERS, 1);
}

/* Bilinear values of the four bars at (i, j) of a square table, which is inside. */
static inline void look_up(const float *table, int size, float i, float j, float *unit)
{
    const int a = (int)i, b = (int)j;
    const float di = i - (float)a, dj = j - (float)b;
    const float low = (1 - di) * (1 - dj), right = (1 - di) * dj, up = di * (1 - dj),
                high = di * dj;
    const float *at = table + 4 * ((ptrdiff_t)a * size + b), *next = at + 4 * (ptrdiff_t)size;
    for (int k = 0; k < 4; k++)
        unit[k] = low * at[k] + right * at[k + 4] + up * next[k] + high * next[k + 4];
}

/* Costs of what may be laid from the normal matrix of the four bars. */
static void costs(const float *normal, const float *right, double power, double least, double most,
                  const double *laid, int kinds, double *out)
{
    for (int kind = 0; kind < kinds; kind++, laid += 4) {
        double top = 0, square = 0;
        for (int k = 0; k < 4; k++) {
            top += laid[k] * right[k];
            for (int l = 0; l < 4; l++) square += laid[k] * laid[l] * normal[4 * k + l];
        }
        const double gain = fmin(fmax(top / fmax(square, 1e-300), least), most);
        out[kind] = power - 2 * gain * top + gain * gain * square;
    }
}

/* What a search is given, as locatk.core.landmarks.scan.scan_numpy has it. */
typedef struct {
    const double *points, *values, *weights;
    const float *table;
    int count, size;
    double step;
} Search;

/* Normal matrix and right side of the four bars at one node: sums over all samples. */
HOT static void gather(const Search *search, const double *centre, double turn,
                       float normal[restrict 16], float right[restrict 4])
{
    const double c = cos(turn) / search->step, s = sin(turn) / search->step;
    const float middle = (float)(search->size - 1) / 2;
    for (int k = 0; k < 16; k++) normal[k] = 0;
    for (int k = 0; k < 4; k++) right[k] = 0;
    for (int i = 0; i < search->count; i++) {
        const double x = search->points[2 * i] - centre[0];
        const double y = search->points[2 * i + 1] - centre[1];
        const float u = (float)(c * x + s * y), v = (float)(c * y - s * x);
        if (fabsf(u) >= middle || fabsf(v) >= middle) continue;
        float unit[4], weighted[4];
        look_up(search->table, search->size, u + middle, v + middle, unit);
        const float weight = (float)search->weights[i], value = (float)search->values[i];
        for (int k = 0; k < 4; k++) weighted[k] = weight * unit[k];
        for (int k = 0; k < 4; k++) right[k] += weighted[k] * value;
        for (int k = 0; k < 4; k++)
            for (int l = 0; l < 4; l++) normal[4 * k + l] += weighted[k] * unit[l];
    }
}

PyObject *scan_landmarks(PyObject *self, PyObject *args)
{
    enum { POINTS, VALUES, WEIGHTS, CENTRES, TURNS, TABLE, LAID, COST, BUFFERS };
    Py_buffer b[BUFFERS];
    Search search;
    int nodes, turns, kinds;
    double least, most;
    if (!PyArg_ParseTuple(args, "y*y*y*iy*iy*iy*idddy*iw*", &b[POINTS], &b[VALUES], &b[WEIGHTS],
                          &search.count, &b[CENTRES], &nodes, &b[TURNS], &turns, &b[TABLE],
                          &search.size, &search.step, &least, &most, &b[LAID], &kinds, &b[COST]))
        return NULL;
    search.points = b[POINTS].buf;
    search.values = b[VALUES].buf;
    search.weights = b[WEIGHTS].buf;
    search.table = b[TABLE].buf;
    const double *centres = b[CENTRES].buf, *angle = b[TURNS].buf, *laid = b[LAID].buf;
    double *out = b[COST].buf;
    Py_BEGIN_ALLOW_THREADS
    double power = 0;
    for (int i = 0; i < search.count; i++)
        power += search.weights[i] * search.values[i] * search.values[i];
    for (int t = 0; t < turns; t++) {
        for (int m = 0; m < nodes; m++, out += kinds) {
            float normal[16], right[4];
            gather(&search, centres + 2 * m, angle[t], normal, right);
            costs(normal, right, power, least, most, laid, kinds, out);
        }
    }
    Py_END_ALLOW_THREADS
    return done(b, BUFFERS, 1);
}
