"""Image files of one camera, imported as the frames of a session.

Files come in the natural order of their names (``frame2`` before ``frame10``), folder after
folder. They contain no times, which therefore follow from a rate: the first frame is at
:data:`~locatk.formats.tables.timestamps.UNDATED_START_NS`, and an unreadable file is a gap.
"""

from __future__ import annotations

import glob
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.errors import FormatError, InputError, LocatkError, MissingDataError
from locatk.core.natural_order import natural_key
from locatk.formats import images
from locatk.formats.files import read_bytes, read_head
from locatk.formats.sessions.frames import Shot
from locatk.formats.tables.timestamps import UNDATED_START_NS

DEVICE = "camera"
"""Name of the camera, which image files and videos do not contain."""

DEFAULT_RATE_HZ = 30.0

MAGIC_BYTES = 12
"""Bytes at the beginning of a file that identify a compressed image."""


class ImageFiles:
    """Frames from image files; iterate to read them, once.

    Parameters
    ----------
    files : sequence of path
        In order of time; see :func:`find_images`.
    rate_hz : float
        Frames per second.
    camera : Camera, optional
        Frames must have its size.

    Attributes
    ----------
    warnings : list of str
        Excluded files and the reasons, one line a file; grows while iterating.
    left_out : int
        Number of excluded files.
    lost : str or None
        Summary of the excluded files, if there are any.
    facts : dict of str to str
        For the session's metadata.
    """

    def __init__(
        self,
        files: Sequence[Path],
        *,
        rate_hz: float = DEFAULT_RATE_HZ,
        camera: Camera | None = None,
    ) -> None:
        self._files = files
        self._rate_hz = rate_hz
        self._camera = camera
        self.warnings: list[str] = []
        self.facts = {
            "importer": "images",
            "source": ", ".join(dict.fromkeys(str(file.parent) for file in files)),
            "files": str(len(files)),
            "rate_hz": repr(float(rate_hz)),
        }

    def __len__(self) -> int:
        """Number of files, including unreadable ones."""
        return len(self._files)

    @property
    def left_out(self) -> int:
        return len(self.warnings)

    @property
    def lost(self) -> str | None:
        if not self.warnings:
            return None
        return f"{self.left_out} of {len(self)} files are excluded"

    def __iter__(self) -> Iterator[Shot]:
        """Yield the frames in order of time.

        Raises
        ------
        InputError
            None of the files is a usable image.
        """
        names = frame_names(self._files)
        # A topic has one kind of message: if some files are stored as they are, the others
        # are stored as PNG.
        has_compressed = any(images.is_compressed(_head(file)) for file in self._files)
        count = 0
        for number, (file, name) in enumerate(zip(self._files, names, strict=True)):
            try:
                data = read_bytes(file)
                picture = images.decode(data)
                check_size(picture.pixels, self._camera)
            except (InputError, MissingDataError) as error:
                self.warnings.append(f"{file}: {error.message}")
                continue
            count += 1
            time_ns = UNDATED_START_NS + round(number * 1e9 / self._rate_hz)
            if picture.format:
                yield Shot(time_ns, name, data, picture.format)
            elif has_compressed:
                yield Shot(time_ns, name, images.encode_png(picture.pixels), "png")
            else:
                yield Shot(time_ns, name, picture.pixels)
        if count == 0:
            reason = self.warnings[0] if self.warnings else "there are none"
            raise FormatError(
                f"none of {len(self._files)} files is usable: {reason}",
                hint="Compare the --camera with the frames"
                if self._camera is not None
                else "Give image files; `locatk import video` reads videos",
            )


def find_images(paths: Sequence[Path]) -> list[Path]:
    """Find the image files that ``paths`` name, each once, in natural order.

    Parameters
    ----------
    paths : sequence of path
        Files with any name; folders, in which the files with an extension of images are taken,
        without sub-folders; or patterns such as ``run/*.png``, likewise.

    Raises
    ------
    MissingDataError
        A path is missing, or no file matches a pattern.
    FormatError
        A folder or pattern has no image.
    """
    by_path: dict[str, Path] = {}
    for path in paths:
        for file in _expand(path):
            by_path.setdefault(os.path.realpath(file), file)
    return sorted(by_path.values(), key=natural_path_key)


def _expand(path: Path) -> list[Path]:
    """Return the files that a path names: itself, those of a folder, or those of a pattern."""
    if path.is_dir():
        files = [file for file in path.iterdir() if file.is_file()]
        kind = "folder"
    elif path.exists():
        return [path]
    elif glob.has_magic(str(path)):
        files = [Path(name) for name in glob.glob(str(path), recursive=True)]
        files = [file for file in files if file.is_file()]
        kind = "pattern"
        if not files:
            raise MissingDataError(
                "no file matches the pattern", file=path, hint="Check the folder and the extension"
            )
    else:
        raise MissingDataError(
            "No such file or folder", file=path, hint="Check the spelling of the path"
        )
    image_files = [file for file in files if file.suffix.lower() in images.EXTENSIONS]
    if not image_files:
        raise FormatError(
            f"no image files ({len(files)} files of other kinds)",
            file=path,
            hint=f"Give a {kind} with {', '.join(sorted(images.EXTENSIONS))}; a pattern such as "
            "'run/**/*.png' searches sub-folders",
        )
    return image_files


def frame_names(files: Sequence[Path]) -> list[str]:
    """Return the names of the frames: those of the files, with folders if names repeat."""
    names = [file.name for file in files]
    return names if len(set(names)) == len(names) else [file.as_posix() for file in files]


def check_size(pixels: NDArray[Any], camera: Camera | None) -> None:
    """Refuse a frame whose size differs from that of the camera.

    Raises
    ------
    InputError
    """
    if camera is None or pixels.shape[:2] == camera.size[::-1]:
        return
    height, width = pixels.shape[:2]
    raise InputError(
        f"{width} x {height} px, but the camera has {camera.size[0]} x {camera.size[1]} px"
    )


def natural_path_key(path: Path) -> tuple[Any, Any]:
    """Return a sort key: natural order of the folders, then of the names."""
    return natural_key(path.parent.as_posix()), natural_key(path.name)


def _head(file: Path) -> bytes:
    try:
        return read_head(file, MAGIC_BYTES)
    except LocatkError:
        return b""
