"""A pseudo-terminal at a path: readers come and go, and nothing of others is touched."""

from __future__ import annotations

import os
import sys
import termios
import time
import tty
from collections.abc import Iterator
from fcntl import ioctl
from pathlib import Path

import pytest

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats.emulation.pseudo_terminal import PseudoPort, PseudoTerminal

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="pseudo-terminals of Linux")

TIOCGEXCL = 0x8004_5440


def opened(path: str) -> int:
    return os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)


@pytest.fixture
def terminal() -> Iterator[PseudoTerminal]:
    made = PseudoTerminal()
    yield made
    made.close()


def test_a_reader_is_seen(terminal: PseudoTerminal) -> None:
    for _ in range(3):
        assert not terminal.has_reader()
        reader, other = opened(terminal.name), opened(terminal.name)
        assert terminal.has_reader()
        assert terminal.has_reader()
        os.close(reader)
        assert terminal.has_reader()
        os.close(other)
        assert not terminal.has_reader()


def test_bytes_pass_as_they_are(terminal: PseudoTerminal) -> None:
    reader = opened(terminal.name)
    data = bytes(range(256)) * 4
    assert terminal.write(data) == len(data)
    assert terminal.has_unread()
    assert os.read(reader, 2000) == data
    assert not terminal.has_unread()
    os.close(reader)


def test_what_was_not_read_is_counted_to_the_byte(terminal: PseudoTerminal) -> None:
    reader = opened(terminal.name)
    sent = 0
    while more := terminal.write(bytes(4096)):
        sent += more
    assert sent > 4096
    read = len(os.read(reader, 100))
    assert terminal.reset() == sent - read
    assert not terminal.has_unread()
    with pytest.raises(BlockingIOError):
        os.read(reader, 1)
    os.close(reader)
    assert terminal.write(b"late") == 4
    assert terminal.reset() == 4


def test_room_is_waited_for(terminal: PseudoTerminal) -> None:
    reader = opened(terminal.name)
    while terminal.write(bytes(4096)):
        time.sleep(0.01)  # some of it is on its way to the reader's side
    terminal.wait_room(0.01)
    assert terminal.write(b"x") == 0
    while True:
        try:
            os.read(reader, 4096)
        except BlockingIOError:
            break
    terminal.wait_room(5)
    assert terminal.write(b"x") == 1
    os.close(reader)


def test_settings_of_a_reader_go_with_it(terminal: PseudoTerminal) -> None:
    """Else the next one would meet lines, echo, or a port that is closed to it."""
    reader = opened(terminal.name)
    usual = termios.tcgetattr(reader)
    changed = termios.tcgetattr(reader)
    changed[tty.LFLAG] |= termios.ICANON | termios.ECHO
    termios.tcsetattr(reader, termios.TCSANOW, changed)
    terminal.write(b"no end of line")
    ioctl(reader, termios.TIOCEXCL)
    assert terminal.has_reader()
    assert ioctl(reader, TIOCGEXCL, bytes(4)) != bytes(4), "locked while it is there"
    os.close(reader)
    assert not terminal.has_reader()
    assert terminal.reset() == 14
    reader = opened(terminal.name)
    assert ioctl(reader, TIOCGEXCL, bytes(4)) == bytes(4)
    assert termios.tcgetattr(reader) == usual
    os.close(reader)


def test_what_a_reader_writes_is_passed_over(terminal: PseudoTerminal) -> None:
    reader = opened(terminal.name)
    for _ in range(50):  # a terminal holds less
        assert os.write(reader, bytes(2000)) == 2000
        assert terminal.has_reader()
    with pytest.raises(BlockingIOError):
        os.read(reader, 1)
    os.close(reader)


def test_a_port_comes_and_goes(tmp_path: Path) -> None:
    link = tmp_path / "port"
    port = PseudoPort(link)
    assert port.path == str(link)
    reader = opened(port.path)
    assert port.terminal is not None
    port.terminal.write(b"abc")
    assert port.unplug() == 3
    assert not os.path.lexists(link)
    assert port.terminal is None
    assert port.unplug() == 0
    assert os.read(reader, 10) == b"", "hung up"
    port.plug()
    assert os.readlink(link) == port.terminal.name
    again = opened(port.path)
    assert not os.path.sameopenfile(reader, again)
    os.close(reader)
    os.close(again)
    port.close()
    assert list(tmp_path.iterdir()) == []


def test_the_usual_path_is_private_and_vanishes() -> None:
    port, other = PseudoPort(), PseudoPort()
    folder = Path(port.path).parent
    assert port.path != other.path
    assert folder.stat().st_mode & 0o077 == 0
    port.close()
    port.close()
    other.close()
    assert not folder.exists()


def touched(path: Path) -> tuple[int, ...]:
    """All that a change of a file shows in; reading a link moves its time of access."""
    found = path.lstat()
    return (
        *(found.st_dev, found.st_ino, found.st_mode, found.st_nlink, found.st_uid, found.st_gid),
        *(found.st_size, found.st_mtime_ns, found.st_ctime_ns),
    )


@pytest.mark.parametrize("kind", ["file", "folder", "link", "dangling", "terminal"])
def test_what_belongs_to_others_is_not_touched(tmp_path: Path, kind: str) -> None:
    path, terminal = tmp_path / "port", PseudoTerminal()
    match kind:
        case "file":
            path.write_text("precious")
        case "folder":
            path.mkdir()
        case "link":
            path.symlink_to("/etc/hostname")
        case "dangling":
            path.symlink_to(tmp_path / "later")
        case "terminal":
            path.symlink_to(terminal.name)
    before = touched(path)
    with pytest.raises(OutputExistsError, match=str(path)):
        PseudoPort(path)
    assert touched(path) == before
    terminal.close()


def test_a_link_left_behind_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "port"
    path.symlink_to("/dev/pts/1234567")
    port = PseudoPort(path)
    assert path.is_char_device()
    port.close()
    assert not path.is_symlink()


def test_a_path_that_was_taken_meanwhile_is_left(tmp_path: Path) -> None:
    path = tmp_path / "port"
    port = PseudoPort(path)
    path.unlink()
    path.write_text("precious")
    port.unplug()
    assert path.read_text() == "precious"
    with pytest.raises(OutputExistsError):
        port.plug()
    port.close()
    assert path.read_text() == "precious"


def test_without_a_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError, match="no folder"):
        PseudoPort(tmp_path / "absent" / "port")


def test_windows_has_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "win32")
    with pytest.raises(LocatkError, match="Windows"):
        PseudoPort()


def test_refused_ports_leave_no_terminal_open(tmp_path: Path) -> None:
    (tmp_path / "port").write_text("precious")
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises(OutputExistsError):
        PseudoPort(tmp_path / "port")
    assert set(os.listdir("/proc/self/fd")) == before
