"""What `locatk info` says of the dots: sheets, cameras and frames, as plain values."""

from __future__ import annotations

from typing import Any

import numpy as np

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import InputError, LocatkError
from locatk.formats import frames, sheets
from locatk.formats.session import Session


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
        if any(session.topics(frames.TOPIC, schema) for schema in frames.SCHEMAS):
            found = frames.read_frames(session)
            described["cameras"] = [
                {"device": each.device, "frames": len(each), "size_px": _size(each.images)}
                for each in found
            ]
            described["devices"] = [each.device for each in found]
            described["frames"] = sum(map(len, found))
    except LocatkError as error:
        described["damage"] = session.damage or error.message
    return described


def _size(images: Any) -> list[int] | None:
    """(width, height) of the first frame, None where it cannot be read."""
    try:
        height, width = images[0].shape
    except InputError:
        return None
    return [width, height]
