"""Bytes that are only kept."""

from __future__ import annotations

from locatk.formats.devices import find_device
from locatk.formats.devices.interface import Counts, Options


def test_bytes_are_counted_and_nothing_else() -> None:
    decoder = find_device("raw").create_decoder(Options())
    assert decoder.feed(b"1,2,3\n") == []
    assert decoder.feed(bytes(1000), pause=True) == []
    assert decoder.restart() == []
    assert decoder.feed(b"") == []
    assert decoder.finish() == []
    assert decoder.counts == Counts(bytes=1006)
    assert decoder.remarks == []
