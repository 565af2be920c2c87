"""What a device would send of a session: the bytes as they were recorded, or made again."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from math import radians

from google.protobuf.message import DecodeError

from locatk.core.errors import FormatError, InputError, error_context
from locatk.formats.capture.statistics import RECORD
from locatk.formats.devices import Device, find_device
from locatk.formats.devices.decoder import Recording
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import halls, observations
from locatk.formats.sessions import magnetometers as arrays
from locatk.formats.sessions.observations import (
    read_halls,
    read_odometry,
    read_samples,
    read_sweeps,
)
from locatk.formats.sessions.reader import Session

RAW = "raw"
"""The device whose bytes are kept as they are."""

SWEEPS = ("/lighthouse/", "locatk.LighthouseSweep")
"""Topic and schema."""


@dataclass(frozen=True)
class Source:
    """Something to send.

    Attributes
    ----------
    device : str
        Which device sends it.
    recorded : bool
        Whether the bytes are those that were recorded.
    packets : callable
        Gives (time in ns, bytes) from the start, each time it is called.
    """

    device: str
    recorded: bool
    packets: Callable[[], Iterator[tuple[int, bytes]]]


def source_of(session: Session, name: str | None = None) -> Source:
    """What the device ``name`` would send of a session.

    Recorded bytes of this device are taken as they are; else the decoded streams are
    encoded. Without a name it is the device that recorded the session, or one whose bytes
    such a session can come from.

    Raises
    ------
    InputError
        There is no such device, or it sends nothing that the session holds.
    FormatError
        A stream of the session is damaged.
    """
    by = session.metadata().get(RECORD, {}).get("device") or None
    wanted = name or by or _usual(session)
    sender = find_device(wanted)
    topics = session.topics("/", SerialChunk.DESCRIPTOR.full_name)
    if topics and wanted in (RAW, by or wanted):
        if len(topics) > 1:
            raise InputError(
                f"raw bytes of {len(topics)} ports",
                file=session.path,
                hint="Give a session of one port",
            )
        return Source(wanted, True, partial(_chunks, session, topics[0]))
    if not sender.encoder:
        raise InputError(
            f"nothing that the device {wanted!r} sends",
            file=session.path,
            hint="Name another --device",
        )
    return Source(wanted, False, partial(_encoded, session, sender, _recording(session)))


def _chunks(session: Session, topic: str) -> Iterator[tuple[int, bytes]]:
    """Bytes of a session, read by read, at the times of the reads."""
    for _, time_ns, payload in session.messages([topic]):
        try:
            yield time_ns, SerialChunk.FromString(payload).data
        except DecodeError:
            raise FormatError("a message is damaged", file=session.path, where=topic) from None


def _encoded(session: Session, sender: Device, recording: Recording) -> Iterator[tuple[int, bytes]]:
    """Bytes that a device makes of observations."""
    with error_context(session.path):
        yield from sender.encode(recording)


def _usual(session: Session) -> str:
    """A device that sends what the session holds, by its name."""
    if session.topics("/", SerialChunk.DESCRIPTOR.full_name):
        return RAW
    if session.topics(arrays.TOPIC, arrays.SCHEMA):
        return "polaris-array"
    if session.topics(*SWEEPS):
        return "dotbot-gateway"
    return "locatk"


def _recording(session: Session) -> Recording:
    """The observations of a session, of whichever kinds it holds."""
    found = Recording(
        samples=read_samples(session) if session.topics(arrays.TOPIC, arrays.SCHEMA) else (),
        halls=read_halls(session) if session.topics(halls.TOPIC, halls.SCHEMA) else (),
        sweeps=read_sweeps(session) if session.topics(*SWEEPS) else None,
        odometry=read_odometry(session),
    )
    if not (found.samples or found.halls or found.sweeps or found.odometry):
        raise InputError(
            "nothing that comes over a serial port",
            file=session.path,
            hint="Of images make a video; `locatk capture camera:FILE` takes it"
            if session.topics("/", "foxglove.CompressedImage")
            else "Give a session of magnetometers, hall sensors, sweeps or odometry",
        )
    return found


IDS = (262_143, 77, 123_456)
"""Tags over which the bar drives."""


def simulate_session(
    system: str, path: str | os.PathLike[str], *, seed: int = 0, overwrite: bool = False
) -> None:
    """Write a session of a system, with its artifacts and its truth.

    Parameters
    ----------
    system : str
        One of :data:`SYSTEMS`.
    path : path
        The output.
    seed : int
        The same gives the same session.
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
            f"no serial port on a device of {system}",
            hint="Record its camera with `locatk capture camera:VIDEO`",
        )
    SYSTEMS[system](path, seed, overwrite)


def _polaris(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """The paper's bar over three tags, from rest."""
    from locatk.core.polaris.simulation.session import SimulationOptions, simulate
    from locatk.core.polaris.tag import PlanarPose, Tags

    places = enumerate(zip(IDS, (0.0, 90.0, 200.0), strict=True))
    site = {number: PlanarPose(0.5 * k, 0.02 * k, radians(turn)) for k, (number, turn) in places}
    tags = Tags(codec="polaris-released", site=site)
    simulated = simulate(tags, SimulationOptions(route=IDS, rest_s=1.0, odometry=True, seed=seed))
    arrays.write_session(
        path,
        [simulated.samples],
        tags=tags,
        truth=(simulated.truth,),
        odometry=(simulated.odometry,) if simulated.odometry else (),
        overwrite=overwrite,
    )


def _landmarks(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """The paper's robot on a floor of 6 x 8 landmarks, of which it visits enough to be sure
    where it is."""
    from locatk.core.landmarks.design.generation import DesignOptions, design_map
    from locatk.core.landmarks.simulation.session import SimulationOptions, simulate

    floor = design_map(DesignOptions(rows=6, columns=8, seed=seed))
    simulated = simulate(floor, SimulationOptions(landmarks=6, seed=seed))
    halls.write_session(
        path,
        simulated.samples,
        floor=floor,
        truth=simulated.truth,
        odometry=simulated.odometry,
        overwrite=overwrite,
    )


def _lighthouse(path: str | os.PathLike[str], seed: int, overwrite: bool) -> None:
    """Two robots under two stations."""
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
"""Those whose devices have a serial port."""
