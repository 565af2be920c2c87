"""What the project promises, measured: one module a system, one row a figure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Figure:
    """One measured figure beside what was promised and what others reach.

    Attributes
    ----------
    name, unit : str
    value : float or None
        None where its data is absent; ``how`` then says so.
    target : float or None
        What the project promises.
    better : str
        ``"lower"`` or ``"higher"``.
    peer : str or None
        Whose figure ``peer_value`` is.
    how : str
        How it was measured, and what was estimated from what.
    """

    name: str
    value: float | None
    unit: str
    how: str
    target: float | None = None
    better: Literal["lower", "higher"] = "lower"
    peer: str | None = None
    peer_value: float | None = None

    @property
    def met(self) -> bool | None:
        """Whether the target is reached; None where there is none, or no value."""
        if self.value is None or self.target is None:
            return None
        return self.value <= self.target if self.better == "lower" else self.value >= self.target
