"""Simulation of many independent passes over one landmark, for studies of solvers.

Section 3.5 of the paper: from a start on a circle around the landmark the robot drives straight,
within 45 degrees of the direction of the centre. All passes are simulated at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.landmark import CODE_COUNT, Geometry, signs
from locatk.core.landmarks.simulation.floor import BAR_DRAWS, bar_fields, scatter_bars
from locatk.core.landmarks.simulation.options import (
    MAX_HEADING_OFFSET_RAD,
    PASS_LENGTH_M,
    START_RADIUS_M,
    Errors,
    RandomSource,
)
from locatk.core.landmarks.simulation.sensors import digitise, gains, odometry
from locatk.core.simulation import SESSION_START_NS, exact_trajectory, random_stream
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

STEP_M = 0.002
"""Distance between the samples of a straight pass."""

SPIN_STEP_RAD = math.radians(2)
"""Largest rotation between the samples of a spin."""

SPIN_RAD = 2 * math.pi
"""Rotation of a spin."""

SAMPLE_RATE_HZ = 50.0
"""Rate of the samples in time; their distances are those of the constants above."""

SEQUELS = ("", "spin", "pass", "stand")
"""Choices of ``then`` of :func:`simulate_passes`."""

POSES_PER_BATCH = 100_000 // 16
"""Poses whose fields are computed at once: 16 bars and sensors each, 1 kB for each of these."""


@dataclass(frozen=True)
class SinglePass:
    """One simulated visit to one landmark.

    Attributes
    ----------
    samples : HallSamples
    odometry : Trajectory
        In the frame ``"odometry"``, which is the robot's at the start; one pose for each sample.
    truth : Trajectory
        In the frame ``"landmark"``.
    code : int
    strength : (4,) ndarray
        Signed strengths of the bars in units of the nominal one.
    first : int
        Number of samples of the first straight pass; the others belong to its sequel.
    lines : int
        Number of parallel lines of sensors on which the territory was entered in the first pass;
        the front and the rear sensor follow the same line.
    """

    samples: HallSamples
    odometry: Trajectory
    truth: Trajectory
    code: int
    strength: Array
    first: int
    lines: int

    @property
    def end(self) -> Array:
        """Pose (3,) of the robot at the end in the landmark's frame: x, y and heading."""
        x, y, z, w = self.truth.quaternion[-1]
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.array([*self.truth.position[-1, :2], heading])


def simulate_passes(
    count: int,
    code: int | Sequence[int] | None = None,
    *,
    geometry: Geometry | None = None,
    sensors: HallSensors | None = None,
    errors: Errors | None = None,
    then: str = "",
    length_m: float = PASS_LENGTH_M,
    aim_m: float = 0.007,
    start: tuple[float, float] | None = None,
    seed: int = 0,
) -> list[SinglePass]:
    """Simulate straight passes, each over a landmark and with a robot of its own.

    Parameters
    ----------
    count : int
    code : int, sequence of int or None
        Codes of the landmarks, repeated if necessary; None for random ones.
    geometry : Geometry, optional
    sensors : HallSensors, optional
        Default: four on the circle of the geometry.
    errors : Errors, optional
        Default: the nominal ones. Errors of the landmark as a whole are ignored.
    then : str
        Sequel of the pass: none, a ``"spin"`` of 360 degrees near the centre, a second
        ``"pass"`` at right angles to the first, or a ``"stand"`` of half a second near the
        centre. Before it, the robot turns and drives back to its estimate of the centre, and
        measures meanwhile.
    length_m : float
        Length of the straight pass.
    aim_m : float
        Mean error of that estimate of the centre.
    start : (float, float), optional
        Angle on the circle of starts, and angle from the direction of the centre to the heading.
        Default: random, uniform.
    seed : int

    Returns
    -------
    list of SinglePass
        Passes that miss the territory (``lines`` is 0) are included, as in the paper.

    Raises
    ------
    InputError
        There is no such code or sequel.
    """
    geometry, errors = geometry or Geometry(), errors or Errors()
    sensors = sensors or HallSensors(
        position_m=circle(geometry.circle_m), noise_t=errors.noise_t or float("nan")
    )
    if then not in SEQUELS:
        raise InputError(f"a pass with the sequel {then!r}", hint=f"Give one of {SEQUELS[1:]}")
    codes = _codes(count, code, random_stream(seed, RandomSource.STUDY_CODES))
    path_rng = random_stream(seed, RandomSource.STUDY_PATHS)
    angle = path_rng.uniform(0, 2 * math.pi, count)
    offset = path_rng.uniform(-MAX_HEADING_OFFSET_RAD, MAX_HEADING_OFFSET_RAD, count)
    target = path_rng.normal(0.0, aim_m / math.sqrt(math.pi / 2), (count, 2))
    if start is not None:
        angle[:], offset[:] = start
    poses = [_poses(*draw, length_m, then) for draw in zip(angle, offset, target, strict=True)]
    draws = random_stream(seed, RandomSource.STUDY_BARS).standard_normal((count, BAR_DRAWS))
    relative_strength, middle, axes = scatter_bars(geometry, draws, errors)
    strength = signs(codes) * relative_strength
    fields = _fields(poses, geometry, sensors, errors, strength, middle, axes)
    reading_rng = random_stream(seed, RandomSource.STUDY_READINGS)
    wheel_rng = random_stream(seed, RandomSource.STUDY_WHEELS)
    simulated = []
    for k, (pose, field) in enumerate(zip(poses, fields, strict=True)):
        first = round(length_m / STEP_M) + 1
        entered = np.abs(field[:first]).max(axis=0) >= geometry.threshold_t
        gain, offset_t = gains(len(sensors), errors, reading_rng)
        readings = gain * (field + errors.earth_t) + offset_t
        readings += reading_rng.normal(0.0, errors.noise_t, readings.shape)
        sample_ns = np.rint(np.arange(len(pose)) * 1e9 / SAMPLE_RATE_HZ).astype(np.int64)
        time_ns = SESSION_START_NS + sample_ns
        reported, _ = odometry(pose, errors, wheel_rng)
        simulated.append(
            SinglePass(
                HallSamples(
                    "robot",
                    sensors,
                    time_ns,
                    digitise(readings, sensors.range_t, errors.quantum_t)[0],
                ),
                trajectory("robot", "odometry", time_ns, reported),
                trajectory("robot", "landmark", time_ns, pose),
                int(codes[k]),
                strength[k],
                first,
                len(set(np.round(sensors.position_m[entered, 1], 6))),
            )
        )
    return simulated


def _codes(
    count: int, code: int | Sequence[int] | None, rng: np.random.Generator
) -> NDArray[np.int64]:
    if code is None:
        return rng.integers(0, CODE_COUNT, count)
    codes = np.atleast_1d(np.asarray(code, np.int64))
    if not len(codes) or codes.min() < 0 or codes.max() >= CODE_COUNT:
        raise InputError(f"landmarks of the codes {codes.tolist()}", hint="Codes are 0 to 15")
    return np.resize(codes, count)


# ---- poses of the robot


def _poses(angle: float, offset: float, target: Array, length_m: float, then: str) -> Array:
    """Return the poses (n, 3) of a pass and its sequel."""
    heading = angle + math.pi + offset
    pose = np.array([START_RADIUS_M * math.cos(angle), START_RADIUS_M * math.sin(angle), heading])
    parts = [_straight(pose, length_m)]
    if then:
        pose = parts[-1][-1]
        back = target - pose[:2]
        if then == "pass":
            # The second pass starts at the same distance from the target as the first.
            across = heading + math.pi / 2
            back = back - START_RADIUS_M * np.array([math.cos(across), math.sin(across)])
        parts.append(_rotation(pose, _wrap(math.atan2(back[1], back[0]) - pose[2])))
        parts.append(_straight(parts[-1][-1], float(np.hypot(*back))))
        if then == "spin":
            parts.append(_rotation(parts[-1][-1], SPIN_RAD))
        elif then == "pass":
            parts.append(_rotation(parts[-1][-1], _wrap(across - parts[-1][-1][2])))
            parts.append(_straight(parts[-1][-1], length_m))
        else:
            parts.append(np.repeat(parts[-1][-1:], round(SAMPLE_RATE_HZ / 2), axis=0))
    # The first pose of each part is the last one of the part before.
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])


def _straight(pose: Array, length_m: float) -> Array:
    distance_m = np.linspace(0.0, length_m, max(round(length_m / STEP_M), 1) + 1)
    return pose + distance_m[:, None] * [math.cos(pose[2]), math.sin(pose[2]), 0.0]


def _rotation(pose: Array, rotation_rad: float) -> Array:
    steps = max(math.ceil(abs(rotation_rad) / SPIN_STEP_RAD), 1)
    return pose + np.linspace(0.0, rotation_rad, steps + 1)[:, None] * [0.0, 0.0, 1.0]


def _wrap(angle_rad: float) -> float:
    """Return the same angle from -pi to pi."""
    return math.remainder(angle_rad, 2 * math.pi)


def trajectory(device: str, frame: str, time_ns: NDArray[np.int64], poses: Array) -> Trajectory:
    """Return poses (n, 3) on the floor, x, y and heading, as a trajectory."""
    return exact_trajectory(device, frame, time_ns, poses[:, :2], poses[:, 2])


# ---- fields


def _fields(
    poses: Sequence[Array],
    geometry: Geometry,
    sensors: HallSensors,
    errors: Errors,
    strength: Array,
    middle: Array,
    axes: Array,
) -> list[Array]:
    """Return the true fields (n, N) of each pass."""
    height = geometry.sensor_height_m + errors.height_m
    ends = np.cumsum([len(pose) for pose in poses])
    pass_index = np.repeat(np.arange(len(poses)), [len(pose) for pose in poses])
    points = sensor_points(np.concatenate(poses), sensors, height) if poses else np.empty((0, 0, 3))
    field = np.empty(points.shape[:2])
    for lower in range(0, len(field), POSES_PER_BATCH):
        batch = slice(lower, lower + POSES_PER_BATCH)
        index = pass_index[batch]
        unit_fields = bar_fields(
            geometry, middle[index][:, None], axes[index][:, None], points[batch][:, :, None]
        )
        field[batch] = np.einsum("nsk,nk->ns", unit_fields, strength[index])
    return np.split(field, ends[:-1])


def sensor_points(poses: Array, sensors: HallSensors, height_m: float) -> Array:
    """Return the positions (n, N, 3) of the sensors of a robot at poses (n, 3)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = sensors.position_m.T
    points = np.empty((len(poses), len(sensors), 3))
    points[..., 0] = poses[:, :1] + np.outer(cos, x) - np.outer(sin, y)
    points[..., 1] = poses[:, 1:2] + np.outer(sin, x) + np.outer(cos, y)
    points[..., 2] = height_m
    return points
