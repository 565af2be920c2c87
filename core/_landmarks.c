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
    for (Py_ssize_t i = 0; i < count; i++, at += 3, field += 4) {
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

/* Bilinear value at (i, j) of a square table, 0 outside. */
static inline float look_up(const float *table, int size, float i, float j)
{
    const float last = (float)(size - 1);
    if (!(i >= 0 && j >= 0 && i < last && j < last)) return 0;
    const int a = (int)i, b = (int)j;
    const float di = i - (float)a, dj = j - (float)b;
    const float *at = table + (ptrdiff_t)a * size + b;
    return (1 - di) * ((1 - dj) * at[0] + dj * at[1])
           + di * ((1 - dj) * at[size] + dj * at[size + 1]);
}

/* Costs of what may be laid from the normal matrix of the four bars. */
static void costs(const double *normal, const double *right, double power, double least,
                  double most, const double *laid, int kinds, double *out)
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

PyObject *scan_landmarks(PyObject *self, PyObject *args)
{
    enum { POINTS, VALUES, WEIGHTS, CENTRES, TURNS, TABLE, LAID, COST, BUFFERS };
    Py_buffer b[BUFFERS];
    int count, nodes, turns, size, kinds;
    double step, least, most;
    if (!PyArg_ParseTuple(args, "y*y*y*iy*iy*iy*idddy*iw*", &b[POINTS], &b[VALUES], &b[WEIGHTS],
                          &count, &b[CENTRES], &nodes, &b[TURNS], &turns, &b[TABLE], &size, &step,
                          &least, &most, &b[LAID], &kinds, &b[COST]))
        return NULL;
    const double *points = b[POINTS].buf, *values = b[VALUES].buf, *weights = b[WEIGHTS].buf;
    const double *centres = b[CENTRES].buf, *angle = b[TURNS].buf;
    const double *laid = b[LAID].buf;
    const float *table = b[TABLE].buf;
    double *out = b[COST].buf;
    const float middle = (float)(size - 1) / 2;
    Py_BEGIN_ALLOW_THREADS
    double power = 0;
    for (int i = 0; i < count; i++) power += weights[i] * values[i] * values[i];
    for (int t = 0; t < turns; t++) {
        const double c = cos(angle[t]) / step, s = sin(angle[t]) / step;
        for (int m = 0; m < nodes; m++, out += kinds) {
            double normal[16] = {0}, right[4] = {0};
            for (int i = 0; i < count; i++) {
                const double x = points[2 * i] - centres[2 * m];
                const double y = points[2 * i + 1] - centres[2 * m + 1];
                const float u = (float)(c * x + s * y), v = (float)(c * y - s * x);
                if (fabsf(u) >= middle || fabsf(v) >= middle) continue;
                const float unit[4] = {
                    look_up(table, size, u + middle, v + middle),
                    look_up(table, size, v + middle, -u + middle),
                    look_up(table, size, -u + middle, -v + middle),
                    look_up(table, size, -v + middle, u + middle),
                };
                for (int k = 0; k < 4; k++) {
                    const double weighted = weights[i] * unit[k];
                    right[k] += weighted * values[i];
                    for (int l = 0; l <= k; l++) normal[4 * k + l] += weighted * unit[l];
                }
            }
            for (int k = 0; k < 4; k++)
                for (int l = k + 1; l < 4; l++) normal[4 * k + l] = normal[4 * l + k];
            costs(normal, right, power, least, most, laid, kinds, out);
        }
    }
    Py_END_ALLOW_THREADS
    return done(b, BUFFERS, 1);
}
