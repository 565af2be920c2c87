"""The Crazyflie's system configuration: read strictly, written for cflib."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.errors import ArtifactError, InputError, LocatkError, OutputExistsError
from locatk.core.lighthouse.calibration import (
    GENERIC_CALIBRATION,
    IDEAL_CALIBRATION,
    PARAMETERS,
    Calibration,
)
from locatk.core.lighthouse.scene import Scene, Station
from locatk.formats.exporters.crazyflie import FORMER_MODEL_NOTE, dumps_config, write_config
from locatk.formats.importers.crazyflie import MODEL_NOTE, loads_config, read_config

CALIBRATION = """
    sweeps:
    - curve: 0.057678
      gibmag: 0.00219
      gibphase: 1.704102
      ogeemag: -0.368164
      ogeephase: 1.700195
      phase: 0.0
      tilt: -0.047882
    - curve: 0.348877
      gibmag: -0.003235
      gibphase: 0.12085
      ogeemag: -0.299072
      ogeephase: 2.0625
      phase: -0.006214
      tilt: 0.041382
    uid: 282585023
"""

SAMPLE = f"""calibs:
  3:{CALIBRATION}  11:{CALIBRATION.replace("282585023", "1083618720")}geos:
  0:
    origin:
    - -2.5
    - 1.0e-05
    - 3.125
    rotation:
    - - 0.8
      - 0.0
      - 0.6
    - - 0.0
      - 1.0
      - 0.0
    - - -0.6
      - 0.0
      - 0.8
  11:
    origin: [0.5, -3, 2.5]
    rotation: [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
systemType: 2
type: lighthouse_system_configuration
version: '1'
"""
"""As cflib writes it: numbers of libsurvive-extras-data (MIT), poses made up."""

SWEEPS = [
    [0.0, -0.047882, 0.057678, 0.00219, 1.704102, -0.368164, 1.700195],
    [-0.006214, 0.041382, 0.348877, -0.003235, 0.12085, -0.299072, 2.0625],
]


def rotation(seed: int) -> np.ndarray:
    q = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    return q * np.sign(np.linalg.det(q))


def scene(**changes: object) -> Scene:
    factory = Calibration(np.array(SWEEPS), "factory")
    stations = (
        Station(1, np.array([1.5, -2.25, 1e-7]), rotation(1), factory, 0xFFFFFFFF),
        Station(16, np.array([1 / 3, 0.1, -2.7]), rotation(2), factory),
    )
    return dataclasses.replace(Scene(stations, scale="markers"), **changes)


def test_reads_what_cflib_writes() -> None:
    found = loads_config(SAMPLE)
    first, second = found.stations
    assert (first.channel, second.channel) == (1, 12)
    assert first.position.tolist() == [-2.5, 1e-5, 3.125]
    assert first.rotation[:, 0] == pytest.approx([0.8, 0.0, -0.6])  # looks forward and down
    assert second.position.tolist() == [0.5, -3.0, 2.5]
    assert (first.id, second.id) == (None, 1083618720)
    assert second.calibration.sweeps.tolist() == SWEEPS
    assert (second.calibration.source, second.calibration.model) == ("factory", "libsurvive")
    assert first.calibration is GENERIC_CALIBRATION
    # Channel 4 is known by its calibration only.
    assert list(found.calibrations) == [4]
    assert found.calibrations[4].sweeps.tolist() == SWEEPS
    assert found.ids == {4: 282585023}
    assert found.scale == "distance"
    assert len(found.notes) == 2
    assert "curve and ogee" in found.notes[0]
    assert "generic calibration of channel 1:" in found.notes[1]


def test_a_scene_from_a_configuration_is_a_valid_artifact(tmp_path: Path) -> None:
    from locatk.formats.artifacts.scene import dumps_scene, loads_scene

    found = loads_config(SAMPLE)
    again = loads_scene(dumps_scene(found))
    assert [s.channel for s in again.stations] == [1, 12]
    assert list(again.calibrations) == [4]


def test_the_same_after_writing_and_reading(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    before = scene(calibrations={7: Calibration(np.array(SWEEPS) / 3, "factory")}, ids={7: 12})
    write_config(path, before)
    after = read_config(path)
    for old, new in zip(before.stations, after.stations, strict=True):
        assert (new.channel, new.id) == (old.channel, old.id)
        assert new.position.tolist() == old.position.tolist()
        assert new.rotation == pytest.approx(old.rotation, abs=1e-15)
        assert new.calibration.sweeps.tolist() == old.calibration.sweeps.tolist()
    assert after.calibrations[7].sweeps.tolist() == before.calibrations[7].sweeps.tolist()
    assert after.ids == {7: 12}
    with pytest.raises(OutputExistsError):
        write_config(path, before)
    write_config(path, before, overwrite=True)
    assert dumps_config(before) == path.read_text()


def test_all_numbers_are_floats_for_yaml_readers() -> None:
    """cflib packs the values as they come: 1e-07 without a point would be a string there."""
    data = yaml.safe_load(dumps_config(scene()))
    assert (data["type"], data["version"], data["systemType"]) == (
        "lighthouse_system_configuration",
        "1",
        2,
    )
    assert list(data["geos"]) == list(data["calibs"]) == [0, 15]
    for geometry in data["geos"].values():
        numbers = [*geometry["origin"], *np.ravel(geometry["rotation"]).tolist()]
        assert len(numbers) == 12
        assert all(isinstance(n, float) for n in numbers)
    for calibration in data["calibs"].values():
        assert [list(s) for s in calibration["sweeps"]] == [list(PARAMETERS)] * 2
        assert all(isinstance(n, float) for s in calibration["sweeps"] for n in s.values())
    assert [c["uid"] for c in data["calibs"].values()] == [0xFFFFFFFF, 0]


def test_cflib_reads_it(tmp_path: Path) -> None:
    pytest.importorskip("cflib", reason="cflib is not installed")
    from cflib.localization import LighthouseConfigFileManager

    write_config(tmp_path / "config.yaml", scene())
    geos, calibs, system = LighthouseConfigFileManager.read(str(tmp_path / "config.yaml"))
    assert system == 2
    packed = [bytearray(), bytearray()]
    geos[15].add_mem_data(packed[0])
    calibs[15].add_mem_data(packed[1])
    assert [len(memory) for memory in packed] == [49, 61]


def test_only_factory_calibrations_are_written() -> None:
    first, second = scene().stations
    for other in (
        GENERIC_CALIBRATION,
        IDEAL_CALIBRATION,
        Calibration(np.array(SWEEPS), "estimated"),
    ):
        text = dumps_config(scene(stations=(first, dataclasses.replace(second, calibration=other))))
        assert list(yaml.safe_load(text)["calibs"]) == [0]
        assert "# No factory calibration of channel 16" in text
        again = loads_config(text)
        assert again.stations[1].calibration is GENERIC_CALIBRATION


def test_scenes_that_cannot_be_written() -> None:
    with pytest.raises(InputError, match="no scale") as refused:
        dumps_config(scene(scale="unit"))
    assert refused.value.hint
    with pytest.raises(InputError, match="no stations") as refused:
        dumps_config(Scene(scale="markers"))
    assert refused.value.hint
    lost = dataclasses.replace(scene().stations[0], position=np.array([0.0, np.nan, 0.0]))
    with pytest.raises(InputError, match="channel 1 is not finite"):
        dumps_config(scene(stations=(lost,)))


def test_rotations_of_32_bits_and_of_four_digits() -> None:
    exact = rotation(5)
    for matrix, rounded in ((exact.astype(np.float32), False), (np.round(exact, 4), True)):
        text = SAMPLE.replace("[[0, -1, 0], [1, 0, 0], [0, 0, 1]]", str(matrix.tolist()))
        found = loads_config(text)
        r = found.stations[1].rotation
        assert r @ r.T == pytest.approx(np.eye(3), abs=1e-12)
        assert r == pytest.approx(exact, abs=1e-4)
        assert any("rounded" in note for note in found.notes) == rounded


@pytest.mark.parametrize("text", ["version: 1", 'version: "1"', "version: '1'"])
def test_version_with_and_without_quotes(text: str) -> None:
    assert loads_config(SAMPLE.replace("version: '1'", text)).stations


def test_missing_parts_and_unknown_keys() -> None:
    head = "type: lighthouse_system_configuration\nversion: '1'\n"
    empty = loads_config(head)
    assert (empty.stations, empty.calibrations, empty.scale) == ((), {}, "unit")
    empty = loads_config(head + "geos: {}\ncalibs: {}\n")
    assert (empty.stations, empty.notes) == ((), ())
    extra = loads_config(head + "colour: red\nlights: [1, 2]\n")
    assert "'colour', 'lights'" in extra.notes[0]


def test_a_calibration_of_zeros_is_none() -> None:
    zeros = SAMPLE
    for value in {str(v) for row in SWEEPS for v in row} - {"0.0"}:
        zeros = zeros.replace(f": {value}\n", ": 0.0\n")
    found = loads_config(zeros)
    assert found.stations[1].calibration is GENERIC_CALIBRATION
    assert found.stations[1].id == 1083618720
    assert found.calibrations == {}


WRONG = [
    ("type: lighthouse_system_configuration", "type: loco", "type", "expected"),
    ("type: lighthouse_system_configuration", "", "type", "expected"),
    ("version: '1'", "version: '2'", "version", "expected '1'"),
    ("systemType: 2", "systemType: 1", "systemType", "V2"),
    ("  11:\n    origin", "  16:\n    origin", "geos.16", "0 to 15"),
    ("  11:\n    origin", "  -1:\n    origin", "geos.-1", "0 to 15"),
    ("  11:\n    origin", "  0:\n    origin", 0, "'0' occurs twice"),
    ("- -2.5\n", "- -2.5\n    - 1\n", "geos.0.origin", "3"),
    ("- -2.5\n", "- .nan\n", "geos.0.origin[0]", "finite"),
    ("- -2.5\n", "- .inf\n", "geos.0.origin[0]", "finite"),
    ("- -2.5\n", "- 1e999\n", "geos.0.origin[0]", "finite"),
    ("- -2.5\n", "- 1e99999999999999999999\n", "geos.0.origin[0]", "finite"),
    ("- -2.5\n", f"- {'9' * 5000}\n", "geos.0.origin[0]", "finite"),
    ("- -2.5\n", "- 1.0e+5\n", "geos.0.origin[0]", "from -1000 to 1000"),
    ("- -2.5\n", "- here\n", "geos.0.origin[0]", "number"),
    ("- -2.5\n", "- '-2.5'\n", "geos.0.origin[0]", "number"),
    ("[0, 0, 1]]", "[0, 0, -1]]", "geos.11.rotation", "rotation"),
    ("[0, 0, 1]]", "[0, 0, 1.1]]", "geos.11.rotation", "rotation"),
    ("[0, 0, 1]]", "[0, 0, 1.0e+10]]", "geos.11.rotation", "rotation"),
    ("[0, 0, 1]]", "[0, 0, 1.0e+300]]", "geos.11.rotation[2][2]", "at most 1e\\+12"),
    ("[0, 0, 1]]", "[0, 0]]", "geos.11.rotation[2]", "3"),
    ("tilt: -0.047882", "tilt: 47.9", "calibs.3.sweeps[0].tilt", "from -10 to 10"),
    ("      tilt: -0.047882\n", "", "calibs.3.sweeps[0]", "missing key 'tilt'"),
    ("uid: 282585023", "uid: 4294967296", "calibs.3.uid", "whole number"),
    ("uid: 282585023", "uid: 1.5", "calibs.3.uid", "whole number"),
    ("    - curve: 0.348877", "      curve: 0.348877", 0, "occurs twice"),
    ("geos:\n", "geos: &a\n", 0, "anchors"),
    ("systemType: 2", "systemType: *a", 0, "anchors"),
    ("systemType: 2", "systemType: !!python/name:os.system 2", 0, "tag"),
    ("systemType: 2", "systemType: 2\n---\na: 1", 2, "more than one"),
    ("systemType: 2", "? [1, 2]\n: 3", 0, "key"),
    ("systemType: 2", "systemType: [[[[[[[[[2]]]]]]]]]", 0, "deep"),
    ("systemType: 2", "systemType: [2", 1, "not valid YAML"),
    ("systemType: 2", "\tsystemType: 2", 0, "not valid YAML"),
]


@pytest.mark.parametrize(("old", "new", "where", "message"), WRONG)
def test_errors_name_key_and_expected_value(
    tmp_path: Path, old: str, new: str, where: str | int, message: str
) -> None:
    path = tmp_path / "config.yaml"
    assert old in SAMPLE
    if isinstance(where, int):  # a line, counted from the one that is changed
        where += SAMPLE[: SAMPLE.index(old)].count("\n") + 1
    path.write_text(SAMPLE.replace(old, new, 1))
    with pytest.raises(ArtifactError, match=message) as refused:
        read_config(path)
    assert (refused.value.file, refused.value.where) == (str(path), where)
    assert "\n" not in str(refused.value)


BOMB = "a: &a [1,1,1,1,1,1,1,1,1]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n"
    for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"null",
        b"42",
        b"- 1\n- 2\n",
        b"\x00\x01\x02",
        b"\xff\xfe",
        b"\x89HDF\r\n\x1a\n" * 40,
        BOMB.encode(),
        b"[" * 900_000,
        b"{a: " * 200_000,
        b"- " * 400_000,
        b"? " * 400_000,
        b"#" * 1_000_001,
    ],
    ids=lambda content: repr(content[:12]),
)
def test_files_of_other_kinds(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.yaml"
    path.write_bytes(content)
    with pytest.raises(ArtifactError) as refused:
        read_config(path)
    assert refused.value.file == str(path)
    assert len(str(refused.value)) < 400


@pytest.mark.slow
@settings(deadline=None, max_examples=300)
@given(st.data())
def test_damaged_files_give_an_error_or_a_scene(data: st.DataObject) -> None:
    content = bytearray(SAMPLE.encode())
    for _ in range(data.draw(st.integers(0, 4))):
        place = data.draw(st.integers(0, len(content) - 1))
        content[place] ^= 1 << data.draw(st.integers(0, 7))
    cut = data.draw(st.integers(0, len(content)))
    try:
        found = loads_config(bytes(content[: cut if cut % 3 == 0 else None]))
    except LocatkError:
        return
    for station in found.stations:
        assert np.all(np.isfinite(station.position))
        assert 1 <= station.channel <= 16


@given(st.one_of(st.text(), st.binary().map(lambda b: b.decode("latin-1"))))
def test_any_text(text: str) -> None:
    with contextlib.suppress(LocatkError):
        loads_config(text)


def test_scenes_solved_by_locatk_are_marked() -> None:
    """The key ``solver`` marks them; other tools ignore it."""
    ours = loads_config(dumps_config(scene()))
    assert MODEL_NOTE not in ours.notes
    theirs = loads_config(SAMPLE)
    assert MODEL_NOTE in theirs.notes
    again = loads_config(dumps_config(dataclasses.replace(theirs, scale="markers")))
    assert MODEL_NOTE in again.notes
    assert MODEL_NOTE in loads_config(SAMPLE + "solver: other\n").notes
    # A scene of an earlier version has another wording of the note.
    former = dataclasses.replace(theirs, scale="markers", notes=(FORMER_MODEL_NOTE,))
    assert "solver" not in dumps_config(former)
