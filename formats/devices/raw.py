"""The device of which nothing is known: its bytes are kept, and that is all."""

from __future__ import annotations

from locatk.formats.devices.decoder import Batch, Counts, Options


class RawDecoder:
    """Counts bytes and makes no records of them; see :mod:`.decoder`."""

    def __init__(self, options: Options) -> None:
        self.counts = Counts()
        self.remarks: list[str] = []

    def feed(self, data: bytes, *, pause: bool = False) -> list[Batch]:
        """See :meth:`.decoder.Decoder.feed`."""
        self.counts.bytes += len(data)
        return []

    def restart(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.restart`."""
        return []

    def finish(self) -> list[Batch]:
        """See :meth:`.decoder.Decoder.finish`."""
        return []
