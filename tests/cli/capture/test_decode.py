"""`locatk decode` as a user runs it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import tags
from locatk.formats.schemas.serial_pb2 import Readings, SerialChunk
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
TEXT = b"a,b\n" + b"".join(b"%d,%d\n" % (k, k * k) for k in range(50))


def recording(path: Path, data: bytes = TEXT, device: str = "raw") -> Path:
    """A session of raw bytes that was recorded as ``device``."""
    with SessionWriter(path, system="") as writer:
        writer.metadata("capture", {"device": device, "note": "kept", "gaps": "2"})
        for number, start in enumerate(range(0, len(data), 16)):
            piece = data[start : start + 16]
            chunk = SerialChunk(byte_offset=start, data=piece, opened=number == 0)
            writer.write("/serial/robot", chunk, START_NS + number * 3_000_000)
    return path


@pytest.fixture
def old(tmp_path: Path) -> Path:
    """Lines that were taken for raw bytes."""
    return recording(tmp_path / "old.mcap")


def test_another_device(locatk: Any, old: Path, tmp_path: Path, raw_bytes: Any) -> None:
    path = tmp_path / "again.mcap"
    result = locatk("decode", old, "--device", "lines", "-o", path)
    assert result.exit_code == 0, result.stderr
    first, header, row = result.stdout.splitlines()
    assert first == f"Wrote {path}"
    assert header.split() == ["name", "device", "bytes", "frames", "bad", "missing", "records"]
    assert row.split() == ["robot", "lines", str(len(TEXT)), "51", "0", "0", "50"]
    assert raw_bytes(path) == TEXT
    facts = Session.open(path).metadata()["capture"]
    assert (facts["device"], facts["note"], facts["gaps"]) == ("lines", "kept", "2")
    assert facts["decoded_from"] == "old.mcap"


def test_one_json_object(locatk: Any, old: Path, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    result = locatk("decode", old, "--device", "lines", "-o", path, "--json")
    report = json.loads(result.stdout)
    assert (report["version"], report["output"], report["system"]) == (1, str(path), None)
    (device,) = report["devices"]
    assert (device["name"], device["device"], device["bytes"]) == ("robot", "lines", len(TEXT))
    assert device["samples"] == {"/readings/robot": 50}
    assert isinstance(report["remarks"], list)


def test_the_recorded_device_is_the_default(locatk: Any, tmp_path: Path) -> None:
    old = recording(tmp_path / "old.mcap", device="lines")
    result = locatk("decode", old, "-o", tmp_path / "again.mcap", "--json")
    assert json.loads(result.stdout)["devices"][0]["device"] == "lines"


def test_the_device_is_identified(locatk: Any, old: Path, tmp_path: Path) -> None:
    result = locatk("decode", old, "--device", "auto", "-o", tmp_path / "again.mcap", "--json")
    assert result.exit_code == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["devices"][0]["device"] == "lines"
    assert report["devices"][0]["samples"] == {"/readings/robot": 50}
    assert report["remarks"][0].startswith("identified device: lines")
    assert "Warning: identified device: lines" in result.stderr


def test_columns(locatk: Any, old: Path, tmp_path: Path) -> None:
    path = tmp_path / "again.mcap"
    given = ("--device", "lines", "--columns", "one,two", "-o", path)
    assert locatk("decode", old, *given).exit_code == 0
    ((_, first), *_) = Session.open(path).decoded("/readings/robot", Readings)
    assert list(first.names) == ["one", "two"]


def test_an_artifact(locatk: Any, old: Path, tmp_path: Path) -> None:
    tag = tmp_path / "mine.toml"
    tag.write_text(tags.dumps_tags(Tags(ids=(3,))))
    path = tmp_path / "again.mcap"
    assert locatk("decode", old, "--artifact", tag, "-o", path).exit_code == 0
    assert Session.open(path).attachment("tag.toml") == tag.read_bytes()


def test_bad_frames_give_status_3(locatk: Any, tmp_path: Path) -> None:
    data = TEXT.replace(b"40,1600\n", b"40,\x81\x9200\n").replace(b"9,81\n", b"\x80,81\n")
    old = recording(tmp_path / "old.mcap", data)
    result = locatk("decode", old, "--device", "lines", "-o", tmp_path / "again.mcap")
    assert result.exit_code == 3
    assert "Incomplete: 2 bad frames" in result.stderr
    assert Session.open(tmp_path / "again.mcap").damage is None


def test_losses_of_the_port_do_not_repeat_in_the_status(locatk: Any, old: Path) -> None:
    """Two gaps are in the metadata; the decoding itself lost nothing."""
    assert locatk("decode", old, "-o", old.with_name("again.mcap")).exit_code == 0


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["OLD", "-o", "OLD", "--overwrite"], "one of the inputs"),
        (["OLD", "-o", "THERE"], "exists"),
        (["OLD", "-o", "NEW", "--device", "nonsense"], "no device 'nonsense'"),
        (["EMPTY", "-o", "NEW"], "no raw bytes"),
        (["CUT", "-o", "NEW"], "cut.mcap"),
        (["GONE", "-o", "NEW"], "No such file"),
        (["OLD", "-o", "NEW", "--artifact", "EMPTY"], "the session contains no artifact"),
    ],
)
def test_refused(locatk: Any, old: Path, tmp_path: Path, given: list[str], words: str) -> None:
    (tmp_path / "there.mcap").write_bytes(b"old")
    (tmp_path / "cut.mcap").write_bytes(old.read_bytes()[:600])
    with SessionWriter(tmp_path / "empty.mcap", system="dots"):
        pass
    names = ("old", "there", "new", "empty", "cut", "gone")
    places = {name.upper(): tmp_path / f"{name}.mcap" for name in names}
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    result = locatk("decode", *(places.get(each, each) for each in given))
    assert result.exit_code == 1
    assert words in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_wrong_usage(locatk: Any, old: Path) -> None:
    assert locatk("decode", old).exit_code == 2
    assert locatk("decode").exit_code == 2
