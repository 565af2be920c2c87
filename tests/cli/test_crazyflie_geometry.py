"""From the log of a Crazyflie to the geometry that is written into it, as in docs/crazyflie.md."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import Result


@pytest.mark.slow
def test_the_exported_geometry_is_that_of_the_room(
    root: Path, tmp_path: Path, locatk: Callable[..., Result]
) -> None:
    """The room and the log are those of another simulator. Its floor and axes are the marks'."""
    visit = runpy.run_path(str(root / "tests" / "data" / "crazyflie_visit.py"))
    log, run, scene, config = (tmp_path / name for name in ("log00", "a.mcap", "a.toml", "a.yaml"))
    visit["write_log"](log, seed=8)
    steps = [
        ("import", "crazyflie-usd", log, "-o", run),
        ("calibrate", "scene", run, "-o", scene, "--floor", "--x-distance", 1000),
        ("export", scene, "--format", "crazyflie-config", "-o", config),
    ]
    for words in steps:
        result = locatk(*words)
        assert result.exit_code == 0, result.output
    geometries = yaml.safe_load(config.read_text())["geos"]
    for station in visit["FloorVisit"]().stations:
        geometry = geometries[station.channel - 1]
        # The marks define axes and scale to some millimetres: the log has the noise of a deck.
        assert np.linalg.norm(np.array(geometry["origin"]) - station.position) < 0.025
        turned = np.array(geometry["rotation"]).T @ station.rotation
        assert np.degrees(np.arccos((np.trace(turned) - 1) / 2)) < 0.5
