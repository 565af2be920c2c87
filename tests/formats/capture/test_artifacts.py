"""Artifacts that go into a recording: of every kind, whole, and one of each."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from locatk.core.dots.camera import Camera
from locatk.core.errors import ArtifactError, FormatError, InputError, MissingDataError
from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.lighthouse.receiver import DECK
from locatk.core.lighthouse.scene import Marker, Scene
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import maps, sheets, tags
from locatk.formats.artifacts import receiver as receivers
from locatk.formats.artifacts import scene as scenes
from locatk.formats.capture.attachments import attachments
from locatk.formats.sessions.writer import SessionWriter

SCENE = scenes.dumps_scene(Scene(markers=(Marker("corner", np.zeros(3)),)))
TAG = tags.dumps_tags(Tags(ids=(3, 5), min_distance=2))
ARRAY = tags.dumps_array(SensorArray(bar(9, 0.02)))
MAP = maps.dumps_map(FloorMap(np.array([[7, 1, -1], [3, 15, 0]]), name="lab"))
HALLS = maps.dumps_halls(HallSensors(("a", "b"), np.array([[0.0, 0.02], [0.0, -0.02]])))
TEXTS = {
    "scene.toml": SCENE,
    "tag.toml": TAG,
    "array.toml": ARRAY,
    "map.toml": MAP,
    "halls.toml": HALLS,
    "receiver.toml": receivers.dumps_receiver(DECK),
}


def write(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def session(path: Path, **attached: str) -> Path:
    with SessionWriter(path, system="polaris") as writer:
        for name, text in attached.items():
            writer.attach_toml(name.replace("__", "-") + ".toml", text)
    return path


@pytest.mark.parametrize("name", TEXTS)
def test_each_kind_has_its_place_whatever_the_file_is_called(tmp_path: Path, name: str) -> None:
    path = write(tmp_path / "mine.toml", "# by hand\n" + TEXTS[name])
    assert attachments([path]) == {name: "# by hand\n" + TEXTS[name]}


def test_several_at_once(tmp_path: Path) -> None:
    paths = [write(tmp_path / f"{k}.toml", text) for k, text in enumerate(TEXTS.values())]
    assert attachments(paths) == TEXTS
    assert attachments([]) == {}


def test_two_of_a_kind(tmp_path: Path) -> None:
    first = write(tmp_path / "a.toml", TAG)
    again = write(tmp_path / "b.toml", TAG)
    other = write(tmp_path / "c.toml", tags.dumps_tags(Tags(ids=(4,))))
    assert attachments([first, again]) == {"tag.toml": TAG}
    with pytest.raises(InputError, match=r"c\.toml: a second tag\.toml"):
        attachments([first, other])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("format = 'smell'\nversion = 1\n", "format"),
        ("a = 1\n", "format"),
        ("this is no TOML", ""),
        (TAG.replace("locatk-tag", "locatk-sensor-array"), ""),
        (TAG + "\nunknown_key = 1\n", "unknown_key"),
        ("", "format"),
    ],
)
def test_files_other_than_artifacts_are_refused_at_once(
    tmp_path: Path, text: str, words: str
) -> None:
    path = write(tmp_path / "wrong.toml", text)
    with pytest.raises((ArtifactError, FormatError)) as caught:
        attachments([path])
    assert words in str(caught.value)
    assert "wrong.toml" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(MissingDataError):
        attachments([tmp_path / "no.toml"])
    with pytest.raises(MissingDataError):
        attachments([tmp_path / "no.mcap"])


# ---- of a session


def test_those_of_a_session(tmp_path: Path) -> None:
    path = session(tmp_path / "old.mcap", tag=TAG, array=ARRAY, array__left=ARRAY, notes="x = 1\n")
    found = attachments([path])
    assert found == {"tag.toml": TAG, "array.toml": ARRAY, "array-left.toml": ARRAY}


def test_a_session_and_a_file(tmp_path: Path) -> None:
    path = session(tmp_path / "old.mcap", tag=TAG)
    more = write(tmp_path / "bar.toml", ARRAY)
    assert attachments([path, more]) == {"tag.toml": TAG, "array.toml": ARRAY}


def test_a_session_without_any(tmp_path: Path) -> None:
    path = session(tmp_path / "old.mcap", notes="x = 1\n")
    with pytest.raises(InputError, match=r"old\.mcap: the session contains no artifact"):
        attachments([path])


def test_damaged_sessions_are_refused_at_once(tmp_path: Path) -> None:
    path = session(tmp_path / "old.mcap", tag="format = 'locatk-tag'\nversion = 1\n")
    with pytest.raises((ArtifactError, FormatError), match=r"old\.mcap"):
        attachments([path])


def test_what_is_no_session(tmp_path: Path) -> None:
    with pytest.raises(FormatError):
        attachments([write(tmp_path / "no.mcap", "this is no session")])


def test_a_camera(tmp_path: Path) -> None:
    text = sheets.dumps_camera(Camera((640, 480), 500.0, (320.0, 240.0)))
    assert attachments([write(tmp_path / "c.toml", text)]) == {"camera.toml": text}
