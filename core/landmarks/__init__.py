"""Landmarks of four bar magnets: from hall sensors and odometry to poses on the map of a floor."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from locatk.core.landmarks.solver import SolveOptions, solve

__all__ = ["SolveOptions", "solve"]


def __getattr__(name: str) -> Any:
    # The solver takes long to import, and many modules need only the data of this package.
    if name in __all__:
        from locatk.core.landmarks import solver

        return getattr(solver, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
