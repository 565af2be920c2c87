"""Commands without the optional packages that they need: one line that names the extra."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result

from locatk.core.landmarks.landmark import Geometry
from locatk.core.landmarks.map.floor import FloorMap
from locatk.formats.artifacts.maps import write_map

Run = Callable[..., Result]

COMMANDS = {
    "map export map.toml -o hall.dxf": ("dxf", "DXF needs ezdxf"),
    "map import plan.dxf -o hall.toml": ("dxf", "plan.dxf: DXF needs ezdxf"),
    "eval bag.db3 --truth bag.db3": ("ros", "bag.db3: a message of ROS needs rosbags"),
    "print pattern -o sheet.pdf --overlay drawing.pdf": ("pdf", "an overlay needs pikepdf"),
    "import crazyflie-config cf.yaml -o scene.toml": (
        "yaml",
        "cf.yaml: a Crazyflie configuration needs PyYAML",
    ),
    "import crazyflie-usd log00 --config cf.yaml -o flight.mcap": (
        "yaml",
        "cf.yaml: a Crazyflie configuration needs PyYAML",
    ),
    "import landmark-csv table.parquet --map map.toml -o drive.mcap": (
        "parquet",
        "Parquet needs pyarrow",
    ),
    "capture ble:robot7 -o run.mcap": ("ble", "ble:robot7: Bluetooth needs bleak"),
    "solve s3://bucket/run.mcap": ("s3", "s3://bucket/run.mcap: a URL needs s3fs"),
}
"""Commands, the extra that each needs, and a part of its message."""


@pytest.fixture
def inputs(tmp_path: Path, crazyflie: Any, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Current folder with the files of the commands."""
    floor = FloorMap(np.array([[7, 1]]), window="I2", detect=1, geometry=Geometry())
    write_map(tmp_path / "map.toml", floor)
    for name in ("drawing.pdf", "cf.yaml", "table.parquet", "plan.dxf"):
        (tmp_path / name).write_bytes(b"PAR1, not read")
    (tmp_path / "bag.db3").write_bytes(b"SQLite format 3\0, not read")
    log = crazyflie.write_flight(crazyflie.Flight(0.5), np.random.default_rng(1))
    (tmp_path / "log00").write_bytes(log.data())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("command", COMMANDS)
def test_the_error_names_the_extra(
    command: str, inputs: Path, locatk: Run, without_extras: Callable[..., None]
) -> None:
    extra, problem = COMMANDS[command]
    before = sorted(inputs.iterdir())
    without_extras(extra)
    result = locatk(*command.split())
    assert result.exit_code == 1
    assert result.stderr.startswith("Error: ")
    assert result.stderr.count("\n") == 1
    assert problem in result.stderr
    assert result.stderr.endswith(f' Hint: Install it: pip install "locatk[{extra}]".\n')
    assert sorted(inputs.iterdir()) == before


@pytest.mark.parametrize(
    "command",
    [
        "map export map.toml -o hall.svg",
        "map export map.toml -o hall.yaml",
        "print pattern -o sheet.pdf --size 90x90mm",
        "print landmarks map.toml -o pack.pdf",
    ],
)
def test_other_outputs_need_no_extra(
    command: str, inputs: Path, locatk: Run, without_extras: Callable[..., None]
) -> None:
    without_extras()
    result = locatk(*command.split())
    assert result.exit_code == 0, result.stderr
