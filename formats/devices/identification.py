"""Identification of an unknown device from its first bytes, with the decoders of all devices.

A decoder makes few records of the bytes of another device, and many of them are bad or skipped.
Frames with a 16-bit checksum are valid by chance once in 65,536 times, so that a few are proof.
Frames without a checksum must be many and leave out almost nothing, and there must be far fewer
of them in a random permutation of the same bytes: zeros are zeros in any order, and frames that
zeros satisfy prove nothing. Lines must be printable text. A decoder with remarks is not certain
of its device.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np

from locatk.formats.devices import DEVICES, ENTRY_POINT_GROUP, Device
from locatk.formats.devices.interface import Batch, Decoder, Options

MAX_IDENTIFICATION_S = 3.0
"""Time after which the caller should :meth:`Identifier.settle`."""

MAX_BYTES = 1 << 17
"""Bytes after which the identification ends in any case."""

PIECE_BYTES = 512
"""Bytes fed at a time, which is the resolution of the position of the first frame."""

MAX_HELD_BACK_BYTES = 8192
"""Bytes that a decoder may hold back, or that one frame may have."""

CHECKSUM_DEVICES = ("locatk", "dotbot-gateway")
"""Devices whose frames have a checksum."""

REQUIRED_BYTES = {"lighthouse-deck": b"\xff" * 12}
"""Byte sequences that a device sends besides its frames."""

MIN_DISTINCT_BYTES = 8
"""Streams of fewer different byte values prove nothing."""

MAX_BYTE_FRACTION = 0.7
"""Streams with a larger fraction of one byte value prove nothing."""

MIN_PRINTABLE_FRACTION = 0.8
"""Fraction of printable characters in text."""

TEXT_DEVICE = "lines"
UNKNOWN_DEVICE = "raw"

_PRINTABLE = bytes([*b"\t\n\r\x1b", *range(0x20, 0x7F)])


@dataclass(frozen=True)
class Verdict:
    """Result of the identification.

    Attributes
    ----------
    device : str
        Name of the device; ``"raw"`` if the bytes match none.
    why : str
        Reason, as a phrase for the user.
    """

    device: str
    why: str


@dataclass(frozen=True)
class _Requirement:
    """Minimum number of frames, and fraction of the bytes since the first frame."""

    frames: int
    fraction: float


_CERTAIN_CHECKSUM, _LIKELY_CHECKSUM = _Requirement(4, 0.5), _Requirement(2, 0.2)
_CERTAIN_PLAIN, _LIKELY_PLAIN = _Requirement(30, 0.9), _Requirement(5, 0.6)
_LIKELY_LINE = _Requirement(1, 0.8)

_MAX_CHANCE_FRACTION = 0.25
"""Largest fraction of the frames that may also occur in the permuted bytes."""


class _Candidate:
    """Device with its decoder.

    Attributes
    ----------
    records : int
        Records received, except those of the log.
    first : int or None
        End of the first record.
    is_proven : bool
        There are far fewer frames in the permuted bytes.
    next_test_bytes : int
        Number of bytes at which the permutation test is repeated.
    """

    def __init__(self, device: Device, options: Options) -> None:
        self.name = device.name
        self.decoder: Decoder = device.create_decoder(options)
        self.records = self._frames = 0
        self.is_proven = False
        self.next_test_bytes = 0
        self.first: int | None = None
        self._last = self._fed = 0

    def feed(self, data: bytes, pause: bool) -> None:
        self._fed += len(data)
        self._take(self.decoder.feed(data, pause=pause))

    def finish(self) -> None:
        self._take(self.decoder.finish())

    def _take(self, batches: Iterable[Batch]) -> None:
        ends = []
        for batch in batches:
            self.records += len(batch) if batch.stream.kind != "log" else 0
            ends += [int(batch.end[0]), int(batch.end[-1])] if len(batch) else []
        if self.frames > self._frames:
            self._frames = self.frames
            ends.append(self._fed)
        if ends:
            self.first = min(ends) if self.first is None else self.first
            self._last = max(self._last, *ends)

    @property
    def frames(self) -> int:
        """Number of valid frames of known types."""
        return self.decoder.counts.frames - self.decoder.counts.unknown

    @property
    def fraction(self) -> float:
        """Fraction of the bytes since the first frame that are in valid frames."""
        if self.first is None:
            return 0.0
        waiting = self._fed - self._last - MAX_HELD_BACK_BYTES
        missed = max(self.decoder.counts.skipped, waiting)
        return max(0.0, 1 - missed / max(1, self._fed - self.first))

    def meets(self, required: _Requirement) -> bool:
        """Return whether there are as many frames as required."""
        return self.frames >= required.frames and self.fraction >= required.fraction


class Identifier:
    """Identifies the device that sends a byte stream.

    Feed it the bytes as they arrive and ask for the :meth:`verdict`; after
    :data:`MAX_IDENTIFICATION_S`, :meth:`settle`. Then feed the same bytes again to the decoder
    of the device.

    Parameters
    ----------
    options : Options, optional
        Options of the decoders.
    devices : iterable of Device, optional
        Candidates; by default the devices of locatk and of other packages.
    """

    def __init__(
        self, options: Options | None = None, devices: Iterable[Device] | None = None
    ) -> None:
        self._options = options or Options()
        self._verdict: Verdict | None = None
        self._data = bytearray()
        self._failures: list[str] = []
        self._devices: dict[str, Device] = {}
        self._candidates: list[_Candidate] = []
        if devices is None:
            devices = [*DEVICES.values(), *self._load_external_devices()]
        for device in devices:
            if device.name not in (UNKNOWN_DEVICE, *self._devices):
                self._devices[device.name] = device
                try:
                    self._candidates.append(_Candidate(device, self._options))
                except Exception as error:  # Code of another package; the others continue.
                    self._remove(device.name, error)

    def _load_external_devices(self) -> list[Device]:
        """Return the devices of other packages."""
        devices = []
        for entry in entry_points(group=ENTRY_POINT_GROUP):
            try:
                device = entry.load()
                if not isinstance(device, Device):
                    raise TypeError("not a Device")
                devices.append(device)
            except Exception as error:  # Code of another package may raise anything.
                self._remove(entry.name, error)
        return devices

    def _remove(self, name: str, error: Exception) -> None:
        self._failures.append(f"the decoder of {name} failed ({type(error).__name__}: {error})")
        self._candidates = [each for each in self._candidates if each.name != name]

    def feed(self, data: bytes, *, pause: bool = False) -> None:
        """Take the next bytes; ``pause`` as in :meth:`.decoder.Decoder.feed`."""
        if self._verdict is not None:
            return
        data = data[: MAX_BYTES - len(self._data)]
        self._data += data
        for start in range(0, len(data), PIECE_BYTES):
            piece, pause = data[start : start + PIECE_BYTES], pause and not start
            for candidate in list(self._candidates):
                try:
                    candidate.feed(piece, pause)
                except Exception as error:
                    self._remove(candidate.name, error)

    def verdict(self) -> Verdict | None:
        """Return the device as soon as it is certain; None before."""
        if self._verdict is None:
            if len(self._data) >= MAX_BYTES:
                return self.settle()
            with_checksum = [
                each for each in self._candidates if each.name in CHECKSUM_DEVICES and each.frames
            ]
            certain = [each for each in with_checksum if each.meets(_CERTAIN_CHECKSUM)]
            if not with_checksum:
                certain = [
                    each
                    for each in self._candidates
                    if self._is_match(each, _CERTAIN_PLAIN)
                    and (each.name == TEXT_DEVICE or not each.decoder.remarks)
                    and self._beats_permutation(each)
                ]
            if len(certain) == 1:
                self._decide(certain[0])
        return self._verdict

    def settle(self) -> Verdict:
        """Return the most likely device and end the identification."""
        if self._verdict is not None:
            return self._verdict
        for candidate in list(self._candidates):
            candidate.next_test_bytes = 0
            try:
                candidate.finish()
            except Exception as error:
                self._remove(candidate.name, error)
        with_checksum = [
            each
            for each in self._candidates
            if each.name in CHECKSUM_DEVICES and each.meets(_LIKELY_CHECKSUM)
        ]
        others = [each for each in self._candidates if self._is_match(each, _LIKELY_PLAIN)]
        for candidate in (*_best_first(with_checksum), *_best_first(others)):
            if candidate in with_checksum or self._beats_permutation(candidate):
                return self._decide(candidate)
        text = next((each for each in self._candidates if each.name == TEXT_DEVICE), None)
        if text is not None and text.meets(_LIKELY_LINE) and self._is_text():
            return self._decide(text)
        reason = "; ".join([self._reason_unknown(), *self._failures])
        self._verdict = Verdict(UNKNOWN_DEVICE, reason)
        return self._verdict

    def _is_match(self, candidate: _Candidate, required: _Requirement) -> bool:
        """Return whether a device without checksums has as many frames as required."""
        if candidate.name in CHECKSUM_DEVICES or not candidate.meets(required):
            return False
        if candidate.name == TEXT_DEVICE:  # All devices send boot messages.
            return candidate.records >= required.frames and self._is_text()
        return REQUIRED_BYTES.get(candidate.name, b"") in self._data

    def _is_text(self) -> bool:
        """Return whether most bytes are printable characters."""
        printable = len(self._data) - len(bytes(self._data).translate(None, _PRINTABLE))
        return printable >= MIN_PRINTABLE_FRACTION * len(self._data)

    def _beats_permutation(self, candidate: _Candidate) -> bool:
        """Return whether the decoder finds far fewer frames in the permuted bytes."""
        if candidate.name == TEXT_DEVICE or candidate.is_proven:
            return True
        if len(self._data) < candidate.next_test_bytes:
            return False
        candidate.next_test_bytes = 2 * len(self._data)
        data = np.frombuffer(bytes(self._data[candidate.first :]), np.uint8)
        fraction = np.bincount(data, minlength=256) / max(len(data), 1)
        if np.count_nonzero(fraction) < MIN_DISTINCT_BYTES or fraction.max() > MAX_BYTE_FRACTION:
            return False
        permuted = np.random.default_rng(0).permutation(data).tobytes()
        try:
            control = _Candidate(self._devices[candidate.name], self._options)
            control.feed(permuted, True)
            control.finish()
        except Exception as error:
            self._remove(candidate.name, error)
            return False
        candidate.is_proven = control.frames <= _MAX_CHANCE_FRACTION * candidate.frames
        return candidate.is_proven

    def _decide(self, candidate: _Candidate) -> Verdict:
        units = "lines" if candidate.name == TEXT_DEVICE else "frames"
        if candidate.name in CHECKSUM_DEVICES:
            units += " with a valid checksum"
        reason = (
            f"{candidate.frames} {units} in the first {len(self._data)} bytes, "
            f"{candidate.fraction:.0%} of the bytes since the first one"
        )
        self._verdict = Verdict(candidate.name, reason)
        return self._verdict

    def _reason_unknown(self) -> str:
        """Return why the bytes match no known device."""
        size = len(self._data)
        if not size:
            return "no bytes received"
        if len(set(self._data)) == 1:
            return f"all {size} bytes are 0x{self._data[0]:02x}: check the wiring and --baud"
        return f"{size} bytes match no known device: check --baud"


def _best_first(candidates: list[_Candidate]) -> list[_Candidate]:
    """Return the candidates, those with the largest fraction of the bytes first."""
    return sorted(candidates, key=lambda each: (-each.fraction, each.decoder.counts.bad))
