"""Artifacts attached to a recording, validated before it starts."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from locatk.core.errors import InputError
from locatk.formats import files
from locatk.formats.artifacts import maps, sheets, tags
from locatk.formats.artifacts import receiver as receivers
from locatk.formats.artifacts import scene as artifacts
from locatk.formats.artifacts.schema import read_format
from locatk.formats.sessions.reader import Session

KINDS: dict[str, tuple[str, Callable[..., Any]]] = {
    artifacts.SCENE_FORMAT: (artifacts.SCENE_FILE, artifacts.loads_scene),
    receivers.RECEIVER_FORMAT: (receivers.RECEIVER_FILE, receivers.loads_receiver),
    sheets.MANIFEST_FORMAT: (sheets.SHEET_FILE, sheets.loads_manifest),
    sheets.CAMERA_FORMAT: (sheets.CAMERA_FILE, sheets.loads_camera),
    tags.TAG_FORMAT: (tags.TAG_FILE, tags.loads_tags),
    tags.ARRAY_FORMAT: (tags.ARRAY_FILE, tags.loads_array),
    maps.MAP_FORMAT: (maps.MAP_FILE, maps.loads_map),
    maps.HALLS_FORMAT: (maps.HALLS_FILE, maps.loads_halls),
}
"""Format of an artifact to the name of its attachment and the function that parses it."""

ATTACHED = dict(KINDS.values())
"""Name of an attachment to the function that parses it."""

BY_DEVICE = ("array", "halls", "receiver")
"""Kinds that each device may have: ``array-<device>.toml``."""


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
    kind = read_format(path, tuple(KINDS))
    name, loads = KINDS[kind]
    text = files.read_text(path)
    loads(text, file=path)
    return {name: text}


def _of_session(path: Path) -> dict[str, str]:
    session = Session.open(path)
    texts = {}
    for info in session.attachments():
        stem, dash, _ = info.name.partition("-")
        loads = ATTACHED.get(f"{stem}.toml" if dash and stem in BY_DEVICE else info.name)
        data = None if loads is None else session.attachment(info.name)
        if loads is not None and data is not None:
            text = data.decode("utf-8", "replace")
            loads(text, file=f"{path}:{info.name}")
            texts[info.name] = text
    if not texts:
        raise InputError(
            "the session contains no artifact", file=path, hint="Give the artifacts (.toml)"
        )
    return texts
