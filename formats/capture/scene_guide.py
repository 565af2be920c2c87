"""Guide through the recording of a scene: which point is next, and is the device at rest there?

The guide observes the sweeps of a running recording (:func:`locatk.formats.capture.setup.record`)
and decides once per second. A point is accepted when the device has rested for
:data:`REST_S`; it must move before the next one. The recording is an ordinary session, which is
solved with the standstills that the guide accepted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from locatk.core.errors import InputError
from locatk.core.lighthouse.demodulation.sweep_reports import report_stations
from locatk.core.lighthouse.epochs import group_epochs, rotor_angles
from locatk.core.lighthouse.recording import NANOSECONDS_PER_S, StationReport, Sweeps
from locatk.core.lighthouse.scene.setup import FLOOR, ORIGIN, X_AXIS, SceneSetup
from locatk.core.lighthouse.scene.standstills import (
    MIN_STANDSTILL_S,
    Standstill,
    find_standstills,
)
from locatk.formats.capture.ingestion import StampedMessage
from locatk.formats.sessions.messages import SWEEPS
from locatk.formats.sessions.observations import SWEEP_TOPIC_PREFIX, sweeps_of_batches

REST_S = MIN_STANDSTILL_S
"""Time for which a device must rest at a point [s]; the solver then finds the same standstill."""

MIN_REST_S = 0.5
"""Shortest rest that is shown while it lasts [s]."""

RECENT_S = 6.0
"""Time of sweeps in which the present rest is searched [s]."""

STALE_S = 1.0
"""Age of the last sweep of a rest from which the device no longer rests [s]."""

KEPT_S = 90.0
"""Time of sweeps in which the factory data are searched [s]: nine frames, of which one must be
complete."""

FACTORY_DATA_INTERVAL_S = 5.0
"""Interval between searches for factory data [s]."""

NO_LIGHT_S = 10.0
"""Time without sweeps after which the user is told [s]."""

MIN_CHANGE_RAD = 0.02
"""Smallest change of an angle between two points [rad]: 4 cm at 2 m."""

MOTION_S = 20.0
"""Time for which the device is moved through the room at the end [s]: 20 positions a metre apart
determine a scene."""

MIN_STATIONS = 2
"""Stations for which the guide waits. A device with several photodiodes may go on with one."""

MAX_WAIT_S = 30.0
"""Time after which it goes on with the stations received so far [s]."""

PROMPTS = {
    ORIGIN: "Put the device at the origin, and let it rest for 3 s.",
    X_AXIS: "Put it on the x axis{distance}, and let it rest for 3 s.",
    FLOOR: "Put it on another point of the floor, off the x axis, and let it rest for 3 s.",
}


@dataclass(frozen=True)
class AcceptedPoint:
    """Point at which a device rested, with a time within the rest."""

    role: str
    device: str
    time_ns: int


class SceneGuide:
    """Guide that follows the sweeps of a recording.

    Parameters
    ----------
    floor_points : int
        Number of points on the floor after those at the origin and on the x axis.
    x_distance_m : float, optional
        Distance of the point on the x axis, for the prompt.
    motion_s : float
        Time of motion at the end.

    Attributes
    ----------
    accepted : list of AcceptedPoint
    is_done : bool
        All points were accepted, and the device was moved.
    can_finish : bool
        All points were accepted.
    """

    def __init__(
        self,
        floor_points: int = 2,
        x_distance_m: float | None = None,
        motion_s: float = MOTION_S,
    ) -> None:
        self._roles = [ORIGIN, X_AXIS, *[FLOOR] * floor_points]
        self._distance = "" if x_distance_m is None else f", {x_distance_m:g} m from the origin"
        self._motion_s = motion_s
        self.accepted: list[AcceptedPoint] = []
        self.is_done = False
        self._angles: list[dict[tuple[str, int, int], float]] = []
        self._messages: deque[StampedMessage] = deque()
        self._reports: dict[int, StationReport] = {}
        self._channels: tuple[int, ...] = ()
        self._is_waiting = True
        self._has_moved = False
        self._moved_s = 0.0
        self._rest: Standstill | None = None
        self._started_s: float | None = None
        self._light_s = self._searched_s = self._updated_s = 0.0
        self._newest_ns = -1
        self._status = ""

    @property
    def can_finish(self) -> bool:
        """True if all points were accepted."""
        return len(self.accepted) == len(self._roles)

    @property
    def status(self) -> str:
        """Stations received, factory data, and rest or motion, in one line."""
        return self._status

    def observe(self, message: StampedMessage) -> None:
        """Take a message of the recording."""
        if message.topic.startswith(SWEEP_TOPIC_PREFIX):
            self._messages.append(message)

    def update(self, elapsed_s: float) -> list[str]:
        """Return what to tell the user, given the time since the start of the recording."""
        lines: list[str] = []
        if self._started_s is None:
            self._started_s = self._light_s = self._updated_s = elapsed_s
            lines.append("Waiting for the light of the stations.")
        sweeps = self._recent()
        if len(sweeps) == 0:
            self._channels, self._rest = (), None
            if elapsed_s - self._light_s >= NO_LIGHT_S:
                self._light_s = elapsed_s
                lines.append(
                    "No light is received: are the stations on, and does the device face them?"
                )
        else:
            self._light_s = elapsed_s
            self._channels = tuple(np.unique(sweeps.channel).tolist())
            self._search_factory_data(elapsed_s)
            self._rest = self._present_rest(sweeps)
            lines += self._step(elapsed_s, sweeps)
        self._updated_s = elapsed_s
        self._status = self._describe()
        return lines

    def setup(self, sweeps: Sweeps, x_distance_m: float | None, height_m: float) -> SceneSetup:
        """Return the setup of the recorded scene, with the standstills that were accepted.

        Raises
        ------
        InputError
            The recording lacks one of them, or two are the same.
        """
        device = self.accepted[0].device
        rests = [each for each in find_standstills(sweeps) if each.device == device]
        numbers: dict[int, str] = {}
        for point in self.accepted:
            for number, rest in enumerate(rests, 1):
                if rest.start_ns <= point.time_ns <= rest.end_ns:
                    numbers[number] = point.role
                    break
            else:
                raise InputError(
                    f"the rest at the {point.role} is not in the recording",
                    hint="give the points by --origin, --x-axis and --ignore",
                )
        if len(numbers) < len(self.accepted):
            raise InputError(
                "two of the points are one standstill in the recording",
                hint="give the points by --origin, --x-axis and --ignore",
            )
        by_role = {role: number for number, role in numbers.items()}
        return SceneSetup(
            has_floor=True,
            origin=by_role[ORIGIN],
            x_axis=by_role[X_AXIS],
            x_distance_m=x_distance_m,
            ignored=tuple(k for k in range(1, len(rests) + 1) if k not in numbers),
            device=device,
            height_m=height_m,
        )

    # ---- one update

    def _recent(self) -> Sweeps:
        """Return the sweeps of the last seconds; older messages are dropped."""
        messages = self._messages
        while messages and messages[-1].publish_ns - messages[0].publish_ns > KEPT_S * 1e9:
            messages.popleft()
        if not messages:
            return _unpack([])
        # The newest message may be old: nothing arrived since.
        newest_ns = messages[-1].publish_ns
        recent = [m for m in messages if newest_ns - m.publish_ns < RECENT_S * NANOSECONDS_PER_S]
        is_new = self._newest_ns != newest_ns
        self._newest_ns = newest_ns
        return _unpack(recent if is_new else [])

    def _search_factory_data(self, elapsed_s: float) -> None:
        if set(self._channels) <= self._reports.keys():
            return
        if elapsed_s - self._searched_s >= FACTORY_DATA_INTERVAL_S:
            self._searched_s = elapsed_s
            reports, _ = report_stations(_unpack(list(self._messages)))
            self._reports |= {report.channel: report for report in reports}

    def _present_rest(self, sweeps: Sweeps) -> Standstill | None:
        """Return the rest that lasts until now, of the device that rested before, if any did."""
        newest_ns = int(sweeps.time_ns.max())
        rests = [
            each
            for each in find_standstills(sweeps, min_duration_s=MIN_REST_S)
            if newest_ns - each.end_ns < STALE_S * NANOSECONDS_PER_S
            and (not self.accepted or each.device == self.accepted[0].device)
        ]
        return max(rests, key=lambda each: each.duration_s, default=None)

    def _step(self, elapsed_s: float, sweeps: Sweeps) -> list[str]:
        """Go on to the next point if the present one is done; return what to tell."""
        assert self._started_s is not None
        if self._is_waiting:
            is_late = elapsed_s - self._started_s > MAX_WAIT_S
            if len(self._channels) < MIN_STATIONS and not is_late:
                return []
            self._is_waiting = False
            return [self._prompt()]
        if self._rest is None:
            self._has_moved = True
            if self.can_finish:
                self._moved_s += elapsed_s - self._updated_s
                self.is_done = self._moved_s >= self._motion_s
            return ["Done."] if self.is_done else []
        if self.can_finish or self._rest.duration_s < REST_S:
            return []
        angles = _angles_at(sweeps, self._rest)
        for point, known in zip(self.accepted, self._angles, strict=True):
            if _is_same_position(angles, known):
                # It may also be the rest that was just accepted and lasts.
                lines = [f"This is the position of the {point.role}. {self._prompt()}"]
                lines, self._has_moved = lines if self._has_moved else [], False
                return lines
        role = self._roles[len(self.accepted)]
        middle_ns = (self._rest.start_ns + self._rest.end_ns) // 2
        self.accepted.append(AcceptedPoint(role, self._rest.device, middle_ns))
        self._angles.append(angles)
        self._has_moved = False
        return [f"Recorded: {role}. {self._prompt()}"]

    def _prompt(self) -> str:
        if self.can_finish:
            return (
                f"Move the device through the whole room for {self._motion_s:.0f} s, at different "
                "heights if it flies. Ctrl-C ends this early."
            )
        return PROMPTS[self._roles[len(self.accepted)]].format(distance=self._distance)

    def _describe(self) -> str:
        if not self._channels:
            return "no light"
        known = ", ".join(
            f"{channel}{' (factory data)' if channel in self._reports else ''}"
            for channel in self._channels
        )
        parts = [f"stations {known}"]
        if self._is_waiting:
            parts.append(f"waiting for {MIN_STATIONS} stations")
        elif self.can_finish:
            parts.append(f"{max(0.0, self._motion_s - self._moved_s):.0f} s of motion left")
        elif self._rest is None:
            parts.append("moving")
        else:
            parts.append(f"at rest for {self._rest.duration_s:.0f} s")
        return "; ".join(parts)


def _angles_at(sweeps: Sweeps, rest: Standstill) -> dict[tuple[str, int, int], float]:
    """Return the median rotor angle during a rest by photodiode, channel and plane."""
    epochs = group_epochs(sweeps)
    is_inside = (epochs.time_ns >= rest.start_ns) & (epochs.time_ns <= rest.end_ns)
    angles = {}
    for number, name in enumerate(epochs.devices):
        own = rotor_angles(epochs.take(is_inside & (epochs.device == number)))
        for column, channel in enumerate(epochs.channels.tolist()):
            for plane in (0, 1):
                known = own[:, column, plane]
                known = known[np.isfinite(known)]
                if len(known):
                    angles[name, channel, plane] = float(np.median(known))
    return angles


def _is_same_position(
    first: Mapping[tuple[str, int, int], float], second: Mapping[tuple[str, int, int], float]
) -> bool:
    """Return whether all common angles of two rests are equal."""
    common = first.keys() & second.keys()
    return bool(common) and all(abs(first[k] - second[k]) < MIN_CHANGE_RAD for k in common)


def _unpack(messages: Sequence[StampedMessage]) -> Sweeps:
    return sweeps_of_batches(SWEEPS.unpack(each.message.SerializeToString() for each in messages))
