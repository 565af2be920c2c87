"""`locatk capture --test`: the sensors of a device are checked before its first recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from locatk.core.landmarks.halls import NAMES, circle
from locatk.formats.schemas.serial_pb2 import SerialChunk
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.writer import SessionWriter

START_NS = 1_700_000_000_000_000_000
INTERVAL_MS = 10


def _turned_array() -> np.ndarray:
    """Readings (n, 3 sensors, 3) in microtesla of an array that is turned by hand."""
    rng = np.random.default_rng(0)
    rotation = Slerp(np.arange(12), Rotation.random(12, random_state=1))(np.linspace(0, 11, 600))
    field = np.repeat(rotation.apply([19.0, 1.0, -44.0])[:, None], 3, axis=1)
    return field + rng.normal(scale=20, size=(3, 3)) + rng.normal(scale=0.3, size=field.shape)


def _passed_halls() -> np.ndarray:
    """Readings (n, 4) in millitesla of hall sensors below which a magnet is moved."""
    position = np.column_stack([circle(), np.zeros(4)])
    stops = np.vstack([[0.3, 0, -0.012], position - [0, 0, 0.012], [0.3, 0, -0.012]])
    time = np.r_[np.zeros(500), np.linspace(0, 5, 400)]
    magnet = magpylib.magnet.Cylinder(polarization=(0, 0, 1.2), dimension=(0.01, 0.005))
    magnet.position = np.column_stack(
        [np.interp(time, np.arange(6), stops[:, k]) for k in range(3)]
    )
    field = 1e3 * magpylib.getB(magnet, position)[:, :, 2]
    return field + np.random.default_rng(0).normal(scale=0.03, size=field.shape)


def _session(path: Path, names: list[str], values: np.ndarray) -> Path:
    """Write a session of lines with named values (n, k)."""
    with SessionWriter(path, system="") as writer:
        offset = 0
        for number, row in enumerate(values):
            line = f"{INTERVAL_MS * number}," + ",".join(f"{value:.3f}" for value in row) + "\n"
            if number == 0:
                line = "t_ms," + ",".join(names) + "\n" + line
            data = line.encode()
            chunk = SerialChunk(byte_offset=offset, data=data, opened=number == 0)
            writer.write("/serial/robot", chunk, START_NS + number * INTERVAL_MS * 1_000_000)
            offset += len(data)
    return path


@pytest.fixture
def check(locatk: Callable[..., Any], tmp_path: Path) -> Callable[..., Any]:
    """Check a session of lines with named values."""

    def run(names: list[str], values: np.ndarray, *options: object) -> Any:
        path = tmp_path / "lines.mcap"
        path.unlink(missing_ok=True)
        _session(path, names, values)
        port = f"replay:{path}"
        return locatk("capture", port, "--speed", 0, "--device", "lines", "--test", *options)

    return run


ARRAY_NAMES = [f"b{sensor}{axis}_ut" for sensor in range(3) for axis in "xyz"]
HALL_NAMES = [f"hall_{name}_mt" for name in NAMES]


def test_a_correct_array_passes(check: Any, tmp_path: Path) -> None:
    result = check(ARRAY_NAMES, _turned_array().reshape(600, 9))
    assert result.exit_code == 0
    assert "No fault was found." in result.stdout
    assert "not tested: order of the sensors" in result.stdout
    assert "turn them slowly" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["lines.mcap"]


def test_faults_of_an_array_are_named_with_status_3(check: Any) -> None:
    values = _turned_array()
    values[:, 1] = values[:, 1][:, [1, 0, 2]]
    values[:, 2] *= 0.5
    result = check(ARRAY_NAMES, values.reshape(600, 9))
    assert result.exit_code == 3
    assert "FAULT  sensor 2: axes exchanged: its x, y, z measure y, x, z" in result.stdout
    assert "FAULT  sensor 3: 0.50 times the gain of the others" in result.stdout
    assert "2 faults of the sensors" in result.stderr


def test_the_result_as_json(check: Any) -> None:
    values = _turned_array()
    values[:, 1, 2] *= -1
    result = check(ARRAY_NAMES, values.reshape(600, 9), "--json")
    assert result.exit_code == 3
    report = json.loads(result.stdout)
    assert report["outputs"] == []
    (test,) = report["tests"]
    assert (test["device"], test["system"]) == ("robot", "polaris")
    assert [fault["code"] for fault in test["faults"]] == ["axis_inverted"]
    assert test["sensors"][1]["axes"] == [1, 2, -3]
    assert test["untested"]


def test_hall_sensors_by_name(check: Any) -> None:
    result = check(HALL_NAMES, _passed_halls())
    assert result.exit_code == 0
    exchanged = check(HALL_NAMES, _passed_halls()[:, [0, 3, 2, 1]])
    assert exchanged.exit_code == 3
    assert "left and right are" in exchanged.stdout


def test_the_recording_is_kept_on_request(check: Any, tmp_path: Path) -> None:
    result = check(HALL_NAMES, _passed_halls(), "-o", tmp_path / "kept.mcap")
    assert result.exit_code == 0
    assert Session.open(tmp_path / "kept.mcap").topics("/halls/")


def test_a_device_that_cannot_be_checked_is_untested(check: Any) -> None:
    values = np.column_stack([_turned_array().reshape(600, 9), np.full((600, 4), np.nan)])
    values[:20, 9:] = 0.1
    result = check(ARRAY_NAMES + HALL_NAMES, values)
    assert "No fault was found." in result.stdout
    assert "not tested: all of it: 20 samples of robot" in result.stdout


def test_other_values_are_refused(check: Any) -> None:
    result = check(["temperature_c"], np.ones((60, 1)))
    assert result.exit_code == 1
    assert "no magnetometers, hall sensors or photodiodes" in result.stderr
    assert "Hint:" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["camera:0", "--test"], "--test does not apply to cameras"),
        (["port", "--test", "--rotate", "10s", "-o", "run.mcap"], "does not apply to --rotate"),
    ],
)
def test_wrong_usage(locatk: Callable[..., Any], arguments: list[str], words: str) -> None:
    result = locatk("capture", *arguments)
    assert result.exit_code == 2
    assert words in result.stderr
