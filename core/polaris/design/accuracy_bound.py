"""Cramer-Rao bound of the pose of a tag: the best accuracy of any unbiased method.

Model: dipoles at one height below a bar of sensors that passes straight over them, white noise, and
an unknown constant offset of each axis of each sensor. The information is that of all samples of
all sensors; nuisance parameters are marginalized (Schur complement).

Fields of the environment are no part of the bound's model, as they are none of the solver's: the
covariance of the errors that they cause in the estimate for white noise is added. The background
of each axis of each sensor is then a polynomial, as the solver fits it if it sees a trend.
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
from locatk.core.polaris.design.environment import QUIET, Environment
from locatk.core.polaris.tag import TagLayout, Tags, cell_positions, symbol_angles

Array = NDArray[np.float64]

NuisanceModel = Literal["magnets", "strength", "speed", "steps"]
"""Unknowns besides positions and angles of the magnets and the offsets of the sensors.

"magnets": none. "strength": the height, and the moment of each magnet. "speed": these, and a
constant speed. "steps": those of "strength", and the length of every step, with the nominal length
and :data:`STEP_SIGMA_M` as a prior."""

STEP_SIGMA_M = 1e-3
"""Standard deviation of a step from one sample to the next: 1.05 to 1.15 mm were measured on the
recordings published with the Polaris paper."""

PASS_MARGIN_CLEARANCES = 4.0
"""Length of the pass before and behind the tag, in clearances."""

BACKGROUND_DEGREE = 4
"""Degree of the background in an environment with varying fields, as of the solver
(:data:`locatk.core.polaris.detection.magnets.DRIFT_TREND_TERMS`)."""

VARYING_MARGIN_CLEARANCES = 8.0
"""Length of the pass before and behind the tag in such an environment, in clearances. The solver
takes all samples with a change above the noise: the field of a magnet, 200 times the noise (default
tag), falls to it within 5.9 clearances (with the cube of the distance), and ten samples more."""

MAX_SAMPLES = 400
"""Largest number of samples of a pass. Denser samples are averaged in groups, which changes the
bounds of the angle and across the track by less than 2 %."""


@dataclass(frozen=True)
class AccuracyBound:
    """Smallest standard deviations, as rms over magnets and layouts.

    Attributes
    ----------
    x_m, y_m, angle_rad : float
        Position and angle of one magnet in the frame of the array; x is along the track.
    pose_x_m, pose_y_m, pose_heading_rad : float
        Pose of the tag, from the positions of its magnets.
    """

    x_m: float
    y_m: float
    angle_rad: float
    pose_x_m: float
    pose_y_m: float
    pose_heading_rad: float


def dipole_gradient(offsets: ArrayLike, moments: ArrayLike) -> Array:
    """Return the derivatives of the field of dipoles with respect to the offset.

    Parameters
    ----------
    offsets : (..., 3) ndarray
        Vectors from the dipole to the sensor, in metres.
    moments : (..., 3) ndarray
        Magnetic moments in A m^2; broadcast against ``offsets``.

    Returns
    -------
    (..., 3, 3) ndarray
        ``[..., i, k]`` is dB_i/dr_k in T/m: symmetric and traceless.

    Notes
    -----
    This is the tensor of third derivatives of 1/r, contracted with the moment.
    """
    r, m = np.broadcast_arrays(np.asarray(offsets, float), np.asarray(moments, float))
    square = np.einsum("...i,...i->...", r, r)
    projection = np.einsum("...i,...i->...", r, m)
    mixed = r[..., :, None] * m[..., None, :]
    gradient = mixed + np.swapaxes(mixed, -1, -2)
    gradient += projection[..., None, None] * np.eye(3)
    outer = r[..., :, None] * r[..., None, :]
    gradient -= (5 * projection / square)[..., None, None] * outer
    return np.asarray(gradient * (3 * MU0_4PI / square**2.5)[..., None, None])


def magnet_covariance(
    tags: Tags,
    layout: TagLayout,
    array: SensorArray,
    *,
    step_m: float,
    heading_rad: float = 0.0,
    offset_m: float = 0.0,
    nuisance: NuisanceModel = "steps",
    environment: Environment = QUIET,
) -> Array:
    """Return the smallest covariance of positions and angles of the magnets in one pass.

    Parameters
    ----------
    tags, layout : Tags, TagLayout
        Magnets, ``tags.clearance_m`` below the bar.
    array : SensorArray
        Sensors with known ``noise_t``; the delays of their axes are ignored.
    step_m : float
        Distance along x from sample to sample. The frame is that of the array at the sample in the
        middle of the pass.
    heading_rad, offset_m : float
        Heading of the tag in this frame, and its distance to the left.
    nuisance : {"magnets", "strength", "speed", "steps"}
        See :data:`NuisanceModel`.
    environment : Environment
        Fields that vary during the pass.

    Returns
    -------
    (3 M, 3 M) ndarray
        Covariance of x, y and angle of the first magnet, of the second, ..., in m and rad, as in
        :attr:`locatk.core.polaris.magnets.DetectedMagnets.covariance`.

    Raises
    ------
    InputError
        The noise is unknown, the step is not positive, or the samples do not determine the
        magnets.
    """
    noise = np.asarray(array.noise_t, float)
    if not (np.isfinite(noise).all() and (noise > 0).all()):
        raise InputError("the noise of the array is unknown", hint="Give its noise")
    if not (step_m > 0 and math.isfinite(step_m)):
        raise InputError(f"a step of {step_m} m from sample to sample is not positive")
    position_m = rotate(cell_positions(tags, layout.cells), heading_rad) + [0.0, offset_m]
    angle_rad = symbol_angles(tags, layout.symbols) + heading_rad
    has_environment = environment.field_t > 0
    margin = VARYING_MARGIN_CLEARANCES if has_environment else PASS_MARGIN_CLEARANCES
    path_m, group = _sample_path(position_m, step_m, margin * tags.clearance_m)
    noise = noise / math.sqrt(group)

    columns, path_column = _derivatives(tags, position_m, angle_rad, array, path_m, nuisance)
    columns, path_column = columns / noise, path_column / noise
    # The background is a linear unknown: removing its part of each sensor's axis marginalizes it.
    remaining = _without_background(path_m, BACKGROUND_DEGREE if has_environment else 0)
    columns = np.einsum("nk,pksi->pnsi", remaining, columns, optimize=True)
    flat = columns.reshape(len(columns), -1)
    information = flat @ flat.T
    if nuisance == "steps":
        gain = _gain_of_steps(columns, path_column, path_m, group, remaining)
        mixed = np.einsum("pnsi,nsi->pn", columns, path_column)
        information -= gain @ mixed.T
        if has_environment:
            by_steps = gain[:, :, None, None] * path_column
            columns = columns - np.einsum("nj,pjsi->pnsi", remaining, by_steps, optimize=True)
    parameters = 3 * len(position_m)
    covariance = _inverse(information)[:parameters]
    result = covariance[:, :parameters]
    if has_environment:
        estimator = np.einsum("pq,qnsi->pnsi", covariance, columns) / noise
        along = environment.path_correlation(path_m)
        across = environment.bar_correlation(array.position_m[:, 1])
        spread = np.einsum("nk,pksi,st->pnti", along, estimator, across, optimize=True)
        result = result + environment.field_t**2 * np.einsum(
            "pnsi,qnsi->pq", spread, estimator, optimize=True
        )
    return np.asarray(result)


def pose_covariance(tags: Tags, layout: TagLayout, covariance: Array, heading_rad: float) -> Array:
    """Return the covariance (3, 3) of the tag's x, y and heading from that of its magnets.

    The pose is the weighted fit of the layout to the positions of the magnets. Their angles would
    add little information, and those of magnets placed by hand are wrong by degrees.

    Raises
    ------
    InputError
        The magnets do not determine a pose.
    """
    position_m = rotate(cell_positions(tags, layout.cells), heading_rad)
    is_position = np.arange(len(covariance)) % 3 < 2
    jacobian = np.zeros((2 * len(position_m), 3))
    jacobian[0::2, 0] = jacobian[1::2, 1] = 1
    jacobian[0::2, 2], jacobian[1::2, 2] = -position_m[:, 1], position_m[:, 0]
    weight = _inverse(covariance[np.ix_(is_position, is_position)])
    return _inverse(jacobian.T @ weight @ jacobian)


def accuracy_bound(
    tags: Tags,
    layouts: Sequence[TagLayout],
    array: SensorArray,
    *,
    step_m: float,
    heading_rad: float = 0.0,
    offset_m: float = 0.0,
    nuisance: NuisanceModel = "steps",
    environment: Environment = QUIET,
    build_m: float = 0.0,
    build_rad: float = 0.0,
) -> AccuracyBound:
    """Return the bound as rms over the magnets of all ``layouts``.

    A magnet below a sensor is measured better than one between two sensors. The layouts are
    therefore distributed evenly over the spacing of the sensors, around ``offset_m``.
    ``build_m`` and ``build_rad`` are standard deviations of the magnets in the tag, along each axis
    and of the angle. The other parameters and the errors are those of :func:`magnet_covariance`.
    """
    spacing_m = float(np.diff(array.position_m[:2, 1])[0]) if len(array) > 1 else 0.0
    count = len(layouts)
    magnets, poses = [], []
    for number, layout in enumerate(layouts):
        covariance = magnet_covariance(
            tags,
            layout,
            array,
            step_m=step_m,
            heading_rad=heading_rad,
            offset_m=offset_m + ((number + 0.5) / count - 0.5) * spacing_m,
            nuisance=nuisance,
            environment=environment,
        )
        built = np.square([build_m, build_m, build_rad])
        covariance = covariance + np.diag(np.tile(built, len(layout.cells)))
        magnets.append(np.diag(covariance).reshape(-1, 3).mean(0))
        poses.append(np.diag(pose_covariance(tags, layout, covariance, heading_rad)))
    variances = np.concatenate([np.mean(magnets, 0), np.mean(poses, 0)])
    return AccuracyBound(*np.sqrt(variances).tolist())


def rotate(points: Array, angle_rad: float) -> Array:
    """Rotate points (n, 2) counter-clockwise about the origin."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _sample_path(position_m: Array, step_m: float, margin_m: float) -> tuple[Array, int]:
    """Return the x of the bar (n,) at each sample, and the number of samples averaged in each.

    One of the samples is at 0, the origin of the frame.
    """
    low, high = position_m[:, 0].min() - margin_m, position_m[:, 0].max() + margin_m
    group = max(1, math.ceil((high - low) / step_m / MAX_SAMPLES))
    step = step_m * group
    return np.arange(math.floor(low / step), math.ceil(high / step) + 1) * step, group


def _derivatives(
    tags: Tags,
    position_m: Array,
    angle_rad: Array,
    array: SensorArray,
    path_m: Array,
    nuisance: NuisanceModel,
) -> tuple[Array, Array]:
    """Return the derivatives of all samples of n positions of the bar and N sensors.

    Returns
    -------
    (p, n, N, 3) ndarray
        Derivatives with respect to x, y and angle of each magnet and to the nuisance parameters.
    (n, N, 3) ndarray
        Derivatives with respect to the position of the bar at the sample.
    """
    sensors = array.position_m[None, :, :] + path_m[:, None, None] * [1.0, 0.0, 0.0]
    source = np.column_stack([position_m, np.full(len(position_m), -tags.clearance_m)])
    offset = sensors[None] - source[:, None, None, :]
    cos, sin, zero = np.cos(angle_rad), np.sin(angle_rad), 0 * angle_rad
    direction, normal = np.column_stack([cos, sin, zero]), np.column_stack([-sin, cos, zero])
    moment = tags.magnet.moment
    gradient = dipole_gradient(offset, moment * direction[:, None, None, :])
    tensor = dipole_tensor(offset)
    by_angle = np.einsum("mnsij,mj->mnsi", tensor, moment * normal)
    by_magnet = np.stack([-gradient[..., 0], -gradient[..., 1], by_angle], 1)
    by_path = gradient[..., 0].sum(0)
    columns = [by_magnet.reshape(-1, *by_magnet.shape[2:])]
    if nuisance != "magnets":
        by_relative_moment = np.einsum("mnsij,mj->mnsi", tensor, moment * direction)
        by_height = gradient[..., 2].sum(0)[None]
        columns += [by_relative_moment, by_height]
    if nuisance == "speed":
        columns += [(path_m[:, None, None] * by_path)[None]]
    return np.concatenate(columns), by_path


def _without_background(path_m: Array, degree: int) -> Array:
    """Return the projection (n, n) that removes polynomials along the path from samples."""
    columns = np.linalg.qr(np.vander(path_m / np.ptp(path_m), degree + 1))[0]
    return np.asarray(np.eye(len(path_m)) - columns @ columns.T)


def _gain_of_steps(
    columns: Array, path_column: Array, path_m: Array, group: int, remaining: Array
) -> Array:
    """Return the estimate (p, n) of the positions of the bar from each column, if steps are free.

    The position of the bar at a sample affects that sample only. The information of the positions
    is therefore diagonal, except for the marginalized background. The prior of the steps, a random
    walk, is added.
    """
    n = len(path_m)
    flat = path_column.reshape(n, -1)
    block = remaining * (flat @ flat.T)
    step_prior = np.diff(np.eye(n), axis=0) / (STEP_SIGMA_M * math.sqrt(group))
    block += step_prior.T @ step_prior
    mixed = np.einsum("pnsi,nsi->pn", columns, path_column)
    # The position at path 0 is not an unknown, because it defines the frame.
    is_unknown = path_m != 0
    gain = np.zeros((len(columns), n))
    try:
        gain[:, is_unknown] = np.linalg.solve(
            block[np.ix_(is_unknown, is_unknown)], mixed[:, is_unknown].T
        ).T
    except np.linalg.LinAlgError:
        raise InputError("the samples do not determine the magnets") from None
    return gain


def _inverse(information: Array) -> Array:
    """Invert a positive definite matrix of unknowns with different units.

    Raises
    ------
    InputError
        The matrix is singular.
    """
    scale = np.sqrt(np.diag(information))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise InputError("the samples do not determine the magnets")
    scaled = information / np.outer(scale, scale)
    try:
        np.linalg.cholesky(scaled)
        return np.asarray(np.linalg.inv(scaled) / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        raise InputError("the samples do not determine the magnets") from None
