"""Sessions: complete files, readable by other tools, with damage reported."""

from __future__ import annotations

import random
import struct
import tracemalloc
from pathlib import Path
from typing import IO

import lz4.frame
import mcap.reader
import mcap.writer
import pytest
import zstandard
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Chunk
from mcap_protobuf.decoder import DecoderFactory

from locatk.core.errors import (
    FormatError,
    InputError,
    LocatkError,
    MissingDataError,
    OutputExistsError,
)
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions import mcap_file
from locatk.formats.sessions.foxglove import read_trajectory
from locatk.formats.sessions.reader import AttachmentInfo, Channel, RandomAccess, Session
from locatk.formats.sessions.writer import PROFILE, SessionWriter

CHUNKS = 3000


def payload(number: int) -> bytes:
    return random.Random(number).randbytes(900)


def write(path: Path, chunks: int = CHUNKS, **options: bool) -> None:
    """A session of about 3 MB: several MCAP chunks on two topics."""
    with SessionWriter(path, system="lighthouse", facts={"place": "lab"}, **options) as writer:
        writer.attach("scene.toml", b"x = 1\n", "application/toml", 7)
        writer.metadata("facts", {"a": "1"})
        for number in range(chunks):
            message = SerialChunk(port="p", byte_offset=number, data=payload(number))
            writer.write(f"/raw/{number % 2}", message, 1000 + number)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("session") / "run.mcap"
    write(path)
    return path


def everything(session: Session) -> list[object]:
    """All that can be read of a session, read."""
    return [
        session.channels,
        session.metadata(),
        session.attachments(),
        [session.attachment(entry.name) for entry in session.attachments()],
        list(session.messages()),
    ]


def test_round_trip(file: Path) -> None:
    session = Session.open(file)
    assert session.profile == PROFILE
    assert session.channels == (
        Channel("/raw/0", "locatk.SerialChunk", "protobuf", CHUNKS // 2),
        Channel("/raw/1", "locatk.SerialChunk", "protobuf", CHUNKS // 2),
    )
    assert (session.start_ns, session.end_ns) == (1000, 1000 + CHUNKS - 1)
    assert session.damage is None
    assert session.attachments() == (AttachmentInfo("scene.toml", "application/toml", 6, 7),)
    assert session.attachment("scene.toml") == b"x = 1\n"
    assert session.attachment("none") is None
    facts = session.facts
    assert facts.pop("tool_version")
    assert facts == {
        "format_version": "1",
        "kind": "session",
        "system": "lighthouse",
        "place": "lab",
    }
    assert session.metadata()["facts"] == {"a": "1"}
    assert session.topics("/raw/") == ("/raw/0", "/raw/1")
    assert session.topics("/raw/", "other.Schema") == ()
    decoded = list(session.decoded("/raw/1", SerialChunk))
    assert [time_ns for time_ns, _ in decoded] == list(range(1001, 1000 + CHUNKS, 2))
    assert decoded[5][1].data == payload(11)
    assert [topic for topic, _, _ in session.messages()][:3] == ["/raw/0", "/raw/1", "/raw/0"]
    assert {topic for topic, _, _ in session.messages(["/raw/1"])} == {"/raw/1"}


def test_equal_calls_give_equal_bytes(file: Path, tmp_path: Path) -> None:
    write(tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == file.read_bytes()


def test_the_library_reads_sessions(file: Path) -> None:
    with open(file, "rb") as stream:
        reader = mcap.reader.make_reader(
            stream, validate_crcs=True, decoder_factories=[DecoderFactory()]
        )
        assert reader.get_header().profile == PROFILE
        assert [entry.name for entry in reader.iter_metadata()] == ["locatk", "facts"]
        assert [entry.data for entry in reader.iter_attachments()] == [b"x = 1\n"]
        found = [
            (channel.topic, message.log_time, decoded.byte_offset, decoded.data)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]
    assert found == [(f"/raw/{n % 2}", 1000 + n, n, payload(n)) for n in range(CHUNKS)]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_nothing_is_left_after_an_exception(tmp_path: Path, error: type[BaseException]) -> None:
    def record() -> None:
        with SessionWriter(tmp_path / "run.mcap", system="dots") as writer:
            writer.write("/raw", SerialChunk(data=b"x"), 1)
            raise error

    with pytest.raises(error):
        record()
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(b"old")
    with pytest.raises(OutputExistsError):
        write(path, 1)
    assert path.read_bytes() == b"old"
    write(path, 1, overwrite=True)
    assert len(list(Session.open(path).messages())) == 1


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        write(tmp_path / "no" / "run.mcap", 1)


def test_times_before_1970_are_refused(tmp_path: Path) -> None:
    def record() -> None:
        with SessionWriter(tmp_path / "run.mcap", system="dots") as writer:
            writer.write("/raw", SerialChunk(), -1)

    with pytest.raises(InputError, match="range of MCAP"):
        record()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_session(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with SessionWriter(path, system="dots"):
        pass
    session = Session.open(path)
    assert (session.start_ns, session.end_ns, session.channels) == (None, None, ())
    assert list(session.messages()) == []


def test_a_topic_has_one_schema(file: Path) -> None:
    from locatk.formats.schemas.poses_pb2 import Odometry

    with pytest.raises(FormatError, match=r"locatk\.SerialChunk"):
        list(Session.open(file).decoded("/raw/0", Odometry))


# ---- files that are not what they should be


def one_line(error: LocatkError) -> None:
    assert "\n" not in str(error)
    assert error.file is not None


@pytest.mark.parametrize(
    "content", [b"", b"time,x,y\n1,2,3\n" * 50, b"\x89MCAP", b"\x00" * 5000, b"\x89MCAP0\r\n"]
)
@pytest.mark.parametrize("damaged_ok", [False, True])
def test_other_files(tmp_path: Path, content: bytes, damaged_ok: bool) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(FormatError) as caught:
        Session.open(path, damaged_ok=damaged_ok)
    one_line(caught.value)
    assert caught.value.hint


def test_missing_file_and_folder(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        Session.open(tmp_path / "none.mcap")
    with pytest.raises(FormatError):
        Session.open(tmp_path)


@pytest.mark.parametrize("cuts", [9, pytest.param(60, marks=pytest.mark.slow)])
def test_truncated_files_are_errors_and_their_rest_is_readable(
    file: Path, tmp_path: Path, cuts: int
) -> None:
    whole = file.read_bytes()
    messages = list(Session.open(file).messages())
    path = tmp_path / "cut.mcap"
    rng = random.Random(1)
    lengths = [1, 8, 20, len(whole) - 1, len(whole) - 9, len(whole) - 40]
    lengths += [rng.randrange(8, len(whole)) for _ in range(cuts)]
    most = 0
    for cut in lengths:
        path.write_bytes(whole[:cut])
        with pytest.raises(FormatError) as caught:
            Session.open(path)
        one_line(caught.value)
        if cut < 200:  # before the first record of the data
            continue
        session = Session.open(path, damaged_ok=True)
        assert session.damage
        left = list(session.messages())
        assert left == messages[: len(left)]
        assert sum(channel.count for channel in session.channels) == len(left)
        most = max(most, len(left))
    assert most == CHUNKS


def test_zeroed_tail_of_a_power_cut(file: Path, tmp_path: Path) -> None:
    whole = file.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) * 2 // 3] + bytes(len(whole) // 3))
    with pytest.raises(FormatError):
        Session.open(path)
    assert list(Session.open(path, damaged_ok=True).messages())


@pytest.mark.parametrize("flips", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_flipped_bits_never_change_data(tmp_path: Path, flips: int) -> None:
    """The result is an error of one line, or the original messages and attachments."""
    good = tmp_path / "good.mcap"
    write(good, 40)
    whole = good.read_bytes()
    expected = everything(Session.open(good))
    path = tmp_path / "bad.mcap"
    rng = random.Random(2)
    errors = 0
    for place in [rng.randrange(len(whole)) for _ in range(flips)]:
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.randrange(8)
        path.write_bytes(damaged)
        try:
            found = everything(Session.open(path))
        except LocatkError as error:
            one_line(error)
            errors += 1
        else:
            assert found[0] == expected[0]
            assert found[2:] == expected[2:]
        try:  # what `locatk info` does
            everything(Session.open(path, damaged_ok=True))
        except LocatkError as error:
            one_line(error)
    assert errors > 0.8 * flips


def test_a_flipped_byte_in_a_chunk_names_the_checksum(file: Path, tmp_path: Path) -> None:
    whole = bytearray(file.read_bytes())
    whole[len(whole) // 2] ^= 1
    path = tmp_path / "bad.mcap"
    path.write_bytes(whole)
    with pytest.raises(FormatError, match="chunk is damaged") as caught:
        list(Session.open(path).messages())
    one_line(caught.value)
    assert caught.value.hint


def test_a_flipped_byte_in_an_attachment(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    path.write_bytes(file.read_bytes().replace(b"x = 1\n", b"x = 3\n"))
    with pytest.raises(FormatError, match=r"scene\.toml is damaged") as caught:
        Session.open(path).attachment("scene.toml")
    one_line(caught.value)


def test_garbage_behind_the_magic(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    rng = random.Random(3)
    for _ in range(40):
        path.write_bytes(b"\x89MCAP0\r\n" + rng.randbytes(rng.randrange(300)))
        for damaged_ok in (False, True):
            with pytest.raises(FormatError):
                Session.open(path, damaged_ok=damaged_ok)


# ---- MCAP of other tools


def foreign(path: Path, **options: object) -> None:
    with open(path, "wb") as stream:
        writer = mcap.writer.Writer(stream, **options)  # type: ignore[arg-type]
        writer.start()
        schema = writer.register_schema("Thing", "jsonschema", b"{}")
        channel = writer.register_channel("/thing", "json", schema)
        silent = writer.register_channel("/silent", "json", 0)
        assert silent
        for number in range(100):
            writer.add_message(channel, 50 - number % 7, b'{"n": %d}' % number, 0)
        writer.add_metadata("who", {"me": "you"})
        writer.add_attachment(1, 2, "a.txt", "text/plain", b"abc")
        writer.finish()


NONE = mcap.writer.CompressionType.NONE
LZ4 = mcap.writer.CompressionType.LZ4


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": LZ4},
        {"compression": NONE, "enable_crcs": False},
        {"chunk_size": 300},
        {"use_chunking": False},
        {"use_statistics": False},
        {"repeat_channels": False},
        {"index_types": mcap.writer.IndexType.NONE},
        {"index_types": mcap.writer.IndexType.CHUNK},
        {
            "index_types": mcap.writer.IndexType.NONE,
            "repeat_channels": False,
            "repeat_schemas": False,
            "use_statistics": False,
            "use_summary_offsets": False,
        },
    ],
)
def test_mcap_of_other_tools(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "other.mcap"
    foreign(path, **options)
    session = Session.open(path)
    assert session.facts == {}
    assert session.profile == ""
    assert session.damage is None
    assert (session.start_ns, session.end_ns) == (44, 50)
    assert Channel("/thing", "Thing", "json", 100) in session.channels
    assert Channel("/silent", "", "json", 0) in session.channels
    assert session.metadata() == {"who": {"me": "you"}}
    assert session.attachment("a.txt") == b"abc"
    messages = list(session.messages())
    assert messages == [("/thing", 50 - n % 7, b'{"n": %d}' % n) for n in range(100)]


@pytest.fixture
def rare(tmp_path: Path) -> Path:
    """A session of which one topic has a twentieth of the messages, in several chunks."""
    path = tmp_path / "rare.mcap"
    with SessionWriter(path, system="lighthouse") as writer:
        for number in range(CHUNKS):
            message = SerialChunk(port="p", byte_offset=number, data=payload(number))
            writer.write("/rare" if number % 20 == 3 else "/raw/0", message, 1000 + number)
    return path


def rare_messages(path: Path) -> list[int]:
    """Numbers of the messages of the rare topic, as read."""
    messages = Session.open(path).messages(["/rare"])
    return [SerialChunk.FromString(data).byte_offset for _, _, data in messages]


def test_few_messages_are_read_by_the_index(rare: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = list(range(3, CHUNKS, 20))
    assert rare_messages(rare) == numbers
    session = Session.open(rare)

    def refuse(*_: object) -> None:
        raise AssertionError("all messages were scanned")

    monkeypatch.setattr(mcap_file, "iter_records", refuse)
    assert len(list(session.messages(["/rare"]))) == len(numbers)
    with pytest.raises(AssertionError, match="scanned"):
        list(session.messages(["/raw/0"]))


@pytest.mark.parametrize("change", ["other message", "other channel", "no message", "twice"])
def test_a_wrong_message_index_is_not_used(rare: Path, change: str) -> None:
    """All messages of the chunk are scanned instead."""
    session = Session.open(rare)
    segment = session.index.segments[1]
    offsets = dict(segment.message_indexes)
    number = next(iter(session.channel_ids(["/rare"])))
    entries = offsets[number] + 9 + 6
    data = bytearray(rare.read_bytes())
    second = data[entries + 16 : entries + 32]
    if change == "other message":
        data[entries : entries + 8] = second[:8]
    elif change == "other channel":
        (other,) = session.channel_ids(["/raw/0"])
        data[entries : entries + 16] = data[offsets[other] + 15 :][:16]
    elif change == "no message":
        data[entries + 8] ^= 1
    else:
        data[entries : entries + 16] = second
    rare.write_bytes(data)
    assert rare_messages(rare) == list(range(3, CHUNKS, 20))


def test_messages_missing_from_the_index_are_noticed(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_index = mcap_file.read_summary

    def forgetful(stream: IO[bytes]) -> mcap_file.Index | None:
        index = read_index(stream)
        assert index is not None
        del index.segments[0]
        return index

    monkeypatch.setattr(mcap_file, "read_summary", forgetful)
    with pytest.raises(FormatError, match="messages instead of"):
        list(Session.open(file).messages())
    session = Session.open(file)
    with pytest.raises(FormatError, match="messages instead of"):
        RandomAccess(session).positions("/raw/0")


def test_a_summary_with_a_wrong_checksum_is_an_error(file: Path, tmp_path: Path) -> None:
    data = bytearray(file.read_bytes())
    summary_start, _, _ = struct.unpack("<QQI", data[-28:-8])
    summary = bytes(data[summary_start : -8 - mcap_file.FOOTER_BYTES])
    (statistics,) = [
        start
        for opcode, start, _ in mcap_file.iter_records(summary, 0)
        if opcode == Opcode.STATISTICS
    ]
    data[summary_start + statistics] ^= 2  # the number of messages; all lengths still agree
    path = tmp_path / "bad.mcap"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="summary is damaged"):
        Session.open(path)


def test_damage_of_a_file_without_index_is_described(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    foreign(path, index_types=mcap.writer.IndexType.NONE, chunk_size=300)
    data = path.read_bytes()
    position = data.index(bytes([Opcode.CHUNK]), 500)
    path.write_bytes(data[: position + 60] + b"\xff" + data[position + 61 :])
    with pytest.raises(FormatError, match="a damaged chunk at byte") as caught:
        Session.open(path)
    assert "recover" in (caught.value.hint or "")
    session = Session.open(path, damaged_ok=True)
    assert session.damage is not None
    assert session.damage.startswith("a damaged chunk at byte ")
    assert 0 < len(list(session.messages())) < 100


def test_a_damaged_metadata_record_of_a_file_without_index_is_described(tmp_path: Path) -> None:
    path = tmp_path / "bad.mcap"
    foreign(path, index_types=mcap.writer.IndexType.NONE)
    path.write_bytes(path.read_bytes().replace(b"\3\0\0\0who", b"\3\0\0\1who"))
    with pytest.raises(FormatError, match="a damaged metadata record at byte"):
        Session.open(path)


def test_a_damaged_metadata_record_is_named(file: Path, tmp_path: Path) -> None:
    data = bytearray(file.read_bytes())
    offset = data.index(bytes([Opcode.METADATA]), len(mcap_file.MAGIC) + 9)
    while data[offset + 9 : offset + 19] != b"\x06\0\0\0locatk":
        offset = data.index(bytes([Opcode.METADATA]), offset + 1)
    data[offset] = 0x7F
    path = tmp_path / "bad.mcap"
    path.write_bytes(data)
    with pytest.raises(FormatError, match="no metadata record where the index names one") as caught:
        Session.open(path)
    assert caught.value.where == f"byte {offset}"


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"index_types": mcap.writer.IndexType.NONE},
        {"enable_crcs": False},
        {"use_chunking": False},
    ],
)
def test_nul_in_texts(tmp_path: Path, options: dict[str, object]) -> None:
    path = tmp_path / "nul.mcap"
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, **options)  # type: ignore[arg-type]
        writer.start()
        writer.add_metadata("who", {"me": "\0"})
        schema = writer.register_schema("Thing\0", "jsonschema", b"{}")
        channel = writer.register_channel("/thing\0", "json", schema, {"key\0": "\0"})
        for number in range(50):
            writer.add_message(channel, number, b"{}", number)
        writer.finish()
    session = Session.open(path)
    assert session.damage is None
    assert session.channels == (Channel("/thing\0", "Thing\0", "json", 50),)
    assert session.metadata() == {"who": {"me": "\0"}}
    assert len(list(session.messages())) == 50


def test_the_hint_quotes_the_path(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "my run.mcap"
    path.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(FormatError) as caught:
        Session.open(path)
    assert f"locatk recover '{path}' -o" in (caught.value.hint or "")


# ---- single messages


def test_single_messages_are_checked(file: Path) -> None:
    session = Session.open(file)
    access = RandomAccess(session)
    position = access.positions("/raw/1")[3]
    message = SerialChunk.FromString(access.payload(position))
    assert (message.byte_offset, message.data) == (7, payload(7))
    wrong = [
        position._replace(offset=position.offset + 1),
        position._replace(offset=1 << 40),
        position._replace(channel=position.channel + 1),
        position._replace(time_ns=position.time_ns + 1),
    ]
    for each in wrong:
        with pytest.raises(FormatError, match="not there"):
            access.payload(each)
    with file.open("rb") as stream:
        data = bytes(mcap_file.read_segment(stream, position.segment))
    with pytest.raises(mcap_file.DamageError):
        mcap_file.message_payload(data[: position.offset + 100], position)


@pytest.mark.parametrize(
    "data",
    [
        b"\x05\x03",
        struct.pack("<BQ", Opcode.MESSAGE, 21) + bytes(21),  # shorter than the head of a message
        struct.pack("<BQ", Opcode.SCHEMA, 9) + bytes(8),
        struct.pack("<BQ", Opcode.SCHEMA, 2**64 - 1) + bytes(8),
    ],
)
def test_records_of_wrong_length_are_damage(data: bytes) -> None:
    with pytest.raises(mcap_file.DamageError) as caught:
        list(mcap_file.iter_records(data, 77))
    assert caught.value.offset == 77


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunks_larger_than_stated_take_little_memory(compression: str) -> None:
    zeros = bytes(8 << 20)
    pack = zstandard.compress if compression == "zstd" else lz4.frame.compress
    builder = RecordBuilder()
    Chunk(compression, pack(zeros), 0, 0, 0, 10).write(builder)
    content = builder.end()[mcap_file.RECORD_HEAD.size :]
    tracemalloc.start()
    try:
        with pytest.raises(mcap_file.DamageError):
            mcap_file.decompress(content, 0)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("time_ns", [1 << 63, (1 << 64) - 1])
def test_times_after_2262_are_refused(tmp_path: Path, time_ns: int) -> None:
    path = tmp_path / "late.mcap"
    with open(path, "wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start("locatk")
        channel = writer.register_channel("/late", "json", 0)
        writer.add_message(channel, 5, b"1", time_ns)  # the time of publication is not used
        writer.add_message(channel, time_ns, b"2", 5)
        writer.finish()
    session = Session.open(path)
    problem = f"late.mcap:/late: a message has the time {time_ns} ns, after the year 2262"
    with pytest.raises(FormatError, match=problem) as caught:
        list(session.messages())
    assert f"locatk recover {path}" in (caught.value.hint or "")
    with pytest.raises(FormatError, match=problem):
        RandomAccess(session).positions("/late")


def test_times_of_poses_after_2262_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    with SessionWriter(path, system="") as writer:
        writer.write("/pose", PoseInFrame(timestamp=Timestamp(seconds=1 << 62)), 0)
    with pytest.raises(FormatError, match="after the year 2262"):
        read_trajectory(Session.open(path), "/pose", "red")
