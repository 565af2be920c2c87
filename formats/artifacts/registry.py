"""Table of the artifacts that sessions contain: kind, system and schema of each."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

from locatk.formats.artifacts.maps import HALLS, MAP
from locatk.formats.artifacts.receiver import RECEIVER
from locatk.formats.artifacts.scene import SCENE
from locatk.formats.artifacts.schema import Artifact, read_format
from locatk.formats.artifacts.sheets import CAMERA, MANIFEST
from locatk.formats.artifacts.tags import ARRAY, TAGS


@dataclass(frozen=True)
class RegisteredArtifact:
    """Artifact of a system.

    Attributes
    ----------
    kind : str
        Short name, as printed by ``locatk info``.
    system : str
        As in the metadata of sessions.
    artifact : Artifact
        Its schema, with the methods that read and write it.
    is_per_device : bool
        A session can contain one for each device, such as ``array-left.toml``.
    """

    kind: str
    system: str
    artifact: Artifact[Any]
    is_per_device: bool = False


ARTIFACTS: dict[str, RegisteredArtifact] = {
    entry.artifact.format: entry
    for entry in (
        RegisteredArtifact("scene", "lighthouse", SCENE),
        RegisteredArtifact("receiver", "lighthouse", RECEIVER, is_per_device=True),
        RegisteredArtifact("manifest", "dots", MANIFEST),
        RegisteredArtifact("camera", "dots", CAMERA),
        RegisteredArtifact("tag", "polaris", TAGS),
        RegisteredArtifact("array", "polaris", ARRAY, is_per_device=True),
        RegisteredArtifact("map", "landmarks", MAP),
        RegisteredArtifact("halls", "landmarks", HALLS, is_per_device=True),
    )
}
"""Artifacts by the key ``format`` of their files."""


def identify_artifact(path: str | os.PathLike[str]) -> RegisteredArtifact:
    """Return the entry of :data:`ARTIFACTS` of a TOML file, by its key ``format``.

    Raises
    ------
    MissingDataError
        There is no such file.
    ArtifactError
        It is not TOML, or of another format.
    """
    return ARTIFACTS[read_format(path, tuple(ARTIFACTS))]


def attached_artifact(name: str) -> RegisteredArtifact | None:
    """Return the entry of :data:`ARTIFACTS` for the name of an attachment, or None."""
    stem, dash, _ = name.partition("-")
    for entry in ARTIFACTS.values():
        is_of_device = entry.is_per_device and dash and entry.artifact.file == f"{stem}.toml"
        if is_of_device or entry.artifact.file == name:
            return entry
    return None
