"""Places: what paths and URLs name, and what is left at them."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from locatk.core.errors import InputError, LocatkError, MissingDataError, OutputExistsError
from locatk.formats.output import atomic_write
from locatk.formats.pipeline import locations as places
from locatk.formats.pipeline.discovery import find_sessions


@pytest.mark.parametrize(
    ("place", "url", "name"),
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
def test_names(place: str, url: bool, name: str) -> None:
    assert places.is_url(place) is url
    assert places.name_of(place) == name


def test_neighbours() -> None:
    assert places.beside("s3://b/day/run.mcap", "x.mcap") == "s3://b/day/x.mcap"
    assert places.beside("day/run.mcap", "x.mcap") == "day/x.mcap"
    assert places.within("s3://b/out/", "x.mcap") == "s3://b/out/x.mcap"
    assert places.within("out", "x.mcap") == "out/x.mcap"
    assert places.absolute("s3://b/run.mcap") == "s3://b/run.mcap"
    assert places.absolute("run.mcap") == str(Path.cwd() / "run.mcap")


def test_a_local_file_is_itself(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with places.local(str(path)) as found:
        assert found == path


def test_parts_of_one_output_are_removed(tmp_path: Path) -> None:
    name = "x" * 60 + ".mcap"
    other = tmp_path / ".x.mcap.0123abcd.part"
    other.touch()
    output = atomic_write(tmp_path / name)
    output.__enter__().write(b"half")
    assert len(list(tmp_path.iterdir())) == 2
    places.remove_parts(str(tmp_path / name))  # as after its process was killed
    assert list(tmp_path.iterdir()) == [other]
    with pytest.raises(LocatkError):
        output.__exit__(None, None, None)
    places.remove_parts(str(tmp_path / "absent" / name))
    places.remove_parts(f"s3://bucket/{name}")


def test_urls_of_any_file_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    path = tmp_path / "run.mcap"
    path.write_bytes(b"data")
    url = (tmp_path / "store" / "deep" / "run.mcap").as_uri()
    places.put(path, url)
    assert (tmp_path / "store" / "deep" / "run.mcap").read_bytes() == b"data"
    with pytest.raises(OutputExistsError):
        places.put(path, url)
    path.write_bytes(b"newer")
    places.put(path, url, overwrite=True)
    assert [p.name for p in (tmp_path / "store" / "deep").iterdir()] == ["run.mcap"]
    with places.local(url) as copy:
        assert copy.name == "run.mcap"
        assert copy.read_bytes() == b"newer"
    assert not copy.exists()
    with (
        pytest.raises(MissingDataError, match="No such object in file://"),
        places.local(url + "x"),
    ):
        pass
    with pytest.raises(InputError, match="web"):
        places.check("https://host/run.mcap", overwrite=True)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(LocatkError, match="s3://") as missing:
        places.exists("s3://bucket/key")
    assert missing.value.hint == 'Install it: pip install "locatk[s3]"'


@given(st.text(max_size=30))
def test_any_name_is_found_or_one_error(name: str) -> None:
    try:
        found = find_sessions([name])
    except LocatkError:
        return
    assert found.sessions
