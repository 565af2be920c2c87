"""The compiled twins of a few hot loops, where the install could build them.

``kernels`` is the module :mod:`locatk.core._kernels`, or None: then the numpy code beside
each use does the same work, some times slower. Set the environment variable
``LOCATK_NUMPY=1`` before the first import to go without on purpose.
"""

from __future__ import annotations

import os
from types import ModuleType

kernels: ModuleType | None = None
if not os.environ.get("LOCATK_NUMPY"):
    try:
        from locatk.core import _kernels

        kernels = _kernels
    except ImportError:
        pass
