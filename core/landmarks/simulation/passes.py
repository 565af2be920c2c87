"""Many single passes over one landmark, for studies of how well a solver reads them.

Section 3.5 of the paper: from a start on a circle around the landmark the robot drives
straight, within 45 degrees of the way to the centre. All passes are made at once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.landmark import CODE_COUNT, Geometry, signs
from locatk.core.landmarks.simulation.floor import BAR_DRAWS, bar_fields, scatter_bars
from locatk.core.landmarks.simulation.options import ASIDE_RAD, PASS_M, START_M, Errors
from locatk.core.landmarks.simulation.sensors import digitise, gains, odometry
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

EPOCH_NS = 1_767_225_600_000_000_000
"""Start of every simulated session: 2026-01-01T00:00:00Z."""

STEP_M = 0.002
"""Between the samples of a pass."""

SPIN_STEP_RAD = math.radians(2)

SPIN_RAD = 2 * math.pi

RATE_HZ = 50.0

THEN = ("", "spin", "pass", "stand")

LARGEST_BATCH = 100_000
"""Points whose fields are found at once; each takes 1 kB."""


@dataclass(frozen=True)
class Pass:
    """One visit to one landmark.

    Attributes
    ----------
    samples : HallSamples
    odometry : Trajectory
        In the frame ``"odometry"``, which is the robot's at the start; one pose a sample.
    truth : Trajectory
        In the frame ``"landmark"``: as it was laid, which is nowhere turned.
    code : int
    strength : (4,) ndarray
        Signed, in units of the nominal one.
    first : int
        Samples of the first straight pass; what follows it, if anything, are the others.
    lines : int
        On how many lines of the first pass a sensor entered the territory, of as many as
        sensors run beside each other (the front and the rear one run on the same).
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
        """(3,) x, y and heading of the robot at the end, in the landmark's frame."""
        x, y, z, w = self.truth.quaternion[-1]
        heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        return np.array([*self.truth.position[-1, :2], heading])


def passes(
    count: int,
    code: int | Sequence[int] | None = None,
    *,
    geometry: Geometry | None = None,
    sensors: HallSensors | None = None,
    errors: Errors | None = None,
    then: str = "",
    way_m: float = PASS_M,
    aim_m: float = 0.007,
    start: tuple[float, float] | None = None,
    seed: int = 0,
) -> list[Pass]:
    """Simulate single straight passes, each over a landmark and with a robot of its own.

    Parameters
    ----------
    count : int
    code : int, sequence of int or None
        Of the landmarks, in turn; None for any.
    geometry : Geometry, optional
    sensors : HallSensors, optional
        Four on the circle of the geometry unless given.
    errors : Errors, optional
        The nominal ones unless given; those of the landmark as a whole do not count.
    then : str
        What follows the pass: nothing, a ``"spin"`` of 360 degrees near the centre, a
        second ``"pass"`` across the first, or a ``"stand"`` of half a second there. In
        between the robot turns and drives back to where it takes the centre to be, and
        measures all the time.
    way_m : float
        Of the straight pass.
    aim_m : float
        Mean distance between that place and the centre.
    start : (float, float), optional
        Angle on the circle of starts, and of the heading from the way to the centre;
        random (even) unless given.
    seed : int

    Returns
    -------
    list of Pass
        Also those that miss the territory (``lines`` is 0), as the paper's runs do.

    Raises
    ------
    InputError
        No such code or sequel.
    """
    geometry, errors = geometry or Geometry(), errors or Errors()
    sensors = sensors or HallSensors(
        position_m=circle(geometry.circle_m), noise_t=errors.noise_t or float("nan")
    )
    if then not in THEN:
        raise InputError(f"a pass with the sequel {then!r}", hint=f"Give one of {THEN[1:]}")
    codes = _codes(count, code, np.random.default_rng([seed, 30]))
    ways = np.random.default_rng([seed, 31])
    angle = ways.uniform(0, 2 * math.pi, count)
    aside = ways.uniform(-ASIDE_RAD, ASIDE_RAD, count)
    aim = ways.normal(0.0, aim_m / math.sqrt(math.pi / 2), (count, 2))
    if start is not None:
        angle[:], aside[:] = start
    poses = [_way(*one, way_m, then) for one in zip(angle, aside, aim, strict=True)]
    draws = np.random.default_rng([seed, 32]).standard_normal((count, BAR_DRAWS))
    bars = scatter_bars(geometry, draws, errors)
    strength = signs(codes) * bars[0]
    fields = _fields(poses, geometry, sensors, errors, strength, bars[1], bars[2])
    read, wheels = np.random.default_rng([seed, 33]), np.random.default_rng([seed, 34])
    made = []
    for k, (pose, field) in enumerate(zip(poses, fields, strict=True)):
        first = round(way_m / STEP_M) + 1
        entered = np.abs(field[:first]).max(axis=0) >= geometry.threshold_t
        gain, offset = gains(len(sensors), errors, read)
        field = gain * (field + errors.earth_t) + offset
        field += read.normal(0.0, errors.noise_t, field.shape)
        time_ns = EPOCH_NS + np.rint(np.arange(len(pose)) * 1e9 / RATE_HZ).astype(np.int64)
        told, _ = odometry(pose, errors, wheels)
        made.append(
            Pass(
                HallSamples(
                    "robot",
                    sensors,
                    time_ns,
                    digitise(field, sensors.range_t, errors.quantum_t)[0],
                ),
                trajectory("robot", "odometry", time_ns, told),
                trajectory("robot", "landmark", time_ns, pose),
                int(codes[k]),
                strength[k],
                first,
                len(set(np.round(sensors.position_m[entered, 1], 6))),
            )
        )
    return made


def _codes(
    count: int, code: int | Sequence[int] | None, rng: np.random.Generator
) -> NDArray[np.int64]:
    if code is None:
        return rng.integers(0, CODE_COUNT, count)
    given = np.atleast_1d(np.asarray(code, np.int64))
    if not len(given) or given.min() < 0 or given.max() >= CODE_COUNT:
        raise InputError(f"landmarks of the codes {given.tolist()}", hint="Codes are 0 to 15")
    return np.resize(given, count)


# ---- where the robot is


def _way(angle: float, aside: float, aim: Array, way_m: float, then: str) -> Array:
    """Poses (n, 3): the pass, and what follows it."""
    heading = angle + math.pi + aside
    pose = np.array([START_M * math.cos(angle), START_M * math.sin(angle), heading])
    parts = [_straight(pose, way_m)]
    if then:
        pose = parts[-1][-1]
        back = aim - pose[:2]
        if then == "pass":
            # Across the first, through the aim: from beside it, as far as the first began.
            across = heading + math.pi / 2
            back = back - START_M * np.array([math.cos(across), math.sin(across)])
        for target in (math.atan2(back[1], back[0]), None):
            if target is not None:
                parts.append(_turn(parts[-1][-1], _nearest(target - pose[2])))
            else:
                parts.append(_straight(parts[-1][-1], float(np.hypot(*back))))
        if then == "spin":
            parts.append(_turn(parts[-1][-1], SPIN_RAD))
        elif then == "pass":
            parts.append(_turn(parts[-1][-1], _nearest(across - parts[-1][-1][2])))
            parts.append(_straight(parts[-1][-1], way_m))
        else:
            parts.append(np.repeat(parts[-1][-1:], round(RATE_HZ / 2), axis=0))
    # Each part begins where the one before it ended.
    return np.concatenate([parts[0], *(part[1:] for part in parts[1:])])


def _straight(pose: Array, way_m: float) -> Array:
    along = np.linspace(0.0, way_m, max(round(way_m / STEP_M), 1) + 1)
    return pose + along[:, None] * [math.cos(pose[2]), math.sin(pose[2]), 0.0]


def _turn(pose: Array, turn_rad: float) -> Array:
    steps = max(math.ceil(abs(turn_rad) / SPIN_STEP_RAD), 1)
    return pose + np.linspace(0.0, turn_rad, steps + 1)[:, None] * [0.0, 0.0, 1.0]


def _nearest(turn_rad: float) -> float:
    """The same turn within -pi and pi."""
    return math.remainder(turn_rad, 2 * math.pi)


def trajectory(device: str, frame: str, time_ns: NDArray[np.int64], poses: Array) -> Trajectory:
    """Poses (n, 3) on the floor as a trajectory, with no uncertainty told."""
    place = np.column_stack([poses[:, :2], np.zeros(len(poses))])
    zeros = np.zeros((len(poses), 6, 6))
    return Trajectory(device, frame, time_ns, place, quaternion_from_heading(poses[:, 2]), zeros)


# ---- what is there to be measured


def _fields(
    poses: Sequence[Array],
    geometry: Geometry,
    sensors: HallSensors,
    errors: Errors,
    strength: Array,
    middle: Array,
    axes: Array,
) -> list[Array]:
    """True fields (n, N) of each pass."""
    height = geometry.sensor_height_m + errors.height_m
    ends = np.cumsum([len(pose) for pose in poses])
    which = np.repeat(np.arange(len(poses)), [len(pose) for pose in poses])
    points = sensor_points(np.concatenate(poses), sensors, height) if poses else np.empty((0, 0, 3))
    field = np.empty(points.shape[:2])
    for lower in range(0, len(field), LARGEST_BATCH // 16):
        part = slice(lower, lower + LARGEST_BATCH // 16)
        own = which[part]
        each = bar_fields(
            geometry, middle[own][:, None], axes[own][:, None], points[part][:, :, None]
        )
        field[part] = np.einsum("nsk,nk->ns", each, strength[own])
    return np.split(field, ends[:-1])


def sensor_points(poses: Array, sensors: HallSensors, height_m: float) -> Array:
    """Places (n, N, 3) of the sensors of a robot at poses (n, 3)."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    x, y = sensors.position_m.T
    at = np.empty((len(poses), len(sensors), 3))
    at[..., 0] = poses[:, :1] + np.outer(cos, x) - np.outer(sin, y)
    at[..., 1] = poses[:, 1:2] + np.outer(sin, x) + np.outer(cos, y)
    at[..., 2] = height_m
    return at
