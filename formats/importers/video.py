"""A video file, read as the frames of a session.

The times are those of the video: its frames keep their distances, also where the rate
varies. Its beginning is at :data:`START_NS`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from locatk.core.dots.camera import Camera
from locatk.core.errors import FormatError, InputError
from locatk.formats.importers.images import START_NS, check_size
from locatk.formats.sessions.frames import Shot

_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"
"""With which a Matroska file and the segment in it begin."""

LOST_S = 0.5
"""A video whose frames end so long before the duration it claims is called cut short."""


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
        What is lost or doubtful, one line each; grows while iterating.
    left_out : int
        0: how many frames a damaged video has lost is not known.
    lost : str or None
        Whether the end is missing, in a line; known after iterating.
    facts : dict of str to str
        For the session's metadata.

    Raises
    ------
    FormatError
        It is no video that OpenCV can read.
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
        """Number of frames as the file claims, which is a guess in some formats."""
        return self._claimed

    def __iter__(self) -> Iterator[Shot]:
        """The frames, in the order of time.

        Raises
        ------
        FormatError
            There is none that can be read.
        InputError
            They have another size than the camera.
        """
        import numpy as np

        count = guessed = 0
        last_ns = longest_ns = 0
        step_ns = round(1e9 / self._rate_hz) if self._rate_hz > 0 else 33_333_333
        with _capture(self._path) as (capture, cv2):
            while True:
                there, picture = capture.read()
                if not there:
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
                yield Shot(START_NS + max(0, time_ns), str(count), pixels)
                count += 1
        if count == 0:
            raise FormatError(
                "no frame of the video can be read", file=self._path, hint="Is it cut short?"
            )
        if guessed:
            self.warnings.append(
                f"{self._path}: {guessed} frames without a time of their own, placed by the rate"
            )
        missing_s = self._claimed / self._rate_hz - last_ns / 1e9 if self._rate_hz > 0 else 0.0
        if is_cut(self._path):
            self.lost = f"{self._path}: cut short after {count} frames"
        # The duration of a Matroska file counts from 0, wherever its first frame is.
        elif missing_s > max(LOST_S, 2e-9 * longest_ns) and not _is_matroska(self._path):
            self.lost = f"{self._path}: the frames end {missing_s:.1f} s before the video should"
        if self.lost is not None:
            self.warnings.append(self.lost)


def is_cut(path: Path) -> bool:
    """Whether a video file ends before what its container says.

    Told by MP4 and MOV (boxes), MKV and WebM (segment) and AVI (RIFF); False for others,
    and where a live recording has left the size open.
    """
    size = path.stat().st_size
    with open(path, "rb") as stream:
        head = stream.read(256)
        if head[:4] == b"RIFF":
            claimed = int.from_bytes(head[4:8], "little")
            return claimed not in (0, 0xFFFFFFFF) and 8 + claimed > size
        if head[:4] == _EBML:
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
    with open(path, "rb") as stream:
        return stream.read(len(_EBML)) == _EBML


def _segment_end(head: bytes) -> int:
    """Where the segment of a Matroska file ends, 0 where it does not say."""
    segment = _element_end(head, len(_EBML))
    if segment is None or head[segment : segment + 4] != _SEGMENT:
        return 0
    return _element_end(head, segment + 4) or 0


def _element_end(head: bytes, position: int) -> int | None:
    """Where the Matroska element ends whose size stands at ``position``, if it says so.

    RFC 8794, 4: the leading zero bits of a size tell how many bytes it has.
    """
    first = head[position] if position < len(head) else 0
    length = 9 - first.bit_length()
    unknown = (1 << 7 * length) - 1
    value = int.from_bytes(head[position : position + length], "big") & unknown
    return None if length > 8 or value == unknown else position + length + value


def _is_text(path: Path) -> bool:
    """Whether a file is plain text, of which FFmpeg would make a video of a terminal."""
    try:
        with open(path, "rb") as stream:
            head = stream.read(4096)
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", file=path) from None
    return all(byte > 31 or byte in b"\t\n\v\f\r\x1b" for byte in head)


@contextmanager
def _capture(path: Path) -> Iterator[tuple[Any, Any]]:
    """The opened video and OpenCV, which says nothing on its own meanwhile."""
    # Read by the library when it opens its first video; -8 is silence.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    import cv2

    # Where these two are moved from OpenCV 4 to 5.
    logging = cv2 if hasattr(cv2, "setLogLevel") else cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(0)  # silent
    capture = cv2.VideoCapture()
    try:
        # As an absolute path no file name is taken for an address on the network.
        opened = not _is_text(path) and capture.open(os.path.abspath(path), cv2.CAP_FFMPEG)
        if opened:
            # Pixels stay where the sensor had them, as in image files.
            capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        else:
            raise FormatError(
                "not a video that can be read",
                file=path,
                hint="Give MP4, MKV, AVI or WebM; `locatk import images` takes image files",
            )
        yield capture, cv2
    finally:
        capture.release()
        logging.setLogLevel(level)
