"""Rooms with ideal stations, devices that rest and move in them, and their sweeps.

The planes are predicted with the published formula of an ideal station, azimuth -+ asin(tan(30 deg)
z / r) (Bitcraze, kalman_measurement_model.md), and not with the package's model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene import Scene, Station

IDEAL = Calibration(np.zeros((2, 7)), "factory")
PERIODS = {1: 959000, 2: 957000, 3: 953000, 4: 949000}
START_NS = 1_700_000_000_000_000_000


def looking_at(position: np.ndarray, target: np.ndarray, roll_rad: float = 0.0) -> np.ndarray:
    """Rotation of a station that looks at a point; x forward, y left, z up, then rolled."""
    forward = (target - position) / np.linalg.norm(target - position)
    left = np.cross([0.0, 0.0, 1.0], forward)
    left /= np.linalg.norm(left)
    upright = np.stack([forward, left, np.cross(forward, left)], axis=1)
    return upright @ rotation_exp([roll_rad, 0.0, 0.0])


def room(rng: np.random.Generator, count: int = 2, roll_rad: float = 0.1) -> Scene:
    """Stations on the walls, looking at the middle of the floor; z is up."""
    stations = []
    for k in range(count):
        azimuth = 2 * np.pi * k / max(count, 3) + rng.uniform(-0.3, 0.3)
        position = np.array(
            [2.5 * np.cos(azimuth), 2.5 * np.sin(azimuth), 2.0 + rng.uniform(-0.3, 0.3)]
        )
        rotation = looking_at(position, rng.normal(0, 0.2, 3), rng.normal(0, roll_rad))
        stations.append(Station(k + 1, position, rotation, IDEAL))
    return Scene(tuple(stations), scale="markers", frame_source="markers")


def rotor_angles(station: Station, points: np.ndarray) -> np.ndarray:
    """Rotor angles (n, 2) at which the planes of an ideal station cross points (n, 3)."""
    x, y, z = ((points - station.position) @ station.rotation).T
    slope = np.arcsin(np.tan(np.pi / 6) * z / np.hypot(x, y))
    azimuth = np.arctan2(y, x)
    return np.stack([azimuth - slope, azimuth + slope], axis=1)


@dataclass
class Stay:
    """Rest of a device at a point, after a motion there."""

    point: tuple[float, float, float]
    rest_s: float = 3.0
    move_s: float = 1.5


def path(stays: Sequence[Stay], time_s: np.ndarray) -> np.ndarray:
    """Positions (n, 3) of a device that moves evenly from rest to rest."""
    times, points = [], []
    now = 0.0
    for stay in stays:
        times += [now, now + stay.rest_s]
        points += [stay.point, stay.point]
        now += stay.rest_s + stay.move_s
    return np.stack([np.interp(time_s, times, [p[k] for p in points]) for k in range(3)], axis=1)


def sweeps_of(
    scene: Scene,
    stays: Sequence[Stay],
    rng: np.random.Generator,
    *,
    noise_rad: float = 1e-4,
    offsets: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0),),
    device: str = "robot",
    wobble_m: float = 0.0,
) -> Sweeps:
    """Sweeps of the photodiodes at ``offsets`` of a device, which does not turn."""
    rows = []
    end_s = sum(stay.rest_s + stay.move_s for stay in stays) - stays[-1].move_s
    for station in scene.stations:
        period = PERIODS[station.channel]
        zero_s = np.arange(rng.uniform(0, 0.02), end_s, period / 48e6)
        for sensor, offset in enumerate(offsets):
            for plane in (0, 1):
                time_s = zero_s + (plane + 1) / 3 * period / 48e6
                position = path(stays, time_s) + offset
                position += wobble_m * np.sin(2 * np.pi * time_s / 7.0)[:, None]
                angle = rotor_angles(station, position)[:, plane]
                angle = angle + rng.normal(0, noise_rad, len(angle))
                turn = (angle + 2 * np.pi * (plane + 1) / 3) / (2 * np.pi)
                rows.append(
                    (
                        START_NS + np.rint(1e9 * (zero_s + turn * period / 48e6)).astype(np.int64),
                        np.full(len(zero_s), sensor),
                        np.full(len(zero_s), station.channel),
                        np.full(len(zero_s), plane),
                        turn * period / 8,
                    )
                )
    columns = [np.concatenate(parts) for parts in zip(*rows, strict=True)]
    order = np.argsort(columns[0], kind="stable")
    time_ns, sensor, channel, plane, count = (column[order] for column in columns)
    return Sweeps(
        (device,),
        time_ns,
        np.zeros(len(order), np.int32),
        sensor.astype(np.int32),
        channel.astype(np.int32),
        (2 * (channel - 1)).astype(np.int32),
        plane.astype(np.int32),
        count,
    )


def measured_up(rng: np.random.Generator, station: Station, sigma_rad: float) -> np.ndarray:
    """Direction of the accelerometer of a station, in its axes, in a room with z up."""
    return station.rotation.T @ rotation_exp(rng.normal(0, sigma_rad, 3))[:, 2]
