"""scene.toml: exact round trips, and strict checks of edited files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError
from locatk.core.geometry import rotation_exp
from locatk.core.lighthouse.calibration import MODELS, Calibration
from locatk.core.lighthouse.room import MOUNTS, Obstacle, RobotSize, Room
from locatk.core.lighthouse.scene import Distance, Marker, MarkerVisit, Scene, Station
from locatk.core.lighthouse.scene.model import FRAME_SOURCES, JOINT_PARAMETERS
from locatk.core.polygons import rectangle
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.artifacts.scene import dumps_scene, format_time, loads_scene, parse_time

# ---- round trips

finite = st.floats(-1e6, 1e6)
times = st.integers(-(10**18), 4 * 10**18)
numbers = st.integers(0, 2**32 - 1)
channels = st.integers(1, 16)


def vectors(n: int) -> st.SearchStrategy[np.ndarray]:
    return st.lists(finite, min_size=n, max_size=n).map(np.array)


@st.composite
def sightings(draw: st.DrawFn) -> MarkerVisit:
    if draw(st.booleans()):
        pair = st.tuples(st.floats(0, 2e5), st.floats(0, 2e5))
        return MarkerVisit(
            counts=draw(st.dictionaries(st.integers(1, 16), pair, min_size=1, max_size=3))
        )
    start, end = sorted([draw(times), draw(times)])
    return MarkerVisit(draw(st.text(max_size=5)), start, end)


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    source = draw(st.sampled_from(artifacts.SOURCES))
    model = draw(st.sampled_from(MODELS))
    return Calibration(draw(vectors(14)).reshape(2, 7), source, model)


def directions() -> st.SearchStrategy[np.ndarray]:
    return vectors(3).map(lambda v: rotation_exp(v % 3)[:, 2])


@st.composite
def stations(draw: st.DrawFn, channel: int) -> Station:
    # Of any rank: rows of whole numbers, many of which are 0.
    rows = st.lists(st.integers(-3, 3), min_size=36, max_size=36).map(np.array)
    covariance = rows.map(lambda v: v.reshape(6, 6) @ v.reshape(6, 6).T * 1e-7)
    return Station(
        channel,
        draw(vectors(3)),
        rotation_exp(draw(vectors(3)) % 3),
        draw(calibrations()),
        draw(st.none() | numbers),
        draw(st.none() | covariance),
        draw(st.none() | vectors(9).map(lambda v: v.reshape(3, 3))),
        draw(st.none() | directions()),
    )


lengths = st.integers(100, 9000).map(lambda mm: mm / 1000)
corners = st.tuples(st.integers(-5000, 5000), st.integers(-5000, 5000))


@st.composite
def rectangles(draw: st.DrawFn) -> np.ndarray:
    x, y = draw(corners)
    return rectangle(draw(lengths), draw(lengths), (x / 1000, y / 1000))


@st.composite
def rooms(draw: st.DrawFn) -> Room:
    low, high = sorted([draw(lengths), draw(lengths)])
    tripods = draw(st.lists(st.tuples(lengths, lengths, lengths), max_size=2))
    mounts = [mount for mount in MOUNTS if mount != "tripod" or tripods]
    return Room(
        draw(rectangles()),
        high + draw(lengths),
        draw(st.sampled_from([(low, low), (low, high)])),
        draw(st.none() | rectangles()),
        tuple(
            Obstacle(draw(rectangles()), bottom, bottom + draw(lengths), draw(st.text(max_size=5)))
            for bottom in draw(st.lists(lengths, max_size=2))
        ),
        tuple(draw(st.lists(st.sampled_from(mounts), min_size=1, max_size=3, unique=True))),
        np.array(tripods, float).reshape(-1, 3),
        draw(st.none() | st.builds(RobotSize, st.integers(1, 50), lengths, lengths)),
    )


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    placed = draw(st.lists(channels, max_size=3, unique=True))
    names = draw(st.lists(st.text(max_size=5), max_size=3, unique=True))
    return Scene(
        stations=tuple(draw(stations(channel)) for channel in placed),
        markers=tuple(
            Marker(name, draw(vectors(3)), tuple(draw(st.lists(sightings(), max_size=2))))
            for name in names
        ),
        distances=tuple(
            Distance(draw(sightings()), draw(sightings()), draw(st.floats(1e-6, 1e3)))
            for _ in range(draw(st.integers(0, 2)))
        ),
        planar=draw(st.sampled_from([None, True, False])),
        floor_z=draw(finite),
        scale=draw(st.sampled_from(artifacts.SCALES)),
        frame=draw(st.text(max_size=5)),
        notes=tuple(draw(st.lists(st.text(max_size=20), max_size=2))),
        calibrations=draw(st.dictionaries(channels, calibrations(), max_size=3)),
        ids=draw(st.dictionaries(channels, numbers, max_size=3)),
        ups=draw(st.dictionaries(channels, directions(), max_size=3)),
        frame_source=draw(st.none() | st.sampled_from(FRAME_SOURCES)),
        level_sigma_rad=draw(st.none() | st.floats(0, 3)),
        room=draw(st.none() | rooms()),
    )


def plain(value: object) -> object:
    """Dataclasses and arrays as things that ``==`` compares; nan equal to nan."""
    if isinstance(value, np.ndarray):
        return value.shape, [repr(item) for item in value.ravel().tolist()]
    if isinstance(value, tuple):
        return tuple(plain(item) for item in value)
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__}
    return value


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(scenes())
def test_every_scene_comes_back_to_the_last_bit(scene: Scene) -> None:
    text = dumps_scene(scene)
    assert plain(loads_scene(text)) == plain(scene)
    assert dumps_scene(loads_scene(text)) == text


@pytest.mark.slow
@given(times)
def test_times_keep_their_nanoseconds(time_ns: int) -> None:
    assert parse_time(format_time(time_ns)) == time_ns


@pytest.mark.parametrize(
    ("text", "time_ns"),
    [
        ("1970-01-01T00:00:00Z", 0),
        ("1970-01-01T00:00:00.5Z", 500_000_000),
        ("1970-01-01 01:00:00.000000001+01:00", 1),
        ("2023-07-27t15:34:22.700963z", 1690472062_700963000),
        ("2023-07-27T15:34:22.700963", None),
        ("2023-13-27T15:34:22Z", None),
        ("2023-07-27T15:34:22.0123456789Z", None),
        ("9999-12-31T23:59:59Z", None),
        ("yesterday", None),
    ],
)
def test_times(text: str, time_ns: int | None) -> None:
    assert parse_time(text) == time_ns


def test_positions_are_written_in_mm() -> None:
    scene = Scene(markers=(Marker("a", np.array([0.1, 0.2, 0.0])),))
    assert "position_mm = [100.0, 200.0, 0.0]" in dumps_scene(scene)


# ---- edited files

HEAD = 'format = "locatk-lighthouse-scene"\nformat_version = 1\n'

STATION = """
[[stations]]
channel = 1
position_mm = [0, 0, 2000]
rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]
calibration = { source = "none" }
"""

MARKER = """
[[markers]]
name = "tl"
position_mm = [400, 600.5, 0]
"""

SIGHTING = (
    MARKER
    + """
[[markers.sightings]]
device = "R"
start = 2023-07-27T15:34:22.700963Z
end = "2023-07-27T15:34:23Z"
"""
)


def test_a_scene_by_hand() -> None:
    text = (
        "\ufeff"
        + HEAD
        + SIGHTING
        + """
[[distances]]
distance_mm = 800
first = { counts = { 1 = [48333, 88779] } }
second.counts.1 = [48333, 88779]
"""
    )
    scene = loads_scene(text.replace("\n", "\r\n").encode())
    assert scene.scale == "unit"
    assert scene.planar is None
    assert scene.markers[0].position.tolist() == [0.4, 0.6005, 0.0]
    (sighting,) = scene.markers[0].visits
    assert sighting.start_ns == 1690472062_700963000
    assert sighting.end_ns == 1690472063_000000000
    assert scene.distances[0].distance == 0.8
    assert scene.distances[0].second.counts == {1: (48333.0, 88779.0)}


def test_the_example_of_the_documentation(root: Path) -> None:
    text = (root / "docs" / "formats.md").read_text("utf-8")
    examples = [block.split("```")[0] for block in text.split("```toml\n")[1:]]
    (example,) = (each for each in examples if 'format = "locatk-lighthouse-scene"' in each)
    scene = loads_scene(example)
    assert [station.channel for station in scene.stations] == [1]
    assert plain(loads_scene(dumps_scene(scene))) == plain(scene)


def test_lengths_have_no_unit_if_the_scale_is_unknown() -> None:
    station = Station(1, np.array([0.5, 0, 1]), np.eye(3), Calibration(np.zeros((2, 7)), "none"))
    text = dumps_scene(Scene(stations=(station,), floor_z=0.25))
    assert "position_units = [0.5, 0.0, 1.0]" in text
    assert "floor_z_units = 0.25" in text
    assert "_mm" not in text
    text = dumps_scene(Scene(stations=(station,), scale="distance", floor_z=0.25))
    assert "position_mm = [500.0, 0.0, 1000.0]" in text
    assert "floor_z_mm = 250.0" in text
    assert "_units" not in text


CALIBRATIONS = (
    HEAD
    + """
[[calibrations]]
channel = 3
id = "4cc60647"
source = "none"
"""
)


def test_serial_numbers_of_stations_before_solving() -> None:
    scene = loads_scene(CALIBRATIONS)
    assert scene.ids == {3: 0x4CC60647}
    assert scene.calibrations[3].source == "none"
    # Its number may be all that is known.
    scene = loads_scene(CALIBRATIONS.replace('source = "none"', ""))
    assert (scene.ids, scene.calibrations) == ({3: 0x4CC60647}, {})
    assert loads_scene(CALIBRATIONS.replace('id = "4cc60647"', "")).ids == {}


JOINT = "[joint_covariance]\nfactor = "


def covariance_rows(*variances: float | str, upper: float = 0, lower: float = 0) -> str:
    rows: list[list[float | str]] = [[0] * len(variances) for _ in variances]
    for k, variance in enumerate(variances):
        rows[k][k] = variance
    if rows:
        rows[0][1], rows[1][0] = upper, lower
    return "[" + ", ".join(f"[{', '.join(map(str, row))}]" for row in rows) + "]"


METRIC = HEAD + 'scale = "markers"\n' + STATION


@pytest.mark.parametrize(
    ("text", "where", "words"),
    [
        ("", None, "missing key 'format'"),
        ('format = "other"', "format", "expected 'locatk-lighthouse-scene'"),
        ('format = "locatk-lighthouse-scene"', None, "missing key 'format_version'"),
        (HEAD.replace("1", "2"), "format_version", "newer"),
        (HEAD + "plannar = true", None, "unknown key 'plannar'"),
        (HEAD + "planar = 1", "planar", "true or false"),
        (HEAD + 'scale = "metres"', "scale", "not one of markers"),
        (HEAD + "frame = 3", "frame", "a string, not a number"),
        (HEAD + 'notes = "x"', "notes", "list of strings"),
        (HEAD + "stations = 3", "stations", "expected tables"),
        (HEAD + "floor_z_mm = nan", "floor_z_mm", "finite"),
        (HEAD + "floor_z_mm = 1e999", "floor_z_mm", "finite"),
        (HEAD + "floor_z_mm = 1e999999999999999999999", "floor_z_mm", "finite"),
        (HEAD + STATION, "stations[0]", "missing key 'position_units'"),
        (METRIC.replace("channel = 1", "channel = 17"), "stations[0].channel", "1 to 16"),
        (METRIC.replace("channel = 1", "channel = true"), "stations[0].channel", "1 to 16"),
        (METRIC.replace("channel = 1", "chanel = 1"), "stations[0]", "missing key 'channel'"),
        (METRIC.replace(", 2000]", "]"), "stations[0].position_mm", "list of 3 numbers"),
        (
            METRIC.replace("2000", '"2"'),
            "stations[0].position_mm[2]",
            "a number in mm, not a string",
        ),
        (METRIC.replace("[1, 0, 0]", "[2, 0, 0]"), "stations[0].rotation", "rotation matrix"),
        (METRIC.replace("[1, 0, 0]", "[-1, 0, 0]"), "stations[0].rotation", "rotation matrix"),
        (METRIC.replace("[1, 0, 0], ", ""), "stations[0].rotation", "3 rows of 3"),
        (METRIC.replace('"none"', '"maker"'), "stations[0].calibration.source", "factory"),
        (METRIC.replace('"none"', '"factory"'), "stations[0].calibration", "missing key 'first'"),
        (METRIC + STATION, "stations[1].channel", "twice"),
        *(
            (METRIC + f"covariance_m_rad = {rows}", "stations[0].covariance_m_rad", words)
            for rows, words in (
                (covariance_rows(), "6 rows of 6 numbers"),
                (covariance_rows(*[1] * 5, -1), "a variance is negative"),
                (covariance_rows(*[1] * 6, upper=0.5), "not symmetric"),
                (covariance_rows(*[1] * 6, upper=2, lower=2), "not positive semi-definite"),
                (covariance_rows(0, *[1] * 5, upper=2, lower=2), "a variance is 0"),
            )
        ),
        (
            METRIC + f"covariance_m_rad = {covariance_rows(*['nan'] * 6)}",
            "stations[0].covariance_m_rad[0][0]",
            "finite",
        ),
        (METRIC + "up = [0, 0, 0]", "stations[0].up", "not all 0"),
        (METRIC + "up = [0, 1]", "stations[0].up", "list of 3 numbers"),
        (HEAD + 'frame_source = "floors"', "frame_source", "not one of markers, floor"),
        (HEAD + "level_sigma_deg = -1", "level_sigma_deg", "at least 0"),
        (HEAD + "[joint_covariance]", "joint_covariance", "missing key 'factor'"),
        (HEAD + JOINT + "[]", "joint_covariance.factor", "rows of 1, 2, 3"),
        (HEAD + JOINT + "[[1], [2]]", "joint_covariance.factor[1]", "list of 2 numbers"),
        (HEAD + JOINT + "[[nan]]", "joint_covariance.factor[0][0]", "finite"),
        (METRIC + JOINT + "[[1]]", "joint_covariance.factor", "expected 20 rows"),
        (METRIC.replace("channel = 1", 'channel = 1\nid = "xyz"'), "stations[0].id", "hexa"),
        (CALIBRATIONS.replace("4cc60647", "0x4c"), "calibrations[0].id", "hexa"),
        (CALIBRATIONS.replace('"4cc60647"', "12"), "calibrations[0].id", "a string"),
        (CALIBRATIONS.replace("source", "sorce"), "calibrations[0]", "missing key 'source'"),
        (
            CALIBRATIONS.replace('source = "none"', 'model = "x"'),
            "calibrations[0]",
            "missing key 'source'",
        ),
        (HEAD + "[[calibrations]]\nchannel = 3", "calibrations[0]", "missing key 'source'"),
        (HEAD + MARKER + MARKER, "markers[1].name", "twice"),
        (HEAD + SIGHTING.replace("22.7", "25.7"), "markers[0].sightings[0].end", "before start"),
        (HEAD + SIGHTING.replace("963Z", "963"), "markers[0].sightings[0].start", "zone"),
        (HEAD + SIGHTING.replace('"R"', "1"), "markers[0].sightings[0].device", "a string"),
        (
            HEAD + MARKER + "sightings = [{ counts = { 17 = [1, 2] } }]",
            "markers[0].sightings[0].counts.17",
            "channel",
        ),
        (
            HEAD + MARKER + "sightings = [{ counts = {} }]",
            "markers[0].sightings[0].counts",
            "not an empty table",
        ),
        (
            HEAD + MARKER + "sightings = [{ counts = { 1 = [1, -2] } }]",
            "markers[0].sightings[0].counts.1",
            "of at least 0",
        ),
        (
            HEAD + "[[distances]]\ndistance_mm = 0\n",
            "distances[0].distance_mm",
            "above 0",
        ),
        (HEAD + "planar = ", 3, "not valid TOML"),
        (HEAD + "planar = true\nplanar = true", 4, "not valid TOML"),
        (HEAD + "planar = maybe\nscale = 3", "3", "not valid TOML"),
    ],
)
def test_errors_name_key_and_expected_value(
    refused: Callable[..., None], text: str, where: str | int | None, words: str
) -> None:
    refused(artifacts.SCENE, text, where, words)


def test_the_joint_covariance_of_stations_is_kept_to_a_millionth() -> None:
    rng = np.random.default_rng(7)
    stations = tuple(
        Station(channel, np.zeros(3), np.eye(3), Calibration(np.zeros((2, 7)), "none"))
        for channel in (2, 5)
    )
    size = JOINT_PARAMETERS * len(stations)
    scales = 10.0 ** rng.uniform(-5, 1, size)
    for rank in (size, size - 6):  # The gauge of a scene has no variance.
        root = scales[:, None] * rng.normal(size=(size, rank))
        covariance = root @ root.T
        scene = Scene(stations=stations, scale="device", covariance=covariance)
        text = dumps_scene(scene)
        read = loads_scene(text).covariance
        assert read is not None
        sigma = np.sqrt(np.diagonal(covariance))
        assert np.max(np.abs(read - covariance) / np.outer(sigma, sigma)) < 1e-5
        assert len(text) < 22_000
    with pytest.raises(ValueError, match="negative"):
        dumps_scene(Scene(stations=stations, covariance=-np.eye(size)))


def test_directions_are_normalised() -> None:
    up = loads_scene(METRIC + "up = [0, 3, 4]").stations[0].up
    assert up is not None
    assert up.tolist() == [0.0, 0.6, 0.8]
    scene = loads_scene(HEAD + "[[calibrations]]\nchannel = 3\nup = [0, 0, 2]\n")
    assert scene.ups[3].tolist() == [0.0, 0.0, 1.0]
    assert scene.calibrations == {}


def test_unknown_keys_get_a_suggestion() -> None:
    with pytest.raises(ArtifactError) as caught:
        loads_scene(METRIC.replace("calibration", "kalibration"))
    assert "'kalibration' meant to be calibration" in (caught.value.hint or "")
    with pytest.raises(ArtifactError) as caught:
        loads_scene(HEAD + "plannar = true")
    assert caught.value.hint == "Did you mean planar?"
    with pytest.raises(ArtifactError) as caught:
        loads_scene(HEAD + MARKER + "sightings = 3")
    assert caught.value.hint == "Write each one under [[markers.sightings]]"


@pytest.mark.parametrize("text", [b"\xff\xfe", b"a = " + b"[" * 100_000, b"a = " + b"9" * 10_000])
def test_files_that_are_not_text(text: bytes) -> None:
    with pytest.raises(ArtifactError):
        loads_scene(text)


# ---- the room

ROOM = """
format = "locatk-lighthouse-scene"
format_version = 1

[room]
outline_mm = [[0, 0], [0, 4000], [5000, 4000], [5000, 0]]
height_mm = 2800
"""


def test_a_file_with_a_room_only_is_a_scene() -> None:
    scene = loads_scene(ROOM)
    room = scene.room
    assert room is not None
    assert not scene.stations
    assert room.height_m == 2.8
    assert room.outline_m.tolist() == [[5, 0], [5, 4], [0, 4], [0, 0]]
    assert room.photodiode_z_m == (0.0, 0.0)
    assert room.mounts == ("wall", "ceiling")
    assert loads_scene(ROOM + "lowest_photodiode_mm = 80\n").room.photodiode_z_m == (0.08, 0.08)


def test_scenes_without_a_room_are_written_as_before() -> None:
    assert "room" not in dumps_scene(Scene())


@pytest.mark.parametrize(
    ("added", "message"),
    [
        ("height = 3", "unknown key 'height'"),
        ("highest_photodiode_mm = 3000", "photodiodes from 0 to 3 m"),
        ('mounts = ["roof"]', "roof"),
        ('mounts = ["tripod"]', "no positions of tripods"),
        ("tripods_mm = [[1, 2]]", "list of 3 numbers"),
        ("area_mm = [[0, 0], [1, 1]]", "2 corners"),
        ("area_mm = [[0, 0], [9, 9], [9, 0], [0, 9]]", "crosses or touches itself"),
        ("[room.robots]\ncount = 0\nradius_mm = 1\nheight_mm = 1", "robots.count"),
        ("[[room.obstacles]]\noutline_mm = [[0,0],[9,0],[9,9]]\nhigh_mm = -1", "obstacles"),
        ("[[room.obstacles]]\noutline_mm = [[0,0],[9,0],[9,9]]\nlow_mm = 2\nhigh_mm = 2",
         "not above its lower face"),
    ],
)  # fmt: skip
def test_rooms_with_wrong_keys_are_refused_in_one_line(added: str, message: str) -> None:
    with pytest.raises(ArtifactError, match=message) as caught:
        loads_scene(ROOM + added + "\n")
    assert "room" in str(caught.value)
    assert "\n" not in str(caught.value)
