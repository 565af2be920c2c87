"""Combination of a scene that is given as an artifact with that of a session.

The artifact is what the user names, and counts first; the session adds what it lacks. Stations are
those of the artifact alone: two surveys of a room have different frames.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locatk.core.lighthouse.scene import Marker, Scene
from locatk.core.lighthouse.scene.designed_frame import is_design
from locatk.core.solution import SolverWarning

MAX_MARKER_DIFFERENCE_M = 1e-3
"""Difference from which two positions of one marker are a conflict: markers are measured to
millimetres."""


def merge_scenes(given: Scene, own: Scene | None) -> tuple[Scene, list[SolverWarning]]:
    """Return the artifact ``given`` completed by the scene of the session, and their conflicts.

    - Stations are those of the artifact.
    - Calibrations, serial numbers and directions of gravity are those of the artifact, by channel;
      of other channels those of the session.
    - Markers are those of both. The position of a marker in both is that of the artifact. Its
      visits are those of the artifact if this has no stations, and otherwise those of the session:
      visits in a solved scene are of the recording from which it was estimated.
    - Distances are those of the artifact, or else of the session.
    - Without stations and markers in the artifact, ``frame``, ``planar`` and ``floor_z`` are those
      of the session.
    - Designed stations of the session remain if the artifact has none: they are a prior.
    """
    if own is None:
        return given, []
    if is_design(own) and not given.stations:
        design = replace(own, calibrations=given.calibrations, ids=given.ids, ups=given.ups)
        design = replace(design, markers=given.markers, distances=given.distances)
        return merge_scenes(design, replace(own, stations=()))
    markers, conflicts = _merge_markers(given, own)
    merged = replace(
        given,
        markers=markers,
        distances=given.distances or own.distances,
        planar=own.planar if given.planar is None and not given.stations else given.planar,
        calibrations={**own.calibrations, **given.calibrations},
        ids={**own.ids, **given.ids},
        ups={**own.ups, **given.ups},
    )
    if not given.stations and not given.markers:
        merged = replace(merged, frame=own.frame, floor_z=given.floor_z or own.floor_z)
    return merged, conflicts


def knowledge_of_stations(scene: Scene) -> Scene:
    """Return a scene whose stations have yet to be estimated, with what is known of them.

    Their factory calibrations, serial numbers and directions of gravity are kept. Estimated
    calibrations are not: they fit the poses that they were estimated with. A design is returned as
    it is: its stations are estimated anyway.
    """
    stations = scene.stations
    if not stations or is_design(scene):
        return scene
    factory = {s.channel: s.calibration for s in stations if s.calibration.source == "factory"}
    ids = {s.channel: s.id for s in stations if s.id is not None}
    ups = {s.channel: s.up for s in stations if s.up is not None}
    return Scene(
        markers=tuple(replace(marker, visits=()) for marker in scene.markers),
        planar=scene.planar,
        calibrations={**factory, **scene.calibrations},
        ids={**ids, **scene.ids},
        ups={**ups, **scene.ups},
    )


def _merge_markers(given: Scene, own: Scene) -> tuple[tuple[Marker, ...], list[SolverWarning]]:
    known = {marker.name: marker for marker in given.markers}
    conflicts = []
    for marker in own.markers:
        first = known.get(marker.name)
        if first is None:
            known[marker.name] = marker
            continue
        difference_m = float(np.linalg.norm(first.position - marker.position))
        if difference_m > MAX_MARKER_DIFFERENCE_M:
            conflicts.append(
                SolverWarning(
                    "marker_conflict",
                    f"marker {marker.name!r} of the session is {1e3 * difference_m:.0f} mm from "
                    "the marker of this name in the artifact, whose position is used",
                )
            )
        sources = (marker, first) if given.stations else (first, marker)
        known[marker.name] = replace(first, visits=sources[0].visits or sources[1].visits)
    return tuple(known.values()), conflicts
