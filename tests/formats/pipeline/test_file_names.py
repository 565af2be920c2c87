"""Names of files: paths and URLs."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.formats.pipeline import file_names


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
    assert file_names.is_url(location) is is_url
    assert file_names.file_name(location) == name


def test_siblings_and_folders() -> None:
    assert file_names.sibling("s3://b/day/run.mcap", "x.mcap") == "s3://b/day/x.mcap"
    assert file_names.sibling("day/run.mcap", "x.mcap") == "day/x.mcap"
    assert file_names.within("s3://b/out/", "x.mcap") == "s3://b/out/x.mcap"
    assert file_names.within("out", "x.mcap") == "out/x.mcap"
    assert file_names.absolute("s3://b/run.mcap") == "s3://b/run.mcap"
    assert file_names.absolute("run.mcap") == str(Path.cwd() / "run.mcap")
