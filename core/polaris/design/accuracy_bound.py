"""Cramer-Rao bound: how well a tag can be measured at best, by any method.

Model: dipoles at one height, a bar that passes straight over them, white noise, and a
constant offset of each axis of each sensor that nobody knows. The information is that of
all samples of all sensors; what is not asked for is marginalised (Schur complement).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from locatk.core.errors import InputError
from locatk.core.magnetics import MU0_4PI, dipole_tensor
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.tag import TagLayout, Tags, cell_positions, symbol_angles

Array = NDArray[np.float64]

Unknown = Literal["magnets", "strength", "speed", "steps"]
"""What is unknown besides places, angles and offsets, each with what precedes it: nothing;
the height and each magnet's moment; a constant speed; the length of every step, of which
the nominal one and :data:`STEP_SIGMA_M` are known."""

UNKNOWNS: tuple[Unknown, ...] = ("magnets", "strength", "speed", "steps")

STEP_SIGMA_M = 1e-3
"""Standard deviation of a step from one sample to the next, as in the published runs."""

MARGIN = 4.0
"""The bar passes from this many clearances before the tag to as many behind it."""

MOST_SAMPLES = 400
"""More of them are taken together by threes, fours, ...: a bound does not feel that."""


@dataclass(frozen=True)
class Bound:
    """Standard deviations (rms over magnets and layouts), in metres and radians.

    ``x``, ``y`` and ``angle`` are those of one magnet in the array's frame (x along the
    track), ``pose_*`` those of the tag, from the places of its magnets.
    """

    x_m: float
    y_m: float
    angle_rad: float
    pose_x_m: float
    pose_y_m: float
    pose_heading_rad: float


def dipole_gradient(offsets: ArrayLike, moments: ArrayLike) -> Array:
    """Derivatives of a dipole's field with respect to the offset.

    Parameters
    ----------
    offsets : (..., 3) ndarray
        From dipole to sensor, in metres.
    moments : (..., 3) ndarray
        In A m^2; broadcast against ``offsets``.

    Returns
    -------
    (..., 3, 3) ndarray
        ``[..., i, k]`` is dB_i/dr_k in T/m: symmetric and traceless.

    Notes
    -----
    The tensor of third derivatives of 1/r, contracted with the moment.
    """
    r, m = np.broadcast_arrays(np.asarray(offsets, float), np.asarray(moments, float))
    square = np.einsum("...i,...i->...", r, r)
    along = np.einsum("...i,...i->...", r, m)
    mixed = r[..., :, None] * m[..., None, :]
    gradient = mixed + np.swapaxes(mixed, -1, -2)
    gradient += along[..., None, None] * np.eye(3)
    outer = r[..., :, None] * r[..., None, :]
    gradient -= (5 * along / square)[..., None, None] * outer
    return np.asarray(gradient * (3 * MU0_4PI / square**2.5)[..., None, None])


def magnet_covariance(
    tags: Tags,
    layout: TagLayout,
    array: SensorArray,
    *,
    step_m: float,
    heading_rad: float = 0.0,
    offset_m: float = 0.0,
    unknown: Unknown = "steps",
) -> Array:
    """Smallest covariance of the magnets' places and angles in one pass.

    Parameters
    ----------
    tags, layout : Tags, Layout
        The magnets, at ``tags.clearance_m`` below the bar.
    array : SensorArray
        Its ``noise_t`` must be known; the delays of its axes do not matter here.
    step_m : float
        Of the bar along its x from sample to sample. The array's frame is that of the
        sample in the middle of the pass.
    heading_rad, offset_m : float
        Of the tag in the array's frame, and how far to its left.
    unknown : {"magnets", "strength", "speed", "steps"}
        See :data:`Unknown`.

    Returns
    -------
    (3 M, 3 M) ndarray
        Of x, y, angle of the first magnet, of the second, ..., in m and rad, as in
        :attr:`locatk.core.polaris.magnets.DetectedMagnets.covariance`.

    Raises
    ------
    InputError
        The noise is not known, the step is not positive, or the samples do not determine
        the magnets.
    """
    noise = np.asarray(array.noise_t, float)
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise InputError("the noise of the array is not known", hint="Give its noise")
    if not (step_m > 0 and math.isfinite(step_m)):
        raise InputError(f"a step of {step_m} m from sample to sample is no pass")
    place = turn(cell_positions(tags, layout.cells), heading_rad) + [0.0, offset_m]
    angle = symbol_angles(tags, layout.symbols) + heading_rad
    path, merged = _path(place, step_m, MARGIN * tags.clearance_m)
    noise = noise / math.sqrt(merged)

    columns, travel = _derivatives(tags, place, angle, array, path, unknown)
    columns, travel = columns / noise, travel / noise
    # Offsets are linear: to marginalise them is to take the mean off, sensor by sensor.
    columns = columns - columns.mean(1, keepdims=True)
    flat = columns.reshape(len(columns), -1)
    information = flat @ flat.T
    if unknown == "steps":
        information -= _lost_to_steps(columns, travel, path, merged)
    wanted = 3 * len(place)
    return _inverse(information)[:wanted, :wanted]


def pose_covariance(tags: Tags, layout: TagLayout, covariance: Array, heading_rad: float) -> Array:
    """Covariance (3, 3) of the tag's x, y, heading from that of its magnets.

    The weighted fit of the layout to the magnets' places. Their angles would add little,
    and hand-placed ones mislead (they are off by degrees).

    Raises
    ------
    InputError
        The magnets do not determine a pose.
    """
    place = turn(cell_positions(tags, layout.cells), heading_rad)
    keep = np.arange(len(covariance)) % 3 < 2
    slope = np.zeros((2 * len(place), 3))
    slope[0::2, 0] = slope[1::2, 1] = 1
    slope[0::2, 2], slope[1::2, 2] = -place[:, 1], place[:, 0]
    weight = _inverse(covariance[np.ix_(keep, keep)])
    return _inverse(slope.T @ weight @ slope)


def bound(
    tags: Tags,
    layouts: Sequence[TagLayout],
    array: SensorArray,
    *,
    step_m: float,
    heading_rad: float = 0.0,
    offset_m: float = 0.0,
    unknown: Unknown = "steps",
) -> Bound:
    """The bound, rms over the magnets of all ``layouts``.

    Under a sensor a magnet is known better than between two, so the layouts are spread
    evenly over the sensors' spacing, about ``offset_m``; a single one passes there. Else
    parameters and errors are those of :func:`magnet_covariance`.
    """
    between = float(np.diff(array.position_m[:2, 1])[0]) if len(array) > 1 else 0.0
    count = len(layouts)
    magnets, poses = [], []
    for number, layout in enumerate(layouts):
        covariance = magnet_covariance(
            tags,
            layout,
            array,
            step_m=step_m,
            heading_rad=heading_rad,
            offset_m=offset_m + ((number + 0.5) / count - 0.5) * between,
            unknown=unknown,
        )
        magnets.append(np.diag(covariance).reshape(-1, 3).mean(0))
        poses.append(np.diag(pose_covariance(tags, layout, covariance, heading_rad)))
    return Bound(*np.sqrt(np.concatenate([np.mean(magnets, 0), np.mean(poses, 0)])).tolist())


def turn(points: Array, angle_rad: float) -> Array:
    """Points (n, 2) turned counter-clockwise."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _path(place: Array, step_m: float, margin_m: float) -> tuple[Array, int]:
    """Where the bar is at each sample, 0 in the middle, and how many samples one stands for."""
    low, high = place[:, 0].min() - margin_m, place[:, 0].max() + margin_m
    merged = max(1, math.ceil((high - low) / step_m / MOST_SAMPLES))
    step = step_m * merged
    return np.arange(math.floor(low / step), math.ceil(high / step) + 1) * step, merged


def _derivatives(
    tags: Tags, place: Array, angle: Array, array: SensorArray, path: Array, unknown: Unknown
) -> tuple[Array, Array]:
    """Derivatives of all samples (n, N, 3).

    Returns (p, n, N, 3) with respect to x, y, angle of each magnet and whatever else is
    unknown, and (n, N, 3) with respect to the bar's way at the sample.
    """
    sensors = array.position_m[None, :, :] + path[:, None, None] * [1.0, 0.0, 0.0]
    source = np.column_stack([place, np.full(len(place), -tags.clearance_m)])
    offset = sensors[None] - source[:, None, None, :]
    direction = np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
    across = np.column_stack([-np.sin(angle), np.cos(angle), 0 * angle])
    moment = tags.magnet.moment
    slope = dipole_gradient(offset, moment * direction[:, None, None, :])
    tensor = dipole_tensor(offset)
    turned = np.einsum("mnsij,mj->mnsi", tensor, moment * across)
    own = np.stack([-slope[..., 0], -slope[..., 1], turned], 1)
    travel = slope[..., 0].sum(0)
    columns = [own.reshape(-1, *own.shape[2:])]
    if unknown != "magnets":
        columns += [np.einsum("mnsij,mj->mnsi", tensor, moment * direction)]  # relative moment
        columns += [slope[..., 2].sum(0)[None]]
    if unknown == "speed":
        columns += [(path[:, None, None] * travel)[None]]
    return np.concatenate(columns), travel


def _lost_to_steps(columns: Array, travel: Array, path: Array, merged: int) -> Array:
    """Information that is lost where every step of the way is unknown.

    The way at sample k is only felt by sample k: but for the offsets' share the block of
    the ways is diagonal. To it comes what is known of the steps, a random walk.
    """
    n = len(path)
    flat = travel.reshape(n, -1)
    block = np.diag((flat * flat).sum(1)) - flat @ flat.T / n
    walk = np.diff(np.eye(n), axis=0) / (STEP_SIGMA_M * math.sqrt(merged))
    block += walk.T @ walk
    mixed = np.einsum("pnsi,nsi->pn", columns, travel)
    moving = path != 0  # the frame of the answer is the bar's at path 0
    block, mixed = block[np.ix_(moving, moving)], mixed[:, moving]
    return np.asarray(mixed @ np.linalg.solve(block, mixed.T))


def _inverse(information: Array) -> Array:
    """Inverse of a positive definite matrix whose unknowns have different units."""
    scale = np.sqrt(np.diag(information))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise InputError("the samples do not determine the magnets")
    scaled = information / np.outer(scale, scale)
    try:
        np.linalg.cholesky(scaled)
    except np.linalg.LinAlgError:
        raise InputError("the samples do not determine the magnets") from None
    return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
