"""Ports: opened, lost and found again; and what is said where one cannot be opened."""

from __future__ import annotations

import errno
import fcntl
import grp
import os
import shutil
import socket
import subprocess
import sys
import termios
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import serial
from serial.rfc2217 import PortManager
from serial.tools import list_ports

from locatk.formats.capture import port_listing as holders
from locatk.formats.capture import ports
from locatk.formats.capture.links import Link, LinkLost, SourceError
from locatk.formats.capture.port_listing import PortInfo
from locatk.formats.capture.ports import SerialPort, port_of

BAUD = 115_200
EVERY_BYTE = bytes(range(256)) * 12


class Terminal:
    """A pseudo-terminal: ``path`` is the port, ``master`` the device behind it."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.path = os.ttyname(slave)
        os.close(slave)

    def send(self, data: bytes) -> None:
        assert os.write(self.master, data) == len(data)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
        self.master = -1


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.unplug()


@pytest.fixture
def another() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.unplug()


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Link]]:
    """Opens a port, by its name or as it is; closed after the test."""
    links: list[Link] = []

    def open_(port: Any) -> Link:
        port = port_of(port, baud=BAUD) if isinstance(port, str) else port
        links.append(port.open())
        return links[-1]

    yield open_
    for link in links:
        link.close()


Opened = Callable[[Any], Link]


def gathered(link: Link, size: int) -> bytes:
    """So many bytes of a link, as they come."""
    data = b""
    while len(data) < size:
        piece = link.read(5.0)
        assert piece, f"silence after {len(data)} of {size} bytes"
        data += piece
    return data


def lost(link: Link) -> str:
    """Why a link ends, after all that is left of it."""
    with pytest.raises(LinkLost) as error:
        all(link.read(5.0) for _ in range(1000))
    return str(error.value)


def refused(name: Any, **options: Any) -> SourceError:
    """The error of a port that cannot be opened, which is one line."""

    def attempt() -> None:
        port = port_of(name, **{"baud": BAUD, **options}) if isinstance(name, str) else name
        port.open().close()

    with pytest.raises(SourceError) as error:
        attempt()
    assert "\n" not in str(error.value)
    assert not str(error.value).endswith(".")
    return error.value


# Serial devices


def test_bytes_of_a_terminal(terminal: Terminal, opened: Opened) -> None:
    port = port_of(terminal.path, baud=BAUD)
    assert port.describe() == {"port": terminal.path, "baud": str(BAUD)}
    link = opened(port)
    terminal.send(EVERY_BYTE)
    assert gathered(link, len(EVERY_BYTE)) == EVERY_BYTE
    assert link.read(0.001) == b""
    assert link.overruns() is None
    assert port.can_reconnect
    assert port.describe() == {
        "port": terminal.path,
        "resolved": terminal.path,
        "baud": str(BAUD),
    }


def test_nothing_is_thrown_away_after_the_opening(terminal: Terminal, opened: Opened) -> None:
    link = opened(terminal.path)
    terminal.send(b"first")
    time.sleep(0.01)
    terminal.send(b"second")
    assert gathered(link, 11) == b"firstsecond"


def test_an_unusual_speed(terminal: Terminal, opened: Opened) -> None:
    link = opened(port_of(terminal.path, baud=250_000))
    terminal.send(b"x")
    assert gathered(link, 1) == b"x"


def test_unplugged(terminal: Terminal, opened: Opened) -> None:
    link = opened(terminal.path)
    terminal.unplug()
    assert "unplugged" in lost(link)
    assert str(refused(terminal.path)) == f"{terminal.path}: no such port"


def test_a_link_is_followed_again(
    tmp_path: Path, terminal: Terminal, another: Terminal, opened: Opened
) -> None:
    # As /dev/serial/by-id does.
    name = tmp_path / "robot"
    name.symlink_to(terminal.path)
    port = port_of(str(name), baud=BAUD)
    link = opened(port)
    assert port.describe()["resolved"] == terminal.path
    terminal.unplug()
    lost(link)
    link.close()
    refused(port)
    name.unlink()
    refused(port)
    name.symlink_to(another.path)
    link = opened(port)
    another.send(b"again")
    assert gathered(link, 5) == b"again"
    assert port.describe()["resolved"] == another.path


def test_one_port_has_one_owner(terminal: Terminal, opened: Opened) -> None:
    link = opened(terminal.path)
    error = refused(terminal.path)
    assert str(error) == f"{terminal.path}: in use by this program itself"
    assert error.hint is not None
    link.close()
    opened(terminal.path)


def test_the_user_of_a_port_is_named(terminal: Terminal) -> None:
    code = (
        "import fcntl, os, sys, time; port = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY);"
        "fcntl.flock(port, fcntl.LOCK_EX); print(flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", code, terminal.path]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        child.stdout.readline()
        error = refused(terminal.path)
        child.kill()
    assert str(error).startswith(f"{terminal.path}: in use by python")
    assert f"(pid {child.pid})" in str(error)


def error_for_another_user(path: str) -> str:
    """Of which error a user without rights is told; needs no other user if this is one."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            if os.geteuid() == 0:
                os.setgid(65534)
                os.setuid(65534)
            port_of(path, baud=BAUD).open()
            text = "opened"
        except SourceError as error:
            text = f"{error}; {error.hint}"
        except BaseException as error:
            text = repr(error)
        os.write(writing, text.encode())
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8") as stream:
        text = stream.read()
    os.waitpid(pid, 0)
    return text


def test_a_holder_that_takes_no_lock(terminal: Terminal) -> None:
    os.chmod(terminal.path, 0o666)
    number = os.open(terminal.path, os.O_RDWR | os.O_NOCTTY)
    fcntl.ioctl(number, termios.TIOCEXCL)
    assert f"{terminal.path}: in use by" in error_for_another_user(terminal.path)
    fcntl.ioctl(number, termios.TIOCNXCL)
    assert error_for_another_user(terminal.path) == "opened"
    os.close(number)


def test_closed_to_programs_that_take_no_lock(
    terminal: Terminal, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    # As a real port is.
    monkeypatch.setattr(ports, "is_pty", lambda path: False)
    os.chmod(terminal.path, 0o666)
    link = opened(terminal.path)
    # The lock alone would say so too; without it there is still TIOCEXCL.
    monkeypatch.setattr("fcntl.flock", lambda *_: None)
    assert ": in use by" in error_for_another_user(terminal.path)
    link.close()
    assert error_for_another_user(terminal.path) == "opened"


def test_a_killed_holder_leaves_a_pseudo_terminal_open(terminal: Terminal) -> None:
    os.chmod(terminal.path, 0o666)
    pid = os.fork()
    if pid == 0:
        port_of(terminal.path, baud=BAUD).open()
        os.kill(os.getpid(), 9)
    os.waitpid(pid, 0)
    assert error_for_another_user(terminal.path) == "opened"


def test_no_permission(terminal: Terminal) -> None:
    if os.geteuid() == 0:
        os.chown(terminal.path, 0, 20)
        os.chmod(terminal.path, 0o660)
        advice = f"sudo usermod -aG {grp.getgrgid(20).gr_name} $USER"
    else:
        os.chmod(terminal.path, 0)
        advice = f"sudo chmod a+rw {terminal.path}"
    told = error_for_another_user(terminal.path)
    assert told.startswith(f"{terminal.path}: no permission to open it; ")
    assert advice in told


@pytest.mark.parametrize("kind", ["a folder, not a serial port", "not a serial port"])
def test_not_a_port(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "run.mcap"
    if kind.startswith("a folder"):
        path.mkdir()
    else:
        path.write_bytes(b"")
    error = refused(str(path))
    assert str(error) == f"{path}: {kind}"
    assert "replay:" in str(error.hint)


def test_a_device_that_is_no_terminal() -> None:
    assert str(refused("/dev/null")) == "/dev/null: not a serial port"


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> list[PortInfo]:
    """The ports of this computer, for the test to change."""
    now: list[PortInfo] = []
    monkeypatch.setattr(ports, "find_ports", lambda: list(now))
    return now


@pytest.mark.parametrize("name", ["/dev/ttyACM5", "/dev/ttyACN1", "ttyACM1"])
def test_no_such_port_names_the_nearest(plugged: list[PortInfo], name: str) -> None:
    plugged += [PortInfo("/dev/ttyACM1"), PortInfo("/dev/ttyS0"), PortInfo("/dev/rfcomm0")]
    error = refused(name)
    assert str(error) == f"{name}: no such port"
    assert error.hint == "See `locatk capture --list`; did you mean /dev/ttyACM1?"


def test_no_such_port_at_all(plugged: list[PortInfo]) -> None:
    assert refused("/dev/null/port").hint == "See `locatk capture --list`"


def test_the_driver_sets_another_speed(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ports, "_actual_baud", lambda number: 9600)
    error = refused(terminal.path)
    assert str(error) == f"{terminal.path}: 115200 baud are not supported; the port uses 9600"
    assert "--baud" in str(error.hint)
    monkeypatch.setattr(ports, "_actual_baud", lambda number: 117_000)
    port_of(terminal.path, baud=BAUD).open().close()


def test_the_speed_is_as_set(terminal: Terminal) -> None:
    port = serial.serial_for_url(terminal.path, baudrate=250_000)
    assert ports._actual_baud(port.fileno()) == (250_000 if sys.platform == "linux" else None)
    port.close()
    with open(os.devnull) as no_terminal:
        assert ports._actual_baud(no_terminal.fileno()) is None


@pytest.mark.parametrize("baud", [2**31, 2**40])
def test_a_speed_that_no_driver_takes(terminal: Terminal, baud: int) -> None:
    assert f"{baud} baud are not supported" in str(refused(terminal.path, baud=baud))


@pytest.mark.parametrize(
    ("failure", "words"),
    [
        (OSError(errno.EIO, "I/O error"), "no device behind"),
        (OSError(errno.ENXIO, "none"), "no device behind"),
        (OSError(errno.EBUSY, "busy"), ": in use by"),
        (OSError(errno.EINVAL, "invalid"), "115200 baud are not supported"),
        (OSError(errno.ENOMEM, "no memory"), "cannot be opened ("),
        (PermissionError(errno.EACCES, "no"), "no permission"),
        (RuntimeError(), "cannot be opened (RuntimeError)"),
        # As serialwin32 says it.
        (serial.SerialException("could not open port: FileNotFoundError(2, 'x')"), "no such port"),
        (serial.SerialException("could not open port: PermissionError(13, 'x')"), ": in use by"),
    ],
)
def test_errors_of_a_driver_are_explained(
    monkeypatch: pytest.MonkeyPatch, failure: Exception, words: str
) -> None:
    def fails(self: Any) -> None:
        raise failure

    monkeypatch.setattr(serial.Serial, "open", fails)
    error = refused("/dev/ttyACM0")
    assert words in str(error)
    assert error.hint


def test_an_error_of_before_is_not_blamed() -> None:
    # Opening again while a lost link is dealt with.
    try:
        raise OSError(errno.EIO, "I/O error")
    except OSError:
        error = refused("hwgrep://no such port here")
    assert str(error).startswith("hwgrep://no such port here: cannot be opened (no ports found")


# The same USB device under another name


def device(path: str, **known: Any) -> PortInfo:
    usual = {"vid": 0x2341, "pid": 0x43, "serial_number": "95", "product": "Uno"}
    return PortInfo(path, **{**usual, "description": "Uno", "location": "1-2", **known})


def test_it_comes_back_under_another_name(
    terminal: Terminal, another: Terminal, plugged: list[PortInfo], opened: Opened
) -> None:
    plugged.append(device(terminal.path))
    port = port_of(terminal.path, baud=BAUD)
    link = opened(port)
    assert port.describe() == {
        "port": terminal.path,
        "resolved": terminal.path,
        "baud": str(BAUD),
        "vid": "2341",
        "pid": "0043",
        "serial_number": "95",
        "product": "Uno",
        "location": "1-2",
    }
    terminal.unplug()
    lost(link)
    plugged.clear()
    assert str(refused(port)) == f"{terminal.path}: no such port"
    plugged += [device("/dev/none", serial_number="96"), device(another.path, location="1-4")]
    link = opened(port)
    another.send(b"here")
    assert gathered(link, 4) == b"here"
    assert port.describe()["resolved"] == another.path
    assert port.describe()["location"] == "1-4"


def test_a_device_is_followed_if_its_name_is_taken(
    terminal: Terminal, another: Terminal, plugged: list[PortInfo], opened: Opened
) -> None:
    plugged.append(device(terminal.path))
    port = port_of(terminal.path, baud=BAUD)
    opened(port).close()
    plugged[:] = [device(terminal.path, serial_number="96"), device(another.path)]
    link = opened(port)
    another.send(b"me")
    assert gathered(link, 2) == b"me"


def test_another_device_is_not_taken_for_it(
    terminal: Terminal, plugged: list[PortInfo], opened: Opened
) -> None:
    plugged.append(device(terminal.path))
    port = port_of(terminal.path, baud=BAUD)
    opened(port).close()
    plugged[:] = [device(terminal.path, pid=0x8036, description="Leonardo bootloader")]
    error = refused(port)
    assert str(error) == f"{terminal.path}: another device now (Leonardo bootloader)"
    assert error.hint == "Plug in Uno again"
    plugged[:] = [device(terminal.path)]
    opened(port)


def test_the_target_of_a_link_is_opened(
    tmp_path: Path, terminal: Terminal, plugged: list[PortInfo], opened: Opened
) -> None:
    name = tmp_path / "by-path"
    name.symlink_to(terminal.path)
    plugged.append(device(terminal.path))
    port = port_of(str(name), baud=BAUD)
    opened(port).close()
    plugged[:] = [device(terminal.path, serial_number="96")]
    opened(port)
    assert port.describe()["serial_number"] == "96"


def test_a_link_that_is_late(
    tmp_path: Path, terminal: Terminal, another: Terminal, plugged: list[PortInfo], opened: Opened
) -> None:
    name = tmp_path / "by-id"
    name.symlink_to(terminal.path)
    plugged.append(device(terminal.path))
    port = port_of(str(name), baud=BAUD)
    opened(port).close()
    name.unlink()
    plugged[:] = [device(another.path)]
    opened(port)
    assert port.describe()["resolved"] == another.path


@pytest.mark.parametrize("serial_number", [None, "0001"])
def test_identical_adapters_are_distinguished_by_their_sockets(
    terminal: Terminal,
    another: Terminal,
    plugged: list[PortInfo],
    opened: Opened,
    serial_number: str | None,
) -> None:
    def adapter(path: str, location: str) -> PortInfo:
        return device(path, serial_number=serial_number, location=location)

    twin = adapter("/dev/none", "1-3")
    plugged += [adapter(terminal.path, "1-2"), twin]
    port = port_of(terminal.path, baud=BAUD)
    opened(port).close()
    # It is unplugged: its twin is not it.
    plugged[:] = [twin]
    error = refused(port)
    assert str(error) == f"{terminal.path}: disconnected; similar ports: /dev/none"
    assert error.hint == "Plug it into its former socket: USB 1-2"
    # It comes back, and the two have changed their names.
    plugged[:] = [adapter(terminal.path, "1-3"), adapter(another.path, "1-2")]
    opened(port).close()
    assert port.describe()["resolved"] == another.path
    # In another socket it is the one that was not there before.
    plugged[:] = [adapter(terminal.path, "2-1"), twin]
    opened(port)
    assert port.describe()["location"] == "2-1"


# URLs


def served(
    talk: Callable[[socket.socket], None], connections: int = 1
) -> tuple[int, threading.Thread]:
    """A server that talks with so many connections, one after the other; its port."""
    server = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        with server:
            for _ in range(connections):
                connection, _ = server.accept()
                with connection:
                    talk(connection)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return server.getsockname()[1], thread


def test_a_socket(opened: Opened) -> None:
    number, thread = served(lambda connection: connection.sendall(b"hello" + EVERY_BYTE), 2)
    port = port_of(f"socket://127.0.0.1:{number}", baud=BAUD)
    assert port.can_reconnect
    for _ in range(2):
        link = opened(port)
        # What the server said before anybody read is not thrown away.
        assert gathered(link, 5 + len(EVERY_BYTE)) == b"hello" + EVERY_BYTE
        assert lost(link) == "closed by the other side"
        assert link.overruns() is None
        link.close()
    assert port.describe() == {"port": port.name, "resolved": f"127.0.0.1:{number}"}
    thread.join()
    assert str(refused(port)) == f"{port.name}: no server at this address"


def wait_after(connection: socket.socket, data: bytes, over: threading.Event) -> None:
    connection.sendall(data)
    over.wait(5.0)


def test_a_silent_socket(opened: Opened) -> None:
    over = threading.Event()
    number, _ = served(lambda connection: wait_after(connection, b"x", over))
    link = opened(f"socket://localhost:{number}")
    assert gathered(link, 1) == b"x"
    assert link.read(0.001) == b""
    over.set()
    lost(link)


def test_a_socket_that_breaks(opened: Opened) -> None:
    def talk(connection: socket.socket) -> None:
        connection.sendall(b"x")
        connection.recv(1)
        # Unsent, unread: a reset instead of an end.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, b"\1\0\0\0\0\0\0\0")

    number, thread = served(talk)
    link = opened(f"socket://127.0.0.1:{number}")
    assert gathered(link, 1) == b"x"
    link._receive.__self__.send(b"?")
    thread.join()
    assert "reset" in lost(link)


def test_hosts_that_are_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(failure: Exception) -> None:
        def connect(*_: object, **__: object) -> None:
            raise failure

        monkeypatch.setattr(socket, "create_connection", connect)

    assert "unknown host " in str(refused(f"socket://{'x' * 70}:1"))
    fails(socket.gaierror(-2, "Name or service not known"))
    assert str(refused("socket://robt:1")) == "socket://robt:1: unknown host robt"
    assert str(refused("rfc2217://robt:1")) == "rfc2217://robt:1: unknown host robt"
    fails(TimeoutError("timed out"))
    assert str(refused("socket://robot:1")) == "socket://robot:1: no answer"
    fails(OSError(errno.ENETUNREACH, "Network is unreachable"))
    assert "socket://robot:1: cannot be reached (Network is unreachable)" in str(
        refused("socket://robot:1")
    )


class Remote:
    """A server for one port behind RFC 2217, as pyserial's example has it."""

    def __init__(self, send: bytes) -> None:
        self.port = serial.serial_for_url("loop://", timeout=0)
        self._send = send

    def __call__(self, connection: socket.socket) -> None:
        self.write = connection.sendall
        manager = PortManager(self.port, self)
        purged = 0
        while purged < 2:  # of both directions: the last that a client does when it opens
            data = connection.recv(1024)
            for _ in manager.filter(data):
                pass
            purged += data.count(b"\xff\xfa\x2c\x0c")
        connection.sendall(b"".join(manager.escape(self._send)))


old_calls = pytest.mark.filterwarnings("ignore:set(Daemon|Name):DeprecationWarning")
"""pyserial 3.5 starts its thread as one did before Python 3.10."""


@pytest.mark.slow
@old_calls
def test_a_remote_port(opened: Opened) -> None:
    remote = Remote(EVERY_BYTE)
    number, thread = served(remote, 2)
    port = port_of(f"rfc2217://127.0.0.1:{number}", baud=57_600)
    assert port.can_reconnect
    for _ in range(2):
        link = opened(port)
        assert remote.port.baudrate == 57_600
        thread.join(0.05)
        # The server has closed by now: what it sent is there all the same.
        assert gathered(link, len(EVERY_BYTE)) == EVERY_BYTE
        assert lost(link) == "closed by the other side"
        link.close()
    thread.join()
    assert str(refused(port)) == f"{port.name}: no server at this address"
    assert port.describe() == {"port": port.name, "resolved": port.name, "baud": "57600"}


@pytest.mark.slow
@old_calls
def test_a_server_of_another_kind() -> None:
    over = threading.Event()
    number, _ = served(lambda connection: wait_after(connection, b"", over))
    error = refused(f"rfc2217://127.0.0.1:{number}?timeout=0.1")
    over.set()
    assert str(error).endswith("(Remote does not seem to support RFC2217 or BINARY mode)")
    assert f"socket://127.0.0.1:{number}" in str(error.hint)


def test_loop(opened: Opened) -> None:
    port = port_of("loop://", baud=BAUD)
    link = opened(port)
    assert link.read(0.001) == b""
    assert not port.can_reconnect
    assert port.describe() == {"port": "loop://", "resolved": "loop://", "baud": str(BAUD)}


def test_spy_sees_the_bytes(terminal: Terminal, tmp_path: Path, opened: Opened) -> None:
    seen = tmp_path / "seen"
    link = opened(f"spy://{terminal.path}?file={seen}")
    terminal.send(b"locatk")
    assert gathered(link, 6) == b"locatk"
    assert "locatk" in seen.read_text()
    terminal.unplug()
    lost(link)


def test_another_class_of_pyserial(terminal: Terminal, opened: Opened) -> None:
    link = opened(f"alt://{terminal.path}?class=PosixPollSerial")
    terminal.send(EVERY_BYTE)
    assert gathered(link, len(EVERY_BYTE)) == EVERY_BYTE
    terminal.unplug()
    lost(link)


def test_a_port_by_its_description(
    terminal: Terminal, opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Info(tuple[str, str, str]):
        device = terminal.path

    found = Info((terminal.path, "Uno", "USB VID:PID=2341:0043"))
    monkeypatch.setattr(list_ports, "grep", lambda regexp: [found] if regexp == "Uno" else [])
    port = port_of("hwgrep://Uno", baud=BAUD)
    link = opened(port)
    terminal.send(b"x")
    assert gathered(link, 1) == b"x"
    assert port.describe()["resolved"] == terminal.path
    refused("hwgrep://Due")


@pytest.mark.parametrize(
    "name",
    [
        "",
        "ftp://robot:1",
        "socket://",
        "socket://robot",
        "socket://robot:0",
        "socket://robot:99999",
        "socket://[robot:1",
        "rfc2217://robot",
        "camera:0",
        "alt:///dev/null?class=Nothing",
        "spy:///dev/null?colour=red",
        "hwgrep://(",
        "loop://?logging=loudly",
        "/dev/tty\0",
    ],
)
def test_names_of_nothing(name: str) -> None:
    assert refused(name)


@pytest.mark.parametrize("baud", [0, -9600])
def test_no_speed(baud: int) -> None:
    assert str(refused("loop://", baud=baud)) == f"{baud} is not a baud rate"


# What is installed to make links of pseudo-terminals


@pytest.mark.skipif(shutil.which("socat") is None, reason="socat is not installed")
def test_socat_ends_and_starts_again(tmp_path: Path, opened: Opened) -> None:
    names = [tmp_path / "device", tmp_path / "port"]
    command = ["socat", *(f"PTY,link={name},raw,echo=0" for name in names)]
    port = SerialPort(str(names[1]), baud=BAUD)
    for _ in range(2):
        with subprocess.Popen(command) as socat:
            while not all(name.exists() for name in names):
                time.sleep(0.005)
            link = opened(port)
            with open(names[0], "wb", buffering=0) as stream:
                stream.write(EVERY_BYTE)
                assert gathered(link, len(EVERY_BYTE)) == EVERY_BYTE
            found = holders.find_port_users([str(names[1])])[str(names[1])]
            assert os.getpid() in {holder.pid for holder in found}
            socat.terminate()
        assert "unplugged" in lost(link)
        link.close()
        refused(port)
