"""Camera frames in sessions: written as they come, read one by one when they are asked for.

Image files that viewers show (PNG, JPEG, WebP) are kept byte by byte as
``foxglove.CompressedImage``; everything else becomes ``foxglove.RawImage``, which the chunks
of a session pack with zstd. Of frames of dots that takes as much room as PNG (0.67 to 0.76
of the pixels with noise, PNG 0.74 to 0.80) and is read six times as fast (0.04 to 0.05 ms a
frame of 188 x 120 px, PNG 0.25 ms).
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, overload

import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from locatk.core.dots.camera import Camera
from locatk.core.dots.frames import Frames
from locatk.core.dots.sheet import Manifest
from locatk.core.errors import FormatError, InputError
from locatk.core.trajectory import Trajectory
from locatk.formats import images
from locatk.formats.artifacts import sheets
from locatk.formats.sessions.mcap_file import MessagePosition
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import RandomAccess, Session
from locatk.formats.sessions.trajectories import (
    Timed,
    check_devices,
    truth_messages,
    write_streams,
    write_warnings,
)
from locatk.formats.sessions.writer import SessionWriter

FRAMES_FILE = "frames.json"
"""Name of the attachment that holds the names of the frames, where they have names."""

FRAMES_VERSION = 1

TOPIC = "/camera/"

SCHEMAS = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
}

LARGEST_MODEL_ERROR_PX = 0.1
"""Where the usual polynomial misses the camera's own model by more, it is not written."""


@dataclass(frozen=True)
class Shot:
    """One frame on its way into a session.

    Attributes
    ----------
    time_ns : int
        Nanoseconds since the epoch.
    name : str
        Of the file it came from, or its number.
    image : bytes or ndarray
        An image file of ``format``, or pixels as in :class:`locatk.formats.images.Picture`.
    format : str
        ``"png"``, ``"jpeg"`` or ``"webp"``; ``""`` for pixels.
    """

    time_ns: int
    name: str
    image: bytes | NDArray[Any]
    format: str = ""


def read_frames(session: Session) -> list[Frames]:
    """The frames of all cameras of a session, one ``Frames`` a camera, sorted by device.

    No image is read yet: ``images[i]`` does that, and raises InputError where it cannot.
    Frames come in the order of their log times.

    Raises
    ------
    FormatError
        There are none, or the session is damaged.
    """
    topics = [topic for schema in SCHEMAS for topic in session.topics(TOPIC, schema)]
    if not topics:
        raise FormatError(
            f"no camera frames (topic {TOPIC}<device>)"
            if session.facts
            else f"not a session of locatk: no topic {TOPIC}<device>",
            file=session.path,
            hint="Make one with `locatk import images` or `locatk import video`",
        )
    names = _names(session)
    places = RandomAccess(session)
    return [_camera_frames(session, places, topic, names) for topic in sorted(topics)]


def _camera_frames(
    session: Session, places: RandomAccess, topic: str, names: Mapping[str, tuple[str, ...]]
) -> Frames:
    device = topic.removeprefix(TOPIC)
    found = sorted(places.positions(topic), key=lambda place: place.time_ns)
    own = names.get(device)
    if own is not None and len(own) != len(found):
        raise FormatError(
            f"{len(own)} names for {len(found)} frames of {device}",
            file=session.path,
            where=FRAMES_FILE,
        )
    numbered = own or tuple(str(number) for number in range(len(found)))
    return Frames(
        device=device,
        time_ns=np.array([place.time_ns for place in found], np.int64),
        names=numbered,
        images=_Images(session, places, topic, found, numbered),
    )


def _names(session: Session) -> dict[str, tuple[str, ...]]:
    data = session.attachment(FRAMES_FILE)
    if data is None:
        return {}
    try:
        said = json.loads(data)
        newer = said["version"] > FRAMES_VERSION
        names = {str(key): tuple(map(str, value)) for key, value in said["names"].items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise FormatError("damaged names", file=session.path, where=FRAMES_FILE) from None
    if newer:
        raise FormatError(
            f"names of format {said['version']}, newer than this locatk",
            file=session.path,
            where=FRAMES_FILE,
            hint="Update locatk",
        )
    return names


class _Images(Sequence[NDArray[np.uint8]]):
    """Images of one camera, each read from the session when it is asked for."""

    def __init__(
        self,
        session: Session,
        places: RandomAccess,
        topic: str,
        found: Sequence[MessagePosition],
        names: Sequence[str],
    ) -> None:
        self._session = session
        self._places = places
        self._topic = topic
        self._found = found
        self._names = names
        schemas = {channel.topic: channel.schema for channel in session.channels}
        self._compressed = schemas[topic] == CompressedImage.DESCRIPTOR.full_name

    def __len__(self) -> int:
        return len(self._found)

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> _Images: ...

    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | _Images:
        if isinstance(index, slice):
            found, names = self._found[index], self._names[index]
            return _Images(self._session, self._places, self._topic, found, names)
        payload = self._places.payload(self._found[index])
        try:
            return self._decoded(payload)
        except InputError as error:
            raise InputError(
                f"frame {self._names[index]}: {error.message}",
                file=self._session.path,
                where=self._topic,
            ) from None

    def _decoded(self, payload: bytes) -> NDArray[np.uint8]:
        try:
            if self._compressed:
                data = CompressedImage.FromString(payload).data
                return images.grey(images.decode(data).pixels)
            raw = RawImage.FromString(payload)
        except DecodeError:
            raise InputError("the message is damaged") from None
        return images.raw_grey(raw.data, raw.width, raw.height, raw.step, raw.encoding)


def write_session(
    path: str | os.PathLike[str],
    frames: Sequence[Frames],
    manifest: Manifest,
    *,
    camera: Camera | None = None,
    truth: Sequence[Trajectory] = (),
    facts: Mapping[str, object] | None = None,
    overwrite: bool = False,
) -> None:
    """Write frames, the sheet they show and what is known beside them as a session.

    Parameters
    ----------
    path : path
        The output.
    frames : sequence of Frames
        One a camera. Their images are asked for one by one and written raw.
    manifest : Manifest
        Attached as ``sheet.toml``.
    camera : Camera, optional
        Attached as ``camera.toml``; for viewers on ``/calibration/<device>`` too.
    truth : sequence of Trajectory
        As in :func:`locatk.formats.sessions.observations.write_session`.
    facts : mapping, optional
        Written as texts to the metadata record ``facts``.
    overwrite : bool
        Replace an existing file.

    Raises
    ------
    OutputExistsError, MissingDataError
        See :func:`locatk.formats.output.atomic_write`.
    InputError
        There is no frame, times do not ascend or are before 1970, an image is no grey
        picture, or two cameras or trajectories have the same name.
    """
    devices = [each.device for each in frames]
    for name in devices:
        if devices.count(name) > 1:
            raise InputError(f"two cameras have the name {name!r}")
    write_shots(
        path,
        {each.device: _shots(each) for each in frames},
        manifest=manifest,
        camera=camera,
        truth=truth,
        facts=facts,
        overwrite=overwrite,
    )


def _shots(frames: Frames) -> Iterator[Shot]:
    rows = zip(frames.time_ns.tolist(), frames.names, frames.images, strict=True)
    for time_ns, name, image in rows:
        yield Shot(time_ns, name, image)


def write_shots(
    path: str | os.PathLike[str],
    cameras: Mapping[str, Iterable[Shot]],
    *,
    manifest: Manifest | None = None,
    camera: Camera | None = None,
    truth: Sequence[Trajectory] = (),
    facts: Mapping[str, object] | None = None,
    warnings: Sequence[str] = (),
    overwrite: bool = False,
) -> dict[str, int]:
    """Write frames as they come; returns how many there were of each device.

    Parameters as of :func:`write_session`, but ``cameras`` maps a device to its frames in
    the order of time, all of them pixels or all of them image files. ``warnings`` are
    written to ``/log`` at the end, when the frames have been taken: whoever makes the
    frames may add to it.

    Raises
    ------
    OutputExistsError, MissingDataError, InputError
        As :func:`write_session`.
    """
    check_devices(truth, "truth")
    names: dict[str, list[str]] = {device: [] for device in cameras}
    with SessionWriter(path, system="dots", overwrite=overwrite) as writer:
        writer.facts(facts)
        if manifest is not None:
            writer.attach_toml(sheets.SHEET_FILE, sheets.dumps_manifest(manifest))
        if camera is not None:
            writer.attach_toml(sheets.CAMERA_FILE, sheets.dumps_camera(camera))
        streams = [
            _frame_messages(device, shots, camera, names[device])
            for device, shots in cameras.items()
        ]
        end_ns = write_streams(writer, [*streams, *truth_messages(truth)])
        counts = {device: len(found) for device, found in names.items()}
        if not any(counts.values()):
            raise InputError("no camera frame at all")
        write_warnings(writer, warnings, end_ns)
        # Frames that are called by their number need no list that says so.
        own = {
            device: found
            for device, found in names.items()
            if any(name != str(number) for number, name in enumerate(found))
        }
        if own:
            said = {"version": FRAMES_VERSION, "names": own}
            writer.attach(FRAMES_FILE, json.dumps(said, indent=0).encode(), "application/json")
    return counts


def _frame_messages(
    device: str, shots: Iterable[Shot], camera: Camera | None, names: list[str]
) -> Iterator[Timed]:
    """Messages of one camera; adds the frames' names to ``names``."""
    before: int | None = None
    for shot in shots:
        if before is None and camera is not None:
            calibration = _calibration(camera, device, shot.time_ns)
            if calibration is not None:
                yield shot.time_ns, f"/calibration/{device}", calibration
        if before is not None and shot.time_ns < before:
            raise InputError(f"frame {shot.name} of {device} is older than the one before it")
        before = shot.time_ns
        names.append(shot.name)
        yield shot.time_ns, f"{TOPIC}{device}", _image_message(shot, device)


def _image_message(shot: Shot, device: str) -> CompressedImage | RawImage:
    if isinstance(shot.image, bytes):
        return CompressedImage(
            timestamp=timestamp(shot.time_ns),
            frame_id=device,
            data=shot.image,
            format=shot.format,
        )
    pixels = shot.image
    fits = (pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16)) or (
        pixels.ndim == 3 and pixels.shape[2] in (3, 4) and pixels.dtype == np.uint8
    )
    if not fits or 0 in pixels.shape:
        raise InputError(
            f"frame {shot.name} of {device} has {pixels.dtype} values of shape {pixels.shape}"
        )
    data = pixels.astype(pixels.dtype.newbyteorder("<"), copy=False).tobytes()
    return RawImage(
        timestamp=timestamp(shot.time_ns),
        frame_id=device,
        width=pixels.shape[1],
        height=pixels.shape[0],
        encoding=images.raw_encoding(pixels),
        step=len(data) // pixels.shape[0],
        data=data,
    )


def _calibration(camera: Camera, device: str, time_ns: int) -> CameraCalibration | None:
    """The camera as viewers know it, None where their polynomial cannot say what it does.

    A point without distortion at radius u is seen at ``u C(k u^2)``, where C generates the
    Catalan numbers: 1, k, 2 k^2, 5 k^3 are the first coefficients of the polynomial.
    """
    k = camera.radial
    coefficients = (k, 2 * k**2, 0.0, 0.0, 5 * k**3)
    (width, height), (x, y), focal = camera.size, camera.centre_px, camera.focal_px
    corners = np.array([(a, b) for a in (0, width - 1) for b in (0, height - 1)], float)
    flat = (camera.undistort(corners) - (x, y)) / focal
    square = (flat * flat).sum(axis=1, keepdims=True)
    k1, k2, _, _, k3 = coefficients
    bent = (x, y) + focal * flat * (1 + square * (k1 + square * (k2 + square * k3)))
    if not np.abs(bent - corners).max() <= LARGEST_MODEL_ERROR_PX:
        return None
    return CameraCalibration(
        timestamp=timestamp(time_ns),
        frame_id=device,
        width=width,
        height=height,
        distortion_model="plumb_bob",
        D=coefficients,
        K=(focal, 0, x, 0, focal, y, 0, 0, 1),
        R=(1, 0, 0, 0, 1, 0, 0, 0, 1),
        P=(focal, 0, x, 0, 0, focal, y, 0, 0, 0, 1, 0),
    )
