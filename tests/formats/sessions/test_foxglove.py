"""Solutions and sessions for Foxglove, Lichtblick, Rerun and PlotJuggler.

They are read with the reader and decoder of mcap, as these viewers do it."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import foxglove_schemas_protobuf
import mcap.reader
import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap_protobuf.decoder import DecoderFactory

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.geometry import quaternion_from_heading
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.sessions import foxglove, frames
from locatk.formats.sessions.solutions import write_solution

START_NS = 1_700_000_000_000_000_000

SCENE = Scene(
    stations=(
        Station(1, np.array([0.0, 1.0, 2.0]), np.eye(3), Calibration(np.zeros((2, 7)), "generic")),
    ),
    markers=(Marker("corner", np.array([0.5, 0.5, 0.0])),),
    planar=True,
    scale="markers",
)
SHEET = Sheet("a", (0, 3000), (393, 565), (24, 32), (210.0, 297.0), (5.08, 5.08))
TILES = Manifest(
    (
        SHEET,
        Sheet("b", (500, 3000), (393, 565), (24, 32), (210.0, 297.0), (5.08, 5.08), (250.0, 0.0)),
    ),
    codec="libdots",
)
SITE = Tags(site={0: PlanarPose(0.0, 0.0, 0.0), 7: PlanarPose(0.5, 0.1, 1.0)})
FLOOR = FloorMap(np.array([[3, 9], [5, 0]]), pitch_m=0.2)

ARTIFACTS: dict[str, tuple[object, str, set[str]]] = {
    "lighthouse": (SCENE, "floor", {"station/1", "marker/corner"}),
    "dots": (Manifest((SHEET,), codec="libdots"), "a", {"sheet/a"}),
    "polaris": (SITE, "site", {"tag/0", "tag/7"}),
    "landmarks": (FLOOR, "map", {f"landmark/{r},{c}" for r in (0, 1) for c in (0, 1)}),
}
"""System to artifact, the frame of the poses on it, and the entities that show it."""


def track(device: str, frame: str, n: int = 40, shift_s: float = 0.0) -> Trajectory:
    turn = np.linspace(0, 3, n)
    return Trajectory(
        device,
        frame,
        START_NS + int(shift_s * 1e9) + 50_000_000 * np.arange(n),
        np.column_stack([0.1 * turn, 0.1 * np.sin(turn), 0 * turn]),
        quaternion_from_heading(turn),
        np.full((n, 6, 6), np.nan),
    )


@dataclass(frozen=True)
class Seen:
    """One message, as a viewer gets it."""

    topic: str
    schema: str
    log_ns: int
    message: Message


def look(path: Path) -> list[Seen]:
    """All messages in the order of the file, with what every viewer needs checked on the way."""
    with path.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            assert (channel.message_encoding, schema.encoding) == ("protobuf", "protobuf")
            files = FileDescriptorSet.FromString(schema.data).file
            names = {f"{file.package}.{kind.name}" for file in files for kind in file.message_type}
            assert schema.name in names, "the schema is not in its FileDescriptorSet"
            wanted = {name for file in files for name in file.dependency}
            assert wanted <= {file.name for file in files}, "an import is missing"
        found = [
            Seen(channel.topic, schema.name, message.log_time, decoded)
            for schema, channel, message, decoded in reader.iter_decoded_messages(
                log_time_order=False
            )
            if schema is not None
        ]
    assert summary.statistics is not None
    assert len(found) == summary.statistics.message_count
    times = [seen.log_ns for seen in found]
    assert times == sorted(times)
    for seen in found:
        if hasattr(seen.message, "timestamp") and seen.schema.startswith("foxglove."):
            assert seen.message.timestamp.ToNanoseconds() == seen.log_ns
    return found


def of(found: list[Seen], schema: str) -> list[Any]:
    return [seen.message for seen in found if seen.schema == f"foxglove.{schema}"]


@pytest.fixture(params=ARTIFACTS)
def solved(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[str, Path]:
    """A solution of each system, of two devices that start at different times."""
    artifact, frame, _ = ARTIFACTS[request.param]
    solution = Solution(
        system=request.param,
        method="paper",
        trajectories=(track("red", frame), track("blue", frame, shift_s=0.7)),
        rejected={"jump": 3},
        detections=(),
        artifact=artifact,
        warnings=(SolverWarning("test", "an assumption"),),
    )
    path = tmp_path / "solved.mcap"
    write_solution(path, solution, source="run.mcap")
    return request.param, path


def test_schemas_are_those_that_viewers_know(solved: tuple[str, Path]) -> None:
    """By their names, field by field: Foxglove's own package is the measure."""
    _, path = solved
    schemas = {seen.schema for seen in look(path) if seen.schema.startswith("foxglove.")}
    assert schemas == {
        f"foxglove.{name}"
        for name in (
            "PoseInFrame",
            "PosesInFrame",
            "FrameTransform",
            "SceneUpdate",
            "PointCloud",
            "Log",
        )
    }
    folder = Path(foxglove_schemas_protobuf.__file__).parent
    for schema in schemas:
        assert (folder / f"{schema.removeprefix('foxglove.')}_pb2.py").exists()


@pytest.mark.slow
def test_all_entities_are_connected_to_one_frame(solved: tuple[str, Path]) -> None:
    """Transforms form one tree, whose root is the frame of the artifact, the paths, the poses."""
    system, path = solved
    found = look(path)
    _, root, _ = ARTIFACTS[system]
    parents: dict[str, str] = {}
    for transform in of(found, "FrameTransform"):
        assert parents.setdefault(transform.child_frame_id, transform.parent_frame_id) == root
    assert set(parents) == {"red", "blue"}
    for schema in ("PoseInFrame", "PosesInFrame", "PointCloud"):
        assert {message.frame_id for message in of(found, schema)} == {root}
    [scene] = of(found, "SceneUpdate")
    assert {entity.frame_id for entity in scene.entities} == {root}


def test_the_scene_shows_the_artifact(solved: tuple[str, Path]) -> None:
    system, path = solved
    found = look(path)
    [scene] = of(found, "SceneUpdate")
    entities = {entity.id: entity for entity in scene.entities}
    assert set(entities) == ARTIFACTS[system][2] | {"path/red", "path/blue"}
    for entity in entities.values():
        drawn = [*entity.cubes, *entity.spheres, *entity.cylinders, *entity.lines, *entity.arrows]
        assert drawn, entity.id
        assert not entity.lifetime.ToNanoseconds()  # shown for ever
        for each in drawn:
            assert each.color.a > 0
            assert each.pose.orientation.w**2 + each.pose.orientation.z**2 > 0
    first = found[0]
    assert first.topic == "/scene"  # there before the first pose


def test_poses_and_logs_are_shown(solved: tuple[str, Path]) -> None:
    _, path = solved
    found = look(path)
    for device in ("red", "blue"):
        wanted = track(device, "", shift_s=0.7 * (device == "blue"))
        poses = [seen.message for seen in found if seen.topic == f"/pose/{device}"]
        moves = [t for t in of(found, "FrameTransform") if t.child_frame_id == device]
        for given, places in (
            (poses, [pose.pose.position for pose in poses]),
            (moves, [move.translation for move in moves]),
        ):
            stamps = [each.timestamp.ToNanoseconds() for each in given]
            assert stamps == wanted.time_ns.tolist()
            assert [[p.x, p.y, p.z] for p in places] == wanted.position.tolist()
    lines = {(log.message, log.level, log.name) for log in of(found, "Log")}
    assert lines == {("an assumption", 2, "locatk"), ("rejected 3: jump", 3, "locatk")}


POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgba", "u1", (4,))])


def test_points_show_path_and_artifact(solved: tuple[str, Path]) -> None:
    """As fields, stride and data say, which is all that a viewer goes by."""
    system, path = solved
    found = look(path)
    clouds = {seen.topic: seen.message for seen in found if seen.schema == "foxglove.PointCloud"}
    root = ARTIFACTS[system][1]
    assert set(clouds) == {f"/artifact_points/{root}", "/path_points/red", "/path_points/blue"}
    for cloud in clouds.values():
        fields = [(field.name, field.offset, field.type) for field in cloud.fields]
        assert fields[:3] == [("x", 0, 7), ("y", 4, 7), ("z", 8, 7)]  # 7 is FLOAT32
        assert fields[3:] == [
            (c, 12 + i, 1) for i, c in enumerate(("red", "green", "blue", "alpha"))
        ]
        assert len(cloud.data) % cloud.point_stride == 0
        assert cloud.pose.orientation.w == 1
    points = np.frombuffer(clouds["/path_points/red"].data, POINT)
    assert np.allclose(points["x"], track("", "").position[:, 0], atol=1e-7)
    assert (points["rgba"] == points["rgba"][0]).all()

    artifact = np.frombuffer(clouds[f"/artifact_points/{root}"].data, POINT)
    low, high = ([f(artifact[axis]) for axis in "xyz"] for f in (np.min, np.max))
    if system == "lighthouse":
        assert np.allclose([low, high], [[0, 0.5, 0], [0.5, 1, 2]])
    elif system == "dots":  # the paper
        assert np.allclose([low, high], [[0, 0, 0], [0.21, 0.297, 0]], atol=1e-6)
        outline = artifact[: foxglove.POINTS_PER_LINE]
        assert outline[0] == outline[-1]  # it is closed
    elif system == "polaris":
        assert len(artifact) == 2 * (5 + foxglove.POINTS_PER_LINE)
    elif system == "landmarks":
        assert len(artifact) == 16  # bars


def test_a_device_named_as_its_frame_has_a_frame_of_its_own() -> None:
    each = track("map", "map")
    [batch] = foxglove.transforms("/tf", each)
    transform = FrameTransform.FromString(batch.payloads[0])
    assert (transform.parent_frame_id, transform.child_frame_id) == ("map", "map_body")


def test_sheets_of_unknown_position_have_separate_frames() -> None:
    """Nothing tells where one lies against the other, so nothing is claimed."""
    scene = foxglove.scene_update(TILES, [], START_NS)
    assert {entity.id: entity.frame_id for entity in scene.entities} == {
        "sheet/a": "a",
        "sheet/b": "floor",
    }
    assert set(foxglove.artifact_points(scene, START_NS)) == {"a", "floor"}


def test_the_artifact_is_shown_without_poses(tmp_path: Path) -> None:
    path = tmp_path / "solved.mcap"
    nothing = Trajectory.from_positions("red", "floor", np.zeros(0, np.int64), np.zeros((0, 3)))
    write_solution(path, Solution("lighthouse", "paper", (nothing,), {}, (), SCENE), source="run")
    assert {seen.topic for seen in look(path)} == {"/scene", "/artifact_points/floor"}


BYTES_A_PIXEL = {"mono8": 1, "mono16": 2, "rgb8": 3, "rgba8": 4}


@pytest.mark.parametrize(
    ("shape", "kind"),
    [((12, 19), np.uint8), ((12, 19), np.uint16), ((12, 19, 3), np.uint8), ((12, 19, 4), np.uint8)],
)
def test_raw_frames_fill_an_image_panel(tmp_path: Path, shape: tuple[int, ...], kind: Any) -> None:
    """Encoding, step and size as Foxglove's documentation of RawImage asks for them."""
    pixels = np.random.default_rng(1).integers(0, np.iinfo(kind).max, shape, kind)
    found = record(tmp_path, frames.Shot(START_NS, "0", pixels))
    [image] = of(found, "RawImage")
    assert (image.width, image.height, image.frame_id) == (19, 12, "camera")
    assert image.step == 19 * BYTES_A_PIXEL[image.encoding]
    assert len(image.data) == image.step * image.height
    seen = np.frombuffer(image.data, np.dtype(kind).newbyteorder("<")).reshape(shape)
    assert np.array_equal(seen, pixels)


def test_packed_frames_fill_an_image_panel(tmp_path: Path) -> None:
    pixels = np.arange(12 * 19, dtype=np.uint8).reshape(12, 19)
    done, packed = cv2.imencode(".png", pixels)
    assert done
    [image] = of(
        record(tmp_path, frames.Shot(START_NS, "0", packed.tobytes(), "png")), "CompressedImage"
    )
    assert image.format == "png"
    shown = cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.array_equal(shown, pixels)


def record(folder: Path, shot: frames.Shot) -> list[Seen]:
    path = folder / "run.mcap"
    frames.write_shots(path, {"camera": [shot]}, manifest=Manifest((SHEET,), codec="libdots"))
    return look(path)


def test_the_layout_refers_to_existing_topics(solved: tuple[str, Path], root: Path) -> None:
    """docs/locatk-layout.json: panels in their places, topics and fields of solutions."""
    _, path = solved
    layout = json.loads((root / "docs" / "locatk-layout.json").read_text())
    panels = layout["configById"]

    def placed(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else placed(node["first"]) + placed(node["second"])

    assert sorted(placed(layout["layout"])) == sorted(panels)
    found = {seen.topic: seen.message for seen in look(path)}
    assert set(panels["3D!locatk"]["topics"]) <= set(found)
    assert panels["RosOut!locatk"]["topicToRender"] in found
    for series in panels["Plot!locatk"]["paths"]:
        _, pose, field = series["value"].split("/")
        device, *names = field.split(".")
        assert (pose, device) in {("pose", d) for d in ("robot", "robot-1", "camera", "bar")}
        value: Any = found["/pose/red"]
        for name in names:
            value = getattr(value, name)
        assert isinstance(value, float)


def test_rerun_converts_the_messages_to_archetypes(
    solved: tuple[str, Path], tmp_path: Path
) -> None:
    """Where `rerun` is: paths and artifacts become points, poses and transforms are understood."""
    system, path = solved
    folder = os.environ.get("LOCATK_RERUN")
    program = shutil.which("rerun", path=folder) if folder else shutil.which("rerun")
    if program is None:
        pytest.skip("rerun is not installed (see LOCATK_RERUN)")
    out = tmp_path / "solved.rrd"
    for arguments in (["mcap", "convert", str(path), "-o", str(out)], ["rrd", "print", str(out)]):
        done = subprocess.run([program, *arguments], capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    for entity, word in (
        ("/path_points/red", "Points3D:positions"),
        (f"/artifact_points/{ARTIFACTS[system][1]}", "Points3D:colors"),
        ("/pose/red", "InstancePoses3D:translations"),
        ("/tf", "Transform3D:child_frame"),
        ("/log", "TextLog:text"),
    ):
        assert any(f"- {entity} -" in line and word in line for line in lines), (entity, word)
