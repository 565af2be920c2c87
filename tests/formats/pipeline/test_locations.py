"""Locations: names of paths and URLs, reading and writing, sessions in folders."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import InputError, LocatkError, MissingDataError, OutputExistsError
from locatk.formats.output import atomic_write
from locatk.formats.pipeline import locations
from locatk.formats.pipeline.locations import find_sessions


@pytest.mark.parametrize(
    ("location", "is_url", "name"),
    [
        ("run.mcap", False, "run.mcap"),
        ("/a/b c/run.mcap", False, "run.mcap"),
        ("s3://bucket/day/run.mcap", True, "run.mcap"),
        ("s3://bucket/day/what?.mcap", True, "what?.mcap"),
        ("https://host/run.mcap?token=a/b", True, "run.mcap"),
        ("c:/run.mcap", False, "run.mcap"),
        ("a://b", False, "b"),
    ],
)
def test_names(location: str, is_url: bool, name: str) -> None:
    assert locations.is_url(location) is is_url
    assert locations.file_name(location) == name


def test_siblings_and_folders() -> None:
    assert locations.sibling("s3://b/day/run.mcap", "x.mcap") == "s3://b/day/x.mcap"
    assert locations.sibling("day/run.mcap", "x.mcap") == "day/x.mcap"
    assert locations.within("s3://b/out/", "x.mcap") == "s3://b/out/x.mcap"
    assert locations.within("out", "x.mcap") == "out/x.mcap"
    assert locations.absolute("s3://b/run.mcap") == "s3://b/run.mcap"
    assert locations.absolute("run.mcap") == str(Path.cwd() / "run.mcap")


def test_a_local_file_is_itself(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with locations.local(str(path)) as found:
        assert found == path


def test_partial_files_of_one_output_are_removed(tmp_path: Path) -> None:
    name = "x" * 60 + ".mcap"
    other = tmp_path / ".x.mcap.0123abcd.part"
    other.touch()
    output = atomic_write(tmp_path / name)
    output.__enter__().write(b"half")
    assert len(list(tmp_path.iterdir())) == 2
    locations.remove_partial_files(str(tmp_path / name))  # as after its process was killed
    assert list(tmp_path.iterdir()) == [other]
    with pytest.raises(LocatkError):
        output.__exit__(None, None, None)
    locations.remove_partial_files(str(tmp_path / "absent" / name))
    locations.remove_partial_files(f"s3://bucket/{name}")


def test_urls_of_any_file_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    path = tmp_path / "run.mcap"
    path.write_bytes(b"data")
    url = (tmp_path / "store" / "deep" / "run.mcap").as_uri()
    locations.upload(path, url)
    assert (tmp_path / "store" / "deep" / "run.mcap").read_bytes() == b"data"
    with pytest.raises(OutputExistsError):
        locations.upload(path, url)
    path.write_bytes(b"newer")
    locations.upload(path, url, overwrite=True)
    assert [p.name for p in (tmp_path / "store" / "deep").iterdir()] == ["run.mcap"]
    with locations.local(url) as copy:
        assert copy.name == "run.mcap"
        assert copy.read_bytes() == b"newer"
    assert not copy.exists()
    with (
        pytest.raises(MissingDataError, match=r"^file://.*: No such object"),
        locations.local(url + "x"),
    ):
        pass
    with pytest.raises(InputError, match="web"):
        locations.check_writable("https://host/run.mcap", overwrite=True)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(LocatkError, match="s3://") as missing:
        locations.exists("s3://bucket/key")
    assert missing.value.hint == 'Install it: pip install "locatk[s3]"'


@given(st.text(max_size=30))
def test_any_name_is_found_or_one_error(name: str) -> None:
    try:
        found = find_sessions([name])
    except LocatkError:
        return
    assert found.sessions


def test_an_unknown_protocol_is_an_error_of_the_input() -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(InputError, match="Protocol not known") as caught:
        locations.exists("teleport://bucket/run.mcap")
    assert type(caught.value) is InputError
    assert caught.value.file == "teleport://bucket/run.mcap"
