"""Error-state filter of a vehicle in the plane: fixes connected by odometry.

The error of the pose is a twist d in the body frame, X_true = X Exp(d) on SE(2), so that its
propagation does not depend on the pose (invariant error; Barrau and Bonnabel, IEEE Trans. Automatic
Control 62 (2017) 1797; notation of Sola, Deray and Atchuthan, arXiv 1812.01537). The state also
contains the systematic errors of wheels (Borenstein and Feng, IEEE Trans. Robotics and Automation
12 (1996) 869), which are no noise: without them the covariance between fixes is too small. A motion
of the odometry is the twist (rx, ry, r_phi) from one sample to the next; the true one is

    ((1 + scale) rx, (1 + scale) ry, (1 + rotation_scale) r_phi + drift rx).

Noise has a variance per metre and per radian, so that results do not depend on the rate of the
odometry. How slippery a floor is differs by orders of magnitude: two factors of the variances of
position and heading are estimated from the innovations, by a scoring step of their likelihood at
each fix (Mehra, IEEE Trans. Automatic Control 17 (1972) 693). If the heading is unknown (fixes of a
position only), it is taken from the chord between two fixes against that of the odometry.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.streaming.history import CHI2_999

Array = NDArray[np.float64]

# Components of the state vector.
X, Y, HEADING, SCALE, DRIFT, ROTATION_SCALE = range(6)
PHASE, REFUSED_IN_A_ROW, ACCEPTED, REFUSED, RESETS, IS_PROVISIONAL = range(6, 12)
ANCHOR, ANCHOR_COVARIANCE, ANCHOR_MOTION = slice(12, 14), slice(14, 18), slice(18, 21)
ANCHOR_DISTANCE, ANCHOR_HEADING_VARIANCE = 21, 22
LOG_NOISE, NOISE_INFORMATION, NOISE_SENSITIVITY = slice(23, 25), slice(25, 27), slice(27, 45)
NOISE_SINCE_FIX = slice(45, 47)

# Phases.
UNKNOWN, POSITION_ONLY, RUNNING = range(3)

# Components of a fix: x, y, heading (nan if unknown), their covariance (9), and of its handling.
FIX_COVARIANCE, FIX_MAX_REFUSALS, FIX_IS_PROVISIONAL = slice(3, 12), 12, 13

MAX_HEADING_SIGMA_RAD = 0.1
"""Standard deviation of a heading from two positions below which it is used: linearization errors
of the filter, about its square, are then below 1 %."""

MIN_CHORD_M = 0.02
"""Shortest chord of the odometry from which a heading is taken [m]."""

MAX_CHORD_RATIO_ERROR, MAX_ANCHOR_DISTANCE_M = 0.1, 2.0
"""Relative difference between the chords of fixes and odometry beyond their noise up to which they
agree, and distance after which another fix becomes the first point of the chord [m]."""

LOG_NOISE_PRIOR_INFORMATION, NOISE_MEMORY = 0.5, 0.98
"""Prior information of the logarithms of the factors of noise (a factor of 4 is one standard
deviation), and the part of the information from fixes that remains at the next fix."""

MAX_HEADING_VARIANCE_RAD2 = math.pi**2
"""Largest variance of a step of the heading that an odometry reports: it is unknown then."""

MAX_NOISE_FACTOR = 1000.0
"""Bound of these factors: 32 in the standard deviation."""


_IDENTITY = np.eye(6)


@dataclass(frozen=True)
class OdometryNoise:
    """Errors of odometry: standard deviations.

    The defaults are those of inexpensive differential drives: 1 % of scale; a heading that drifts
    by 3 degrees in a metre by wheels of unequal diameters, a track wrong by 2 %.

    Attributes
    ----------
    scale, rotation_scale : float
        Constant relative errors of distances and of rotations.
    drift_rad_per_m : float
        Constant drift of the heading.
    distance_m, heading_rad : float
        Random walk of position and heading after one metre (per root of a metre).
    rotation_rad : float
        Random walk of the heading after one radian of rotation.
    slip_m, slip_rad : float
        Random walk of position and heading after one second of motion, for slip.
    rest_m, rest_rad : float
        The same at rest; they keep a long rest from being averaged without limit.
    acceleration_m_s2, angular_acceleration_rad_s2 : float
        Accelerations that are usual; they limit the interpolation between samples.
    """

    scale: float = 0.015
    rotation_scale: float = 0.02
    drift_rad_per_m: float = 0.05
    distance_m: float = 7e-4
    heading_rad: float = 5e-3
    rotation_rad: float = 5e-3
    slip_m: float = 1e-4
    slip_rad: float = 5e-4
    rest_m: float = 1e-5
    rest_rad: float = 1e-5
    acceleration_m_s2: float = 0.5
    angular_acceleration_rad_s2: float = 2.0


@dataclass(frozen=True)
class PlanarFilter:
    """Equations of the filter, see :class:`.history.FilterModel`."""

    noise: OdometryNoise = field(default_factory=OdometryNoise)
    state_size: int = 47
    error_size: int = 6
    motion_size: int = 4
    fix_size: int = 14

    def unknown_state(self) -> tuple[Array, Array]:
        """Return state and covariance before any fix."""
        noise = self.noise
        covariance = np.zeros((6, 6))
        errors = (noise.scale, noise.drift_rad_per_m, noise.rotation_scale)
        covariance[[3, 4, 5], [3, 4, 5]] = np.square(errors)
        return np.zeros(self.state_size), covariance

    def part(self, motion: Array, fraction: float) -> Array:
        """Return the motion in a fraction of the duration of ``motion`` (4,)."""
        return motion * fraction

    def propagate(
        self, state: Array, covariance: Array, motion: Array, duration_s: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a motion.

        ``motion`` is the twist (rx, ry, r_phi) in m and rad, and the increase of the variance of
        the heading that the odometry reports (nan if unknown; then :class:`OdometryNoise` holds).
        """
        phase = state[PHASE]
        if phase == UNKNOWN:
            return state, covariance
        rx, ry, rotation, reported = motion.tolist()
        noise = self.noise
        distance = math.hypot(rx, ry)
        is_moving = distance > 0.0 or rotation != 0.0
        slip = (noise.slip_m, noise.slip_rad) if is_moving else (noise.rest_m, noise.rest_rad)
        heading_variance = min(reported, MAX_HEADING_VARIANCE_RAD2)
        if not reported > 0.0:
            heading_variance = noise.heading_rad**2 * distance + noise.rotation_rad**2 * abs(
                rotation
            )
        heading_variance += slip[1] ** 2 * duration_s
        position_variance = noise.distance_m**2 * distance + slip[0] ** 2 * duration_s
        state = state.copy()
        if phase == POSITION_ONLY:
            x, y, heading = state[ANCHOR_MOTION].tolist()
            dx, dy = exponential(rx, ry, rotation)
            c, s = math.cos(heading), math.sin(heading)
            state[ANCHOR_MOTION] = x + c * dx - s * dy, y + s * dx + c * dy, heading + rotation
            state[ANCHOR_DISTANCE] += distance
            state[ANCHOR_HEADING_VARIANCE] += heading_variance
            return state, covariance
        x, y, heading, scale, drift, rotation_scale = state[:6].tolist()
        vx, vy = (1 + scale) * rx, (1 + scale) * ry
        angle = (1 + rotation_scale) * rotation + drift * rx
        dx, dy = exponential(vx, vy, angle)
        c, s = math.cos(heading), math.sin(heading)
        state[X], state[Y] = x + c * dx - s * dy, y + s * dx + c * dy
        state[HEADING] = math.remainder(heading + angle, 2 * math.pi)
        # Ad(Exp(-u)), and the right Jacobian of Exp to the second order.
        c, s = math.cos(angle), math.sin(angle)
        transition = np.array(
            [
                [c, s, s * dx - c * dy, rx + angle * ry / 2, -vy * rx / 2, -vy * rotation / 2],
                [-s, c, c * dx + s * dy, ry - angle * rx / 2, vx * rx / 2, vx * rotation / 2],
                [0.0, 0.0, 1.0, 0.0, rx, rotation],
                [0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
                [0.0, 0.0, 0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
            ]
        )
        covariance = transition @ covariance @ transition.T
        # A random walk of the heading within the step also displaces the end of the step.
        state[NOISE_SINCE_FIX] += position_variance, heading_variance
        factors = np.exp(state[LOG_NOISE])
        heading_variance *= factors[1]
        third, half = heading_variance / 3, heading_variance / 2
        added = np.zeros((2, 3, 3))
        added[0, 0, 0] = added[0, 1, 1] = position_variance * factors[0]
        added[1] = [
            [third * vy * vy, -third * vx * vy, -half * vy],
            [-third * vx * vy, third * vx * vx, half * vx],
            [-half * vy, half * vx, heading_variance],
        ]
        covariance[:3, :3] += added[0] + added[1]
        motion_of_pose = transition[:3, :3]
        sensitivity = state[NOISE_SENSITIVITY].reshape(2, 3, 3)
        sensitivity = motion_of_pose @ sensitivity @ motion_of_pose.T + added
        state[NOISE_SENSITIVITY] = sensitivity.ravel()
        return state, covariance

    def update(
        self, state: Array, covariance: Array, fix: Array, interpolation_s2: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a fix of any of x, y and heading.

        ``fix`` is x, y, heading in m and rad (nan if unknown), their covariance (9,) in the axes
        of the frame, the number of refusals in a row after which a fix is taken for right (0: at
        once), and whether the fix is provisional.
        """
        fix_covariance = fix[FIX_COVARIANCE].reshape(3, 3).copy()
        if interpolation_s2 > 0:
            variance = (interpolation_s2 * self.noise.acceleration_m_s2) ** 2
            fix_covariance[0, 0] += variance
            fix_covariance[1, 1] += variance
            fix_covariance[2, 2] += (interpolation_s2 * self.noise.angular_acceleration_rad_s2) ** 2
        known = np.isfinite(fix[:3]).nonzero()[0]
        state = state.copy()
        if state[PHASE] == RUNNING:
            if fix[FIX_MAX_REFUSALS] > 0:
                updated = self._fuse(state, covariance, fix, fix_covariance, known)
                if updated is not None:
                    return updated
                state[REFUSED] += 1
                state[REFUSED_IN_A_ROW] += 1
            is_final = state[REFUSED_IN_A_ROW] >= fix[FIX_MAX_REFUSALS]
            if not (is_final or state[IS_PROVISIONAL]):
                return state, _with_slip(state, covariance)
            if len(known) < 2 or not np.isfinite(fix[:2]).all():
                return state, covariance
            state[RESETS] += 1
            state[PHASE] = UNKNOWN
        if len(known) == 3:
            return _start(state, covariance, fix, fix_covariance)
        if np.isfinite(fix[:2]).all():
            return _start_from_positions(state, covariance, fix, fix_covariance)
        return state, covariance

    def _fuse(
        self,
        state: Array,
        covariance: Array,
        fix: Array,
        fix_covariance: Array,
        known: NDArray[np.intp],
    ) -> tuple[Array, Array] | None:
        """Return the update by a fix, or None if it contradicts the state."""
        heading = float(state[HEADING])
        residual = fix[:3] - state[:3]
        residual[2] = math.remainder(residual[2], 2 * math.pi) if residual[2] == residual[2] else 0
        c, s = math.cos(heading), math.sin(heading)
        rows = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        if len(known) < 3:
            rows, residual = rows[known], residual[known]
            fix_covariance = fix_covariance[np.ix_(known, known)]
        cross = covariance[:, :3] @ rows.T
        precision = np.linalg.inv(rows @ cross[:3] + fix_covariance)
        normalized = precision @ residual
        excess = float(residual @ normalized) / CHI2_999[len(known)]
        _estimate_noise(state, precision, rows, normalized / math.sqrt(max(excess, 1.0)))
        if excess > 1.0:
            return None
        gain = cross @ precision
        correction = gain @ residual
        keep = _IDENTITY.copy()
        keep[:, :3] -= gain @ rows
        sensitivity = state[NOISE_SENSITIVITY].reshape(2, 3, 3)
        state[NOISE_SENSITIVITY] = (keep[:3, :3] @ sensitivity @ keep[:3, :3].T).ravel()
        covariance = keep @ covariance @ keep.T + gain @ fix_covariance @ gain.T
        # The error is now relative to the corrected pose: Ad(Exp(-correction / 2)).
        cx, cy, angle = correction[:3].tolist()
        hc, hs = math.cos(angle / 2), math.sin(angle / 2)
        hx, hy = cx / 2, cy / 2
        reset = _IDENTITY.copy()
        reset[:2, :3] = [[hc, hs, hs * hx - hc * hy], [-hs, hc, hc * hx + hs * hy]]
        covariance = reset @ covariance @ reset.T
        dx, dy = exponential(cx, cy, angle)
        state[X] += c * dx - s * dy
        state[Y] += s * dx + c * dy
        state[HEADING] = math.remainder(heading + angle, 2 * math.pi)
        state[3:6] += correction[3:6]
        return _accepted(state, fix), (covariance + covariance.T) / 2


def _with_slip(state: Array, covariance: Array) -> Array:
    """Return the covariance after a refused fix: wheels may have slipped since the last one.

    The noise since then is increased to its bound. Without motion, the fix is wrong.
    """
    position_variance, heading_variance = (MAX_NOISE_FACTOR * state[NOISE_SINCE_FIX]).tolist()
    covariance = covariance.copy()
    covariance[range(3), range(3)] += position_variance, position_variance, heading_variance
    return covariance


def _estimate_noise(state: Array, precision: Array, rows: Array, normalized: Array) -> None:
    """Improve the factors of the odometry's noise by one innovation, in place.

    ``precision`` is the inverse of the covariance S of the innovation, and ``normalized`` its
    product with the innovation. With the derivative G of S by the logarithm of a factor, that of
    the log likelihood is (n' G n - tr(S^-1 G)) / 2, with the information tr((S^-1 G)^2) / 2.
    """
    parts = rows @ state[NOISE_SENSITIVITY].reshape(2, 3, 3) @ rows.T
    relative = precision @ parts
    slope = (normalized @ parts @ normalized - np.trace(relative, axis1=1, axis2=2)) / 2
    information = (relative * relative.transpose(0, 2, 1)).sum(axis=(1, 2)) / 2
    state[NOISE_INFORMATION] = NOISE_MEMORY * state[NOISE_INFORMATION] + information
    prior = LOG_NOISE_PRIOR_INFORMATION
    change = (slope - (1 - NOISE_MEMORY) * prior * state[LOG_NOISE]) / (
        state[NOISE_INFORMATION] + prior
    )
    changed = state[LOG_NOISE] + np.minimum(np.maximum(change, -1.0), 1.0)
    bound = math.log(MAX_NOISE_FACTOR)
    state[LOG_NOISE] = np.minimum(np.maximum(changed, -bound), bound)


def exponential(rx: float, ry: float, rotation: float) -> tuple[float, float]:
    """Return the translation of Exp of a twist; its rotation is that of the twist."""
    if abs(rotation) < 1e-6:
        return rx - ry * rotation / 2, ry + rx * rotation / 2
    sine, versine = math.sin(rotation) / rotation, 2 * math.sin(rotation / 2) ** 2 / rotation
    return sine * rx - versine * ry, versine * rx + sine * ry


def logarithm(x: float, y: float, rotation: float) -> tuple[float, float]:
    """Return the translation (rx, ry) of the twist of a planar motion; its rotation is the same."""
    half = rotation / 2
    factor = 1.0 - half * half / 3 if abs(half) < 1e-4 else half / math.tan(half)
    return factor * x + half * y, factor * y - half * x


def pose_covariance(state: Array, covariance: Array) -> Array:
    """Return the covariance (3, 3) of x, y and heading in the axes of the frame."""
    c, s = math.cos(state[HEADING]), math.sin(state[HEADING])
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(rotation @ covariance[:3, :3] @ rotation.T)


def _accepted(state: Array, fix: Array) -> Array:
    """Count a fix that was used, in place."""
    state[ACCEPTED] += 1
    state[REFUSED_IN_A_ROW] = 0
    state[NOISE_SINCE_FIX] = 0.0
    state[IS_PROVISIONAL] = fix[FIX_IS_PROVISIONAL]
    return state


def _start(
    state: Array, covariance: Array, fix: Array, fix_covariance: Array
) -> tuple[Array, Array]:
    """Return the state of a fix alone; what is known of the odometry's errors stays."""
    state[:3] = fix[:3]
    state[HEADING] = math.remainder(fix[2], 2 * math.pi)
    state[PHASE] = RUNNING
    state[NOISE_SENSITIVITY] = 0.0
    c, s = math.cos(fix[2]), math.sin(fix[2])
    to_body = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    started = np.zeros((6, 6))
    started[:3, :3] = to_body @ fix_covariance @ to_body.T
    started[3:, 3:] = covariance[3:, 3:]
    return _accepted(state, fix), started


def _start_from_positions(
    state: Array, covariance: Array, fix: Array, fix_covariance: Array
) -> tuple[Array, Array]:
    """Return the state of two positions and the odometry between them, or that of one position."""
    if state[PHASE] == POSITION_ONLY:
        chord = fix[:2] - state[ANCHOR]
        x, y, rotation = state[ANCHOR_MOTION].tolist()
        length = math.hypot(x, y)
        first = state[ANCHOR_COVARIANCE].reshape(2, 2)
        last = fix_covariance[:2, :2]
        if length > MIN_CHORD_M:
            normal = np.array([-chord[1], chord[0]]) / max(math.hypot(*chord), 1e-9)
            along = np.array([normal[1], -normal[0]])
            variance = normal @ (first + last) @ normal / length**2
            variance += state[ANCHOR_HEADING_VARIANCE]
            # The chord of a systematic drift deviates by half of the drift from its heading.
            variance += covariance[4, 4] * state[ANCHOR_DISTANCE] ** 2 / 4
            sigma = math.sqrt(along @ (first + last) @ along)
            misfit = abs(math.hypot(*chord) - length)
            is_far = state[ANCHOR_DISTANCE] > MAX_ANCHOR_DISTANCE_M
            if misfit > 4 * sigma + MAX_CHORD_RATIO_ERROR * length:
                is_far = True
            elif variance < MAX_HEADING_SIGMA_RAD**2:
                heading = math.atan2(chord[1], chord[0]) - math.atan2(y, x) + rotation
                pose = fix.copy()
                pose[2] = heading
                joint = np.zeros((3, 3))
                joint[:2, :2] = last
                joint[:2, 2] = joint[2, :2] = last @ normal / length
                joint[2, 2] = variance
                return _start(state, covariance, pose, joint)
            if not is_far:
                return _accepted(state, fix), covariance
        elif state[ANCHOR_DISTANCE] <= MAX_ANCHOR_DISTANCE_M:
            return _accepted(state, fix), covariance
    state[PHASE] = POSITION_ONLY
    state[ANCHOR], state[ANCHOR_COVARIANCE] = fix[:2], fix_covariance[:2, :2].ravel()
    state[ANCHOR_MOTION] = 0.0
    state[ANCHOR_DISTANCE] = state[ANCHOR_HEADING_VARIANCE] = 0.0
    return _accepted(state, fix), covariance
