"""A small recorded session, a solver that needs no time, and recordings in other processes."""

from __future__ import annotations

import contextlib
import os
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from locatk.core.errors import DegenerateError
from locatk.core.lighthouse.calibration import Calibration
from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.results import StationDetection
from locatk.core.lighthouse.scene import Marker, Scene, Station
from locatk.core.solution import Solution, SolverWarning
from locatk.core.trajectory import Trajectory
from locatk.formats.pipeline import systems
from locatk.formats.sessions import observations
from locatk.formats.sessions.reader import Session

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
def requests(monkeypatch: pytest.MonkeyPatch) -> list[systems.SolveRequest]:
    """Put a solver in place that answers with the truth, 1 mm off; gives what it was asked.

    A session called `still` is refused, in `blind` the robot is never seen.
    """
    asked: list[systems.SolveRequest] = []

    def solve(session: Session, request: systems.SolveRequest) -> systems.SolvedSession:
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
            detections=(
                StationDetection(
                    station=0,
                    channel=1,
                    id=None,
                    period_ticks=959000,
                    calibration="generic",
                    sweeps=np.int64(40),
                    rejected=3,
                ),
            ),
            artifact=SCENE,
            warnings=(SolverWarning("generic_calibration", "generic calibration"),),
        )
        return systems.SolvedSession(solution, 0.25)

    monkeypatch.setitem(systems.SYSTEMS, "lighthouse", solve)
    return asked


class Line:
    """A serial line: a pseudo-terminal behind a path that stays, where the test is the device."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._master = -1
        self.plug()

    def plug(self) -> None:
        """Make it appear, as another terminal."""
        import tty

        self._master, slave = os.openpty()
        tty.setraw(slave)
        self.path.symlink_to(os.ttyname(slave))
        os.close(slave)
        os.set_blocking(self._master, False)

    def unplug(self) -> None:
        """Make it vanish."""
        if self._master >= 0:
            self.path.unlink()
            os.close(self._master)
            self._master = -1

    def send(self, data: bytes, over: threading.Event | None = None) -> int:
        """Send all of it, or until it is ``over``; waits for the reader. How much was sent."""
        done = 0
        until = time.monotonic() + 20.0
        while done < len(data) and not (over is not None and over.is_set()):
            assert time.monotonic() < until, "nobody reads"
            select.select([], [self._master], [], 0.1)
            with contextlib.suppress(BlockingIOError):
                done += os.write(self._master, data[done : done + 65_536])
        return done


class Process:
    """A command in a process of its own, which may be talked to while it runs.

    ``first`` is Python that runs in it before.
    """

    def __init__(self, *arguments: object, first: str = "") -> None:
        code = f"{first}\nfrom locatk.cli.app import main; main()"
        start = ["-c", code] if first else ["-m", "locatk.cli"]
        command = [sys.executable, *start, *map(str, arguments)]
        self.stdout = ""
        self.lines: list[str] = []
        self._news = threading.Condition()
        self.child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self._readers = [threading.Thread(target=read) for read in (self._talk, self._results)]
        for reader in self._readers:
            reader.start()

    def _talk(self) -> None:
        assert self.child.stderr is not None
        for line in self.child.stderr:
            with self._news:
                self.lines.append(line.rstrip("\n"))
                self._news.notify_all()
        with self._news:
            self.lines.append("")  # wakes those who wait for what never came
            self._news.notify_all()

    def _results(self) -> None:
        assert self.child.stdout is not None
        self.stdout = self.child.stdout.read()

    @property
    def stderr(self) -> str:
        """What it has said."""
        return "\n".join(self.lines)

    def until(self, words: str, timeout_s: float = 30.0) -> None:
        """Wait until it says this."""
        with self._news:
            self._news.wait_for(lambda: words in self.stderr or self.lines[-1:] == [""], timeout_s)
        assert words in self.stderr

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal."""
        self.child.send_signal(number)

    def end(self, timeout_s: float = 30.0) -> int:
        """Wait for its end; gives the exit status."""
        status = self.child.wait(timeout_s)
        for reader in self._readers:
            reader.join(timeout_s)
        return status

    def stop(self) -> int:
        """As by Ctrl-C; gives the exit status."""
        self.signal(signal.SIGINT)
        return self.end()


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Callable[[str], Line]]:
    """``line()`` is a serial line that is plugged in, ``line("name")`` one more."""
    made: list[Line] = []

    def plugged(name: str = "port") -> Line:
        made.append(Line(tmp_path / name))
        return made[-1]

    yield plugged
    for each in made:
        each.unplug()


@pytest.fixture
def process() -> Iterator[Callable[..., Process]]:
    """``process("capture", ...)`` begins a command; it is gone in the end, whatever happens."""
    yield from _processes()


@pytest.fixture(scope="module")
def processes() -> Iterator[Callable[..., Process]]:
    """The same for all tests of a module."""
    yield from _processes()


def _processes() -> Iterator[Callable[..., Process]]:
    made: list[Process] = []

    def begin(*arguments: object, first: str = "") -> Process:
        made.append(Process(*arguments, first=first))
        return made[-1]

    yield begin
    for each in made:
        with contextlib.suppress(ProcessLookupError):
            each.child.kill()
        each.end()
        for stream in (each.child.stdout, each.child.stderr):
            assert stream is not None
            stream.close()


@pytest.fixture
def raw_bytes(raw_bytes: Callable[..., bytes]) -> Callable[..., bytes]:
    """Return the function of all tests, which reads the rest of damaged recordings here."""
    return partial(raw_bytes, damaged_ok=True)
