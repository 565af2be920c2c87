"""Links: all that is there, at once; silence; and the end, which is never taken for silence."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import itertools
import os
import queue
import struct
import termios
import threading
import tty
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import serial

from locatk.formats.capture import links as serial_link
from locatk.formats.capture.links import (
    MAX_READ_BYTES,
    DescriptorLink,
    LinkLost,
    Overruns,
    PolledLink,
    RemoteLink,
    SerialLink,
)


@pytest.fixture
def pipe() -> Iterator[tuple[DescriptorLink, int]]:
    """A link to the end of a pipe, and the other end."""
    there, here = os.pipe()
    os.set_blocking(there, False)
    yield DescriptorLink(there, lambda size: os.read(there, size), lambda: None), here
    os.close(there)
    with contextlib.suppress(OSError):  # the test did
        os.close(here)


class Terminal:
    """A pseudo-terminal as a serial port, and its other end."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.port = serial.serial_for_url(os.ttyname(slave), baudrate=115_200, timeout=0)
        os.close(slave)
        self.link = SerialLink(self.port, exclusive=False)

    def unplug(self) -> None:
        if self.master >= 0:
            os.close(self.master)
        self.master = -1


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    terminal = Terminal()
    yield terminal
    terminal.link.close()
    terminal.unplug()


def gathered(link: Any, size: int) -> bytes:
    """So many bytes of a link, as they come."""
    data = b""
    while len(data) < size:
        piece = link.read(5.0)
        assert piece, f"silence after {len(data)} of {size} bytes"
        data += piece
    return data


class Cleared:
    """A source that is always ready, from a list of answers."""

    def __init__(self, *answers: bytes | OSError) -> None:
        self.answers = list(answers)
        self.asked = 0
        self.ready, other = os.pipe()
        os.close(other)  # the end of a pipe is always ready

    def __call__(self, size: int) -> bytes:
        self.asked += 1
        answer = self.answers.pop(0) if self.answers else b""
        if isinstance(answer, OSError):
            raise answer
        return answer

    def link(self) -> DescriptorLink:
        return DescriptorLink(self.ready, self, lambda: os.close(self.ready))


def test_one_read_gives_all_there_is(pipe: tuple[DescriptorLink, int]) -> None:
    link, here = pipe
    data = bytes(range(256)) * 200
    os.write(here, data)
    assert link.read(1.0) == data


def test_silence_is_no_end(pipe: tuple[DescriptorLink, int]) -> None:
    link, here = pipe
    assert link.read(0.0) == b""
    assert link.read(0.001) == b""
    os.write(here, b"x")
    assert link.read(0.0) == b"x"


def test_the_other_side_closes(pipe: tuple[DescriptorLink, int]) -> None:
    link, here = pipe
    os.write(here, b"last")
    os.close(here)
    assert link.read(1.0) == b"last"
    for _ in range(3):
        with pytest.raises(LinkLost, match="closed"):
            link.read(1.0)


def test_full_pieces_are_followed_by_more() -> None:
    source = Cleared(b"a" * 4095, b"b" * 4095, b"c" * 10, b"d")
    assert source.link().read(1.0) == b"a" * 4095 + b"b" * 4095 + b"c" * 10
    assert source.asked == 3


def test_an_empty_piece_after_a_full_one_is_no_end() -> None:
    # With VMIN 0, as pyserial sets it, a terminal gives b"" where a pipe gives EAGAIN.
    link = Cleared(b"a" * 4095, b"", b"b").link()
    assert link.read(1.0) == b"a" * 4095
    assert link.read(1.0) == b"b"


def test_what_was_read_before_an_error_is_given_first() -> None:
    gone = OSError(errno.EIO, "Input/output error")
    link = Cleared(b"a" * 4095, gone, gone).link()
    assert link.read(1.0) == b"a" * 4095
    with pytest.raises(LinkLost, match="unplugged"):
        link.read(1.0)


def test_a_read_ends_though_there_are_more() -> None:
    link = Cleared(*itertools.repeat(b"a" * 65_536, 100)).link()
    assert len(link.read(1.0)) == MAX_READ_BYTES


def test_ready_for_nothing_is_silence() -> None:
    assert Cleared(BlockingIOError()).link().read(1.0) == b""


def test_closed_is_lost_and_closing_again_does_nothing() -> None:
    link = Cleared().link()
    link.close()
    link.close()
    with pytest.raises(LinkLost):
        link.read(0.0)
    assert link.overruns() is None


def test_a_terminal_gives_what_came(terminal: Terminal) -> None:
    data = bytes(range(256)) * 40
    assert os.write(terminal.master, data) == len(data)
    assert gathered(terminal.link, len(data)) == data
    assert terminal.link.read(0.001) == b""


def test_an_unplugged_terminal_is_lost(terminal: Terminal) -> None:
    os.write(terminal.master, b"x")
    assert gathered(terminal.link, 1) == b"x"
    terminal.unplug()
    for _ in range(3):
        with pytest.raises(LinkLost, match="unplugged"):
            terminal.link.read(1.0)


def test_a_second_reader_is_reported(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    # Ready, but another program has taken the bytes before they are read.
    monkeypatch.setattr(serial_link.select, "select", lambda *_: ([0], [], []))
    with pytest.raises(LinkLost, match="another program"):
        terminal.link.read(1.0)


def counters(**values: int) -> bytes:
    """``struct serial_icounter_struct`` of Linux, field by field."""
    names = ("cts", "dsr", "rng", "dcd", "rx", "tx", "frame", "overrun", "parity", "brk")
    fields = [values.get(name, 0) for name in (*names, "buf_overrun")]
    return struct.pack("=11i", *fields) + bytes(4 * 9)


def test_overruns_count_from_the_opening(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[bytes | OSError] = [
        counters(overrun=5, frame=1, rx=900),
        counters(overrun=7, frame=4, parity=2, buf_overrun=11, rx=9000, cts=3, brk=8),
        OSError(errno.EIO, "Input/output error"),
    ]

    def ioctl(number: int, request: int, space: bytes) -> bytes:
        assert request == termios.TIOCGICOUNT == 0x545D
        assert len(space) == 80
        answer = told.pop(0)
        if isinstance(answer, OSError):
            raise answer
        return answer

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    link = SerialLink(terminal.port, exclusive=False)
    counted = Overruns(overrun=2, buffer=11, frame=3, parity=2)
    assert link.overruns() == counted
    assert counted.lost == 13
    # The port is gone, and what it counted is not.
    assert link.overruns() == counted


def test_counters_start_again(terminal: Terminal, monkeypatch: pytest.MonkeyPatch) -> None:
    told = [counters(overrun=2**31 - 1), counters(overrun=-(2**31) + 1)]
    monkeypatch.setattr(fcntl, "ioctl", lambda *_: told.pop(0))
    link = SerialLink(terminal.port, exclusive=False)
    assert link.overruns() == Overruns(overrun=2)


def test_nobody_counts_on_a_pseudo_terminal(terminal: Terminal) -> None:
    assert terminal.link.overruns() is None


def test_a_polled_port() -> None:
    port = serial.serial_for_url("loop://", timeout=0)
    link = PolledLink(port)
    assert link.read(0.0) == b""
    data = bytes(range(256)) * 4
    port.write(data)
    assert link.read(1.0) == data
    threading.Timer(0.01, port.write, [b"later"]).start()
    assert gathered(link, 5) == b"later"
    link.close()
    with pytest.raises(LinkLost):
        link.read(0.0)


def test_a_polled_port_that_is_ready_but_empty() -> None:
    with pytest.raises(LinkLost):
        PolledLink(SimpleNamespace(in_waiting=1, read=lambda size: b"")).read(1.0)


def remote(*items: bytes | None, alive: bool = True) -> RemoteLink:
    waiting: queue.Queue[bytes | None] = queue.Queue()
    for item in items:
        waiting.put(item)
    thread = SimpleNamespace(is_alive=lambda: alive)
    return RemoteLink(SimpleNamespace(_read_buffer=waiting, _thread=thread, close=lambda: None))


def test_a_remote_port_loses_nothing_at_its_end() -> None:
    link = remote(b"a", b"b", None, alive=False)
    assert link.read(1.0) == b"ab"
    for _ in range(2):
        with pytest.raises(LinkLost):
            link.read(1.0)


def test_a_remote_port_whose_thread_died_without_a_word() -> None:
    link = remote(b"a", alive=False)
    assert link.read(1.0) == b"a"
    with pytest.raises(LinkLost):
        link.read(0.0)


def test_a_silent_remote_port() -> None:
    assert remote().read(0.0) == b""


def test_a_remote_read_ends_though_there_are_more(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial_link, "MAX_READ_BYTES", 3)
    link = remote(*(bytes([each]) for each in range(7)))
    assert [link.read(1.0) for _ in range(3)] == [b"\0\1\2", b"\3\4\5", b"\6"]
    assert link.read(0.0) == b""
