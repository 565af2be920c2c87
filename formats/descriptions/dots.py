"""Description of recordings of dots, sheets and cameras, in the units of their files."""

from __future__ import annotations

from typing import Any

import numpy as np

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError, LocatkError
from locatk.formats.artifacts import sheets
from locatk.formats.sessions import capture_record, frames
from locatk.formats.sessions.reader import Session


def describe_recording(session: Session) -> dict[str, Any]:
    """Describe frames, sheets and camera of a session; damaged contents are left out and reported.

    A solution has sheets and no frames.
    """
    described: dict[str, Any] = {}
    try:
        sheet = sheets.attached_manifest(session)
        if sheet is not None:
            described |= describe_manifest(sheet)
        lens = sheets.attached_camera(session)
        if lens is not None:
            described["camera"] = describe_camera(lens)
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
        described |= capture_record.describe_damage(session, error)
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


def describe_manifest(printed: Manifest) -> dict[str, Any]:
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


def describe_camera(lens: Camera) -> dict[str, Any]:
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
