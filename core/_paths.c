/* Hot loops of core/block_tridiagonal.py and core/lighthouse/motion: systems of a chain of states
 * with many right-hand sides, and the products of sweeps for their normal equations.
 */
#include "_kernels.h"
#include <string.h>

/* ---- Systems of chains ------------------------------------------------------------------ */

enum { MAX_BAND = 256, MAX_COLUMNS = 1 << 20 };

/* Number of right-hand sides that are solved together: their rows in a band stay in the cache. */
enum { STRIP = 32 };

/* Subtract `weight` times `other` from `sum`. A full strip has a length that the compiler knows. */
static inline void subtract_row(double *sum, double weight, const double *other, int width)
{
    if (width == STRIP)
        for (int c = 0; c < STRIP; c++) sum[c] -= weight * other[c];
    else
        for (int c = 0; c < width; c++) sum[c] -= weight * other[c];
}

/* Solve for `width` right-hand sides from `first`, by the factor alone if `is_half`. `factor`
 * (n, band) has in row j the elements (j, j) to (j + band - 1, j) of the Cholesky factor. */
HOT static void solve_strip(const double *factor, long long n, int band, long long m,
                            long long first, int width, int is_half, double *solution)
{
    double sum[STRIP];
    for (long long i = 0; i < n; i++) {
        double *own = solution + i * m + first;
        for (int c = 0; c < width; c++) sum[c] = own[c];
        for (long long j = i - band + 1 > 0 ? i - band + 1 : 0; j < i; j++)
            subtract_row(sum, factor[j * band + (i - j)], solution + j * m + first, width);
        for (int c = 0; c < width; c++) own[c] = sum[c] / factor[i * band];
    }
    for (long long i = is_half ? -1 : n - 1; i >= 0; i--) {
        double *own = solution + i * m + first;
        for (int c = 0; c < width; c++) sum[c] = own[c];
        for (long long j = i + 1; j < n && j < i + band; j++)
            subtract_row(sum, factor[i * band + (j - i)], solution + j * m + first, width);
        for (int c = 0; c < width; c++) own[c] = sum[c] / factor[i * band];
    }
}

PyObject *solve_band(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *factor_array, *solution_array;
    long long n, band, m, is_half;
    if (!parse_arguments(args, "OLLLLO:solve_band", &factor_array, &n, &band, &m, &is_half,
                         &solution_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "band", band, 1, MAX_BAND);
    check_range(&call, "m", m, 0, MAX_COLUMNS);
    check_range(&call, "is_half", is_half, 0, 1);
    const double *factor = input(&call, factor_array, "factor", ITEM_FLOAT64, ITEMS(n, band));
    double *solution = output(&call, solution_array, "solution", ITEM_FLOAT64, ITEMS(n, m));
    if (call.failed) return finish_call(&call, 1);
    for (long long first = 0; first < m; first += STRIP)
        solve_strip(factor, n, (int)band, m, first, m - first < STRIP ? (int)(m - first) : STRIP,
                    (int)is_half, solution);
    return finish_call(&call, 1);
}

/* ---- Products of sweeps ----------------------------------------------------------------- */

HOT static void add_products(const double *jacobian, int rows, const int64_t *column,
                             const double *value, int width, long long m, double *coupling,
                             double *information)
{
    for (int r = 0; r < rows; r++) {
        double *row = coupling + r * m;
        for (int c = 0; c < width; c++) row[column[c]] += jacobian[r] * value[c];
    }
    for (int r = 0; r < width; r++) {
        double *row = information + column[r] * m;
        for (int c = 0; c < width; c++) row[column[c]] += value[r] * value[c];
    }
}

PyObject *couple_sweeps(PyObject *self, PyObject *args)
{
    (void)self;
    Call call = {0};
    PyObject *knot_array, *jacobian_array, *column_array, *value_array, *coupling_array,
        *information_array;
    long long n, k, d, width, m;
    if (!parse_arguments(args, "OOOOLLLLLOO:couple_sweeps", &knot_array, &jacobian_array,
                         &column_array, &value_array, &n, &k, &d, &width, &m, &coupling_array,
                         &information_array))
        return NULL;
    check_range(&call, "n", n, 0, INT_MAX);
    check_range(&call, "k", k, 1, INT_MAX);
    check_range(&call, "d", d, 1, MAX_BAND);
    check_range(&call, "width", width, 0, MAX_COLUMNS);
    check_range(&call, "m", m, 0, MAX_COLUMNS);
    const int64_t *knot = input(&call, knot_array, "knot", ITEM_INT64, ITEMS(n));
    const double *jacobian =
        input(&call, jacobian_array, "jacobian", ITEM_FLOAT64, ITEMS(n, 2 * d));
    const int64_t *column = input(&call, column_array, "column", ITEM_INT64, ITEMS(n, width));
    const double *value = input(&call, value_array, "value", ITEM_FLOAT64, ITEMS(n, width));
    double *coupling = output(&call, coupling_array, "coupling", ITEM_FLOAT64, ITEMS(k, d, m));
    double *information =
        output(&call, information_array, "information", ITEM_FLOAT64, ITEMS(m, m));
    check_items(&call, "knot", knot, ITEM_INT64, ITEMS(n), 0, k - 2);
    check_items(&call, "column", column, ITEM_INT64, ITEMS(n, width), 0, m - 1);
    if (call.failed) return finish_call(&call, 1);
    memset(coupling, 0, (size_t)(k * d * m) * sizeof *coupling);
    memset(information, 0, (size_t)(m * m) * sizeof *information);
    for (long long s = 0; s < n; s++)
        add_products(jacobian + 2 * d * s, (int)(2 * d), column + width * s, value + width * s,
                     (int)width, m, coupling + knot[s] * d * m, information);
    return finish_call(&call, 1);
}
