"""Stream of Lighthouse: fixes of photodiodes and rigid devices, in a scene given or estimated."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from locatk.core.errors import LocatkError
from locatk.core.lighthouse.channels import CHANNELS, period_counts
from locatk.core.lighthouse.devices.device_sweeps import MIN_SENSORS
from locatk.core.lighthouse.receiver import Receiver
from locatk.core.lighthouse.recording import UNKNOWN, Sweeps
from locatk.core.lighthouse.scene import Scene
from locatk.core.lighthouse.scene.designed_frame import (
    DesignedFrame,
    is_design,
    with_mounting_tolerance,
)
from locatk.core.lighthouse.scene.estimation import direction_only_warning
from locatk.core.lighthouse.solver import SolveOptions
from locatk.core.lighthouse.stream.known_scene import KnownScene
from locatk.core.lighthouse.stream.photodiodes import PhotodiodeFixes
from locatk.core.lighthouse.stream.rigid import RigidFixes
from locatk.core.lighthouse.stream.scene_search import (
    FIRST_ATTEMPT_NS,
    INTERVAL_GROWTH,
    LAST_ATTEMPT_NS,
    MAX_INTERVAL_NS,
    OdometryStore,
    Row,
    SceneResult,
    SweepStore,
    align_scene,
    estimate_live_scene,
    is_better,
    make_sweeps,
)
from locatk.core.lighthouse.stream.supervision import (
    StationSupervision,
    doubled_channel_warnings,
)
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    ArtifactUpdate,
    BackgroundTask,
    DetectionEvent,
    Stream,
    StreamEvent,
    WarningEvent,
)
from locatk.core.trajectory import Trajectory

TICK_NS = 500_000_000
"""Time of data between updates of noise and gates, and checks of hidden stations [ns]."""

MOVED_CHECK_TICKS = 4
"""Ticks between verifications of the stations: every two seconds."""

DETECTION_TICKS = 20
"""Ticks between detections of the stations: every ten seconds."""

RECENT_SWEEPS = 4_000
"""Largest number of sweeps in which channels with several stations are looked for: two seconds of
ten robots under two stations."""

FORGET_NS = 60_000_000_000
"""Time after which the state of a silent device is dropped [ns]."""

MAX_TIME_STEP_NS = 60_000_000_000
"""Time by which a sweep may be later than the one before without being taken for a clock that was
set [ns]; ticks in between are skipped."""

PLANES = (UNKNOWN, 0, 1)
"""Numbers of the planes of a sweep."""

SCENE_TASK = "scene"


class LighthouseStream(Stream):
    """Causal solver of Lighthouse for any number of devices.

    Devices with three or more photodiodes of known position get poses, all other photodiodes
    positions, with the names of the offline solver: that of the device, or ``device/sensor`` if it
    has several.

    Parameters
    ----------
    scene : Scene, optional
        With stations: they are used as they are. Without, they are estimated in the background;
        markers, distances and calibrations of the scene are used for it. Those of a design
        (``frame_source`` is ``"design"``) are used until then, with their mounting tolerance.
    receiver_of : callable, optional
        Returns the receiver of a device, or None; called at its first sweep.
    options : SolveOptions, optional
        ``scene`` and ``seed`` for the estimation of the scene.

    Attributes
    ----------
    system : str
    version : int
        Of the scene that was estimated; 0 without.
    """

    system = "lighthouse"

    def __init__(
        self,
        scene: Scene | None,
        receiver_of: Callable[[str], Receiver | None] = lambda device: None,
        options: SolveOptions | None = None,
    ) -> None:
        self._rejected: Counter[str] = Counter()
        self.version = 0
        self._options = options or SolveOptions()
        self._receiver_of = receiver_of
        self._receivers: dict[str, Receiver] = {}
        self._multiple: set[str] = set()
        self._prior = scene or Scene()
        self._known: KnownScene | None = None
        self._events: list[StreamEvent] = []
        self._now_ns: int | None = None
        self._start_ns = self._next_tick_ns = self._ticks = 0
        self._period = np.zeros(CHANNELS.stop)
        self._period[CHANNELS.start :] = period_counts(np.arange(CHANNELS.start, CHANNELS.stop))
        self._devices: dict[str, int] = {}
        self._recent: deque[Row] = deque(maxlen=RECENT_SWEEPS)
        self._doubled: set[int] = set()
        self._warned: set[tuple[str, str]] = set()
        self._store: SweepStore | None = None
        self._odometry = OdometryStore()
        self._next_attempt_ns = FIRST_ATTEMPT_NS
        self._is_task_due = self._is_task_running = False
        self._detected_sweeps = 0
        if is_design(self._prior):
            self._use_scene(with_mounting_tolerance(self._prior))
        elif self._prior.stations:
            self._use_scene(self._prior)
        if self._known is None or self._is_provisional:
            self._store = SweepStore()

    @property
    def scene(self) -> Scene | None:
        """Scene with stations that fixes refer to; None as long as there is none."""
        return None if self._known is None else self._known.scene

    @property
    def rejected(self) -> Mapping[str, int]:
        """Number of sweeps or epochs that were not used, by reason."""
        return self._rejected

    # ---- observations

    def push(self, observations: Any) -> Sequence[StreamEvent]:
        """Return the fixes and other results that the next sweeps make known.

        Parameters
        ----------
        observations : Sweeps or Trajectory or object
            Odometry determines the scale of a scene that is estimated. Other observations are not
            used here.
        """
        if isinstance(observations, Trajectory):
            if self._store is not None:
                self._odometry.add(observations)
        elif isinstance(observations, Sweeps):
            self._push_sweeps(observations)
            self._flush()
        return self._take_events()

    def advance(self, time_ns: int) -> Sequence[StreamEvent]:
        """Return the results that follow from the time alone: fixes without a hidden station."""
        if self._now_ns is not None and time_ns > self._now_ns:
            self._advance_ticks(time_ns)
            if self._known is not None:
                self._photodiodes.advance(time_ns, self._flush)
                self._flush()
        return self._take_events()

    def finish(self) -> Sequence[StreamEvent]:
        """Return the fixes that wait for another station, and the last detections."""
        if self._now_ns is not None and self._known is not None:
            self._photodiodes.advance(self._now_ns + TICK_NS, self._flush)
            self._flush()
            self._detect(self._now_ns)
        return self._take_events()

    def _take_events(self) -> Sequence[StreamEvent]:
        events, self._events = self._events, []
        return events

    def _push_sweeps(self, sweeps: Sweeps) -> None:
        """Take sweeps one by one, so that results do not depend on how they are cut."""
        is_known = (sweeps.channel >= CHANNELS.start) & (sweeps.channel < CHANNELS.stop)
        channel = np.where(is_known, sweeps.channel, 0)
        with np.errstate(invalid="ignore"):
            is_in_period = (sweeps.count >= 0) & (sweeps.count < self._period[channel])
        for name, *row, usable in zip(
            [sweeps.devices[k] for k in sweeps.device.tolist()],
            sweeps.time_ns.tolist(),
            sweeps.sensor.tolist(),
            channel.tolist(),
            sweeps.polynomial.tolist(),
            sweeps.sweep.tolist(),
            sweeps.count.tolist(),
            is_in_period.tolist(),
            strict=True,
        ):
            if row[4] not in PLANES:
                self._rejected["plane_unknown"] += 1
                continue
            if not usable:
                reason = "count_above_period" if row[2] else "unknown_channel"
                self._rejected[reason] += 1
                continue
            self._push_sweep(name, *row)

    def _push_sweep(
        self,
        name: str,
        time_ns: int,
        sensor: int,
        channel: int,
        polynomial: int,
        plane: int,
        count: float,
    ) -> None:
        if self._now_ns is None:
            self._now_ns = self._start_ns = time_ns
            self._next_tick_ns = time_ns + TICK_NS
            if self._known is not None:
                for note in self._prior.notes:
                    self._warn(SolverWarning("scene_assumption", note))
        self._advance_ticks(time_ns)
        device = self._devices.get(name)
        if device is None:
            device = self._add_device(name)
        if sensor > 0:
            self._multiple.add(name)
        row = (time_ns, device, sensor, channel, polynomial, plane, count)
        self._recent.append(row)
        if channel in self._doubled:
            self._rejected["sweep_of_doubled_channel"] += 1
            return
        if self._store is not None:
            self._store.add(row)
        if self._known is None:
            return
        station = self._known.column.get(channel)
        if station is None:
            self._rejected["station_not_in_scene"] += 1
            return
        self._supervision.last_ns[station] = time_ns
        if name in self._receivers:
            fixes = self._rigid.push(name, time_ns, sensor, station, plane, count)
            if fixes:
                self._flush()
                self._events.extend(fixes)
            return
        photodiode = f"{name}/{sensor}" if name in self._multiple else name
        is_labelled = polynomial != UNKNOWN
        self._photodiodes.push(photodiode, time_ns, station, plane, count, is_labelled, self._flush)

    def _add_device(self, name: str) -> int:
        """Return the number of a device that sends for the first time."""
        receiver = self._receiver_of(name)
        if receiver is not None:
            if len(receiver) > 1:
                self._multiple.add(name)
            if len(receiver) >= MIN_SENSORS:
                self._receivers[name] = receiver
        return self._devices.setdefault(name, len(self._devices))

    def _flush(self) -> None:
        """Estimate the positions that are due, before any later event."""
        if self._known is not None and self._photodiodes.due:
            self._events.extend(self._photodiodes.solve_due())

    # ---- time

    def _advance_ticks(self, time_ns: int) -> None:
        """Do the regular work up to a time."""
        assert self._now_ns is not None
        if time_ns <= self._now_ns:
            return
        if time_ns - self._now_ns > MAX_TIME_STEP_NS:
            self._next_tick_ns = time_ns
        self._now_ns = time_ns
        while time_ns >= self._next_tick_ns:
            self._flush()
            self._ticks += 1
            self._tick(self._next_tick_ns)
            self._next_tick_ns += TICK_NS

    def _tick(self, now_ns: int) -> None:
        if self._store is not None:
            elapsed_ns = now_ns - self._start_ns
            if elapsed_ns >= self._next_attempt_ns and len(self._store):
                self._is_task_due = True
        if self._ticks % DETECTION_TICKS == 1:
            self._check_channels()
        if self._known is None:
            return
        self._photodiodes.update_noise()
        self._rigid.update_noise()
        for warning in self._supervision.check_hidden(now_ns):
            self._events.append(WarningEvent("", now_ns, warning))
        if self._ticks % MOVED_CHECK_TICKS == 0 and not self._is_provisional:
            warnings = self._supervision.check_moved(self._rigid)
            self._events.extend(WarningEvent("", now_ns, warning) for warning in warnings)
        if self._ticks % DETECTION_TICKS == 0:
            self._detect(now_ns)
            self._photodiodes.forget(now_ns - FORGET_NS)
            self._rigid.forget(now_ns - FORGET_NS)

    def _detect(self, now_ns: int) -> None:
        """Report the stations, if they were received since the last time."""
        detections = self._supervision.detections(self._photodiodes, self._rigid)
        total = sum(each.sweeps + each.rejected for each in detections)
        if total != self._detected_sweeps:
            self._detected_sweeps = total
            self._events.extend(DetectionEvent("", now_ns, each) for each in detections)

    def _check_channels(self) -> None:
        """Look for channels with several stations in the last sweeps."""
        proven, warnings = doubled_channel_warnings(
            make_sweeps(tuple(self._devices), list(self._recent))
        )
        self._doubled |= set(proven)
        for warning in warnings:
            self._warn(warning)

    def _warn(self, warning: SolverWarning) -> None:
        """Report a warning once."""
        key = (warning.code, warning.message)
        if key not in self._warned and len(self._warned) < 1000:
            self._warned.add(key)
            self._events.append(WarningEvent("", self._now_ns or 0, warning))

    # ---- scene

    def _use_scene(self, scene: Scene, frame: DesignedFrame | None = None) -> None:
        """Locate devices in another scene from now on."""
        old = self._known
        known = self._known = KnownScene.of(scene, frame)
        self._supervision = StationSupervision(known)
        if old is None:
            self._photodiodes = PhotodiodeFixes(known, self._reject, self._observe)
            self._rigid = RigidFixes(known, self._receivers, self._reject)
        else:
            self._photodiodes = self._photodiodes.moved_to(known)
            self._rigid = self._rigid.moved_to(known)
        if len(known.stations) < known.min_stations:
            self._warn(direction_only_warning(known.stations[0].channel))

    @property
    def _is_provisional(self) -> bool:
        """True if the stations in use are designed poses."""
        return self._known is not None and is_design(self._known.scene)

    def _reject(self, reason: str, number: int) -> None:
        self._rejected[reason] += number

    def _observe(self, angles: Any, is_solved: bool, is_inconsistent: bool) -> None:
        self._supervision.observe(angles, is_solved, is_inconsistent)

    def background_task(self) -> BackgroundTask | None:
        """Return the estimation of the scene when it is time for an attempt."""
        if not self._is_task_due or self._is_task_running or self._store is None:
            return None
        self._is_task_due, self._is_task_running = False, True
        self._store.devices = list(self._devices)
        sweeps = self._store.sweeps()
        sweeps = sweeps.take(~np.isin(sweeps.channel, list(self._doubled)))
        arguments = (
            sweeps, self._prior, self._options, self._odometry.tracks(), dict(self._receivers)
        )  # fmt: skip
        return BackgroundTask(SCENE_TASK, estimate_live_scene, arguments)

    def complete(self, task: BackgroundTask, result: Any) -> Sequence[StreamEvent]:
        """Use the scene of a task if it is the first or better than the one in use.

        Raises
        ------
        Exception
            ``result`` is an error of the program, not of the data.
        """
        self._is_task_running = False
        now_ns = self._now_ns or 0
        self._next_attempt_ns = self._following_attempt(now_ns - self._start_ns)
        if isinstance(result, LocatkError):
            hint = f" ({result.hint})" if result.hint else ""
            state = "the designed poses are in use" if self._is_provisional else "no scene yet"
            self._warn(SolverWarning("scene_not_estimated", f"{state}: {result.message}{hint}"))
        elif isinstance(result, BaseException):
            raise result
        else:
            self._adopt(result, now_ns)
        is_found = self._known is not None and not self._is_provisional
        if is_found and now_ns - self._start_ns > LAST_ATTEMPT_NS:
            self._store = None
        return self._take_events()

    def _following_attempt(self, elapsed_ns: int) -> int:
        """Return the time since the start of the next attempt."""
        interval_ns = max(FIRST_ATTEMPT_NS, round((INTERVAL_GROWTH - 1.0) * elapsed_ns))
        if self._known is None or self._is_provisional:
            interval_ns = min(interval_ns, MAX_INTERVAL_NS)
        return elapsed_ns + interval_ns

    def _adopt(self, result: SceneResult, now_ns: int) -> None:
        """Use the scene of a result, in the frame of the one before, if it is better."""
        scene, old = result.scene, self.scene
        if old is not None and not is_design(old):
            if not is_better(scene, old):
                return
            scene = align_scene(scene, old)
        self._flush()
        self.version += 1
        self._use_scene(scene, result.frame)
        is_first = old is None or is_design(old)
        reason = "estimated from the first sweeps" if is_first else "refined with later sweeps"
        self._events.append(ArtifactUpdate(now_ns, self.version, scene, reason))
        for warning in result.warnings:
            self._warn(warning)
