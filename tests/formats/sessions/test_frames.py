"""Camera frames in sessions: stored unchanged, read on access, errors reported."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import IndexType, Writer
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.core.dots.camera import Camera
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats import images
from locatk.formats.sessions import frames, mcap_file, observations
from locatk.formats.sessions.frames import Shot
from locatk.formats.sessions.reader import Session

SHEET = Sheet("a", (0, 3000), (393, 565), (24, 32), (210.0, 297.0), (5.08, 5.08))
MANIFEST = Manifest((SHEET,), codec="libdots")
CAMERA = Camera((188, 120), 900.0, (93.5, 59.5), -0.8)


def noise(n: int, shape: tuple[int, ...] = (120, 188), kind: type = np.uint8) -> list[np.ndarray]:
    """Pictures that no chunk can pack, all of them different."""
    rng = np.random.default_rng(7)
    return [rng.integers(0, np.iinfo(kind).max, shape, kind, endpoint=True) for _ in range(n)]


def camera_frames(n: int, device: str = "camera", start_ns: int = 10**9) -> Frames:
    names = tuple(f"frame{number}.png" for number in range(n))
    return Frames(device, start_ns + 20_000_000 * np.arange(n), names, noise(n))


def read(path: Path) -> list[Frames]:
    return observations.read_frames(Session.open(path))


# ---- round trips


def test_frames_are_restored(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    left, right = camera_frames(90, "left"), camera_frames(60, "right", 10**9 + 7)
    place = np.arange(6.0).reshape(2, 3)
    truth = Trajectory.from_positions("left", "a", left.time_ns[:2], place)
    frames.write_session(
        path, [right, left], MANIFEST, camera=CAMERA, truth=[truth], facts={"seed": 3}
    )
    session = Session.open(path)
    found = observations.read_frames(session)
    assert [each.device for each in found] == ["left", "right"]
    for mine, given_ in zip(found, (left, right), strict=True):
        assert mine.names == given_.names
        np.testing.assert_array_equal(mine.time_ns, given_.time_ns)
        np.testing.assert_array_equal(list(mine.images), list(given_.images))
    assert observations.read_manifest(session) == MANIFEST
    assert observations.read_camera(session) == CAMERA
    (back,) = observations.read_truth(session)
    np.testing.assert_array_equal(back.position, place)
    assert session.metadata()["facts"] == {"seed": "3"}
    assert session.facts["system"] == "dots"


def test_frames_are_read_in_any_order(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    given_ = camera_frames(130)  # three chunks
    frames.write_session(path, [given_], MANIFEST)
    (found,) = read(path)
    for number in (129, 0, 64, -1, 1, 128):
        np.testing.assert_array_equal(found.images[number], given_.images[number])
    assert len(found) == len(found.images) == 130
    part = found.images[100:104]
    np.testing.assert_array_equal(list(part), given_.images[100:104])
    with pytest.raises(IndexError):
        found.images[130]


def test_opening_reads_no_image_and_iteration_decompresses_each_chunk_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A session of any length is read with the memory of one chunk."""
    path = tmp_path / "run.mcap"
    frames.write_session(path, [camera_frames(130)], MANIFEST)
    unpacked: list[int] = []
    unpack = mcap_file.read_segment

    def counted(stream, segment):  # type: ignore[no-untyped-def]
        data = unpack(stream, segment)
        unpacked.append(len(data))
        return data

    monkeypatch.setattr(mcap_file, "read_segment", counted)
    (found,) = read(path)
    assert unpacked == []
    for _ in found.images:
        pass
    assert len(unpacked) == len(Session.open(path).index.segments) > 2
    assert max(unpacked) < 2 << 20


def test_the_library_reads_the_same_frames(tmp_path: Path) -> None:
    """The stock reader of MCAP and OpenCV, which share nothing with ours."""
    path = tmp_path / "run.mcap"
    given_ = camera_frames(3)
    frames.write_session(path, [given_], MANIFEST, camera=CAMERA)
    with open(path, "rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        found = list(reader.iter_decoded_messages(["/camera/camera"]))
        for (_, _, message, raw), time_ns, image in zip(
            found, given_.time_ns, given_.images, strict=True
        ):
            assert message.log_time == time_ns
            assert raw.timestamp.seconds * 10**9 + raw.timestamp.nanos == time_ns
            assert (raw.encoding, raw.frame_id) == ("mono8", "camera")
            pixels = np.frombuffer(raw.data, np.uint8).reshape(raw.height, raw.step)
            np.testing.assert_array_equal(pixels, image)
        attached = {each.name: each.data for each in reader.iter_attachments()}
    assert set(attached) == {"sheet.toml", "camera.toml", "frames.json"}


def test_image_files_are_stored_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    (picture,) = noise(1)
    data = {kind: cv2.imencode(f".{kind}", picture)[1].tobytes() for kind in ("png", "jpeg")}
    shots = [Shot(n, str(n), each, kind) for n, (kind, each) in enumerate(data.items(), 1)]
    assert frames.write_shots(path, {"c": shots}) == {"c": 2}
    session = Session.open(path)
    kept = [message for _, message in session.decoded("/camera/c", CompressedImage)]
    assert [(each.format, each.data) for each in kept] == list(data.items())
    (found,) = observations.read_frames(session)
    np.testing.assert_array_equal(found.images[0], picture)
    decoded = cv2.imdecode(np.frombuffer(data["jpeg"], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert np.abs(found.images[1].astype(int) - decoded).max() <= 1
    assert found.names == ("1", "2")


def test_frame_numbers_are_not_listed_as_names(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    frames.write_shots(path, {"c": [Shot(n, str(n), noise(1)[0]) for n in range(3)]})
    session = Session.open(path)
    assert session.attachment(frames.FRAMES_FILE) is None
    assert observations.read_frames(session)[0].names == ("0", "1", "2")


@pytest.mark.parametrize("name", ["caf\u00e9 \u2603.png", "a\udce9.png", 'quote".png', "new\nline"])
def test_frame_names_of_any_kind(tmp_path: Path, name: str) -> None:
    path = tmp_path / "run.mcap"
    frames.write_shots(path, {"c": [Shot(1, name, noise(1)[0])]})
    assert read(path)[0].names == (name,)


def test_equal_frames_give_equal_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        frames.write_session(tmp_path / name, [camera_frames(5)], MANIFEST, camera=CAMERA)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


# ---- the camera for viewers


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.95, 0.95), st.floats(100, 3000), st.floats(60, 127), st.floats(40, 79))
def test_the_camera_model_for_viewers_is_accurate_or_left_out(
    bend: float, focal: float, x: float, y: float
) -> None:
    """OpenCV's model with what is written puts points where ours has them."""
    corner = np.hypot(max(x, 187 - x), max(y, 119 - y)) / focal
    camera = Camera((188, 120), focal, (x, y), bend / corner**2)
    message = frames._calibration(camera, "c", 1)
    if abs(bend) < 0.05:
        assert message is not None
    if abs(bend) > 0.5:
        assert message is None
    if message is None:
        return
    flat = np.stack(np.meshgrid(np.arange(0, 188, 11), np.arange(0, 120, 7)), -1).reshape(-1, 2)
    seen = flat.astype(float)
    straight = np.column_stack([(camera.undistort(seen) - (x, y)) / focal, np.ones(len(seen))])
    matrix = np.array(message.K).reshape(3, 3)
    theirs, _ = cv2.projectPoints(straight, np.zeros(3), np.zeros(3), matrix, np.array(message.D))
    assert np.abs(theirs[:, 0] - seen).max() < 0.11


# ---- what is wrong is said


@pytest.mark.parametrize(
    ("times", "pictures", "words"),
    [
        ([2, 1], noise(2), "older than the one before"),
        ([-1, 1], noise(2), "not in the range"),
        ([1, 2], noise(2, (120, 188, 2)), "uint8 values of shape (120, 188, 2)"),
        ([1, 2], [np.zeros((4, 5))] * 2, "float64 values"),
        ([1, 2], [np.zeros((0, 5), np.uint8)] * 2, "of shape (0, 5)"),
    ],
)
def test_frames_that_cannot_be_written(
    tmp_path: Path, times: list[int], pictures: list[np.ndarray], words: str
) -> None:
    with pytest.raises(InputError, match=words.replace("(", r"\(").replace(")", r"\)")):
        frames.write_session(
            tmp_path / "run.mcap", [Frames("c", np.array(times), ("a", "b"), pictures)], MANIFEST
        )
    assert list(tmp_path.iterdir()) == []


def test_two_cameras_of_one_name_and_no_frames(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="two cameras"):
        frames.write_session(tmp_path / "a", [camera_frames(1), camera_frames(1)], MANIFEST)
    with pytest.raises(InputError, match="no camera frame"):
        frames.write_session(tmp_path / "a", [camera_frames(0)], MANIFEST)
    assert list(tmp_path.iterdir()) == []


def test_a_session_without_frames_is_an_error(tmp_path: Path) -> None:
    from locatk.formats.sessions.writer import SessionWriter

    with SessionWriter(tmp_path / "run.mcap", system="dots"):
        pass
    with pytest.raises(FormatError, match="no camera frames") as caught:
        read(tmp_path / "run.mcap")
    assert "locatk import images" in (caught.value.hint or "")


def test_a_damaged_chunk_affects_only_its_frames(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    frames.write_session(path, [camera_frames(130)], MANIFEST)
    segments = Session.open(path).index.segments
    data = bytearray(path.read_bytes())
    data[segments[1].offset + segments[1].length // 2] ^= 0xFF
    path.write_bytes(data)
    messages: set[str] = set()
    (found,) = read(path)
    written = camera_frames(130).images
    readable = 0
    for number in range(130):
        try:
            image = found.images[number]
        except InputError as error:
            messages.add(str(error))
            continue
        np.testing.assert_array_equal(image, written[number])
        readable += 1
    assert 130 * 0.3 < readable < 130 * 0.9
    (message,) = messages
    assert "wrong checksum" in message or "cannot be decompressed" in message
    assert str(path) in message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("message", "words"),
    [
        (RawImage(width=2, height=2, step=2, encoding="mono8", data=b"abc"), "3 bytes for 2 x 2"),
        (RawImage(width=2, height=2, step=1, encoding="mono8", data=b"ab"), "rows of 1 bytes"),
        (RawImage(width=0, height=2, step=0, encoding="mono8"), "0 x 2 px"),
        (
            RawImage(width=2, height=1, step=4, encoding="yuyv", data=b"abcd"),
            "'yuyv' is not one of",
        ),
        (CompressedImage(data=b"hello", format="png"), "not an image"),
        (CompressedImage(data=images.encode_png(noise(1)[0])[:900], format="png"), "cut short"),
    ],
)
def test_a_frame_that_cannot_be_read_is_named(
    tmp_path: Path, message: RawImage | CompressedImage, words: str
) -> None:
    from locatk.formats.sessions.writer import SessionWriter

    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="dots") as writer:
        writer.write("/camera/c", message, 5)
    (found,) = read(path)
    with pytest.raises(InputError, match=words) as caught:
        found.images[0]
    assert caught.value.message.startswith("frame 0: ")
    assert (caught.value.file, caught.value.where) == (str(path), "/camera/c")


def test_invalid_frame_names_are_refused(tmp_path: Path) -> None:
    from locatk.formats.sessions.writer import SessionWriter

    raw = RawImage(width=1, height=1, step=1, encoding="mono8", data=b"a")
    for text, words in (
        (b'{"version": 1, "names": {"c": ["a", "b"]}}', "2 names for 1 frames"),
        (b'{"version": 2, "names": {}}', "newer"),
        (b'{"version": 1, "names": ["a"]}', "damaged names"),
        (b"[", "damaged names"),
    ):
        path = tmp_path / "run.mcap"
        with SessionWriter(path, system="dots", overwrite=True) as writer:
            writer.write("/camera/c", raw, 5)
            writer.attach(frames.FRAMES_FILE, text, "application/json")
        with pytest.raises(FormatError, match=words):
            read(path)


@pytest.mark.parametrize("options", [{"index_types": IndexType.NONE}, {"use_chunking": False}])
def test_files_without_indexes(tmp_path: Path, options: dict[str, object]) -> None:
    """As recorders of other tools write them, and with messages out of order."""
    path = tmp_path / "run.mcap"
    pictures = noise(40)
    with open(path, "wb") as stream:
        writer = Writer(stream, **options)
        writer.start("x", "other tool")
        for name, kind in (("camera/c", RawImage), ("other", CompressedImage)):
            files = build_file_descriptor_set(kind).SerializeToString()
            schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", files)
            channel = writer.register_channel(f"/{name}", "protobuf", schema)
            for number in reversed(range(40)):
                image = RawImage(
                    width=188, height=120, step=188, encoding="mono8",
                    data=pictures[number].tobytes(),
                )  # fmt: skip
                writer.add_message(channel, number, image.SerializeToString(), number)
        writer.finish()
    (found,) = read(path)
    assert found.time_ns.tolist() == list(range(40))
    np.testing.assert_array_equal(list(found.images), pictures)


def test_raw_sixteen_bits(tmp_path: Path) -> None:
    deep = noise(1, kind=np.uint16)[0]
    path = tmp_path / "run.mcap"
    frames.write_shots(path, {"c": [Shot(1, "0", deep)]})
    np.testing.assert_array_equal(read(path)[0].images[0], deep >> 8)
