/* The search for maps: twin of the Python loop in locatk.core.landmarks.design. */
#include "_kernels.h"
