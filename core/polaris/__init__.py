"""Tags of passive disc magnets: from a magnetometer bar's samples to tags and poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.polaris.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # scipy belongs to the call, not to `import locatk.core.polaris`.
    if name in __all__:
        from locatk.core.polaris import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
