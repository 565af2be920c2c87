"""Registry of artifacts: kinds, systems, and names of attachments."""

from __future__ import annotations

from pathlib import Path

import pytest

from locatk.core.errors import ArtifactError
from locatk.formats.artifacts.registry import ARTIFACTS, attached_artifact, identify_artifact
from locatk.formats.pipeline.systems import SYSTEMS


def test_each_system_has_artifacts_with_their_own_names() -> None:
    entries = ARTIFACTS.values()
    assert {entry.system for entry in entries} == set(SYSTEMS)
    assert len({entry.kind for entry in entries}) == len(entries) == 8
    assert len({entry.artifact.file for entry in entries}) == len(entries)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("sheet.toml", "manifest"),
        ("array.toml", "array"),
        ("array-left.toml", "array"),
        ("halls-a-b.toml", "halls"),
        ("scene-left.toml", None),
        ("camera-left.toml", None),
        ("arrays.toml", None),
        ("array", None),
        ("solution.json", None),
    ],
)
def test_names_of_attachments(name: str, kind: str | None) -> None:
    entry = attached_artifact(name)
    assert (None if entry is None else entry.kind) == kind


def test_identify_by_the_key_format(tmp_path: Path) -> None:
    path = tmp_path / "any.toml"
    path.write_text("format = 'locatk-landmark-map'\n")
    assert identify_artifact(path).kind == "map"
    path.write_text("format = 'locatk-landmark-mop'\n")
    with pytest.raises(
        ArtifactError, match=r"'locatk-landmark-mop' is not one of .*locatk-landmark-map"
    ):
        identify_artifact(path)
