"""One recording from what the user wants to the files: checks first, then the port, then the
first byte on the disk."""

from __future__ import annotations

import contextlib
import platform
import shutil
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from locatk.core.errors import InputError, LocatkError
from locatk.formats.capture import attachments as artifacts
from locatk.formats.capture import ports, replay
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.ingestion import AUTO, CameraIntake, Intake, SerialIntake
from locatk.formats.capture.links import Link, Port, SourceError
from locatk.formats.capture.reader_thread import BACKOFF_S, PortReader
from locatk.formats.capture.recorder import Limits, Recorder
from locatk.formats.capture.recording_files import (
    DiskFullError,
    FileContent,
    RecordingFiles,
    check_outputs,
)
from locatk.formats.capture.statistics import CaptureStatus, RecordingResult
from locatk.formats.devices import find_device
from locatk.formats.devices.decoder import Options

CAMERA = "camera:"
NAME, CAMERA_NAME = "robot", "camera"


@dataclass(frozen=True)
class CaptureRequest:
    """What to record, and how; the options of ``locatk capture``."""

    port: str
    device: str
    output: Path
    artifacts: tuple[Path, ...] = ()
    note: str | None = None
    meta: Mapping[str, str] = field(default_factory=dict)
    limits: Limits = field(default_factory=Limits)
    name: str | None = None
    baud: int | None = None
    columns: tuple[str, ...] = ()
    speed: float = 1.0
    image: str = "jpeg"
    wait_s: float = 0.0
    overwrite: bool = False

    @property
    def is_camera(self) -> bool:
        """Whether frames are recorded, not bytes."""
        return self.port.startswith(CAMERA)

    @property
    def device_name(self) -> str:
        """Name of the device in the session."""
        return self.name or (CAMERA_NAME if self.is_camera else NAME)

    @property
    def numbered(self) -> bool:
        """Whether there may be several files."""
        return self.limits.rotate_s is not None or self.limits.rotate_bytes is not None


def record(
    wanted: CaptureRequest,
    stop: threading.Event,
    *,
    tell: Callable[[str], None] = lambda text: None,
    show: Callable[[CaptureStatus], None] = lambda status: None,
    ready: Callable[[str], None] = lambda port: None,
    waiting: Callable[[str], None] = lambda port: None,
) -> RecordingResult:
    """Record until ``stop`` is set, a limit of ``wanted`` is reached or the source is at its
    end.

    Parameters
    ----------
    wanted : CaptureRequest
    stop : threading.Event
    tell, show : callable
        See :class:`.recorder.Recorder`.
    ready : callable
        Takes the name of the port once it is open.
    waiting : callable
        Takes what is wrong with a port that is waited for.

    Raises
    ------
    LocatkError
        Something is wrong with what is wanted, an artifact, the output or the port; nothing
        was written then.
    """
    _check_name(wanted.device_name)
    content = _artifacts(wanted)
    check_outputs(
        wanted.output,
        numbered=wanted.numbered,
        overwrite=wanted.overwrite,
        inputs=[*wanted.artifacts, *_played(wanted.port)],
    )
    _check_disk(wanted.output.parent, wanted.limits.reserve_bytes)
    clock = HostClock()
    intake = _intake(wanted, content)
    port = _port(wanted, clock)
    link = _opened(port, wanted.wait_s, stop, waiting)
    try:
        ready(port.name)
        facts = _facts(wanted, port, clock)
        parts = RecordingFiles(
            wanted.output,
            FileContent(facts, content, intake.declared),
            numbered=wanted.numbered,
            overwrite=wanted.overwrite,
        )
    except BaseException:
        link.close()
        raise
    receiver = PortReader(port, link, clock)
    recorder = Recorder(receiver, intake, parts, clock, wanted.limits, tell=tell, show=show)
    return recorder.run(stop)


def _artifacts(wanted: CaptureRequest) -> dict[str, str]:
    """What goes into the session: of what is played what that holds, and what is given."""
    played: dict[str, str] = {}
    for path in _played(wanted.port):
        with contextlib.suppress(LocatkError):  # none, or no session: the port will say
            played |= artifacts.attachments([path])
    return {**played, **artifacts.attachments(wanted.artifacts)}


def _opened(
    port: Port, wait_s: float, stop: threading.Event, waiting: Callable[[str], None]
) -> Link:
    """Open a port, which may not be there for another ``wait_s``."""
    until = time.monotonic() + wait_s
    told = False
    while True:
        try:
            return port.open()
        except SourceError as error:
            if time.monotonic() >= until:
                raise
            if not told:
                waiting(str(error))
            told = True
            if stop.wait(BACKOFF_S[1]):
                raise


def _played(port: str) -> list[Path]:
    """The file that is played, whatever topic of it."""
    if not port.startswith(replay.PREFIX):
        return []
    place = port.removeprefix(replay.PREFIX).removeprefix("//")
    return [Path(place), Path(place.rpartition("#")[0] or place)]


def _check_name(name: str) -> None:
    if not name or any(c.isspace() or c == "/" for c in name):
        raise InputError(f"the name {name!r} cannot be in a topic", hint="Use letters and digits")


def _check_disk(folder: Path, reserve: int) -> None:
    """Refuse a folder that cannot be written, or a disk that is full already."""
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise LocatkError(
            f"cannot write: {error.strerror or error}",
            file=folder,
            hint="Choose another -o",
        ) from error
    free = shutil.disk_usage(folder).free
    if free <= reserve:
        raise DiskFullError(
            f"only {free / 1e6:.0f} MB are free on the disk",
            file=folder,
            hint=f"Free some space, or choose a --reserve below {reserve / 1e6:.0f} MB",
        )


def _intake(wanted: CaptureRequest, content: Mapping[str, str]) -> Intake:
    if wanted.is_camera:
        if wanted.device != AUTO:
            raise InputError(
                f"a camera is no {wanted.device}", hint="Leave out --device for a camera"
            )
        return CameraIntake(wanted.device_name, wanted.image)
    return SerialIntake(
        wanted.device_name,
        wanted.port,
        wanted.device,
        Options(columns=wanted.columns),
        baud=wanted.baud,
        artifacts=content,
    )


def _port(wanted: CaptureRequest, clock: HostClock) -> Port:
    if wanted.is_camera:
        from locatk.formats.capture import camera  # OpenCV, which bytes do not need

        return camera.port_of(
            wanted.port.removeprefix(CAMERA),
            clock=clock.now,
            speed=wanted.speed,
            format=wanted.image,
        )
    known = None if wanted.device == AUTO else find_device(wanted.device)
    baud = wanted.baud or (known.baud if known else 115_200)
    return ports.port_of(wanted.port, baud=baud, speed=wanted.speed)


def _facts(wanted: CaptureRequest, port: Port, clock: HostClock) -> dict[str, str]:
    """What is known at the start, for the metadata record ``capture``."""
    known = {} if wanted.is_camera or wanted.device == AUTO else {"device": wanted.device}
    return {
        **port.describe(),
        "port": wanted.port,
        **known,
        "name": wanted.device_name,
        "started_ns": str(clock.now()),
        "host": platform.node(),
        "clock": "host, steady, set once from the wall clock",
        **({"note": wanted.note} if wanted.note else {}),
        **{f"meta:{key}": value for key, value in wanted.meta.items()},
    }
