"""Cameras, network streams and video files as sources of frames, through OpenCV.

A thread takes each frame as soon as the driver provides it, and stamps it with that time; the
reading thread encodes it as an image file. A video file is played in real time, its frames at
the times at which they are due; ``locatk import video`` is faster and keeps the times of the
file.
"""

from __future__ import annotations

import contextlib
import math
import os
import stat
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from locatk.core.errors import LocatkError
from locatk.formats.capture.links import LinkEnded, LinkLost, Overruns, SourceError
from locatk.formats.capture.port_listing import busy_error, find_port_users, permission_error
from locatk.formats.importers.video import Video, is_cut, open_file, silence_opencv

FORMATS = ("jpeg", "png")

JPEG_QUALITY = 95

MAX_FRAME_GAP_S = 1.0
"""Time without frames after which a camera is considered lost; single frames may fail."""

TIMEOUT_MS = 5_000
"""Time after which a silent network stream is closed; V4L2 has a timeout of 10 s of its own."""

MAX_WAITING_BYTES = 64 << 20
"""Limit of the pixels that wait to be read."""

MAX_READ_FRAMES = 8
"""Frames per read, because their encoding takes time."""


class Frame(NamedTuple):
    """Frame: its time in ns of the given clock, and its image file."""

    time_ns: int
    image: bytes
    width: int
    height: int

    @property
    def size(self) -> int:
        """Bytes of the image file."""
        return len(self.image)


class CameraPort:
    """Camera, stream or video file; see :func:`camera_port`."""

    def __init__(
        self, address: str, *, clock: Callable[[], int], speed: float, format: str
    ) -> None:
        self.name = f"camera:{address}"
        self._address = address
        self._clock = clock
        self._speed = speed
        self._format = format
        self._properties: dict[str, str] = {}
        self.can_reconnect = not self._is_file()

    def _is_file(self) -> bool:
        """Return whether it has an end: it is no number, address, or device such as /dev/video0."""
        if self._address.isdecimal() or "://" in self._address:
            return False
        try:
            return not stat.S_ISCHR(os.stat(self._address).st_mode)
        except OSError:
            return not self._address.startswith("/dev/")

    def open(self) -> CameraLink:
        """Open it and wait for its first frame.

        Raises
        ------
        SourceError
            It cannot be opened, or provides no frame.
        """
        is_file = self._is_file()
        if is_file:
            _check_file(self._address)
        with contextlib.ExitStack() as resources:
            resources.enter_context(silence_opencv())
            capture = _open_capture(self._address, is_file)
            if capture is None:
                raise self._explain_error(is_file)
            resources.callback(capture.release)
            first = _grab(capture, self._clock)
            if first is None and is_file:
                hint = "The video may be truncated"
                raise SourceError("the video has no frame", file=self._address, hint=hint)
            if first is None:
                hint = "Check that no other program uses it"
                raise SourceError("no frame was received", file=self.name, hint=hint)
            height, width = first[1].shape[:2]
            self._properties = {
                "width": str(width),
                "height": str(height),
                "fps": f"{_rate(capture):g}",
                "backend": capture.getBackendName(),
            }
            return CameraLink(
                capture,
                first,
                release=resources.pop_all().close,
                clock=self._clock,
                file=self._address if is_file else None,
                speed=self._speed,
                format=self._format,
            )

    def describe(self) -> dict[str, str]:
        """Return ``port`` and ``format``; once it was open, also facts of the video.

        These are ``width``, ``height``, ``fps`` (0 if unknown) and ``backend``, that of OpenCV.
        """
        return {"port": self.name, "format": self._format, **self._properties}

    def _explain_error(self, is_file: bool) -> SourceError:
        if is_file or "://" in self._address:
            hint = "Check the address, and that the camera is on"
            return SourceError("no video was received", file=self._address, hint=hint)
        path = f"/dev/video{self._address}" if self._address.isdecimal() else self._address
        if os.path.exists(path):
            if not os.access(path, os.R_OK | os.W_OK):
                return permission_error(self.name, path)
            if find_port_users([path])[path]:
                return busy_error(self.name, path)
        devices = sorted(str(each) for each in Path("/dev").glob("video*"))
        hint = f"Available: {', '.join(devices)}" if devices else "Check that it is plugged in"
        return SourceError("no such camera", file=self.name, hint=hint)


def camera_port(
    address: str, *, clock: Callable[[], int], speed: float = 1.0, format: str = "jpeg"
) -> CameraPort:
    """Return the camera at an address, not yet opened.

    Parameters
    ----------
    address : str
        Number of a camera, URL (``rtsp://...``, ``http://...``), device or video file.
    clock : callable
        Returns the time in ns; called by several threads.
    speed : float
        Factor on the speed of a video file; 0 is as fast as it is read.
    format : str
        ``"jpeg"`` (quality 95) or ``"png"``, which is lossless.

    Raises
    ------
    SourceError
        The address or ``speed`` is invalid.
    """
    if not address:
        raise SourceError(
            "the name of the camera is empty", hint="Example: camera:0, camera:video.mp4"
        )
    if not (math.isfinite(speed) and speed >= 0):
        raise SourceError(f"{speed} is not a valid speed", hint="Give 1, 10, or 0 for the fastest")
    if format not in FORMATS:
        raise ValueError(f"format {format!r} is none of {FORMATS}")
    return CameraPort(address, clock=clock, speed=speed, format=format)


class CameraLink:
    """Frames of an open camera.

    Attributes
    ----------
    dropped : int
        Frames of a camera dropped because the queue was full; no frames of a file are dropped.
    """

    def __init__(
        self,
        capture: Any,
        first: tuple[int, Any],
        *,
        release: Callable[[], object],
        clock: Callable[[], int],
        file: str | None,
        speed: float,
        format: str,
    ) -> None:
        self.dropped = 0
        self._capture = capture
        self._release = release
        self._clock = clock
        self._file = file
        self._speed = speed
        self._format = format
        self._waiting = deque([first])
        self._bytes = int(first[1].nbytes)
        self._end: LinkEnded | LinkLost | None = None
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="locatk-camera", daemon=True)
        self._thread.start()

    def read(self, wait_s: float) -> list[Frame]:
        """Return the frames that have arrived, at most MAX_READ_FRAMES.

        Wait for the first one, at most ``wait_s``.

        Raises
        ------
        LinkLost
            A camera provides no more frames, or a file is truncated.
        LinkEnded
            The file is at its end.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._end, max(0.0, wait_s))
            if not self._waiting and self._end is not None:
                raise self._end
            taken = [
                self._waiting.popleft() for _ in range(min(MAX_READ_FRAMES, len(self._waiting)))
            ]
            self._bytes -= sum(pixels.nbytes for _, pixels in taken)
            self._changed.notify_all()
        return [self._encode(time_ns, pixels) for time_ns, pixels in taken]

    def _encode(self, time_ns: int, pixels: Any) -> Frame:
        import cv2

        options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY] if self._format == "jpeg" else []
        suffix = ".jpg" if self._format == "jpeg" else ".png"
        done, data = cv2.imencode(suffix, pixels, options)
        if not done:
            raise LinkLost(f"a frame cannot be encoded as {self._format}")
        return Frame(time_ns, data.tobytes(), pixels.shape[1], pixels.shape[0])

    def overruns(self) -> Overruns | None:
        """Return None, because bytes are not counted; see :attr:`dropped`."""
        return None

    def close(self) -> None:
        """Close the camera. If a driver hangs, the camera stays open until it returns."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        self._thread.join(2.0)

    def _run(self) -> None:
        try:
            end = self._play_file() if self._file is not None else self._take_camera_frames()
        except Exception as error:  # Any error of a driver must be reported.
            end = LinkLost(f"{type(error).__name__}: {error}")
        finally:
            self._release()
        with self._changed:
            self._end = end
            self._changed.notify_all()

    def _take_camera_frames(self) -> LinkEnded | LinkLost:
        """Take the frames of a camera until there are no more."""
        last = time.monotonic()
        while not self._closing:
            grabbed = _grab(self._capture, self._clock)
            if grabbed is not None:
                last = time.monotonic()
                with self._changed:
                    if self._waiting and self._bytes + grabbed[1].nbytes > MAX_WAITING_BYTES:
                        self.dropped += 1
                    else:
                        self._put(grabbed)
            elif time.monotonic() - last > MAX_FRAME_GAP_S:
                return LinkLost("no more frames: unplugged, or end of the stream")
            else:
                time.sleep(0.01)
        return LinkEnded("closed")

    def _play_file(self) -> LinkEnded | LinkLost:
        """Take the frames of a file, each when it is due."""
        begun, count, position_s = time.monotonic(), 1, 0.0
        origin_s = _position_s(self._capture)
        step_s = 1 / (_rate(self._capture) or 30.0)
        while True:
            grabbed = _grab(self._capture, self._clock)
            if grabbed is None:
                break
            # Some files have no timestamps, or wrong ones.
            stated_s = _position_s(self._capture) - origin_s
            position_s = stated_s if stated_s > position_s else position_s + step_s
            due = begun + position_s / self._speed if self._speed else begun
            with self._changed:
                self._changed.wait_for(lambda: self._closing, max(0.0, due - time.monotonic()))
                self._changed.wait_for(lambda: self._closing or self._bytes < MAX_WAITING_BYTES)
                if self._closing:
                    return LinkEnded("closed")
                self._put((self._clock(), grabbed[1]))
            count += 1
        if is_cut(Path(self._file or "")):
            return LinkLost(f"the video is truncated after {count} frames")
        return LinkEnded("the end of the video")

    def _put(self, grabbed: tuple[int, Any]) -> None:
        self._waiting.append(grabbed)
        self._bytes += grabbed[1].nbytes
        self._changed.notify_all()


def _check_file(path: str) -> None:
    if not os.path.exists(path):
        raise SourceError("no such video", file=path, hint="Cameras are camera:0, camera:1, ...")
    try:
        Video(Path(path))
    except LocatkError as error:
        raise SourceError(error.message, file=path, hint=error.hint) from None


def _open_capture(address: str, is_file: bool) -> Any:
    """Return an open ``cv2.VideoCapture``, or None."""
    import cv2

    capture = cv2.VideoCapture()
    if is_file:
        is_open = open_file(capture, address)
    elif "://" in address:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC]
        options = [value for limit in limits for value in (limit, TIMEOUT_MS)]
        is_open = capture.open(address, cv2.CAP_FFMPEG, options)
    elif address.isdecimal():
        is_open = capture.open(int(address), cv2.CAP_ANY)
    else:
        # Other backends would read from any device, and block.
        is_open = capture.open(address, cv2.CAP_V4L2)
    return capture if is_open else None


def _grab(capture: Any, clock: Callable[[], int]) -> tuple[int, Any] | None:
    """Return (time in ns, pixels) of the next frame; None if there is none."""
    is_ok = capture.grab()
    time_ns = clock()
    if is_ok:
        is_ok, pixels = capture.retrieve()
    return (time_ns, pixels) if is_ok else None


def _rate(capture: Any) -> float:
    import cv2

    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return rate if math.isfinite(rate) and rate > 0 else 0.0


def _position_s(capture: Any) -> float:
    import cv2

    return float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1e3
