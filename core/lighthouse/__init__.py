"""Lighthouse V2: poses of photodiodes and rigid devices from sweeping light planes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.lighthouse.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # The solver takes long to import, and many modules need only the data of this package.
    if name in __all__:
        from locatk.core.lighthouse import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
