"""Image files of one camera, read as the frames of a session.

Files come in the natural order of their names (``frame2`` before ``frame10``), folder after
folder. Nothing in them says when they were taken, so that a rate does: the first frame is at
:data:`START_NS`, and a file that cannot be read keeps its place in time.
"""

from __future__ import annotations

import glob
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.errors import FormatError, InputError, MissingDataError
from locatk.formats import images
from locatk.formats.sessions.frames import Shot

DEVICE = "camera"
"""Name of the camera; image files and videos do not tell one."""

START_NS = 1_000_000_000
"""Time of the first frame where no clock is known: a second after 1970, for no one to take
it for a date; zero is what some viewers take for no time."""

RATE_HZ = 30.0

_NUMBER = re.compile("([0-9]+)")


class ImageFiles:
    """Frames from image files; iterate to read them, once.

    Parameters
    ----------
    files : sequence of path
        In the order of time; see :func:`find_images`.
    rate_hz : float
        Frames a second.
    camera : Camera, optional
        Frames must have its size.

    Attributes
    ----------
    warnings : list of str
        What was left out and why, one line a file; grows while iterating.
    left_out : int
        How many files that is.
    lost : str or None
        The same in a line, if there are any.
    facts : dict of str to str
        For the session's metadata.
    """

    def __init__(
        self, files: Sequence[Path], *, rate_hz: float = RATE_HZ, camera: Camera | None = None
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
        """Number of files, whether they can be read or not."""
        return len(self._files)

    @property
    def left_out(self) -> int:
        return len(self.warnings)

    @property
    def lost(self) -> str | None:
        if not self.warnings:
            return None
        return f"{self.left_out} of {len(self)} files are left out"

    def __iter__(self) -> Iterator[Shot]:
        """The frames, in the order of time.

        Raises
        ------
        InputError
            None of the files is an image that can be used.
        """
        names = frame_names(self._files)
        # One topic holds one kind of message: beside files that are kept as they are, the
        # others become PNG.
        compressed = any(images.is_compressed(_head(file)) for file in self._files)
        count = 0
        for number, (file, name) in enumerate(zip(self._files, names, strict=True)):
            try:
                data = file.read_bytes()
                picture = images.decode(data)
                check_size(picture.pixels, self._camera)
            except InputError as error:
                self.warnings.append(f"{file}: {error.message}")
                continue
            except OSError as error:
                self.warnings.append(f"{file}: cannot be read ({error.strerror})")
                continue
            count += 1
            time_ns = START_NS + round(number * 1e9 / self._rate_hz)
            if picture.format:
                yield Shot(time_ns, name, data, picture.format)
            elif compressed:
                yield Shot(time_ns, name, images.encode_png(picture.pixels), "png")
            else:
                yield Shot(time_ns, name, picture.pixels)
        if count == 0:
            first = self.warnings[0] if self.warnings else "there are none"
            raise FormatError(
                f"none of {len(self._files)} files can be used: {first}",
                hint="Compare the --camera with the frames" if self._camera is not None else None,
            )


def find_images(paths: Sequence[Path]) -> list[Path]:
    """Image files that ``paths`` name, each once, in natural order.

    Parameters
    ----------
    paths : sequence of path
        Files, which are taken whatever they are called; folders, of which files with an
        image's extension are taken, without sub-folders; or patterns such as
        ``run/*.png``, of which likewise.

    Raises
    ------
    MissingDataError
        A path is not there, or a pattern fits nothing.
    FormatError
        A folder or the files of a pattern hold no image.
    """
    found: dict[Path, Path] = {}
    for path in paths:
        for file in _expanded(path):
            found.setdefault(file.resolve(), file)
    return sorted(found.values(), key=_natural)


def _expanded(path: Path) -> list[Path]:
    if path.is_dir():
        inside = [file for file in path.iterdir() if file.is_file()]
        what = "folder"
    elif path.exists():
        return [path]
    elif glob.has_magic(str(path)):
        inside = [Path(name) for name in glob.glob(str(path), recursive=True)]
        inside = [file for file in inside if file.is_file()]
        what = "pattern"
        if not inside:
            raise MissingDataError(
                "no file fits the pattern", file=path, hint="Check the folder and the extension"
            )
    else:
        raise MissingDataError(
            "No such file or folder", file=path, hint="Check the spelling of the path"
        )
    kept = [file for file in inside if file.suffix.lower() in images.EXTENSIONS]
    if not kept:
        raise FormatError(
            f"no image files ({len(inside)} files of other kinds)",
            file=path,
            hint=f"Give a {what} with {', '.join(sorted(images.EXTENSIONS))}; a pattern such as "
            "'run/**/*.png' searches sub-folders",
        )
    return kept


def frame_names(files: Sequence[Path]) -> list[str]:
    """Names of the frames: those of the files, with folders where they would not differ."""
    names = [file.name for file in files]
    return names if len(set(names)) == len(names) else [file.as_posix() for file in files]


def check_size(pixels: NDArray[Any], camera: Camera | None) -> None:
    """Refuse a frame of another size than the camera's.

    Raises
    ------
    InputError
    """
    if camera is None or pixels.shape[:2] == camera.size[::-1]:
        return
    height, width = pixels.shape[:2]
    raise InputError(
        f"{width} x {height} px, where the camera has {camera.size[0]} x {camera.size[1]} px"
    )


def _natural(path: Path) -> tuple[list[str | int], ...]:
    """Sort key in which numbers count as numbers; unlike ones of equal value differ too."""
    parts = (path.parent.as_posix(), path.name)
    split = [
        [int(piece) if odd % 2 else piece for odd, piece in enumerate(_NUMBER.split(part))]
        for part in parts
    ]
    return (*split, [path.as_posix()])


def _head(file: Path) -> bytes:
    try:
        with open(file, "rb") as stream:
            return stream.read(12)
    except OSError:
        return b""
