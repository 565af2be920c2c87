"""Polaris: tags of passive disc magnets, observed by an array of magnetometers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.polaris.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # The solver imports scipy, which many users of this package do not need.
    if name in __all__:
        from locatk.core.polaris import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
