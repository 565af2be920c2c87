"""Frames in which a Crazyflie may fly, by their source."""

from __future__ import annotations

from dataclasses import replace

import pytest

from locatk.core.lighthouse.simulation.session import SimulationOptions, simulate
from locatk.formats.exporters.crazyflie import describe_frame_fault


@pytest.mark.parametrize(
    ("source", "scale", "fault"),
    [
        ("markers", "device", None),
        ("floor", "device", None),
        ("gravity", "distance", "the origin of the frame 'lab' is not known to be on the floor"),
        ("station", "distance", "the frame 'lab' is not level"),
        (None, "markers", None),
        (None, "distance", "the frame 'lab' is not level"),
    ],
)
def test_frames_for_flight(source: str | None, scale: str, fault: str | None) -> None:
    scene = simulate(SimulationOptions(planar=False, duration_s=1.0)).true_scene
    found = describe_frame_fault(replace(scene, frame="lab", frame_source=source, scale=scale))
    assert (found is None) == (fault is None)
    assert fault is None or str(found).startswith(fault)
