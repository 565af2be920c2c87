"""What a solver answers: poses, what it rejected and why, and the artifact it used."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from locatk.core.trajectory import Trajectory


@dataclass(frozen=True)
class Solution:
    """Answer of one solver for one session.

    Attributes
    ----------
    system : str
        ``"lighthouse"``, ``"polaris"``, ``"dots"`` or ``"landmarks"``.
    method : str
        Name of the algorithm, as in ``"bundle"`` or ``"paper"``.
    trajectories : tuple of Trajectory
        One a device, accepted poses only.
    rejected : dict of str to int
        Reason to count of the observations that were not used.
    detections : list of dict
        What the system saw, in the JSON form of docs/formats.md.
    artifact : object
        The scene, tag, sheet or map on which the poses stand (solved or given).
    notes : tuple of str
        Each assumption that a reader must know: unit scale, generic calibration, ...
    facts : dict
        Further numbers of the run for ``--json`` and reports.
    """

    system: str
    method: str
    trajectories: tuple[Trajectory, ...]
    rejected: dict[str, int] = field(default_factory=dict)
    detections: list[dict[str, Any]] = field(default_factory=list)
    artifact: Any = None
    notes: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def poses(self) -> int:
        """Number of accepted poses over all devices."""
        return sum(len(t) for t in self.trajectories)
