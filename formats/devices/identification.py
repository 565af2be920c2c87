"""Which device speaks: all that are known listen to the first bytes.

What a decoder makes of the bytes of another device is little, and much is bad or skipped.
Frames with a checksum come right by chance once in 65536 times: a few are proof. Others
must be many and leave out almost nothing, and must be far less where the same bytes are in
a random order: zeros are zeros in any order, and whatever fits them says nothing. Lines
must be text. A decoder that has doubts is not sure of its device.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import entry_points

import numpy as np

from locatk.formats.devices import DEVICES, GROUP, Device
from locatk.formats.devices.decoder import Batch, Decoder, Options

LISTEN_S = 3.0
"""Seconds after which whoever listens should :meth:`Identifier.settle`."""

LARGEST = 1 << 17
"""Bytes after which it is settled anyway."""

PIECE = 512
"""Bytes that are listened to at a time: the first frame is placed so exactly."""

PATIENCE = 8192
"""Bytes that a decoder may hold back, or that one frame may have."""

CHECKED = ("locatk", "dotbot-gateway")
"""Devices whose frames have a checksum."""

MARKS = {"lighthouse-deck": b"\xff" * 12}
"""What must be among the bytes of a device beside its frames."""

VALUES = 8
"""So many different bytes say something."""

ONE_VALUE = 0.7
"""A larger share of one byte says nothing, whatever stands between."""

TEXT = "lines"
NOTHING = "raw"

_PRINTED = bytes([*b"\t\n\r\x1b", *range(0x20, 0x7F)])

SURE, LIKELY, NONE = "sure", "likely", "none"


@dataclass(frozen=True)
class Verdict:
    """What a device was taken for.

    Attributes
    ----------
    device : str
        Its name; ``"raw"`` where the bytes fit none.
    confidence : str
        ``"sure"``, ``"likely"``, or ``"none"`` where they fit none.
    why : str
        For people, as a phrase.
    """

    device: str
    confidence: str
    why: str


@dataclass(frozen=True)
class _Needed:
    """What it takes: so many frames, and so much of the bytes from the first on."""

    frames: int
    share: float


_SURE_CHECKED, _LIKELY_CHECKED = _Needed(4, 0.5), _Needed(2, 0.2)
_SURE, _LIKELY = _Needed(30, 0.9), _Needed(5, 0.6)
_BY_CHANCE = 0.25
"""Of what was found, so much may be found in a random order as well."""


class _Listener:
    """A device that listens.

    Attributes
    ----------
    records : int
        Other than those of the log.
    first : int or None
        Where its first record ended.
    proven : bool
        It hears far less in a random order; tried again when there are ``again`` bytes.
    """

    def __init__(self, device: Device, options: Options) -> None:
        self.name = device.name
        self.decoder: Decoder = device.decode(options)
        self.records = self._frames = 0
        self.proven = False
        self.again = 0
        self.first: int | None = None
        self._last = self._heard = 0

    def feed(self, data: bytes, pause: bool) -> None:
        self._heard += len(data)
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
            ends.append(self._heard)
        if ends:
            self.first = min(ends) if self.first is None else self.first
            self._last = max(self._last, *ends)

    @property
    def frames(self) -> int:
        """Right, and of a type that is known."""
        return self.decoder.counts.frames - self.decoder.counts.unknown

    @property
    def share(self) -> float:
        """Of the bytes from the first frame on, what is in good ones."""
        if self.first is None:
            return 0.0
        waiting = self._heard - self._last - PATIENCE
        missed = max(self.decoder.counts.skipped, waiting)
        return max(0.0, 1 - missed / max(1, self._heard - self.first))

    def has(self, needed: _Needed) -> bool:
        """Whether it has heard as much as is needed."""
        return self.frames >= needed.frames and self.share >= needed.share


class Identifier:
    """Listens to the first bytes of a device that nobody has named.

    Feed it what the device says, as it comes, and ask for the :meth:`verdict`; when
    :data:`LISTEN_S` are over, :meth:`settle`. What was fed is to be fed again to the
    decoder that it names.

    Parameters
    ----------
    options : Options, optional
        For the decoders.
    devices : iterable of Device, optional
        All that are known to locatk and to other packages, where it is left out.
    """

    def __init__(
        self, options: Options | None = None, devices: Iterable[Device] | None = None
    ) -> None:
        self._options = options or Options()
        self._verdict: Verdict | None = None
        self._data = bytearray()
        self._failed: list[str] = []
        self._devices: dict[str, Device] = {}
        self._listeners: list[_Listener] = []
        if devices is None:
            devices = [*DEVICES.values(), *self._others()]
        for device in devices:
            if device.name not in (NOTHING, *self._devices):
                self._devices[device.name] = device
                try:
                    self._listeners.append(_Listener(device, self._options))
                except Exception as error:  # of another package: the others go on
                    self._leave(device.name, error)

    def _others(self) -> list[Device]:
        """Devices of other packages."""
        found = []
        for entry in entry_points(group=GROUP):
            try:
                device = entry.load()
                if not isinstance(device, Device):
                    raise TypeError("no Device")
                found.append(device)
            except Exception as error:
                self._leave(entry.name, error)
        return found

    def _leave(self, name: str, error: Exception) -> None:
        self._failed.append(f"{name} could not listen ({type(error).__name__}: {error})")
        self._listeners = [each for each in self._listeners if each.name != name]

    def feed(self, data: bytes, *, pause: bool = False) -> None:
        """Take the next bytes; ``pause`` as in :meth:`.decoder.Decoder.feed`."""
        if self._verdict is not None:
            return
        data = data[: LARGEST - len(self._data)]
        self._data += data
        for start in range(0, len(data), PIECE):
            piece, pause = data[start : start + PIECE], pause and not start
            for listener in list(self._listeners):
                try:
                    listener.feed(piece, pause)
                except Exception as error:
                    self._leave(listener.name, error)

    def verdict(self) -> Verdict | None:
        """What the device is, as soon as there is no doubt; None before."""
        if self._verdict is None:
            if len(self._data) >= LARGEST:
                return self.settle()
            checked = [each for each in self._listeners if each.name in CHECKED and each.frames]
            sure = [each for each in checked if each.has(_SURE_CHECKED)]
            if not checked:
                fitting = [each for each in self._listeners if self._fits(each, _SURE)]
                sure = [e for e in fitting if e.name == TEXT or not e.decoder.remarks]
                sure = [each for each in sure if self._not_by_chance(each)]
            if len(sure) == 1:
                self._decide(sure[0], SURE)
        return self._verdict

    def settle(self) -> Verdict:
        """What the device is most likely; nothing more is listened to."""
        if self._verdict is not None:
            return self._verdict
        for listener in list(self._listeners):
            listener.again = 0
            try:
                listener.finish()
            except Exception as error:
                self._leave(listener.name, error)
        checked = [e for e in self._listeners if e.name in CHECKED and e.has(_LIKELY_CHECKED)]
        others = [each for each in self._listeners if self._fits(each, _LIKELY)]
        for listener in (*_best(checked), *_best(others)):
            if listener in checked or self._not_by_chance(listener):
                return self._decide(listener, LIKELY)
        text = next((each for each in self._listeners if each.name == TEXT), None)
        if text is not None and text.has(_Needed(1, 0.8)) and self._is_text():
            return self._decide(text, LIKELY)
        self._verdict = Verdict(NOTHING, NONE, "; ".join([self._nothing(), *self._failed]))
        return self._verdict

    def _fits(self, listener: _Listener, needed: _Needed) -> bool:
        """Whether a device without checksums has heard enough that is its own."""
        if listener.name in CHECKED or not listener.has(needed):
            return False
        if listener.name == TEXT:  # boot messages come from all devices
            return listener.records >= needed.frames and self._is_text()
        return MARKS.get(listener.name, b"") in self._data

    def _is_text(self) -> bool:
        """Whether most bytes are of characters that people print."""
        printed = len(self._data) - len(bytes(self._data).translate(None, _PRINTED))
        return printed >= 0.8 * len(self._data)

    def _not_by_chance(self, listener: _Listener) -> bool:
        """Whether it hears far less in the same bytes in a random order."""
        if listener.name == TEXT or listener.proven:
            return True
        if len(self._data) < listener.again:
            return False
        listener.again = 2 * len(self._data)
        data = np.frombuffer(bytes(self._data[listener.first :]), np.uint8)
        share = np.bincount(data, minlength=256) / max(len(data), 1)
        if np.count_nonzero(share) < VALUES or share.max() > ONE_VALUE:
            return False
        mixed = np.random.default_rng(0).permutation(data).tobytes()
        try:
            control = _Listener(self._devices[listener.name], self._options)
            control.feed(mixed, True)
            control.finish()
        except Exception as error:
            self._leave(listener.name, error)
            return False
        listener.proven = control.frames <= _BY_CHANCE * listener.frames
        return listener.proven

    def _decide(self, listener: _Listener, confidence: str) -> Verdict:
        size = len(self._data)
        found = f"{listener.frames} {'lines' if listener.name == TEXT else 'frames'}"
        if listener.name in CHECKED:
            found += " of right checksum"
        share = f"{listener.share:.0%} of what came since the first"
        self._verdict = Verdict(
            listener.name, confidence, f"{found} in the first {size} bytes, {share}"
        )
        return self._verdict

    def _nothing(self) -> str:
        """Why it is no known device."""
        size = len(self._data)
        if not size:
            return "nothing came"
        if len(set(self._data)) == 1:
            return f"{size} bytes that are all 0x{self._data[0]:02x}: check the wiring and baud"
        return f"{size} bytes that fit no known device: check the baud"


def _best(listeners: list[_Listener]) -> list[_Listener]:
    """Those who hear most first."""
    return sorted(listeners, key=lambda each: (-each.share, each.decoder.counts.bad))
