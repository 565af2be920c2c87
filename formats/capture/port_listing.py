"""Serial ports of this computer, as ``locatk capture --list`` shows them."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.formats.capture.port_holders import holders

TTYS = Path("/sys/class/tty")

Identity = tuple[int, int, str | None, str]
"""What a USB port keeps when it is plugged in again: vendor, product, serial number, and
which of the interfaces of a device with several ports it is."""


@dataclass(frozen=True)
class PortInfo:
    """A port and what is known of it; None where it does not tell.

    Attributes
    ----------
    device : str
        What to give ``locatk capture``.
    vid, pid : int or None
        Vendor and product of a USB device.
    serial_number : str or None
    product, description, manufacturer : str or None
    location : str or None
        The USB socket, and after a colon the interface of a device with several ports.
    holder : str or None
        Who has it open, as far as the user may see.
    """

    device: str
    vid: int | None = None
    pid: int | None = None
    serial_number: str | None = None
    product: str | None = None
    description: str | None = None
    manufacturer: str | None = None
    location: str | None = None
    holder: str | None = None

    @property
    def identity(self) -> Identity | None:
        """By which a USB device is known again; None for others."""
        if self.vid is None or self.pid is None:
            return None
        interface = (self.location or "").partition(":")[2]
        return self.vid, self.pid, self.serial_number, interface


def ports() -> list[PortInfo]:
    """All ports with their holders, in natural order of their names."""
    found = attached()
    held = holders(info.device for info in found)
    return [replace(info, holder=", ".join(map(str, held[info.device])) or None) for info in found]


def attached() -> list[PortInfo]:
    """All ports, without looking for holders."""
    found = [_info(port) for port in _comports() if _is_there(port.device)]
    return sorted(found, key=lambda info: _natural(info.device))


def _comports() -> list[Any]:
    from serial.tools import list_ports

    for _ in range(3):
        try:
            return list(list_ports.comports())
        except (OSError, TypeError, ValueError):
            pass  # a port went while pyserial looked at it; the next look is without it
    return []


def _info(port: Any) -> PortInfo:
    def known(text: str | None) -> str | None:
        return None if text in (None, "", "n/a") else text

    return PortInfo(
        device=port.device,
        vid=port.vid,
        pid=port.pid,
        serial_number=known(port.serial_number),
        product=known(port.product),
        description=known(port.description),
        manufacturer=known(port.manufacturer),
        location=known(port.location),
    )


def _is_there(device: str) -> bool:
    """Not one of the names that Linux keeps for UARTs that a computer might have.

    Since Linux 6.5 pyserial 3.5 takes them for ports (pyserial issue 763); the type of
    such a one is 0, PORT_UNKNOWN.
    """
    name = device.removeprefix("/dev/")
    if sys.platform != "linux" or not name.startswith("ttyS"):
        return True
    try:
        return (TTYS / name / "type").read_text(encoding="ascii").strip() != "0"
    except OSError:
        return True


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts ttyS10 after ttyS9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]
