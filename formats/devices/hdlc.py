"""HDLC frames as the DotBot group's firmware sends them over a serial port.

A frame stands between flags 0x7E; next to another there may be one of them or two. A flag
or an escape 0x7D inside is sent as 0x7D and the byte with bit 5 turned over. The last two
bytes are the FCS-16 of the others, little-endian (CRC-16/X.25; RFC 1662, appendix C;
DotBot-firmware ``drv/hdlc/hdlc.c``).
"""

from __future__ import annotations

from binascii import crc_hqx

from locatk.formats.devices.decoder import Counts

FLAG = b"\x7e"
ESCAPE = b"\x7d"
FLAG_INSIDE = b"\x7d\x5e"
ESCAPE_INSIDE = b"\x7d\x5d"

LARGEST = 1024
"""Bytes between flags of the longest frame; those of DotBots have some 500 at most."""

_TURNED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_GOOD = int(f"{0xF0B8:016b}"[::-1], 2)
"""X.25 takes the lowest bit of a byte first, ``crc_hqx`` the highest: bytes and sums are
turned around for it. This is the sum over a frame with its FCS."""


class HdlcDecoder:
    """Bytes in, payloads out; ``frames``, ``bad`` and ``skipped`` of ``counts`` are kept."""

    def __init__(self, counts: Counts) -> None:
        self._counts = counts
        self._base = 0  # bytes before the rest
        self._rest = b""
        self._dropped = 0  # of the frame of the rest, for being too long
        self._flagged = False
        self._heard = False

    def feed(self, data: bytes) -> list[tuple[int, bytes]]:
        """Payloads of the frames that ``data`` completes, each with how many bytes were fed
        up to and with its closing flag."""
        *pieces, rest = (self._rest + data).split(FLAG)
        payloads = []
        for piece in pieces:
            self._base += len(piece) + 1
            payload = None if self._dropped or not self._flagged else unpacked(piece)
            if payload is not None:
                payloads.append((self._base, payload))
                self._counts.frames += 1
                self._heard = True
            elif self._heard and (piece or self._dropped):
                self._counts.bad += 1
                self._counts.skipped += self._dropped + len(piece)
            self._flagged, self._dropped = True, 0
        if self._dropped + len(rest) > LARGEST:
            self._base += len(rest)
            self._dropped += len(rest)
            rest = b""
        self._rest = rest
        return payloads

    def restart(self) -> None:
        """Begin anew, as if nothing had been heard before."""
        self._base += len(self._rest)
        self._rest, self._dropped = b"", 0
        self._flagged = self._heard = False


def packed(payload: bytes) -> bytes:
    """The frame of a payload, with a flag on either side."""
    crc = crc_hqx(payload.translate(_TURNED), 0xFFFF) ^ 0xFFFF
    body = payload + bytes([_TURNED[crc >> 8], _TURNED[crc & 0xFF]])
    body = body.replace(ESCAPE, ESCAPE_INSIDE).replace(FLAG, FLAG_INSIDE)
    return FLAG + body + FLAG


def unpacked(body: bytes) -> bytes | None:
    """The payload of what stands between two flags; None if it is no right frame."""
    if not 2 <= len(body) <= LARGEST:
        return None
    if ESCAPE in body:
        if body.count(ESCAPE) != body.count(FLAG_INSIDE) + body.count(ESCAPE_INSIDE):
            return None
        body = body.replace(FLAG_INSIDE, FLAG).replace(ESCAPE_INSIDE, ESCAPE)
    return body[:-2] if crc_hqx(body.translate(_TURNED), 0xFFFF) == _GOOD else None
