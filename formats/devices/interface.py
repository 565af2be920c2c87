"""Interface of devices: bytes to records (decoder), and recordings to bytes (encoder).

A decoder takes a byte stream in pieces of any size and returns records in batches. The
records do not depend on how the stream is cut. A decoder has no clock: each record states
after which byte it was complete, and the capture knows when that byte arrived.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSamples
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.polaris.array import Samples
from locatk.core.trajectory import Trajectory

KINDS = (
    "magnetometers",
    "halls",
    "lighthouse",
    "captures",
    "odometry",
    "imu",
    "poses",
    "readings",
    "log",
)
"""Kinds of records; :mod:`locatk.formats.capture.ingestion` converts each to messages."""


@dataclass(frozen=True)
class Ticks:
    """Tick counter of a device.

    Attributes
    ----------
    hz : float
        Nominal frequency.
    bits : int
        Width; the counter wraps after ``2**bits`` ticks.
    name : str
        Name of the counter, if a device has several; ``""`` for its main one.
    """

    hz: float
    bits: int = 64
    name: str = ""


@dataclass(frozen=True)
class Stream:
    """Identity of a stream of records: their kind, and the device behind the port.

    Attributes
    ----------
    kind : str
        One of :data:`KINDS`.
    node : str
        Name of the device behind the port; ``""`` if there is only one.
    sensors : int
        Number of sensors, of ``magnetometers`` and ``halls``, and of ``lighthouse`` if the device
        is a Lighthouse deck.
    names : tuple of str
        Names of the values, of ``readings``; names of the sensors, of ``halls``, if the device
        sends them.
    ticks : Ticks or None
        Counter of :attr:`Batch.tick`.
    """

    kind: str
    node: str = ""
    sensors: int = 0
    names: tuple[str, ...] = ()
    ticks: Ticks | None = None


@dataclass(frozen=True)
class Batch:
    """Records of one stream, in the order of their arrival.

    Attributes
    ----------
    stream : Stream
    end : (n,) int64 ndarray
        Number of bytes fed up to and including the last byte of each record's frame; never
        descending.
    columns : dict of str to ndarray
        Values, (n,) or (n, width), in SI units:

        ``magnetometers``
            ``b_tesla`` (n, 3 N): x, y, z of each sensor, along the axes of the array.
            ``temperature_celsius`` (n,), if the device sends it.
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
        ``imu``
            ``acceleration_m_s2``, ``angular_rate_rad_s`` (n, 3), as in
            :class:`locatk.core.inertial.InertialSamples`; NaN if a sensor was not sampled.
        ``poses``
            ``position_m`` (n, 3), ``quaternion_xyzw`` (n, 4): poses that the device estimates.
        ``readings``
            ``value`` (n, len(names)) float64.
        ``log``
            ``level`` (n,) int: 1 debug, 2 info, 3 warning, 4 error, 5 fatal, as in
            ``foxglove.Log``; ``text`` (n,) object array of str.
    tick : (n,) int64 ndarray or None
        Tick counter of the device at the measurement, as received.
    sequence : (n,) int64 ndarray or None
        Sequence number of the sample or frame, as received.
    """

    stream: Stream
    end: NDArray[np.int64]
    columns: dict[str, NDArray[Any]]
    tick: NDArray[np.int64] | None = None
    sequence: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.end)

    def take(self, rows: NDArray[np.int64]) -> Batch:
        """Return the selected records."""
        return Batch(
            self.stream,
            self.end[rows],
            {name: column[rows] for name, column in self.columns.items()},
            None if self.tick is None else self.tick[rows],
            None if self.sequence is None else self.sequence[rows],
        )


@dataclass
class Counts:
    """Statistics of a decoder.

    Attributes
    ----------
    bytes : int
        Bytes fed.
    frames : int
        Complete and valid frames.
    bad : int
        Invalid frames: wrong checksum, length or content.
    lost : int
        Frames missing between two valid ones, by their sequence numbers.
    skipped : int
        Bytes outside of valid frames. Bytes before the first valid frame are not counted,
        because reception rarely begins at the start of a frame.
    unknown : int
        Those of ``frames`` whose type this version does not know.
    """

    bytes: int = 0
    frames: int = 0
    bad: int = 0
    lost: int = 0
    skipped: int = 0
    unknown: int = 0


class Decoder(Protocol):
    """Converts a byte stream to records.

    Attributes
    ----------
    counts : Counts
    remarks : list of str
        Facts that a user of the records must know, such as an assumption; each is added once.
        The caller removes them.
    """

    counts: Counts
    remarks: list[str]

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Return the records that the next bytes complete.

        ``pause`` states that the line was silent before these bytes, for longer than between
        the bytes of a frame.
        """

    def restart(self) -> list[Batch]:
        """Discard a partial frame after a reconnect, and return records that were held back.

        Frames that the device sent while it was disconnected do not count as
        :attr:`Counts.lost`.
        """

    def finish(self) -> list[Batch]:
        """Return the records that were held back, at the end of the byte stream."""


@dataclass(frozen=True)
class Options:
    """Options of a decoder, as given by the user.

    Attributes
    ----------
    columns : tuple of str
        Names of the values of a line, in their order; of ``lines``.
    """

    columns: tuple[str, ...] = field(default=())


@dataclass(frozen=True)
class Recording:
    """Observations of a session, as input of an encoder; empty or None if it has none."""

    samples: Sequence[Samples] = ()
    halls: Sequence[HallSamples] = ()
    sweeps: Sweeps | None = None
    odometry: Sequence[Trajectory] = ()
