"""Camera frames in sessions: written one by one, read when they are accessed.

Image files that viewers show (PNG, JPEG, WebP) are stored unchanged as
``foxglove.CompressedImage``. All other images become ``foxglove.RawImage``, compressed with zstd
like everything in a session. Frames of dots then take as much space as PNG (0.67 to 0.76 bytes
per pixel with noise, PNG 0.74 to 0.80) and are read six times as fast (0.04 to 0.05 ms per frame
of 188 x 120 px, PNG 0.25 ms).
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
from locatk.formats.sessions.messages import MessageBatch, timestamp
from locatk.formats.sessions.reader import RandomAccess, Session
from locatk.formats.sessions.trajectories import (
    check_devices,
    truth_messages,
    write_streams,
    write_warnings,
)
from locatk.formats.sessions.writer import SessionWriter

FRAMES_FILE = "frames.json"
"""Attachment with the names of the frames, if they differ from their numbers."""

FRAMES_VERSION = 1

TOPIC = "/camera/"

SCHEMAS = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
}

MAX_MODEL_ERROR_PX = 0.1
"""If the polynomial of viewers differs more from the camera's model, it is not written."""


@dataclass(frozen=True)
class Shot:
    """One frame to be written to a session.

    Attributes
    ----------
    time_ns : int
        Nanoseconds since the epoch.
    name : str
        Name of its file, or its number.
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
    """List the frames of all cameras of a session, sorted by device.

    No image is read: ``images[i]`` does that, and raises InputError if the image is damaged.
    Frames are in the order of their log times.

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
    messages = RandomAccess(session)
    return [_camera_frames(session, messages, topic, names) for topic in sorted(topics)]


def _camera_frames(
    session: Session, messages: RandomAccess, topic: str, names: Mapping[str, tuple[str, ...]]
) -> Frames:
    device = topic.removeprefix(TOPIC)
    positions = sorted(messages.positions(topic), key=lambda position: position.time_ns)
    frame_names = names.get(device, tuple(map(str, range(len(positions)))))
    if len(frame_names) != len(positions):
        raise FormatError(
            f"{len(frame_names)} names for {len(positions)} frames of {device}",
            file=session.path,
            where=FRAMES_FILE,
        )
    return Frames(
        device=device,
        time_ns=np.array([position.time_ns for position in positions], np.int64),
        names=frame_names,
        images=_Images(session, messages, topic, positions, frame_names),
    )


def _names(session: Session) -> dict[str, tuple[str, ...]]:
    data = session.attachment(FRAMES_FILE)
    if data is None:
        return {}
    try:
        record = json.loads(data)
        is_newer = record["version"] > FRAMES_VERSION
        names = {str(key): tuple(map(str, value)) for key, value in record["names"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise FormatError("damaged names", file=session.path, where=FRAMES_FILE) from None
    if is_newer:
        raise FormatError(
            f"names of format {record['version']}, newer than this locatk",
            file=session.path,
            where=FRAMES_FILE,
            hint="Update locatk",
        )
    return names


class _Images(Sequence[NDArray[np.uint8]]):
    """Images of one camera, each read from the session when it is accessed."""

    def __init__(
        self,
        session: Session,
        messages: RandomAccess,
        topic: str,
        positions: Sequence[MessagePosition],
        names: Sequence[str],
    ) -> None:
        self._session = session
        self._messages = messages
        self._topic = topic
        self._positions = positions
        self._names = names
        schemas = {channel.topic: channel.schema for channel in session.channels}
        self._is_compressed = schemas[topic] == CompressedImage.DESCRIPTOR.full_name

    def __len__(self) -> int:
        return len(self._positions)

    @overload
    def __getitem__(self, index: int) -> NDArray[np.uint8]: ...

    @overload
    def __getitem__(self, index: slice) -> _Images: ...

    def __getitem__(self, index: int | slice) -> NDArray[np.uint8] | _Images:
        if isinstance(index, slice):
            positions, names = self._positions[index], self._names[index]
            return _Images(self._session, self._messages, self._topic, positions, names)
        payload = self._messages.payload(self._positions[index])
        try:
            return self._decode(payload)
        except InputError as error:
            raise InputError(
                f"frame {self._names[index]}: {error.message}",
                file=self._session.path,
                where=self._topic,
            ) from None

    def _decode(self, payload: bytes) -> NDArray[np.uint8]:
        try:
            if self._is_compressed:
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
    """Write a session of frames, with the sheet that they show and reference data.

    Parameters
    ----------
    path : path
        The output.
    frames : sequence of Frames
        One per camera. Their images are accessed one by one and written raw.
    manifest : Manifest
        Attached as ``sheet.toml``.
    camera : Camera, optional
        Attached as ``camera.toml``; also written for viewers on ``/calibration/<device>``.
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
        There is no frame, times do not ascend or are before 1970, an image is not grey, or two
        cameras or trajectories have the same name.
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
    """Write frames from iterables; return the number of frames of each device.

    Parameters are those of :func:`write_session`, but ``cameras`` maps a device to its frames in
    the order of time, all of them pixels or all of them image files. ``warnings`` are written to
    ``/log`` at the end, so that an iterable may add to them.

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
        counts = {device: len(frame_names) for device, frame_names in names.items()}
        if not any(counts.values()):
            raise InputError("no camera frame at all")
        write_warnings(writer, warnings, end_ns)
        # Frames whose names are their numbers are not listed.
        listed = {
            device: frame_names
            for device, frame_names in names.items()
            if any(name != str(number) for number, name in enumerate(frame_names))
        }
        if listed:
            record = {"version": FRAMES_VERSION, "names": listed}
            writer.attach(FRAMES_FILE, json.dumps(record, indent=0).encode(), "application/json")
    return counts


def _frame_messages(
    device: str, shots: Iterable[Shot], camera: Camera | None, names: list[str]
) -> Iterator[MessageBatch]:
    """Yield the messages of one camera; append the names of its frames to ``names``."""
    previous_ns: int | None = None
    for shot in shots:
        if previous_ns is None and camera is not None:
            calibration = _calibration(camera, device, shot.time_ns)
            if calibration is not None:
                yield MessageBatch.single(shot.time_ns, f"/calibration/{device}", calibration)
        if previous_ns is not None and shot.time_ns < previous_ns:
            raise InputError(f"frame {shot.name} of {device} is older than the one before it")
        previous_ns = shot.time_ns
        names.append(shot.name)
        message = _image_message(shot, device)
        yield MessageBatch.single(shot.time_ns, f"{TOPIC}{device}", message)


def _image_message(shot: Shot, device: str) -> CompressedImage | RawImage:
    if isinstance(shot.image, bytes):
        return CompressedImage(
            timestamp=timestamp(shot.time_ns),
            frame_id=device,
            data=shot.image,
            format=shot.format,
        )
    pixels = shot.image
    is_supported = (pixels.ndim == 2 and pixels.dtype in (np.uint8, np.uint16)) or (
        pixels.ndim == 3 and pixels.shape[2] in (3, 4) and pixels.dtype == np.uint8
    )
    if not is_supported or 0 in pixels.shape:
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
    """Return the camera in the model of viewers; None if their polynomial cannot represent it.

    A point at undistorted radius u is imaged at radius ``u C(k u^2)``, with the generating
    function C of the Catalan numbers: 1, k, 2 k^2, 5 k^3 are the first coefficients of the
    polynomial.
    """
    k = camera.radial
    coefficients = (k, 2 * k**2, 0.0, 0.0, 5 * k**3)
    (width, height), (x, y), focal = camera.size, camera.centre_px, camera.focal_px
    corners = np.array([(a, b) for a in (0, width - 1) for b in (0, height - 1)], float)
    undistorted = (camera.undistort(corners) - (x, y)) / focal
    radius2 = (undistorted * undistorted).sum(axis=1, keepdims=True)
    k1, k2, _, _, k3 = coefficients
    factor = 1 + radius2 * (k1 + radius2 * (k2 + radius2 * k3))
    distorted = (x, y) + focal * undistorted * factor
    if not np.abs(distorted - corners).max() <= MAX_MODEL_ERROR_PX:
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
