"""A file that grows while it is recorded: whole writes, and room to be finished."""

from __future__ import annotations

import errno
import os
import sys
import threading
from pathlib import Path
from typing import IO, Any

import pytest

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats.capture import recording_files as live_file
from locatk.formats.capture.recording_files import (
    MIN_RESERVED_BYTES,
    RESERVED_BYTES,
    DiskFullError,
    FileContent,
    LiveFile,
    RecordingFiles,
)
from locatk.formats.sessions.reader import Session


class Disk:
    """Stands for the file: takes so many bytes at once, and so many in all."""

    def __init__(self, real: Any, room: int, at_once: int = 1 << 30) -> None:
        self._real, self.room, self._at_once = real, room, at_once
        self.error = errno.ENOSPC

    def write(self, data: memoryview) -> int:
        some = min(len(data), self.room, self._at_once)
        if not some:
            raise OSError(self.error, os.strerror(self.error))
        self.room -= some
        written: int = self._real.write(data[:some])
        return written

    def __getattr__(self, name: str) -> Any:
        return getattr(self._real, name)


def on(file: LiveFile, room: int, at_once: int = 1 << 30) -> Disk:
    disk = Disk(file._file, room, at_once)
    file._file = disk  # type: ignore[assignment]
    return disk


def test_what_is_written_can_be_read_at_once(tmp_path: Path) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    assert file.write(b"one") == 3
    assert (tmp_path / "run.mcap").read_bytes() == b"one"
    assert file.write(memoryview(b"two")) == 3
    assert file.tell() == 6
    file.flush()
    file.close()
    file.close()
    assert file.tell() == 6
    assert (tmp_path / "run.mcap").read_bytes() == b"onetwo"


def test_a_file_that_is_there_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"old")
    with pytest.raises(OutputExistsError):
        LiveFile(path)
    assert path.read_bytes() == b"old"
    LiveFile(path, overwrite=True).close()
    assert path.read_bytes() == b""


@pytest.mark.skipif(sys.platform == "win32", reason="no flock")
def test_a_file_that_is_being_written_is_not_replaced(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    file = LiveFile(path)
    file.write(b"one")
    with pytest.raises(OutputExistsError, match="being recorded"):
        LiveFile(path, overwrite=True)
    file.write(b", two")
    file.close()
    assert path.read_bytes() == b"one, two"
    LiveFile(path, overwrite=True).close()
    assert path.read_bytes() == b""


def test_a_file_that_was_removed_is_not_there(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    file = LiveFile(path)
    assert file.is_there()
    path.rename(tmp_path / "elsewhere.mcap")
    assert file.is_there()
    (tmp_path / "elsewhere.mcap").unlink()
    assert not file.is_there()
    file.close()
    assert not file.is_there()


def test_places_that_are_no_files(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        LiveFile(tmp_path / "no" / "run.mcap")
    for overwrite in (False, True):
        with pytest.raises(OutputExistsError):
            LiveFile(tmp_path, overwrite=overwrite)


def test_missing_write_permission_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("builtins.open", refuse)
    with pytest.raises(LocatkError, match=r"run\.mcap: cannot write: Permission denied"):
        LiveFile(tmp_path / "run.mcap")


def test_short_writes_are_gone_on_with(tmp_path: Path) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    on(file, room=1000, at_once=7)
    assert file.write(bytes(range(100))) == 100
    file.close()
    assert (tmp_path / "run.mcap").read_bytes() == bytes(range(100))


def test_a_write_is_whole_or_nothing(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    file = LiveFile(path)
    disk = on(file, room=10, at_once=4)
    file.write(b"whole")
    with pytest.raises(DiskFullError, match=r"run\.mcap: no space left"):
        file.write(b"too much of it")
    assert file.tell() == 5
    assert path.read_bytes() == b"whole"
    disk.room = 100
    file.write(b", and on")
    file.close()
    assert path.read_bytes() == b"whole, and on"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT, errno.EFBIG])
def test_all_errors_of_a_full_disk(tmp_path: Path, number: int) -> None:
    """EFBIG: 4 GB on a FAT32 stick, or ``ulimit -f``."""
    file = LiveFile(tmp_path / "run.mcap")
    on(file, room=0).error = number
    with pytest.raises(DiskFullError):
        file.write(b"x")
    file.close()


def test_a_disk_that_fails_otherwise_is_not_full(tmp_path: Path) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    on(file, room=0).error = errno.EIO
    with pytest.raises(OSError, match=os.strerror(errno.EIO)) as caught:
        file.write(b"x")
    assert not isinstance(caught.value, DiskFullError)
    file.close()


@pytest.mark.parametrize("kind", [KeyboardInterrupt, SystemExit])
def test_an_interrupt_leaves_no_half_write(tmp_path: Path, kind: type[BaseException]) -> None:
    """The second Ctrl-C may come between the system's write and its answer."""
    path = tmp_path / "run.mcap"
    file = LiveFile(path)
    file.write(b"whole")

    class Interrupted:
        def __init__(self, real: Any) -> None:
            self._real = real

        def write(self, data: memoryview) -> int:
            self._real.write(data[:7])
            raise kind

        def __getattr__(self, name: str) -> Any:
            return getattr(self._real, name)

    real = file._file
    file._file = Interrupted(real)  # type: ignore[assignment]
    with pytest.raises(kind):
        file.write(b"half of it")
    file._file = real
    assert file.tell() == 5
    file.write(b", and on")
    file.close()
    assert path.read_bytes() == b"whole, and on"


# ---- room ahead


class Taken:
    """Stands for fallocate: notes what was asked for."""

    def __init__(self, *answers: int) -> None:
        self.answers = list(answers)
        self.ends: list[int] = []

    def __call__(self, descriptor: int, offset: int, length: int) -> int:
        self.ends.append(offset + length)
        return self.answers.pop(0) if self.answers else 0


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> Taken:
    taken = Taken()
    monkeypatch.setattr(live_file, "_fallocate", taken)
    monkeypatch.setattr(sys, "platform", "linux")
    return taken


def test_the_requested_space_is_reserved(tmp_path: Path, taken: Taken) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    for _ in range(50):
        file.make_room(300_000)
        assert taken.ends[-1] >= file.tell() + 300_000
        file.write(bytes(200_000))
    assert len(taken.ends) < 50  # not for each
    file.close()


def test_a_nearly_full_disk_is_reported_in_time(tmp_path: Path, taken: Taken) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    file.make_room(1000)
    had = taken.ends[-1]
    taken.answers = [errno.ENOSPC] * 100
    with pytest.raises(DiskFullError):
        fill(file, 1000)
    assert had - file.tell() >= 1000
    file.close()


def test_a_small_disk_gives_what_it_has(tmp_path: Path, taken: Taken) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    taken.answers = [errno.ENOSPC, 0]
    file.make_room(2_000_000)
    assert taken.ends == [2_000_000 + RESERVED_BYTES, 2_000_000 + RESERVED_BYTES // 2]
    taken.answers = [errno.ENOSPC, 0]
    file.write(bytes(2_000_000))
    file.make_room(2_000_000)
    assert taken.ends[-1] == file.tell() + 2_000_000 + MIN_RESERVED_BYTES
    file.write(bytes(1_500_000))
    taken.answers = [errno.ENOSPC]
    with pytest.raises(DiskFullError):
        file.make_room(2_000_000)
    file.close()


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_FSIZE of Linux")
def test_a_disk_of_six_megabytes_is_used(tmp_path: Path) -> None:
    """A limit of the file size, which needs no rights, is like a full disk."""
    import resource

    path = tmp_path / "run.mcap"
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6 << 20, old[1]))
    try:
        made = RecordingFiles(path, FileContent())
        with pytest.raises(DiskFullError):
            log_for_ever(made)
        made.finish({"ended": "full"})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    session = Session.open(path)
    assert session.metadata()["capture"]["ended"] == "full"
    assert 3 << 20 < path.stat().st_size <= 6 << 20


@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_FSIZE of Linux")
def test_no_room_is_promised_beyond_the_limit_of_the_file_size(tmp_path: Path) -> None:
    """Linux allocates space beyond the limit, where it then refuses to write."""
    import resource

    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, old[1]))
    try:
        file = LiveFile(tmp_path / "run.mcap")
        file.make_room(1 << 20)
        with pytest.raises(DiskFullError):
            file.make_room((1 << 20) + 1)
        file.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


def log_for_ever(made: RecordingFiles) -> None:
    while True:
        made.log(os.urandom(50_000).hex(), 1)
        made.flush()


def fill(file: LiveFile, promised: int) -> None:
    """Write for ever."""
    while True:
        file.make_room(promised)
        file.write(os.urandom(100_000))


def exhaust(stream: IO[bytes]) -> None:
    """Write for ever."""
    while True:
        stream.write(bytes(1 << 16))


@pytest.mark.parametrize("number", [errno.EOPNOTSUPP, errno.ENOSYS])
def test_an_impossible_reservation_is_not_repeated(
    tmp_path: Path, taken: Taken, number: int
) -> None:
    taken.answers = [number]
    file = LiveFile(tmp_path / "run.mcap")
    for _ in range(3):
        file.make_room(10 * RESERVED_BYTES)
        file.write(b"x")
    assert len(taken.ends) == 1
    file.close()


def test_a_signal_does_not_interrupt_the_reservation(tmp_path: Path, taken: Taken) -> None:
    taken.answers = [errno.EINTR]
    file = LiveFile(tmp_path / "run.mcap")
    file.make_room(1000)
    file.make_room(1000)
    assert len(taken.ends) > 1
    file.close()


@pytest.mark.skipif(sys.platform != "linux", reason="fallocate(2) is of Linux")
def test_space_is_reserved_beyond_the_end_and_released(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    file = LiveFile(path)
    file.write(b"x")
    number = live_file._fallocate(file._file.fileno(), 1, 1 << 20)
    if number:
        pytest.skip(f"this file system takes no room ahead ({os.strerror(number)})")
    file.make_room(1000)
    assert path.stat().st_size == 1
    assert path.stat().st_blocks * 512 >= RESERVED_BYTES
    file.close()
    assert path.stat().st_size == 1
    assert path.stat().st_blocks * 512 < RESERVED_BYTES


def test_on_a_disk_that_fills_what_was_promised_can_be_written(small_disk: Path) -> None:
    path = small_disk / "run.mcap"
    file = LiveFile(path)
    other = small_disk / "other"
    promised = 600_000
    try:
        file.make_room(promised)
        with (  # somebody else takes all the rest
            open(other, "wb", buffering=0) as stream,
            pytest.raises(OSError, match=os.strerror(errno.ENOSPC)),
        ):
            exhaust(stream)
        with pytest.raises(DiskFullError):
            fill(file, promised)
        size = file.tell()
        end = os.urandom(promised)
        file.write(end)
    finally:
        file.close()
    assert path.stat().st_size == size + promised
    assert path.read_bytes()[size:] == end


# ---- forcing to the disk


def test_forcing_never_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = LiveFile(tmp_path / "run.mcap")
    asked: list[int] = []

    def fail(number: int) -> None:
        asked.append(number)
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fdatasync", fail, raising=False)
    file.sync()
    assert len(asked) == 1
    file.close()
    file.sync()
    assert len(asked) == 1


def test_forcing_and_closing_at_once(tmp_path: Path) -> None:
    """The thread that forces may come late: no error, and no other file is touched."""
    for number in range(50):
        file = LiveFile(tmp_path / f"{number}.mcap")
        file.write(b"x")
        thread = threading.Thread(target=file.sync)
        thread.start()
        file.close()
        thread.join()
        assert (tmp_path / f"{number}.mcap").read_bytes() == b"x"


def test_a_link_is_followed(tmp_path: Path) -> None:
    target, link = tmp_path / "disk.mcap", tmp_path / "run.mcap"
    target.write_bytes(b"old")
    link.symlink_to(target)
    file = LiveFile(link, overwrite=True)
    file.write(b"new")
    file.close()
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
