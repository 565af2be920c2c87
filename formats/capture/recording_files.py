"""The files of a recording: one, or one after the other, each whole in itself."""

from __future__ import annotations

import contextlib
import ctypes
import errno
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
from locatk.formats.capture.statistics import RECORD
from locatk.formats.output import check_output
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import RECORD as SESSION
from locatk.formats.sessions.writer import SessionWriter

CHUNK_BYTES = 1 << 19
"""A chunk is written when it has so many bytes, if not before. Half of what the MCAP writer
takes before it writes one unasked."""

LOG_NAME = "locatk capture"
"""Who says what the recorder writes to ``/log``."""

INDEX_BYTES_PER_CHUNK = 512
"""Bytes of the index at the end of a file by chunk, at most."""


@dataclass(frozen=True)
class FileContent:
    """What every part begins with.

    Attributes
    ----------
    facts : mapping of str to str
        Entries of the metadata record ``capture`` that are known at the start.
    artifacts : mapping of str to str
        Attachments: name to text.
    declared : sequence of (str, type)
        Topics that are sure to come.
    """

    facts: Mapping[str, str] = field(default_factory=dict)
    artifacts: Mapping[str, str] = field(default_factory=dict)
    declared: Sequence[tuple[str, type[Message]]] = ()


def part_path(path: Path, number: int) -> Path:
    """Path of a part, numbered from 1: ``run.mcap`` becomes ``run-001.mcap``."""
    return path.with_name(f"{path.stem}-{number:03d}{path.suffix}")


class RecordingFiles:
    """Writes a recording; :meth:`next_part` goes on in a new file.

    Parameters
    ----------
    path : path
        The file, or where ``numbered`` the name from which those of the parts are made.
    content : FileContent
    numbered : bool
        There may be several parts.
    overwrite : bool
        Replace existing files.

    Raises
    ------
    OutputExistsError, MissingDataError, LocatkError
        See :class:`.live_file.LiveFile`.
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
        if numbered and overwrite:  # what stays of an older recording would look like ours
            olds = parts_of(path)
            for old in olds:
                check_idle(old)
            for old in olds:
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
        self._writer.metadata(RECORD, facts)
        for name, text in self._artifacts.items():
            self._writer.attach_toml(name, text)
        for topic, message_class in self._content.declared:
            self._writer.declare(topic, message_class)
        self._writer.declare("/log", Log)

    @property
    def artifacts(self) -> Mapping[str, str]:
        """What is attached, name to text."""
        return self._artifacts

    @property
    def bytes_written(self) -> int:
        """By all parts together."""
        return self._finished_bytes + self.part_bytes

    @property
    def part_bytes(self) -> int:
        """By this part."""
        return self.file.tell() if self._is_open else 0

    def is_gone(self) -> bool:
        """Whether somebody has removed the file that is being written."""
        return self._is_open and not self.file.is_there()

    def system(self, name: str) -> None:
        """Say whose session it is, once that is known."""
        if name and name != self._system:
            self._system = name
            self._writer.metadata(SESSION, {"system": name})

    def attach(self, artifacts: Mapping[str, str]) -> None:
        """Attach what is not yet there, to this part and all that follow."""
        for name, text in artifacts.items():
            if name not in self._artifacts:
                self._artifacts[name] = text
                self._writer.attach_toml(name, text)

    def write(self, stamped: Iterable[StampedMessage]) -> None:
        """Write messages, in the order in which they come."""
        for each in stamped:
            self._writer.write(each.topic, each.message, each.time_ns, each.publish_ns)
            self._last_ns = max(self._last_ns, each.time_ns)
            self._pending += each.message.ByteSize()
            if self._pending >= CHUNK_BYTES:  # before the writer does, who makes no room
                self.flush()

    def log(self, text: str, time_ns: int, *, level: int = Log.WARNING) -> None:
        """A line for the log panel, not before what was written last."""
        time_ns = max(time_ns, self._last_ns)
        line = Log(timestamp=timestamp(time_ns), level=level, message=text, name=LOG_NAME)  # type: ignore[arg-type]
        self._writer.write("/log", line, time_ns)
        self._last_ns = time_ns
        self._pending += line.ByteSize()

    def flush(self) -> None:
        """Give all that is buffered to the system: what is killed from here on keeps it.

        Raises
        ------
        DiskFullError
            There is no room for it; the file can still be finished.
        """
        self._chunks += self._pending > 0
        self._pending = 0
        self.file.make_room(4 * CHUNK_BYTES + INDEX_BYTES_PER_CHUNK * self._chunks)
        self._writer.flush()

    def next_part(self, facts: Mapping[str, str]) -> None:
        """Finish this file with ``facts`` and go on in the next one."""
        self.finish(facts)
        self._open()

    def finish(self, facts: Mapping[str, str]) -> None:
        """Write the end of the file; ``facts`` are added to the record ``capture``. Nothing
        where that is done."""
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._writer.metadata(RECORD, facts)
            self._writer.__exit__(None, None, None)
        finally:
            self._finished_bytes += self.file.tell()
            self.file.close()


def parts_of(path: Path) -> list[Path]:
    """The parts of ``path`` that are there."""
    name = re.compile(re.escape(path.stem) + r"-\d{3,}" + re.escape(path.suffix))
    if not path.parent.is_dir():
        return []
    return sorted(each for each in path.parent.iterdir() if name.fullmatch(each.name))


def check_outputs(
    path: Path, *, numbered: bool, overwrite: bool, inputs: Sequence[Path] = ()
) -> None:
    """Refuse outputs that are there, or are among ``inputs``, before a port is opened.

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
"""Bytes of the disk that are taken before they are needed, so that a recording whose disk is
full can still be finished."""

FULL_DISK_ERRNOS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
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
            if isinstance(error, OSError) and error.errno in FULL_DISK_ERRNOS:
                raise DiskFullError(_words(error.errno), file=self.path) from error
            raise
        self._size += done
        return done

    def make_room(self, more: int) -> None:
        """Take ``more`` bytes of the disk beyond what is written, and :data:`RESERVED_BYTES`.

        Where the file system cannot do that, nothing happens.

        Raises
        ------
        DiskFullError
            There is no room; what was taken before is still there to finish the file.
        """
        wanted = self._size + more
        if not self._takes_ahead or wanted + RESERVED_BYTES // 2 <= self._taken:
            return
        number = _fallocate(self._file.fileno(), self._size, more + RESERVED_BYTES)
        if number in FULL_DISK_ERRNOS:
            raise DiskFullError(_words(number), file=self.path)
        if number == 0:
            self._taken = wanted + RESERVED_BYTES
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
