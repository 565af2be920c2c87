"""Ports of Bluetooth devices, with devices in the place of those of bleak."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from bleak.exc import (
    BleakBluetoothNotAvailableError,
    BleakBluetoothNotAvailableReason,
    BleakDBusError,
    BleakError,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from locatk.core.errors import LocatkError
from locatk.formats.capture import bluetooth
from locatk.formats.capture.bluetooth import BluetoothPort
from locatk.formats.capture.links import Link, LinkLost, SourceError
from locatk.formats.capture.ports import port_of
from locatk.formats.schemas.serial_pb2 import Readings
from locatk.formats.sessions.reader import Session

ADDRESS, OTHER = "C0:11:22:33:44:55", "C0:11:22:33:44:66"
WAIT_S = 20.0
LINES = b"".join(b"t_ms:%d,x_mm:%d\n" % (10 * k, k * k) for k in range(200))


@pytest.fixture
def robot(air: Any) -> Any:
    return air.add("robot7", ADDRESS)


@pytest.fixture
def port(air: Any) -> BluetoothPort:
    """The port that ``start`` of the conftest records."""
    return BluetoothPort("ble:robot7")


@pytest.fixture
def opened() -> Iterator[Callable[[Any], Link]]:
    links: list[Link] = []

    def open_(port: Any) -> Link:
        port = port_of(port, baud=115_200) if isinstance(port, str) else port
        links.append(port.open())
        return links[-1]

    yield open_
    for link in links:
        link.close()
    assert not [each for each in threading.enumerate() if each.name == "locatk-bluetooth"]


def cut(data: bytes, size: int = 20) -> list[bytes]:
    return [data[start : start + size] for start in range(0, len(data), size)]


def gathered(link: Link, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = link.read(5.0)
        assert piece, f"silence after {len(data)} of {size} bytes"
        data += piece
    return data


def refused(name: str) -> SourceError:
    """The error of a port that cannot be opened: one line, and no thread is left."""
    with pytest.raises(SourceError) as error:
        port_of(name, baud=115_200).open().close()
    assert error.value.hint
    for text in (str(error.value), error.value.hint):
        assert text.isprintable()
        assert not text.endswith(".")
    assert not [each for each in threading.enumerate() if each.name == "locatk-bluetooth"]
    return error.value


def wait_until(condition: Callable[[], object]) -> None:
    until = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < until
        time.sleep(0.002)


# Bytes


@pytest.mark.parametrize("name", ["ble:robot7", f"ble:{ADDRESS}", f"BLE:{ADDRESS.lower()}"])
def test_bytes_by_name_and_by_address(robot: Any, opened: Any, name: str) -> None:
    port = port_of(name, baud=115_200)
    assert port.describe() == {"port": name}
    link = opened(port)
    every_byte = bytes(range(256)) * 12
    robot.send(cut(every_byte, 244))
    assert gathered(link, len(every_byte)) == every_byte
    assert link.read(0.001) == b""
    assert port.can_reconnect
    assert port.describe() == {"port": name, "resolved": ADDRESS, "product": "robot7"}


def test_notifications_before_the_first_read_are_kept(robot: Any, opened: Any) -> None:
    robot.greeting = (b"first ", b"second")
    assert gathered(opened("ble:robot7"), 12) == b"first second"


def test_bytes_before_a_disconnection_are_read(robot: Any, opened: Any) -> None:
    link = opened("ble:robot7")
    robot.send(cut(LINES))
    robot.drop()
    assert gathered(link, len(LINES)) == LINES
    with pytest.raises(LinkLost, match="disconnected"):
        all(link.read(0.01) == b"" for _ in range(1000))


def test_bytes_beyond_the_queue_are_counted(
    robot: Any, opened: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bluetooth, "MAX_WAITING_NOTIFICATIONS", 3)
    link = opened("ble:robot7")
    robot.send([b"a", b"bb", b"ccc", b"dddd", b"eeeee"])
    wait_until(lambda: link.overruns().lost == 9)
    assert link.read(1.0) == b"abbccc"


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(sizes=st.lists(st.integers(1, 244), min_size=1, max_size=30), data=st.binary(max_size=3000))
def test_cuts_do_not_matter(robot: Any, sizes: list[int], data: bytes) -> None:
    pieces, rest = [], data
    for size in sizes:
        pieces.append(rest[:size])
        rest = rest[size:]
    link = BluetoothPort(f"ble:{ADDRESS}").open()
    try:
        robot.send([*pieces, rest, b"end"])
        assert gathered(link, len(data) + 3) == data + b"end"
    finally:
        robot.subscribed.clear()
        link.close()


# Sessions


def values(path: Path) -> list[float]:
    return [
        value
        for _, message in Session.open(path).decoded("/readings/robot", Readings)
        for value in message.value
    ]


def test_lines_are_whole_across_notifications(
    robot: Any, start: Any, tmp_path: Path, raw_bytes: Any
) -> None:
    running = start("lines")
    robot.send(cut(LINES, 7))
    running.until(lambda: running.shown and running.shown[-1].totals.bytes == len(LINES))
    result = running.end()
    assert result.totals.bad == 0
    assert raw_bytes(tmp_path / "run.mcap") == LINES
    assert [int(v) for v in values(tmp_path / "run.mcap") if v == int(v)].count(199 * 199) == 1
    known = Session.open(tmp_path / "run.mcap").metadata()["capture"]
    assert (known["resolved"], known["product"]) == (ADDRESS, "robot7")


def test_disconnection_and_reconnection(
    robot: Any, air: Any, start: Any, tmp_path: Path, raw_bytes: Any, log_lines: Any
) -> None:
    running = start("lines")
    robot.send([b"x:1\nx:2\nx:"])
    running.until(lambda: running.shown and running.shown[-1].totals.bytes)
    robot.is_on = False
    robot.drop()
    running.wait_for_message("disconnected")
    air.add("robot7", OTHER)  # not the same one, although its name is
    time.sleep(0.15)
    robot.is_on = True
    robot.send([b"x:4\nx:5\n"])
    running.until(lambda: running.shown[-1].totals.bytes == 18)
    result = running.end()
    assert robot.connections == 2
    assert air.devices[1].connections == 0
    assert result.totals.gaps == 1
    assert raw_bytes(tmp_path / "run.mcap") == b"x:1\nx:2\nx:x:4\nx:5\n"
    # The first line after each opening may be the rest of one, as with a serial port.
    assert values(tmp_path / "run.mcap") == [2, 5]
    assert any("disconnected" in line for line in log_lines(tmp_path / "run.mcap"))


def test_end_while_the_device_is_away(
    robot: Any, start: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = start("lines")
    robot.send([b"x:1\n"])
    running.until(lambda: running.shown and running.shown[-1].totals.bytes)
    monkeypatch.setattr(bluetooth, "SCAN_TIMEOUT_S", 60.0)
    robot.is_on = False
    robot.drop()
    running.wait_for_message("disconnected")
    began = time.monotonic()
    assert running.end().ended == "stopped"
    assert time.monotonic() - began < 1.5


def test_stop_ends_the_search(air: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bluetooth, "SCAN_TIMEOUT_S", 60.0)
    stop = threading.Event()
    port = port_of("ble:robot7", baud=115_200, stop=stop)
    threading.Timer(0.05, stop.set).start()
    began = time.monotonic()
    with pytest.raises(SourceError, match="stopped before"):
        port.open()
    assert time.monotonic() - began < 1.5


# Refusals


def test_unknown_name(robot: Any, air: Any) -> None:
    air.add("evil\x1b[2J\nname", OTHER)
    air.add(None, "C0:11:22:33:44:77")
    error = refused("ble:robot8")
    assert error.message == "not found in 0.1 s; found: evil\\x1b[2J\\x0aname, robot7"


def test_nothing_in_range(air: Any) -> None:
    assert "found: no device with a name" in str(refused("ble:robot7"))


def test_many_names_are_cut(air: Any) -> None:
    for number in range(20):
        air.add(f"n{number:02d}", f"C0:00:00:00:00:{number:02d}")
    assert str(refused("ble:robot7")).endswith("n11 and 8 more")


def test_two_devices_of_one_name(robot: Any, air: Any, opened: Any) -> None:
    twin = air.add("robot7", OTHER)
    error = refused("ble:robot7")
    assert error.message == f"2 devices have this name: {ADDRESS}, {OTHER}"
    assert error.hint == f"Give an address: ble:{ADDRESS}"
    assert robot.connections == twin.connections == 0
    opened(f"ble:{OTHER}")
    assert (robot.connections, twin.connections) == (0, 1)


def test_second_device_that_advertises_later(
    robot: Any, air: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bluetooth, "SAME_NAME_WAIT_S", 5.0)
    threading.Timer(0.05, air.add, ("robot7", OTHER)).start()
    assert "2 devices" in str(refused("ble:robot7"))


@pytest.mark.parametrize("name", ["ble:", "ble: "])
def test_no_name(air: Any, name: str) -> None:
    assert "no name or address" in str(refused(name))
    assert air.scans == 0


def test_bleak_is_missing(without_extras: Callable[..., None]) -> None:
    without_extras("ble")
    with pytest.raises(LocatkError) as error:
        port_of("ble:robot7", baud=115_200).open()
    assert str(error.value) == "ble:robot7: Bluetooth needs bleak, which is not installed"
    assert error.value.hint == 'Install it: pip install "locatk[ble]"'


@pytest.mark.parametrize(
    ("raised", "reason"),
    [
        (BleakError("Bluetooth device is turned off"), "(Bluetooth device is turned off)"),
        (
            BleakBluetoothNotAvailableError(
                "No powered adapter\nfound", BleakBluetoothNotAvailableReason.POWERED_OFF
            ),
            "(No powered adapter found)",
        ),
        (
            BleakDBusError("org.bluez.Error.NotReady", ["Resource Not Ready"]),
            "([org.bluez.Error.NotReady] Resource Not Ready)",
        ),
        (OSError(), "(OSError)"),
    ],
)
def test_adapter_is_off(air: Any, raised: Exception, reason: str) -> None:
    air.adapter_error = raised
    assert str(refused("ble:robot7")) == f"ble:robot7: Bluetooth is not available {reason}"


@pytest.mark.parametrize(
    ("raised", "problem"),
    [(TimeoutError(), "no answer in 10 s"), (BleakError("busy"), "cannot be connected (busy)")],
)
def test_no_connection(robot: Any, raised: Exception, problem: str) -> None:
    robot.connect_error = raised
    assert refused("ble:robot7").message == problem


def test_device_without_the_service(air: Any) -> None:
    air.add("watch", OTHER, has_uart=False)
    assert "no Nordic UART Service" in str(refused("ble:watch"))
