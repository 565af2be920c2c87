"""Serial ports of this computer, as ``locatk capture --list`` shows them."""

from __future__ import annotations

import os
import re
import stat
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.formats.capture.links import SourceError

TTY_CLASS_DIR = Path("/sys/class/tty")

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


def find_ports_with_users() -> list[PortInfo]:
    """All ports with their holders, in natural order of their names."""
    found = find_ports()
    held = find_port_users(info.device for info in found)
    return [replace(info, holder=", ".join(map(str, held[info.device])) or None) for info in found]


def find_ports() -> list[PortInfo]:
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
        return (TTY_CLASS_DIR / name / "type").read_text(encoding="ascii").strip() != "0"
    except OSError:
        return True


def _natural(name: str) -> list[tuple[int, str]]:
    """Sorts ttyS10 after ttyS9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


PROC_DIR = Path("/proc")

USUAL_HOLDERS = (
    "ModemManager, a serial monitor (Arduino IDE, screen, minicom), another locatk capture"
)

PTY_MASTERS = ("/dev/ptmx", "/dev/pts/ptmx")

_Pair = tuple[int, int]


@dataclass(frozen=True)
class PortUser:
    """A process that has a port open.

    Attributes
    ----------
    pid : int
    name : str
        Of its command, as ``ps`` shows it: 15 characters at most; of an interpreter, with
        what it runs.
    """

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid})"


def find_port_users(paths: Iterable[str]) -> dict[str, tuple[PortUser, ...]]:
    """Processes that have each of ``paths`` open, as far as the user may see them.

    A path may be a symbolic link; a device is the same under all its names.
    """
    devices: dict[_Pair, set[int]] = defaultdict(set)
    nodes: dict[_Pair, set[int]] = defaultdict(set)
    wanted: dict[str, tuple[set[int], set[int]]] = {}
    for path in paths:
        status = _status(path)
        if status is not None:
            node = (status.st_dev, status.st_ino)
            wanted[path] = (devices[_device(status)], nodes[node])
        else:
            wanted[path] = (set(), set())
    if devices:
        for pid, pair in _open_devices():
            if pair in devices:
                devices[pair].add(pid)
        for pid, pair in _locks():
            if pair in nodes:
                nodes[pair].add(pid)
    return {
        path: tuple(PortUser(pid, name) for pid in sorted(opened | locked) if (name := _name(pid)))
        for path, (opened, locked) in wanted.items()
    }


def busy_error(name: str, path: str) -> SourceError:
    """The error of a port that somebody has open already."""
    seen = [
        holder
        for holder in find_port_users([path])[path]
        if holder.pid == os.getpid() or not _serves(holder.pid, path)
    ]
    if not seen:
        return SourceError(
            f"{name} is in use by another program",
            hint=f"End it: usually {USUAL_HOLDERS}; `sudo lsof {path}` names it",
        )
    names = " and ".join(
        "this program itself" if holder.pid == os.getpid() else str(holder) for holder in seen
    )
    hint = "End it, or choose another port: `locatk capture --list`"
    if any(holder.name == "ModemManager" for holder in seen):
        hint = "It lets go after half a minute; for good: sudo systemctl disable --now ModemManager"
    return SourceError(f"{name} is in use by {names}", hint=hint)


def permission_error(name: str, path: str) -> SourceError:
    """The error of a port that this user may not open."""
    return SourceError(f"no permission to open {name}", hint=_permission(path))


def is_pty(path: str) -> bool:
    """Whether it is an end of a pseudo-terminal, by Linux' list of devices."""
    status = _status(path)
    return status is not None and _is_pty(status)


def _permission(path: str) -> str:
    status = _status(path)
    if status is None or sys.platform == "win32":
        return "Ask who administers this computer"
    if status.st_mode & 0o060 != 0o060 or status.st_gid == 0:
        return f"Only its owner may: sudo chmod a+rw {path}, or a udev rule, which stays"
    import grp
    import pwd

    try:
        group = grp.getgrgid(status.st_gid)
    except KeyError:
        return f"It belongs to the group {status.st_gid}, which has no name here"
    try:
        is_member = pwd.getpwuid(os.geteuid()).pw_name in group.gr_mem
    except KeyError:
        is_member = False
    if is_member:
        return f"You joined the group {group.gr_name} since you logged in: log in again"
    return f"Join the group {group.gr_name}: sudo usermod -aG {group.gr_name} $USER; log in again"


def _status(path: str) -> os.stat_result | None:
    try:
        return os.stat(path)
    except OSError:
        return None


def _is_pty(status: os.stat_result) -> bool:
    return stat.S_ISCHR(status.st_mode) and 136 <= os.major(status.st_rdev) <= 143


def _device(status: os.stat_result) -> _Pair:
    """The device behind a node, wherever the node is. Pseudo-terminals of other containers
    have the same numbers, but a file system of their own."""
    if not stat.S_ISCHR(status.st_mode):
        return status.st_dev, status.st_ino
    return status.st_dev if _is_pty(status) else -1, status.st_rdev


def _open_devices() -> Iterator[tuple[int, _Pair]]:
    """(pid, device) of all that is open below /dev."""
    try:
        pids = [entry for entry in os.listdir(PROC_DIR) if entry.isdigit()]
    except OSError:
        return
    for pid in pids:
        folder = f"{PROC_DIR}/{pid}/fd"
        try:
            numbers = os.listdir(folder)
        except OSError:
            continue  # another user's, or it has ended
        for number in numbers:
            link = f"{folder}/{number}"
            try:
                # Others are not looked at: a file on a server that is away would block.
                if not os.readlink(link).startswith("/dev/"):
                    continue
                status = os.stat(link)
            except OSError:
                continue
            yield int(pid), _device(status)


def _locks() -> Iterator[tuple[int, _Pair]]:
    """(pid, node) of the locks on whole files, which are told of all users."""
    try:
        lines = (PROC_DIR / "locks").read_text(encoding="ascii", errors="replace").splitlines()
    except OSError:
        return
    for line in lines:
        # 1: FLOCK  ADVISORY  WRITE 6929 00:1a:3 0 EOF
        fields = line.split()
        if len(fields) < 6 or fields[1] != "FLOCK":
            continue
        try:
            pid = int(fields[4])
            major, minor, inode = fields[5].split(":")
            yield pid, (os.makedev(int(major, 16), int(minor, 16)), int(inode))
        except ValueError:
            continue


def _name(pid: int) -> str:
    """Name of a process, ``""`` where it has ended."""
    name = _line(PROC_DIR / str(pid) / "comm")
    if not name.startswith("python"):
        return name
    words = _line(PROC_DIR / str(pid) / "cmdline").replace("\0", " ").split()[1:]
    if "-c" in words[:3]:
        return name
    run = [Path(word).name for word in words if not word.startswith("-")]
    return f"{name} {' '.join(run[:2])}".strip()


def _serves(pid: int, path: str) -> bool:
    """Whether a process is the other end of a pseudo-terminal, which keeps it open."""
    if not is_pty(path):
        return False
    folder = PROC_DIR / str(pid) / "fd"
    try:
        return any(os.readlink(each) in PTY_MASTERS for each in folder.iterdir())
    except OSError:
        return False


def _line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
