"""Image files and videos become frames: in order, on time, and none of them lost silently."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.dots.camera import Camera
from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats.importers.images import ImageFiles, find_images, natural_path_key
from locatk.formats.importers.video import Video, is_cut
from locatk.formats.sessions import frames, observations
from locatk.formats.sessions.reader import Session
from locatk.formats.tables.timestamps import UNDATED_START_NS


def picture(number: int, size: tuple[int, int] = (64, 48)) -> np.ndarray:
    """A smooth grey ramp whose mean tells its number."""
    width, height = size
    return np.full((height, width), 20 + 10 * number, np.uint8) + np.arange(width, dtype=np.uint8)


def save(path: Path, number: int = 0, **more: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    data = cv2.imencode(path.suffix, picture(number, **more))[1]  # type: ignore[arg-type]
    path.write_bytes(data.tobytes())
    return path


# ---- which files, in which order


def test_numbers_in_names_count_as_numbers(tmp_path: Path) -> None:
    names = ["frame1.png", "frame2.png", "frame10.png", "frame0100.png", "x1y2.png", "x1y10.png"]
    for name in reversed(names):
        save(tmp_path / name)
    assert [path.name for path in find_images([tmp_path])] == names
    # A shell gives them in its own order; the order of the names holds all the same.
    shell = sorted(tmp_path.iterdir())
    assert [path.name for path in find_images(shell)] == names


@given(st.lists(st.integers(0, 10**6), min_size=1, max_size=20, unique=True))
def test_any_numbers_come_in_order(numbers: list[int]) -> None:
    paths = sorted((Path(f"run/f{number}.png") for number in numbers), key=natural_path_key)
    assert [int(path.stem[1:]) for path in paths] == sorted(numbers)


@pytest.mark.slow
@given(st.lists(st.text(st.characters(exclude_characters="/\0"), min_size=1), min_size=2))
def test_any_names_can_be_ordered(names: list[str]) -> None:
    paths = [Path("run") / name for name in names]
    backward = paths[::-1]
    backward.sort(key=natural_path_key)
    assert backward == sorted(paths, key=natural_path_key)


def test_folders_files_and_patterns(tmp_path: Path) -> None:
    wanted = [save(tmp_path / "run" / f"{n}{ext}") for n, ext in enumerate((".PNG", ".bmp"))]
    deep = save(tmp_path / "run" / "more" / "2.jpg")
    (tmp_path / "run" / "notes.txt").write_text("not an image")
    (tmp_path / "run" / "sheet.toml").write_text("")
    assert find_images([tmp_path / "run"]) == wanted
    assert find_images([tmp_path / "run" / "*"]) == wanted
    assert find_images([tmp_path / "run" / "**" / "*"]) == [*wanted, deep]
    # The same file by three names is one frame.
    assert find_images([wanted[0], tmp_path / "run", tmp_path / "*" / "0.*"]) == wanted
    # Whoever names a file means it.
    assert find_images([tmp_path / "run" / "notes.txt"]) == [tmp_path / "run" / "notes.txt"]


def test_a_name_that_looks_like_a_pattern(tmp_path: Path) -> None:
    path = save(tmp_path / "run[1].png")
    assert find_images([path]) == [path]


@pytest.mark.parametrize(
    ("name", "kind", "words"),
    [
        ("none", MissingDataError, "No such file"),
        ("*.png", MissingDataError, "no file matches the pattern"),
        ("*.txt", FormatError, "no image files (1 files of other kinds)"),
        ("", FormatError, "no image files (1 files of other kinds)"),
    ],
)
def test_nothing_to_import(tmp_path: Path, name: str, kind: type, words: str) -> None:
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(kind) as caught:
        find_images([tmp_path / name])
    assert words in caught.value.message
    assert caught.value.file == str(tmp_path / name)


# ---- frames from files


def test_times_names_and_values(tmp_path: Path) -> None:
    files = [save(tmp_path / f"f{n}.png", n) for n in range(3)]
    shots = list(ImageFiles(files, rate_hz=40))
    assert [shot.time_ns for shot in shots] == [
        UNDATED_START_NS,
        UNDATED_START_NS + 25_000_000,
        1_050_000_000,
    ]
    assert [shot.name for shot in shots] == ["f0.png", "f1.png", "f2.png"]
    assert [shot.image for shot in shots] == [path.read_bytes() for path in files]


def test_names_of_several_folders_differ(tmp_path: Path) -> None:
    files = [save(tmp_path / folder / "1.png") for folder in "ab"]
    assert [shot.name for shot in ImageFiles(files)] == [path.as_posix() for path in files]


def test_a_bad_file_is_told_and_keeps_its_place_in_time(tmp_path: Path) -> None:
    files = [save(tmp_path / f"f{n}.png", n) for n in range(4)]
    files[1].write_bytes(files[1].read_bytes()[:60])
    files[2].write_text("hello")
    source = ImageFiles(files, rate_hz=10)
    assert [shot.time_ns for shot in source] == [UNDATED_START_NS, UNDATED_START_NS + 300_000_000]
    assert [line.partition(": ")[0] for line in source.warnings] == [str(f) for f in files[1:3]]
    assert (source.left_out, source.lost) == (2, "2 of 4 files are excluded")


@pytest.mark.skipif(os.getuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read(tmp_path: Path) -> None:
    files = [save(tmp_path / f"f{n}.png", n) for n in range(2)]
    files[0].chmod(0)
    source = ImageFiles(files)
    assert len(list(source)) == 1
    assert "ermission" in source.warnings[0]


def test_no_file_at_all_can_be_used(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_text("hello")
    with pytest.raises(FormatError, match=r"none of 1 files is usable: .*not an image"):
        list(ImageFiles([path]))


def test_frames_of_another_camera(tmp_path: Path) -> None:
    camera = Camera((64, 48), 500.0, (31.5, 23.5))
    files = [save(tmp_path / "0.png"), save(tmp_path / "1.png", size=(48, 64))]
    source = ImageFiles(files, camera=camera)
    assert len(list(source)) == 1
    assert "48 x 64 px, but the camera has 64 x 48 px" in source.warnings[0]


@pytest.mark.parametrize(
    ("kinds", "schema"),
    [
        ((".png", ".jpg"), CompressedImage),
        ((".bmp", ".pgm", ".tiff"), RawImage),
        ((".bmp", ".png"), CompressedImage),
    ],
)
def test_kinds_of_files(tmp_path: Path, kinds: tuple[str, ...], schema: type) -> None:
    files = [save(tmp_path / f"{n}{kind}", n) for n, kind in enumerate(kinds)]
    out = tmp_path / "run.mcap"
    frames.write_shots(out, {"camera": ImageFiles(files)})
    session = Session.open(out)
    assert session.topics("/camera/", schema.DESCRIPTOR.full_name) == ("/camera/camera",)
    (found,) = observations.read_frames(session)
    for number, image in enumerate(found.images):
        assert np.abs(image.astype(int) - picture(number)).max() <= (3 if ".jpg" in kinds else 0)
    if ".png" in kinds:  # a file is kept byte by byte also where others become PNG
        png = files[kinds.index(".png")].read_bytes()
        kept = [message.data for _, message in session.decoded("/camera/camera", CompressedImage)]
        assert png in kept


def test_the_log_names_what_was_left_out(tmp_path: Path) -> None:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    files = [save(tmp_path / f"f{n}.png", n) for n in range(3)]
    files[0].write_bytes(b"")
    source = ImageFiles(files)
    out = tmp_path / "run.mcap"
    frames.write_shots(out, {"camera": source}, warnings=source.warnings)
    (line,) = [message for _, message in Session.open(out).decoded("/log", Log)]
    assert str(files[0]) in line.message
    assert line.level == Log.WARNING


# ---- videos

TIMES_MS = (0, 33, 70, 100, 180, 200, 233, 500, 510, 530)


def element(name: str, *content: bytes) -> bytes:
    """Matroska element: id in hexadecimal, size in eight bytes, content."""
    data = b"".join(content)
    return bytes.fromhex(name) + (1 << 56 | len(data)).to_bytes(8, "big") + data


def number(value: int) -> bytes:
    return value.to_bytes(4, "big")


def matroska(path: Path, times_ms: tuple[int, ...] = TIMES_MS) -> Path:
    """A video of JPEG frames, written by hand: OpenCV cannot write other than a fixed rate."""
    blocks = [
        element(
            "a3",
            b"\x81" + time.to_bytes(2, "big") + b"\x80",
            cv2.imencode(".jpg", picture(n))[1].tobytes(),
        )
        for n, time in enumerate(times_ms)
    ]
    head = element(
        "1a45dfa3", element("4286", b"\1"), element("4282", b"matroska"), element("4287", b"\4")
    )
    track = element(
        "ae",
        element("d7", b"\1"),
        element("73c5", b"\1"),
        element("83", b"\1"),
        element("86", b"V_MJPEG"),
        element("e0", element("b0", number(64)), element("ba", number(48))),
    )
    body = element(
        "18538067",
        element("1549a966", element("2ad7b1", number(1_000_000))),
        element("1654ae6b", track),
        element("1f43b675", element("e7", number(0)), *blocks),
    )
    path.write_bytes(head + body)
    return path


def test_times_of_a_video_are_kept(tmp_path: Path) -> None:
    source = Video(matroska(tmp_path / "run.mkv"))
    shots = list(source)
    assert [shot.time_ns for shot in shots] == [
        UNDATED_START_NS + ms * 1_000_000 for ms in TIMES_MS
    ]
    assert [shot.name for shot in shots] == [str(n) for n in range(10)]
    for n, shot in enumerate(shots):
        assert shot.image.shape == (48, 64)
        assert np.abs(shot.image.astype(int) - picture(n)).max() <= 3
    assert source.warnings == []
    assert source.lost is None


@pytest.mark.parametrize(("name", "fourcc"), [("run.avi", "MJPG"), ("run.mp4", "mp4v")])
def test_videos_of_a_fixed_rate(tmp_path: Path, name: str, fourcc: str) -> None:
    path = tmp_path / name
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*fourcc), 25, (64, 48), False)
    for n in range(20):
        writer.write(picture(n % 10))
    writer.release()
    source = Video(path)
    shots = list(source)
    assert len(shots) == len(source) == 20
    np.testing.assert_allclose(
        [s.time_ns - UNDATED_START_NS for s in shots], 4e7 * np.arange(20), atol=1
    )
    assert all(
        np.abs(s.image.astype(int) - picture(n % 10)).mean() < 4 for n, s in enumerate(shots)
    )
    assert source.warnings == []
    # The index of these formats is at the end: what is cut is told, or cannot be opened.
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    assert is_cut(path)
    try:
        source = Video(path)
        assert 5 < len(list(source)) < 20
    except FormatError as error:
        assert error.file == str(path)  # noqa: PT017
    else:
        assert "truncated after" in (source.lost or "")


def test_a_video_that_is_cut_short(tmp_path: Path) -> None:
    path = matroska(tmp_path / "run.mkv")
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    source = Video(path)
    shots = list(source)
    assert 4 < len(shots) < 10
    assert [shot.time_ns - UNDATED_START_NS for shot in shots] == [
        ms * 1_000_000 for ms in TIMES_MS[: len(shots)]
    ]
    assert source.lost == f"{path}: truncated after {len(shots)} frames"


@pytest.mark.slow
@given(st.binary(max_size=300))
def test_no_bytes_upset_the_look_for_the_end(tmp_path_factory, data: bytes) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path_factory.getbasetemp() / "any"
    for head in (
        b"RIFF",
        b"\x1a\x45\xdf\xa3",
        b"\0\0\0\x20ftyp",
        b"\x1a\x45\xdf\xa3\x80\x18\x53\x80\x67",
    ):
        path.write_bytes(head + data)
        assert is_cut(path) in (True, False)


@pytest.mark.parametrize("data", [b"", b"hello world\n" * 300, bytes(range(256)) * 20])
def test_what_is_no_video(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "run.mp4"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="not a readable video"):
        Video(path)


def test_a_video_of_another_camera(tmp_path: Path) -> None:
    path = matroska(tmp_path / "run.mkv")
    with pytest.raises(InputError, match="64 x 48 px, but the camera has 188 x 120 px"):
        list(Video(path, camera=Camera((188, 120), 900.0, (93.5, 59.5))))
