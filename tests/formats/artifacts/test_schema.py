"""Schemas of artifacts: files, attachments of sessions, units, and the tables of the docs."""

from __future__ import annotations

import math
import re
import runpy
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.dots.camera import Camera
from locatk.core.dots.sheet import Manifest, Sheet
from locatk.core.errors import ArtifactError, MissingDataError, OutputExistsError
from locatk.core.landmarks.halls import HallSensors, circle
from locatk.core.landmarks.map.floor import HOLE_CODE, FloorMap
from locatk.core.lighthouse.scene import Marker, Scene
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.tag import Tags
from locatk.formats.artifacts import maps, sheets, tags
from locatk.formats.artifacts.kinds import UNITS, InvalidValueError, ListOf, Number, unit_ending
from locatk.formats.artifacts.scene import SCENE
from locatk.formats.artifacts.schema import Artifact, Key, Table
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

NOTE = 'a "b" \\ \n c'
SHEET = Sheet("a", (0, 3000), (393, 555), (24, 32), (210.0, 297.0), (5.0, 7.5))

ALL: dict[str, tuple[Artifact[Any], Any]] = {
    "scene.toml": (
        SCENE,
        Scene(markers=(Marker("a", np.array([0.1, 0.2, 0.0])),), notes=(NOTE,)),
    ),
    "sheet.toml": (sheets.MANIFEST, Manifest((SHEET,), codec="libdots", notes=(NOTE,))),
    "camera.toml": (sheets.CAMERA, Camera((188, 120), 900.0, (93.5, 59.5))),
    "tag.toml": (tags.TAGS, Tags(notes=(NOTE,))),
    "array.toml": (tags.ARRAY, SensorArray(bar(3, 0.008))),
    "map.toml": (maps.MAP, FloorMap(np.array([[1, HOLE_CODE], [3, 15]]), notes=(NOTE,))),
    "halls.toml": (maps.HALLS, HallSensors()),
}

every = pytest.mark.parametrize(("artifact", "value"), ALL.values(), ids=ALL)


@every
def test_files(tmp_path: Path, artifact: Artifact[Any], value: Any) -> None:
    path = tmp_path / artifact.file
    artifact.write(path, value)
    text = artifact.dumps(value)
    assert artifact.dumps(artifact.read(path)) == path.read_text("utf-8") == text
    with pytest.raises(OutputExistsError):
        artifact.write(path, value)
    artifact.write(path, value, overwrite=True)
    with pytest.raises(MissingDataError):
        artifact.read(tmp_path / "none.toml")


@pytest.mark.slow
@every
@given(text=st.text(max_size=80))
def test_any_text_is_an_artifact_or_an_error(
    artifact: Artifact[Any], value: Any, text: str
) -> None:
    with pytest.raises(ArtifactError):
        artifact.loads(artifact.dumps(value) + "x" + text)


def test_artifacts_have_different_file_names() -> None:
    assert [artifact.file for artifact, _ in ALL.values()] == list(ALL)


@every
def test_errors_name_the_artifact_if_there_is_no_file(artifact: Artifact[Any], value: Any) -> None:
    with pytest.raises(ArtifactError) as caught:
        artifact.loads(re.sub("format_version = .", "format_version = 9", artifact.dumps(value)))
    assert caught.value.file == f"<{artifact.file.removesuffix('.toml')}>"
    assert caught.value.where == "format_version"


def session(path: Path, **parts: str) -> Session:
    """A session with these attachments; `_` stands for `-`."""
    with SessionWriter(path, system="landmarks") as writer:
        for name, text in parts.items():
            writer.attach_toml(name.replace("_", "-") + ".toml", text)
    return Session.open(path)


@every
def test_artifacts_are_attached_to_sessions(
    tmp_path: Path, artifact: Artifact[Any], value: Any
) -> None:
    name, text = artifact.file.removesuffix(".toml"), artifact.dumps(value)
    bearing = session(tmp_path / "run.mcap", **{name: text})
    assert artifact.dumps(artifact.attached(bearing)) == text
    assert artifact.attached(session(tmp_path / "none.mcap")) is None
    with pytest.raises(ArtifactError, match=rf"run\.mcap:{name}\.toml"):
        artifact.attached(session(tmp_path / "bad-run.mcap", **{name: "x"}))


def test_a_device_may_have_an_artifact_of_its_own(tmp_path: Path) -> None:
    shared, own = (maps.HALLS.dumps(HallSensors(position_m=circle(r))) for r in (0.025, 0.03))
    both = session(tmp_path / "both.mcap", halls=shared, halls_b=own)
    for device, text in (("b", own), ("a", shared), (None, shared)):
        found = maps.HALLS.attached_for(both, device)
        assert found is not None
        assert maps.HALLS.dumps(found) == text
    assert maps.HALLS.attached_for(session(tmp_path / "none.mcap"), "a") is None
    with pytest.raises(ArtifactError, match=r"bad\.mcap:halls-b\.toml"):
        maps.HALLS.attached_for(session(tmp_path / "bad.mcap", halls=shared, halls_b="x"), "b")


# ---- the schema


def test_the_tables_of_the_documentation_are_up_to_date(root: Path) -> None:
    page = (root / "docs" / "formats.md").read_text("utf-8")
    script = runpy.run_path(str(root / ".ci" / "artifact_tables.py"))
    assert script["updated"](page) == page, "run: python .ci/artifact_tables.py"
    assert {artifact.file for artifact in script["ARTIFACTS"]} >= set(ALL)


@pytest.mark.parametrize("ending", [e for e, unit in UNITS.items() if unit.si_ending])
@settings(max_examples=40, deadline=None)
@given(value=st.floats(allow_nan=False, allow_infinity=False).filter(lambda v: abs(v) < 1e300))
def test_units_are_exact(ending: str, value: float) -> None:
    unit = UNITS[ending]
    if abs(value) < 1e-290 and value:
        return  # a product may be below the smallest float
    digits = unit.from_si(value)
    assert unit.to_si(digits if isinstance(digits, Decimal) else Decimal(repr(digits))) == value
    assert unit.to_si(1) == pytest.approx(float(unit.factor), rel=1e-15)


@pytest.mark.parametrize(
    ("key", "attribute", "parsed"),
    [
        ("spacing_mm", "spacing_m", 0.04),
        ("delay_ms", "delay_s", 0.04),
        ("noise_ut", "noise_t", 40e-6),
        ("heading_deg", "heading_rad", math.radians(40)),
        ("size_px", "size_px", 40.0),
        ("radial", "radial", 40.0),
    ],
)
def test_the_ending_of_a_key_is_its_unit(key: str, attribute: str, parsed: float) -> None:
    table = Table((Key(key, Number()),))
    assert table.parse({key: 40}) == {attribute: parsed}
    assert float(table.to_toml({attribute: parsed})[key]) == 40.0
    unconverted = Table((Key(key, Number(), is_si=False),))
    assert unconverted.parse({key: 40}) == {key: 40.0}


def test_the_longest_ending_is_the_unit() -> None:
    assert [unit_ending(key) for key in ("drift_deg_per_m", "a_per_m", "delay_ms", "names")] == [
        "_deg_per_m", "_per_m", "_ms", "",
    ]  # fmt: skip


def test_errors_have_the_path_unit_and_hint() -> None:
    inner = Table((Key("height_mm", Number(0, 5, hint="Measure again")),))
    table = Table((Key("tags", ListOf(inner)),))
    with pytest.raises(InvalidValueError, match="expected a number from 0 to 5 in mm") as caught:
        table.parse({"tags": [{"height_mm": 1}, {"height_mm": 6}]})
    assert (caught.value.key, caught.value.hint) == ("tags[1].height_mm", "Measure again")
    with pytest.raises(InvalidValueError, match="missing key 'height_mm'") as caught:
        table.parse({"tags": [{"hight_mm": 1}]})
    assert (caught.value.key, caught.value.hint) == (
        "tags[0]", "Is 'hight_mm' meant to be height_mm?",
    )  # fmt: skip
    with pytest.raises(InvalidValueError, match="unknown key 'hight_mm'") as caught:
        table.parse({"tags": [{"height_mm": 1, "hight_mm": 1}]})
    assert caught.value.hint == "Did you mean height_mm?"


def test_a_missing_array_of_tables_gets_its_heading() -> None:
    with pytest.raises(ArtifactError) as caught:
        sheets.MANIFEST.loads("""
            format = "locatk-dot-sheets"
            format_version = 1
            codec = "libdots"
            pitch_mm = 0.5
        """)
    assert caught.value.hint == "Write each one under [[sheets]]"


@every
def test_a_typo_in_the_header_gets_the_nearest_key(artifact: Artifact[Any], value: Any) -> None:
    text = artifact.dumps(value)
    with pytest.raises(ArtifactError, match="unknown key 'tol_version'") as caught:
        artifact.loads(text.replace("tool_version", "tol_version"))
    assert caught.value.hint == "Did you mean tool_version?"


@pytest.mark.parametrize(
    ("text", "absent"),
    [
        (SCENE.dumps(Scene()), ("notes", "stations", "planar")),
        (tags.TAGS.dumps(Tags()), ("notes", "family", "built", "site")),
        (
            maps.MAP.dumps(FloorMap(np.ones((1, 1), int))),
            ("notes", "name", "walls", "seed", "built"),
        ),
        (maps.HALLS.dumps(HallSensors()), ("sensor", "noise_ut", "range_mt")),
    ],
    ids=["scene", "tag", "map", "halls"],
)
def test_unknown_and_empty_values_are_not_written(text: str, absent: tuple[str, ...]) -> None:
    keys = {line.split(" = ")[0].strip("[]") for line in text.splitlines()}
    assert "format" in keys
    assert keys.isdisjoint(absent)
