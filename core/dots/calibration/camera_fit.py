"""Fit of a camera to dots whose positions on a flat sheet are known.

Two models of a frame:

:class:`HomographyModel`
    Each frame is any homography of the sheet. Only the lens can bend straight lines then, so that
    its centre and k are estimated without the focal length, whether frames are tilted or not.
:class:`PoseModel`
    Each frame is a pose over the sheet. Perspective depends on the ratio of tilt and focal length,
    and the shortening along the tilt on the tilt alone, so that sufficiently tilted frames
    determine the focal length.

Unknowns are five parameters of the camera, shared by all frames, and the parameters of each frame;
:mod:`locatk.core.least_squares` eliminates the latter. Residuals are distances in the frame.
The weights of a frame follow from the scatter of its dots, and those of single dots from Tukey's
biweight, which rejects outliers; both are updated between fits.

Lengths in a frame are in half its diagonal, from its middle; lengths on the sheet have any unit and
origin, x right and y *down*.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.geometry import rotation_exp, skew
from locatk.core.least_squares import Indices, SchurEquations, SchurStep, minimize
from locatk.core.robust import robust_sigma

Array = NDArray[np.float64]

CAMERA_PARAMETERS = 5
CENTRE, RADIAL, LOG_FOCAL, ASPECT = slice(0, 2), 2, 3, 4
"""Parameters of the camera: centre (two), k, logarithm of the focal length, and the sheet's scale
along x over that along y, minus 1."""

CENTRE_PRIOR_SIGMA = 0.1
"""Prior standard deviation of the centre of a lens [half diagonals]."""

RADIAL_PRIOR_SIGMA = 1.0
"""Prior standard deviation of k in half diagonals: with 1, a dot seen at half a diagonal is at half
that distance without the distortion."""

LOG_FOCAL_PRIOR_SIGMA = 1.5
"""Prior standard deviation of the logarithm of the focal length: a factor of 4.5."""

ASPECT_PRIOR_SIGMA = 0.02
"""Prior standard deviation of a sheet's aspect. The templates of ronyeh/papertoolkit correct the
scale of printers by up to 1.2 %."""

INITIAL_SIGMA_PX = 0.05
"""Standard deviation of a dot [px] before it is estimated."""

BIWEIGHT_SIGMAS = 4.685
"""Distance in standard deviations from which a dot has no weight: Tukey's biweight with 95 %
efficiency for normal errors."""

MIN_RELATIVE_SCATTER = 0.3
"""Least scatter of a frame's dots that is used, relative to the median of all frames."""

INVISIBLE_RESIDUAL = 1.0
"""Residual, per axis, of dots that the lens does not show at all [half diagonals]: an outlier."""

MIN_SCATTER = 1e-9
"""Least scatter that is used [half diagonals], for frames without any error."""

FRAME_PARAMETERS = 8
"""Parameters that the dots of a frame determine, in the number of degrees of freedom."""

REWEIGHTED_FITS = 4
"""Number of fits, each with the weights from the previous one."""

INITIAL_DAMPING = 1e-6
MIN_GAIN = 1e-9
MAX_ITERATIONS = 30
"""Settings of each fit: initial damping, relative gain at convergence, largest number of steps."""


@dataclass(frozen=True)
class CalibrationViews:
    """Dots of n frames of one camera, at most m in each.

    Attributes
    ----------
    size : (width, height)
        Of a frame in px.
    pixels : (n, m, 2) float64 ndarray
        Observed positions in px.
    plane : (n, m, 2) float64 ndarray
        Positions on the sheet, x right and y *down*, in any unit, from any origin.
    valid : (n, m) bool ndarray
        Whether there is such a dot.
    """

    size: tuple[int, int]
    pixels: Array
    plane: Array
    valid: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.valid)

    @property
    def middle(self) -> Array:
        """Middle of the frame (2,) in px."""
        return (np.array(self.size) - 1) / 2

    @property
    def half_diagonal(self) -> float:
        """Half the diagonal of the frame in px."""
        return math.hypot(*self.size) / 2


@dataclass(frozen=True)
class CameraFit:
    """Result of a fit, in px; nan for parameters that were not estimated.

    Attributes
    ----------
    centre : (2,) ndarray
    radial : float
        k in px^-2.
    focal : float
    aspect : float
        The sheet's scale along x over that along y, minus 1.
    sigma : (5,) ndarray
        Standard deviations of centre (two), k, focal length and aspect.
    tilt : (n,) ndarray
        Of each frame, in rad.
    frames : (n, q) ndarray
        Homographies or poses.
    distance : (n, m) ndarray
        Of each dot from its predicted position.
    used : (n, m) bool ndarray
        Dots that were not rejected as outliers.
    """

    centre: Array
    radial: float
    focal: float
    aspect: float
    sigma: Array
    tilt: Array
    frames: Array
    distance: Array
    used: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Root mean square distance of the dots that were used, in px."""
        return float(np.sqrt(np.mean(self.distance[self.used] ** 2)))


# ---- fits


def fit_without_lens(views: CalibrationViews) -> CameraFit:
    """Fit homographies without any distortion, for comparison."""
    return _fit(views, HomographyModel(), np.zeros(CAMERA_PARAMETERS), homographies(views), [])


def fit_homographies(views: CalibrationViews, *, fix_centre: bool = False) -> CameraFit:
    """Estimate centre and k of the lens, whatever the focal length.

    Parameters
    ----------
    views : CalibrationViews
        At least four dots in each frame, not all on a line.
    fix_centre : bool
        Keep the centre in the middle of the frame.
    """
    free = [RADIAL] if fix_centre else [0, 1, RADIAL]
    return _fit(views, HomographyModel(), np.zeros(CAMERA_PARAMETERS), homographies(views), free)


def fit_poses(
    views: CalibrationViews, start: CameraFit, usual_focal: float, *, fix_centre: bool = False
) -> CameraFit:
    """Estimate centre, k and focal length; the standard deviation shows whether it is determined.

    Parameters
    ----------
    views : CalibrationViews
    start : CameraFit
        Result of :func:`fit_homographies`.
    usual_focal : float
        Mean of the prior of the focal length, in px.
    fix_centre : bool
        Keep the centre in the middle of the frame.
    """
    half = views.half_diagonal
    usual = math.log(usual_focal / half)
    camera = np.zeros(CAMERA_PARAMETERS)
    if not fix_centre:
        camera[CENTRE] = (start.centre - views.middle) / half
    camera[RADIAL] = start.radial * half**2
    focal = focal_of_homographies(start.frames)
    is_plausible = focal > 0 and abs(math.log(focal) - usual) < LOG_FOCAL_PRIOR_SIGMA
    camera[LOG_FOCAL] = math.log(focal) if is_plausible else usual
    frames = poses_of_homographies(start.frames, math.exp(camera[LOG_FOCAL]))
    free = [RADIAL, LOG_FOCAL, ASPECT] if fix_centre else [0, 1, RADIAL, LOG_FOCAL, ASPECT]
    return _fit(views, PoseModel(), camera, frames, free, usual)


def homographies(views: CalibrationViews) -> Array:
    """Return homographies (n, 8) by linear least squares, in half diagonals, without a lens."""
    frame, plane = normalize_views(views)
    return _linear_homographies(frame, plane, views.valid)


def _fit(
    views: CalibrationViews,
    model: FrameModel,
    camera: Array,
    frames: Array,
    free: list[int],
    usual_log_focal: float = 0.0,
) -> CameraFit:
    """Fit a model with the ``free`` parameters of the camera, and estimate the weights."""
    half = views.half_diagonal
    observed, plane = normalize_views(views)
    is_free = np.isin(np.arange(CAMERA_PARAMETERS), free)
    prior_mean = np.array([0.0, 0.0, 0.0, usual_log_focal, 0.0])
    state = CameraState(camera, frames)
    weights = views.valid * (INITIAL_SIGMA_PX / half) ** -2.0
    initial = CameraProblem(model, observed, plane, views.valid, weights, is_free, prior_mean)
    if not np.isfinite(initial.frame_equations(state).cost):
        raise DegenerateError(
            "no lens of this kind shows such frames: some dots would be beyond its fold",
            hint="Is the sheet flat? Are the frames whole, neither cropped nor scaled?",
        )
    for _ in range(REWEIGHTED_FITS):
        problem = CameraProblem(model, observed, plane, views.valid, weights, is_free, prior_mean)
        minimum = minimize(
            problem,
            state,
            damping=INITIAL_DAMPING,
            max_iterations=MAX_ITERATIONS,
            min_gain=MIN_GAIN,
        )
        state, residual = minimum.state, minimum.equations.residual
        weights = _estimate_weights(residual, views.valid)
    sigma = np.full(CAMERA_PARAMETERS, np.nan)
    final = CameraProblem(model, observed, plane, views.valid, weights, is_free, prior_mean)
    sigma[is_free] = final.camera_sigma(state)
    focal = half * math.exp(state.camera[LOG_FOCAL]) if is_free[LOG_FOCAL] else math.nan
    return CameraFit(
        centre=views.middle + half * state.camera[CENTRE],
        radial=float(state.camera[RADIAL]) / half**2,
        focal=focal,
        aspect=float(state.camera[ASPECT]) if is_free[ASPECT] else math.nan,
        sigma=sigma * np.array([half, half, half**-2.0, focal, 1.0]),
        tilt=model.tilts(state.frames),
        frames=state.frames,
        distance=half * np.linalg.norm(residual, axis=2),
        used=weights > 0,
    )


def normalize_views(views: CalibrationViews) -> tuple[Array, Array]:
    """Return the dots in the frame and on the sheet (n, m, 2), 0 for missing dots.

    In the frame they are in half diagonals from the middle; on the sheet from the mean of each
    frame's dots, in units of about the size of a frame.
    """
    valid = views.valid[..., None]
    frame = np.where(valid, (views.pixels - views.middle) / views.half_diagonal, 0)
    plane, count = np.where(valid, views.plane, 0), valid.sum(axis=1, keepdims=True)
    plane = (plane - plane.sum(axis=1, keepdims=True) / count) * valid
    return frame, plane / math.sqrt((plane * plane).sum() / count.sum())


def _estimate_weights(residual: Array, valid: NDArray[np.bool_]) -> Array:
    """Return weights (n, m): the frame's inverse variance times the biweight of the dot."""
    pairs = zip(residual, valid, strict=True)
    sigma = np.array([robust_sigma(one[exists]) for one, exists in pairs])
    count = 2 * valid.sum(axis=1)
    sigma *= np.sqrt(count / np.maximum(count - FRAME_PARAMETERS, 1))
    least = max(MIN_RELATIVE_SCATTER * float(np.median(sigma)), MIN_SCATTER)
    sigma = np.maximum(sigma, least)[:, None]
    ratio = np.linalg.norm(residual, axis=2) / (math.sqrt(2) * BIWEIGHT_SIGMAS * sigma)
    result: Array = np.square(np.clip(1 - ratio * ratio, 0, None)) * valid / sigma**2
    return result


# ---- least-squares problem


@dataclass(frozen=True)
class CameraState:
    """Unknowns of the fit: parameters of the camera (5,) and of the frames (n, q)."""

    camera: Array
    frames: Array


@dataclass(frozen=True)
class FrameEquations:
    """Normal equations of each of n frames, with s = 5 parameters of the camera and q of its own.

    Attributes
    ----------
    hessian, gradient : (n, s, s) and (n, s) ndarray
    block_hessian, block_gradient : (n, q, q) and (n, q) ndarray
    coupling : (n, s, q) ndarray
    cost : float
        Half the weighted sum of squares; infinite if the lens cannot show a dot that has weight.
    residual : (n, m, 2) ndarray
        Predicted minus observed; 0 for missing dots, :data:`INVISIBLE_RESIDUAL` for dots that the
        lens does not show.
    """

    hessian: Array
    gradient: Array
    block_hessian: Array
    block_gradient: Array
    coupling: Array
    cost: float
    residual: Array


@dataclass(frozen=True)
class CameraProblem:
    """Fit of a camera as a problem for :func:`~locatk.core.least_squares.minimize`.

    Attributes
    ----------
    model : FrameModel
    observed, plane : (n, m, 2) ndarray
        Dots in the frame and on the sheet.
    valid : (n, m) bool ndarray
        Whether there is such a dot.
    weights : (n, m) ndarray
        Inverse variances; 0 for missing dots and for outliers.
    free : (5,) bool ndarray
        Parameters of the camera that are estimated.
    prior_mean : (5,) ndarray
    """

    model: FrameModel
    observed: Array
    plane: Array
    valid: NDArray[np.bool_]
    weights: Array
    free: NDArray[np.bool_]
    prior_mean: Array

    @property
    def prior_weight(self) -> Array:
        """Inverse prior variances (5,)."""
        sigma = np.array([
            CENTRE_PRIOR_SIGMA,
            CENTRE_PRIOR_SIGMA,
            RADIAL_PRIOR_SIGMA,
            LOG_FOCAL_PRIOR_SIGMA,
            ASPECT_PRIOR_SIGMA,
        ])  # fmt: skip
        result: Array = np.where(self.free, sigma**-2.0, 0.0)
        return result

    def linearize(self, state: CameraState, _: Indices) -> SchurEquations:
        frames = self.frame_equations(state)
        deviation = state.camera - self.prior_mean
        prior = self.prior_weight
        return SchurEquations(
            cost=np.array([frames.cost + 0.5 * float(prior @ deviation**2)]),
            hessian=frames.hessian.sum(axis=0) + np.diag(prior),
            gradient=frames.gradient.sum(axis=0) + prior * deviation,
            block_hessian=frames.block_hessian,
            block_gradient=frames.block_gradient,
            coupling=frames.coupling,
            free=self.free,
            gauge=np.zeros((CAMERA_PARAMETERS, 0)),
            residual=frames.residual,
        )

    def retract(self, state: CameraState, step: SchurStep) -> CameraState:
        return CameraState(
            state.camera + step.shared, self.model.retract(state.frames, step.blocks)
        )

    def frame_equations(self, state: CameraState) -> FrameEquations:
        """Return the normal equations of the frames, without the prior."""
        predicted, by_frame, by_camera = project(self.model, state.camera, state.frames, self.plane)
        is_visible = np.asarray(np.isfinite(predicted).all(axis=2))
        residual = np.where(is_visible[..., None], predicted - self.observed, INVISIBLE_RESIDUAL)
        residual = np.where(self.valid[..., None], residual, 0)
        root = np.sqrt(self.weights)[..., None, None]
        table = np.concatenate([by_camera, by_frame, residual[..., None]], axis=3) * root
        if not is_visible.all():
            table = np.where(is_visible[..., None, None], table, 0.0)
        is_possible = is_visible[self.weights > 0].all()
        table = table.reshape(len(table), -1, table.shape[3])
        gram = table.transpose(0, 2, 1) @ table
        s = CAMERA_PARAMETERS
        cost = 0.5 * float(gram[:, -1, -1].sum()) if is_possible else math.inf
        return FrameEquations(
            hessian=gram[:, :s, :s],
            gradient=gram[:, :s, -1],
            block_hessian=gram[:, s:-1, s:-1],
            block_gradient=gram[:, s:-1, -1],
            coupling=gram[:, :s, s:-1],
            cost=cost,
            residual=residual,
        )

    def camera_sigma(self, state: CameraState) -> Array:
        """Return the standard deviations of the free parameters of the camera.

        They are the larger ones of those from the scatter of the dots and those from the
        disagreement of the frames (the sandwich estimator of White and Huber, clustered by frame):
        the errors of a frame's dots are correlated if the paper is not flat.
        """
        frames = self.frame_equations(state)
        eliminated = np.linalg.solve(frames.block_hessian, frames.coupling.transpose(0, 2, 1))
        reduced = frames.hessian - frames.coupling @ eliminated
        score = frames.gradient - np.einsum("nqs,nq->ns", eliminated, frames.block_gradient)
        n, free = len(reduced), self.free
        information = reduced.sum(axis=0) + np.diag(self.prior_weight)
        covariance = np.linalg.inv(information[np.ix_(free, free)])
        influence = score[:, free] @ covariance
        clustered = (influence * influence).sum(axis=0) * n / max(n - int(free.sum()), 1)
        result: Array = np.sqrt(np.maximum(np.diag(covariance), clustered))
        return result


# ---- models of a frame


class FrameModel(Protocol):
    """Parameters (n, q) of frames, and the projection of the sheet that follows from them."""

    def flat(self, camera: Array, frames: Array, plane: Array) -> tuple[Array, Array, Array]:
        """Project positions on the sheet without distortion, relative to the centre.

        Parameters
        ----------
        camera : (5,) ndarray
        frames : (n, q) ndarray
        plane : (n, m, 2) ndarray

        Returns
        -------
        points : (n, m, 2) ndarray
        by_frame : (n, m, 2, p) ndarray
            Derivatives by the steps of :meth:`retract`.
        by_shape : (n, m, 2, 2) ndarray
            Derivatives by the logarithm of the focal length and by the aspect.
        """

    def retract(self, frames: Array, step: Array) -> Array:
        """Return the parameters after steps (n, p)."""

    def tilts(self, frames: Array) -> Array:
        """Return the tilt (n,) of each frame in rad; nan if the model has none."""


class HomographyModel:
    """Frames of eight numbers: (a x + b y + c) / (1 + g x + h y), (d x + e y + f) / (same)."""

    def flat(self, camera: Array, frames: Array, plane: Array) -> tuple[Array, Array, Array]:
        depth = 1 + plane @ frames[:, 6:, None]
        rays = np.concatenate([plane, np.ones_like(depth)], axis=2) / depth
        points = rays @ frames[:, :6].reshape(-1, 2, 3).transpose(0, 2, 1)
        by_frame = np.zeros((*points.shape, 8))
        by_frame[..., 0, 0:3] = by_frame[..., 1, 3:6] = rays
        by_frame[..., 6:] = -points[..., :, None] * rays[..., None, :2]
        return points, by_frame, np.zeros((*points.shape, 2))

    def retract(self, frames: Array, step: Array) -> Array:
        return frames + step

    def tilts(self, frames: Array) -> Array:
        return np.full(len(frames), np.nan)


class PoseModel:
    """Frames of a rotation (nine numbers), a shift (two) and a scale, sheet over frame.

    The scale times the focal length is the distance: so the focal length affects the perspective
    only, and an untilted frame does not depend on it.
    """

    def flat(self, camera: Array, frames: Array, plane: Array) -> tuple[Array, Array, Array]:
        inverse_focal = math.exp(-camera[LOG_FOCAL])
        axes = frames[:, :9].reshape(-1, 3, 3)[:, :, :2].transpose(0, 2, 1)
        stretch = np.array([0.5, -0.5])
        rotated = (plane * (1 + camera[ASPECT] * stretch)) @ axes
        by_aspect = (plane * stretch) @ axes
        depth = frames[:, None, 11:] + inverse_focal * rotated[..., 2:]
        points = (rotated[..., :2] + frames[:, None, 9:11]) / depth

        def chain(by_rotated: Array) -> Array:
            """Return derivatives (..., 2, p) of ``points`` from those of ``rotated``."""
            by_depth = points[..., None] * (inverse_focal * by_rotated[..., 2:, :])
            result: Array = (by_rotated[..., :2, :] - by_depth) / depth[..., None]
            return result

        by_frame = np.zeros((*points.shape, 6))
        by_frame[..., :3] = chain(-skew(rotated))
        by_frame[..., 0, 3] = by_frame[..., 1, 4] = 1 / depth[..., 0]
        by_frame[..., 5] = -points / depth
        by_focal = points * (inverse_focal * rotated[..., 2:]) / depth
        by_shape = np.stack([by_focal, chain(by_aspect[..., None])[..., 0]], axis=3)
        return points, by_frame, by_shape

    def retract(self, frames: Array, step: Array) -> Array:
        rotation = rotation_exp(step[:, :3]) @ frames[:, :9].reshape(-1, 3, 3)
        return np.concatenate([rotation.reshape(-1, 9), frames[:, 9:] + step[:, 3:]], axis=1)

    def tilts(self, frames: Array) -> Array:
        # Between the optical axis and the sheet's normal.
        result: Array = np.arctan2(np.hypot(frames[:, 6], frames[:, 7]), np.abs(frames[:, 8]))
        return result


def project(
    model: FrameModel, camera: Array, frames: Array, plane: Array
) -> tuple[Array, Array, Array]:
    """Return the points (n, m, 2) in frames with distortion, and their derivatives.

    The derivatives are (n, m, 2, p) by the frame's parameters and (n, m, 2, 5) by those of the
    camera. Points that the lens does not show are nan.
    """
    points, by_frame, by_shape = model.flat(camera, frames, plane)
    squared = (points * points).sum(axis=2, keepdims=True)
    # r = u D(k u^2) with D(x) = 2 / (1 + sqrt(1 - 4 x)) inverts u = r / (1 + k r^2).
    with np.errstate(invalid="ignore", divide="ignore"):
        root = np.sqrt(1 - 4 * camera[RADIAL] * squared)
        factor = 2 / (1 + root)
        slope = factor * factor / root
    by_points = 2 * camera[RADIAL] * slope[..., None] * points[..., :, None] * points[..., None, :]
    by_points += factor[..., None] * np.eye(2)
    by_camera = np.zeros((*points.shape, CAMERA_PARAMETERS))
    by_camera[..., CENTRE] = np.eye(2)
    by_camera[..., RADIAL] = points * slope * squared
    by_camera[..., LOG_FOCAL:] = by_points @ by_shape
    return camera[CENTRE] + points * factor, by_points @ by_frame, by_camera


# ---- initial guesses


def _linear_homographies(frame: Array, plane: Array, valid: NDArray[np.bool_]) -> Array:
    """Return homographies (n, 8) of dots (n, m, 2) by linear least squares."""
    x, y = plane[..., :1], plane[..., 1:]
    rays = np.concatenate([x, y, np.ones_like(x)], axis=2)
    rows = []
    for axis in (0, 1):
        coordinate = frame[..., axis : axis + 1]
        blocks = [np.zeros_like(rays), np.zeros_like(rays)]
        blocks[axis] = rays
        rows.append(np.concatenate([*blocks, -coordinate * rays[..., :2], coordinate], axis=2))
    table = np.concatenate(rows, axis=1) * np.tile(valid, (1, 2))[..., None]
    gram = table.transpose(0, 2, 1) @ table
    result: Array = np.linalg.solve(gram[:, :8, :8], gram[:, :8, 8:])[..., 0]
    return result


def focal_of_homographies(frames: Array) -> float:
    """Return the focal length for which homographies (n, 8) are best rotations; nan if none.

    There are two constraints per frame, linear in the square of the focal length and in the aspect
    of the sheet (Zhang, IEEE PAMI 22 (2000) 1330, Eqs. 3 and 4).
    """
    first, second = frames[:, [0, 3]], frames[:, [1, 4]]
    g, h = frames[:, 6], frames[:, 7]
    size = (first * first + second * second).sum(axis=1) / 2
    constant = [(first * second).sum(axis=1), (first**2 - second**2).sum(axis=1)]
    by_focal_squared = [g * h, g * g - h * h]
    by_aspect = [np.zeros_like(size), -2 * size]
    table = np.stack([np.concatenate(by_focal_squared), np.concatenate(by_aspect)], axis=1)
    weight = np.tile(1 / size, 2)
    solution, *_ = np.linalg.lstsq(table * weight[:, None], -np.concatenate(constant) * weight)
    return math.sqrt(solution[0]) if solution[0] > 0 else math.nan


def poses_of_homographies(frames: Array, focal: float) -> Array:
    """Return the poses (n, 12) that are nearest to homographies (n, 8)."""
    first = np.stack([frames[:, 0], frames[:, 3], focal * frames[:, 6]], axis=1)
    second = np.stack([frames[:, 1], frames[:, 4], focal * frames[:, 7]], axis=1)
    columns = np.stack([first, second], axis=2)
    scale = math.sqrt(2) / np.linalg.norm(columns, axis=(1, 2))[:, None]
    columns *= scale[..., None]
    third = np.cross(columns[..., 0], columns[..., 1])
    left, _, right = np.linalg.svd(np.concatenate([columns, third[..., None]], axis=2))
    rotation = (left @ right).reshape(-1, 9)
    return np.concatenate([rotation, frames[:, [2, 5]] * scale, scale], axis=1)
