"""Serial ports of this computer, their users and permissions.

Linux lists the users of a port in ``/proc`` (proc(5)): the open files of processes that the
user may inspect, and the locks of all processes. On other systems no users are known, and
hints name the usual programs.
"""

from __future__ import annotations

import os
import stat
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from locatk.core.natural_order import natural_key
from locatk.formats.capture.links import SourceError

TTY_CLASS_DIR = Path("/sys/class/tty")

Identity = tuple[int, int, str | None, str]
"""Identity of a USB port across reconnects: vendor, product, serial number, and interface of a
device with several ports."""


@dataclass(frozen=True)
class PortInfo:
    """Serial port; unknown attributes are None.

    Attributes
    ----------
    device : str
        Argument of ``locatk capture``.
    vid, pid : int or None
        Vendor and product of a USB device.
    serial_number : str or None
    product, description, manufacturer : str or None
    location : str or None
        USB socket, and after a colon the interface of a device with several ports.
    holder : str or None
        Programs that have it open, as far as the user may see them.
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
        """Identity of a USB device; None for other ports."""
        if self.vid is None or self.pid is None:
            return None
        interface = (self.location or "").partition(":")[2]
        return self.vid, self.pid, self.serial_number, interface


def find_ports_with_users() -> list[PortInfo]:
    """Return all ports with the programs that use them, in natural order of their names."""
    ports = find_ports()
    users = find_port_users(info.device for info in ports)
    return [replace(info, holder=", ".join(map(str, users[info.device])) or None) for info in ports]


def find_ports() -> list[PortInfo]:
    """Return all ports in natural order of their names."""
    ports = [_info(port) for port in _comports() if _exists(port.device)]
    return sorted(ports, key=lambda info: natural_key(info.device))


def _comports() -> list[Any]:
    from serial.tools import list_ports

    for _ in range(3):
        try:
            return list(list_ports.comports())
        except (OSError, TypeError, ValueError):
            pass  # A port vanished while pyserial read its attributes; try again.
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


def _exists(device: str) -> bool:
    """Return False for UART names that Linux reserves for hardware that does not exist.

    Since Linux 6.5, pyserial 3.5 lists them as ports (pyserial issue 763); their type is 0,
    PORT_UNKNOWN.
    """
    name = device.removeprefix("/dev/")
    if sys.platform != "linux" or not name.startswith("ttyS"):
        return True
    try:
        return (TTY_CLASS_DIR / name / "type").read_text(encoding="ascii").strip() != "0"
    except OSError:
        return True


PROC_DIR = Path("/proc")

USUAL_USERS = (
    "ModemManager, a serial monitor (Arduino IDE, screen, minicom), another locatk capture"
)

PTY_MASTERS = ("/dev/ptmx", "/dev/pts/ptmx")

_Pair = tuple[int, int]


@dataclass(frozen=True)
class PortUser:
    """Process that has a port open.

    Attributes
    ----------
    pid : int
    name : str
        Name of its command, as in ``ps`` (15 characters); of an interpreter, with its script.
    """

    pid: int
    name: str

    def __str__(self) -> str:
        return f"{self.name} (pid {self.pid})"


def find_port_users(paths: Iterable[str]) -> dict[str, tuple[PortUser, ...]]:
    """Return the processes that have each of ``paths`` open, as far as the user may see them.

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
    """Return the error for a port that another program has open."""
    users = [
        user
        for user in find_port_users([path])[path]
        if user.pid == os.getpid() or not _is_pty_master(user.pid, path)
    ]
    if not users:
        return SourceError(
            "in use by another program",
            file=name,
            hint=f"End it: usually {USUAL_USERS}; `sudo lsof {path}` shows it",
        )
    names = " and ".join(
        "this program itself" if user.pid == os.getpid() else str(user) for user in users
    )
    hint = "End it, or choose another port: `locatk capture --list`"
    if any(user.name == "ModemManager" for user in users):
        hint = (
            "It closes the port after 30 s; to stop it: sudo systemctl disable --now ModemManager"
        )
    return SourceError(f"in use by {names}", file=name, hint=hint)


def permission_error(name: str, path: str) -> SourceError:
    """Return the error for a port that this user may not open."""
    return SourceError("no permission to open it", file=name, hint=_permission(path))


def is_pty(path: str) -> bool:
    """Return whether a path is an end of a pseudo-terminal, by Linux' list of devices."""
    status = _status(path)
    return status is not None and _is_pty(status)


def _permission(path: str) -> str:
    status = _status(path)
    if status is None or sys.platform == "win32":
        return "Ask the administrator of this computer"
    if status.st_mode & 0o060 != 0o060 or status.st_gid == 0:
        return f"Only its owner may: sudo chmod a+rw {path}, or a permanent udev rule"
    import grp
    import pwd

    try:
        group = grp.getgrgid(status.st_gid)
    except KeyError:
        return f"Its group {status.st_gid} has no name on this computer"
    try:
        is_member = pwd.getpwuid(os.geteuid()).pw_name in group.gr_mem
    except KeyError:
        is_member = False
    if is_member:
        return f"You joined the group {group.gr_name} after your login: log in again"
    return f"Join the group {group.gr_name}: sudo usermod -aG {group.gr_name} $USER; log in again"


def _status(path: str) -> os.stat_result | None:
    try:
        return os.stat(path)
    except OSError:
        return None


def _is_pty(status: os.stat_result) -> bool:
    return stat.S_ISCHR(status.st_mode) and 136 <= os.major(status.st_rdev) <= 143


def _device(status: os.stat_result) -> _Pair:
    """Return the identity of the device of a node.

    Pseudo-terminals of other containers have the same numbers, but another file system.
    """
    if not stat.S_ISCHR(status.st_mode):
        return status.st_dev, status.st_ino
    return status.st_dev if _is_pty(status) else -1, status.st_rdev


def _open_devices() -> Iterator[tuple[int, _Pair]]:
    """Yield (pid, device) of all open files below /dev."""
    try:
        pids = [entry for entry in os.listdir(PROC_DIR) if entry.isdigit()]
    except OSError:
        return
    for pid in pids:
        folder = f"{PROC_DIR}/{pid}/fd"
        try:
            numbers = os.listdir(folder)
        except OSError:
            continue  # The process is another user's, or has ended.
        for number in numbers:
            link = f"{folder}/{number}"
            try:
                # Other files are skipped: one on an unreachable server would block.
                if not os.readlink(link).startswith("/dev/"):
                    continue
                status = os.stat(link)
            except OSError:
                continue
            yield int(pid), _device(status)


def _locks() -> Iterator[tuple[int, _Pair]]:
    """Yield (pid, node) of the locks on whole files, which are listed for all users."""
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
    """Return the name of a process; ``""`` if it has ended."""
    name = _read_line(PROC_DIR / str(pid) / "comm")
    if not name.startswith("python"):
        return name
    words = _read_line(PROC_DIR / str(pid) / "cmdline").replace("\0", " ").split()[1:]
    if "-c" in words[:3]:
        return name
    run = [Path(word).name for word in words if not word.startswith("-")]
    return f"{name} {' '.join(run[:2])}".strip()


def _is_pty_master(pid: int, path: str) -> bool:
    """Return whether a process is the other end of a pseudo-terminal, which keeps it open."""
    if not is_pty(path):
        return False
    folder = PROC_DIR / str(pid) / "fd"
    try:
        return any(os.readlink(each) in PTY_MASTERS for each in folder.iterdir())
    except OSError:
        return False


def _read_line(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
