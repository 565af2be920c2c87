"""Scenes of an artifact and of a session together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene, Station
from locatk.formats.pipeline.scene_merging import knowledge_of_stations, merge_scenes

FACTORY = Calibration(np.full((2, 7), 0.01), "factory")
OTHER = Calibration(np.full((2, 7), 0.02), "factory")
FIRST, SECOND = MarkerVisit("r", 0, 1), MarkerVisit("r", 5, 6)
UP = np.array([0.0, 0.0, 1.0])


def marker(name: str, x: float = 0.0, *visits: MarkerVisit) -> Marker:
    return Marker(name, np.array([x, 0.0, 0.0]), visits)


def test_factory_calibrations_and_markers_combine() -> None:
    given = Scene(calibrations={1: FACTORY}, ids={1: 7}, ups={1: UP})
    own = Scene(
        markers=(marker("a", 1.0, FIRST),),
        distances=(Distance(FIRST, SECOND, 1.0),),
        planar=True,
        floor_z=0.1,
        frame="hall",
        calibrations={1: OTHER, 2: OTHER},
        ids={1: 8, 2: 9},
        ups={2: UP},
    )
    merged, conflicts = merge_scenes(given, own)
    assert conflicts == []
    assert merged.markers == own.markers
    assert merged.distances == own.distances
    assert (merged.planar, merged.floor_z, merged.frame) == (True, 0.1, "hall")
    assert merged.calibrations == {1: FACTORY, 2: OTHER}
    assert merged.ids == {1: 7, 2: 9}
    assert merged.ups.keys() == {1, 2}


def test_the_artifact_counts_first_and_conflicts_are_named() -> None:
    given = Scene(markers=(marker("a", 1.0, FIRST), marker("b", 2.0)), planar=False)
    own = Scene(markers=(marker("a", 1.5, SECOND), marker("b", 2.0004, SECOND)), planar=True)
    merged, conflicts = merge_scenes(given, own)
    first, second = merged.markers
    assert (first.position[0], first.visits) == (1.0, (FIRST,))
    assert (second.position[0], second.visits) == (2.0, (SECOND,))
    assert merged.planar is False
    (conflict,) = conflicts
    assert conflict.code == "marker_conflict"
    assert "'a' of the session is 500 mm" in conflict.message


def test_visits_in_a_solved_scene_are_of_another_recording() -> None:
    station = Station(1, np.zeros(3), np.eye(3), FACTORY)
    given = Scene((station,), markers=(marker("a", 1.0, FIRST),), frame="room", scale="markers")
    own = Scene(
        (Station(2, np.zeros(3), np.eye(3), OTHER),),
        markers=(marker("a", 1.0, SECOND),),
        planar=True,
        frame="hall",
    )
    merged, _ = merge_scenes(given, own)
    assert merged.stations == (station,)
    assert merged.markers[0].visits == (SECOND,)
    assert (merged.frame, merged.planar) == ("room", None)


def test_a_scene_that_is_calibrated_anew_keeps_what_stations_sent() -> None:
    fitted = Calibration(np.zeros((2, 7)), "estimated")
    given = Scene(
        (
            Station(1, np.zeros(3), np.eye(3), FACTORY, 7, up=UP),
            Station(2, np.zeros(3), np.eye(3), fitted),
        ),
        markers=(marker("a", 1.0, FIRST),),
        calibrations={3: OTHER},
        scale="markers",
        frame_source="markers",
        level_sigma_rad=0.1,
    )
    known = knowledge_of_stations(given)
    assert known.stations == ()
    assert known.calibrations == {1: FACTORY, 3: OTHER}
    assert (known.ids, known.ups) == ({1: 7}, {1: UP})
    assert known.markers[0].visits == ()
    assert (known.scale, known.frame_source, known.level_sigma_rad) == ("unit", None, None)
    by_hand = Scene(markers=(marker("a", 1.0, FIRST),))
    assert knowledge_of_stations(by_hand) is by_hand


def test_a_session_without_scene() -> None:
    given = Scene(ids={1: 7})
    assert merge_scenes(given, None) == (given, [])


def test_a_design_stays_a_prior_of_its_session() -> None:
    stations = (Station(1, np.zeros(3), np.eye(3), FACTORY),)
    design = Scene(stations, planar=True, floor_z=0.1, frame="room", frame_source="design")
    assert knowledge_of_stations(design) is design
    known = marker("a", 1.0)
    merged, conflicts = merge_scenes(Scene(markers=(known,), ids={1: 7}), design)
    assert conflicts == []
    assert (merged.stations, merged.frame, merged.frame_source) == (stations, "room", "design")
    assert (merged.markers, merged.ids) == ((known,), {1: 7})
    solved = replace(design, frame_source="floor", frame="other")
    assert merge_scenes(solved, design)[0].frame == "other"
