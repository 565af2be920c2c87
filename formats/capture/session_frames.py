"""Port that plays the camera frames of a session: ``camera:FILE.mcap``.

``camera:FILE.mcap#/camera/NAME`` if a session has several cameras. Image files are passed on
unchanged, pixels become PNG files. The frames have the times of the recording.
"""

from __future__ import annotations

import os
from collections.abc import Generator
from typing import Any

from google.protobuf.message import DecodeError

from locatk.core.errors import InputError, LocatkError
from locatk.formats import images
from locatk.formats.capture.camera import Frame
from locatk.formats.capture.links import LinkLost, SourceError
from locatk.formats.capture.replay import ReplayLink
from locatk.formats.sessions.frames import SCHEMAS, TOPIC
from locatk.formats.sessions.reader import Session


class SessionFramesPort:
    """Frames of one camera of a session.

    Parameters
    ----------
    address : str
        ``FILE.mcap``, also with a topic as above.
    speed : float
        Factor on the speed of the recording; 0 is as fast as possible.
    """

    can_reconnect = False
    keeps_time = True

    def __init__(self, address: str, *, speed: float) -> None:
        self.name = f"camera:{address}"
        self._speed = speed
        self._file, self._topic = address, ""
        if "#" in address and not os.path.exists(address):
            self._file, _, self._topic = address.rpartition("#")

    def open(self) -> ReplayLink:
        """Open the session at its first frame; see :class:`.links.Port`."""
        try:
            session = Session.open(self._file)
        except LocatkError as error:
            raise SourceError(
                error.message, file=error.file, where=error.where, hint=error.hint
            ) from None
        topics = {topic: name for name in SCHEMAS for topic in session.topics(TOPIC, name)}
        if not self._topic and len(topics) == 1:
            self._topic = next(iter(topics))
        if self._topic not in topics:
            each = " or ".join(f"camera:{self._file}#{topic}" for topic in sorted(topics))
            raise SourceError(
                f"{len(topics)} cameras" if topics else "no camera frames",
                file=self._file,
                hint=f"Give {each}" if topics else "Give a session of `locatk simulate dots`",
            )
        frames = _frames(session, self._topic, SCHEMAS[topics[self._topic]])
        return ReplayLink(frames, self._speed, keeps_time=True)

    def describe(self) -> dict[str, str]:
        """Return ``port``, ``resolved`` (the file), ``speed`` and ``topic``."""
        return {
            "port": self.name,
            "resolved": os.path.realpath(self._file),
            "speed": f"{self._speed:g}",
            "topic": self._topic,
        }


def _frames(
    session: Session, topic: str, message_type: Any
) -> Generator[tuple[int, list[Frame]], None, None]:
    """Yield (log time in ns, a list of one frame).

    Raises
    ------
    LinkLost
        The session is damaged.
    """
    try:
        for _, time_ns, payload in session.messages([topic]):
            message = message_type.FromString(payload)
            if hasattr(message, "encoding"):
                pixels = images.raw_grey(
                    message.data, message.width, message.height, message.step, message.encoding
                )
                yield time_ns, [Frame(time_ns, images.encode_png(pixels), *pixels.shape[::-1])]
            else:
                yield time_ns, [Frame(time_ns, message.data, 0, 0)]
    except (InputError, DecodeError) as error:
        raise LinkLost(f"{topic}: {error}") from error
