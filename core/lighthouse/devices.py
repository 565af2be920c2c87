"""Recordings with rigid devices: their full poses, and the other devices in the same scene."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from locatk.core.lighthouse.channels import period_ticks
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.rigid import RigidAnswer, solve_rigid
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.sweeps import Sweeps
from locatk.core.robust import robust_sigma
from locatk.core.solution import Solution

if TYPE_CHECKING:
    from locatk.core.lighthouse.solver import SolveOptions

LEAST_PHOTODIODES = 3
"""Photodiodes of known place that fix an orientation."""


def rigid_devices(sweeps: Sweeps, receivers: Mapping[str, Receiver]) -> dict[str, Receiver]:
    """The receivers with which devices of a recording get full poses."""
    present = {sweeps.devices[k] for k in np.unique(sweeps.device)}
    return {
        name: receiver
        for name, receiver in receivers.items()
        if len(receiver) >= LEAST_PHOTODIODES and name in present
    }


def solve_devices(
    sweeps: Sweeps, scene: Scene, options: SolveOptions, rigid: Mapping[str, Receiver]
) -> Solution:
    """Solve the rigid devices, then the others in the scene of the rigid ones.

    Parameters
    ----------
    sweeps, scene, options
        As for :func:`~locatk.core.lighthouse.solver.solve`.
    rigid : mapping of str to Receiver
        By device; of at least one device of the recording.
    """
    from locatk.core.lighthouse.solver import solve

    answer = solve_rigid(sweeps, rigid, scene)
    own = _solution(answer, options)
    numbers = [k for k, name in enumerate(sweeps.devices) if name not in rigid]
    left = np.flatnonzero(np.isin(sweeps.device, numbers))
    if len(left) == 0:
        return own
    columns = ("time_ns", "device", "sensor", "channel", "polynomial", "sweep", "count")
    rest = replace(sweeps, **{name: getattr(sweeps, name)[left] for name in columns})
    others = solve(rest, answer.scene, options)
    return _together(own, others, tuple(rigid))


def _solution(answer: RigidAnswer, options: SolveOptions) -> Solution:
    """What the rigid devices alone say."""
    rows: list[dict[str, object]] = []
    for k, channel in enumerate(sorted(answer.used)):
        station = answer.scene.station(channel)
        rows.append(
            {
                "station": k,
                "channel": channel,
                "id": None if station is None or station.id is None else f"{station.id:08x}",
                "period_ticks": int(period_ticks(channel)),
                "calibration": "none" if station is None else station.calibration.source,
                "sweeps": answer.used[channel],
                "rejected": answer.unused[channel],
                "residual_rad": robust_sigma(answer.residuals[channel]),
            }
        )
    return Solution(
        "lighthouse",
        options.method,
        answer.trajectories,
        dict(answer.rejected),
        rows,
        answer.scene,
        tuple(dict.fromkeys(answer.notes)),
        dict(answer.facts),
    )


def _together(rigid: Solution, others: Solution, names: tuple[str, ...]) -> Solution:
    """One solution of two over the same scene."""
    rejected = dict(rigid.rejected)
    for reason, number in others.rejected.items():
        rejected[reason] = rejected.get(reason, 0) + number
    rows = {row["channel"]: dict(row) for row in others.detections}
    for row in rigid.detections:
        both = rows.setdefault(row["channel"], {**row, "sweeps": 0, "rejected": 0})
        both["sweeps"] += row["sweeps"]
        both["rejected"] += row["rejected"]
    points = [t for t in others.trajectories if t.device not in names]
    return replace(
        others,
        trajectories=(*rigid.trajectories, *points),
        rejected=rejected,
        detections=[{**rows[c], "station": k} for k, c in enumerate(sorted(rows))],
        notes=tuple(dict.fromkeys((*rigid.notes, *others.notes))),
        facts={**others.facts, "rigid": rigid.facts},
    )
