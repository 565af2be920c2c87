"""`locatk recover`, and what `locatk info` says of the files it is for."""

from __future__ import annotations

import json
from pathlib import Path

import mcap.writer
import pytest

from locatk.formats.sessions.reader import Session


@pytest.fixture
def chunked(session: Path) -> Path:
    """The session again, in many chunks."""
    found = Session.open(session)
    schemas: dict[int, int] = {}
    channels: dict[str, int] = {}
    path = session.with_name("chunked.mcap")
    with path.open("wb") as stream:
        writer = mcap.writer.Writer(stream, chunk_size=300)
        writer.start("locatk", "tests")
        writer.add_metadata("locatk", found.facts)
        scene = found.attachment("scene.toml")
        assert scene is not None
        writer.add_attachment(0, 0, "scene.toml", "application/toml", scene)
        for channel in found.index.channels.values():
            schema = found.index.schemas[channel.schema_id]
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            channels[channel.topic] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas[schema.id]
            )
        for topic, time_ns, payload in found.messages():
            writer.add_message(channels[topic], time_ns, payload, time_ns)
            if writer._Writer__statistics.message_count == 1:
                writer.flush()
        writer.finish()
    return path


def damage(path: Path, *, share: float = 0.4) -> Path:
    """Flip a bit of a chunk."""
    data = bytearray(path.read_bytes())
    segments = Session.open(path).index.segments
    data[segments[int(share * len(segments))].offset + 80] ^= 1
    path.write_bytes(data)
    return path


def test_a_complete_file(locatk, chunked: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.mcap"
    result = locatk("recover", chunked, "-o", out)
    assert result.exit_code == 0, result.stderr
    assert result.stderr == ""
    assert result.stdout.startswith(f"Wrote {out}: ")
    assert "/truth/red" in result.stdout
    assert list(Session.open(out).messages()) == list(Session.open(chunked).messages())


def test_json(locatk, chunked: Path, tmp_path: Path) -> None:
    count = len(list(Session.open(chunked).messages()))
    out = tmp_path / "out.mcap"
    result = locatk("recover", damage(chunked), "-o", out, "--json")
    assert result.exit_code == 3
    answer = json.loads(result.stdout)
    assert set(answer) == {
        *("version", "source", "output", "bytes", "complete", "damaged", "ended", "messages"),
        *("chunks", "attachments", "metadata", "topics", "lost_messages", "lost_attachments"),
        *(
            "lost_metadata",
            "lost_bytes",
            "tail_bytes",
            "damaged_chunks",
            "orphans",
            "late",
            "nameless",
        ),
        *("unconfirmed", "losses"),
    }
    assert (answer["version"], answer["source"], answer["output"]) == (1, str(chunked), str(out))
    assert answer["bytes"] == out.stat().st_size
    assert (answer["complete"], answer["ended"], answer["damaged_chunks"]) == (False, True, 1)
    assert answer["messages"] + answer["lost_messages"] == count
    assert sum(topic["saved"] for topic in answer["topics"]) == answer["messages"]
    assert sum(topic["lost"] for topic in answer["topics"]) == answer["lost_messages"] > 0
    [loss] = answer["losses"]
    assert loss["what"] == "chunk"
    assert loss["end"] - loss["start"] == answer["lost_bytes"]
    assert loss["start_ns"] <= loss["end_ns"]
    assert len(list(Session.open(out).messages())) == answer["messages"]


def test_losses_are_one_line(locatk, chunked: Path, tmp_path: Path) -> None:
    result = locatk("recover", damage(chunked), "-o", tmp_path / "out.mcap")
    assert result.exit_code == 3
    assert result.stderr.startswith(f"Incomplete: {chunked}: lost ")
    assert "at 1 place" in result.stderr
    assert result.stderr.count("\n") == 1
    assert "chunk" in result.stdout
    assert "from byte" in result.stdout


def test_a_recording_without_an_end(locatk, chunked: Path, tmp_path: Path) -> None:
    data = chunked.read_bytes()
    last = Session.open(chunked).index.segments[-1]
    chunked.write_bytes(data[: last.offset + 50])
    out = tmp_path / "out.mcap"
    result = locatk("recover", chunked, "-o", out)
    assert result.exit_code == 3
    assert "the end (50 bytes of it remain) and the data after it" in result.stderr
    assert "?" in result.stdout  # how much is not known
    assert locatk("info", out).exit_code == 0
    again = locatk("recover", out, "-o", tmp_path / "again.mcap")
    assert again.exit_code == 0


def test_a_damaged_index_is_no_loss(locatk, chunked: Path, tmp_path: Path) -> None:
    data = bytearray(chunked.read_bytes())
    data[-20] ^= 1
    chunked.write_bytes(data)
    result = locatk("recover", chunked, "-o", tmp_path / "out.mcap")
    assert result.exit_code == 0
    assert "rebuilt" in result.stderr
    quiet = locatk("recover", chunked, "-o", tmp_path / "out2.mcap", "-q")
    assert (quiet.exit_code, quiet.stderr) == (0, "")


def test_what_is_refused(locatk, chunked: Path, tmp_path: Path) -> None:
    before, out = chunked.read_bytes(), tmp_path / "out.mcap"
    assert locatk("recover", chunked).exit_code == 2
    assert locatk("recover", tmp_path / "none.mcap", "-o", out).exit_code == 1
    for more in ((), ("--overwrite",)):
        result = locatk("recover", chunked, "-o", chunked, *more)
        assert result.exit_code == 1
        assert "is one of the inputs" in result.stderr
    out.write_bytes(b"old")
    assert locatk("recover", chunked, "-o", out).exit_code == 1
    assert out.read_bytes() == b"old"
    assert locatk("recover", chunked, "-o", out, "--overwrite").exit_code == 0
    assert chunked.read_bytes() == before


@pytest.mark.parametrize("data", [b"", b"x,y\n1,2\n" * 50, b"\x89MCAP0\r\n", bytes(999)])
def test_nothing_is_left(locatk, tmp_path: Path, data: bytes) -> None:
    path, out = tmp_path / "run.mcap", tmp_path / "out.mcap"
    path.write_bytes(data)
    result = locatk("recover", path, "-o", out)
    assert result.exit_code == 1
    assert result.stderr.startswith(f"Error: {path}: nothing of a recording")
    assert result.stderr.count("\n") == 1
    assert not out.exists()


# ---- what `locatk info` says of damaged files


def test_info_points_to_recover(locatk, chunked: Path) -> None:
    data = chunked.read_bytes()
    chunked.write_bytes(data[: len(data) // 2])
    result = locatk("info", chunked)
    assert result.exit_code == 3
    assert "`locatk recover` saves the rest" in result.stderr
    assert result.stderr.count("\n") == 1
    answer = json.loads(locatk("info", chunked, "--json").stdout)
    assert answer["recoverable"]
    assert sum(stream["messages"] for stream in answer["streams"]) > 0


def test_info_reports_recoverable_damage(locatk, chunked: Path, tmp_path: Path) -> None:
    """Behind the damage, too; what info says of the damaged file it says of the saved one."""
    data = bytearray(chunked.read_bytes())
    data[Session.open(chunked).index.segments[2].offset + 3] ^= 0xFF  # a length
    data[2] ^= 1  # the first bytes
    del data[-40:]
    chunked.write_bytes(data)
    left = json.loads(locatk("info", chunked, "--json").stdout)
    assert left["damage"] == "it does not begin as an MCAP file"
    assert locatk("recover", chunked, "-o", tmp_path / "out.mcap").exit_code == 3
    saved = json.loads(locatk("info", tmp_path / "out.mcap", "--json").stdout)
    assert saved["damage"] is None
    for key in ("kind", "system", "start_ns", "end_ns", "streams", "devices", "sweeps"):
        assert left[key] == saved[key], key


def test_info_of_a_damaged_chunk_points_to_recover(locatk, session: Path) -> None:
    result = locatk("info", damage(session))
    assert result.exit_code == 3
    assert f"Incomplete: {session}: a damaged chunk at byte" in result.stderr
    assert "locatk recover" in result.stderr


def test_info_of_other_faults_does_not(locatk, session: Path, tmp_path: Path) -> None:
    """A recording that is whole as a file has nothing to recover."""
    out = tmp_path / "out.mcap"
    with out.open("wb") as stream:
        writer = mcap.writer.Writer(stream)
        writer.start("locatk", "tests")
        writer.add_metadata("locatk", {"kind": "session", "system": "lighthouse"})
        writer.add_attachment(0, 0, "scene.toml", "application/toml", b"no = scene")
        writer.finish()
    result = locatk("info", out)
    assert result.exit_code == 3
    assert "locatk recover" not in result.stderr
    assert not json.loads(locatk("info", out, "--json").stdout)["recoverable"]
    text = tmp_path / "text.mcap"
    text.write_text("hello\n" * 100)
    result = locatk("info", text)
    assert result.exit_code == 1
    assert "locatk recover" not in result.stderr
