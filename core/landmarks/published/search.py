"""The paper's search, from a recording: first step, spin, compensation (sections 3 and 4.1).

Visits are found as for the default method. Of each:

1. the first pass gives entries, and these a first centre (:mod:`.paper_first`);
2. each spin of 330 degrees or more gives valleys, and these pattern, heading and centre
   (:mod:`.paper_valleys`); the last one that can be read counts, as the paper retries;
3. where the robot then stands, or passes, within a few millimetres of the centre and along
   the bars, the four voltages amend the pose (:mod:`.paper_pose`).

A pass alone tells the paper neither pattern nor heading: such a visit is refused as
``no_spin``, with the first centre in a warning (``first_step``). What the paper does not have:
a reading whose bars explain less than half of the spin's field is refused as ``unexplained``.
Farther than 8-10 mm from the centre valleys merge, and other patterns would be read silently.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import DegenerateError
from locatk.core.landmarks import preprocessing
from locatk.core.landmarks.detection.hypotheses import Hypothesis, VisitHypotheses
from locatk.core.landmarks.detection.trace import OdometryDrift, relative, sensor_positions
from locatk.core.landmarks.field import landmark_field
from locatk.core.landmarks.halls import HallSamples
from locatk.core.landmarks.landmark import Geometry, name
from locatk.core.landmarks.published import first_step as paper_first
from locatk.core.landmarks.published.entries import Entries, entries
from locatk.core.landmarks.published.pose import compensate
from locatk.core.landmarks.published.valleys import Recognised, profile, recognise, valleys
from locatk.core.landmarks.published.voting import voted_centre
from locatk.core.solution import SolverWarning
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

HYSTERESIS = 0.2
"""Of the territory's threshold: what a field has to exceed on either side of a valley."""

SPIN_RAD = math.radians(330)

SPIN_M = 0.005
"""How far the robot may move while it turns on the spot."""

LEFT_M = 0.020
"""A way without any field after which the first pass is over."""

NEAR_M = 0.006
"""From the centre, for the four voltages: a bar's field is linear within 7.5 mm..."""

NEAR_RAD = math.radians(12)
"""... and this is 5 mm on the circle."""

STILL = (0.3e-3, math.radians(0.3))
"""Metres and radians within which a robot stands."""

UNEXPLAINED = 0.4
"""Of the rms field of a spin: a larger rms residual refuses the reading."""


@dataclass(frozen=True)
class FirstStep:
    """What the first pass of a visit tells: the landmark's centre, without a heading.

    Attributes
    ----------
    first, stop : int
        Samples of the pass.
    entries : Entries
        In the frame of the odometry.
    centre_m : (2,) ndarray
        In the frame of the odometry; ``nan`` where no circle is kept.
    voted_m : (2,) ndarray
        The baseline's estimate (:mod:`.voting`).
    grazed : bool
        Only a corner of the territory may have been cut; the estimate can be 28 mm off.
    """

    first: int
    stop: int
    entries: Entries
    centre_m: Array
    voted_m: Array
    grazed: bool


def sightings(
    samples: HallSamples, odometry: Trajectory, geometry: Geometry
) -> list[VisitHypotheses]:
    """Landmarks visited in a recording, by the published algorithm.

    Parameters
    ----------
    samples : HallSamples
    odometry : Trajectory
        Of the same robot and clock.
    geometry : Geometry

    Returns
    -------
    list of Sighting
        One a visit, in order of time, with one hypothesis of probability 1 and unknown
        covariance; or refused as ``no_spin``, ``no_pattern`` or ``unexplained``.

    Raises
    ------
    InputError
        There is no odometry, it covers no sample, or no sensor can be used.
    DegenerateError
        The field of such bars does not reach the threshold.
    """
    run = preprocessing.preprocess(samples, odometry)
    both = paper_first.radii(geometry)
    found = preprocessing.segment_visits(run, geometry, OdometryDrift())
    return [_Visit(run, visit.first, visit.stop, geometry, both).sighting() for visit in found]


def first_steps(samples: HallSamples, odometry: Trajectory, geometry: Geometry) -> list[FirstStep]:
    """The first step alone, for each visit of a recording; raises as :func:`sightings`."""
    run = preprocessing.preprocess(samples, odometry)
    both = paper_first.radii(geometry)
    found = preprocessing.segment_visits(run, geometry, OdometryDrift())
    return [_Visit(run, visit.first, visit.stop, geometry, both).first_step() for visit in found]


def first_step(
    place: Array, field_t: Array, threshold_t: float, both: tuple[float, float]
) -> tuple[Entries, Array, Array]:
    """Entries, the paper's centre (2,) and the voted one (2,) of one pass.

    ``place`` (n, N, 2) are the sensors, ``field_t`` (n, N) their fields, ``both`` r1 and r2.
    """
    seen = entries(place, field_t, threshold_t)
    # Batches of one: a visit without a silent sensor has no way to keep away from.
    points, silent = seen.point[None], seen.silent[None]
    centre = paper_first.first_centre(points, silent, seen.robot[None], both)[0]
    return seen, centre, voted_centre(points, silent, both)[0]


def spins(pose: Array) -> list[tuple[int, int]]:
    """Stretches (first, stop) in which poses (n, 3) turn by :data:`SPIN_RAD` on the spot."""
    found = []
    first = 0
    while first < len(pose):
        away = np.hypot(*(pose[first:, :2] - pose[first, :2]).T) > SPIN_M
        stop = first + int(away.argmax()) if away.any() else len(pose)
        heading = pose[first:stop, 2]
        low, high = sorted((int(heading.argmin()), int(heading.argmax())))
        if abs(heading[high] - heading[low]) >= SPIN_RAD:
            found.append((first + low, first + high + 1))
            first = stop
        else:
            # On to the next sample from which another stretch begins.
            moved = np.hypot(*(pose[first:, :2] - pose[first, :2]).T) > SPIN_M / 10
            first = first + int(moved.argmax()) if moved.any() else len(pose)
    return found


class _Visit:
    """One visit on its way through the steps; indices are those of its own samples."""

    def __init__(
        self,
        run: preprocessing.HallRecording,
        first: int,
        stop: int,
        geometry: Geometry,
        both: tuple[float, float],
    ) -> None:
        self.run, self.first, self.stop = run, first, stop
        self.geometry, self.both = geometry, both
        self.pose = run.pose[first:stop]
        self.field = run.samples.field_t[first:stop] - run.offset_t
        self.lever = run.samples.sensors.position_m
        self.place = sensor_positions(self.pose, self.lever)
        self.spins = spins(self.pose)
        self.warnings: list[SolverWarning] = []

    def warn(self, code: str, message: str) -> None:
        """Add a warning on this visit."""
        self.warnings.append(SolverWarning(code, message))

    def first_step(self) -> FirstStep:
        stop = self._end_of_pass()
        seen, centre, voted = first_step(
            self.place[:stop], self.field[:stop], self.geometry.threshold_t, self.both
        )
        chords = seen.point[:, None] - seen.point
        longest = float(np.hypot(chords[..., 0], chords[..., 1]).max(initial=0.0))
        grazed = longest < paper_first.GRAZED_M
        return FirstStep(self.first, self.first + stop, seen, centre, voted, grazed)

    def sighting(self) -> VisitHypotheses:
        step = self.first_step()
        if np.isfinite(step.centre_m).all():
            x, y = step.centre_m * 1e3
            grazed = ", by a grazing pass" if step.grazed else ""
            message = f"first step: centre at {x:.1f}, {y:.1f} mm of the odometry{grazed}"
            self.warn("first_step", message)
        refused = "no_spin"
        for start, stop in reversed(self.spins):
            found = self._second_step(start, stop)
            if found is None:
                refused = "no_pattern"
                continue
            at, hypothesis = self._compensated(found, start, stop)
            left = self._unexplained(at, hypothesis, start, stop)
            if left > UNEXPLAINED:
                refused = "unexplained"
                message = f"{name(hypothesis.code)} leaves {100 * left:.0f} % of the spin's field"
                self.warn("spin_unexplained", message)
                continue
            return self._answer(at, (hypothesis,), "")
        nearest = len(self.pose) // 2
        if np.isfinite(step.centre_m).all():
            nearest = int(np.hypot(*(self.pose[:, :2] - step.centre_m).T).argmin())
        return self._answer(nearest, (), refused)

    def _end_of_pass(self) -> int:
        """Where the first pass ends: at a spin, or where nothing is felt for a while."""
        end = self.spins[0][0] if self.spins else len(self.pose)
        inside = np.flatnonzero((np.abs(self.field) >= self.geometry.threshold_t).any(axis=1))
        way = np.cumsum(np.hypot(*np.diff(self.pose[:, :2], axis=0, prepend=self.pose[:1, :2]).T))
        if not len(inside):
            return end
        gap = np.flatnonzero(np.diff(way[inside]) > LEFT_M)
        last = inside[gap[0]] if len(gap) else inside[-1]
        # The margin behind counts for the sensors that saw nothing.
        return min(end, int(np.searchsorted(way, way[last] + LEFT_M, "right")))

    def _second_step(self, start: int, stop: int) -> Recognised | None:
        """Centre in the odometry's frame, bars and their letters."""
        turning = slice(start, stop)
        middle = np.median(self.pose[turning, :2], axis=0)
        around = profile(self.place[turning], self.field[turning], middle)
        if np.isnan(around).any():
            self.warn("spin_incomplete", "a spin whose circle was not seen all around")
            return None
        seen = valleys(around, HYSTERESIS * self.geometry.threshold_t)
        radius = float(np.mean(np.hypot(*self.lever.T)))
        found = recognise(seen, radius)
        if found is None:
            message = f"a spin with {len(seen.angle_rad)} valleys fits no landmark near its centre"
            self.warn("spin_without_pattern", message)
            return None
        return Recognised(found.centre_m + middle, found.bar_rad, found.north)

    def _compensated(self, found: Recognised, start: int, stop: int) -> tuple[int, Hypothesis]:
        """Sample and hypothesis: amended by the four voltages if the robot came near."""
        away = self.pose[start:, :2] - found.centre_m
        # Bars lie a quarter apart, so that any of the four frames tells how well it stands.
        turned = 4 * (self.pose[start:, 2] - found.seen_under(0.0)[1])
        aside = np.arctan2(np.sin(turned), np.cos(turned)) / 4
        distance = np.hypot(*away.T)
        good = (distance <= NEAR_M) & (np.abs(aside) <= NEAR_RAD)
        good &= np.isfinite(self.field[start:]).sum(axis=1) >= 3
        if not good.any():
            self.warn("never_over_bars", "never stood over the bars: by the valleys alone")
            return self._posed(stop - 1, found)
        cost = np.where(good, distance + self.geometry.circle_m * np.abs(aside), np.inf)
        at = start + int(cost.argmin())
        standing = self._standing(at)
        code, _ = found.seen_under(self.pose[at, 2])
        whole = np.isfinite(self.field[standing]).any(axis=0)
        field = np.nanmean(self.field[standing][:, whole], axis=0)
        try:
            pose = compensate(self.geometry, code, self.lever[whole], field)
        except DegenerateError as error:
            self.warn("voltages_undetermined", f"{error}: by the valleys alone")
            return self._posed(at, found)
        if np.hypot(*pose[:2]) > 2 * NEAR_M or abs(pose[2]) > 2 * NEAR_RAD:
            self.warn(
                "voltages_contradict_valleys",
                "the voltages contradict the valleys: by these alone",
            )
            return self._posed(at, found)
        return at, _hypothesis(code, pose)

    def _standing(self, at: int) -> slice:
        """The samples around one in which the robot did not move."""
        off = np.abs(self.pose - self.pose[at])
        moved = np.flatnonzero((off[:, :2] > STILL[0]).any(axis=1) | (off[:, 2] > STILL[1]))
        before, after = moved[moved < at], moved[moved > at]
        first = int(before[-1]) + 1 if len(before) else 0
        return slice(first, int(after[0]) if len(after) else len(self.pose))

    def _posed(self, at: int, found: Recognised) -> tuple[int, Hypothesis]:
        code, heading = found.seen_under(self.pose[at, 2])
        pose = relative(self.pose[at : at + 1], np.array([*found.centre_m, heading]))[0]
        pose[2] = math.remainder(pose[2], math.tau)
        return at, _hypothesis(code, pose)

    def _unexplained(self, at: int, hypothesis: Hypothesis, start: int, stop: int) -> float:
        """Rms of what the bars leave of the spin's field, in units of the field's rms."""
        way = relative(self.pose[start:stop], self.pose[at])
        x, y, turn = hypothesis.pose
        cos, sin = math.cos(turn), math.sin(turn)
        way[:, :2] = way[:, :2] @ np.array([[cos, sin], [-sin, cos]]) + [x, y]
        way[:, 2] += turn
        expected = landmark_field(self.geometry, hypothesis.code, sensor_positions(way, self.lever))
        seen = self.field[start:stop]
        return math.sqrt(np.nanmean((seen - expected) ** 2) / np.nanmean(seen**2))

    def _answer(self, at: int, hypotheses: tuple[Hypothesis, ...], refused: str) -> VisitHypotheses:
        samples = self.run.samples
        return VisitHypotheses(
            device=samples.device,
            time_ns=int(samples.time_ns[self.first + at]),
            first=self.first,
            stop=self.stop,
            odometry=self.pose[at].copy(),
            hypotheses=hypotheses,
            refused=refused,
            warnings=tuple(self.warnings),
        )


def _hypothesis(code: int, pose: Array) -> Hypothesis:
    unknown = np.full(4, np.nan)
    return Hypothesis(code, 1.0, pose, np.full((3, 3), np.nan), unknown, unknown)
