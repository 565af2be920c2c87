"""JSON form of live events, shared by all sinks that send JSON (docs/live.md)."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from locatk.core.solution import to_json
from locatk.core.streaming.events import (
    ArtifactUpdate,
    Correction,
    DetectionEvent,
    LiveEvent,
    PoseEstimate,
    StateChange,
    WarningEvent,
)

VERSION = 1


def event_to_json(event: LiveEvent, latency_s: float | None = None) -> dict[str, Any]:
    """Return an event as a dict of JSON values; numbers that are unknown are None.

    Poses have the fields of the CSV export (``locatk export``) and ``type``, ``frame``, ``state``,
    ``reason``, ``reset_counter``; other events their attributes. ``latency_s`` is added if given.
    """
    table = _fields(event)
    if latency_s is not None:
        table["latency_s"] = round(latency_s, 6)
    return table


def _fields(event: LiveEvent) -> dict[str, Any]:
    if isinstance(event, PoseEstimate):
        return _pose(event)
    if isinstance(event, StateChange):
        return {
            "type": "state",
            "time_s": event.time_ns * 1e-9,
            "device": event.device,
            "state": str(event.state),
            "reason": event.reason,
        }
    if isinstance(event, DetectionEvent):
        return {
            "type": "detection",
            "time_s": event.time_ns * 1e-9,
            "device": event.device,
            "detection": finite(to_json(event.detection)),
        }
    if isinstance(event, Correction):
        return {
            "type": "correction",
            "time_s": event.time_ns * 1e-9,
            "device": event.device,
            "displacement_m": finite(event.displacement_m.tolist()),
            "rotation_rad": finite(float(event.rotation_rad)),
            "reason": event.reason,
        }
    if isinstance(event, ArtifactUpdate):
        return {
            "type": "artifact",
            "time_s": event.time_ns * 1e-9,
            "version": event.version,
            "reason": event.reason,
        }
    assert isinstance(event, WarningEvent)
    return {
        "type": "warning",
        "time_s": event.time_ns * 1e-9,
        "device": event.device,
        "code": event.warning.code,
        "message": event.warning.message,
    }


def _pose(pose: PoseEstimate) -> dict[str, Any]:
    x, y, z = pose.position.tolist()
    has_orientation = pose.has_orientation
    quaternion = pose.quaternion.tolist() if has_orientation else [None] * 4
    with np.errstate(invalid="ignore"):
        sigma = finite(np.sqrt(np.diagonal(pose.covariance)).tolist())
    return {
        "type": "pose",
        "time_s": pose.time_ns * 1e-9,
        "device": pose.device,
        "frame": pose.frame,
        "x_m": x,
        "y_m": y,
        "z_m": z,
        "qx": quaternion[0],
        "qy": quaternion[1],
        "qz": quaternion[2],
        "qw": quaternion[3],
        "sigma_x_m": sigma[0],
        "sigma_y_m": sigma[1],
        "sigma_z_m": sigma[2],
        "sigma_heading_rad": sigma[5],
        "probability": finite(pose.probability),
        "state": str(pose.state),
        "reason": pose.reason,
        "reset_counter": pose.reset_counter,
    }


def finite(value: Any) -> Any:
    """Replace numbers that are not finite by None, in nested lists and dicts."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list):
        return [finite(each) for each in value]
    if isinstance(value, dict):
        return {key: finite(each) for key, each in value.items()}
    return value


def dump(value: object) -> bytes:
    """Return the shortest JSON of a value in UTF-8.

    Raises
    ------
    ValueError
        It contains a number that is not finite.
    """
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode(
        "utf-8", "replace"
    )
