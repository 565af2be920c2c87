"""Figures of ``locatk bench live``: latency, processor time, agreement with ``solve``, memory.

``locatk live`` runs as a process of its own. Its inputs are emulated devices on pseudo-terminals,
in real time, and a video file of a camera; datagrams of its UDP sink are received here. The
recording that it makes is solved offline for the comparison.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts.registry import ARTIFACTS
from locatk.formats.benchmarks.figures import Figure
from locatk.formats.benchmarks.timing import FIRST_SEED, machine_factor
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_trajectories

LIVE_S = 30.0
"""Duration of each measurement in real time."""

WARM_UP_S = 5.0
"""Time after the first pose from which processor time is measured: start-up is over."""

DOTS_HZ = 100.0
DOTS_FRAMES = 2_000

ENVIRONMENT = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}

CLOCK_TICKS_PER_S = os.sysconf("SC_CLK_TCK") if hasattr(os, "sysconf") else 100

MAX_DATAGRAM_BYTES = 65_536


def figures(data: Path) -> list[Figure]:
    """Return all figures; none needs published data. About five minutes, on a quiet machine."""
    if not hasattr(os, "openpty"):
        return [Figure("live", None, "", "not measured: this system has no pseudo-terminals")]
    return [
        *lighthouse_figures(),
        *dots_figures(),
        *polaris_figures(),
        *landmark_figures(),
        *memory_figures(),
    ]


# ---- a live session in a process of its own


@dataclass
class LiveRun:
    """Messages and processor time of a live session.

    Attributes
    ----------
    messages : list of dict
        Datagrams of the UDP sink, in their order.
    cpu_fraction : float
        Processor time over time, from :data:`WARM_UP_S` on; nan if it was too short.
    status : int
        Exit status.
    """

    messages: list[dict[str, Any]] = field(default_factory=list)
    cpu_fraction: float = float("nan")
    status: int = -1

    def of_type(self, kind: str) -> list[dict[str, Any]]:
        """Return the messages of one type."""
        return [message for message in self.messages if message["type"] == kind]

    def latency_s(self, kind: str = "pose") -> np.ndarray:
        """Return the times (n,) from the last byte that a message needed to its sending."""
        return np.array([message["latency_s"] for message in self.of_type(kind)])


def locatk(*arguments: str) -> list[str]:
    """Return the command line of locatk in this interpreter."""
    return [sys.executable, "-m", "locatk.cli", *arguments]


def run(*arguments: str) -> None:
    """Run a command of locatk, and wait for it."""
    subprocess.run(
        locatk(*arguments), check=True, env=ENVIRONMENT, stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )  # fmt: skip


def run_live(
    arguments: Sequence[str], *, on_first_pose: Callable[[], None] = lambda: None
) -> LiveRun:
    """Run ``locatk live`` to its end, and return what its UDP sink sent."""
    result = LiveRun()
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(0.2)
    address = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
    process = subprocess.Popen(
        locatk("live", *arguments, "--to", address, "--json"),
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=ENVIRONMENT, text=True,
    )  # fmt: skip
    errors: list[str] = []
    assert process.stderr is not None
    listener = threading.Thread(target=lambda: errors.extend(process.stderr), daemon=True)  # type: ignore[arg-type]
    listener.start()
    samples: list[tuple[float, float]] = []
    while True:
        try:
            result.messages.append(json.loads(receiver.recv(MAX_DATAGRAM_BYTES)))
        except TimeoutError:
            if process.poll() is not None:
                break
        if not samples and result.messages and result.messages[-1]["type"] == "pose":
            on_first_pose()
        now = time.monotonic()
        if result.of_type("pose") if not samples else now - samples[-1][0] > 0.5:
            used = _processor_time_s(process.pid)
            if used is not None:
                samples.append((now, used))
    receiver.close()
    listener.join(1.0)
    late = [sample for sample in samples if sample[0] > samples[0][0] + WARM_UP_S]
    if len(late) > 1:
        result.cpu_fraction = (late[-1][1] - late[0][1]) / (late[-1][0] - late[0][0])
    result.status = process.returncode
    if result.status not in (0, 3):
        raise OSError(f"locatk live ended with {result.status}: {''.join(errors)}")
    return result


def _processor_time_s(pid: int) -> float | None:
    """Return the processor time of a process; None if the system does not tell."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(words[11]) + int(words[12])) / CLOCK_TICKS_PER_S


@contextmanager
def emulated(session: Path, device: str, port: Path) -> Iterator[None]:
    """Emulate a device that sends a session once, on a new pseudo-terminal."""
    process = subprocess.Popen(
        locatk("emulate", str(session), "--device", device, "--link", str(port), "-q"),
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=ENVIRONMENT,
    )  # fmt: skip
    try:
        while not port.exists():
            if process.poll() is not None:
                raise OSError(f"locatk emulate ended with {process.returncode}")
            time.sleep(0.02)
        yield
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait()


def percentile_ms(seconds: np.ndarray, percent: float) -> float | None:
    """Return a percentile in milliseconds; None without values."""
    return None if not len(seconds) else 1e3 * float(np.percentile(seconds, percent))


# ---- agreement with the offline solver


@dataclass(frozen=True)
class Agreement:
    """Differences of live poses to those of ``locatk solve`` on the same bytes.

    Attributes
    ----------
    ratio : (n,) ndarray
        Distance in the plane over the standard deviation of the live pose in its direction.
    distance_m : (n,) ndarray
    """

    ratio: np.ndarray
    distance_m: np.ndarray


def compare(live: Sequence[Trajectory], solved: Sequence[Trajectory]) -> Agreement:
    """Compare live poses with those of the solver at their times, interpolated."""
    ratios, distances = [np.zeros(0)], [np.zeros(0)]
    by_device = {each.device: each for each in solved}
    for track in live:
        other = by_device.get(track.device)
        if other is None or len(other) < 2:
            continue
        inside = (track.time_ns >= other.time_ns[0]) & (track.time_ns <= other.time_ns[-1])
        track = track.select(inside)
        origin_ns = other.time_ns[0]
        wanted, known = track.time_ns - origin_ns, other.time_ns - origin_ns
        planar = np.column_stack([np.interp(wanted, known, other.position[:, k]) for k in (0, 1)])
        offset = track.position[:, :2] - planar
        distance = np.hypot(*offset.T)
        covariance = track.covariance[:, :2, :2]
        variance = np.einsum("ni,nij,nj->n", offset, covariance, offset)
        sigma = np.sqrt(variance) / np.maximum(distance, 1e-12)
        ratios.append(distance / np.maximum(sigma, 1e-12))
        distances.append(distance)
    return Agreement(np.concatenate(ratios), np.concatenate(distances))


def agreement_figures(system: str, recording: Path, artifacts: Sequence[str]) -> list[Figure]:
    """Solve a recording of ``locatk live`` offline, and compare."""
    solved = recording.with_name("solved.mcap")
    run("solve", str(recording), *artifacts, "-o", str(solved), "--overwrite")
    agreement = compare(read_trajectories(recording, "live"), read_trajectories(solved))
    how = f"{len(agreement.ratio)} live poses against `locatk solve` of the recording"
    median = float(np.median(agreement.ratio)) if len(agreement.ratio) else None
    p95 = float(np.percentile(agreement.ratio, 95)) if len(agreement.ratio) else None
    return [
        Figure(f"{system}: live - offline, median", median, "sigma", how, 1.0),
        Figure(f"{system}: live - offline, p95", p95, "sigma", how),
    ]


# ---- the systems


def lighthouse_figures(duration_s: float = LIVE_S, robots: int = 10) -> list[Figure]:
    """Localize robots with one photodiode each, which report every sweep of two stations."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        receiver = folder / "receiver.toml"
        receiver.write_text(
            'format = "locatk-lighthouse-receiver"\nformat_version = 1\n'
            "position_mm = [[0.0, 0.0, 0.0]]\n"
        )
        session, solved, scene = (folder / name for name in ("sim.mcap", "sim-solved.mcap", "scene.toml"))
        run(
            "simulate", "lighthouse", "--robots", str(robots), "--stations", "2",
            "--duration", f"{duration_s:g}", "--receiver", str(receiver), "--seed", str(FIRST_SEED),
            "-o", str(session),
        )  # fmt: skip
        run("solve", str(session), "-o", str(solved))
        _save_artifact(solved, "scene.toml", scene)
        port, recording = folder / "port", folder / "run.mcap"
        stack.enter_context(emulated(session, "dotbot-gateway", port))
        live = run_live(
            [str(port), "--device", "dotbot-gateway", "--artifact", str(scene), "--record",
             str(recording), "--duration", f"{duration_s + 2:g}"]
        )  # fmt: skip
        agreement = agreement_figures("lighthouse", recording, ["--artifact", str(scene)])
    latency_s = live.latency_s()
    how = (
        f"{robots} robots, one photodiode each, two stations: {len(latency_s)} poses in "
        f"{duration_s:.0f} s from a pseudo-terminal, recorded; last byte to the UDP sink"
    )
    return [
        Figure("lighthouse: latency, p50", percentile_ms(latency_s, 50), "ms", how, 3.0,
               workload="Python", machine_factor=machine_factor("Python")),
        Figure("lighthouse: latency, p99", percentile_ms(latency_s, 99), "ms", how, 10.0,
               workload="Python", machine_factor=machine_factor("Python")),
        Figure("lighthouse: poses per second and robot", len(latency_s) / duration_s / robots,
               "1/s", how, 90.0, "higher"),
        Figure("lighthouse: one core", 100 * live.cpu_fraction, "%",
               f"{how}; processor time of the process without start-up", 60.0,
               workload="Python", machine_factor=machine_factor("Python")),
        *agreement,
    ]  # fmt: skip


def dots_figures(frames: int = DOTS_FRAMES, rate_hz: float = DOTS_HZ) -> list[Figure]:
    """Localize a camera of 188 x 120 px over a sheet, from a video file in real time."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        session, video, sheet = folder / "sim.mcap", folder / "camera.avi", folder / "sheet.toml"
        run(
            "simulate", "dots", "--frames", str(frames), "--rate", f"{rate_hz:g}", "--seed",
            str(FIRST_SEED), "-o", str(session),
        )  # fmt: skip
        _save_artifact(session, "manifest.toml", sheet)
        write_video(session, video, rate_hz)
        recording = folder / "run.mcap"
        live = run_live(
            [f"camera:{video}", "--artifact", str(sheet), "--record", str(recording)]
        )
        agreement = agreement_figures("dots", recording, ["--artifact", str(sheet)])
    latency_s = live.latency_s()
    lost = frames - len(live.of_type("pose"))
    how = (
        f"{frames} frames of 188 x 120 px at {rate_hz:.0f} frames/s from a video file, recorded; "
        "frame to the UDP sink"
    )
    return [
        Figure("dots: latency, p50", percentile_ms(latency_s, 50), "ms", how),
        Figure("dots: latency, p99", percentile_ms(latency_s, 99), "ms", how, 10.0,
               workload="Python", machine_factor=machine_factor("Python")),
        Figure("dots: frames without a pose", lost, "", how, 0.0),
        Figure("dots: one core", 100 * live.cpu_fraction, "%",
               f"{how}; processor time of the process without start-up", 60.0,
               workload="Python", machine_factor=machine_factor("Python")),
        *agreement,
    ]  # fmt: skip


def write_video(session: Path, video: Path, rate_hz: float) -> None:
    """Write the frames of a session as a lossless video file."""
    import cv2

    from locatk.formats.sessions.frames import read_frames

    (frames,) = read_frames(Session.open(session))
    height, width = frames.images[0].shape
    codec = cv2.VideoWriter.fourcc(*"FFV1")
    writer = cv2.VideoWriter(str(video), codec, rate_hz, (width, height), isColor=False)
    for image in frames.images:
        writer.write(image)
    writer.release()


def polaris_figures() -> list[Figure]:
    """Identify tags under a bar of magnetometers, from a pseudo-terminal."""
    return _field_figures("polaris", "the last magnet", 0.2)


def landmark_figures() -> list[Figure]:
    """Identify landmarks under a robot, from a pseudo-terminal."""
    return _field_figures("landmarks", "leaving a landmark", 0.1)


def _field_figures(system: str, moment: str, target_s: float) -> list[Figure]:
    """Measure the delay of detections, and the latency of poses at the rate of odometry."""
    raise NotImplementedError


def memory_figures() -> list[Figure]:
    """Push ten hours of observations."""
    raise NotImplementedError


def _save_artifact(session: Path, name: str, path: Path) -> None:
    data = Session.open(session).attachment(name)
    if data is None:
        known = ", ".join(entry.artifact.file for entry in ARTIFACTS.values())
        raise OSError(f"{session} has no {name} (of {known})")
    path.write_bytes(data)
