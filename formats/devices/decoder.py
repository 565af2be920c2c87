"""What a device says over a wire: the contract between bytes and records.

A decoder takes bytes as they come, in pieces of any size, and gives records in batches;
whatever the pieces, the records are the same. It knows no clock: a record says after
which byte it was complete, and the session knows when that byte arrived.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

KINDS = ("magnetometers", "halls", "lighthouse", "captures", "odometry", "readings", "log")
"""Kinds of records; :mod:`locatk.formats.capture.device_messages` says what becomes of each."""


@dataclass(frozen=True)
class Ticks:
    """A device's clock: how fast it counts, and after how many bits it starts again."""

    hz: float
    bits: int = 64


@dataclass(frozen=True)
class Stream:
    """Records of one kind, of one of the devices behind a port.

    Attributes
    ----------
    kind : str
        One of :data:`KINDS`.
    node : str
        Which of the devices behind the port; ``""`` where there is only one.
    sensors : int
        Of ``magnetometers`` and ``halls``: how many.
    names : tuple of str
        Of ``readings``: names of the values; of ``halls``: names of the sensors, where the
        device tells.
    ticks : Ticks or None
        The clock of :attr:`Batch.tick`.
    """

    kind: str
    node: str = ""
    sensors: int = 0
    names: tuple[str, ...] = ()
    ticks: Ticks | None = None


@dataclass(frozen=True)
class Batch:
    """Records of one stream, in the order in which they came.

    Attributes
    ----------
    stream : Stream
    end : (n,) int64 ndarray
        Bytes fed up to and with the last byte of each record's frame; never descending.
    columns : dict of str to ndarray
        What was measured, (n,) or (n, width), in SI:

        ``magnetometers``
            ``b_tesla`` (n, 3 N): x, y, z of each sensor, in the array's axes.
            ``temperature_celsius`` (n,), where the device tells.
        ``halls``
            ``b_tesla`` (n, N), positive upward.
        ``lighthouse``
            ``sensor``, ``channel`` (1 to 16), ``polynomial``, ``sweep``, ``count``, as in
            :class:`locatk.core.lighthouse.recording.Sweeps`.
        ``captures``
            ``sensor``, ``bits`` (uint64), ``polynomial``, ``bit_offset``, as in
            ``locatk.LighthouseCapture``.
        ``odometry``
            ``x_m``, ``y_m``, ``heading_rad``.
        ``readings``
            ``value`` (n, len(names)) float64.
        ``log``
            ``level`` (n,) int: 1 debug, 2 info, 3 warning, 4 error, 5 fatal, as in
            ``foxglove.Log``; ``text`` (n,) object array of str.
    tick : (n,) int64 ndarray or None
        The device's clock as received, when the record was measured.
    sequence : (n,) int64 ndarray or None
        The device's counter of samples or frames, as received.
    """

    stream: Stream
    end: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    tick: NDArray[np.int64] | None = None
    sequence: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.end)


@dataclass
class Counts:
    """What became of the bytes.

    Attributes
    ----------
    bytes : int
        Fed so far.
    frames : int
        Whole and right.
    bad : int
        Wrong: checksum, length, or content that cannot be.
    lost : int
        Missing between two good ones, as their sequence numbers tell.
    skipped : int
        Bytes that belong to no good frame; those before the first are not counted, as
        nobody starts to listen at the start of a frame.
    unknown : int
        Of the ``frames``: those of a type that this version does not know.
    """

    bytes: int = 0
    frames: int = 0
    bad: int = 0
    lost: int = 0
    skipped: int = 0
    unknown: int = 0


class Decoder(Protocol):
    """Bytes in, records out.

    Attributes
    ----------
    counts : Counts
    remarks : list of str
        What must be known to use the records, said once: an assumption, a doubt. Whoever
        feeds takes them out.
    """

    counts: Counts
    remarks: list[str]

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Take the next bytes and give the records that they complete.

        ``pause`` says that the line was silent before them, for longer than between the
        bytes of a frame.
        """

    def restart(self) -> list[Batch]:
        """The connection was lost and is there again: what is half received is dropped, and
        what the device counted while nobody listened is not :attr:`Counts.lost`."""

    def finish(self) -> list[Batch]:
        """No more bytes: give what was held back."""


@dataclass(frozen=True)
class Options:
    """What the user told of a device.

    Attributes
    ----------
    columns : tuple of str
        ``lines``: names of the values of a line, in their order.
    """

    columns: tuple[str, ...] = field(default=())
