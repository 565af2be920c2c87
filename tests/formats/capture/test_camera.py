"""Cameras: frames as image files with the time at which they came; the ends of each kind."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from locatk.formats import images
from locatk.formats.capture import camera
from locatk.formats.capture.camera import CameraLink, Frame, camera_port
from locatk.formats.capture.links import LinkEnded, LinkLost, SourceError

SIZE = (64, 48)
GREYS = list(range(20, 220, 20))


def ticks() -> Callable[[], int]:
    """A clock that goes on by one at each look."""
    counter = itertools.count()
    return lambda: next(counter)


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Ten frames of one grey each, at 100 frames a second."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 100, SIZE)
    for grey in GREYS:
        writer.write(np.full((SIZE[1], SIZE[0], 3), grey, np.uint8))
    writer.release()
    return path


def shown(link: CameraLink) -> tuple[list[Frame], Exception]:
    """All frames and what came after them."""
    frames: list[Frame] = []
    try:
        while True:
            found = link.read(5.0)
            assert found, "silence"
            frames += found
    except (LinkEnded, LinkLost) as end:
        return frames, end
    finally:
        link.close()


@pytest.mark.parametrize("format", ["jpeg", "png"])
def test_frames_of_a_video(video: Path, format: str) -> None:
    port = camera_port(str(video), clock=ticks(), speed=0, format=format)
    frames, end = shown(port.open())
    assert isinstance(end, LinkEnded)
    assert [(frame.width, frame.height) for frame in frames] == [SIZE] * len(GREYS)
    pictures = [images.decode(frame.image) for frame in frames]
    assert {picture.format for picture in pictures} == {format}
    assert {picture.pixels.ndim for picture in pictures} == {3}
    levels = [float(picture.pixels.mean()) for picture in pictures]
    assert levels == pytest.approx(GREYS, abs=3)
    times = [frame.time_ns for frame in frames]
    assert times == sorted(set(times))
    assert not port.can_reconnect


def test_png_loses_nothing(video: Path) -> None:
    capture = cv2.VideoCapture(str(video), cv2.CAP_FFMPEG)
    expected = [capture.read()[1][..., ::-1] for _ in GREYS]
    capture.release()
    frames, _ = shown(camera_port(str(video), clock=ticks(), speed=0, format="png").open())
    for frame, pixels in zip(frames, expected, strict=True):
        assert np.array_equal(images.decode(frame.image).pixels, pixels)


def test_what_is_known_of_it(video: Path) -> None:
    port = camera_port(str(video), clock=ticks(), speed=0)
    before = {"port": f"camera:{video}", "format": "jpeg"}
    assert port.describe() == before
    link = port.open()
    assert link.overruns() is None
    link.close()
    assert port.describe() == {
        **before,
        "width": "64",
        "height": "48",
        "fps": "100",
        "backend": "FFMPEG",
    }


@pytest.mark.parametrize("speed", [1.0, 2.0])
def test_a_video_keeps_its_pace(video: Path, speed: float) -> None:
    frames, _ = shown(camera_port(str(video), clock=time.monotonic_ns, speed=speed).open())
    # No frame is early: sleeping may take longer, never shorter.
    since = np.array([frame.time_ns for frame in frames[1:]]) - frames[0].time_ns
    due = np.arange(1, len(GREYS)) * 1e7 / speed
    assert (since >= due - 1e5).all()


def test_messages_of_opencv_are_off_while_it_is_open(video: Path) -> None:
    logging: Any = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    level = logging.getLogLevel()
    assert level != 0
    link = camera_port(str(video), clock=ticks(), speed=1e-3).open()
    assert logging.getLogLevel() == 0
    link.close()
    assert logging.getLogLevel() == level


def test_silence_until_a_frame_is_due(video: Path) -> None:
    link = camera_port(str(video), clock=ticks(), speed=1e-3).open()
    assert len(link.read(1.0)) == 1
    assert link.read(0.001) == []
    link.close()
    with pytest.raises(LinkEnded):
        link.read(0.0)


def test_a_file_waits_for_a_slow_reader(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "MAX_WAITING_BYTES", 3 * SIZE[0] * SIZE[1] * 2)
    link = camera_port(str(video), clock=ticks(), speed=0).open()
    time.sleep(0.05)
    assert len(link._waiting) <= 3
    frames, _ = shown(link)
    assert len(frames) == len(GREYS)
    assert link.dropped == 0


def test_a_video_that_is_cut_short(video: Path) -> None:
    data = video.read_bytes()
    sixth = [at for at in range(len(data)) if data.startswith(b"00dc", at)][6]
    video.write_bytes(data[:sixth])
    frames, end = shown(camera_port(str(video), clock=ticks(), speed=0).open())
    assert 0 < len(frames) < len(GREYS)
    assert isinstance(end, LinkLost)
    assert "truncated" in str(end)


def refused(place: str) -> SourceError:
    """The error of what is no camera."""

    def attempt() -> None:
        camera_port(place, clock=ticks()).open().close()

    with pytest.raises(SourceError) as error:
        attempt()
    assert "\n" not in str(error.value)
    return error.value


def test_a_camera_that_is_not_there() -> None:
    error = refused("73")
    assert str(error) == "camera:73: no such camera"
    assert error.hint
    assert "camera:/dev/video73: no such camera" in str(refused("/dev/video73"))


def test_an_address_without_a_camera() -> None:
    error = refused("rtsp://127.0.0.1:1/stream")
    assert str(error) == "rtsp://127.0.0.1:1/stream: no video was received"


def test_files_that_are_no_videos(tmp_path: Path) -> None:
    assert "no such video" in str(refused(str(tmp_path / "none.mp4")))
    assert "a folder instead of a file" in str(refused(str(tmp_path)))
    noise = np.random.default_rng(0).bytes(4000)
    for content in (b"", b"hello\n" * 100, noise):
        path = tmp_path / "some.mp4"
        path.write_bytes(content)
        error = refused(str(path))
        assert error.file == str(path)


@pytest.mark.slow
def test_the_libraries_say_nothing(tmp_path: Path) -> None:
    # Asked in a program of its own: here another test may have woken FFmpeg before.
    (tmp_path / "some.mp4").write_bytes(os.urandom(4000))
    code = """
import sys
from locatk.formats.capture.camera import camera_port
from locatk.formats.capture.links import SourceError
for place in sys.argv[1:]:
    try:
        camera_port(place, clock=lambda: 0).open()
    except SourceError as error:
        print(error)
"""
    places = ["73", "rtsp://127.0.0.1:1/x", "http://127.0.0.1:1/x", str(tmp_path / "some.mp4")]
    done = subprocess.run(
        [sys.executable, "-c", code, *places], capture_output=True, text=True, check=True
    )
    assert len(done.stdout.splitlines()) == len(places)
    assert done.stderr == ""


def test_a_device_without_rights_or_in_use(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = os.openpty()
    name = os.ttyname(slave)
    assert f"camera:{name}: in use by" in str(refused(name))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert f"camera:{name}: no permission to open it" in str(refused(name))
    os.close(master)
    os.close(slave)


def test_bad_arguments(video: Path) -> None:
    with pytest.raises(SourceError):
        camera_port("", clock=ticks())
    for speed in (-1.0, float("nan")):
        with pytest.raises(SourceError):
            camera_port(str(video), clock=ticks(), speed=speed)
    with pytest.raises(ValueError, match="tiff"):
        camera_port(str(video), clock=ticks(), format="tiff")


# A camera that sends as long as it likes: Motion JPEG over HTTP, as network cameras do


class Stream(BaseHTTPRequestHandler):
    """Twelve frames, then the end."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        for grey in range(20, 260, 20):
            picture = np.full((SIZE[1], SIZE[0], 3), grey, np.uint8)
            data = cv2.imencode(".jpg", picture)[1].tobytes()
            head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def stream() -> Iterator[str]:
    """The address of a network camera."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), Stream)
    thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/video.mjpg"
    server.shutdown()
    server.server_close()


def test_a_network_camera(stream: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "MAX_FRAME_GAP_S", 0.1)
    port = camera_port(stream, clock=ticks())
    assert port.can_reconnect
    for _ in range(2):
        frames, end = shown(port.open())
        assert len(frames) >= 10  # the last one may be taken for half a frame
        assert {(frame.width, frame.height) for frame in frames} == {SIZE}
        assert isinstance(end, LinkLost)
        assert "no more frames" in str(end)


class Capture:
    """A driver as OpenCV has it, whose camera is unplugged after some frames."""

    def __init__(self, answers: list[bool]) -> None:
        self.answers = answers
        self.released = False

    def grab(self) -> bool:
        return self.answers.pop(0) if self.answers else False

    def retrieve(self) -> tuple[bool, Any]:
        return True, np.zeros((SIZE[1], SIZE[0], 3), np.uint8)

    def get(self, what: int) -> float:
        return float("nan")

    def getBackendName(self) -> str:
        return "V4L2"

    def release(self) -> None:
        self.released = True


@pytest.fixture
def driver(monkeypatch: pytest.MonkeyPatch) -> Callable[[list[bool]], Capture]:
    """Puts a camera of one's own behind ``camera:0``."""
    monkeypatch.setattr(camera, "MAX_FRAME_GAP_S", 0.05)

    def plug(answers: list[bool]) -> Capture:
        capture = Capture(answers)
        monkeypatch.setattr(camera, "_open_capture", lambda address, is_file: capture)
        return capture

    return plug


def test_a_camera_is_unplugged(driver: Callable[[list[bool]], Capture]) -> None:
    capture = driver([True, True, False, True])  # a single failure is none
    port = camera_port("0", clock=ticks())
    frames, end = shown(port.open())
    assert len(frames) == 3
    assert isinstance(end, LinkLost)
    assert port.can_reconnect
    assert capture.released
    assert port.describe()["fps"] == "0"


def test_a_camera_that_gives_nothing(driver: Callable[[list[bool]], Capture]) -> None:
    capture = driver([])
    assert str(refused("0")) == "camera:0: no frame was received"
    assert capture.released


def test_a_video_without_frames_is_named(
    driver: Callable[[list[bool]], Capture], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    driver([])
    # Noise can look like the header of a video.
    monkeypatch.setattr(camera, "_check_file", lambda path: None)
    video = tmp_path / "empty.mp4"
    video.write_bytes(bytes(100))
    assert str(refused(str(video))) == f"{video}: the video has no frame"


def test_unread_frames_are_counted(
    driver: Callable[[list[bool]], Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(camera, "MAX_WAITING_BYTES", 4 * SIZE[0] * SIZE[1] * 3)
    capture = driver([True] * 10)
    link = camera_port("0", clock=ticks()).open()
    while not capture.released:
        time.sleep(0.01)
    frames, _ = shown(link)
    assert len(frames) == 4
    assert link.dropped == 6


def test_a_driver_that_fails(
    driver: Callable[[list[bool]], Capture], monkeypatch: pytest.MonkeyPatch
) -> None:
    driver([True, True])
    answers = [(True, np.zeros((4, 4), np.uint8))]

    def retrieve(self: Capture) -> tuple[bool, Any]:
        if not answers:
            raise cv2.error("the driver is broken")
        return answers.pop()

    monkeypatch.setattr(Capture, "retrieve", retrieve)
    frames, end = shown(camera_port("0", clock=ticks(), format="png").open())
    assert len(frames) == 1
    assert isinstance(end, LinkLost)
    assert "the driver is broken" in str(end)
