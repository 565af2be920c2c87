"""Figures of Polaris on passes that are not straight, level and clean.

The generator shares no code with the simulator and the solver: the bar follows a curve, its
attitude and height vary along the path, iron lies around the magnets, and the discs are cylinders
(magpylib). The axes of a sensor are converted one after the other, with the noise of the published
recordings (0.86, 0.89 and 1.24 uT), rounded to counts of 0.15 and 0.24 uT, an offset of each axis
of each sensor, and the Earth's field, which rotates with the bar.

Estimated and true magnets are compared in the frame of the array at the time of the detection. The
NEES (normalised estimation error squared) is that of single magnets, per degree of freedom: 1 is
expected of a correct covariance.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import magpylib
import numpy as np
from numpy.typing import NDArray

from locatk.core.magnetics import dipole_field
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import Tags, as_built_magnets
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.polaris.passes import random_id
from locatk.formats.benchmarks.timing import FIRST_SEED

Array = NDArray[np.float64]
Random = np.random.Generator

PASSES_PER_KIND = 12
"""Passes with each disturbance."""

RATE_HZ, SPEED_MPS = 83.0, 0.12
"""Rate of the samples, and mean speed: 1.4 mm per sample, as between the published 2.6 mm and the
1 mm of the paper."""

CONVERSION_S = 2.7e-3
"""Time between the conversions of two axes."""

NOISE_T = np.array([0.86e-6, 0.89e-6, 1.24e-6])
QUANTUM_T = np.array([0.150e-6, 0.150e-6, 0.242e-6])

HALF_LENGTH_M = 0.11
"""Length of the path before and after the middle of the tag."""

EARTH_T = 48e-6
OFFSET_T = 30e-6

BUILD_SIGMA_M, BUILD_SIGMA_RAD = 0.3e-3, math.radians(3.0)
"""Standard deviation of the magnets from their cells and orientations; the truth includes it."""


@dataclass(frozen=True)
class Disturbance:
    """Deviation of a pass from a straight one over a clean floor; ranges are (least, largest).

    Attributes
    ----------
    radius_m : (float, float) or None
        Radius of the path, with a random sign; None if it is straight.
    radius_ratio : float
        Radius at the end of the path over that at its beginning.
    attitude_deg : (float, float)
        Angles of roll and pitch, with random signs.
    is_rocking : bool
        True if the attitude swings by half of that angle along the path.
    wobble_m : (float, float)
        Amplitude of the height.
    wavelength_m : (float, float)
        Wavelength of height and attitude along the path.
    debris : int
        Number of iron bits.
    debris_moment : (float, float)
        Moment of a bit relative to that of a magnet, log-uniform.
    yaw_deg : (float, float)
        Amplitude of a rotation of the bar that its path does not follow.
    """

    radius_m: tuple[float, float] | None = None
    radius_ratio: float = 1.0
    attitude_deg: tuple[float, float] = (0.0, 0.0)
    is_rocking: bool = False
    wobble_m: tuple[float, float] = (0.0, 0.0)
    wavelength_m: tuple[float, float] = (0.06, 0.3)
    debris: int = 0
    debris_moment: tuple[float, float] = (0.01, 0.15)
    yaw_deg: tuple[float, float] = (0.0, 0.0)


DISTURBANCES: dict[str, Disturbance] = {
    "no disturbance": Disturbance(),
    "curve of 150 to 300 mm": Disturbance(radius_m=(0.15, 0.3)),
    "curve of 300 to 1000 mm": Disturbance(radius_m=(0.3, 1.0)),
    "tightening curve": Disturbance(radius_m=(0.3, 1.0), radius_ratio=0.5),
    "roll and pitch of 1 to 3 deg": Disturbance(attitude_deg=(1.0, 3.0)),
    "roll and pitch that vary": Disturbance(attitude_deg=(1.0, 3.0), is_rocking=True),
    "height of 0.5 to 1 mm, 150 to 300 mm": Disturbance(
        wobble_m=(0.5e-3, 1e-3), wavelength_m=(0.15, 0.3)
    ),
    "height of 0.5 to 1 mm, 40 to 150 mm": Disturbance(
        wobble_m=(0.5e-3, 1e-3), wavelength_m=(0.04, 0.15)
    ),
    "yaw of 1 to 4 deg": Disturbance(yaw_deg=(1.0, 4.0)),
    "iron debris": Disturbance(debris=10),
    "all of these at once": Disturbance(
        (0.2, 0.6), 0.7, (0.5, 2.0), True, (0.2e-3, 0.5e-3), debris=6
    ),
}  # fmt: skip


@dataclass(frozen=True)
class BarPath:
    """Path of the bar: a function of the distance along it.

    Attributes
    ----------
    disturbance : Disturbance
    rng : Generator
        It draws the path once, when it is created.
    """

    disturbance: Disturbance
    rng: Random
    distance_m: Array = field(init=False)
    pose: Array = field(init=False)

    def __post_init__(self) -> None:
        disturbance, rng = self.disturbance, self.rng
        s = np.linspace(-HALF_LENGTH_M - 0.01, HALF_LENGTH_M + 0.01, 4001)
        curvature = np.zeros_like(s)
        if disturbance.radius_m is not None:
            radius = rng.uniform(*disturbance.radius_m) * rng.choice([-1, 1])
            fraction = (s + HALF_LENGTH_M) / (2 * HALF_LENGTH_M)
            curvature = 1 / (radius * (1 + (disturbance.radius_ratio - 1) * fraction))
        heading = _integral(curvature, s)
        swing = [np.sin(math.tau * (s / self._wavelength() + rng.random())) for _ in range(3)]
        roll, pitch = (
            np.radians(rng.uniform(*disturbance.attitude_deg))
            * rng.choice([-1, 1])
            * (1 + disturbance.is_rocking * 0.5 * each)
            for each in swing[:2]
        )
        pose = [
            _integral(np.cos(heading), s),
            _integral(np.sin(heading), s),
            rng.uniform(*disturbance.wobble_m) * swing[2],
            roll,
            pitch,
            heading + self._yaw(s),
        ]
        object.__setattr__(self, "distance_m", s)
        object.__setattr__(self, "pose", np.column_stack(pose))

    def _yaw(self, s: Array) -> Array:
        if not self.disturbance.yaw_deg[1]:
            return np.zeros_like(s)
        amplitude = math.radians(self.rng.uniform(*self.disturbance.yaw_deg))
        swing = np.sin(math.tau * (s / self._wavelength() + self.rng.random()))
        return np.asarray(amplitude * swing)

    def _wavelength(self) -> float:
        low, high = np.log(self.disturbance.wavelength_m)
        return float(np.exp(self.rng.uniform(low, high)))

    def at(self, distance_m: Array) -> tuple[Array, Array]:
        """Return positions (n, 3) and rotations (n, 3, 3) of the bar: yaw, pitch, roll."""
        x, y, z, roll, pitch, yaw = (
            np.interp(distance_m, self.distance_m, each) for each in self.pose.T
        )
        (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
        rotation = np.array([
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ])  # fmt: skip
        return np.column_stack([x, y, z]), rotation.transpose(2, 0, 1)


def _integral(values: Array, s: Array) -> Array:
    """Return the integral of values over ``s``, zero in the middle."""
    integral = np.concatenate([[0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(s))])
    return np.asarray(integral - integral[len(s) // 2])


@dataclass(frozen=True)
class DisturbedPass:
    """Recording of a disturbed pass over one tag, with its truth.

    Attributes
    ----------
    tags : Tags
    tag_id : int
    samples : Samples
    bar_position_m, bar_heading_rad : (n, 2), (n,) ndarray
        At the times of the samples.
    magnet_m, angle_rad : (M, 2), (M,) ndarray
        Magnets in the frame of the floor, in the order of the layout.
    """

    tags: Tags
    tag_id: int
    samples: Samples
    bar_position_m: Array
    bar_heading_rad: Array
    magnet_m: Array
    angle_rad: Array


def simulate_disturbed(
    disturbance: Disturbance, seed: int, tags: Tags | None = None
) -> DisturbedPass:
    """Simulate a pass over a tag with random id, heading and lateral offset."""
    rng = np.random.default_rng(seed)
    tags = tags or Tags()
    tag_id = random_id(tags, rng)
    position, angle = as_built_magnets(tags, tag_id, layout_of(tags, tag_id))
    position = position + rng.normal(0, BUILD_SIGMA_M, position.shape)
    angle = angle + rng.normal(0, BUILD_SIGMA_RAD, angle.shape)
    heading = rng.uniform(0, math.tau)
    cos, sin = math.cos(heading), math.sin(heading)
    magnet_m = position @ np.array([[cos, sin], [-sin, cos]]) + [0, rng.uniform(-0.006, 0.006)]
    angle = angle + heading
    path = BarPath(disturbance, rng)
    moment = tags.magnet.moment * rng.normal(1, 0.03, len(angle))
    bits = np.column_stack(
        [
            rng.uniform(-0.09, 0.09, (disturbance.debris, 2)),
            rng.uniform(0, 1e-3, disturbance.debris),
        ]
    )
    low, high = np.log(disturbance.debris_moment)
    bit_moments = rng.normal(size=bits.shape)
    bit_moments *= (
        tags.magnet.moment
        * np.exp(rng.uniform(low, high, (len(bits), 1)))
        / np.linalg.norm(bit_moments, axis=1, keepdims=True)
    )
    array = SensorArray(
        bar(9, 0.020), NOISE_T, CONVERSION_S * np.array([-1.0, 0.0, 1.0]), QUANTUM_T,
        np.full(3, 5e-3),
    )  # fmt: skip
    times = np.arange(int(2 * HALF_LENGTH_M / SPEED_MPS * RATE_HZ)) / RATE_HZ
    phase = rng.uniform(0, math.tau)

    def distance(time_s: Array) -> Array:
        # The speed varies by 10 % within a second.
        wobble = 0.1 * SPEED_MPS / math.tau * np.sin(math.tau * time_s + phase)
        return -HALF_LENGTH_M + SPEED_MPS * time_s + wobble

    north = rng.uniform(0, math.tau)
    earth = EARTH_T * np.array([0.4 * math.cos(north), 0.4 * math.sin(north), -0.9])
    cylinders = [
        magpylib.magnet.Cylinder(
            polarization=tags.magnet.remanence_t
            * strength
            * np.array([math.cos(a), math.sin(a), 0]),
            dimension=(tags.magnet.diameter_m, tags.magnet.height_m),
            position=(x, y, 0.0),
        )
        for (x, y), a, strength in zip(magnet_m, angle, moment / tags.magnet.moment, strict=True)
    ]
    field_t = np.empty((len(times), len(array), 3))
    for axis in range(3):
        bar_m, rotation = path.at(distance(times + array.delay_s[axis]))
        points = bar_m[:, None] + array.position_m @ rotation.transpose(0, 2, 1)
        points[..., 2] += tags.clearance_m
        total = magpylib.getB(cylinders, points.reshape(-1, 3), sumup=True).reshape(points.shape)
        for bit, bit_moment in zip(bits, bit_moments, strict=True):
            total = total + dipole_field(points - bit, bit_moment)
        field_t[..., axis] = np.einsum("nsj,nj->ns", total + earth, rotation[:, :, axis])
    field_t += rng.normal(0, OFFSET_T, field_t.shape[1:])
    field_t += rng.normal(size=field_t.shape) * NOISE_T
    field_t = np.round(field_t / QUANTUM_T) * QUANTUM_T
    bar_m, rotation = path.at(distance(times))
    yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    samples = Samples("bar", array, np.round(times * 1e9).astype(np.int64), field_t)
    return DisturbedPass(tags, tag_id, samples, bar_m[:, :2], yaw, magnet_m, angle)


@dataclass(frozen=True)
class DisturbedOutcome:
    """Result of one disturbed pass.

    Attributes
    ----------
    is_right, is_wrong : bool
        The true id was read; another one was.
    reasons : tuple of str
        Reasons of the refusals.
    magnets : (M, 3) ndarray
        Errors of x, y and angle of the magnets of a tag that was read right, in standard
        deviations; empty otherwise.
    pose : (3,) ndarray
        The same of the tag's pose, without the error of the build of the tag.
    duration_s : float
        Processor time.
    """

    is_right: bool
    is_wrong: bool
    reasons: tuple[str, ...]
    errors: Array
    magnets: Array
    duration_s: float


def solve_disturbed(disturbed: DisturbedPass) -> DisturbedOutcome:
    """Solve a pass, and compare the magnets with the truth."""
    start = time.process_time()
    detections = solve([disturbed.samples], disturbed.tags, SolveOptions()).detections
    duration = time.process_time() - start
    read = [each for each in detections if each.tag_id is not None]
    right = [each for each in read if each.tag_id == disturbed.tag_id]
    errors, sigmas = np.empty((0, 3)), np.empty((0, 3))
    if right:
        errors, sigmas = _magnet_errors(disturbed, right[0])
    return DisturbedOutcome(
        bool(right) and len(right) == len(read),
        len(right) < len(read),
        tuple(each.refused for each in detections if each.refused),
        errors,
        errors / sigmas,
        duration,
    )


def _magnet_errors(disturbed: DisturbedPass, detection: TagDetection) -> tuple[Array, Array]:
    """Return errors and standard deviations (M, 3) of x, y and angle of detected magnets."""
    time_s = disturbed.samples.time_ns * 1e-9
    x, y, heading = (
        float(np.interp(detection.time_s, time_s, each))
        for each in (*disturbed.bar_position_m.T, disturbed.bar_heading_rad)
    )
    cos, sin = math.cos(heading), math.sin(heading)
    true_m = (disturbed.magnet_m - [x, y]) @ np.array([[cos, -sin], [sin, cos]])
    by_cell = {magnet.cell: magnet for magnet in detection.magnets}
    cells = layout_of(disturbed.tags, disturbed.tag_id).cells
    errors, sigmas = [], []
    for cell, position, angle in zip(cells, true_m, disturbed.angle_rad - heading, strict=True):
        magnet = by_cell.get(cell)
        if magnet is None:
            continue
        error = magnet.angle_rad - angle
        errors.append([magnet.x_m - position[0], magnet.y_m - position[1],
                       math.remainder(error, math.tau)])  # fmt: skip
        sigmas.append([magnet.sigma_x_m, magnet.sigma_y_m, magnet.sigma_angle_rad])
    return np.array(errors), np.array(sigmas)


def nees(outcomes: Sequence[DisturbedOutcome]) -> tuple[float, float]:
    """Return the mean NEES of positions and of angles per degree of freedom."""
    errors = [each.magnets for each in outcomes if len(each.magnets)]
    if not errors:
        return math.nan, math.nan
    square = np.vstack(errors) ** 2
    return float(square[:, :2].mean()), float(square[:, 2].mean())


def disturbance_figures() -> Iterator[Figure]:
    """Pass over the default tag with each disturbance."""
    durations = []
    for number, (name, disturbance) in enumerate(DISTURBANCES.items()):
        first = FIRST_SEED + 9000 + 100 * number
        outcomes = [
            solve_disturbed(simulate_disturbed(disturbance, seed))
            for seed in range(first, first + PASSES_PER_KIND)
        ]
        durations += [outcome.duration_s for outcome in outcomes]
        reasons = [reason for outcome in outcomes for reason in outcome.reasons]
        how = f"{PASSES_PER_KIND} passes, any heading, random ids, seeds from {first}"
        yield Figure(f"{name}: read", 100 * float(np.mean([o.is_right for o in outcomes])), "%",
                     how + "".join(f"; {r}" for r in reasons), 100.0, "higher")  # fmt: skip
        yield Figure(f"{name}: wrong ids", sum(o.is_wrong for o in outcomes), "passes",
                     "of the same passes", 0.0)  # fmt: skip
        for what, value in zip(("position", "angle"), nees(outcomes), strict=True):
            yield Figure(f"{name}: NEES of a magnet's {what}", value, "per degree of freedom",
                         "mean of the magnets that were read; goal: 0.5 to 2", 2.0)  # fmt: skip
    how = f"processor time of solve(), of {len(durations)} passes"
    yield Figure("disturbed passes: longest", max(durations), "s", how, 1.0)
