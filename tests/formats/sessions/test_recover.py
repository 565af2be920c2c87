"""Recovery of damaged recordings: every intact chunk is saved, unchanged, and losses are listed."""

from __future__ import annotations

import contextlib
import os
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import mcap.reader
import mcap.writer
import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import Message
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.opcode import Opcode
from mcap_protobuf.decoder import DecoderFactory
from mcap_protobuf.schema import build_file_descriptor_set

from locatk.core.errors import FormatError, LocatkError, MissingDataError, OutputExistsError
from locatk.formats.schemas.magnetics_pb2 import MagnetometerArray
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.mcap_file import MAGIC, iter_records
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.recovery import recover as recovery
from locatk.formats.sessions.recovery.recover import Recovered, Rewriter, recover

START_NS = 1_700_000_000_000_000_000
CHUNKS = 14
READ = 700
"""Bytes of one message of raw bytes; ten of them a chunk."""

TOPICS: dict[str, type[Message]] = {
    "/serial/bar": SerialChunk,
    "/magnetometers/bar": MagnetometerArray,
    "/log": Log,
}

Flat = tuple[str, int, int, int, bytes]
"""Topic, sequence, log time, publish time and payload of a message."""


def write(
    path: Path,
    *,
    chunks: int = CHUNKS,
    finish: bool = True,
    listed: bool = False,
    **options: object,
) -> None:
    """A recording as `locatk capture` makes it: small chunks, one after the other.

    With ``listed``, its channels stand in the metadata record ``channels`` as well; ``options``
    are those of the stock writer.
    """
    noise = random.Random(7)
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)  # type: ignore[arg-type]
        writer.start("locatk", "locatk test")
        writer.add_metadata("locatk", {"kind": "session", "system": "polaris"})
        writer.add_metadata("capture", {"port": "/dev/ttyACM0"})
        channels = {}
        for topic, kind in TOPICS.items():
            name = kind.DESCRIPTOR.full_name
            files = build_file_descriptor_set(kind).SerializeToString()
            schema = writer.register_schema(name, "protobuf", files)
            channels[topic] = writer.register_channel(topic, "protobuf", schema)
            if listed:
                writer.add_metadata("channels", {str(channels[topic]): f"{topic} {name}"})
        offset = 0
        for number in range(chunks):
            for part in range(10):
                time_ns = START_NS + (10 * number + part) * 20_000_000
                raw = SerialChunk(
                    timestamp=timestamp(time_ns), byte_offset=offset, data=noise.randbytes(READ)
                )
                fields = [noise.random() for _ in range(6)]
                samples = MagnetometerArray(sensors=2, time_ns=[time_ns], b_tesla=fields)
                offset += READ
                for topic, message in (("/serial/bar", raw), ("/magnetometers/bar", samples)):
                    data = message.SerializeToString()
                    sequence = 10 * number + part
                    writer.add_message(channels[topic], time_ns, data, time_ns - 5, sequence)
            if number % 10 == 3:
                writer.flush()
                name, content = f"{number}.toml", noise.randbytes(900)
                writer.add_attachment(time_ns, time_ns, name, "application/toml", content)
                writer.add_metadata("state", {"chunk": str(number)})
                log = Log(message=f"chunk {number}").SerializeToString()
                writer.add_message(channels["/log"], time_ns, log, time_ns, number)
            writer.flush()
        if finish:
            writer.finish()


def stock(path: Path) -> list[Flat]:
    """All messages, as the stock reader reads them, in the order of the file."""
    with path.open("rb") as stream:
        reader = mcap.reader.make_reader(stream, validate_crcs=True)
        return [
            (channel.topic, m.sequence, m.log_time, m.publish_time, m.data)
            for _, channel, m in reader.iter_messages(log_time_order=False)
        ]


@dataclass
class Whole:
    """A recording that is whole, and what is where in it."""

    data: bytes
    chunks: list[tuple[int, int]]
    messages: list[list[Flat]]
    """Of each chunk."""
    attachments: list[tuple[int, int]]
    metadata: list[tuple[int, int]]

    @property
    def flat(self) -> list[Flat]:
        return [message for chunk in self.messages for message in chunk]

    @property
    def data_end(self) -> bytes:
        """The record behind all data, with the last one before it."""
        start = self.data.rindex(bytes([Opcode.DATA_END, 4, 0, 0, 0, 0, 0, 0, 0]))
        return self.data[start - 40 : start + 13]


def whole(path: Path) -> Whole:
    """The recording at ``path``, taken apart."""
    data = path.read_bytes()
    spans: dict[int, list[tuple[int, int]]] = {}
    for opcode, start, end in iter_records(data[: -len(MAGIC)][len(MAGIC) :], 0):
        spans.setdefault(opcode, []).append((start + len(MAGIC) - 9, end + len(MAGIC)))
    left = iter(stock(path))
    messages: list[list[Flat]] = []
    with path.open("rb") as stream:
        summary = mcap.reader.make_reader(stream).get_summary()
        assert summary is not None
        for index in summary.chunk_indexes:
            count = 0
            for offset in index.message_index_offsets.values():
                count += int.from_bytes(data[offset + 11 : offset + 15], "little") // 16
            messages.append([next(left) for _ in range(count)])
    return Whole(
        data,
        spans[Opcode.CHUNK],
        messages,
        spans[Opcode.ATTACHMENT],
        spans[Opcode.METADATA],
    )


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Whole:
    path = tmp_path_factory.mktemp("good") / "run.mcap"
    write(path)
    return whole(path)


def there(spans: list[tuple[int, int]], source: bytes, data: bytes) -> list[int]:
    """Numbers of the records of ``source`` that are in ``data`` byte by byte."""
    return [n for n, (start, end) in enumerate(spans) if data.find(source[start:end]) >= 0]


def is_part(some: list[Flat], of: list[Flat]) -> bool:
    """Whether ``some`` are messages of ``of``, in its order."""
    rest = iter(of)
    return all(message in rest for message in some)


def check(
    source: Whole, data: bytes, folder: Path, *, one: bool = True, ordered: bool = True
) -> Recovered | None:
    """Recover ``data``, which is ``source`` damaged in ``one`` place, and hold it to its word."""
    damaged, output = folder / "damaged.mcap", folder / "out.mcap"
    damaged.write_bytes(data)
    output.unlink(missing_ok=True)
    intact = there(source.chunks, source.data, data)
    expected = [message for number in intact for message in source.messages[number]]
    try:
        result = recover(damaged, output)
    except FormatError as raised:
        result, error = None, str(raised)
    assert damaged.read_bytes() == data
    if result is None:
        # The first chunk says what the messages are; that may be left nowhere else.
        assert not intact or (0 not in intact and "nothing identifies" in error)
        assert "\n" not in error
        assert not output.exists()
        return None

    saved = stock(output)
    if ordered:
        assert is_part(saved, source.flat)  # none altered, none twice
        assert is_part(expected, saved)
    else:
        assert set(expected) <= set(saved) <= set(source.flat)
        assert len(set(saved)) == len(saved)
    session = Session.open(output)
    flat = [(topic, time_ns, payload) for topic, time_ns, payload in session.messages()]
    assert flat == [(topic, time_ns, payload) for topic, _, time_ns, _, payload in saved]
    assert result.messages == len(saved)

    attached = [session.attachment(entry.name) for entry in session.attachments()]
    contents = [source.data[start:end] for start, end in source.attachments]
    assert all(any(data in content for content in contents) for data in attached if data)
    assert len(attached) >= len(there(source.attachments, source.data, data))
    lost = (
        len(saved) < len(source.flat)
        or len(attached) < len(source.attachments)
        or result.metadata < len(source.metadata)
        or not result.ended
    )
    if result.complete:
        assert not lost
    elif one and source.data_end in data:
        assert lost  # else nobody can know whether anything stood in its place
    assert session.metadata()["recovered"]["complete"] == str(result.complete).lower()
    return result


# ---- 400 random cuts and flips


def flipped(data: bytes, noise: random.Random, bits: int, places: range | None = None) -> bytes:
    changed = bytearray(data)
    for _ in range(bits):
        place = noise.choice(places) if places else noise.randrange(len(data))
        changed[place] ^= 1 << noise.randrange(8)
    return bytes(changed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_random_cuts(good: Whole, tmp_path: Path, seed: int) -> None:
    noise = random.Random(seed)
    for _ in range(16):
        cut = noise.randrange(len(good.data))
        result = check(good, good.data[:cut], tmp_path)
        if result is None:
            assert cut < good.chunks[0][1]
            continue
        assert result.ended == (cut >= len(good.data) - len(MAGIC))
        assert not result.ended or cut + 8 > len(good.data)
        last = max((end for _, end in good.chunks if end <= cut), default=0)
        assert result.tail <= cut - last


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_random_flips(good: Whole, tmp_path: Path, seed: int) -> None:
    noise = random.Random(100 + seed)
    for _ in range(10):
        result = check(good, flipped(good.data, noise, 1), tmp_path)
        assert result is not None
        assert result.chunks >= CHUNKS - 1
        assert result.ended
    for _ in range(6):
        check(good, flipped(good.data, noise, 12), tmp_path, one=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_random_flips_of_frames_and_heads(good: Whole, tmp_path: Path, seed: int) -> None:
    """Most bytes of a file are payload: what is hard to get right is between."""
    noise = random.Random(200 + seed)
    ends = [end for _, end in (*good.chunks, *good.attachments, *good.metadata)]
    for _ in range(12):
        start = noise.choice([0, *ends])
        places = range(start, min(start + 60, len(good.data)))
        result = check(good, flipped(good.data, noise, 1, places), tmp_path)
        assert result is not None
        assert result.chunks >= CHUNKS - 1
    for _ in range(8):  # the summary and the footer
        places = range(good.chunks[-1][1], len(good.data))
        result = check(good, flipped(good.data, noise, 1, places), tmp_path)
        assert result is not None
        assert result.complete


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_zeros_holes_and_garbage(good: Whole, tmp_path: Path, seed: int) -> None:
    noise = random.Random(300 + seed)
    data, size = good.data, len(good.data)
    for _ in range(3):
        a, b = sorted(noise.randrange(size) for _ in range(2))
        wide = noise.randrange(1, 30_000)
        check(good, data[:a] + bytes(size - a), tmp_path)  # a tail of zeros
        check(good, data[:a] + bytes(len(data[a : a + wide])) + data[a + wide :], tmp_path)
        check(good, data[:a] + noise.randbytes(wide) + data[a + wide :], tmp_path, one=False)
        check(good, data[:a] + noise.randbytes(wide) + data[a:], tmp_path)  # put in between
        check(good, data[:a] + data[a + wide :], tmp_path)  # left out
        check(good, data[:a] + bytes(b - a) + data[b:], tmp_path)
        check(good, data[a:], tmp_path)  # the head is missing
        pieces = [data[n : n + 9000] for n in range(1, size, 9000)]
        noise.shuffle(pieces)
        result = check(good, data + b"".join(pieces[:9]), tmp_path)
        assert result is not None
        assert result.complete
        check(good, data[:a] + b"".join(pieces[:9]), tmp_path, one=False, ordered=False)


# ---- whole files, killed recordings, other tools


def test_an_undamaged_file_is_copied(good: Whole, tmp_path: Path) -> None:
    result = check(good, good.data, tmp_path)
    assert result is not None
    assert result.complete
    assert not result.damaged
    assert stock(tmp_path / "out.mcap") == good.flat
    old, new = (Session.open(tmp_path / name) for name in ("damaged.mcap", "out.mcap"))
    assert (new.profile, new.channels) == (old.profile, old.channels)
    assert new.library.startswith("locatk test (recovered by locatk ")
    metadata = new.metadata()
    metadata.pop("recovered")
    assert metadata == old.metadata()
    assert new.attachments() == old.attachments()
    for entry in old.attachments():
        assert new.attachment(entry.name) == old.attachment(entry.name)
    again = recover(tmp_path / "out.mcap", tmp_path / "again.mcap")
    assert again.complete
    assert stock(tmp_path / "again.mcap") == good.flat


def test_attachments_stay_between_their_messages(good: Whole, tmp_path: Path) -> None:
    check(good, good.data, tmp_path)
    out = whole(tmp_path / "out.mcap")
    before = [
        [sum(len(m) for m, (start, _) in zip(w.messages, w.chunks, strict=True) if start < at)]
        for w in (good, out)
        for at, _ in w.attachments
    ]
    assert before[: len(before) // 2] == before[len(before) // 2 :]


def test_the_library_decodes_the_output(good: Whole, tmp_path: Path) -> None:
    check(good, good.data[: len(good.data) // 2], tmp_path)
    with (tmp_path / "out.mcap").open("rb") as stream:
        reader = mcap.reader.make_reader(stream, decoder_factories=[DecoderFactory()])
        sizes = [
            len(message.data)
            for _, channel, _, message in reader.iter_decoded_messages(["/serial/bar"])
        ]
    assert set(sizes) == {READ}


def test_a_killed_recording(good: Whole, tmp_path: Path) -> None:
    """Nothing is lost but the end; that it has none is said."""
    killed = tmp_path / "killed.mcap"
    write(killed, finish=False, listed=True)
    result = recover(killed, tmp_path / "out.mcap")
    assert stock(tmp_path / "out.mcap") == good.flat
    assert (result.complete, result.ended, result.tail, result.losses) == (False, False, 0, ())
    assert {topic.lost for topic in result.topics} == {None}
    data = killed.read_bytes()
    killed.write_bytes(data + b"\x06" + bytes(30))
    result = recover(killed, tmp_path / "out.mcap", overwrite=True)
    assert (result.messages, result.tail) == (len(good.flat), 31)


def test_missing_bytes_are_counted(good: Whole, tmp_path: Path) -> None:
    """Told by the offsets of what is left; at the start only where that is known."""

    def missing(numbers: list[int], data: bytes = good.data) -> int | None:
        damaged = bytearray(data)
        for number in numbers:
            damaged[good.chunks[number][0] + 100] ^= 1
        result = check(good, bytes(damaged), tmp_path)
        assert result is not None
        return {topic.topic: topic.missing_bytes for topic in result.topics}["/serial/bar"]

    assert missing([]) == 0
    assert missing([5]) == 10 * READ
    assert missing([5, 6, 9]) == 30 * READ
    assert missing([0]) == 10 * READ
    assert missing([-1]) == 0
    assert missing([0], good.data.replace(b"capture", b"copture")) == 0


def test_lost_messages_are_counted_if_the_index_is_intact(good: Whole, tmp_path: Path) -> None:
    damaged = bytearray(good.data)
    damaged[good.chunks[7][0] + 100] ^= 1
    damaged[good.attachments[1][0] + 100] ^= 1
    result = check(good, bytes(damaged), tmp_path)
    assert result is not None
    assert {topic.topic: topic.lost for topic in result.topics} == {
        "/serial/bar": 10,
        "/magnetometers/bar": 10,
        "/log": 0,
    }
    assert (result.lost_messages, result.lost_attachments, result.lost_metadata) == (20, 1, 0)
    assert [loss.what for loss in result.losses] == ["chunk", "attachment"]
    assert result.losses[0].start_ns == good.messages[7][0][2]
    assert result.losses[1].name
    result = check(good, bytes(damaged[:-100]), tmp_path)  # the index is lost as well
    assert result is not None
    assert (result.lost_messages, result.lost_attachments) == (None, None)


@pytest.mark.parametrize("listed", [False, True])
def test_the_chunk_that_defines_the_channels_is_lost(
    good: Whole, tmp_path: Path, listed: bool
) -> None:
    path, output = tmp_path / "killed.mcap", tmp_path / "out.mcap"
    write(path, finish=False, listed=listed)
    data = bytearray(path.read_bytes())
    start = data.index(good.data[good.chunks[0][0] : good.chunks[0][1]])
    data[start + 100] ^= 1
    path.write_bytes(data)
    if not listed:
        with pytest.raises(FormatError, match=r"channels of all its \d+ messages"):
            recover(path, output)
        assert sorted(tmp_path.iterdir()) == [path]
        return
    result = recover(path, output)
    assert stock(output) == good.flat[len(good.messages[0]) :]
    assert (result.orphans, result.nameless, result.unconfirmed) == (0, (), ())
    session = Session.open(output)
    assert len(list(session.decoded("/serial/bar", SerialChunk))) == 10 * (CHUNKS - 1)
    rest = Session.open(path, damaged_ok=True)
    assert rest.damage
    assert rest.channels[0].schema == "locatk.SerialChunk"
    named = session.metadata()["channels"]
    channels = {str(each.id): each.topic for each in session.index.channels.values()}
    assert {key: text.split()[0] for key, text in named.items()} == channels


@pytest.mark.parametrize(
    "names",
    [
        {"x": "/serial/bar locatk.SerialChunk", "70000": "/a locatk.SerialChunk", "": ""},
        {"1": "locatk.SerialChunk"},
        {"1": "/serial/bar os.path", "2": "/a foxglove.os", "3": "/log foxglove.Log_pb2.Log"},
        {"1": "/serial/bar locatk.Nothing", "2": "/a locatk.DESCRIPTOR", "3": "/a foxglove...x"},
        {"9" * 5000: "/a locatk.SerialChunk", "²": "/a locatk.SerialChunk"},
    ],
)
def test_invalid_channel_records_are_ignored(
    good: Whole, tmp_path: Path, names: dict[str, str]
) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start()
        writer.add_metadata("channels", names)
        start, end = good.chunks[1]
        stream.write(good.data[start:end])
    with pytest.raises(FormatError, match="channels of all its"):
        recover(tmp_path / "a.mcap", tmp_path / "out.mcap")


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        {"compression": mcap.writer.CompressionType.LZ4},
        {"compression": mcap.writer.CompressionType.NONE, "enable_crcs": False},
        {"use_chunking": False},
        {"use_statistics": False},
        {"repeat_channels": False, "repeat_schemas": False},
        {"index_types": mcap.writer.IndexType.NONE},
        {"enable_data_crcs": True, "chunk_size": 100},
    ],
    ids=str,
)
def test_files_of_other_tools(good: Whole, tmp_path: Path, options: dict[str, object]) -> None:
    path, output = tmp_path / "other.mcap", tmp_path / "out.mcap"
    write(path, **options)
    result = recover(path, output)
    assert result.complete
    assert not result.damaged
    assert stock(output) == good.flat
    data, noise = path.read_bytes(), random.Random(1)
    for _ in range(8):
        path.write_bytes(data[: noise.randrange(9000, len(data))])
        result = recover(path, output, overwrite=True)
        assert not result.complete
        saved = stock(output)
        assert saved == good.flat[: len(saved)]
        assert saved


# ---- what is refused


def test_the_input_is_not_the_output(good: Whole, tmp_path: Path) -> None:
    path, link = tmp_path / "run.mcap", tmp_path / "link.mcap"
    path.write_bytes(good.data)
    link.symlink_to(path)
    for output in (path, link):
        for overwrite in (False, True):
            with pytest.raises(OutputExistsError, match="the output is the input"):
                recover(path, output, overwrite=overwrite)
    assert path.read_bytes() == good.data


def test_existing_outputs_and_missing_inputs(good: Whole, tmp_path: Path) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "out.mcap"
    path.write_bytes(good.data)
    output.write_bytes(b"old")
    with pytest.raises(OutputExistsError):
        recover(path, output)
    with pytest.raises(MissingDataError):
        recover(path, tmp_path / "none" / "out.mcap")
    with pytest.raises(MissingDataError):
        recover(tmp_path / "none.mcap", output, overwrite=True)
    with pytest.raises(FormatError):
        recover(tmp_path, output, overwrite=True)
    path.write_bytes(good.data[:500])
    with pytest.raises(FormatError):
        recover(path, output, overwrite=True)
    assert output.read_bytes() == b"old"


@pytest.mark.parametrize("data", [b"", MAGIC, MAGIC * 2, b"time,x\n1,2\n" * 50, bytes(4096)])
def test_files_without_a_recording(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="nothing of a recording") as caught:
        recover(path, tmp_path / "out.mcap")
    assert caught.value.hint
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("position", [5000, -60], ids=["data", "index"])
def test_an_output_that_cannot_be_read_back_is_removed(
    good: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, position: int
) -> None:
    """The disk stores other bytes than were written."""
    path, output = tmp_path / "run.mcap", tmp_path / "out.mcap"
    path.write_bytes(good.data)
    read_back = recovery.verify

    def rotten(written: IO[bytes], rewriter: Rewriter) -> None:
        with open(written.name, "r+b") as stream:
            stream.seek(position, os.SEEK_END if position < 0 else os.SEEK_SET)
            stream.write(b"rotten")
        read_back(written, rewriter)

    monkeypatch.setattr(recovery, "verify", rotten)
    with pytest.raises(LocatkError, match="cannot be read back") as caught:
        recover(path, output)
    assert caught.value.exit_status == 1
    assert list(tmp_path.iterdir()) == [path]


def test_an_output_without_a_metadata_record_is_noticed(
    good: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(good.data)
    add_metadata = mcap.writer.Writer.add_metadata

    def forget_state(writer: mcap.writer.Writer, name: str, data: dict[str, str]) -> None:
        if name != "state":
            add_metadata(writer, name, data)

    monkeypatch.setattr(mcap.writer.Writer, "add_metadata", forget_state)
    with pytest.raises(LocatkError, match="other metadata"):
        recover(path, tmp_path / "out.mcap")


@pytest.mark.parametrize("options", [{}, {"use_chunking": False}])
def test_nul_in_texts_is_preserved(tmp_path: Path, options: dict[str, object]) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "out.mcap"
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)  # type: ignore[arg-type]
        writer.start()
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing\0", "json", schema, {"key": "a\0b"})
        for number in range(50):
            writer.add_message(channel, number, b"{}", number)
        writer.finish()
    result = recover(path, output)
    assert result.messages == 50
    assert result.complete
    assert not result.damaged
    assert stock(output) == stock(path)
    if not options:
        # In a damaged file the checksum of a chunk still proves its texts.
        path.write_bytes(path.read_bytes()[:-20])
        assert recover(path, output, overwrite=True).messages == 50


def test_a_file_that_changes_during_recovery(
    good: Whole, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "out.mcap"
    register = Rewriter._register

    def change_before_registration(change: Callable[[bytes], bytes]) -> None:
        def changed(rewriter: Rewriter, channel: object) -> None:
            path.write_bytes(change(path.read_bytes()))
            register(rewriter, channel)  # type: ignore[arg-type]

        monkeypatch.setattr(Rewriter, "_register", changed)

    for change in (
        lambda data: data[:20_000],
        lambda data: data[:20_000] + b"\xff" * (len(data) - 20_000),
    ):
        change_before_registration(change)
        for options in ({}, {"use_chunking": False}):
            write(path, **options)
            with pytest.raises(FormatError, match="the file changes while it is read") as caught:
                recover(path, output)
            assert "recover" not in (caught.value.hint or "")
            assert list(tmp_path.iterdir()) == [path]


def test_a_message_of_an_impossible_time_is_lost(tmp_path: Path) -> None:
    path, output = tmp_path / "run.mcap", tmp_path / "out.mcap"
    write(path, chunks=1, use_chunking=False)
    messages, data = stock(path), bytearray(path.read_bytes())
    log_time = (START_NS + 3 * 20_000_000).to_bytes(8, "little")
    data[data.index(log_time) + 7] = 0xFF
    path.write_bytes(data)
    assert recover(path, output).messages == len(messages) - 1
    assert len(list(Session.open(output).messages())) == len(messages) - 1


@pytest.mark.parametrize("has_statistics", [True, False])
def test_a_message_of_an_impossible_time_in_a_chunk_is_lost(
    tmp_path: Path, has_statistics: bool
) -> None:
    path, output = tmp_path / "late.mcap", tmp_path / "out.mcap"
    times_ns = {"/a": [5, 6, (1 << 63) - 1], "/late": [7, 1 << 63, (1 << 64) - 1]}
    with open(path, "wb") as stream:
        writer = mcap.writer.Writer(stream, use_statistics=has_statistics)
        writer.start("locatk")
        for topic, times in times_ns.items():
            channel = writer.register_channel(topic, "json", 0)
            for time_ns in times:
                writer.add_message(channel, time_ns, b"{}", 0)
        writer.finish()
    result = recover(path, output)
    assert [(each.topic, each.saved, each.lost) for each in result.topics] == [
        ("/a", 3, 0),
        ("/late", 1, 2),
    ]
    assert (result.lost_messages, result.late, result.complete) == (2, 2, False)
    saved = list(Session.open(output).messages())
    assert [(topic, time_ns) for topic, time_ns, _ in saved] == [
        *(("/a", time_ns) for time_ns in times_ns["/a"]),
        ("/late", 7),
    ]


def test_messages_of_impossible_times_alone_are_no_recording(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    with open(path, "wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start("locatk")
        writer.add_message(writer.register_channel("/late", "json", 0), 1 << 63, b"{}", 0)
        writer.finish()
    with pytest.raises(FormatError, match="all its messages have times after the year 2262"):
        recover(path, tmp_path / "out.mcap")
    assert list(tmp_path.iterdir()) == [path]


# ---- any damage at all

SMALL: list[dict[str, object]] = [
    {"chunks": 2},
    {"chunks": 2, "use_chunking": False},
    {"chunks": 2, "compression": mcap.writer.CompressionType.NONE, "enable_crcs": False},
]


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> list[bytes]:
    path = tmp_path_factory.mktemp("small") / "run.mcap"
    contents = []
    for options in SMALL:
        write(path, listed=True, **options)  # type: ignore[arg-type]
        contents.append(path.read_bytes())
    return contents


@pytest.mark.slow
@settings(max_examples=40, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    which=st.integers(0, len(SMALL) - 1),
    edits=st.lists(
        st.tuples(
            st.floats(0, 1),
            st.integers(0, 400),
            st.binary(max_size=60) | st.integers(0, 400).map(bytes),
        ),
        max_size=6,
    ),
)
def test_any_damage(
    small: list[bytes],
    tmp_path_factory: pytest.TempPathFactory,
    which: int,
    edits: list[tuple[float, int, bytes]],
) -> None:
    """No exception but those of locatk, and no output that cannot be read."""
    folder = tmp_path_factory.mktemp("any")
    data = small[which]
    for share, cut, put in edits:
        place = int(share * len(data))
        data = data[:place] + put + data[place + cut :]
    path, output = folder / "run.mcap", folder / "out.mcap"
    path.write_bytes(data)
    with contextlib.suppress(LocatkError):
        result = recover(path, output)
        assert len(stock(output)) == result.messages
        assert len(list(Session.open(output).messages())) == result.messages
        return
    assert not output.exists()


def test_unconfirmed_names_are_reported(good: Whole, tmp_path: Path) -> None:
    data = bytearray(good.data)
    for chunk_start, _ in good.chunks[:1]:
        data[chunk_start + 100] ^= 1
    at = data.rindex(b"/serial/bar")  # in the index
    data[at + 1] ^= 1
    path, output = tmp_path / "bad.mcap", tmp_path / "out.mcap"
    path.write_bytes(data)
    result = recover(path, output)
    assert "/rerial/bar" in result.unconfirmed
    assert not result.complete
    damage = Session.open(path, damaged_ok=True).damage
    assert damage is not None
    assert "only it contains the names of" in damage
    assert "/rerial/bar" in Session.open(output).metadata()["recovered"]["unconfirmed"]


def test_a_name_that_is_not_utf8(good: Whole, tmp_path: Path) -> None:
    path, output = tmp_path / os.fsdecode(b"bad\xff.mcap"), tmp_path / "out.mcap"
    path.write_bytes(good.data)
    recover(path, output)
    assert Session.open(output).metadata()["recovered"]["source"] == r"bad\xff.mcap"
