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
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from locatk.core.geometry import heading_from_quaternion
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.preprocessing import MIN_FIELD_THRESHOLDS
from locatk.core.landmarks.stream import LandmarksStream
from locatk.core.lighthouse.stream import LighthouseStream
from locatk.core.polaris.array import Samples
from locatk.core.polaris.results import TagDetection
from locatk.core.polaris.solver import solve
from locatk.core.polaris.stream import PolarisStream
from locatk.core.solution import Solution
from locatk.core.streaming.events import DetectionEvent
from locatk.core.streaming.localizer import LiveLocalizer
from locatk.core.trajectory import Trajectory
from locatk.formats.artifacts.scene import SCENE
from locatk.formats.artifacts.sheets import MANIFEST
from locatk.formats.benchmarks.figures import Figure, measure_or_explain
from locatk.formats.benchmarks.landmarks.faults import drive_over, random_cells
from locatk.formats.benchmarks.landmarks.global_localization import standard_floor
from locatk.formats.benchmarks.polaris.suite import read_runs
from locatk.formats.benchmarks.timing import FIRST_SEED, machine_factor
from locatk.formats.emulation.sources import write_simulated_session
from locatk.formats.importers.polaris_csv import PUBLISHED_TAGS
from locatk.formats.sessions.observations import (
    read_magnetometers,
    read_odometry,
    read_sweeps,
    read_tags,
)
from locatk.formats.sessions.reader import Session
from locatk.formats.sessions.solutions import read_trajectories

LIVE_S = 30.0
"""Duration of the measurement of Lighthouse in real time."""

ROBOT_S = 45.0
"""Longest duration of a simulated drive over tags or landmarks in real time."""

WARM_UP_S = 5.0
"""Time after the first pose from which processor time is measured: start-up is over."""

PROCESSOR_INTERVAL_S = 0.5

MEMORY_HOURS = 10.0

LANDMARK_DRIVES = POLARIS_DRIVES = 4

MAX_PASS_S = 4.0
"""Longest time over one tag."""

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
        *polaris_figures(data),
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

    def is_certain(self, track: Trajectory) -> np.ndarray:
        """Return which poses (n,) of a recorded track were not published as ``provisional``."""
        times_s = np.sort(
            [
                pose["time_s"]
                for pose in self.of_type("pose")
                if pose["device"] == track.device and pose["state"] != "provisional"
            ]
        )
        # Messages have the time as a float, to 0.2 microseconds.
        wanted_s = 1e-9 * track.time_ns
        return np.searchsorted(times_s, wanted_s - 1e-6) < np.searchsorted(times_s, wanted_s + 1e-6)

    def latency_s(self) -> np.ndarray:
        """Return the times (n,) from the last byte that a pose needed to its sending.

        Those of the first second, in which the port is opened, are left out.
        """
        poses = self.of_type("pose")
        start_s = min((pose["time_s"] for pose in poses), default=0.0) + 1.0
        return np.array([pose["latency_s"] for pose in poses if pose["time_s"] > start_s])


def locatk(*arguments: str) -> list[str]:
    """Return the command line of locatk in this interpreter."""
    return [sys.executable, "-m", "locatk.cli", *arguments]


def run(*arguments: str) -> None:
    """Run a command of locatk, and wait for it.

    Raises
    ------
    OSError
        It failed.
    """
    done = subprocess.run(
        locatk(*arguments), env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        text=True,
    )  # fmt: skip
    if done.returncode not in (0, 3):
        raise OSError(f"locatk {arguments[0]} ended with {done.returncode}: {done.stderr}")


def run_live(arguments: Sequence[str]) -> LiveRun:
    """Run ``locatk live`` to its end, and return what its UDP sink sent."""
    result = LiveRun()
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 22)
    receiver.bind(("127.0.0.1", 0))
    receiver.settimeout(0.2)
    address = f"udp://127.0.0.1:{receiver.getsockname()[1]}"
    process = subprocess.Popen(
        locatk("live", *arguments, "--to", address),
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
        now = time.monotonic()
        is_due = samples and now - samples[-1][0] > PROCESSOR_INTERVAL_S
        is_first = not samples and result.messages and result.messages[-1]["type"] == "pose"
        if is_due or is_first:
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


def agreement_figures(
    system: str, live: LiveRun, recording: Path, artifacts: Sequence[str]
) -> list[Figure]:
    """Solve a recording of ``locatk live`` offline, and compare the poses but provisional ones."""
    solved = recording.with_name("solved.mcap")
    run("solve", str(recording), *artifacts, "-o", str(solved), "--overwrite")
    certain = [each.select(live.is_certain(each)) for each in read_trajectories(recording, "live")]
    agreement = compare(certain, read_trajectories(solved))
    how = (
        f"{len(agreement.ratio)} live poses that are not provisional against `locatk solve` of "
        "the recording"
    )
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
        session, solved = folder / "sim.mcap", folder / "sim-solved.mcap"
        scene = folder / "scene.toml"
        run(
            "simulate", "lighthouse", "--robots", str(robots), "--stations", "2",
            "--duration", f"{duration_s:g}", "--receiver", str(receiver), "--seed", str(FIRST_SEED),
            "-o", str(session),
        )  # fmt: skip
        run("solve", str(session), "-o", str(solved))
        _save_artifact(solved, SCENE.file, scene)
        port, recording = folder / "port", folder / "run.mcap"
        stack.enter_context(emulated(session, "dotbot-gateway", port))
        live = run_live(
            [str(port), "--device", "dotbot-gateway", "--artifact", str(scene), "--record",
             str(recording), "--duration", f"{duration_s + 2:g}"]
        )  # fmt: skip
        agreement = agreement_figures("lighthouse", live, recording, ["--artifact", str(scene)])
    latency_s = live.latency_s()
    how = (
        f"{robots} robots, one photodiode each, two stations: {len(latency_s)} poses in "
        f"{duration_s:.0f} s from a pseudo-terminal, recorded; last byte to the UDP sink, without "
        "the first second"
    )
    return [
        Figure("lighthouse: latency, p50", percentile_ms(latency_s, 50), "ms", how, 3.0,
               workload="Python", machine_factor=machine_factor("Python")),
        Figure("lighthouse: latency, p99", percentile_ms(latency_s, 99), "ms", how, 10.0,
               workload="Python", machine_factor=machine_factor("Python")),
        Figure("lighthouse: poses per second and robot", len(latency_s) / (duration_s - 1) / robots,
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
        _save_artifact(session, MANIFEST.file, sheet)
        write_video(session, video, rate_hz)
        recording = folder / "run.mcap"
        live = run_live([f"camera:{video}", "--artifact", str(sheet), "--record", str(recording)])
        agreement = agreement_figures("dots", live, recording, ["--artifact", str(sheet)])
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


def polaris_figures(data: Path, duration_s: float = ROBOT_S) -> list[Figure]:
    """Identify the tags of the published recordings and of simulated sites."""
    published = Figure(
        "polaris: id and pose after the last magnet, published recordings, p99", None, "ms",
        f"{_DELAY}; tags without positions, of which any id may follow", workload="numpy",
    )  # fmt: skip

    def measure_published() -> list[Figure]:
        runs = read_runs(data / "polaris")
        recordings = [(each, PUBLISHED_TAGS, None) for some in runs.values() for each in some]
        return _tag_figures(published, recordings)

    site, with_odometry = (
        Figure(
            f"polaris: id and pose after the last magnet, {name}, p99", None, "ms",
            f"{_DELAY}; tags on a site", 200.0, workload="numpy",
        )
        for name in ("site", "site and odometry")
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        sessions = []
        for seed in range(FIRST_SEED, FIRST_SEED + POLARIS_DRIVES):
            path = Path(folder, f"{seed}.mcap")
            write_simulated_session("polaris", path, seed=seed)
            sessions.append(Session.open(path))
        drives = [
            (read_magnetometers(each)[0], read_tags(each), read_odometry(each)[0])
            for each in sessions
        ]
    return [
        *measure_or_explain(measure_published, published),
        *_tag_figures(site, [(samples, tags, None) for samples, tags, _ in drives]),
        *_tag_figures(with_odometry, drives),
        *_robot_figures("polaris", "locatk", duration_s),
    ]


_DELAY = (
    "one sample at a time: the last magnet by the offline solver, plus waiting for samples, plus "
    "computation"
)


def _tag_figures(declared: Figure, recordings: Sequence[tuple[Any, ...]]) -> list[Figure]:
    """Measure the delay of each tag, and compare the ids with those of the offline solver."""
    delays_s, wrong = [], 0
    for samples, tags, odometry in recordings:
        offline = solve([samples], tags, odometry=() if odometry is None else (odometry,))
        events = push_timed(PolarisStream(tags), _interleaved(samples, odometry))
        found = [(t, e.detection) for t, e in events if isinstance(e, DetectionEvent)]
        found = [(t, d) for t, d in found if isinstance(d, TagDetection)]
        wrong += [d.tag_id for _, d in found] != [d.tag_id for d in offline.detections]
        for (time_s, detection), reference in zip(found, offline.detections, strict=False):
            if detection.tag_id is not None and reference.tag_id is not None:
                delays_s.append(time_s - 1e-9 * last_magnet_ns(offline, reference))
    how = f"{declared.how}; {len(delays_s)} tags"
    value = percentile_ms(np.array(delays_s), 99)
    return [
        replace(declared, value=value, how=how, machine_factor=machine_factor("numpy")),
        Figure(f"{declared.name}: recordings with other ids than offline", wrong, "", how, 0.0),
    ]


def landmark_figures(duration_s: float = ROBOT_S) -> list[Figure]:
    """Identify the landmarks of simulated drives."""
    floor, source = standard_floor(Path())
    delays_s: list[float] = []
    for seed in range(FIRST_SEED, FIRST_SEED + LANDMARK_DRIVES):
        session = drive_over(floor, seed, random_cells(floor, seed))
        samples, odometry = session.samples[0], session.odometry[0]
        events = push_timed(LandmarksStream(floor), _interleaved(samples, odometry))
        left_ns = samples.time_ns[_has_field(samples, floor)]
        for time_s, event in events:
            if isinstance(event, DetectionEvent):
                # The visit ended with the last sample in a field before the result.
                before = np.searchsorted(left_ns, 1e9 * time_s, "right") - 1
                delays_s.append(time_s - 1e-9 * left_ns[before])
    how = (
        f"{len(delays_s)} visits of {LANDMARK_DRIVES} simulated drives over {source}, one sample "
        "at a time: waiting for samples plus computation"
    )
    return [
        Figure("landmarks: estimate after leaving a landmark, p99",
               percentile_ms(np.array(delays_s), 99), "ms", how, 100.0, workload="numpy",
               machine_factor=machine_factor("numpy")),
        *_robot_figures("landmarks", "locatk", duration_s),
    ]  # fmt: skip


def _robot_figures(system: str, device: str, duration_s: float) -> list[Figure]:
    """Measure the latency of poses at the rate of odometry, over a pseudo-terminal."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        session, port, recording = (folder / name for name in ("sim.mcap", "port", "run.mcap"))
        write_simulated_session(system, session, seed=FIRST_SEED)
        stack.enter_context(emulated(session, device, port))
        live = run_live(
            [str(port), "--device", device, "--artifact", str(session), "--record",
             str(recording), "--duration", f"{duration_s:g}"]
        )  # fmt: skip
        agreement = agreement_figures(system, live, recording, [])
    latency_s = live.latency_s()
    how = (
        f"one robot, {len(latency_s)} poses in {duration_s:.0f} s from a pseudo-terminal, "
        "recorded; last byte to the UDP sink"
    )
    return [
        Figure(f"{system}: latency of poses, p50", percentile_ms(latency_s, 50), "ms", how),
        Figure(f"{system}: latency of poses, p99", percentile_ms(latency_s, 99), "ms", how),
        Figure(f"{system}: one core", 100 * live.cpu_fraction, "%",
               f"{how}; processor time of the process without start-up", 60.0,
               workload="Python", machine_factor=machine_factor("Python")),
        *agreement,
    ]  # fmt: skip


# ---- one observation at a time


def push_timed(stream: Any, pieces: Iterable[Any]) -> list[tuple[float, Any]]:
    """Push pieces when they are complete; return the events with the times of their results.

    The clock is that of the observations: a piece arrives at the time of its last sample, and is
    processed as soon as the one before it is. The processor time of each call is added.
    """
    now_s = -np.inf
    events: list[tuple[float, Any]] = []
    for piece in pieces:
        start_s = time.process_time()
        results = stream.push(piece)
        spent_s = time.process_time() - start_s
        now_s = max(now_s, 1e-9 * float(piece.time_ns[-1])) + spent_s
        events += [(now_s, event) for event in results]
    return events


def _interleaved(samples: Samples | HallSamples, odometry: Trajectory | None) -> Iterator[Any]:
    """Yield single samples and poses of odometry in the order of their times."""
    pieces = [
        *((int(t), 0, k) for k, t in enumerate([] if odometry is None else odometry.time_ns)),
        *((int(samples.time_ns[k]), 1, k) for k in range(len(samples))),
    ]
    for _, kind, k in sorted(pieces):
        if odometry is not None and kind == 0:
            yield odometry.select(np.array([k]))
        else:
            part = slice(k, k + 1)
            yield replace(samples, time_ns=samples.time_ns[part], field_t=samples.field_t[part])


def last_magnet_ns(solution: Solution, detection: TagDetection) -> float:
    """Return the time at which an array was over the last magnet of a tag."""
    (track,) = solution.trajectories
    near = np.abs(1e-9 * track.time_ns - detection.time_s) < MAX_PASS_S / 2
    track = track.select(near)
    moment = int(np.argmin(np.abs(1e-9 * track.time_ns - detection.time_s)))
    heading = heading_from_quaternion(track.quaternion)
    forward = np.column_stack([np.cos(heading), np.sin(heading)])
    left = np.column_stack([-np.sin(heading), np.cos(heading)])
    magnets = np.array([[each.x_m, each.y_m] for each in detection.magnets])
    on_floor = (
        track.position[moment, :2]
        + magnets[:, :1] * forward[moment]
        + magnets[:, 1:] * left[moment]
    )
    offset = on_floor[None] - track.position[:, None, :2]
    ahead_m = np.einsum("nmk,nk->nm", offset, forward).max(axis=1)
    is_ahead = np.flatnonzero(ahead_m > 0)
    return float(track.time_ns[is_ahead[-1] if len(is_ahead) else 0])


def _has_field(samples: HallSamples, floor: FloorMap) -> np.ndarray:
    """Return which samples (n,) measure the field of a landmark."""
    strongest_t = np.abs(samples.field_t - np.median(samples.field_t, axis=0)).max(axis=1)
    return strongest_t >= MIN_FIELD_THRESHOLDS * floor.geometry.threshold_t


# ---- memory


def memory_figures(hours: float = MEMORY_HOURS) -> list[Figure]:
    """Push ten hours of sweeps through a localizer, as fast as possible, in another process."""
    code = f"from locatk.formats.benchmarks.live import print_memory; print_memory({hours})"
    with tempfile.TemporaryDirectory() as folder:
        session, solved = Path(folder, "sim.mcap"), Path(folder, "solved.mcap")
        write_simulated_session("lighthouse", session, seed=FIRST_SEED)
        run("solve", str(session), "-o", str(solved))
        done = subprocess.run(
            [sys.executable, "-c", code, str(session), str(solved)],
            capture_output=True, text=True, env=ENVIRONMENT,
        )  # fmt: skip
    if done.returncode:
        raise OSError(done.stderr)
    report = json.loads(done.stdout)
    how = (
        f"{hours:g} h of two robots under two stations, {report['events']} events: largest "
        "resident memory of the process at the end minus that after the first tenth"
    )
    return [
        Figure(
            "memory: growth in ten hours", report["end_mb"] - report["tenth_mb"], "MB", how, 5.0
        ),
        Figure("memory: at the end", report["end_mb"], "MB", how),
    ]


def print_memory(hours: float) -> None:
    """Push a session repeatedly, and print the largest resident memory as JSON.

    ``sys.argv`` contains the session and its solution. Runs in the process of
    :func:`memory_figures`.
    """
    import resource

    session, solved = (Session.open(path) for path in sys.argv[1:3])
    sweeps = read_sweeps(session)
    sweeps = sweeps.take(np.argsort(sweeps.time_ns, kind="stable"))
    localizer = LiveLocalizer(LighthouseStream(SCENE.attached(solved)))
    start_ns = int(sweeps.time_ns[0])
    round_ns = int(sweeps.time_ns[-1]) - start_ns + 1_000_000_000
    rounds = int(np.ceil(3600e9 * hours / round_ns))
    events, memory_mb = 0, []
    for number in range(rounds):
        shift_ns = number * round_ns
        for begin_ns in range(start_ns, start_ns + round_ns, 500_000_000):
            inside = (sweeps.time_ns >= begin_ns) & (sweeps.time_ns < begin_ns + 500_000_000)
            piece = sweeps.take(np.flatnonzero(inside))
            events += len(localizer.push(replace(piece, time_ns=piece.time_ns + shift_ns)))
            localizer.advance(begin_ns + shift_ns)
        memory_mb.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
    tenth_mb = memory_mb[len(memory_mb) // 10]
    print(json.dumps({"events": events, "tenth_mb": tenth_mb, "end_mb": memory_mb[-1]}))


def _save_artifact(session: Path, name: str, path: Path) -> None:
    data = Session.open(session).attachment(name)
    if data is None:
        raise OSError(f"{session} has no {name}")
    path.write_bytes(data)
