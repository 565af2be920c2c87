"""Localization with magnetic tags, printed dots, magnetic landmarks and Lighthouse stations.

The functions of the command line for Python, notebooks and studies:

>>> import locatk
>>> session = locatk.open("run.mcap")                      # doctest: +SKIP
>>> solution = locatk.solve(session)                       # doctest: +SKIP
>>> solution.to_dataframe()                                # doctest: +SKIP
>>> locatk.evaluate(solution).ape_translation.rmse         # doctest: +SKIP

Names are imported when they are first used, so that ``import locatk`` takes no time.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.evaluation import Evaluation as Evaluation
    from locatk.core.trajectory import Trajectory as Trajectory
    from locatk.formats.api.functions import evaluate as evaluate
    from locatk.formats.api.functions import open as open
    from locatk.formats.api.functions import simulate as simulate
    from locatk.formats.api.functions import solve as solve
    from locatk.formats.api.session import Session as Session
    from locatk.formats.api.solution import Solution as Solution

    __version__: str

_NAMES = {
    "Evaluation": "locatk.core.evaluation",
    "Session": "locatk.formats.api.session",
    "Solution": "locatk.formats.api.solution",
    "Trajectory": "locatk.core.trajectory",
    "evaluate": "locatk.formats.api.functions",
    "open": "locatk.formats.api.functions",
    "simulate": "locatk.formats.api.functions",
    "solve": "locatk.formats.api.functions",
}
"""Public names, and the modules that define them."""

__all__ = ["__version__", *_NAMES]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from locatk.formats.output import tool_version

        return tool_version()
    if name not in _NAMES:
        raise AttributeError(f"module 'locatk' has no attribute {name!r}")
    value = getattr(importlib.import_module(_NAMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
