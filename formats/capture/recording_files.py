"""Files of a recording: one, or several in sequence, each a complete session.

A file can be read up to its last flush while it grows. Unlike the output of
:func:`locatk.formats.output.atomic_write` it has its final name from the start, because a
recording must be there when the program is killed.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import math
import os
import re
import shutil
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message

from locatk.core.errors import LocatkError, OutputExistsError
from locatk.formats.capture.ingestion import StampedMessage
from locatk.formats.locks import lock_file
from locatk.formats.output import check_output
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD, SESSION_RECORD
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.writer import SessionWriter

CHUNK_BYTES = 1 << 19
"""Bytes after which a chunk is written, if not before: half of the limit at which the MCAP writer
writes one itself."""

LOG_NAME = "locatk capture"
"""Sender of the recorder's messages on ``/log``."""

INDEX_BYTES_PER_CHUNK = 512
"""Upper limit of the index at the end of a file, per chunk."""


@dataclass(frozen=True)
class FileContent:
    """Initial content of each file.

    Attributes
    ----------
    facts : mapping of str to str
        Entries of the metadata record ``capture`` that are known at the start.
    artifacts : mapping of str to str
        Attachments: name to text.
    declared : sequence of (str, type)
        Topics that are certain to occur.
    """

    facts: Mapping[str, str] = field(default_factory=dict)
    artifacts: Mapping[str, str] = field(default_factory=dict)
    declared: Sequence[tuple[str, type[Message]]] = ()


def part_path(path: Path, number: int) -> Path:
    """Return the path of a part, numbered from 1: ``run.mcap`` becomes ``run-001.mcap``."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


class RecordingFiles:
    """Writes a recording; :meth:`next_part` continues in a new file.

    Parameters
    ----------
    path : path
        The file; if ``numbered``, the name from which those of the parts are derived.
    content : FileContent
    numbered : bool
        There may be several parts.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        See :class:`LiveFile`.
    """

    def __init__(
        self, path: Path, content: FileContent, *, numbered: bool = False, overwrite: bool = False
    ) -> None:
        self._path, self._content = path, content
        self._numbered, self._overwrite = numbered, overwrite
        self._artifacts = dict(content.artifacts)
        self._system = ""
        self._finished_bytes = 0
        self._chunks = 0
        self._pending = 0
        self._last_ns = 0
        self.paths: list[Path] = []
        self._is_open = False
        # Parts of an older, longer recording would look like parts of this one.
        if numbered and overwrite:
            old_parts = parts_of(path)
            for old in old_parts:
                check_idle(old)
            for old in old_parts:
                old.unlink(missing_ok=True)
        self._open()

    def _open(self) -> None:
        number = len(self.paths) + 1
        path = part_path(self._path, number) if self._numbered else self._path
        self.file = LiveFile(path, overwrite=self._overwrite)
        self._is_open = True
        self.paths.append(path)
        self._chunks = 0
        self._writer = SessionWriter(path, system=self._system, live=self.file)  # type: ignore[arg-type]
        self._writer.__enter__()
        facts = dict(self._content.facts)
        if self._numbered:
            facts["part"] = str(number)
        if number > 1:
            facts["started_ns"] = str(self._last_ns)
        self._writer.metadata(CAPTURE_RECORD, facts)
        for name, text in self._artifacts.items():
            self._writer.attach_toml(name, text)
        for topic, message_class in self._content.declared:
            self._writer.declare(topic, message_class)
        self._writer.declare("/log", Log)

    @property
    def artifacts(self) -> Mapping[str, str]:
        """Attachments, name to text."""
        return self._artifacts

    @property
    def bytes_written(self) -> int:
        """Size of all parts."""
        return self._finished_bytes + self.part_bytes

    @property
    def part_bytes(self) -> int:
        """Size of this part."""
        return self.file.tell() if self._is_open else 0

    def is_gone(self) -> bool:
        """Return whether the open file was removed."""
        return self._is_open and not self.file.is_there()

    def system(self, name: str) -> None:
        """Set the system of the session, once it is known."""
        if name and name != self._system:
            self._system = name
            self._writer.metadata(SESSION_RECORD, {"system": name})

    def attach(self, artifacts: Mapping[str, str]) -> None:
        """Attach new artifacts to this part and all that follow."""
        for name, text in artifacts.items():
            if name not in self._artifacts:
                self._artifacts[name] = text
                self._writer.attach_toml(name, text)

    def write(self, stamped: Iterable[StampedMessage]) -> None:
        """Write messages in the given order."""
        for each in stamped:
            self._writer.write(each.topic, each.message, each.time_ns, each.publish_ns)
            self._last_ns = max(self._last_ns, each.time_ns)
            self._pending += each.message.ByteSize()
            # Flush before the MCAP writer does, which allocates no space.
            if self._pending >= CHUNK_BYTES:
                self.flush()

    def log(self, text: str, time_ns: int, *, level: int = Log.WARNING) -> None:
        """Write a log message, not before the time of the last message."""
        time_ns = max(time_ns, self._last_ns)
        line = Log(timestamp=timestamp(time_ns), level=level, message=text, name=LOG_NAME)  # type: ignore[arg-type]
        self._writer.write("/log", line, time_ns)
        self._last_ns = time_ns
        self._pending += line.ByteSize()

    def flush(self) -> None:
        """Write all buffered data to the system, so that they survive if the program is killed.

        Raises
        ------
        DiskFullError
            The disk has no space for them; the file can still be finished.
        """
        self._chunks += self._pending > 0
        self._pending = 0
        self.file.make_room(4 * CHUNK_BYTES + INDEX_BYTES_PER_CHUNK * self._chunks)
        self._writer.flush()

    def next_part(self, facts: Mapping[str, str]) -> None:
        """Finish this file with ``facts`` and continue in the next one."""
        self.finish(facts)
        self._open()

    def finish(self, facts: Mapping[str, str]) -> None:
        """Write the end of the file; ``facts`` are added to the record ``capture``.

        A second call has no effect.
        """
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._writer.metadata(CAPTURE_RECORD, facts)
            self._writer.__exit__(None, None, None)
        finally:
            self._finished_bytes += self.file.tell()
            self.file.close()


def parts_of(path: Path) -> list[Path]:
    """Return the existing parts of ``path``."""
    name = re.compile(re.escape(path.stem) + r"-\d{3,}" + re.escape(path.suffix))
    if not path.parent.is_dir():
        return []
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


def check_outputs(
    path: Path, *, numbered: bool, overwrite: bool, inputs: Sequence[Path] = ()
) -> None:
    """Refuse outputs that exist, or are among ``inputs``, before a port is opened.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.check_output`.
    """
    outputs = [part_path(path, 1), *parts_of(path)] if numbered else [path]
    for each in outputs:
        if each.exists() and any(each.samefile(other) for other in inputs if other.exists()):
            raise OutputExistsError(
                "the output is one of the inputs", file=each, hint="Choose another -o"
            )
        check_output(each, overwrite=overwrite)


RESERVED_BYTES = 4 << 20
"""Space of the disk that is allocated in advance if it has that much, so that the system is asked
rarely."""

MIN_RESERVED_BYTES = 2 * CHUNK_BYTES
"""Smallest space that is allocated in advance: half of it covers one chunk more."""

FULL_DISK_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Errors of the system if the disk, a quota, or the largest file of a file system is full."""

_KEEP_SIZE = 1
"""FALLOC_FL_KEEP_SIZE: the size of the file does not change."""


class DiskFullError(LocatkError, OSError):
    """The disk is full; the data written before are complete."""


class LiveFile:
    """Unbuffered binary file that is only appended to.

    Parameters
    ----------
    path : path
        Must not exist, unless ``overwrite``.
    overwrite : bool
        Replace it. The old file is removed at once.

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        It exists, its folder does not exist, or the system refuses.
    """

    def __init__(self, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
        check_output(path, overwrite=overwrite)
        # As in atomic_write, the target of a link is replaced, not the link.
        self.path = Path(os.path.realpath(path) if os.path.islink(path) else path)
        try:
            if overwrite:
                check_idle(self.path)
                with contextlib.suppress(FileNotFoundError):
                    os.unlink(self.path)
            self._file = open(self.path, "xb", buffering=0)  # noqa: SIM115 - closed by close()
            lock_file(self._file.fileno())
        except LocatkError:
            raise
        except OSError as error:
            raise LocatkError(f"cannot write: {error.strerror or error}", file=path) from error
        self._size = 0
        self._allocated_end = 0
        self._reserved = RESERVED_BYTES
        self._can_allocate = sys.platform == "linux"
        self._largest_size = _size_limit()

    def write(self, data: bytes | bytearray | memoryview) -> int:
        """Append all of ``data``, or nothing of it.

        Raises
        ------
        DiskFullError
            The disk is full.
        OSError
            Any other error of the disk.
        """
        view = memoryview(data)
        done = 0
        try:
            while done < len(view):
                done += self._file.write(view[done:])
        except BaseException as error:
            with contextlib.suppress(OSError):
                self._file.truncate(self._size)
                self._allocated_end = self._size
                self._file.seek(self._size)
            if isinstance(error, OSError) and error.errno in FULL_DISK_ERRNOS:
                raise DiskFullError(_describe_errno(error.errno), file=self.path) from error
            raise
        self._size += done
        return done

    def make_room(self, more: int) -> None:
        """Allocate ``more`` bytes beyond the present end, so that they can certainly be written.

        Up to :data:`RESERVED_BYTES` are allocated in addition, as many as the disk has. On file
        systems without allocation this has no effect, except that the limit of the process for the
        size of a file is respected.

        Raises
        ------
        DiskFullError
            The disk is full; space allocated before remains available to finish the file.
        """
        wanted = self._size + more
        # The system allocates space beyond this limit, and refuses to write there.
        if wanted > self._largest_size:
            raise DiskFullError(_describe_errno(errno.EFBIG), file=self.path)
        # tmpfs releases all unwritten space of a range whose allocation fails: begin behind it.
        start = max(self._size, self._allocated_end)
        while self._can_allocate and wanted + self._reserved // 2 > self._allocated_end:
            end = wanted + self._reserved
            number = _fallocate(self._file.fileno(), start, end - start)
            if number == 0:
                self._allocated_end = end
            elif number in FULL_DISK_ERRNOS and self._reserved > MIN_RESERVED_BYTES:
                self._reserved //= 2
            elif number in FULL_DISK_ERRNOS:
                raise DiskFullError(_describe_errno(number), file=self.path)
            elif number == errno.EINTR:
                return
            else:
                self._can_allocate = False

    def free(self) -> int | None:
        """Return the free bytes of the disk; None if they are unknown."""
        try:
            status = os.fstatvfs(self._file.fileno())
        except (AttributeError, OSError, ValueError):
            try:
                return shutil.disk_usage(self.path.parent).free
            except OSError:
                return None
        return status.f_bavail * status.f_frsize

    def is_there(self) -> bool:
        """Return whether the file has a name; it may have been removed or replaced."""
        try:
            return os.fstat(self._file.fileno()).st_nlink > 0
        except (OSError, ValueError):
            return False

    def tell(self) -> int:
        """Return the number of bytes written."""
        return self._size

    def flush(self) -> None:
        """Do nothing, because the file is unbuffered."""

    def sync(self) -> None:
        """Force the data to the disk; slow, therefore called from a separate thread."""
        if not self._file.closed:
            with contextlib.suppress(OSError, ValueError):  # Closed meanwhile, or not supported.
                getattr(os, "fdatasync", os.fsync)(self._file.fileno())

    def close(self) -> None:
        """Release the allocated space, force the data to the disk and close."""
        if self._file.closed:
            return
        with contextlib.suppress(OSError):
            self._file.truncate(self._size)
        with contextlib.suppress(OSError):
            os.fsync(self._file.fileno())
        self._file.close()


def _size_limit() -> float:
    """Return the largest size of a file that this process may write (``ulimit -f``)."""
    try:
        import resource
    except ImportError:
        return math.inf
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    return math.inf if limit == resource.RLIM_INFINITY else float(limit)


def check_idle(path: Path) -> None:
    """Refuse a file that another capture is writing.

    Raises
    ------
    OutputExistsError
    """
    try:
        with open(path, "rb") as stream:
            busy = lock_file(stream.fileno()) is False
    except FileNotFoundError:
        return
    if busy:
        raise OutputExistsError(
            "being recorded by another program",
            file=path,
            hint="End that program, or choose another name",
        )


def _describe_errno(number: int | None) -> str:
    return "the file has the largest size possible" if number == errno.EFBIG else "no space left"


def _fallocate(descriptor: int, offset: int, length: int) -> int:
    """Allocate space on the disk without changing the file's size; return an errno or 0.

    fallocate(2) with FALLOC_FL_KEEP_SIZE, which Python's ``os.posix_fallocate`` does not support.
    """
    try:
        libc = ctypes.CDLL(None, use_errno=True)
        call = libc.fallocate64 if hasattr(libc, "fallocate64") else libc.fallocate
    except (OSError, AttributeError):
        return errno.ENOSYS
    call.argtypes = [ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64]
    call.restype = ctypes.c_int
    return ctypes.get_errno() if call(descriptor, _KEEP_SIZE, offset, length) else 0
