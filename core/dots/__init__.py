"""Printed micro-dot pattern: from camera frames of a sheet to poses on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.dots.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # OpenCV belongs to the call, not to `import locatk.core.dots`.
    if name in __all__:
        from locatk.core.dots import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
