"""Artifacts as shapes for the page of a live session."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.calibration import IDEAL_CALIBRATION
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.formats.sinks.shapes import artifact_to_json, find_artifact


def frame_of(artifact: Any, frame: str, *used: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the points of the shapes by kind and style, and the labels, of a frame."""
    table = json.loads(json.dumps(artifact_to_json(artifact, used)))
    part = table["frames"][frame]
    shapes = {f"{each['kind']} {each['style']}": each["points"] for each in part["shapes"]}
    assert len(shapes) == len(part["shapes"])
    return shapes, {label["text"]: label["at"] for label in part["labels"]}


def test_stations_have_ids_and_viewing_directions() -> None:
    # Looks along y, downwards.
    forward = np.array([0.0, 0.8, -0.6])
    left = np.array([-1.0, 0.0, 0.0])
    rotation = np.column_stack([forward, left, np.cross(forward, left)])
    stations = (
        Station(3, np.array([1.0, -2.0, 2.5]), rotation, IDEAL_CALIBRATION, 0x12AB),
        Station(4, np.array([1.0, 2.0, 2.5]), np.eye(3), IDEAL_CALIBRATION),
    )
    scene = Scene(stations, (Marker("corner", np.array([0.5, 0.0, 0.1])),), scale="markers")
    shapes, labels = frame_of(scene, "floor")
    assert shapes["station station"] == [[[1, -2, 2.5], [0, 0.8, -0.6]], [[1, 2, 2.5], [1, 0, 0]]]
    assert shapes["marker marker"] == [[[0.5, 0.0, 0.1]]]
    assert labels == {
        "station 3 (000012ab)": [1, -2, 2.5],
        "station 4": [1, 2, 2.5],
        "corner": [0.5, 0, 0.1],
    }
    assert artifact_to_json(scene)["unit"] == "m"
    assert artifact_to_json(Scene(stations))["unit"] == "unit"


def test_sheets_are_drawn_in_their_frames() -> None:
    tiles = Manifest(
        tuple(
            Sheet(f"t{k}", (500 * k, 0), (391, 561), (1, 1), (210, 297), (6, 6), (210.0 * k, 0.0))
            for k in range(2)
        )
    )
    shapes, labels = frame_of(tiles, "floor")
    corners = np.array(shapes["polygon paper"])
    np.testing.assert_allclose(corners.min(axis=1), [[0, 0], [0.21, 0]], atol=1e-4)
    np.testing.assert_allclose(corners.max(axis=1), [[0.21, 0.297], [0.42, 0.297]], atol=1e-4)
    assert len(shapes["polygon pattern"]) == 2
    assert set(labels) == {"t0", "t1"}
    loose = Manifest(tuple(Sheet(n, (0, 0), (9, 9), (1, 1), (210, 297), (6, 6)) for n in "ab"))
    assert list(artifact_to_json(loose)["frames"]) == ["a"]
    assert list(artifact_to_json(loose, ["b"])["frames"]) == ["a", "b"]
    assert set(frame_of(loose, "b", "b")[1]) == {"b"}


def test_tags_of_a_site_have_their_meanings() -> None:
    site = {7: PlanarPose(1.0, 2.0, np.pi / 2), 12: PlanarPose(3.0, 0.0, 0.0)}
    shapes, labels = frame_of(Tags(site=site, meanings={7: "stop"}), "site")
    assert set(labels) == {"tag 7: stop", "tag 12"}
    assert shapes["marker tag"] == [[[1, 2]], [[3, 0]]]
    assert len(shapes["marker magnet"]) == 10
    for outline, centre in zip(shapes["polygon pattern"], ([1, 2], [3, 0]), strict=True):
        np.testing.assert_allclose(np.mean(outline, axis=0), centre, atol=1e-5)
    magnets = np.array(shapes["marker magnet"])[:5, 0]
    assert np.abs(magnets - [1, 2]).max() < 0.06


def test_a_tag_without_a_site_is_drawn_in_its_frame() -> None:
    tags = Tags(meanings={7: "stop"})
    assert artifact_to_json(tags)["frames"] == {}
    shapes, labels = frame_of(tags, "tag-7", "tag-7")
    assert list(labels) == ["tag 7: stop"]
    assert "marker magnet" in shapes
    assert artifact_to_json(tags, ["start"])["frames"]["start"]["shapes"] == []


def test_landmarks_have_cells_and_codes() -> None:
    codes = np.array([[0, 15], [-1, 5]])
    floor = FloorMap(codes, pitch_m=0.3, walls=frozenset({((0, 0), (0, 1))}))
    shapes, labels = frame_of(floor, "map")
    assert labels == {"0,0 SSSS": [0, 0, 0], "0,1 NNNN": [0.3, 0, 0], "1,1 NSNS": [0.3, 0.3, 0]}
    assert len(shapes["polygon north"]) == len(shapes["polygon south"]) == 12
    assert shapes["line wall"] == [[[0.15, pytest.approx(-0.15)], [0.15, 0.15]]]


def test_a_large_floor_is_drawn_as_points() -> None:
    floor = FloorMap(np.zeros((60, 60), np.int64), pitch_m=0.1)
    shapes, labels = frame_of(floor, "map")
    assert labels == {}
    points = np.array(shapes["marker weak"])
    assert points.shape == (3600, 1, 2)
    np.testing.assert_allclose(points.max(axis=(0, 1)), [5.9, 5.9])


def test_without_an_artifact_frames_are_empty() -> None:
    assert artifact_to_json(None, ["odom"]) == {
        "unit": "m",
        "frames": {"odom": {"shapes": [], "labels": []}},
    }
    scene = Scene()
    assert find_artifact({"array-a.toml": object(), "scene.toml": scene}) is scene
    assert find_artifact({"array-a.toml": object()}) is None
