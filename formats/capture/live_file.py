"""A file that grows while it is recorded, and can be read at any time up to its last flush.

Unlike :func:`locatk.formats.output.atomic_write` it has its name from the start, as what is
recorded must be there when the program is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import shutil
import sys
from pathlib import Path

from locatk.core.errors import LocatkError, OutputExistsError
from locatk.formats.output import check_output

AHEAD = 4 << 20
"""Bytes of the disk that are taken before they are needed, so that a recording whose disk is
full can still be finished."""

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What the system says of a disk, a quota or a file system's largest file that is full."""

_KEEP_SIZE = 1
"""FALLOC_FL_KEEP_SIZE: the file is not longer for it."""


class DiskFullError(LocatkError, OSError):
    """There is no room for more; what was written is whole."""


class LiveFile:
    """An unbuffered binary file that is only ever appended to.

    Parameters
    ----------
    path : path
        Must not exist, unless ``overwrite``.
    overwrite : bool
        Replace it. The old file is gone from here on.

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        It is there, its folder is not, or the system refuses.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        check_output(path, overwrite=overwrite)
        # As atomic_write: what a link points to is replaced, not the link.
        self.path = Path(os.path.realpath(path) if os.path.islink(path) else path)
        try:
            if overwrite:
                check_idle(self.path)
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(self.path)
            self._file = open(self.path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
            _lock(self._file.fileno())
        except LocatkError:
            raise
        except OSError as error:
            raise LocatkError(f"cannot write: {error.strerror or error}", file=path) from error
        self._size = 0
        self._taken = 0
        self._takes_ahead = sys.platform == "linux"

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Append all of ``data``, or nothing of it.

        Raises
        ------
        DiskFullError
            There is no room.
        OSError
            The disk fails otherwise.
        """
        view = memoryview(data)
        done = 0
        try:
            while done < len(view):
                done += self._file.write(view[done:])
        except BaseException as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
                self._file.seek(self._size)
            if isinstance(error, OSError) and error.errno in FULL:
                raise DiskFullError(_words(error.errno), file=self.path) from error
            raise
        self._size += done
        return done

    def make_room(self, more: int) -> None:
        """Take ``more`` bytes of the disk beyond what is written, and :data:`AHEAD`.

        Where the file system cannot do that, nothing happens.

        Raises
        ------
        DiskFullError
            There is no room; what was taken before is still there to finish the file.
        """
        wanted = self._size + more
        if not self._takes_ahead or wanted + AHEAD // 2 <= self._taken:
            return
        number = _fallocate(self._file.fileno(), self._size, more + AHEAD)
        if number in FULL:
            raise DiskFullError(_words(number), file=self.path)
        if number == 0:
            self._taken = wanted + AHEAD
        elif number != errno.EINTR:
            self._takes_ahead = False

    def free(self) -> int | None:
        """Bytes that are free on the disk, None where the system does not tell."""
        try:
            found = os.fstatvfs(self._file.fileno())
        except (AttributeError, OSError, ValueError):
            try:
                return shutil.disk_usage(self.path.parent).free
            except OSError:
                return None
        return found.f_bavail * found.f_frsize

    def is_there(self) -> bool:
        """Whether the file has a name: somebody may have removed or replaced it."""
        try:
            return os.fstat(self._file.fileno()).st_nlink > 0
        except (OSError, ValueError):
            return False

    def tell(self) -> int:
        """Bytes written."""
        return self._size

    def flush(self) -> None:
        """Nothing: what is written is with the system."""

    def sync(self) -> None:
        """Force what is written to the disk; slow, to be called from a thread of its own."""
        if not self._file.closed:
            with contextlib.suppress(OSError, ValueError):  # closed meanwhile; no such thing
                getattr(os, "fdatasync", os.fsync)(self._file.fileno())

    def close(self) -> None:
        """Give back what was taken ahead, force the rest to the disk and close."""
        if self._file.closed:
            return
        with contextlib.suppress(OSError):
            self._file.truncate(self._size)
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())
        self._file.close()


def check_idle(path: Path) -> None:
    """Refuse a file that another capture is writing.

    Raises
    ------
    OutputExistsError
    """
    try:
        with open(path, "rb") as stream:
            busy = not _lock(stream.fileno())
    except FileNotFoundError:
        return
    if busy:
        raise OutputExistsError(
            f"output {str(path)!r} is being recorded by another program",
            hint="End that one, or choose another name",
        )


def _lock(descriptor: int) -> bool:
    """Take the lock of a file until it is closed; False where somebody else has it."""
    try:
        import fcntl
    except ImportError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return True  # a file system without locks
    return True


def _words(number: int | None) -> str:
    return "the file is as large as it can be" if number == errno.EFBIG else "no space left"


def _fallocate(descriptor: int, offset: int, length: int) -> int:
    """Take room on the disk without a change of the file's size; returns an errno or 0.

    fallocate(2) with FALLOC_FL_KEEP_SIZE, which Python's ``os.posix_fallocate`` cannot do.
    """
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        call = libc.fallocate64 if hasattr(libc, "fallocate64") else libc.fallocate
    except (OSError, AttributeError):
        return errno.ENOSYS
    call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    call.restype = ctypes.c_int
    return ctypes.get_errno() if call(descriptor, _KEEP_SIZE, offset, length) else 0
