"""Causal positions of single photodiodes in a known scene.

The sweeps of a photodiode are paired as offline (:mod:`locatk.core.lighthouse.epochs`): two
successive sweeps of a station whose counts differ by about a third of a rotation. A *fix* uses the
newest pair of each station. It is due when a pair completes the stations that the photodiode
received lately, and when the next pair shows that another station is hidden. Each pair of a
station that sends all the time therefore gives a fix.

The sweeps of a fix are up to a rotation apart. Their angles are carried to their mean time with
the rate since the pair before. Noise of the rate and acceleration add to the covariance. Successive
fixes share pairs; the variance of the noise is multiplied by the number of fixes that a pair is
part of, so that their average has the covariance of independent fixes.

Positions of all photodiodes that are due are estimated together, and pass the gates of the offline
solver (:mod:`locatk.core.lighthouse.localization.photodiodes`). A jump is a position that departs
from the line through the last two by more than noise and a likely acceleration explain.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.epochs import (
    MAX_PAIR_DELAY_NS,
    MAX_PLANE_DELAY_TURNS,
    MAX_RATE_INTERVAL_S,
    MIN_PLANE_DELAY_TURNS,
    Epochs,
)
from locatk.core.lighthouse.light_planes import ROTOR_ZERO_RAD, angles_to_counts
from locatk.core.lighthouse.localization.photodiodes import (
    MAX_RANGE_M,
    angle_sigma,
    inlier_gate,
    leave_out_worst_station,
    restore_swapped_sweeps,
)
from locatk.core.lighthouse.localization.positions import (
    PositionEstimates,
    intersect_planes,
    project_on_floor,
)
from locatk.core.lighthouse.noise import (
    INLIER_GATE_RAD,
    INLIER_GATE_SIGMAS,
    MIN_INLIER_GATE_RAD,
)
from locatk.core.lighthouse.recording import UNKNOWN
from locatk.core.lighthouse.stream.known_scene import KnownScene
from locatk.core.lighthouse.stream.recent_path import MAX_LATENESS_NS, SPEED_SIGMA_M_S, RecentPath
from locatk.core.streaming.events import Fix

Array = NDArray[np.float64]

MAX_FIX_SPAN_NS = 22_000_000
"""Longest time from the end of the oldest pair of a fix to that of the newest [ns]: the slowest
rotation (19.98 ms on channel 1) and the motion of the photodiode against the planes."""

EXPECTED_STATION_NS = 500_000_000
"""Time since its last pair for which a station is waited for [ns]: two reports at 4 Hz."""

CONFIRMING_FIXES = 3
"""Successive departures that agree with each other: the photodiode was carried there."""

PAIRS_KEPT = 3
"""Pairs of a station that are kept: the newest, and two that give rate and acceleration."""

NOISE_FIXES = 512
"""Number of fixes from which noise and gate are estimated."""

MIN_NOISE_FIXES = 30
"""Fewest fixes with redundancy from which noise and gate are estimated, and fewest new ones."""

INITIAL_SIGMA_RAD = MIN_INLIER_GATE_RAD / INLIER_GATE_SIGMAS
"""Standard deviation of an angle before it is estimated [rad]."""

IDENTITY_QUATERNION = np.array([0.0, 0.0, 0.0, 1.0])


class Pair:
    """Both sweeps of one rotation of a station."""

    __slots__ = ("angle", "count", "is_labelled", "is_outlier", "time_ns", "uses")

    def __init__(
        self,
        time_ns: tuple[int, int],
        count: tuple[float, float],
        angle: tuple[float, float],
        is_labelled: bool,
    ) -> None:
        self.time_ns = time_ns
        self.count = count
        self.angle = angle
        self.is_labelled = is_labelled
        self.is_outlier = False
        self.uses = 0


@dataclass
class PhotodiodeState:
    """Recent sweeps and positions of one photodiode.

    Attributes
    ----------
    name : str
    newest_ns : int
        Time of its newest sweep.
    lone : dict of int to (int, float, int, bool)
        By station: time, count, plane and label of a sweep that has no partner yet.
    pairs : dict of int to deque of Pair
        By station, ascending in time.
    path : RecentPath
    """

    name: str
    newest_ns: int = 0
    lone: dict[int, tuple[int, float, int, bool]] = field(default_factory=dict)
    pairs: dict[int, deque[Pair]] = field(default_factory=dict)
    path: RecentPath = field(default_factory=RecentPath)


@dataclass
class DueFix:
    """Fix to be estimated.

    Attributes
    ----------
    state : PhotodiodeState
    time_ns : int
        Mean time of its sweeps.
    members : list of (int, Pair)
        Stations and their pairs.
    angle : list of (float, float)
        Angles of the pairs at that time.
    inflation : float
        Variance of these angles relative to that of an angle.
    motion_variance : float
        Mean variance by acceleration [rad^2].
    motion_sigma_m : float
        Standard deviation of the position by unknown motion.
    """

    state: PhotodiodeState
    time_ns: int
    members: list[tuple[int, Pair]]
    angle: list[tuple[float, float]]
    inflation: float
    motion_variance: float
    motion_sigma_m: float


class PhotodiodeFixes:
    """Fixes of all single photodiodes of a stream.

    Parameters
    ----------
    known : KnownScene
    count_rejected : callable
        Takes a reason and a number.
    observe : callable
        Takes the angles (s, 2) of each fix, and whether it has a position and contradicts itself,
        for the supervision of the stations.

    Attributes
    ----------
    due : list of DueFix
        In the order in which they became due; at most one of each photodiode.
    sigma_rad, gate_rad : float
        Noise of an angle, and largest residual of a consistent fix.
    used, rejected : list of int
        By station: sweeps of accepted fixes that they use, and that they leave out.
    residual : list of deque of float
        By station, the last residuals of used sweeps.
    """

    def __init__(
        self,
        known: KnownScene,
        count_rejected: Callable[[str, int], None],
        observe: Callable[[Array, bool, bool], None],
    ) -> None:
        self.known = known
        self.due: list[DueFix] = []
        self.sigma_rad, self.gate_rad = INITIAL_SIGMA_RAD, known.max_gate_rad
        self.used = [0] * len(known.stations)
        self.residual = [deque[float](maxlen=NOISE_FIXES) for _ in known.stations]
        self._reject = count_rejected
        self._observe = observe
        self._states: dict[str, PhotodiodeState] = {}
        self.rejected = [0] * len(known.stations)
        self._noise: deque[tuple[Array, int]] = deque(maxlen=NOISE_FIXES)
        self._new_fixes = 0
        self._period = [float(period_counts(s.channel)) for s in known.stations]

    # ---- sweeps

    def push(
        self,
        name: str,
        time_ns: int,
        station: int,
        plane: int,
        count: float,
        is_labelled: bool,
        flush: Callable[[], None],
    ) -> None:
        """Take a sweep; ``flush`` is called before a photodiode with a due fix gets another."""
        state = self._states.get(name)
        if state is None or time_ns < state.newest_ns - MAX_LATENESS_NS:
            state = self._states[name] = PhotodiodeState(name)
        state.newest_ns = max(state.newest_ns, time_ns)
        lone = state.lone.get(station)
        sweep = (time_ns, count, plane, is_labelled)
        if lone is None:
            pairs = state.pairs.get(station)
            if pairs and pairs[-1].time_ns[1] >= time_ns:
                # Of three sweeps with one time stamp any two could be the pair.
                last = pairs[-1]
                is_repeated = count in last.count or last.time_ns[1] > time_ns
                self._reject("repeated_in_rotation" if is_repeated else "plane_unknown", 1)
                if not is_repeated and not last.uses and last.time_ns[0] == time_ns:
                    pairs.pop()
                    if not pairs:
                        del state.pairs[station]
                    self._reject("plane_unknown", 2)
                return
            state.lone[station] = sweep
            return
        if time_ns < lone[0]:
            # It is older than a sweep of which the pair is still open.
            self._reject("plane_unknown", 1)
            return
        if lone[0] == time_ns and count < lone[1]:
            lone, sweep = sweep, lone
        if lone == sweep:
            self._reject("repeated_in_rotation", 1)
            return
        if not self._is_pair(station, lone, sweep):
            self._reject("plane_unknown", 1)
            state.lone[station] = (time_ns, count, plane, is_labelled)
            return
        del state.lone[station]
        turn = 2 * math.pi / self._period[station]
        pair = Pair(
            (lone[0], sweep[0]),
            (lone[1], sweep[1]),
            (turn * lone[1] + ROTOR_ZERO_RAD[0], turn * sweep[1] + ROTOR_ZERO_RAD[1]),
            lone[3] and sweep[3],
        )
        self._add_pair(state, station, pair, flush)

    def _is_pair(
        self,
        station: int,
        first: tuple[int, float, int, bool],
        second: tuple[int, float, int, bool],
    ) -> bool:
        """Return whether two sweeps are both planes of one rotation, as in ``_pair_planes``."""
        if not 0 <= second[0] - first[0] <= MAX_PAIR_DELAY_NS:
            return False
        if first[2] != UNKNOWN or second[2] != UNKNOWN:
            return first[2] == 0 and second[2] == 1
        delay = (second[1] - first[1]) / self._period[station]
        return MIN_PLANE_DELAY_TURNS < delay < MAX_PLANE_DELAY_TURNS

    def _add_pair(
        self, state: PhotodiodeState, station: int, pair: Pair, flush: Callable[[], None]
    ) -> None:
        pairs = state.pairs.get(station)
        if pairs is None:
            pairs = state.pairs[station] = deque(maxlen=PAIRS_KEPT)
        now_ns = pair.time_ns[1]
        if pairs and not pairs[-1].uses:
            # Another station was waited for, and did not come.
            waiting_ns = max(p[-1].time_ns[1] for p in state.pairs.values() if p)
            self._make_due(state, min(waiting_ns, now_ns), flush)
        pairs.append(pair)
        for other_pairs in state.pairs.values():
            age_ns = now_ns - other_pairs[-1].time_ns[1]
            if MAX_FIX_SPAN_NS < age_ns <= EXPECTED_STATION_NS:
                return
        # A position from a single station is checked by nothing: another one is waited for.
        needed = max(self.known.min_stations, min(2, len(self.known.stations)))
        if len(self._members(state, now_ns)) >= needed:
            self._make_due(state, now_ns, flush)

    def advance(self, time_ns: int, flush: Callable[[], None]) -> None:
        """Make the fixes due whose other sweeps did not come in time."""
        for state in self._states.values():
            waiting = [
                pairs[-1].time_ns[1]
                for pairs in state.pairs.values()
                if not pairs[-1].uses and pairs[-1].time_ns[1] < time_ns - MAX_FIX_SPAN_NS
            ]
            if waiting:
                self._make_due(state, max(waiting), flush)

    # ---- due fixes

    def _members(self, state: PhotodiodeState, now_ns: int) -> list[tuple[int, Pair]]:
        """Return the newest pairs of the stations that are in use, within the span of a fix."""
        return [
            (station, pairs[-1])
            for station, pairs in state.pairs.items()
            if 0 <= now_ns - pairs[-1].time_ns[1] <= MAX_FIX_SPAN_NS
            and station not in self.known.excluded
        ]

    def _make_due(self, state: PhotodiodeState, now_ns: int, flush: Callable[[], None]) -> None:
        """Prepare the fix of the newest pairs, the newest of which ended at ``now_ns``."""
        if any(due.state is state for due in self.due):
            flush()
        members = self._members(state, now_ns)
        for _, pair in members:
            pair.uses += 1
        if len(members) < self.known.min_stations:
            if members:
                self._reject("moment_with_too_few_sweeps", 1)
            return
        total_ns = sum(pair.time_ns[0] - now_ns + pair.time_ns[1] - now_ns for _, pair in members)
        time_ns = now_ns + round(total_ns / (2 * len(members)))
        angles: list[tuple[float, float]] = []
        factor = variance = unknown_s = 0.0
        for station, pair in members:
            earlier = self._earlier(state.pairs[station], pair)
            moved = [0.0, 0.0]
            for k in (0, 1):
                offset_s = (time_ns - pair.time_ns[k]) * 1e-9
                moved[k] = pair.angle[k]
                if not earlier:
                    factor += 1.0
                    unknown_s += offset_s**2
                    continue
                interval_s = (pair.time_ns[k] - earlier[0].time_ns[k]) * 1e-9
                rate = (pair.angle[k] - earlier[0].angle[k]) / interval_s
                moved[k] += rate * offset_s
                fraction = offset_s / interval_s
                factor += (1.0 + fraction) ** 2 + fraction**2
                if len(earlier) > 1:
                    before_s = (earlier[0].time_ns[k] - earlier[1].time_ns[k]) * 1e-9
                    before = (earlier[0].angle[k] - earlier[1].angle[k]) / before_s
                    acceleration = 2 * (rate - before) / (interval_s + before_s)
                    variance += (0.5 * acceleration * offset_s * (offset_s + interval_s)) ** 2
            angles.append((moved[0], moved[1]))
        planes = 2 * len(members)
        self.due.append(
            DueFix(
                state,
                time_ns,
                members,
                angles,
                max(pair.uses for _, pair in members) * factor / planes,
                variance / planes,
                SPEED_SIGMA_M_S * math.sqrt(unknown_s / planes),
            )
        )

    @staticmethod
    def _earlier(pairs: deque[Pair], pair: Pair) -> list[Pair]:
        """Return the pairs before one that give its rate and acceleration, the newest first.

        Outliers are left out if there is another.
        """
        near = [
            other
            for other in reversed(pairs)
            if other.time_ns[1] < pair.time_ns[0]
            and pair.time_ns[0] - other.time_ns[0] < MAX_RATE_INTERVAL_S * 1e9
        ]
        return [other for other in near if not other.is_outlier] or near[:1]

    # ---- positions

    def solve_due(self) -> list[Fix]:
        """Estimate the due fixes, and return the accepted ones in order."""
        due, self.due = self.due, []
        if not due:
            return []
        known = self.known
        s = len(known.stations)
        ideal = np.full((len(due), s, 2), np.nan)
        angles = np.full((len(due), s, 2), np.nan)
        for row, fix in enumerate(due):
            for (station, _), angle in zip(fix.members, fix.angle, strict=True):
                angles[row, station] = angle
                ideal[row, station] = known.corrections[station].ideal(*angle)
        if known.floor_map is not None:
            calibration = known.stations[0].calibration
            estimates = project_on_floor(
                ideal[:, 0], calibration, known.floor_map, known.scene.floor_z
            )
        else:
            estimates = intersect_planes(ideal, *known.arrays, floor_z=known.floor_z)
            estimates = self._repair(due, ideal, angles, estimates)
        is_solved = np.isfinite(estimates.position[:, 0]).tolist()
        max_residual = estimates.max_residual
        unit = estimates.covariance(1.0, self._is_planar)
        spread = np.sqrt(np.maximum(np.einsum("mii->m", unit), 0.0)).tolist()
        variance = np.array([f.inflation * self.sigma_rad**2 + f.motion_variance for f in due])
        common, covariance = np.full((2, len(due), 6, 6), np.nan)
        common[:, :3, :3] = unit * known.calibration_sigma_rad**2
        for row, fix in enumerate(due):
            if is_solved[row]:
                common[row, :3, :3] += known.errors.position_covariance(
                    estimates.position[row].tolist(), [station for station, _ in fix.members]
                )
        covariance[:, :3, :3] = unit * variance[:, None, None] + common[:, :3, :3]
        dims = range(2 if self._is_planar else 3)
        covariance[:, dims, dims] += np.array([f.motion_sigma_m**2 for f in due])[:, None]
        with np.errstate(invalid="ignore"):
            distance = np.linalg.norm(estimates.position[:, None] - known.arrays[0], axis=2)
            is_inconsistent = max_residual > self.gate_rad
            is_out_of_range = distance.min(axis=1) > MAX_RANGE_M
        fixes: list[Fix] = []
        for row, fix in enumerate(due):
            self._noise.append((estimates.residual[row], int(estimates.redundancy[row])))
            self._new_fixes += 1
            reason = ""
            if not is_solved[row]:
                reason = "moment_with_too_few_sweeps"
            elif is_inconsistent[row]:
                reason = "moment_inconsistent"
            elif is_out_of_range[row] and known.scene.scale != "unit":
                reason = "moment_out_of_reach"
            elif self._jumps(fix, estimates.position[row], spread[row] * self.sigma_rad):
                reason = "moment_jumps"
            self._observe(angles[row], is_solved[row], reason == "moment_inconsistent")
            residual = estimates.residual[row].tolist()
            for station, pair in fix.members:
                is_used = not reason and math.isfinite(residual[station][0])
                pair.is_outlier |= not is_used
                if is_used:
                    self.used[station] += 2
                    self.residual[station].extend(residual[station])
                else:
                    self.rejected[station] += 2
            if reason:
                self._reject(reason, 1)
                continue
            fixes.append(
                Fix(
                    fix.state.name,
                    known.scene.frame,
                    fix.time_ns,
                    estimates.position[row],
                    IDENTITY_QUATERNION,
                    covariance[row],
                    common[row],
                )
            )
        return fixes

    @property
    def _is_planar(self) -> bool:
        return self.known.floor_z is not None or self.known.floor_map is not None

    def _repair(
        self, due: list[DueFix], ideal: Array, angles: Array, estimates: PositionEstimates
    ) -> PositionEstimates:
        """Restore exchanged sweeps and leave out a station that contradicts, as offline."""
        known = self.known
        is_wrong = (estimates.max_residual > self.gate_rad) & (estimates.redundancy > 0)
        if not np.any(is_wrong):
            return estimates
        is_labelled = all(pair.is_labelled for fix in due for _, pair in fix.members)
        if len(known.stations) == 2 and not is_labelled:
            channels = np.array([s.channel for s in known.stations])
            counts = np.stack(
                [angles_to_counts(angles[:, k], int(c)) for k, c in enumerate(channels)], axis=1
            )
            none = np.zeros(len(due), np.int64)
            epochs = Epochs(("",), none, none, channels, counts, False)
            before = estimates.position
            _, estimates, restored = restore_swapped_sweeps(
                epochs, estimates, known.arrays, known.floor_z
            )
            if restored:
                changed = np.flatnonzero(np.any(estimates.position != before, axis=1))
                for row in changed:
                    for _, pair in due[row].members:
                        pair.is_outlier = True
        estimates, repaired = leave_out_worst_station(
            ideal, estimates, known.arrays, known.floor_z, self.gate_rad
        )
        if repaired:
            self._reject("station_contradicts_others", repaired)
        return estimates

    def _jumps(self, fix: DueFix, position: Array, noise_m: float) -> bool:
        """Return whether a position departs from the path of its photodiode."""
        now = (fix.time_ns, position, math.hypot(noise_m, fix.motion_sigma_m))
        is_metric = self.known.scene.scale != "unit"
        return is_metric and not fix.state.path.accepts(now, CONFIRMING_FIXES)

    def update_noise(self) -> None:
        """Estimate the noise of an angle and the gate from the last fixes, as offline."""
        if self._new_fixes < MIN_NOISE_FIXES:
            return
        if self.known.max_gate_rad > INLIER_GATE_RAD:
            return  # Residuals of designed stations are those of their poses.
        if sum(redundancy > 0 for _, redundancy in self._noise) < MIN_NOISE_FIXES:
            return
        self._new_fixes = 0
        n = len(self._noise)
        estimates = PositionEstimates(
            np.zeros((n, 3)),
            np.zeros((n, 3, 3)),
            np.stack([residual for residual, _ in self._noise]),
            np.array([redundancy for _, redundancy in self._noise]),
        )
        self.gate_rad = inlier_gate(estimates)
        self.sigma_rad = angle_sigma(estimates, estimates.max_residual <= self.gate_rad)

    def forget(self, time_ns: int) -> None:
        """Forget photodiodes that received nothing since ``time_ns``."""
        silent = [
            name
            for name, state in self._states.items()
            if all(pairs[-1].time_ns[1] < time_ns for pairs in state.pairs.values())
            and all(lone[0] < time_ns for lone in state.lone.values())
        ]
        for name in silent:
            del self._states[name]

    def moved_to(self, known: KnownScene) -> PhotodiodeFixes:
        """Return the fixes in another scene; sweeps of stations that both have are kept."""
        new = PhotodiodeFixes(known, self._reject, self._observe)
        new.sigma_rad = self.sigma_rad
        return new
