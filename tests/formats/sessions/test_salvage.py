"""Records of damaged files that are accepted or rejected."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import lz4.frame
import mcap.writer
import pytest
import zstandard
from mcap.opcode import Opcode

from locatk.formats.sessions.mcap_file import MAGIC, iter_records, read_messages
from locatk.formats.sessions.recovery import validation
from locatk.formats.sessions.recovery.salvage import Loss, Salvage, salvage

NONE = mcap.writer.CompressionType.NONE
Write = Callable[[mcap.writer.Writer, int], None]


def file(
    *,
    chunks: int = 3,
    finish: bool = True,
    topic: str = "/thing",
    extra: Write | None = None,
    **options: object,
) -> bytes:
    """A small file: in each chunk two messages of four bytes, between them what ``extra`` adds."""
    stream = BytesIO()
    writer = mcap.writer.Writer(stream, **options)  # type: ignore[arg-type]
    writer.start("test", "tests")
    schema = writer.register_schema("Thing", "jsonschema", b"{}")
    channel = writer.register_channel(topic, "json", schema)
    for number in range(chunks):
        for part in range(2):
            time = 100 * number + part
            writer.add_message(channel, time, b"%04d" % time, time, time)
        writer.flush()
        if extra is not None:
            extra(writer, number)
    if finish:
        writer.finish()
    return stream.getvalue()


def attach(name: str, data: bytes) -> Write:
    return lambda writer, number: writer.add_attachment(number, number, name, "text/plain", data)


@pytest.mark.skipif(not hasattr(os, "SEEK_DATA"), reason="holes of Linux and macOS")
def test_holes_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A hole has no blocks on the disk, and may be larger than what can be read."""
    sparse, content, size = tmp_path / "sparse.mcap", file(), 1 << 36
    with open(sparse, "wb") as stream:
        stream.write(content)
        stream.seek(size)
        stream.write(content)
    if sparse.stat().st_blocks * 512 > size // 2:
        pytest.skip("a file system without holes")
    count, read = 0, validation.DamagedFile.read

    def counted(source: validation.DamagedFile, offset: int, length: int) -> bytes:
        nonlocal count
        data = read(source, offset, length)
        count += len(data)
        assert count < 1 << 26
        return data

    monkeypatch.setattr(validation.DamagedFile, "read", counted)
    with open(sparse, "rb") as stream:
        found = salvage(stream)
    (loss,) = found.losses + found.index_losses
    assert loss.start == len(content)
    assert size <= loss.end < size + 100
    assert found.copies == len(salvage(BytesIO(content)).index.segments)


def spans(data: bytes, kind: Opcode) -> list[tuple[int, int]]:
    """(start, end) of the records of one kind in a whole file."""
    inside = data[len(MAGIC) : -len(MAGIC) if data.endswith(MAGIC) else len(data)]
    return [
        (start + len(MAGIC) - 9, end + len(MAGIC))
        for opcode, start, end in iter_records(inside, 0)
        if opcode == kind
    ]


def times(data: bytes) -> tuple[Salvage, list[int]]:
    """What is left of ``data``, and the log times of the messages."""
    stream = BytesIO(data)
    found = salvage(stream)
    messages = [
        (time, payload)
        for segment in found.index.segments
        for _, time, payload in read_messages(stream, segment, {1, 2, 3})
    ]
    assert all(payload == b"%04d" % time for time, payload in messages)
    assert sum(found.index.counts.values()) == len(messages)
    return found, [time for time, _ in messages]


ALL = [0, 1, 100, 101, 200, 201]


def test_an_undamaged_file_has_no_losses() -> None:
    found, left = times(file(extra=attach("a.txt", b"abc")))
    assert left == ALL
    assert (found.losses, found.index_losses, found.copies, found.tail) == ([], [], 0, 0)
    assert found.ended
    assert found.statistics is not None
    assert found.index.header.library == "tests"
    assert (found.index.start_ns, found.index.end_ns) == (0, 201)
    assert [entry.name for entry in found.index.attachments] == ["a.txt"] * 3


def test_the_times_of_a_truncated_chunk_are_reported() -> None:
    data = file()
    start, end = spans(data, Opcode.CHUNK)[1]
    found, left = times(data[: end - 3])
    assert left == ALL[:2]
    assert found.losses == [Loss(start, end - 3, "chunk", "", 100, 101)]
    assert (found.ended, found.tail) == (False, end - 3 - start)


def test_killed_between_two_records() -> None:
    found, left = times(file(finish=False))
    assert left == ALL
    assert (found.losses, found.ended, found.tail) == ([], False, 0)


def test_zeros_are_reported_as_such() -> None:
    data = file(finish=False)
    found, left = times(data + bytes(100_000))
    assert left == ALL
    assert found.losses == [Loss(len(data), len(data) + 100_000, "zeros")]


@pytest.mark.slow
@pytest.mark.parametrize("value", [0, 1, 2**31, 2**40 - 1, 2**62, 2**63, 2**64 - 1])
def test_wild_lengths(value: int) -> None:
    """In the frame of each record, and in each place of a chunk, an attachment and metadata."""

    def extra(writer: mcap.writer.Writer, number: int) -> None:
        attach("a.txt", b"abc")(writer, number)
        writer.add_metadata("m", {"key": "value"})

    data = file(extra=extra)
    places = [
        start for opcode, start, _ in iter_records(data[8:-8], 0) if opcode != Opcode.DATA_END
    ]
    for kind in (Opcode.CHUNK, Opcode.ATTACHMENT, Opcode.METADATA):
        start, end = spans(data, kind)[1]
        places += range(start + 9, min(start + 60, end - 8))
    for place in places:
        for width in (4, 8):
            wild = struct.pack("<Q", value)[:width]
            damaged = data[:place] + wild + data[place + width :]
            _, left = times(damaged)
            assert len(left) >= 4, place
            assert set(left) <= set(ALL)


def chunk(packed: bytes, size: int, crc: int, compression: bytes) -> bytes:
    head = struct.pack("<QQQI", 7, 7, size, crc)
    head += struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(packed))
    return struct.pack("<BQ", Opcode.CHUNK, len(head) + len(packed)) + head + packed


def test_decompression_bombs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(validation, "MAX_RECORD_BYTES", 1 << 20)
    zeros = bytes(8 << 20)
    writer = zstandard.ZstdCompressor(write_content_size=False)
    for packed, name in (
        (lz4.frame.compress(zeros), b"lz4"),
        (zstandard.compress(zeros), b"zstd"),
        (writer.compress(zeros), b"zstd"),
    ):
        for size in (10, len(zeros), 1 << 62):
            bomb = chunk(packed, size, 0, name)
            data = file()
            found, left = times(data[: spans(data, Opcode.CHUNK)[2][0]] + bomb)
            assert left == ALL[:4]
            assert [loss.what for loss in found.losses] == ["chunk"]


@pytest.mark.parametrize("name", [b"zstd", b"lz4", b""])
def test_chunks_without_a_checksum(name: bytes) -> None:
    message = struct.pack("<BQHIQQ", Opcode.MESSAGE, 26, 1, 0, 7, 7) + b"0007"
    pack = {b"zstd": zstandard.compress, b"lz4": lz4.frame.compress, b"": bytes}[name]
    data = file(finish=False)
    for content, good in ((message, True), (message[:-1], False), (message + b"\x05", False)):
        more = chunk(pack(content), len(content), 0, name)
        found, left = times(data + more)
        assert left == [*ALL, *([7] if good else [])]
        assert bool(found.losses) != good
    wrong = chunk(pack(message), len(message), zlib.crc32(message) ^ 1, name)
    assert times(data + wrong)[1] == ALL


def test_a_damaged_chunk_does_not_hide_the_next() -> None:
    """Its length is wrong, and leads to the beginning of a later record."""
    data = file()
    (start, end), (_, far) = spans(data, Opcode.CHUNK)[:2]
    for length in (far - start - 9, end - start - 9 + 5, 3):
        damaged = data[: start + 1] + struct.pack("<Q", length) + data[start + 9 :]
        assert times(damaged)[1] == ALL[2:]


def test_an_index_does_not_hide_a_chunk() -> None:
    """The end of an index of messages is missing, and so is the beginning of what follows."""
    data = file(extra=attach("a.txt", b"x" * 100))
    index = spans(data, Opcode.MESSAGE_INDEX)[0]
    later = spans(data, Opcode.CHUNK)[1][0]
    found, left = times(data[: index[1] - 20] + data[later:])
    assert left == ALL
    assert len(found.index.attachments) == 2
    assert found.losses


def test_an_index_with_a_flipped_bit_is_no_message() -> None:
    data = file()
    for start, _ in spans(data, Opcode.MESSAGE_INDEX):
        damaged = bytearray(data)
        damaged[start] = Opcode.MESSAGE
        found, left = times(bytes(damaged))
        assert left == ALL
        assert [loss.what for loss in found.losses] == ["message"]


def test_copies_are_left_out_and_moved_chunks_are_kept() -> None:
    data = file(extra=attach("a.txt", b"abc"))
    start, end = spans(data, Opcode.CHUNK)[1]
    found, left = times(data + b"garbage" + data[start:])
    assert left == ALL
    assert found.copies == 2
    assert len(found.index.attachments) == 3
    found, left = times(data[:start] + data[end:] + b"garbage" + data[start:end])
    assert left == [0, 1, 200, 201, 100, 101]
    assert found.copies == 0


def test_a_recording_inside_an_attachment_is_not_searched() -> None:
    inner = file(finish=False)
    data = file(extra=attach("inner.mcap", inner))
    start, end = spans(data, Opcode.ATTACHMENT)[1]
    damaged = bytearray(data)
    damaged[end - 6] ^= 1
    found, left = times(bytes(damaged))
    assert left == ALL
    assert found.losses == [Loss(start, end, "attachment", "inner.mcap")]


def test_zeros_are_not_accepted_as_text() -> None:
    """A power cut leaves zeros behind, which are no worse UTF-8 than letters."""
    data = file(extra=lambda writer, _: writer.add_metadata("name", {"key": "some value"}))
    start, end = spans(data, Opcode.METADATA)[2]
    for zeros in range(1, 12):
        found, _ = times(data[: end - zeros] + bytes(zeros + 1000))
        assert len(found.metadata) == 2
    data = file(extra=attach("a.txt", b"some text"))
    start, end = spans(data, Opcode.ATTACHMENT)[2]
    for zeros in range(5, end - start):
        found, _ = times(data[: end - zeros] + bytes(zeros + 1000))
        assert len(found.index.attachments) == 2


def test_two_concatenated_recordings() -> None:
    """Ids of the one are not those of the other."""
    first, second = file(), file(chunks=1, topic="/other")
    found, left = times(first + second)
    assert left == [*ALL, 0, 1]
    assert not found.losses
    assert found.statistics is None  # there are two, and none for both
    assert found.ended
    assert (Opcode.CHANNEL, 1) in found.conflicts
    found, left = times(first + second[:-60])
    assert left == [*ALL, 0, 1]
    assert not found.ended


def test_a_moved_summary_is_still_verified() -> None:
    """The index at the end says how much there was, even where it is not at its place."""
    data = file()
    start, end = spans(data, Opcode.CHUNK)[1]
    found, left = times(data[:start] + data[end:])
    assert left == [0, 1, 200, 201]
    assert found.statistics is not None
    assert found.statistics.message_count == 6


def test_a_summary_with_a_wrong_checksum_is_ignored() -> None:
    data = bytearray(file())
    [(start, _)] = spans(bytes(data), Opcode.STATISTICS)
    data[start + 9] ^= 2  # the number of messages; all lengths still agree
    found, left = times(bytes(data))
    assert left == ALL
    assert found.statistics is None
    assert not found.losses
    assert [(loss.what, loss.end) for loss in found.index_losses] == [
        ("index", len(data) - len(MAGIC))
    ]


def test_names_that_no_checksum_confirms_are_reported() -> None:
    data = bytearray(file())
    (first, _), *_ = spans(bytes(data), Opcode.CHUNK)
    [(start, end)] = spans(bytes(data), Opcode.CHANNEL)  # in the summary
    name = data.index(b"/thing", start, end)
    data[first + 60] ^= 1
    found, left = times(bytes(data))
    assert left == ALL[2:]
    assert not found.unconfirmed  # the checksum of the summary is right
    data[name + 1] ^= 1
    found, left = times(bytes(data))
    assert left == ALL[2:]
    assert found.index.channels[1].topic == "/uhing"
    assert found.unconfirmed == {1}
    data[first + 60] ^= 1
    found, left = times(bytes(data))
    assert left == ALL
    assert found.index.channels[1].topic == "/thing"  # from the chunk, whose checksum is right
    assert not found.unconfirmed


def test_a_file_without_a_checksum_of_the_summary_is_accepted() -> None:
    data = bytearray(file(enable_crcs=False))
    (first, _), *_ = spans(bytes(data), Opcode.CHUNK)
    data[first + 9 + 48] ^= 0xFF  # the magic number of the compressed data
    found, left = times(bytes(data))
    assert left == ALL[2:]
    assert not found.unconfirmed


# ---- messages outside chunks


def test_messages_outside_chunks() -> None:
    data = file(use_chunking=False)
    found, left = times(data)
    assert left == ALL
    assert not found.losses
    starts = [start for start, _ in spans(data, Opcode.MESSAGE)]
    damaged = bytearray(data)
    damaged[starts[2] + 1] ^= 0x40  # its length
    found, left = times(bytes(damaged))
    assert left == [0, 1, 101, 200, 201]
    assert [(loss.start, loss.end) for loss in found.losses] == [(starts[2], starts[3])]
    found, left = times(data[: starts[4]] + bytes(500))
    assert left == ALL[:4]
    hole = data[: starts[1]] + b"\xff" * 40 + data[starts[2] :]
    assert times(hole)[1] == [0, 100, 101, 200, 201]


def test_messages_beside_chunks_are_accepted_if_the_statistics_count_them() -> None:
    data = file(compression=NONE)
    start, end = spans(data, Opcode.CHUNK)[1]
    loose = data[start + 9 + 40 : end]
    assert loose[0] == Opcode.MESSAGE
    mixed = data[:start] + loose + data[end:]
    found, left = times(mixed)
    assert left == ALL
    assert not found.losses
    found, left = times(mixed[:-10])
    assert left == [0, 1, 200, 201]
    assert {loss.what for loss in found.losses} == {"message"}


def test_a_large_hole(tmp_path: Path) -> None:
    """In blocks, not at once; the hole takes no room on the disk."""
    data = file()
    start, _ = spans(data, Opcode.CHUNK)[2]
    path, hole = tmp_path / "hole.mcap", 8_000_000
    with path.open("wb") as stream:
        stream.write(data[:start])
        stream.seek(hole)
        stream.write(data[start:])
    with path.open("rb") as stream:
        found = salvage(stream)
    assert sum(found.index.counts.values()) == 6
    assert [len(loss) for loss in found.losses] == [hole - start]


@pytest.mark.parametrize("data", [b"", b"\x89", MAGIC, MAGIC * 2, b"a,b\n1,2\n" * 99, bytes(999)])
def test_files_that_are_no_recording(data: bytes) -> None:
    found, left = times(data)
    assert left == []
    assert not found.metadata
