"""What `locatk info` says of dots, polaris and landmarks: artifacts and recordings, as plain
values."""

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
from locatk.formats.sessions import capture_record as captured
from locatk.formats.sessions import frames, halls
from locatk.formats.sessions import magnetometers as arrays
from locatk.formats.sessions.field_samples import Kind, NoGeometryError
from locatk.formats.sessions.mcap_file import DamageError
from locatk.formats.sessions.reader import Session


def manifest(found: Manifest) -> dict[str, Any]:
    """How the sheets of a manifest were printed, and where they are."""
    return {
        "codec": found.codec,
        "pitch_mm": found.pitch_mm,
        "dot_mm": found.dot_mm,
        "offset_mm": found.offset_mm,
        "dpi": found.dpi,
        "scale_x": found.scale[0],
        "scale_y": found.scale[1],
        "sheets": [
            {
                "id": sheet.id,
                "frame": found.frame(number),
                "origin": sheet.origin,
                "size": sheet.size,
                "section": sheet.section,
                "page_mm": sheet.page_mm,
                "pattern_mm": [round(n * found.pitch_mm, 3) for n in sheet.size],
                "position_mm": sheet.position_mm,
                "heading_deg": None if sheet.position_mm is None else sheet.heading_deg,
            }
            for number, sheet in enumerate(found.sheets)
        ],
        "notes": list(found.notes),
    }


def camera(found: Camera) -> dict[str, Any]:
    """A camera, and by how much its lens moves a corner of the frame."""
    width, height = found.size
    corners = np.array([(x, y) for x in (0, width - 1) for y in (0, height - 1)], float)
    moved = np.linalg.norm(found.undistort(corners) - corners, axis=1).max()
    return {
        "size_px": found.size,
        "focal_px": found.focal_px,
        "centre_px": found.centre_px,
        "radial": found.radial,
        "distortion_px": float(moved),
    }


def damage(session: Session, error: LocatkError) -> dict[str, Any]:
    """What is wrong with a session of which something could not be read, and whether it is
    the file, of which `locatk recover` saves the rest."""
    broken = session.damage is not None or isinstance(error.__context__, DamageError)
    return {"damage": session.damage or error.message, "recoverable": broken}


def dots(session: Session) -> dict[str, Any]:
    """Frames, sheets and camera of a session; what is damaged is left out and said.

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
        if topics and not captured.is_few(session, topics):
            described |= _counted_frames(session, topics)
        elif topics:
            found = frames.read_frames(session)
            described["cameras"] = [
                {"device": each.device, "frames": len(each), "size_px": _size(each.images)}
                for each in found
            ]
            described["devices"] = [each.device for each in found]
            described["frames"] = sum(map(len, found))
    except LocatkError as error:
        described |= damage(session, error)
    return described


def _counted_frames(session: Session, topics: list[str]) -> dict[str, Any]:
    """Frames of a large session, none of them looked at."""
    cameras = [
        {
            "device": topic.removeprefix(frames.TOPIC),
            "frames": captured.messages(session, topic),
            "size_px": None,
        }
        for topic in sorted(topics)
    ]
    return {
        "cameras": cameras,
        "devices": [each["device"] for each in cameras],
        "frames": sum(each["frames"] for each in cameras),
        "unread_bytes": captured.held_bytes(session, topics),
    }


def _size(images: Any) -> list[int] | None:
    """(width, height) of the first frame, None where there is none or it cannot be read."""
    if not len(images):
        return None
    try:
        height, width = images[0].shape
    except InputError:
        return None
    return [width, height]


def tags(found: Tags) -> dict[str, Any]:
    """The design of tags, and what is known of each."""
    magnet = found.magnet
    numbers = set(found.ids or ()) | set(found.built) | set(found.site)
    return {
        "codec": found.codec,
        "order": found.order,
        "magnets": found.magnets,
        "orientations": found.orientations,
        "spacing_mm": 1e3 * found.spacing_m,
        "clearance_mm": 1e3 * found.clearance_m,
        "magnet": {
            "diameter_mm": 1e3 * magnet.diameter_m,
            "height_mm": 1e3 * magnet.height_m,
            "remanence_t": magnet.remanence_t,
            "grade": magnet.grade,
            "moment_am2": magnet.moment,
        },
        "capacity": codec.capacity(found),
        "family": None if found.ids is None else len(found.ids),
        "min_distance": found.min_distance,
        "tags": [_tag(found, number) for number in sorted(numbers)],
        "notes": list(found.notes),
    }


def _tag(found: Tags, number: int) -> dict[str, Any]:
    layout = codec.layout_of(found, number)
    built, place = found.built.get(number), found.site.get(number)
    return {
        "id": number,
        "cells": layout.cells,
        "symbols": layout.symbols,
        "passes": None if built is None else built.passes,
        "offset_mm": None if built is None else 1e3 * built.offset_m,
        "angle_deg": None if built is None else np.degrees(built.angle_rad),
        "position_mm": None if place is None else [1e3 * place.x_m, 1e3 * place.y_m],
        "heading_deg": None if place is None else float(np.degrees(place.heading_rad)),
    }


def array(found: SensorArray) -> dict[str, Any]:
    """Where the sensors of an array sit, and how they measure; None where unknown."""
    return {
        "sensor": found.sensor,
        "sensors": len(found),
        "position_mm": 1e3 * found.position_m,
        "noise_ut": 1e6 * found.noise_t,
        "delay_ms": 1e3 * found.delay_s,
        "quantum_ut": 1e6 * np.where(found.quantum_t > 0, found.quantum_t, np.nan),
        "range_ut": 1e6 * found.range_t,
    }


def polaris(session: Session) -> dict[str, Any]:
    """Samples, arrays and tags of a session; what is damaged is left out and said.

    A solution has tags and no samples.
    """
    return _described(
        session, tag_files.attached_tags, tags, "arrays", arrays, lambda each: each.array, array
    )


def _described(
    session: Session,
    attached: Callable[[Session], Any],
    told: Callable[[Any], dict[str, Any]],
    name: str,
    samples: Any,
    geometry: Callable[[Any], Any],
    sensors: Callable[[Any], dict[str, Any]],
) -> dict[str, Any]:
    """What is ``attached``, as it is ``told``, and the samples that the module ``samples``
    reads, under ``name``, with the ``sensors`` whose ``geometry`` they have. Of a large session
    the samples are not read, nor where a device has none."""
    described: dict[str, Any] = {}
    kind = samples.KIND
    try:
        known = attached(session)
        if known is not None:
            described |= told(known)
        topics = session.topics(kind.topic, kind.schema)
        small = captured.is_small(session, topics)
        if topics and small and all(captured.messages(session, topic) for topic in topics):
            found = samples.read_samples(session)
            described[name] = [{**_recorded(each), **sensors(geometry(each))} for each in found]
            described["samples"] = sum(map(len, found))
        elif topics:
            entries = [_unread(session, kind, topic) for topic in topics]
            described[name] = [{**entry, **sensors(known)} for entry, known in entries]
            counts = [entry["samples"] for entry, _ in entries]
            described["samples"] = None if None in counts else sum(counts)
            described["unread_bytes"] = None if small else captured.held_bytes(session, topics)
        if topics:
            described["devices"] = [each["device"] for each in described[name]]
    except NoGeometryError as error:
        described["notes"] = [f"{error.message}. {error.hint}"]
    except LocatkError as error:
        described |= damage(session, error)
    return described


def _unread(session: Session, kind: Kind[Any], topic: str) -> tuple[dict[str, Any], Any]:
    """What is known of a device's samples before reading them, and its geometry."""
    device = topic.removeprefix(kind.topic)
    geometry = kind.attached(session, device)
    if geometry is None:
        raise FormatError(f"no geometry of the {kind.geometry} {device!r}")
    count = captured.samples(session, topic) if captured.messages(session, topic) else 0
    entry = {
        "device": device,
        "samples": count,
        "rate_hz": captured.rate_hz(session, count),
        "left_out": None,
    }
    return entry, geometry


def _recorded(found: Samples | HallSamples) -> dict[str, Any]:
    span = float(found.time_ns[-1] - found.time_ns[0]) * 1e-9
    return {
        "device": found.device,
        "samples": len(found),
        "rate_hz": (len(found) - 1) / span if span > 0 else None,
        "left_out": int(np.count_nonzero(np.isnan(found.field_t))),
    }


def floor(found: FloorMap) -> dict[str, Any]:
    """A map of landmarks: its design, what lies where, and how it was really laid."""
    geometry, laid = found.geometry, found.codes[found.codes != HOLE_CODE]
    numbers = PATTERN_OF[laid]
    return {
        "name": found.name or None,
        "rows": found.shape[0],
        "columns": found.shape[1],
        "landmarks": len(laid),
        "patterns": {
            letters: int(np.count_nonzero(numbers == number))
            for number, letters in enumerate(PATTERNS, 1)
        },
        "alphabet": found.alphabet,
        "window": found.window,
        "detect": found.detect,
        "seed": found.seed,
        "pitch_mm": 1e3 * found.pitch_m,
        "origin_mm": [1e3 * each for each in found.origin_m],
        "walls": len(found.walls),
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
        "map": maps.map_rows(found.codes),
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
            for cell, built in sorted(found.built.items())
        ],
        "notes": list(found.notes),
    }


def hall_sensors(found: HallSensors) -> dict[str, Any]:
    """Where hall sensors sit, and how they measure; None where unknown."""
    return {
        "sensor": found.sensor,
        "sensors": len(found),
        "names": list(found.names),
        "position_mm": 1e3 * found.position_m,
        "noise_ut": 1e6 * found.noise_t,
        "range_mt": 1e3 * found.range_t,
    }


def landmarks(session: Session) -> dict[str, Any]:
    """Samples, hall sensors and map of a session; what is damaged is left out and said.

    A solution has a map and no samples.
    """
    return _described(
        session, maps.attached_map, floor, "halls", halls, lambda each: each.sensors, hall_sensors
    )
