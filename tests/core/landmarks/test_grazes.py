"""Landmarks that are only grazed, among neighbours: probabilities of codes against the truth.

The bars are cuboids of magpylib with errors; paths are arcs, noise has heavy tails.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.detection.fit import ModelPriors
from locatk.core.landmarks.detection.hypotheses import detect_landmarks
from locatk.core.landmarks.detection.trace import compose, relative, sensor_positions
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import HALF_PI_RAD, rotated
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import preprocess
from locatk.core.landmarks.simulation.floor import floor_field, install_landmarks
from locatk.core.landmarks.simulation.options import Errors, Faults
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

ERRORS = Errors()


@dataclass(frozen=True)
class GrazeReading:
    """One visit: probabilities of its hypotheses, and which of them are right."""

    probability: Array
    is_right: NDArray[np.bool_]
    nees: float


def arc(random: np.random.Generator, centre: tuple[float, float], lateral_m: float) -> Array:
    """Return poses (n, 3) on an arc of 0.34 m that passes a point at a distance."""
    distance = np.arange(-0.17, 0.17, 0.0008)
    heading = random.uniform(-math.pi, math.pi) + random.normal(0, 1.0) * distance
    step = np.gradient(distance)
    path = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]) * step[:, None], axis=0)
    middle = len(path) // 2
    across = np.array([-math.sin(heading[middle]), math.cos(heading[middle])])
    return np.column_stack([path - path[middle] + centre + lateral_m * across, heading])


def drift_of_wheels(random: np.random.Generator, pose: Array) -> Array:
    """Return the path by the odometry of two wheels 0.1 m apart."""
    forward, rotation = np.hypot(*np.diff(pose[:, :2], axis=0).T), np.diff(pose[:, 2])
    wheels = forward[:, None] + rotation[:, None] * [-0.05, 0.05]
    wheels += ERRORS.wheel_noise_m * np.sqrt(np.abs(wheels)) * random.normal(size=wheels.shape)
    scale, turn = random.normal(0, 0.01, 2)
    drift = random.normal(0, ERRORS.odometry_drift_rad_per_m)
    forward, difference = wheels.mean(axis=1), (wheels[:, 1] - wheels[:, 0]) / 0.1
    heading = np.r_[0.0, np.cumsum((1 + turn) * difference + drift * forward)]
    half = (heading[1:] + heading[:-1]) / 2
    steps = (1 + scale) * forward[:, None] * np.column_stack([np.cos(half), np.sin(half)])
    return np.column_stack([np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]), heading])


def graze(seed: int, lateral_m: tuple[float, float] = (0.03, 0.07)) -> list[GrazeReading]:
    """Pass the middle landmark of 5 x 5 random ones on one side, and detect all on the path."""
    random = np.random.default_rng(seed)
    floor = FloorMap(random.integers(0, 16, (5, 5)))
    installed = install_landmarks(floor, ERRORS, Faults(), seed).values()
    side = random.choice([-1, 1])
    pose = arc(random, floor.position((2, 2)), side * random.uniform(*lateral_m))
    sensors = HallSensors()
    height = np.full((len(pose), 4, 1), floor.geometry.sensor_height_m)
    points = np.concatenate([sensor_positions(pose, sensors.position_m), height], axis=2)
    field = floor_field(floor.geometry, installed, points) * random.normal(1, ERRORS.gain, 4)
    field += random.normal(0, ERRORS.offset_t, 4) + random.laplace(0, 1e-4, field.shape)
    time_ns = np.arange(len(pose), dtype=np.int64) * 5_000_000
    by_wheels = drift_of_wheels(random, pose)
    odometry = Trajectory(
        "robot",
        "odometry",
        time_ns,
        np.column_stack([by_wheels[:, :2], np.zeros(len(pose))]),
        quaternion_from_heading(by_wheels[:, 2]),
        np.full((len(pose), 6, 6), np.nan),
    )
    recording = preprocess(HallSamples("robot", sensors, time_ns, field), odometry)
    priors = ModelPriors(noise_t=recording.noise_t)
    _, visits = detect_landmarks(recording, floor.geometry, priors, floor.pitch_m)
    readings = []
    for visit in visits:
        if visit.hypotheses.refused:
            continue
        robot = pose[np.searchsorted(time_ns, visit.hypotheses.time_ns)]
        several = visit.hypotheses.hypotheses
        is_right, nees = [], math.nan
        for one in several:
            # The hypothesis places a landmark on the floor: which one is there?
            rotation = robot[2] - one.pose[2]
            back = relative(np.zeros((1, 3)), one.pose)[0]
            centre = compose(robot, back)[:2]
            nearest = min(installed, key=lambda mark: math.dist((mark.x_m, mark.y_m), centre))
            quarters = round(rotation / HALF_PI_RAD)
            has_code = int(rotated(one.code, quarters)) == nearest.code
            frame = np.array([nearest.x_m, nearest.y_m, nearest.heading_rad])
            is_right.append(has_code and math.dist(frame[:2], centre) < 0.015)
            if one is several[0]:
                frame[2] += quarters * HALF_PI_RAD
                error = one.pose - relative(robot[None], frame)[0]
                error[2] = math.remainder(error[2], math.tau)
                nees = float(error @ np.linalg.solve(one.covariance, error))
        probability = np.array([one.probability for one in several])
        readings.append(GrazeReading(probability, np.array(is_right), nees))
    return readings


@functools.cache
def grazes() -> list[GrazeReading]:
    """Forty drives, with about two visits each."""
    return [reading for seed in range(700, 740) for reading in graze(seed)]


@pytest.mark.slow
def test_probabilities_of_grazes_are_calibrated() -> None:
    best = np.array([reading.probability[0] for reading in grazes()])
    is_right = np.array([reading.is_right[0] for reading in grazes()])
    is_sure = best > 0.9
    assert is_sure.sum() > 40
    # The number of wrong ones has a Poisson distribution.
    expected = (1 - best[is_sure]).sum()
    assert (~is_right[is_sure]).sum() <= expected + 3 * math.sqrt(expected)
    assert is_right[best > 0.99].all()
    assert abs(best.mean() - is_right.mean()) < 0.08


@pytest.mark.slow
def test_covariances_of_grazes_hold() -> None:
    nees = [reading.nees for reading in grazes() if reading.is_right[0]]
    assert 0.5 < np.mean(nees) / 3 < 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [705, 706, 824, 929])
def test_fields_of_neighbours_are_no_evidence(seed: int) -> None:
    """Without these fields in the model, wrong codes have P above 0.99 here."""
    for reading in graze(seed):
        assert reading.is_right[0] or reading.probability[0] < 0.99
        assert reading.probability[reading.is_right].sum() > 1e-3
