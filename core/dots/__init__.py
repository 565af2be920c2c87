"""Printed micro-dot pattern: poses on a sheet from camera frames of it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.dots.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # The solver imports OpenCV, which many modules that need only the data types do not.
    if name in __all__:
        from locatk.core.dots import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
