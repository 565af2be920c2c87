"""Device of unknown format: its bytes are stored and not decoded."""

from __future__ import annotations

from locatk.formats.devices.interface import Batch, Counts, Options


class RawDecoder:
    """Decoder that counts bytes and returns no records; see :class:`.decoder.Decoder`."""

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """Count the bytes."""
        self.counts.bytes += len(data)
        return []

    def restart(self) -> list[Batch]:
        """Return nothing."""
        return []

    def finish(self) -> list[Batch]:
        """Return nothing."""
        return []
