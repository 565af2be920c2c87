"""The files of a recording: each whole in itself, readable up to the last flush."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.Log_pb2 import Log

from locatk.core.errors import LocatkError, MissingDataError, OutputExistsError
from locatk.formats.capture import recording_files as live_file
from locatk.formats.capture import recording_files as parts
from locatk.formats.capture.ingestion import StampedMessage
from locatk.formats.capture.recording_files import (
    LOG_NAME,
    DiskFullError,
    FileContent,
    RecordingFiles,
    check_outputs,
    part_path,
)
from locatk.formats.schemas.serial_pb2 import Readings, SerialChunk
from locatk.formats.sessions.mcap_writer import MAX_CHUNK_BYTES
from locatk.formats.sessions.messages import timestamp
from locatk.formats.sessions.reader import Session

START_NS = 1_700_000_000_000_000_000
TOPIC = "/serial/robot"
CONTENT = FileContent(
    facts={"port": "/dev/ttyACM0", "meta:robot": "7"},
    artifacts={"tag.toml": "a = 1\n"},
    declared=[(TOPIC, SerialChunk)],
)


def chunk(data: bytes, offset: int = 0, time_ns: int = START_NS) -> StampedMessage:
    message = SerialChunk(timestamp=timestamp(time_ns), byte_offset=offset, data=data)
    return StampedMessage(TOPIC, message, time_ns, time_ns)


def contents(path: Path) -> bytes:
    session = Session.open(path, damaged_ok=True)
    return b"".join(message.data for _, message in session.decoded(TOPIC, SerialChunk))


def test_names_of_parts() -> None:
    assert part_path(Path("a/run.mcap"), 1) == Path("a/run-001.mcap")
    assert part_path(Path("run"), 12) == Path("run-012")
    assert part_path(Path("run.2.mcap"), 1234) == Path("run.2-1234.mcap")


def test_one_file_with_all_messages(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    made = RecordingFiles(path, CONTENT)
    made.write([chunk(b"first")])
    made.system("polaris")
    made.system("")
    made.attach({"array.toml": "b = 2\n", "tag.toml": "another"})
    made.log("it happened", START_NS + 5)
    made.finish({"ended": "stopped"})
    session = Session.open(path)
    assert session.damage is None
    assert session.profile == "locatk"
    assert session.facts["system"] == "polaris"
    assert session.metadata()["capture"] == {**CONTENT.facts, "ended": "stopped"}
    assert sorted(each.name for each in session.attachments()) == ["array.toml", "tag.toml"]
    assert session.attachment("tag.toml") == b"a = 1\n"
    assert session.attachment("array.toml") == b"b = 2\n"
    ((time_ns, line),) = session.decoded("/log", Log)
    assert (time_ns, line.message, line.name) == (START_NS + 5, "it happened", LOG_NAME)
    assert line.level == Log.WARNING
    assert contents(path) == b"first"
    assert made.paths == [path]
    assert made.bytes_written == path.stat().st_size


def test_streams_without_a_message_are_known_too(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT)
    made.finish({})
    session = Session.open(tmp_path / "run.mcap")
    assert {each.topic: each.schema for each in session.channels} == {
        TOPIC: "locatk.SerialChunk",
        "/log": "foxglove.Log",
    }


def test_flushed_data_survive_a_killed_program(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT)
    made.flush()
    made.write([chunk(b"kept")])
    made.flush()
    made.write([chunk(b"lost", 4)])
    killed = shutil.copy(tmp_path / "run.mcap", tmp_path / "killed.mcap")
    made.finish({})
    session = Session.open(killed, damaged_ok=True)
    assert session.damage
    assert contents(Path(killed)) == b"kept"
    assert session.metadata()["capture"]["port"] == "/dev/ttyACM0"
    assert session.attachment("tag.toml") == b"a = 1\n"
    assert contents(tmp_path / "run.mcap") == b"keptlost"


def test_a_new_topic_is_there_when_the_program_is_killed(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT)
    made.write([chunk(b"x")])
    made.flush()
    made.write([StampedMessage("/readings/robot", Readings(device="robot"), START_NS, START_NS)])
    made.flush()
    killed = shutil.copy(tmp_path / "run.mcap", tmp_path / "killed.mcap")
    made.finish({})
    ((_, message),) = Session.open(killed, damaged_ok=True).decoded("/readings/robot", Readings)
    assert message.device == "robot"


def test_no_chunk_exceeds_the_reserved_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[int] = []
    room = 0

    def make_room(self: live_file.LiveFile, more: int) -> None:
        nonlocal room
        room = self.tell() + more

    real = live_file.LiveFile.write

    def write(self: live_file.LiveFile, data: bytes) -> int:
        written.append(len(data))
        count = real(self, data)
        assert not room or self.tell() <= room
        return count

    made = RecordingFiles(tmp_path / "run.mcap", CONTENT)
    monkeypatch.setattr(live_file.LiveFile, "make_room", make_room)
    monkeypatch.setattr(live_file.LiveFile, "write", write)
    made.flush()
    sent = [os.urandom(size) for size in (1, 100_000, 400_000, 5, 600_000, 300_000, 300_000)]
    offset = 0
    for data in sent * 3:
        made.write([chunk(data, offset)])
        offset += len(data)
    made.finish({})
    assert max(written) > 500_000
    assert contents(tmp_path / "run.mcap") == b"".join(sent * 3)


def test_space_is_reserved_for_pending_chunks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A silent line, flushed five times a second for a day, needs no more of the disk."""
    asked: list[int] = []
    monkeypatch.setattr(live_file.LiveFile, "make_room", lambda self, more: asked.append(more))
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT)
    for _ in range(2000):
        made.flush()
    made.finish({})
    assert max(asked) - min(asked) < 100_000


# ---- parts


def test_parts_are_whole_in_themselves(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True)
    made.write([chunk(b"one")])
    made.system("landmarks")
    made.attach({"halls.toml": "h = 1\n"})
    made.next_part({"ended": "goes on"})
    made.write([chunk(b"two", 3)])
    made.next_part({"ended": "goes on"})
    made.finish({"ended": "stopped"})
    paths = [tmp_path / f"run-{number:03d}.mcap" for number in (1, 2, 3)]
    assert made.paths == paths
    assert sorted(tmp_path.iterdir()) == paths
    assert [contents(path) for path in paths] == [b"one", b"two", b""]
    for number, path in enumerate(paths, 1):
        session = Session.open(path)
        assert session.facts["system"] == "landmarks"
        assert session.metadata()["capture"]["part"] == str(number)
        assert session.metadata()["capture"]["meta:robot"] == "7"
        assert session.attachment("tag.toml") == b"a = 1\n"
        assert session.attachment("halls.toml") == b"h = 1\n"
        assert {TOPIC, "/log"} <= {each.topic for each in session.channels}
        ended = session.metadata()["capture"]["ended"]
        assert ended == ("stopped" if number == 3 else "goes on")
    assert made.bytes_written == sum(path.stat().st_size for path in paths)


def test_the_size_of_a_part_is_its_own(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True)
    made.write([chunk(os.urandom(300_000))])
    made.flush()
    assert made.part_bytes == made.bytes_written > 300_000
    made.next_part({})
    assert made.part_bytes < 10_000
    assert made.bytes_written > 300_000 + made.part_bytes
    made.finish({})


@pytest.mark.parametrize("number", [1, 2, 7])
def test_outputs_that_are_there_are_refused_ahead(tmp_path: Path, number: int) -> None:
    """A part that cannot be begun would end the recording in the middle."""
    part_path(tmp_path / "run.mcap", number).write_bytes(b"old")
    with pytest.raises(OutputExistsError):
        check_outputs(tmp_path / "run.mcap", numbered=True, overwrite=False)
    check_outputs(tmp_path / "run.mcap", numbered=True, overwrite=True)
    check_outputs(tmp_path / "run.mcap", numbered=False, overwrite=False)


def test_names_that_resemble_parts_are_ignored(tmp_path: Path) -> None:
    for name in ("run.mcap", "run-x.mcap", "run-001.csv", "other-001.mcap", "run-001-b.mcap"):
        (tmp_path / name).write_bytes(b"")
    check_outputs(tmp_path / "run.mcap", numbered=True, overwrite=False)
    with pytest.raises(MissingDataError):
        check_outputs(tmp_path / "no" / "run.mcap", numbered=True, overwrite=False)


def test_parts_of_an_older_recording_do_not_stay_among_the_new(tmp_path: Path) -> None:
    for number in (1, 2, 3, 4):
        part_path(tmp_path / "run.mcap", number).write_bytes(b"old")
    (tmp_path / "run-x.mcap").write_bytes(b"another")
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True, overwrite=True)
    made.next_part({})
    made.finish({})
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["run-001.mcap", "run-002.mcap", "run-x.mcap"]


@pytest.mark.skipif(sys.platform == "win32", reason="no flock")
def test_parts_that_are_being_written_are_not_replaced(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True)
    made.write([chunk(b"one")])
    made.next_part({})
    made.write([chunk(b"two", 3)])
    with pytest.raises(OutputExistsError, match="being recorded"):
        RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True, overwrite=True)
    made.finish({})
    assert [contents(path) for path in made.paths] == [b"one", b"two"]


def test_a_part_that_cannot_be_begun_leaves_the_one_before_whole(tmp_path: Path) -> None:
    made = RecordingFiles(tmp_path / "run.mcap", CONTENT, numbered=True)
    made.write([chunk(b"one")])
    part_path(tmp_path / "run.mcap", 2).mkdir()
    with pytest.raises(LocatkError):
        made.next_part({"ended": "goes on"})
    assert contents(tmp_path / "run-001.mcap") == b"one"
    assert Session.open(tmp_path / "run-001.mcap").metadata()["capture"]["ended"] == "goes on"
    assert made.paths == [tmp_path / "run-001.mcap"]


# ---- a full disk


def fill(made: RecordingFiles, size: int, pieces: list[bytes]) -> None:
    """Write for ever, and note what."""
    while True:
        pieces.append(os.urandom(size))
        made.write([chunk(pieces[-1], size * (len(pieces) - 1))])


def test_a_full_disk_leaves_a_whole_file(small_disk: Path) -> None:
    path = small_disk / "run.mcap"
    made = RecordingFiles(path, CONTENT)
    pieces: list[bytes] = []
    with pytest.raises(DiskFullError):
        fill(made, 50_000, pieces)
    sent = b"".join(pieces)
    made.finish({"ended": "full"})
    session = Session.open(path)
    assert session.metadata()["capture"]["ended"] == "full"
    assert contents(path) == sent


@pytest.mark.parametrize("size", [700_000, 3_000_000])
def test_a_full_disk_leaves_a_whole_file_of_large_messages(small_disk: Path, size: int) -> None:
    """Pictures of a camera are larger than a chunk."""
    path = small_disk / "run.mcap"
    made = RecordingFiles(path, CONTENT)
    pieces: list[bytes] = []
    with pytest.raises(DiskFullError):
        fill(made, size, pieces)
    made.finish({"ended": "full"})
    session = Session.open(path)
    kept = contents(path)
    assert len(kept) >= size * (len(pieces) - 1)
    assert b"".join(pieces).startswith(kept)
    assert session.metadata()["capture"]["ended"] == "full"


def test_a_message_too_large_for_the_disk_is_omitted(small_disk: Path) -> None:
    path = small_disk / "run.mcap"
    made = RecordingFiles(path, CONTENT)
    made.flush()
    made.write([chunk(os.urandom(3_000_000))])
    with pytest.raises(DiskFullError):
        made.write([chunk(os.urandom(6_600_000), 3_000_000)])
    made.finish({"ended": "full"})
    assert len(contents(path)) == 3_000_000
    assert Session.open(path).metadata()["capture"]["ended"] == "full"


def test_half_of_what_the_writer_writes_unasked() -> None:
    """Should the writer write chunks of its own accord earlier, no room would be made for them."""
    assert MAX_CHUNK_BYTES >= 2 * parts.CHUNK_BYTES
