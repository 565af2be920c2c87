"""Description of recordings of landmarks, maps and hall sensors, in the units of their files."""

from __future__ import annotations

from typing import Any

import numpy as np

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.landmark import PATTERN_OF, PATTERNS
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.formats.artifacts.maps import attached_map, map_rows
from locatk.formats.descriptions.magnetic_samples import describe_samples
from locatk.formats.sessions.field_samples import HALLS, read_halls
from locatk.formats.sessions.reader import Session


def describe_recording(session: Session) -> dict[str, Any]:
    """Describe samples, sensors and map of a session; damaged contents are left out and reported.

    A solution has a map and no samples.
    """
    return describe_samples(
        session,
        attached_map,
        describe_map,
        "halls",
        HALLS,
        lambda: [(each, describe_hall_sensors(each.sensors)) for each in read_halls(session)],
        describe_hall_sensors,
    )


def describe_map(floor_map: FloorMap) -> dict[str, Any]:
    """Describe a map of landmarks: its design, its cells, and the landmarks as built."""
    geometry, codes = floor_map.geometry, floor_map.codes[floor_map.codes != HOLE_CODE]
    numbers = PATTERN_OF[codes]
    return {
        "name": floor_map.name or None,
        "rows": floor_map.shape[0],
        "columns": floor_map.shape[1],
        "landmarks": len(codes),
        "patterns": {
            letters: int(np.count_nonzero(numbers == number))
            for number, letters in enumerate(PATTERNS, 1)
        },
        "alphabet": floor_map.alphabet,
        "window": floor_map.window,
        "detect": floor_map.detect,
        "seed": floor_map.seed,
        "pitch_mm": 1e3 * floor_map.pitch_m,
        "origin_mm": [1e3 * each for each in floor_map.origin_m],
        "walls": len(floor_map.walls),
        "bars": {
            "size_mm": [
                1e3 * size
                for size in (geometry.bar_length_m, geometry.bar_width_m, geometry.bar_height_m)
            ],
            "remanence_t": geometry.remanence_t,
            "radius_mm": 1e3 * geometry.radius_m,
            "sensor_height_mm": 1e3 * geometry.sensor_height_m,
            "circle_mm": 1e3 * geometry.circle_m,
            "threshold_mt": 1e3 * geometry.threshold_t,
        },
        "map": map_rows(floor_map.codes),
        "built": [
            {
                "cell": cell,
                "x_mm": 1e3 * built.x_m,
                "y_mm": 1e3 * built.y_m,
                "heading_deg": float(np.degrees(built.heading_rad)),
                "strength": built.strength,
                "visits": built.visits,
                "flags": list(built.flags),
            }
            for cell, built in sorted(floor_map.built.items())
        ],
        "notes": list(floor_map.notes),
    }


def describe_hall_sensors(sensors: HallSensors) -> dict[str, Any]:
    """Describe positions and properties of hall sensors."""
    return {
        "sensor": sensors.sensor,
        "sensors": len(sensors),
        "names": list(sensors.names),
        "position_mm": 1e3 * sensors.position_m,
        "noise_ut": 1e6 * sensors.noise_t,
        "range_mt": 1e3 * sensors.range_t,
    }
