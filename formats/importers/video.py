"""Video files, imported as the frames of a session.

The times are those of the video, also if its rate varies. It begins at
:data:`~locatk.formats.tables.timestamps.UNDATED_START_NS`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.dots.camera import Camera
from locatk.core.errors import FormatError, InputError
from locatk.formats.files import check_regular, open_binary, read_head
from locatk.formats.importers.images import check_size
from locatk.formats.sessions.frames import Shot
from locatk.formats.tables.timestamps import UNDATED_START_NS

EBML_MAGIC, SEGMENT_MAGIC = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
"""First bytes of a Matroska file and of its segment."""

MAX_MISSING_S = 0.5
"""Longest time between the last frame and the claimed end of a video that is complete."""

DEFAULT_STEP_NS = 33_333_333
"""Time between frames of a video without a rate, at 30 Hz."""

HEAD_BYTES = 256
"""Beginning of a file with the sizes that its container claims."""

TEXT_CHECK_BYTES = 4096


class Video:
    """Frames of a video file; iterate to read them, once.

    Parameters
    ----------
    path : path
    camera : Camera, optional
        Frames must have its size.

    Attributes
    ----------
    warnings : list of str
        Losses and doubts, one line each; grows while iterating.
    left_out : int
        0, because the number of frames that a damaged video lost is unknown.
    lost : str or None
        Text on a missing end, if it is; known after iterating.
    facts : dict of str to str
        For the session's metadata.

    Raises
    ------
    FormatError
        The file is not a video that OpenCV can read.
    """

    def __init__(self, path: Path, *, camera: Camera | None = None) -> None:
        self._path = path
        self._camera = camera
        self.warnings: list[str] = []
        self.left_out = 0
        self.lost: str | None = None
        with _capture(path) as (capture, cv2):
            self._rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
            self._claimed = int(max(0.0, capture.get(cv2.CAP_PROP_FRAME_COUNT)))
        self.facts = {"importer": "video", "source": path.name}

    def __len__(self) -> int:
        """Number of frames that the file claims, which some formats only estimate."""
        return self._claimed

    def __iter__(self) -> Iterator[Shot]:
        """Yield the frames in order of time.

        Raises
        ------
        FormatError
            No frame is readable.
        InputError
            Their size differs from that of the camera.
        """
        count = guessed = 0
        last_ns = longest_ns = 0
        step_ns = round(1e9 / self._rate_hz) if self._rate_hz > 0 else DEFAULT_STEP_NS
        with _capture(self._path) as (capture, cv2):
            while True:
                has_frame, picture = capture.read()
                if not has_frame:
                    break
                time_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
                if count and time_ns <= last_ns:
                    guessed += 1
                    time_ns = last_ns + step_ns
                if count:
                    longest_ns = max(longest_ns, time_ns - last_ns)
                last_ns = time_ns
                pixels = picture
                if picture.ndim == 3:
                    pixels = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
                pixels = np.asarray(pixels, np.uint8)
                try:
                    check_size(pixels, self._camera)
                except InputError as error:
                    raise InputError(
                        error.message, file=self._path, hint="Compare the --camera with the video"
                    ) from None
                yield Shot(UNDATED_START_NS + max(0, time_ns), str(count), pixels)
                count += 1
        if count == 0:
            raise FormatError(
                "no frame of the video is readable", file=self._path, hint="Is it cut short?"
            )
        if guessed:
            self.warnings.append(
                f"{self._path}: {guessed} frames without a time; their times follow from the rate"
            )
        missing_s = self._claimed / self._rate_hz - last_ns / 1e9 if self._rate_hz > 0 else 0.0
        if is_cut(self._path):
            self.lost = f"{self._path}: truncated after {count} frames"
        # The duration of a Matroska file counts from 0, even if its first frame is later.
        elif missing_s > max(MAX_MISSING_S, 2e-9 * longest_ns) and not _is_matroska(self._path):
            self.lost = f"{self._path}: the frames end {missing_s:.1f} s before the claimed end"
        if self.lost is not None:
            self.warnings.append(self.lost)


def is_cut(path: Path) -> bool:
    """Return whether a video file is shorter than its container claims.

    MP4 and MOV (boxes), MKV and WebM (segment) and AVI (RIFF) contain their size. False for
    others, and if a live recording left the size open.
    """
    size = check_regular(path)
    with open_binary(path) as stream:
        head = stream.read(HEAD_BYTES)
        if head[:4] == b"RIFF":
            claimed = int.from_bytes(head[4:8], "little")
            return claimed not in (0, 0xFFFFFFFF) and 8 + claimed > size
        if head[:4] == EBML_MAGIC:
            return _segment_end(head) > size
        if head[4:8] != b"ftyp":
            return False
        position = 0
        while position + 8 <= size:
            stream.seek(position)
            box = stream.read(16)
            length = int.from_bytes(box[:4], "big")
            if length == 1:
                length = int.from_bytes(box[8:16], "big")
            if length < 8:  # 0: up to the end of the file
                return False
            position += length
        return position > size


def _is_matroska(path: Path) -> bool:
    return read_head(path, len(EBML_MAGIC)) == EBML_MAGIC


def _segment_end(head: bytes) -> int:
    """Return the end of the segment of a Matroska file, 0 if unknown."""
    segment = _element_end(head, len(EBML_MAGIC))
    if segment is None or head[segment : segment + 4] != SEGMENT_MAGIC:
        return 0
    return _element_end(head, segment + 4) or 0


def _element_end(head: bytes, position: int) -> int | None:
    """Return the end of the Matroska element whose size is at ``position``; None if unknown.

    The number of leading zero bits of a size is its length in bytes minus one (RFC 8794, 4).
    """
    first = head[position] if position < len(head) else 0
    length = 9 - first.bit_length()
    unknown = (1 << 7 * length) - 1
    value = int.from_bytes(head[position : position + length], "big") & unknown
    return None if length > 8 or value == unknown else position + length + value


def _is_text(path: Path) -> bool:
    """Return whether a file is plain text, which FFmpeg would render as a video of a terminal."""
    head = read_head(path, TEXT_CHECK_BYTES)
    return all(byte > 31 or byte in b"\t\n\v\f\r\x1b" for byte in head)


@contextmanager
def _capture(path: Path) -> Iterator[tuple[Any, Any]]:
    """Open a video and OpenCV, which prints nothing meanwhile."""
    with silence_opencv() as cv2:
        capture = cv2.VideoCapture()
        try:
            if _is_text(path) or not open_file(capture, path):
                raise FormatError(
                    "not a readable video",
                    file=path,
                    hint="Give MP4, MKV, AVI or WebM; `locatk import images` takes image files",
                )
            yield capture, cv2
        finally:
            capture.release()


@contextmanager
def silence_opencv() -> Iterator[Any]:
    """Yield the module ``cv2``; OpenCV prints no messages in this context."""
    # The library reads this when it opens its first video; -8 means quiet.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    # OpenCV is slow to import, and must read the variable above.
    import cv2

    # OpenCV 5 moved these two functions.
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(0)  # silent
    try:
        yield cv2
    finally:
        logging.setLogLevel(level)


def open_file(capture: Any, path: str | Path) -> bool:
    """Open a video file with a ``cv2.VideoCapture``; return whether it is a readable video."""
    import cv2

    # An absolute path is never mistaken for a network address.
    is_open: bool = capture.open(os.path.abspath(path), cv2.CAP_FFMPEG)
    if is_open:
        # Pixels stay at their positions on the sensor, as in image files.
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return is_open
