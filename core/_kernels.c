/* The hot loops of core/dots, frame by frame: dots of an image, their lattice, what they say,
 * where that is in the pattern, and the pose; and of core/polaris: the alignment of samples with
 * templates.
 *
 * Each has a twin in numpy that says what it does and why (core/dots/blobs.py and others,
 * core/polaris/ddtw.py) and that is used where this module was not built; tests hold the two
 * against each other. Constants come in as arguments, so that they stand in one place.
 * Only the stable ABI of Python 3.11 is used, and buffers instead of numpy's own interface.
 */
#include "_kernels.h"
#include <float.h>
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* ---- Sorting ---------------------------------------------------------------------------- */

/* Shell sort, ascending; for the few hundred numbers of a frame. */
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

/* ---- Dots of an image ------------------------------------------------------------------- */

/* Index beyond the rim, mirrored at the outermost pixel. */
static inline int mirrored(int i, int count)
{
    if (count == 1) return 0;
    while (i < 0 || i >= count) i = i < 0 ? -i : 2 * (count - 1) - i;
    return i;
}

static inline float smaller(float a, float b) { return a < b ? a : b; }

/* Smoothed image by five taps each way (two outer, two inner, the middle). */
HOT static void smooth_image(const uint8_t *restrict image, int h, int w, const float *taps,
                             float *restrict line, float *restrict smooth)
{
    const float outer = taps[0], inner = taps[1], middle = taps[2];
    for (int y = 0; y < h; y++) {
        const uint8_t *a = image + (size_t)mirrored(y - 2, h) * w;
        const uint8_t *b = image + (size_t)mirrored(y - 1, h) * w;
        const uint8_t *c = image + (size_t)y * w;
        const uint8_t *d = image + (size_t)mirrored(y + 1, h) * w;
        const uint8_t *e = image + (size_t)mirrored(y + 2, h) * w;
        float *restrict in = line + 2;
        for (int x = 0; x < w; x++)
            in[x] =
                outer * (float)(a[x] + e[x]) + inner * (float)(b[x] + d[x]) + middle * (float)c[x];
        for (int k = 1; k <= 2; k++) {
            in[-k] = in[mirrored(-k, w)];
            in[w - 1 + k] = in[mirrored(w - 1 + k, w)];
        }
        float *restrict out = smooth + (size_t)y * w;
        for (int x = 0; x < w; x++)
            out[x] =
                outer * (in[x - 2] + in[x + 2]) + inner * (in[x - 1] + in[x + 1]) + middle * in[x];
    }
}

/* Marks (1) where a pixel is the least of the 5 x 5 about it, and of equal ones the first; the
 * rim of two is not looked at. */
HOT static void mark_minima(const float *restrict smooth, int h, int w, float *restrict across,
                            uint8_t *restrict marks)
{
    for (int y = 0; y < h; y++) {
        const float *restrict s = smooth + (size_t)y * w;
        float *restrict m = across + (size_t)y * w;
        for (int x = 2; x < w - 2; x++)
            m[x] =
                smaller(smaller(smaller(s[x - 2], s[x - 1]), smaller(s[x + 1], s[x + 2])), s[x]);
    }
    for (int y = 2; y < h - 2; y++) {
        const float *restrict a = across + (size_t)(y - 2) * w, *restrict b = a + w;
        const float *restrict d = a + 3 * w, *restrict e = a + 4 * w;
        const float *restrict s = smooth + (size_t)y * w;
        uint8_t *restrict mark = marks + (size_t)y * w;
        for (int x = 2; x < w - 2; x++) {
            const float before = smaller(smaller(a[x], b[x]), smaller(s[x - 2], s[x - 1]));
            const float after = smaller(smaller(d[x], e[x]), smaller(s[x + 1], s[x + 2]));
            mark[x] = (s[x] < before) & (s[x] <= after);
        }
    }
}

/* Moving sums over `reach` values of a line with a stride, mirrored at its ends. */
static void moving_sum(const float *line, int count, int stride, int reach, float *out)
{
    const int half = reach / 2;
    float sum = 0;
    for (int k = -half; k <= half; k++) sum += line[mirrored(k, count) * stride];
    for (int k = 0; k < count; k++) {
        out[k * stride] = sum;
        sum += line[mirrored(k + half + 1, count) * stride]
               - line[mirrored(k - half, count) * stride];
    }
}

/* Brightness of the paper: means of blocks, averaged over a square of blocks. */
static void paper_image(const uint8_t *image, int w, int rows, int columns, int block, int reach,
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
            /* Whole grey levels, as an 8-bit image has them. */
            means[r * columns + c] = (float)((2 * sum + block * block) / (2 * block * block));
        }
    }
    for (int r = 0; r < rows; r++)
        moving_sum(means + r * columns, columns, 1, reach, across + r * columns);
    for (int c = 0; c < columns; c++) moving_sum(across + c, rows, columns, reach, paper + c);
    const float share = 1.0f / (float)(reach * reach);
    for (int k = 0; k < rows * columns; k++) paper[k] *= share;
}

/* Contrast of the median dot: of those above the split that Otsu's criterion makes, once the
 * few that are darker than any dot were set aside as dirt. */
static float median_dot(float *contrasts, int count, int fewest, int splits)
{
    if (count == 0) return 0;
    sort_floats(contrasts, count);
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
        if (dots >= fewest) return contrasts[count - 1 - (dots - 1) / 2];
        count -= dots;
    }
    return contrasts[count - 1 - (count - 1) / 2];
}

/* Slope of a plane through the paper's brightness, in grey levels a pixel along one axis. */
static float slope_of(const float *paper, int count, int step, int across, int across_step,
                      int block)
{
    double sum = 0, squares = 0;
    for (int k = 0; k < count; k++) {
        const double from_middle = k - (count - 1) / 2.0;
        double line = 0;
        for (int j = 0; j < across; j++) line += paper[k * step + j * across_step];
        sum += line / across * from_middle;
        squares += from_middle * from_middle;
    }
    return (float)(sum / (squares > 1 ? squares : 1) / block);
}

static float peak(const float *at, int step, float light, float slope, float contrast, float top)
{
    const float least = 0.05f * contrast;
    const float before = light - slope - at[-step], after = light + slope - at[step];
    const float a = logf(before > least ? before : least);
    const float b = logf(after > least ? after : least);
    float bend = 2 * top - a - b;
    bend = bend > 1e-6f ? bend : 1e-6f;
    const float offset = 0.5f * (b - a) / bend;
    return offset < -0.5f ? -0.5f : offset > 0.5f ? 0.5f : offset;
}

typedef struct {
    float x, y, contrast, off; /* off: square distance from the middle */
} Dot;

static int middle_first(const void *a, const void *b)
{
    const float x = ((const Dot *)a)->off, y = ((const Dot *)b)->off;
    return (x > y) - (x < y);
}

typedef struct {
    int h, w, block, reach, fewest, splits, most, rows, columns;
    float faintest, share;
    const float *taps;
    float *smooth, *across, *line, *means, *blurred, *paper, *contrasts, *lights;
    int *sums;
    uint8_t *marks;
    Dot *dots;
} Finder;

/* Dots of an image to `xy`; how many there are. */
static int dots_of(const Finder *f, const uint8_t *image, float *xy)
{
    const int h = f->h, w = f->w;
    Dot *dots = f->dots;
    smooth_image(image, h, w, f->taps, f->line, f->smooth);
    paper_image(image, w, f->rows, f->columns, f->block, f->reach, f->sums, f->means, f->blurred,
                f->paper);
    mark_minima(f->smooth, h, w, f->across, f->marks);
    int minima = 0;
    for (int y = 2; y < h - 2; y++) {
        const uint8_t *mark = f->marks + (size_t)y * w, *end = mark + w - 2;
        const int row = y / f->block < f->rows ? y / f->block : f->rows - 1;
        for (const uint8_t *at = mark + 2; (at = memchr(at, 1, (size_t)(end - at))); at++) {
            const int x = (int)(at - mark);
            const int column = x / f->block < f->columns ? x / f->block : f->columns - 1;
            const float light = f->paper[row * f->columns + column];
            const float contrast = light - f->smooth[(size_t)y * w + x];
            if (!(contrast > f->faintest)) continue;
            f->lights[minima] = light;
            f->contrasts[minima] = contrast / light;
            dots[minima].x = (float)x;
            dots[minima].y = (float)y;
            dots[minima++].contrast = contrast;
        }
    }
    memcpy(f->across, f->contrasts, (size_t)minima * sizeof(float));
    const float bar = f->share * median_dot(f->across, minima, f->fewest, f->splits);
    const int rows = f->rows, columns = f->columns;
    const float slope_x = slope_of(f->paper, columns, 1, rows, columns, f->block);
    const float slope_y = slope_of(f->paper, rows, columns, columns, 1, f->block);
    int kept = 0;
    for (int k = 0; k < minima; k++) {
        if (!(f->contrasts[k] > bar)) continue;
        const float light = f->lights[k], contrast = dots[k].contrast, top = logf(contrast);
        const float *at = f->smooth + (size_t)dots[k].y * w + (size_t)dots[k].x;
        const float x = dots[k].x + peak(at, 1, light, slope_x, contrast, top);
        const float y = dots[k].y + peak(at, w, light, slope_y, contrast, top);
        const float dx = x - 0.5f * (float)(w - 1), dy = y - 0.5f * (float)(h - 1);
        dots[kept].x = x;
        dots[kept].y = y;
        dots[kept++].off = dx * dx + dy * dy;
    }
    if (kept > f->most) {
        qsort(dots, (size_t)kept, sizeof(Dot), middle_first);
        kept = f->most;
    }
    for (int k = 0; k < kept; k++) {
        xy[2 * k] = dots[k].x;
        xy[2 * k + 1] = dots[k].y;
    }
    return kept;
}

static PyObject *find_dots(PyObject *self, PyObject *args)
{
    enum { IMAGES, TAPS, XY, COUNTS, BUFFERS };
    Py_buffer b[BUFFERS];
    int n;
    Finder f;
    if (!PyArg_ParseTuple(args, "y*iiiy*iiffiiiw*w*", &b[IMAGES], &n, &f.h, &f.w, &b[TAPS],
                          &f.block, &f.reach, &f.faintest, &f.share, &f.fewest, &f.splits, &f.most,
                          &b[XY], &b[COUNTS]))
        return NULL;
    f.rows = f.h / f.block;
    f.columns = f.w / f.block;
    f.taps = b[TAPS].buf;
    const size_t area = (size_t)f.h * f.w, blocks = (size_t)f.rows * f.columns;
    f.smooth = malloc((4 * area + (size_t)f.w + 4 + 3 * blocks) * sizeof(float));
    f.dots = malloc(area * sizeof(Dot));
    f.sums = malloc((size_t)f.w * sizeof(int));
    f.marks = malloc(area);
    const int stored = f.smooth && f.dots && f.sums && f.marks;
    if (stored) {
        f.across = f.smooth + area;
        f.contrasts = f.across + area;
        f.lights = f.contrasts + area;
        f.line = f.lights + area;
        f.means = f.line + f.w + 4;
        f.blurred = f.means + blocks;
        f.paper = f.blurred + blocks;
        Py_BEGIN_ALLOW_THREADS for (int k = 0; k < n; k++)((int64_t *)b[COUNTS].buf)[k] =
            dots_of(&f, (const uint8_t *)b[IMAGES].buf + k * area,
                    (float *)b[XY].buf + 2 * (size_t)k * f.most);
        Py_END_ALLOW_THREADS
    }
    free(f.smooth);
    free(f.dots);
    free(f.sums);
    free(f.marks);
    return done(b, BUFFERS, stored);
}

/* ---- The lattice of dots ---------------------------------------------------------------- */

enum { A_U = 0, C_U = 2, A_V = 3, C_V = 5, PERSPECTIVE = 6, LENS = 8, PARAMETERS = 9 };

typedef struct {
    int seeds, fewest, rings;
    const double *ring, *prior; /* radii; inverse squares of the parameters' deviations */
    double nearest, farthest, gate, loose, tight, firm, bent_from, offset;
} Rules;

enum { LANES = 8 };

/* Dots of a frame, an array a quantity, filled up to whole groups of LANES. */
typedef struct {
    int count;
    float *x, *y, *valid;              /* p; 1 where there is such a dot */
    float *u, *v, *bend, *over, *q[2]; /* |p|^2 / (1 + lens |p|^2), 1 / (1 + g q), q */
    float *use, *miss[2];              /* 1 where it counts; by how much it misses */
} Dots;

static int new_dots(Dots *d, int m)
{
    d->count = (m + LANES - 1) / LANES * LANES;
    float **arrays[] = {&d->x,    &d->y,    &d->valid, &d->u,   &d->v,       &d->bend,
                        &d->over, &d->q[0], &d->q[1],  &d->use, &d->miss[0], &d->miss[1]};
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
    float *restrict us = d->u, *restrict vs = d->v, *restrict bends = d->bend;
    float *restrict overs = d->over, *restrict q0 = d->q[0], *restrict q1 = d->q[1];
    for (int i = 0; i < d->count; i++) {
        const float x = px[i], y = py[i], square = x * x + y * y;
        const float bend = 1 / (1 + t[LENS] * square), qx = x * bend, qy = y * bend;
        const float over = 1 / (1 + t[PERSPECTIVE] * qx + t[PERSPECTIVE + 1] * qy);
        us[i] = (t[A_U] * qx + t[A_U + 1] * qy + t[C_U]) * over;
        vs[i] = (t[A_V] * qx + t[A_V + 1] * qy + t[C_V]) * over;
        bends[i] = square * bend;
        overs[i] = over;
        q0[i] = qx;
        q1[i] = qy;
    }
}

/* Dots near their places within a ring count; whether there are dots beyond it. */
HOT static int aim_at_places(const Dots *d, float ring, float gate)
{
    const float *restrict us = d->u, *restrict vs = d->v, *restrict valid = d->valid;
    float *restrict use = d->use, *restrict du = d->miss[0], *restrict dv = d->miss[1];
    int beyond = 0;
    for (int i = 0; i < d->count; i++) {
        const float u = rintf(us[i]), v = rintf(vs[i]);
        const int there = valid[i] > 0, near = u * u + v * v < ring;
        du[i] = us[i] - u;
        dv[i] = vs[i] - v;
        beyond |= there & !near;
        use[i] = there & near & (fabsf(du[i]) < gate) & (fabsf(dv[i]) < gate) ? 1.0f : 0.0f;
    }
    return beyond;
}

/* Where, about its place, the symbol stands that is nearest. */
static inline void nearest_symbol(const float *rest, float offset, float *symbol)
{
    const int along_x = fabsf(rest[0]) > fabsf(rest[1]);
    symbol[0] = along_x ? copysignf(offset, rest[0]) : 0;
    symbol[1] = along_x ? 0 : copysignf(offset, rest[1]);
}

/* Dots near where a symbol stands count. */
HOT static void aim_at_symbols(const Dots *d, float offset, float tight)
{
    const float *restrict us = d->u, *restrict vs = d->v, *restrict valid = d->valid;
    float *restrict use = d->use, *restrict du = d->miss[0], *restrict dv = d->miss[1];
    for (int i = 0; i < d->count; i++) {
        const float rest[2] = {us[i] - rintf(us[i]), vs[i] - rintf(vs[i])};
        float symbol[2];
        nearest_symbol(rest, offset, symbol);
        du[i] = rest[0] - symbol[0];
        dv[i] = rest[1] - symbol[1];
        use[i] = (valid[i] > 0) & (fabsf(du[i]) < tight) & (fabsf(dv[i]) < tight) ? 1.0f : 0.0f;
    }
}

/* Solves a x = b in place by Gauss with pivots, for `sides` columns b[k][side]. */
static int solve(double a[PARAMETERS][PARAMETERS], double *b, int sides)
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

static double total(const float *lanes)
{
    double sum = 0;
    for (int l = 0; l < LANES; l++) sum += lanes[l];
    return sum;
}

/* Normal equations by which the dots in use are moved onto what they miss, and priors. Sums
 * run in LANES side by side, since a compiler may not reorder a single one. */
HOT static void equations(const double *parameters, const Dots *d, double sigma, int lens,
                          const double *prior, double normal[PARAMETERS][PARAMETERS],
                          double *right)
{
    float s_shared[6][LANES] = {{0}}, s_cross[2][9][LANES] = {{{0}}}, s_corner[6][LANES] = {{0}};
    float s_right[PARAMETERS][LANES] = {{0}};
    const float g0 = (float)parameters[PERSPECTIVE], g1 = (float)parameters[PERSPECTIVE + 1];
    for (int i = 0; i < d->count; i += LANES) {
        float o[LANES], b[2][LANES];
        for (int l = 0; l < LANES; l++) {
            o[l] = d->over[i + l] * d->use[i + l];
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
            const float *value = (axis ? d->v : d->u) + i, *miss = d->miss[axis] + i;
            const float *q0 = d->q[0] + i, *q1 = d->q[1] + i, *bend = d->bend + i;
            const float a0 = (float)parameters[3 * axis], a1 = (float)parameters[3 * axis + 1];
            float c[3][LANES], w[LANES];
            for (int l = 0; l < LANES; l++) {
                c[0][l] = -value[l] * b[0][l];
                c[1][l] = -value[l] * b[1][l];
                const float slope = a0 * q0[l] + a1 * q1[l] - value[l] * (g0 * q0[l] + g1 * q1[l]);
                c[2][l] = lens ? -slope * bend[l] * o[l] : 0;
                w[l] = -miss[l] * d->use[i + l];
            }
            for (int k = 0; k < 3; k++) {
                const float *column = c[k];
                float (*x)[LANES] = s_cross[axis];
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
        shared[k] = total(s_shared[k]);
        corner[k] = total(s_corner[k]);
    }
    for (int k = 0; k < 9; k++) {
        cross[0][k] = total(s_cross[0][k]);
        cross[1][k] = total(s_cross[1][k]);
        right[k] = total(s_right[k]);
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

/* One Gauss-Newton step; false where it cannot be made. */
static int step(double *parameters, const Dots *d, double sigma, int lens, const double *prior)
{
    double normal[PARAMETERS][PARAMETERS], right[PARAMETERS];
    equations(parameters, d, sigma, lens, prior, normal, right);
    if (!solve(normal, right, 1)) return 0;
    for (int k = 0; k < PARAMETERS; k++) parameters[k] += right[k];
    return 1;
}

/* Square distance of each point to its third nearest; no branch, since none could be foretold. */
HOT static void third_nearest(const float *restrict x, const float *restrict y, int count,
                              float *restrict first, float *restrict second, float *restrict third)
{
    for (int i = 0; i < count; i++) first[i] = second[i] = third[i] = FLT_MAX;
    for (int j = 0; j < count; j++)
        for (int i = 0; i < count; i++) {
            const float dx = x[i] - x[j], dy = y[i] - y[j];
            const float square = i == j ? FLT_MAX : dx * dx + dy * dy;
            const float a = first[i], b = second[i], c = third[i];
            third[i] = smaller(c, b > square ? b : square);
            second[i] = smaller(b, a > square ? a : square);
            first[i] = smaller(a, square);
        }
}

/* Pitch, direction and shift in the middle; false where there are too few dots. `scratch` is
 * for a float a dot, seven a seed, and two a pair of seeds. */
static int seed(const float *points, const uint8_t *valid, int m, const Rules *rules,
                float *scratch, double *parameters)
{
    float *squares = scratch, *x = squares + m + 1, *y = x + rules->seeds,
          *work = y + rules->seeds;
    float *dxs = work + 5 * rules->seeds, *dys = dxs + rules->seeds * (rules->seeds + 1) / 2;
    int there = 0, count = 0;
    for (int i = 0; i < m; i++) {
        const float px = points[2 * i], py = points[2 * i + 1];
        squares[there] = px * px + py * py;
        there += valid[i] != 0;
    }
    if (there < rules->fewest) return 0;
    const int wanted = there < rules->seeds ? there : rules->seeds;
    const float bar = nth_smallest(squares, there, wanted - 1);
    for (int i = 0; i < m && count < wanted; i++) {
        const float px = points[2 * i], py = points[2 * i + 1];
        if (!valid[i] || px * px + py * py > bar) continue;
        x[count] = px;
        y[count++] = py;
    }
    float *third = work + 2 * rules->seeds;
    third_nearest(x, y, count, work, work + rules->seeds, third);
    sort_floats(third, count);
    const float pitch_square = 0.5f * (third[(count - 1) / 2] + third[count / 2]);
    const float low = (float)rules->nearest * pitch_square;
    const float high = (float)rules->farthest * pitch_square;
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
    const double turn = 2 * 3.14159265358979323846;
    for (int axis = 0; axis < 2; axis++) {
        const double *a = parameters + 3 * axis;
        double re = 0, im = 0;
        for (int i = 0; i < count; i++) {
            const double phase = turn * (a[0] * x[i] + a[1] * y[i]);
            re += cos(phase);
            im += sin(phase);
        }
        parameters[C_U + 3 * axis] = -atan2(im, re) / turn;
    }
    return 1;
}

/* Lattice of the dots; false where there is none. */
static int fit(const Dots *d, const float *points, const uint8_t *valid, int m, int lens,
               const Rules *rules, float *scratch, double *parameters, float *uv, float *place,
               double *sigma)
{
    if (!seed(points, valid, m, rules, scratch, parameters)) return 0;
    for (int r = 0, beyond = 1; r < rules->rings && beyond; r++) {
        project(parameters, d);
        const double ring = rules->ring[r] * rules->ring[r];
        beyond = aim_at_places(d, (float)ring, (float)rules->gate);
        const int bent = lens && rules->ring[r] > rules->bent_from;
        if (!step(parameters, d, rules->loose, bent, rules->prior)) return 0;
    }
    for (int again = 0; again < 2; again++) {
        project(parameters, d);
        aim_at_symbols(d, (float)rules->offset, (float)rules->tight);
        if (!step(parameters, d, rules->firm, lens, rules->prior)) return 0;
    }
    project(parameters, d);
    aim_at_symbols(d, (float)rules->offset, (float)rules->tight);
    /* The place in the middle becomes the origin. */
    double shift[2];
    for (int axis = 0; axis < 2; axis++) {
        double *a = parameters + 3 * axis;
        shift[axis] = rint(a[2]);
        a[0] -= shift[axis] * parameters[PERSPECTIVE];
        a[1] -= shift[axis] * parameters[PERSPECTIVE + 1];
        a[2] -= shift[axis];
    }
    int count = 0;
    double squares = 0;
    for (int i = 0; i < m; i++) {
        uv[2 * i] = d->u[i] - (float)shift[0];
        uv[2 * i + 1] = d->v[i] - (float)shift[1];
        place[2 * i] = rintf(uv[2 * i]);
        place[2 * i + 1] = rintf(uv[2 * i + 1]);
        if (d->use[i] > 0) {
            count++;
            squares += (double)(d->miss[0][i] * d->miss[0][i] + d->miss[1][i] * d->miss[1][i]);
        }
    }
    *sigma = sqrt(squares / (2 * count - 8 > 1 ? 2 * count - 8 : 1));
    for (int k = 0; k < PARAMETERS; k++)
        if (!isfinite(parameters[k])) return 0;
    return count >= rules->fewest;
}

static PyObject *fit_lattices(PyObject *self, PyObject *args)
{
    enum { POINTS, VALID, RING, PRIOR, FITTED, UV, PLACE, SIGMA, FOUND, BUFFERS };
    Py_buffer b[BUFFERS];
    int n, m, lens;
    Rules rules;
    if (!PyArg_ParseTuple(args, "y*y*iipy*y*iiddddddddw*w*w*w*w*", &b[POINTS], &b[VALID], &n, &m,
                          &lens, &b[RING], &b[PRIOR], &rules.seeds, &rules.fewest, &rules.nearest,
                          &rules.farthest, &rules.gate, &rules.loose, &rules.tight, &rules.firm,
                          &rules.bent_from, &rules.offset, &b[FITTED], &b[UV], &b[PLACE],
                          &b[SIGMA], &b[FOUND]))
        return NULL;
    rules.rings = (int)(b[RING].len / (Py_ssize_t)sizeof(double));
    rules.ring = b[RING].buf;
    rules.prior = b[PRIOR].buf;
    Dots d;
    const int made = new_dots(&d, m);
    const size_t seeds = (size_t)rules.seeds;
    float *scratch = malloc(((size_t)m + 1 + 7 * seeds + seeds * (seeds + 1)) * sizeof(float));
    const int stored = made && scratch;
    if (stored) {
        Py_BEGIN_ALLOW_THREADS for (int k = 0; k < n; k++)
        {
            const size_t at = (size_t)k * m;
            const float *points = (const float *)b[POINTS].buf + 2 * at;
            const uint8_t *valid = (const uint8_t *)b[VALID].buf + at;
            load_dots(&d, points, valid, m);
            ((uint8_t *)b[FOUND].buf)[k] = (uint8_t)fit(
                &d, points, valid, m, lens, &rules, scratch,
                (double *)b[FITTED].buf + (size_t)k * PARAMETERS, (float *)b[UV].buf + 2 * at,
                (float *)b[PLACE].buf + 2 * at, (double *)b[SIGMA].buf + k);
        }
        Py_END_ALLOW_THREADS
    }
    if (made) free(d.x);
    free(scratch);
    return done(b, BUFFERS, stored);
}

/* Soft bits of a frame's dots on the square of places about the middle. */
static void bits_of(const float *uv, const float *place, const uint8_t *valid, int m, int half,
                    float sigma, float offset, float often, float *misses, float *x_bits,
                    float *y_bits)
{
    const int length = 2 * half;
    const float spread = -0.25f / (sigma * sigma);
    for (int k = 0; k < length * length; k++) {
        misses[k] = FLT_MAX;
        x_bits[k] = y_bits[k] = 0;
    }
    for (int i = 0; i < m; i++) {
        if (!valid[i]) continue;
        const int column = (int)place[2 * i] + half, row = (int)place[2 * i + 1] + half;
        if (column < 0 || column >= length || row < 0 || row >= length) continue;
        const float rest[2] = {uv[2 * i] - place[2 * i], uv[2 * i + 1] - place[2 * i + 1]};
        float symbol[2];
        nearest_symbol(rest, offset, symbol);
        const float a = fabsf(rest[0] - symbol[0]), b = fabsf(rest[1] - symbol[1]);
        const float miss = a > b ? a : b;
        const int cell = row * length + column;
        if (miss >= misses[cell]) continue;
        misses[cell] = miss;
        for (int axis = 0; axis < 2; axis++) {
            const float along = axis ? rest[1] + rest[0] : rest[1] - rest[0];
            const float one = expf(spread * (along - offset) * (along - offset)) + often;
            const float zero = expf(spread * (along + offset) * (along + offset)) + often;
            (axis ? y_bits : x_bits)[cell] = logf(one / zero);
        }
    }
}

static PyObject *soft_bits(PyObject *self, PyObject *args)
{
    enum { UV, PLACE, VALID, FOUND, SIGMA, X_BITS, Y_BITS, BUFFERS };
    Py_buffer b[BUFFERS];
    int n, m, half;
    float offset, often;
    if (!PyArg_ParseTuple(args, "y*y*y*y*y*iiiffw*w*", &b[UV], &b[PLACE], &b[VALID], &b[FOUND],
                          &b[SIGMA], &n, &m, &half, &offset, &often, &b[X_BITS], &b[Y_BITS]))
        return NULL;
    const size_t size = 4 * (size_t)half * half;
    float *misses = malloc(size * sizeof(float));
    if (misses) {
        Py_BEGIN_ALLOW_THREADS for (int k = 0; k < n; k++)
        {
            const size_t at = (size_t)k * m;
            bits_of((const float *)b[UV].buf + 2 * at, (const float *)b[PLACE].buf + 2 * at,
                    (const uint8_t *)b[VALID].buf + at, ((const uint8_t *)b[FOUND].buf)[k] ? m : 0,
                    half, (float)((const double *)b[SIGMA].buf)[k], offset, often, misses,
                    (float *)b[X_BITS].buf + k * size, (float *)b[Y_BITS].buf + k * size);
        }
        Py_END_ALLOW_THREADS
    }
    free(misses);
    return done(b, BUFFERS, misses != NULL);
}

/* ---- A first reading of windows ---------------------------------------------------------- */

enum { PERIOD = 63, SEQUENCES = 4, BASE = 3 };

typedef struct {
    const int64_t *lengths, *weights, *prefixes, *crt; /* prefixes one after the other */
    const float *signs;  /* the main sequence as -1 and 1, from 0 to its period and beyond */
    const int8_t *digit; /* (4, 63) digit of each difference, -1 where there is none */
    const float *masks;  /* (4, 3, widest) whether a place has a digit, repeated beyond the end */
    int64_t range, smallest, widest;
    double places;           /* logarithm of how many there are */
    double free[PERIOD + 1]; /* what a line says of which so many phases are likely */
} Code;

typedef struct {
    int64_t place, shift, wrong, first, last;
    double odds, order, lead;
} Axis;

static inline int64_t remainder_of(int64_t a, int64_t b)
{
    const int64_t r = a % b;
    return r < 0 ? r + b : r;
}

/* Index of the main sequence at the start of a column or row; Codec.phases. */
static int64_t phase_at(const Code *code, int64_t place)
{
    int64_t total = code->smallest * place;
    const int64_t *prefix = code->prefixes;
    for (int k = 0; k < SEQUENCES; k++) {
        const int64_t length = code->lengths[k];
        total += code->weights[k] * (place / length * prefix[length] + prefix[place % length]);
        prefix += length + 1;
    }
    return remainder_of(total, PERIOD);
}

/* Likeliest place and shift of one axis by the likeliest phase of each line. */
HOT static void vote(const Code *code, const float *const *scores, int lines, float *votes,
                     int *phase, float *margin, Axis *axis)
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
    int64_t place = 0;
    axis->lead = DBL_MAX;
    for (int k = 0; k < SEQUENCES; k++) {
        const int length = (int)code->lengths[k];
        memset(votes, 0, (size_t)length * sizeof(float));
        for (int i = 0; i + 1 < lines; i++) {
            const float weight = smaller(margin[i], margin[i + 1]);
            const int difference = (phase[i + 1] - phase[i] + PERIOD) % PERIOD;
            const int digit = code->digit[k * PERIOD + difference];
            if (digit < 0 || weight <= 0) continue;
            const float *restrict mask =
                code->masks + (k * BASE + digit) * code->widest + i % length;
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
        if (votes[best] - second < axis->lead) axis->lead = votes[best] - second;
        place = (place + code->crt[k] * best) % code->range;
    }
    axis->place = place;
    float ballots[PERIOD] = {0};
    for (int i = 0; i < lines; i++) {
        const int64_t ahead = phase_at(code, (place + i) % code->range);
        ballots[remainder_of(phase[i] - ahead, PERIOD)] += margin[i];
    }
    int best = 0;
    for (int k = 1; k < PERIOD; k++)
        if (ballots[k] > ballots[best]) best = k;
    axis->shift = best;
    /* Against lines of the main sequence in any order, each at one of its likely phases. */
    axis->order = -code->places;
    for (int i = 0; i < lines; i++) {
        const float top = scores[i][phase[i]];
        if (top <= 0) continue;
        int likely = 0;
        for (int k = 0; k < PERIOD; k++) likely += scores[i][k] > top - 2;
        const int64_t ahead = phase_at(code, (place + i) % code->range);
        const float here = scores[i][remainder_of(ahead + best, PERIOD)];
        axis->order += code->free[likely] - 0.5 * (double)(top - here);
    }
}

/* Evidence for the place: line i of the axis, dot j along it, at bits[start + i*a + j*b]. */
static void compare(const Code *code, const float *bits, float sign, int start, int across,
                    int along, int length, Axis *axis)
{
    double odds = 0;
    axis->wrong = 0;
    axis->first = length;
    axis->last = -1;
    for (int i = 0; i < length; i++) {
        const float *line = bits + start + i * across;
        const int64_t phase =
            remainder_of(phase_at(code, (axis->place + i) % code->range) + axis->shift, PERIOD);
        int seen = 0;
        for (int j = 0; j < length; j++) {
            const float bit = line[j * along];
            if (bit == 0) continue;
            seen = 1;
            const float agreement = sign * bit * code->signs[phase + j];
            axis->wrong += agreement < 0;
            odds -= logf(0.5f + 0.5f * expf(-agreement));
        }
        if (seen) {
            if (i < axis->first) axis->first = i;
            axis->last = i;
        }
    }
    axis->odds = odds - code->places;
}

/* Adds a bit, the step-th of a line, to the line's scores at all phases, read both ways. */
static inline void correlate(float bit, const float *signs, int step, int length,
                             float *restrict forwards, float *restrict backwards)
{
    const float *restrict f = signs + step, *restrict g = signs + length - 1 - step;
    for (int k = 0; k < PERIOD; k++) forwards[k] += bit * f[k];
    for (int k = 0; k < PERIOD; k++) backwards[k] -= bit * g[k];
}

HOT static void read_window(const Code *code, const float *x_bits, const float *y_bits, int length,
                            float *scores, const float **lines, float *votes, int *phase,
                            float *margin, int64_t *rotation, Axis *x, Axis *y)
{
    const size_t size = (size_t)length * PERIOD;
    float *table[4] = {scores, scores + size, scores + 2 * size, scores + 3 * size};
    memset(scores, 0, 4 * size * sizeof(float));
    for (int row = 0; row < length; row++)
        for (int column = 0; column < length; column++) {
            const float a = x_bits[row * length + column], b = y_bits[row * length + column];
            const int down = row * PERIOD, right = column * PERIOD;
            if (a != 0) correlate(a, code->signs, row, length, table[0] + right, table[1] + right);
            if (b != 0)
                correlate(b, code->signs, column, length, table[2] + down, table[3] + down);
        }
    float sums[4] = {0};
    for (int t = 0; t < 4; t++)
        for (int i = 0; i < length; i++) {
            const float *s = table[t] + i * PERIOD;
            float top = s[0];
            for (int k = 1; k < PERIOD; k++) top = top > s[k] ? top : s[k];
            sums[t] += top;
        }
    /* Scores of columns and rows at each rotation, and whether they count backwards. */
    static const int column_table[4] = {0, 2, 1, 3}, row_table[4] = {2, 1, 3, 0};
    static const int column_turned[4] = {0, 1, 1, 0}, row_turned[4] = {0, 0, 1, 1};
    int best = 0;
    for (int r = 1; r < 4; r++)
        if (sums[column_table[r]] + sums[row_table[r]]
            > sums[column_table[best]] + sums[row_table[best]])
            best = r;
    *rotation = best;
    const int last = length - 1, width = length;
    for (int i = 0; i < length; i++)
        lines[i] = table[column_table[best]] + (column_turned[best] ? last - i : i) * PERIOD;
    vote(code, lines, length, votes, phase, margin, x);
    for (int i = 0; i < length; i++)
        lines[i] = table[row_table[best]] + (row_turned[best] ? last - i : i) * PERIOD;
    vote(code, lines, length, votes, phase, margin, y);
    /* Steps in the seen window for a step in x and in y of the printed one. */
    static const int sign_x[4] = {1, 1, -1, -1}, sign_y[4] = {1, -1, -1, 1};
    const int start[4] = {0, last * width, last * width + last, last};
    const int step_x[4] = {1, -width, -1, width}, step_y[4] = {width, 1, -width, -1};
    const float *columns = best % 2 ? y_bits : x_bits, *rows = best % 2 ? x_bits : y_bits;
    compare(code, columns, (float)sign_x[best], start[best], step_x[best], step_y[best], length,
            x);
    compare(code, rows, (float)sign_y[best], start[best], step_y[best], step_x[best], length, y);
}

static PyObject *read_windows(PyObject *self, PyObject *args)
{
    enum {
        X_BITS,
        Y_BITS,
        LENGTHS,
        WEIGHTS,
        PREFIXES,
        CRT,
        SIGNS,
        DIGIT,
        MASKS,
        WHOLE,
        ODDS,
        BUFFERS
    };
    Py_buffer b[BUFFERS];
    int n, length;
    long long range, smallest;
    Code code;
    if (!PyArg_ParseTuple(args, "y*y*iiy*y*y*y*y*y*y*LLdw*w*", &b[X_BITS], &b[Y_BITS], &n, &length,
                          &b[LENGTHS], &b[WEIGHTS], &b[PREFIXES], &b[CRT], &b[SIGNS], &b[DIGIT],
                          &b[MASKS], &range, &smallest, &code.places, &b[WHOLE], &b[ODDS]))
        return NULL;
    code.lengths = b[LENGTHS].buf;
    code.weights = b[WEIGHTS].buf;
    code.prefixes = b[PREFIXES].buf;
    code.crt = b[CRT].buf;
    code.signs = b[SIGNS].buf;
    code.digit = b[DIGIT].buf;
    code.masks = b[MASKS].buf;
    code.widest = b[MASKS].len / (Py_ssize_t)(SEQUENCES * BASE * sizeof(float));
    code.range = range;
    code.smallest = smallest;
    code.free[0] = 0;
    for (int k = 1; k <= PERIOD; k++) code.free[k] = log((double)PERIOD / k);
    const size_t size = (size_t)length * length;
    float *scores = malloc((4 * (size_t)length * PERIOD + (size_t)length + 512) * sizeof(float));
    const float **lines = malloc((size_t)length * sizeof(float *));
    int *phase = malloc((size_t)length * sizeof(int));
    const int stored = scores && lines && phase;
    if (stored) {
        float *margin = scores + 4 * (size_t)length * PERIOD, *votes = margin + length;
        int64_t *out = b[WHOLE].buf;
        double *evidence = b[ODDS].buf;
        Py_BEGIN_ALLOW_THREADS for (int k = 0; k < n; k++, out += 11, evidence += 6)
        {
            Axis axes[2];
            read_window(&code, (const float *)b[X_BITS].buf + k * size,
                        (const float *)b[Y_BITS].buf + k * size, length, scores, lines, votes,
                        phase, margin, out, axes, axes + 1);
            for (int axis = 0; axis < 2; axis++) {
                const Axis *a = axes + axis;
                const int64_t row[5] = {a->place, a->shift, a->wrong, a->first, a->last};
                memcpy(out + 1 + 5 * axis, row, sizeof(row));
                evidence[axis] = a->odds;
                evidence[2 + axis] = a->order;
                evidence[4 + axis] = a->lead;
            }
        }
        Py_END_ALLOW_THREADS
    }
    free(scores);
    free((void *)lines);
    free(phase);
    return done(b, BUFFERS, stored);
}

/* ---- From a place to a pose --------------------------------------------------------------- */

/* Fits the lattice once more, to the dots that say what they should, and reads the pose off. */
static int pose_of(const Code *code, const uint8_t *valid, const float *uv, const float *place,
                   int m, int half, int lens, const double *prior, const int64_t *window,
                   double offset, double tight, double finest, const Dots *d, int64_t *phases,
                   double *parameters, double *pose, double *covariance)
{
    static const int turns[4][2][2] = {
        {{1, 0}, {0, 1}}, {{0, -1}, {1, 0}}, {{-1, 0}, {0, -1}}, {{0, 1}, {-1, 0}}};
    static const int corners[4][2] = {{0, 0}, {1, 0}, {1, 1}, {0, 1}};
    const int64_t x = window[0], y = window[1], section[2] = {window[2], window[3]};
    const int (*turn)[2] = turns[window[4]], *corner = corners[window[4]], length = 2 * half;
    int64_t *columns = phases, *rows = phases + length;
    for (int k = 0; k < length; k++) {
        const int64_t at_x = remainder_of(x + k, code->range);
        const int64_t at_y = remainder_of(y + k, code->range);
        columns[k] = remainder_of(phase_at(code, at_x) + section[0] + y, PERIOD);
        rows[k] = remainder_of(phase_at(code, at_y) + section[1] + x, PERIOD);
    }
    int count = 0;
    double squares = 0;
    for (int i = 0; i < m; i++) {
        d->use[i] = 0;
        if (!valid[i]) continue;
        const int a = (int)place[2 * i] + half, b = (int)place[2 * i + 1] + half;
        const int column = turn[0][0] * a + turn[0][1] * b + corner[0] * (length - 1);
        const int row = turn[1][0] * a + turn[1][1] * b + corner[1] * (length - 1);
        if (column < 0 || column >= length || row < 0 || row >= length) continue;
        const int column_bit = code->signs[columns[column] + row] > 0;
        const int row_bit = code->signs[rows[row] + column] > 0;
        /* Up 00, left 10, right 01, down 11 (column bit, row bit). */
        const int dx = row_bit - column_bit, dy = row_bit + column_bit - 1;
        const float du =
            uv[2 * i] - place[2 * i] - (float)offset * (float)(turn[0][0] * dx + turn[1][0] * dy);
        const float dv = uv[2 * i + 1] - place[2 * i + 1]
                         - (float)offset * (float)(turn[0][1] * dx + turn[1][1] * dy);
        if (!(fabsf(du) < (float)tight && fabsf(dv) < (float)tight)) continue;
        d->use[i] = 1;
        d->miss[0][i] = du;
        d->miss[1][i] = dv;
        count++;
        squares += (double)(du * du + dv * dv);
    }
    double variance = squares / (2 * count - 8 > 1 ? 2 * count - 8 : 1);
    if (variance < finest * finest) variance = finest * finest;
    project(parameters, d);
    double normal[PARAMETERS][PARAMETERS], copy[PARAMETERS][PARAMETERS], right[PARAMETERS];
    equations(parameters, d, sqrt(variance), lens, prior, normal, right);
    memcpy(copy, normal, sizeof(normal));
    if (!solve(copy, right, 1)) return 0;
    for (int k = 0; k < PARAMETERS; k++) parameters[k] += right[k];

    const double *t = parameters;
    const double centre[2] = {t[C_U] + half, t[C_V] + half};
    const double u = t[A_U] - t[C_U] * t[PERSPECTIVE], v = t[A_V] - t[C_V] * t[PERSPECTIVE];
    double right_of[2];
    for (int axis = 0; axis < 2; axis++) {
        pose[axis] = turn[axis][0] * centre[0] + turn[axis][1] * centre[1]
                     + corner[axis] * (length - 1) + (double)(axis ? y : x);
        right_of[axis] = turn[axis][0] * u + turn[axis][1] * v;
    }
    pose[2] = atan2(-right_of[1], right_of[0]);
    double jacobian[3][PARAMETERS] = {{0}}, solved[PARAMETERS * 3];
    for (int axis = 0; axis < 2; axis++) {
        jacobian[axis][C_U] = turn[axis][0];
        jacobian[axis][C_V] = turn[axis][1];
    }
    jacobian[2][A_U] = v / (u * u + v * v);
    jacobian[2][A_V] = -u / (u * u + v * v);
    for (int k = 0; k < PARAMETERS; k++)
        for (int side = 0; side < 3; side++) solved[3 * k + side] = jacobian[side][k];
    if (!solve(normal, solved, 3)) return 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            double sum = 0;
            for (int k = 0; k < PARAMETERS; k++) sum += jacobian[i][k] * solved[3 * k + j];
            covariance[3 * i + j] = sum * variance;
        }
    return 1;
}

static PyObject *poses(PyObject *self, PyObject *args)
{
    enum {
        POINTS,
        VALID,
        UV,
        PLACE,
        PRIOR,
        WINDOWS,
        FITTED,
        POSE,
        COVARIANCE,
        LENGTHS,
        WEIGHTS,
        PREFIXES,
        CRT,
        SIGNS,
        DIGIT,
        MASKS,
        BUFFERS
    };
    Py_buffer b[BUFFERS];
    int n, m, half, lens;
    long long range, smallest;
    double offset, tight, finest;
    Code code;
    if (!PyArg_ParseTuple(args, "y*y*y*y*iiipy*y*y*y*y*y*y*y*y*LLdddw*w*w*", &b[POINTS], &b[VALID],
                          &b[UV], &b[PLACE], &n, &m, &half, &lens, &b[PRIOR], &b[WINDOWS],
                          &b[LENGTHS], &b[WEIGHTS], &b[PREFIXES], &b[CRT], &b[SIGNS], &b[DIGIT],
                          &b[MASKS], &range, &smallest, &offset, &tight, &finest, &b[FITTED],
                          &b[POSE], &b[COVARIANCE]))
        return NULL;
    code.lengths = b[LENGTHS].buf;
    code.weights = b[WEIGHTS].buf;
    code.prefixes = b[PREFIXES].buf;
    code.signs = b[SIGNS].buf;
    code.range = range;
    code.smallest = smallest;
    Dots d;
    const int made = new_dots(&d, m);
    int64_t *phases = malloc(4 * (size_t)half * sizeof(int64_t));
    const int stored = made && phases;
    if (stored) {
        Py_BEGIN_ALLOW_THREADS for (int k = 0; k < n; k++)
        {
            const size_t at = (size_t)k * m;
            const uint8_t *valid = (const uint8_t *)b[VALID].buf + at;
            double *out = (double *)b[POSE].buf + 3 * k;
            double *spread = (double *)b[COVARIANCE].buf + 9 * k;
            load_dots(&d, (const float *)b[POINTS].buf + 2 * at, valid, m);
            if (!pose_of(&code, valid, (const float *)b[UV].buf + 2 * at,
                         (const float *)b[PLACE].buf + 2 * at, m, half, lens, b[PRIOR].buf,
                         (const int64_t *)b[WINDOWS].buf + 5 * k, offset, tight, finest, &d,
                         phases, (double *)b[FITTED].buf + (size_t)k * PARAMETERS, out, spread)) {
                for (int i = 0; i < 3; i++) out[i] = NAN;
                for (int i = 0; i < 9; i++) spread[i] = NAN;
            }
        }
        Py_END_ALLOW_THREADS
    }
    if (made) free(d.x);
    free(phases);
    return done(b, BUFFERS, stored);
}

/* ---- Derivative dynamic time warping ---------------------------------------------------- */

/* Templates that are compared at a time, one a lane: the cells of one template wait for each
 * other, those of its neighbours do not. */
enum { DDTW_LANES = 32 };

/* Costs of the cheapest paths through the matrices of one query (n, 3) and DDTW_LANES templates
 * (length, 3, DDTW_LANES). `column` (n, DDTW_LANES) holds the matrices' last column. */
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
            float *restrict at = column + (size_t)i * DDTW_LANES;
            for (int k = 0; k < DDTW_LANES; k++) {
                const float dx = a - x[k], dy = b - y[k], dz = c - z[k];
                const float before = smaller(at[k], corner[k]);
                corner[k] = at[k];
                above[k] = smaller(before, above[k]) + sqrtf(dx * dx + dy * dy + dz * dz);
                at[k] = above[k];
            }
        }
        memcpy(cost, above, sizeof(above));
    }
}

static PyObject *ddtw(PyObject *self, PyObject *args)
{
    enum { QUERY, SLOPES, COST, BUFFERS };
    Py_buffer b[BUFFERS];
    int n, length, count;
    if (!PyArg_ParseTuple(args, "y*y*iiiw*", &b[QUERY], &b[SLOPES], &n, &length, &count, &b[COST]))
        return NULL;
    const size_t block = (size_t)length * 3 * DDTW_LANES;
    float *slopes = calloc(block + (size_t)n * DDTW_LANES, sizeof(float));
    if (slopes) {
        Py_BEGIN_ALLOW_THREADS for (int first = 0; first < count; first += DDTW_LANES)
        {
            const size_t lanes = (size_t)(count - first < DDTW_LANES ? count - first : DDTW_LANES);
            float cost[DDTW_LANES] = {0};
            for (int row = 0; row < 3 * length; row++)
                memcpy(slopes + (size_t)row * DDTW_LANES,
                       (const float *)b[SLOPES].buf + (size_t)row * count + first,
                       lanes * sizeof(float));
            ddtw_lanes(b[QUERY].buf, n, slopes, length, slopes + block, cost);
            memcpy((float *)b[COST].buf + first, cost, lanes * sizeof(float));
        }
        Py_END_ALLOW_THREADS
    }
    free(slopes);
    return done(b, BUFFERS, slopes != NULL);
}

static PyMethodDef methods[] = {
    {"find_dots", find_dots, METH_VARARGS, "Twin of locatk.core.dots.blobs.find_dots_numpy."},
    {"fit_lattices", fit_lattices, METH_VARARGS,
     "Twin of locatk.core.dots.grid.fit_lattices_numpy."},
    {"read_windows", read_windows, METH_VARARGS, "Twin of locatk.core.dots.reading.read_numpy."},
    {"soft_bits", soft_bits, METH_VARARGS, "Twin of locatk.core.dots.softbits.soft_bits_numpy."},
    {"poses", poses, METH_VARARGS, "Twin of locatk.core.dots.pose.poses_numpy."},
    {"ddtw", ddtw, METH_VARARGS, "Twin of locatk.core.polaris.ddtw.distances_numpy."},
    {"bar_fields", bar_fields, METH_VARARGS,
     "Twin of locatk.core.landmarks.bars.evaluate_numpy."},
    {"scan_landmarks", scan_landmarks, METH_VARARGS,
     "Twin of locatk.core.landmarks.scan.scan_numpy."},
    {"window_edges", window_edges, METH_VARARGS,
     "Twin of locatk.core.lighthouse.bursts.window_edges_numpy."},
    {"light_bits", light_bits, METH_VARARGS,
     "Twin of locatk.core.lighthouse.demodulate.soft_bits_numpy."},
    {"light_places", light_places, METH_VARARGS,
     "Twin of locatk.core.lighthouse.identify.identify_numpy."},
    {"light_expected", light_expected, METH_VARARGS,
     "Twin of locatk.core.lighthouse.identify.expect_numpy."},
    {"search_map", search_map, METH_VARARGS,
     "Twin of locatk.core.landmarks.search.search_python."},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {
    PyModuleDef_HEAD_INIT,
    "_kernels",
    "Hot loops of locatk.core.",
    -1,
    methods,
    NULL,
    NULL,
    NULL,
    NULL,
};

PyMODINIT_FUNC PyInit__kernels(void) { return PyModule_Create(&module); }
