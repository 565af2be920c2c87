"""Bytes that an emulated device sends: recorded, encoded from a session, or simulated."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import radians

from google.protobuf.message import DecodeError

from locatk.core.errors import FormatError, InputError, error_context
from locatk.formats.devices import Device, find_device
from locatk.formats.devices.interface import Recording
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import field_samples, observations
from locatk.formats.sessions.mcap_file import CAPTURE_RECORD
from locatk.formats.sessions.reader import Session

RAW = "raw"
"""Device whose bytes are stored without decoding."""

SWEEPS = (observations.SWEEP_TOPIC_PREFIX, "locatk.LighthouseSweep")
"""Topic and schema."""


@dataclass(frozen=True)
class ByteSource:
    """Bytes of a device.

    Attributes
    ----------
    device : str
        Name of the device.
    recorded : bool
        The bytes are those of the recording.
    packets : callable
        Returns (time in ns, bytes) from the start, at each call.
    """

    device: str
    recorded: bool
    packets: Callable[[], Iterator[tuple[int, bytes]]]


def select_source(session: Session, name: str | None = None) -> ByteSource:
    """Return the bytes that the device ``name`` would send of a session.

    Recorded bytes of this device are used unchanged; otherwise the decoded streams are encoded.
    The default device is the one that recorded the session, or one that sends such streams.

    Raises
    ------
    InputError
        There is no such device, or it sends nothing that the session contains.
    FormatError
        A stream of the session is damaged.
    """
    recorded_by = session.metadata().get(CAPTURE_RECORD, {}).get("device") or None
    wanted = name or recorded_by or _default_device(session)
    device = find_device(wanted)
    topics = session.topics("/", SerialChunk.DESCRIPTOR.full_name)
    if topics and wanted in (RAW, recorded_by or wanted):
        if len(topics) > 1:
            raise InputError(
                f"raw bytes of {len(topics)} ports",
                file=session.path,
                hint="Give a session of one port",
            )
        return ByteSource(wanted, True, partial(_recorded_packets, session, topics[0]))
    if not device.encoder:
        raise InputError(
            f"no data that the device {wanted!r} sends",
            file=session.path,
            hint="Give another --device",
        )
    return ByteSource(
        wanted, False, partial(_encoded_packets, session, device, _read_recording(session))
    )


def replayed_source(session: Session) -> ByteSource:
    """Return the bytes that a replay of a session consists of.

    They are those of :func:`select_source`, but a magnetometer array with odometry is encoded as
    the device that sends both.

    Raises
    ------
    InputError, FormatError
        See :func:`select_source`.
    """
    has_odometry = bool(session.topics("/odometry/", "locatk.Odometry"))
    is_array = _default_device(session) == "polaris-array"
    return select_source(session, "locatk" if is_array and has_odometry else None)


def _recorded_packets(session: Session, topic: str) -> Iterator[tuple[int, bytes]]:
    """Yield the bytes of each read of a recording, with its time."""
    for _, time_ns, payload in session.messages([topic]):
        try:
            yield time_ns, SerialChunk.FromString(payload).data
        except DecodeError:
            raise FormatError("a message is damaged", file=session.path, where=topic) from None


def _encoded_packets(
    session: Session, device: Device, recording: Recording
) -> Iterator[tuple[int, bytes]]:
    """Yield the bytes that a device makes of observations."""
    with error_context(session.path):
        yield from device.encode(recording)


def _default_device(session: Session) -> str:
    """Return the name of a device that sends the streams of the session."""
    if session.topics("/", SerialChunk.DESCRIPTOR.full_name):
        return RAW
    if field_samples.MAGNETOMETERS.topics(session):
        return "polaris-array"
    if session.topics(*SWEEPS):
        return "dotbot-gateway"
    return "locatk"


def _read_recording(session: Session) -> Recording:
    """Return the observations of a session."""
    recording = Recording(
        samples=observations.read_magnetometers(session)
        if field_samples.MAGNETOMETERS.topics(session)
        else (),
        halls=observations.read_halls(session) if field_samples.HALLS.topics(session) else (),
        sweeps=observations.read_sweeps(session) if session.topics(*SWEEPS) else None,
        odometry=observations.read_odometry(session),
    )
    if not (recording.samples or recording.halls or recording.sweeps or recording.odometry):
        raise InputError(
            "no data that a serial device sends",
            file=session.path,
            hint="Convert the images to a video and use `locatk capture camera:FILE`"
            if session.topics("/", "foxglove.CompressedImage")
            else "Give a session of magnetometers, hall sensors, sweeps or odometry",
        )
    return recording


TAG_IDS = (262_143, 77, 123_456)
"""Tags on the route of the magnetometer bar."""


def write_simulated_session(
    system: str, path: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> None:
    """Write a simulated session of a system, with its artifacts and its truth.

    Parameters
    ----------
    system : str
        One of :data:`SYSTEMS`.
    path : path
        Output.
    seed : int
        Seed of the simulator.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    InputError
        The devices of this system have no serial port.
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    """
    if system not in SYSTEMS:
        raise InputError(
            f"the devices of {system} have no serial port",
            hint="Record its camera with `locatk capture camera:VIDEO`",
        )
    SYSTEMS[system](path, seed, overwrite)


# The functions import the simulators, because recordings are emulated without them, and that of
# polaris takes 0.35 s to import, as long as everything else.


def _polaris(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """Simulate the paper's bar over three tags, starting at rest."""
    from locatk.core.polaris.simulation.session import SimulationOptions, simulate
    from locatk.core.polaris.tag import PlanarPose, Tags

    poses = enumerate(zip(TAG_IDS, (0.0, 90.0, 200.0), strict=True))
    site = {tag: PlanarPose(0.5 * k, 0.02 * k, radians(deg)) for k, (tag, deg) in poses}
    tags = Tags(codec="polaris-released", site=site)
    simulated = simulate(
        tags, SimulationOptions(route=TAG_IDS, rest_s=1.0, odometry=True, seed=seed)
    )
    field_samples.write_magnetometers(
        path,
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=(simulated.odometry,) if simulated.odometry else (),
        overwrite=overwrite,
    )


def _landmarks(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """Simulate the paper's robot on a floor of 6 x 8 landmarks, of which it visits six."""
    from locatk.core.landmarks.design.generation import DesignOptions, design_map
    from locatk.core.landmarks.simulation.session import SimulationOptions, simulate

    floor = design_map(DesignOptions(rows=6, columns=8, seed=seed))
    simulated = simulate(floor, SimulationOptions(landmarks=6, seed=seed))
    field_samples.write_halls(
        path,
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        overwrite=overwrite,
    )


def _lighthouse(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """Simulate two robots under two stations."""
    from locatk.core.lighthouse.simulation import SimulationOptions, simulate

    simulated = simulate(SimulationOptions(robots=2, seed=seed))
    observations.write_session(
        path,
        system="lighthouse",
        sweeps=simulated.sweeps,
        scene=simulated.scene,
        truth=simulated.truth,
        overwrite=overwrite,
    )


SYSTEMS: dict[str, Callable[[str | os.PathLike[str], int, bool], None]] = {
    "polaris": _polaris,
    "landmarks": _landmarks,
    "lighthouse": _lighthouse,
}
"""Systems whose devices have a serial port."""
