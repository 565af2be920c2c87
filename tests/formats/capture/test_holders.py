"""Who holds a port, and what the hint says."""

from __future__ import annotations

import fcntl
import grp
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from locatk.formats.capture import port_listing as holding
from locatk.formats.capture.port_listing import (
    PortUser,
    busy_error,
    find_port_users,
    is_pty,
    permission_error,
)

linux = pytest.mark.skipif(sys.platform != "linux", reason="only Linux has /proc")


@pytest.fixture
def path() -> Iterator[str]:
    """A terminal that nobody has open."""
    master, slave = os.openpty()
    path = os.ttyname(slave)
    os.close(slave)
    yield path
    os.close(master)


@pytest.fixture
def another(path: str) -> Iterator[int]:
    """The number of another process that has it open, without a lock."""
    number = os.open(path, os.O_RDWR | os.O_NOCTTY)
    with subprocess.Popen(["sleep", "60"], stdin=number) as child:
        os.close(number)
        yield child.pid
        child.kill()


@linux
def test_nobody(path: str) -> None:
    assert find_port_users([path]) == {path: ()}
    assert find_port_users(["/no/such/port"]) == {"/no/such/port": ()}


@linux
def test_this_program(path: str, tmp_path: Path) -> None:
    link = tmp_path / "robot"
    link.symlink_to(path)
    number = os.open(path, os.O_RDWR | os.O_NOCTTY)
    found = find_port_users([str(link), path, "/dev/null"])
    os.close(number)
    assert [holder.pid for holder in found[path]] == [os.getpid()]
    assert found[str(link)] == found[path]
    assert find_port_users([path]) == {path: ()}


@linux
def test_another_program(path: str, another: int) -> None:
    assert find_port_users([path]) == {path: (PortUser(another, "sleep"),)}
    assert str(busy_error("robot", path)) == f"robot: in use by sleep (pid {another})"


@linux
def test_locks_of_other_users_are_listed(
    path: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The line of a lock as Linux writes it, and a /proc whose files nobody may look into.
    number = os.open(path, os.O_RDWR | os.O_NOCTTY)
    fcntl.flock(number, fcntl.LOCK_EX)
    status = os.stat(path)
    place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
    lines = [line for line in Path("/proc/locks").read_text().splitlines() if place in line]
    os.close(number)
    assert len(lines) == 1
    other = "2: POSIX  ADVISORY  WRITE 9 00:00:1 0 EOF\n3: -> FLOCK broken\n"
    (tmp_path / "locks").write_text(f"{lines[0]}\n{other}4: FLOCK ADVISORY WRITE x y 0 EOF\n")
    (tmp_path / str(os.getpid())).mkdir()
    (tmp_path / str(os.getpid()) / "comm").write_text("capture\n")
    monkeypatch.setattr(holding, "PROC_DIR", tmp_path)
    assert find_port_users([path]) == {path: (PortUser(os.getpid(), "capture"),)}


def test_processes_that_cannot_be_inspected(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(holding, "PROC_DIR", tmp_path / "none")
    error = busy_error("/dev/ttyACM0", "/dev/ttyACM0")
    assert str(error) == "/dev/ttyACM0: in use by another program"
    assert error.hint is not None
    assert "ModemManager" in error.hint
    assert "lsof /dev/ttyACM0" in error.hint


def seen(monkeypatch: pytest.MonkeyPatch, *found: PortUser) -> None:
    monkeypatch.setattr(holding, "find_port_users", lambda paths: dict.fromkeys(paths, found))


def test_the_hint_knows_the_modem_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    seen(monkeypatch, PortUser(9, "ModemManager"))
    error = busy_error("robot", "/dev/ttyACM0")
    assert str(error) == "robot: in use by ModemManager (pid 9)"
    assert "systemctl disable --now ModemManager" in str(error.hint)


def test_all_holders_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    seen(monkeypatch, PortUser(os.getpid(), "python"), PortUser(8, "screen"))
    assert "by this program itself and screen (pid 8)" in str(busy_error("robot", "/dev/x"))


def node(monkeypatch: pytest.MonkeyPatch, mode: int, gid: int) -> None:
    monkeypatch.setattr(
        holding, "_status", lambda path: SimpleNamespace(st_mode=0o020000 | mode, st_gid=gid)
    )


def test_the_group_of_the_device_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    node(monkeypatch, 0o660, 987)
    monkeypatch.setattr(grp, "getgrgid", lambda gid: SimpleNamespace(gr_name="uucp", gr_mem=[]))
    error = permission_error("robot", "/dev/ttyACM0")
    assert str(error) == "robot: no permission to open it"
    assert "sudo usermod -aG uucp $USER" in str(error.hint)
    assert "log in again" in str(error.hint)


def test_a_member_must_log_in_again(monkeypatch: pytest.MonkeyPatch) -> None:
    node(monkeypatch, 0o660, 987)
    monkeypatch.setattr("pwd.getpwuid", lambda uid: SimpleNamespace(pw_name="ada"))
    group = SimpleNamespace(gr_name="dialout", gr_mem=["ada"])
    monkeypatch.setattr(grp, "getgrgid", lambda gid: group)
    assert "after your login: log in again" in str(permission_error("robot", "/dev/x").hint)


@pytest.mark.parametrize(("mode", "gid"), [(0o600, 987), (0o660, 0), (0o640, 987)])
def test_no_group_may(monkeypatch: pytest.MonkeyPatch, mode: int, gid: int) -> None:
    node(monkeypatch, mode, gid)
    assert "udev" in str(permission_error("robot", "/dev/x").hint)


def test_a_group_without_a_name(monkeypatch: pytest.MonkeyPatch) -> None:
    node(monkeypatch, 0o660, 2**31 - 7)
    assert "2147483641" in str(permission_error("robot", "/dev/x").hint)


@linux
def test_pseudo_terminals_are_known(path: str, tmp_path: Path) -> None:
    assert is_pty(path)
    assert not is_pty("/dev/null")
    assert not is_pty(str(tmp_path))
    assert not is_pty("/no/such/port")
