/* What the C files of locatk.core._kernels share (core/_kernels.c says what the module is). */
#ifndef LOCATK_KERNELS_H
#define LOCATK_KERNELS_H
#define PY_SSIZE_T_CLEAN
#ifndef Py_LIMITED_API
#define Py_LIMITED_API 0x030B0000
#endif
#include <Python.h>

/* Loops over arrays are compiled for wide registers too, and the processor's own version is
 * taken at run time, where compiler and C library can do that. */
#if defined(__GNUC__) && !defined(__clang__) && defined(__x86_64__) && defined(__GLIBC__)
#define HOT __attribute__((target_clones("avx2", "default")))
#else
#define HOT
#endif

/* Releases the buffers of a call; None, or MemoryError where there was none to work in. */
static inline PyObject *done(Py_buffer *buffers, int count, int stored)
{
    for (int k = 0; k < count; k++) PyBuffer_Release(buffers + k);
    if (!stored) return PyErr_NoMemory();
    Py_RETURN_NONE;
}

/* core/_landmarks.c */
PyObject *bar_fields(PyObject *self, PyObject *args);
PyObject *scan_landmarks(PyObject *self, PyObject *args);
/* core/_maps.c */
PyObject *search_map(PyObject *self, PyObject *args);
/* core/_light.c */
PyObject *window_edges(PyObject *self, PyObject *args);
PyObject *light_bits(PyObject *self, PyObject *args);
PyObject *light_places(PyObject *self, PyObject *args);
PyObject *light_expected(PyObject *self, PyObject *args);

#endif
