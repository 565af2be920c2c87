"""Files by path or URL: reading, writing, errors of object stores."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from locatk.core.errors import InputError, LocatkError, MissingDataError, OutputExistsError
from locatk.formats.pipeline import file_access


def test_a_local_file_is_itself(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with file_access.local(str(path)) as found:
        assert found == path


def test_partial_files_of_one_output_are_removed(tmp_path: Path) -> None:
    name = "x" * 60 + ".mcap"
    (tmp_path / f".{name}.89abcdef.part").touch()  # of a process that was killed
    others = {".x.mcap.0123abcd.part", f".{name}.part", f".{name}.backup.part", f".{name}.cut.part"}
    for other in others:
        (tmp_path / other).touch()
    os.mkfifo(tmp_path / f".{name}.01234567.part")  # Opening it would wait for a writer.
    file_access.remove_partial_files(str(tmp_path / name))
    others.add(f".{name}.01234567.part")
    assert {path.name for path in tmp_path.iterdir()} == others
    file_access.remove_partial_files(str(tmp_path / "absent" / name))
    file_access.remove_partial_files(f"s3://bucket/{name}")


def test_urls_of_any_file_system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("fsspec", reason="fsspec is not installed")
    path = tmp_path / "run.mcap"
    path.write_bytes(b"data")
    url = (tmp_path / "store" / "deep" / "run.mcap").as_uri()
    file_access.upload(path, url)
    assert (tmp_path / "store" / "deep" / "run.mcap").read_bytes() == b"data"
    with pytest.raises(OutputExistsError):
        file_access.upload(path, url)
    path.write_bytes(b"newer")
    file_access.upload(path, url, overwrite=True)
    assert [p.name for p in (tmp_path / "store" / "deep").iterdir()] == ["run.mcap"]
    with file_access.local(url) as copy:
        assert copy.name == "run.mcap"
        assert copy.read_bytes() == b"newer"
    assert not copy.exists()
    with (
        pytest.raises(MissingDataError, match=r"^file://.*: No such object"),
        file_access.local(url + "x"),
    ):
        pass
    with pytest.raises(InputError, match="web"):
        file_access.check_writable("https://host/run.mcap", overwrite=True)
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(LocatkError, match="s3://") as missing:
        file_access.exists("s3://bucket/key")
    assert missing.value.hint == 'Install it: pip install "locatk[s3]"'


def test_an_unknown_protocol_is_an_error_of_the_input() -> None:
    pytest.importorskip("fsspec")
    with pytest.raises(InputError, match="Protocol not known") as caught:
        file_access.exists("teleport://bucket/run.mcap")
    assert type(caught.value) is InputError
    assert caught.value.file == "teleport://bucket/run.mcap"
