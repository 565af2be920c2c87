"""The generated code agrees with the schemas."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

from locatk.formats.schemas import (
    inertial_pb2,
    lighthouse_pb2,
    magnetics_pb2,
    poses_pb2,
    serial_pb2,
)

MODULES = (inertial_pb2, lighthouse_pb2, magnetics_pb2, poses_pb2, serial_pb2)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_generated_code_is_up_to_date(root: Path) -> None:
    pytest.importorskip("grpc_tools", reason="grpcio-tools (extra dev) is not installed")
    script = runpy.run_path(str(root / "formats" / "schemas" / "generate.py"))
    assert script["stale"]() == []


def test_names_of_the_messages() -> None:
    names = {
        message.full_name
        for module in MODULES
        for message in module.DESCRIPTOR.message_types_by_name.values()
    }
    assert names == {
        "locatk.HallArray",
        "locatk.Imu",
        "locatk.LighthouseCapture",
        "locatk.LighthouseSweep",
        "locatk.MagnetometerArray",
        "locatk.Odometry",
        "locatk.PoseTrack",
        "locatk.Readings",
        "locatk.SerialChunk",
    }


def test_messages_are_documented(root: Path) -> None:
    text = (root / "docs" / "formats.md").read_text("utf-8")
    for module in MODULES:
        for message in module.DESCRIPTOR.message_types_by_name.values():
            assert f"`{message.full_name}`" in text
            for field in message.fields:
                assert f"`{field.name}`" in text, f"{message.full_name}.{field.name}"
