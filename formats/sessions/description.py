"""Descriptions of artifacts and recordings of dots, polaris and landmarks for `locatk info`.

They consist of plain values for JSON, in the units of the artifacts' files.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import FormatError, InputError, LocatkError
from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.landmark import PATTERN_OF, PATTERNS
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.polaris import codec
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import maps, sheets
from locatk.formats.artifacts import tags as tag_files
from locatk.formats.sessions import capture_record, frames
from locatk.formats.sessions.field_samples import (
    HALLS,
    MAGNETOMETERS,
    MissingGeometryError,
    SensorKind,
    read_halls,
    read_magnetometers,
)
from locatk.formats.sessions.mcap_file import DamageError
from locatk.formats.sessions.reader import Session


def manifest(printed: Manifest) -> dict[str, Any]:
    """Describe how the sheets of a manifest were printed, and their positions."""
    return {
        "codec": printed.codec,
        "pitch_mm": printed.pitch_mm,
        "dot_mm": printed.dot_mm,
        "offset_mm": printed.offset_mm,
        "dpi": printed.dpi,
        "scale_x": printed.scale[0],
        "scale_y": printed.scale[1],
        "sheets": [
            {
                "id": sheet.id,
                "frame": printed.frame(number),
                "origin": sheet.origin,
                "size": sheet.size,
                "section": sheet.section,
                "page_mm": sheet.page_mm,
                "pattern_mm": [round(n * printed.pitch_mm, 3) for n in sheet.size],
                "position_mm": sheet.position_mm,
                "heading_deg": None if sheet.position_mm is None else sheet.heading_deg,
            }
            for number, sheet in enumerate(printed.sheets)
        ],
        "notes": list(printed.notes),
    }


def camera(lens: Camera) -> dict[str, Any]:
    """Describe a camera, and the largest displacement of a corner of the frame by its lens."""
    width, height = lens.size
    corners = np.array([(x, y) for x in (0, width - 1) for y in (0, height - 1)], float)
    displacement = np.linalg.norm(lens.undistort(corners) - corners, axis=1).max()
    return {
        "size_px": lens.size,
        "focal_px": lens.focal_px,
        "centre_px": lens.centre_px,
        "radial": lens.radial,
        "distortion_px": float(displacement),
    }


def damage(session: Session, error: LocatkError) -> dict[str, Any]:
    """Describe the damage of a session that could not be read completely.

    It is recoverable if the MCAP file is damaged, of which `locatk recover` saves the rest.
    """
    is_file_damaged = session.damage is not None or isinstance(error.__context__, DamageError)
    return {"damage": session.damage or error.message, "recoverable": is_file_damaged}


def dots(session: Session) -> dict[str, Any]:
    """Describe frames, sheets and camera of a session; damaged contents are left out and reported.

    A solution has sheets and no frames.
    """
    described: dict[str, Any] = {}
    try:
        sheet = sheets.attached_manifest(session)
        if sheet is not None:
            described |= manifest(sheet)
        lens = sheets.attached_camera(session)
        if lens is not None:
            described["camera"] = camera(lens)
        topics = [t for schema in frames.SCHEMAS for t in session.topics(frames.TOPIC, schema)]
        if topics and not capture_record.is_few(session, topics):
            described |= _counted_frames(session, topics)
        elif topics:
            cameras = frames.read_frames(session)
            described["cameras"] = [
                {"device": each.device, "frames": len(each), "size_px": _size(each.images)}
                for each in cameras
            ]
            described["devices"] = [each.device for each in cameras]
            described["frames"] = sum(map(len, cameras))
    except LocatkError as error:
        described |= damage(session, error)
    return described


def _counted_frames(session: Session, topics: list[str]) -> dict[str, Any]:
    """Describe the frames of a large session without reading any."""
    cameras = [
        {
            "device": topic.removeprefix(frames.TOPIC),
            "frames": capture_record.messages(session, topic),
            "size_px": None,
        }
        for topic in sorted(topics)
    ]
    return {
        "cameras": cameras,
        "devices": [each["device"] for each in cameras],
        "frames": sum(each["frames"] for each in cameras),
        "unread_bytes": capture_record.held_bytes(session, topics),
    }


def _size(images: Any) -> list[int] | None:
    """Return (width, height) of the first frame; None without one, or if it cannot be read."""
    if not len(images):
        return None
    try:
        height, width = images[0].shape
    except InputError:
        return None
    return [width, height]


def tags(design: Tags) -> dict[str, Any]:
    """Describe the design of tags, and the known measurements of each."""
    magnet = design.magnet
    numbers = set(design.ids or ()) | set(design.built) | set(design.site)
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
        "tags": [_tag(design, number) for number in sorted(numbers)],
        "notes": list(design.notes),
    }


def _tag(design: Tags, number: int) -> dict[str, Any]:
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
    }


def array(sensors: SensorArray) -> dict[str, Any]:
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


def polaris(session: Session) -> dict[str, Any]:
    """Describe samples, arrays and tags of a session; damaged contents are left out and reported.

    A solution has tags and no samples.
    """
    return _describe_samples(
        session,
        tag_files.attached_tags,
        tags,
        "arrays",
        MAGNETOMETERS,
        lambda: [(each, array(each.array)) for each in read_magnetometers(session)],
        array,
    )


def _describe_samples(
    session: Session,
    read_artifact: Callable[[Session], Any],
    describe_artifact: Callable[[Any], dict[str, Any]],
    key: str,
    kind: SensorKind[Any],
    read_samples: Callable[[], list[tuple[Samples | HallSamples, dict[str, Any]]]],
    describe_sensors: Callable[[Any], dict[str, Any]],
) -> dict[str, Any]:
    """Describe the artifact and the samples of a session.

    Samples are read only if they are few and every device has some; ``read_samples`` returns
    them with the description of their sensors. Their descriptions get the name ``key``.
    """
    described: dict[str, Any] = {}
    try:
        artifact = read_artifact(session)
        if artifact is not None:
            described |= describe_artifact(artifact)
        topics = kind.topics(session)
        is_small = capture_record.is_small(session, topics)
        if topics and is_small and all(capture_record.messages(session, topic) for topic in topics):
            recordings = read_samples()
            described[key] = [{**_recorded(each), **sensors} for each, sensors in recordings]
            described["samples"] = sum(len(each) for each, _ in recordings)
        elif topics:
            entries = [_unread(session, kind, topic) for topic in topics]
            described[key] = [{**entry, **describe_sensors(known)} for entry, known in entries]
            counts = [entry["samples"] for entry, _ in entries]
            described["samples"] = None if None in counts else sum(counts)
            described["unread_bytes"] = (
                None if is_small else capture_record.held_bytes(session, topics)
            )
        if topics:
            described["devices"] = [each["device"] for each in described[key]]
    except MissingGeometryError as error:
        described["notes"] = [f"{error.message}. {error.hint}"]
    except LocatkError as error:
        described |= damage(session, error)
    return described


def _unread(session: Session, kind: SensorKind[Any], topic: str) -> tuple[dict[str, Any], Any]:
    """Describe the samples of a device without reading them; return also its geometry."""
    device = topic.removeprefix(kind.topic)
    geometry = kind.attached(session, device)
    if geometry is None:
        raise FormatError(f"no geometry of the {kind.geometry} {device!r}")
    count = capture_record.samples(session, topic) if capture_record.messages(session, topic) else 0
    entry = {
        "device": device,
        "samples": count,
        "rate_hz": capture_record.rate_hz(session, count),
        "left_out": None,
    }
    return entry, geometry


def _recorded(samples: Samples | HallSamples) -> dict[str, Any]:
    span = float(samples.time_ns[-1] - samples.time_ns[0]) * 1e-9
    return {
        "device": samples.device,
        "samples": len(samples),
        "rate_hz": (len(samples) - 1) / span if span > 0 else None,
        "left_out": int(np.count_nonzero(np.isnan(samples.field_t))),
    }


def floor(floor_map: FloorMap) -> dict[str, Any]:
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
        "map": maps.map_rows(floor_map.codes),
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


def hall_sensors(sensors: HallSensors) -> dict[str, Any]:
    """Describe positions and properties of hall sensors."""
    return {
        "sensor": sensors.sensor,
        "sensors": len(sensors),
        "names": list(sensors.names),
        "position_mm": 1e3 * sensors.position_m,
        "noise_ut": 1e6 * sensors.noise_t,
        "range_mt": 1e3 * sensors.range_t,
    }


def landmarks(session: Session) -> dict[str, Any]:
    """Describe samples, sensors and map of a session; damaged contents are left out and reported.

    A solution has a map and no samples.
    """
    return _describe_samples(
        session,
        maps.attached_map,
        floor,
        "halls",
        HALLS,
        lambda: [(each, hall_sensors(each.sensors)) for each in read_halls(session)],
        hall_sensors,
    )
