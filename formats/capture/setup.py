"""Start of a recording: checks of the request, opening of the port, first byte of the file."""

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
from locatk.formats.capture import ports, replay
from locatk.formats.capture.attachments import attachments
from locatk.formats.capture.clocks import HostClock
from locatk.formats.capture.ingestion import (
    AUTO,
    CameraIntake,
    Intake,
    SerialIntake,
    StampedMessage,
)
from locatk.formats.capture.links import Link, Port, SourceError
from locatk.formats.capture.reader_thread import BACKOFF_S, PortReader
from locatk.formats.capture.recorder import Limits, Recorder
from locatk.formats.capture.recording_files import (
    DiskFullError,
    FileContent,
    RecordingFiles,
    check_outputs,
)
from locatk.formats.capture.status import CaptureStatus, RecordingResult
from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Options

CAMERA = "camera:"
NAME, CAMERA_NAME = "robot", "camera"


@dataclass(frozen=True)
class CaptureRequest:
    """Options of ``locatk capture``, and of an input of ``locatk live``.

    Attributes
    ----------
    output : Path or None
        None if nothing is recorded.
    keeps_time : bool
        A replayed session has the times of its recording, instead of those of the replay.
    """

    port: str
    device: str
    output: Path | None
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
    keeps_time: bool = False

    @property
    def is_camera(self) -> bool:
        """Return whether frames are recorded instead of bytes."""
        return self.port.startswith(CAMERA)

    @property
    def device_name(self) -> str:
        """Name of the device in the session."""
        return self.name or (CAMERA_NAME if self.is_camera else NAME)

    @property
    def numbered(self) -> bool:
        """Return whether there may be several files."""
        return self.limits.rotate_s is not None or self.limits.rotate_bytes is not None


def record(
    request: CaptureRequest,
    stop: threading.Event,
    *,
    tell: Callable[[str], None] = lambda text: None,
    show: Callable[[CaptureStatus], None] = lambda status: None,
    ready: Callable[[str], None] = lambda port: None,
    waiting: Callable[[str], None] = lambda port: None,
    observe: Callable[[StampedMessage], None] | None = None,
) -> RecordingResult:
    """Record until ``stop`` is set, a limit is reached or the source ends.

    Parameters
    ----------
    request : CaptureRequest
    stop : threading.Event
    tell, show, observe : callable
        See :class:`.recorder.Recorder`.
    ready : callable
        Takes the name of the port once it is open.
    waiting : callable
        Takes the error of a port that is not yet available.

    Raises
    ------
    LocatkError
        The request, an artifact, the output or the port is invalid; no file was written.
    """
    clock = HostClock()
    source = open_source(request, clock, stop, waiting=waiting)
    try:
        ready(source.port.name)
        files = create_files(request, source, clock)
    except BaseException:
        source.link.close()
        raise
    reader = PortReader(source.port, source.link, clock)
    recorder = Recorder(
        reader, source.intake, files, clock, request.limits, tell=tell, show=show, observe=observe
    )
    return recorder.run(stop)


@dataclass(frozen=True)
class OpenSource:
    """Open port of a request, before its first byte.

    Attributes
    ----------
    port : Port
    link : Link
        To be closed, or given to a reader.
    intake : Intake
    artifacts : dict of str to str
        Attachments, name to text.
    """

    port: Port
    link: Link
    intake: Intake
    artifacts: dict[str, str]


def open_source(
    request: CaptureRequest,
    clock: HostClock,
    stop: threading.Event,
    *,
    waiting: Callable[[str], None] = lambda port: None,
) -> OpenSource:
    """Check a request and open its port.

    Raises
    ------
    LocatkError
        As :func:`record`.
    """
    content = check_request(request)
    intake = create_intake(request, content)
    port = _port(request, clock, stop)
    return OpenSource(port, _open_port(port, request.wait_s, stop, waiting), intake, content)


def check_request(request: CaptureRequest) -> dict[str, str]:
    """Check name, output and artifacts of a request; return its attachments, name to text.

    Raises
    ------
    LocatkError
        One of them is invalid.
    """
    _check_name(request.device_name)
    content = _artifacts(request)
    if request.output is not None:
        check_outputs(
            request.output,
            numbered=request.numbered,
            overwrite=request.overwrite,
            inputs=[*request.artifacts, *_replayed_paths(request.port)],
        )
        _check_disk(request.output.parent, request.limits.reserve_bytes)
    return content


def create_files(request: CaptureRequest, source: OpenSource, clock: HostClock) -> RecordingFiles:
    """Create the file of a recording; ``request`` has an output.

    Raises
    ------
    LocatkError
        See :class:`.recording_files.LiveFile`.
    """
    assert request.output is not None
    return RecordingFiles(
        request.output,
        FileContent(_facts(request, source.port, clock), source.artifacts, source.intake.declared),
        numbered=request.numbered,
        overwrite=request.overwrite,
    )


def _artifacts(request: CaptureRequest) -> dict[str, str]:
    """Return the attachments: those of a replayed session, and those given."""
    replayed: dict[str, str] = {}
    for path in _replayed_paths(request.port):
        # Not a session, or one without artifacts: opening the port reports it.
        with contextlib.suppress(LocatkError):
            replayed |= attachments([path])
    return {**replayed, **attachments(request.artifacts)}


def _open_port(
    port: Port, wait_s: float, stop: threading.Event, waiting: Callable[[str], None]
) -> Link:
    """Open a port, and retry for up to ``wait_s``."""
    until = time.monotonic() + wait_s
    is_reported = False
    while True:
        try:
            return port.open()
        except SourceError as error:
            if time.monotonic() >= until:
                raise
            if not is_reported:
                waiting(str(error))
            is_reported = True
            if stop.wait(BACKOFF_S[1]):
                raise


def _replayed_paths(port: str) -> list[Path]:
    """Return the possible paths of a replayed file, with and without a topic."""
    prefix = next((each for each in (replay.PREFIX, CAMERA) if port.startswith(each)), None)
    source = port.removeprefix(prefix or "").removeprefix("//")
    is_session = ".mcap" in source.lower()
    if prefix is None or (prefix == CAMERA and not is_session):
        return []
    return [Path(source), Path(source.rpartition("#")[0] or source)]


def _check_name(name: str) -> None:
    if not name or any(c.isspace() or c == "/" for c in name):
        raise InputError(
            f"the name {name!r} cannot be part of a topic", hint="Use letters and digits"
        )


def _check_disk(folder: Path, reserve: int) -> None:
    """Refuse a folder that cannot be written, or a full disk."""
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
            f"only {free / 1e6:.0f} MB of the disk are free",
            file=folder,
            hint=f"Free some space, or reduce --reserve below {free / 1e6:.0f} MB",
        )


def create_intake(
    request: CaptureRequest, content: Mapping[str, str]
) -> SerialIntake | CameraIntake:
    """Return the conversion of received data to messages.

    Raises
    ------
    InputError
        There is no such device.
    """
    if request.is_camera:
        if request.device != AUTO:
            raise InputError(
                f"a camera is not a {request.device}", hint="Omit --device for a camera"
            )
        return CameraIntake(request.device_name, request.image)
    return SerialIntake(
        request.device_name,
        request.port,
        request.device,
        Options(columns=request.columns),
        baud=request.baud,
        artifacts=content,
    )


def _port(request: CaptureRequest, clock: HostClock, stop: threading.Event) -> Port:
    if request.is_camera:
        # OpenCV is slow to import, and not needed for bytes.
        from locatk.formats.capture.camera import camera_port
        from locatk.formats.capture.session_frames import SessionFramesPort

        address = request.port.removeprefix(CAMERA)
        if is_session_address(address):
            return SessionFramesPort(address, speed=request.speed)
        return camera_port(
            address,
            clock=clock.now,
            speed=request.speed,
            format=request.image,
        )
    known = None if request.device == AUTO else find_device(request.device)
    baud = request.baud or (known.baud if known else 115_200)
    return ports.port_of(
        request.port,
        baud=baud,
        speed=request.speed,
        keeps_time=request.keeps_time,
        stop=stop,
    )


def is_session_address(address: str) -> bool:
    """Return whether the address of a camera is a session with its frames."""
    return address.lower().endswith(".mcap") or ".mcap#/" in address.lower()


def _facts(request: CaptureRequest, port: Port, clock: HostClock) -> dict[str, str]:
    """Return the entries of the metadata record ``capture`` that are known at the start."""
    known = {} if request.is_camera or request.device == AUTO else {"device": request.device}
    return {
        **port.describe(),
        "port": request.port,
        **known,
        "name": request.device_name,
        "started_ns": str(clock.now()),
        "host": platform.node(),
        "clock": "host, steady, set once from the wall clock",
        **({"note": request.note} if request.note else {}),
        **{f"meta:{key}": value for key, value in request.meta.items()},
    }
