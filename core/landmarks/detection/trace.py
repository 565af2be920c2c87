"""One visit made ready for a fit: where each sensor was by odometry, and how that may be wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Drift:
    """How far odometry is trusted: standard deviations of what is wrong with it.

    Attributes
    ----------
    scale : float
        Of distances, constant.
    turn_scale : float
        Of turns, constant.
    curvature_radpm : float
        Turn a metre that odometry does not see, constant; the default is one degree on a
        pass of 230 mm.
    walk_m, walk_rad : float
        Random walk of place and heading over one unit of effort, a way of
        :data:`WAY_M` or a turn of :data:`TURN_RAD`.
    """

    scale: float = 0.01
    turn_scale: float = 0.01
    curvature_radpm: float = math.radians(1) / 0.23
    walk_m: float = 0.2e-3
    walk_rad: float = math.radians(0.1)


WAY_M = 0.15

TURN_RAD = math.pi / 2


@dataclass(frozen=True)
class Trace:
    """Field along the ways of the sensors in one visit, in a frame of the robot's odometry.

    The frame is the robot's at sample :attr:`reference`. The way is the odometry's plus
    ``correction @ c``, where ``c`` is to be found and has the prior ``N(0, 1)``.

    Attributes
    ----------
    pose : (n, 3) ndarray
        Robot at each sample by odometry: x, y, heading.
    correction : (n, 3, m) ndarray
        What each of m ways to be wrong changes in x, y, heading; 0 at the reference.
    value_t : (n, N) ndarray
        Fields; ``nan`` where there is none that can be used.
    lever_m : (N, 2) ndarray
        Sensors in the robot's frame.
    weight : (n,) ndarray
        Samples of which each is the mean.
    reference : int
    share : float
        How many there were for each that was kept.
    """

    pose: Array
    correction: Array
    value_t: Array
    lever_m: Array
    weight: Array
    reference: int
    share: float = 1.0

    def __len__(self) -> int:
        return len(self.pose)

    def places(self) -> Array:
        """(n, N, 2) sensors by odometry."""
        return sensor_places(self.pose, self.lever_m)

    def thinned(self, most: int) -> Trace:
        """At most ``most`` samples of it, evenly chosen; the reference stays."""
        step = math.ceil(len(self) / most)
        if step == 1:
            return self
        keep = np.arange(self.reference % step, len(self), step)
        return Trace(
            self.pose[keep],
            self.correction[keep],
            self.value_t[keep],
            self.lever_m,
            self.weight[keep],
            self.reference // step,
            self.share * step,
        )


def sensor_places(pose: Array, lever_m: Array) -> Array:
    """(n, N, 2) places of sensors at ``lever_m`` (N, 2) on a robot with poses (n, 3)."""
    cos, sin = np.cos(pose[:, 2, None]), np.sin(pose[:, 2, None])
    x = pose[:, 0, None] + cos * lever_m[:, 0] - sin * lever_m[:, 1]
    y = pose[:, 1, None] + sin * lever_m[:, 0] + cos * lever_m[:, 1]
    return np.stack([x, y], -1)


def compose(pose: Array, local: Array) -> Array:
    """Poses (..., 3) in the outer frame of what is at ``local`` (..., 3) as seen from ``pose``."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    x, y = local[..., 0], local[..., 1]
    return np.stack(
        [
            pose[..., 0] + cos * x - sin * y,
            pose[..., 1] + sin * x + cos * y,
            pose[..., 2] + local[..., 2],
        ],
        -1,
    )


def relative(pose: Array, origin: Array) -> Array:
    """Poses (n, 3) as seen from the pose ``origin`` (3,)."""
    cos, sin = math.cos(origin[2]), math.sin(origin[2])
    dx, dy = pose[:, 0] - origin[0], pose[:, 1] - origin[1]
    return np.column_stack([cos * dx + sin * dy, cos * dy - sin * dx, pose[:, 2] - origin[2]])


def corrections(pose: Array, reference: int, drift: Drift) -> Array:
    """(n, 3, m) what can be wrong with odometry, one standard deviation each.

    Scales and curvature are constant over the way; a random walk is kept as a straight
    line over each unit of effort.
    """
    step = np.diff(pose, axis=0, prepend=pose[:1])
    length = np.hypot(step[:, 0], step[:, 1])
    effort = np.cumsum(length / WAY_M + np.abs(step[:, 2]) / TURN_RAD)
    way, turn = np.cumsum(length), np.cumsum(step[:, 2])
    parts = max(1, math.ceil(effort[-1] - 1e-9))
    unit = max(effort[-1] / parts, 1e-12)
    ramps = np.clip(effort[:, None] / unit - np.arange(parts), 0, 1) * math.sqrt(unit)
    ramps -= ramps[reference]
    zero = np.zeros_like(ramps)
    heading = np.column_stack(
        [
            drift.turn_scale * (turn - turn[reference]),
            drift.curvature_radpm * (way - way[reference]),
            drift.walk_rad * ramps,
        ]
    )
    swung = np.moveaxis(_swung(heading, step, reference), 2, 1)
    stretch = np.column_stack([pose[:, :2] - pose[reference, :2], np.zeros(len(pose))])
    shift = drift.walk_m * ramps
    return np.concatenate(
        [
            drift.scale * stretch[:, :, None],
            swung,
            np.stack([shift, zero, zero], 1),
            np.stack([zero, shift, zero], 1),
        ],
        axis=2,
    )


def bent(pose: Array, steady: Array, drift: Drift) -> Array:
    """Poses (n, 3) of a way with its constant errors taken off, from its first pose on.

    ``steady`` (3,) are scale, turn scale and curvature in standard deviations of ``drift``:
    what the first three columns of :func:`corrections` are to first order, exactly.
    """
    step = np.diff(pose, axis=0, prepend=pose[:1])
    way = np.cumsum(np.hypot(step[:, 0], step[:, 1]))
    turn = pose[:, 2] - pose[0, 2]
    wrong = drift.turn_scale * steady[1] * turn + drift.curvature_radpm * steady[2] * way
    middle = wrong.copy()
    middle[1:] = (wrong[1:] + wrong[:-1]) / 2
    cos, sin = np.cos(middle), np.sin(middle)
    stretch = 1 + drift.scale * steady[0]
    x = np.cumsum(stretch * (cos * step[:, 0] - sin * step[:, 1]))
    y = np.cumsum(stretch * (sin * step[:, 0] + cos * step[:, 1]))
    return np.column_stack([pose[0, 0] + x, pose[0, 1] + y, pose[:, 2] + wrong])


def _swung(heading: Array, step: Array, reference: int) -> Array:
    """(n, m, 3) what errors (n, m) of the heading do to the whole pose: the way swings."""
    middle = heading.copy()
    middle[1:] = (heading[1:] + heading[:-1]) / 2
    x = np.cumsum(-middle * step[:, 1, None], axis=0)
    y = np.cumsum(middle * step[:, 0, None], axis=0)
    return np.stack([x - x[reference], y - y[reference], heading], -1)
