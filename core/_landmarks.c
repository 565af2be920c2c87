/* The hot loops of core/landmarks: the field of bars, and the search for where a landmark lies.
 * Twins of locatk.core.landmarks.bars.evaluate_numpy and .scan.scan_numpy, which say why.
 */
#include "_kernels.h"
#include <math.h>

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
