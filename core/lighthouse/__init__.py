"""Lighthouse V2: from the counts of sweeping light planes to poses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.lighthouse.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # scipy-sized imports belong to the call, not to `import locatk.core.lighthouse`.
    if name in __all__:
        from locatk.core.lighthouse import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
