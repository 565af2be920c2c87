"""Access to the compiled kernels, if they were built.

``kernels`` is the extension module :mod:`locatk.core._kernels`, or None if it was not built
(no C compiler) or if the environment variable ``LOCATK_NUMPY=1`` is set before the first
import. Each function of the module has a twin in numpy next to its caller, which is used
instead of it and gives the same results, but is several times slower.

A kernel raises ``ValueError`` if the type, size or layout of an array or a value that is used as
an index does not agree with the other arguments; it never reads or writes beyond an array.
"""

from __future__ import annotations

import contextlib
import importlib
import os
from types import ModuleType

kernels: ModuleType | None = None
if not os.environ.get("LOCATK_NUMPY"):
    with contextlib.suppress(ImportError):
        kernels = importlib.import_module("locatk.core._kernels")
