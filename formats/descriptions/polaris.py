"""Description of recordings of polaris, tags and sensor arrays, in the units of their files."""

from __future__ import annotations

from typing import Any

import numpy as np

from locatk.core.polaris import codec
from locatk.core.polaris.array import SensorArray
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts.tags import attached_tags
from locatk.formats.descriptions.magnetic_samples import describe_samples
from locatk.formats.sessions.field_samples import MAGNETOMETERS, read_magnetometers
from locatk.formats.sessions.reader import Session


def describe_recording(session: Session) -> dict[str, Any]:
    """Describe samples, arrays and tags of a session; damaged contents are left out and reported.

    A solution has tags and no samples.
    """
    return describe_samples(
        session,
        attached_tags,
        describe_tags,
        "arrays",
        MAGNETOMETERS,
        lambda: [(each, describe_array(each.array)) for each in read_magnetometers(session)],
        describe_array,
    )


def describe_tags(design: Tags) -> dict[str, Any]:
    """Describe the design of tags, and the known measurements of each."""
    magnet = design.magnet
    numbers = {*(design.ids or ()), *design.built, *design.site, *design.meanings}
    return {
        "codec": design.codec,
        "order": design.order,
        "magnets": design.magnets,
        "orientations": design.orientations,
        "spacing_mm": 1e3 * design.spacing_m,
        "clearance_mm": 1e3 * design.clearance_m,
        "magnet": {
            "diameter_mm": 1e3 * magnet.diameter_m,
            "height_mm": 1e3 * magnet.height_m,
            "remanence_t": magnet.remanence_t,
            "grade": magnet.grade,
            "moment_am2": magnet.moment,
        },
        "capacity": codec.capacity(design),
        "family": None if design.ids is None else len(design.ids),
        "min_distance": design.min_distance,
        "tags": [_describe_tag(design, number) for number in sorted(numbers)],
        "notes": list(design.notes),
    }


def _describe_tag(design: Tags, number: int) -> dict[str, Any]:
    layout = codec.layout_of(design, number)
    built, pose = design.built.get(number), design.site.get(number)
    return {
        "id": number,
        "cells": layout.cells,
        "symbols": layout.symbols,
        "passes": None if built is None else built.passes,
        "offset_mm": None if built is None else 1e3 * built.offset_m,
        "angle_deg": None if built is None else np.degrees(built.angle_rad),
        "position_mm": None if pose is None else [1e3 * pose.x_m, 1e3 * pose.y_m],
        "heading_deg": None if pose is None else float(np.degrees(pose.heading_rad)),
        "meaning": design.meanings.get(number),
    }


def describe_array(sensors: SensorArray) -> dict[str, Any]:
    """Describe positions and properties of the sensors of an array."""
    return {
        "sensor": sensors.sensor,
        "sensors": len(sensors),
        "position_mm": 1e3 * sensors.position_m,
        "noise_ut": 1e6 * sensors.noise_t,
        "delay_ms": 1e3 * sensors.delay_s,
        "quantum_ut": 1e6 * np.where(sensors.quantum_t > 0, sensors.quantum_t, np.nan),
        "range_ut": 1e6 * sensors.range_t,
    }
