"""A small recorded session, and a solver that needs no time."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from locatk.cli import systems
from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.lighthouse.sweeps import Sweeps
from locatk.core.solution import Solution
from locatk.core.trajectory import Trajectory
from locatk.formats import observations
from locatk.formats.session import Session

START_NS = 1_700_000_000_000_000_000
POSES = 20


def track(device: str, n: int = POSES, shift_m: float = 0.0) -> Trajectory:
    """``n`` poses on a curve, a tenth of a second apart, known to 2 mm."""
    turn = np.linspace(0, 3, n)
    position = np.column_stack([turn + shift_m, np.sin(turn), 0 * turn])
    time_ns = START_NS + 100_000_000 * np.arange(n)
    covariance = np.broadcast_to(np.eye(3) * 4e-6, (n, 3, 3))
    return Trajectory.from_positions(device, "floor", time_ns, position, covariance)


CALIBRATION = Calibration(np.zeros((2, 7)), "generic")
SCENE = Scene(
    stations=(Station(3, np.array([0.0, 1.0, 2.0]), np.eye(3), CALIBRATION, id=0x4CC60647),),
    markers=(Marker("corner", np.zeros(3)),),
    planar=True,
    scale="markers",
)


def sweeps(devices: tuple[str, ...]) -> Sweeps:
    """Two sweeps of channel 1 for each pose and device."""
    n = 2 * POSES * len(devices)
    return Sweeps(
        devices=devices,
        time_ns=START_NS + 50_000_000 * np.arange(n),
        device=np.arange(n, dtype=np.int32) % len(devices),
        sensor=np.zeros(n, np.int32),
        channel=np.ones(n, np.int32),
        polynomial=np.full(n, -1, np.int32),
        sweep=np.full(n, -1, np.int32),
        count=40_000.0 + np.arange(n),
    )


def record(path: Path, devices: tuple[str, ...] = ("red",), system: str = "lighthouse") -> Path:
    """A session with truth and markers."""
    observations.write_session(
        path,
        system=system,
        sweeps=sweeps(devices),
        scene=Scene(markers=SCENE.markers),
        truth=[track(device) for device in devices],
        facts={"note": "made by a test"},
    )
    return path


@pytest.fixture(name="record")
def recorder() -> Callable[..., Path]:
    """``record(path, devices, system)`` writes a session and returns its path."""
    return record


@pytest.fixture
def scene() -> Scene:
    """The scene that the solver of :func:`requests` finds."""
    return SCENE


@pytest.fixture
def session(tmp_path: Path) -> Path:
    """A session of one robot, `red`."""
    return record(tmp_path / "run.mcap")


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> list[systems.Request]:
    """Put a solver in place that answers with the truth, 1 mm off; gives what it was asked.

    A session called `still` is refused, in `blind` the robot is never seen.
    """
    asked: list[systems.Request] = []

    def solve(session: Session, request: systems.Request) -> systems.Solved:
        asked.append(request)
        name = Path(session.path).stem
        if name.startswith("still"):
            raise DegenerateError("one robot standing still", hint="Drive it around")
        devices = observations.read_sweeps(session).devices
        solution = Solution(
            system="lighthouse",
            method=request.method or "bundle",
            trajectories=tuple(
                track(device, 0 if name.startswith("blind") else POSES, shift_m=1e-3)
                for device in devices
            ),
            rejected={"jump": 3},
            detections=[
                {
                    "station": 0,
                    "channel": 1,
                    "id": None,
                    "period_ticks": 959000,
                    "calibration": "generic",
                    "sweeps": np.int64(40),
                    "rejected": 3,
                }
            ],
            artifact=SCENE,
            notes=("generic calibration",),
        )
        return systems.Solved(solution, 0.25)

    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", solve)
    return asked
