"""The list of ports, and by what a device is known again."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from locatk.formats.capture import port_listing as listing
from locatk.formats.capture.port_listing import (
    PortInfo,
    PortUser,
    find_ports,
    find_ports_with_users,
)


def usb(device: str, **known: object) -> ListPortInfo:
    """A port as pyserial tells of it."""
    info = ListPortInfo(device)
    for name, value in known.items():
        setattr(info, name, value)
    return info


ARDUINO: dict[str, Any] = {
    "vid": 0x2341,
    "pid": 0x43,
    "serial_number": "95437",
    "product": "Uno",
    "description": "Uno",
    "manufacturer": "Arduino",
    "location": "1-2:1.0",
}


@pytest.fixture
def arduino(monkeypatch: pytest.MonkeyPatch) -> None:
    """An Arduino, and ports that tell nothing."""
    known = usb("/dev/ttyACM10", **ARDUINO)
    others = [usb("/dev/ttyACM9", serial_number=""), usb("/dev/ttyS4")]
    monkeypatch.setattr(list_ports, "comports", lambda: [known, *others])


@pytest.mark.usefixtures("arduino")
def test_ports_in_natural_order() -> None:
    assert [info.device for info in find_ports_with_users()] == [
        "/dev/ttyACM9",
        "/dev/ttyACM10",
        "/dev/ttyS4",
    ]


@pytest.mark.usefixtures("arduino")
def test_all_that_is_known() -> None:
    bare, known, _ = find_ports_with_users()
    assert known == PortInfo(device="/dev/ttyACM10", **ARDUINO)
    assert bare == PortInfo(device="/dev/ttyACM9")
    assert json.loads(json.dumps(asdict(known)))["pid"] == 67


def test_this_machine() -> None:
    # Whatever it has: names that exist, once each.
    names = [info.device for info in find_ports()]
    assert len(set(names)) == len(names)
    if sys.platform == "linux":
        assert all(os.path.exists(name) for name in names)


@pytest.mark.usefixtures("arduino")
def test_holders_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    held = {"/dev/ttyACM10": (PortUser(7, "screen"), PortUser(8, "cat"))}
    monkeypatch.setattr(
        listing, "find_port_users", lambda paths: {p: held.get(p, ()) for p in paths}
    )
    assert [info.holder for info in find_ports_with_users()] == [
        None,
        "screen (pid 7), cat (pid 8)",
        None,
    ]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux has names without ports")
def test_names_without_a_port_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, kind in (("ttyS0", "4"), ("ttyS1", "0")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "type").write_text(f"{kind}\n")
    monkeypatch.setattr(listing, "TTY_CLASS_DIR", tmp_path)
    names = ["/dev/ttyS0", "/dev/ttyS1", "/dev/ttyS2", "/dev/ttyUSB0"]
    monkeypatch.setattr(list_ports, "comports", lambda: [usb(name) for name in names])
    assert [info.device for info in find_ports()] == ["/dev/ttyS0", "/dev/ttyS2", "/dev/ttyUSB0"]


def test_a_port_that_goes_meanwhile(monkeypatch: pytest.MonkeyPatch) -> None:
    # pyserial 3.5 then takes None for a number (SysFS.__init__).
    failures = [TypeError("int() can't convert non-string with explicit base")]

    def comports() -> list[ListPortInfo]:
        if failures:
            raise failures.pop()
        return [usb("/dev/ttyACM0")]

    monkeypatch.setattr(list_ports, "comports", comports)
    assert find_ports() == [PortInfo("/dev/ttyACM0")]


def test_ports_that_cannot_be_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    def comports() -> list[ListPortInfo]:
        raise OSError("no /sys here")

    monkeypatch.setattr(list_ports, "comports", comports)
    assert find_ports() == find_ports_with_users() == []


def test_identity() -> None:
    one = PortInfo("/dev/ttyACM0", vid=1, pid=2, serial_number="a", location="1-2")
    elsewhere = PortInfo("/dev/ttyACM7", vid=1, pid=2, serial_number="a", location="3-1")
    assert one.identity == elsewhere.identity == (1, 2, "a", "")
    assert PortInfo("/dev/ttyACM0", vid=1, pid=2, serial_number="b").identity != one.identity
    assert PortInfo("/dev/ttyS0", serial_number="a").identity is None


def test_interfaces_of_one_device_are_listed_separately() -> None:
    first, second = (
        PortInfo("/dev/ttyACM0", vid=1, pid=2, serial_number="a", location=f"1-2:1.{interface}")
        for interface in (0, 2)
    )
    assert first.identity != second.identity
