"""Artifacts attached to a recording, validated before it starts."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from locatk.core.errors import InputError
from locatk.formats import files
from locatk.formats.artifacts.registry import attached_artifact, identify_artifact
from locatk.formats.sessions.reader import Session


def attachments(paths: Iterable[Path]) -> dict[str, str]:
    """Return attachments (name to text) of artifacts (.toml) and of sessions that contain some.

    Raises
    ------
    MissingDataError, FormatError, ArtifactError
        A file does not exist or is no valid artifact.
    InputError
        Two artifacts of one kind, or a session without any.
    """
    texts: dict[str, str] = {}
    for path in paths:
        for name, text in _of(path).items():
            if texts.get(name, text) != text:
                raise InputError(f"a second {name}", file=path, hint="Give one of each kind")
            texts[name] = text
    return texts


def _of(path: Path) -> dict[str, str]:
    if path.suffix.lower() == ".mcap":
        return _of_session(path)
    artifact = identify_artifact(path).artifact
    text = files.read_text(path)
    artifact.loads(text, file=path)
    return {artifact.file: text}


def _of_session(path: Path) -> dict[str, str]:
    session = Session.open(path)
    texts = {}
    for info in session.attachments():
        entry = attached_artifact(info.name)
        data = None if entry is None else session.attachment(info.name)
        if entry is not None and data is not None:
            text = data.decode("utf-8", "replace")
            entry.artifact.loads(text, file=f"{path}:{info.name}")
            texts[info.name] = text
    if not texts:
        raise InputError(
            "the session contains no artifact", file=path, hint="Give the artifacts (.toml)"
        )
    return texts
