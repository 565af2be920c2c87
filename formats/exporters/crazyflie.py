"""System configurations of the Crazyflie (YAML), for cfclient and cflib.

The format is described in :mod:`locatk.formats.importers.crazyflie`. Only factory calibrations are
written. A Crazyflie replaces others within half a minute by the calibration that it receives, and a
reader could not distinguish an estimate from it.

A Crazyflie takes z for up and z = 0 for the floor: it holds the height that it is commanded, and
lands where z is 0. Frames that are not level are therefore refused (:func:`describe_frame_fault`).
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from locatk.core.errors import InputError
from locatk.core.lighthouse.calibration import PARAMETERS
from locatk.core.lighthouse.scene import Scene
from locatk.formats.importers.crazyflie import (
    FRAME,
    MODEL_NOTE,
    OWN_SOLVER,
    SOLVER,
    SYSTEM_V2,
    TYPE,
    VERSION,
    list_channels,
)
from locatk.formats.output import atomic_write

FORMER_MODEL_NOTE = (
    "stations are taken as the Crazyflie estimates them, whose calibration model leaves curve and "
    "ogee out: solve again for millimetres"
)
"""Wording of :data:`MODEL_NOTE` in scenes of earlier versions."""

LEVEL_FRAME_HINT = (
    "Fix the frame by points of the floor on which a device rested: locatk calibrate scene SESSION "
    "--floor, or give three or more markers"
)


def describe_frame_fault(scene: Scene) -> str | None:
    """Return why the frame of a scene with stations is not level on the floor, or None if it is.

    Level are frames of markers, of points on the floor, of planar scenes with stations above their
    floor, and of a Crazyflie's configuration. Other frames in space have the axes of a station, or
    their origin in it.
    """
    if scene.planar:
        if all(station.position[2] < scene.floor_z for station in scene.stations):
            return f"z of the frame {scene.frame!r} points down: all stations are below the floor"
        return None
    if scene.frame_source in ("markers", "floor"):
        return None
    if scene.frame_source == "gravity":
        return f"the origin of the frame {scene.frame!r} is not known to be on the floor"
    if scene.scale == "markers" or scene.frame == FRAME:
        return None
    return f"the frame {scene.frame!r} is not level: nothing relates its axes to the floor"


def dumps_config(scene: Scene, *, allow_tilted: bool = False) -> str:
    """Return the YAML text of a scene for cfclient, cflib and the Crazyflie.

    The same scene gives the same text. Comments state the frame and the calibrations that are
    omitted.

    Parameters
    ----------
    scene : Scene
    allow_tilted : bool
        Also write frames that are not level, with a comment.

    Raises
    ------
    InputError
        The scene has no stations, no scale, or numbers that are not finite; or its frame is not
        level.
    """
    if not scene.stations:
        raise InputError(
            "the scene has no stations to export", hint="Solve a session first (locatk solve)"
        )
    if scene.scale == "unit":
        raise InputError(
            "the scene has no scale: a Crazyflie needs metres",
            hint="Give markers or a distance to locatk solve",
        )
    fault = describe_frame_fault(scene)
    if fault and not allow_tilted:
        raise InputError(fault, hint=LEVEL_FRAME_HINT)
    geos, calibs, omitted = {}, {}, []
    calibrations = dict(scene.calibrations) | {s.channel: s.calibration for s in scene.stations}
    ids = dict(scene.ids) | {s.channel: s.id for s in scene.stations}
    for station in scene.stations:
        if not (np.all(np.isfinite(station.position)) and np.all(np.isfinite(station.rotation))):
            raise InputError(f"the pose of the station on channel {station.channel} is not finite")
        geos[station.channel - 1] = {
            "origin": np.asarray(station.position, float).tolist(),
            "rotation": np.asarray(station.rotation, float).tolist(),
        }
    for channel, calibration in sorted(calibrations.items()):
        if calibration.source != "factory":
            omitted.append(channel)
            continue
        if not np.all(np.isfinite(calibration.sweeps)):
            raise InputError(f"the calibration of channel {channel} is not finite")
        calibs[channel - 1] = {
            "sweeps": [
                dict(zip(PARAMETERS, row, strict=True)) for row in calibration.sweeps.tolist()
            ],
            "uid": int(ids.get(channel) or 0),
        }
    head = [f"# Positions in the frame {scene.frame!r}; ids are channels less one."]
    if fault:
        head.append(f"# NOT FOR FLIGHT: {fault}.")
    if omitted:
        head.append(
            f"# No factory calibration of {list_channels(omitted)}: "
            "the Crazyflie takes it from the light."
        )
    is_of_crazyflie = not {MODEL_NOTE, FORMER_MODEL_NOTE}.isdisjoint(scene.notes)
    head += [f"type: {TYPE}", f"version: '{VERSION}'", f"systemType: {SYSTEM_V2}"]
    if not is_of_crazyflie:
        head.append(f"{SOLVER}: {OWN_SOLVER}")
    tables = {"geos": dict(sorted(geos.items())), "calibs": calibs}
    return "\n".join([*head, *_yaml_lines(tables)]) + "\n"


def _yaml_lines(value: Any) -> list[str]:
    """Return the lines of a number, list or mapping in YAML's block style."""
    lines: list[str] = []
    if isinstance(value, dict):
        for key, item in value.items():
            block = _yaml_lines(item)
            if isinstance(item, list):
                lines += [f"{key}:", *block]
            elif isinstance(item, dict) and item:
                lines += [f"{key}:", *(f"  {line}" for line in block)]
            else:
                lines.append(f"{key}: {block[0]}")
        return lines or ["{}"]
    if isinstance(value, list):
        for item in value:
            first, *others = _yaml_lines(item)
            lines += [f"- {first}", *(f"  {line}" for line in others)]
        return lines
    text = repr(value)
    # To YAML 1.1, 1e-07 is a text: a number has a point.
    return [text if "." in text else text.replace("e", ".0e")]


def write_config(
    path: str | os.PathLike[str],
    scene: Scene,
    *,
    allow_tilted: bool = False,
    overwrite: bool = False,
) -> None:
    """Write a scene as a system configuration.

    Raises
    ------
    InputError
        See :func:`dumps_config`.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    text = dumps_config(scene, allow_tilted=allow_tilted)
    with atomic_write(path, overwrite=overwrite) as stream:
        stream.write(text.encode())
