"""Causal localization over Polaris tags: samples and odometry in, tags and fixes out.

A pass is followed sample by sample. Whenever the array leaves a row of magnets behind, the tags of
the pass are identified as far as it has been recorded (:mod:`.identification.early`). A tag that is
beyond doubt is reported at once. The others are reported, or refused, when the pass has ended as it
would in :func:`.solver.solve`, by the same stages on a window of the newest samples. The pass of an
early tag is solved again at its end, for further tags in it.

A pass gives one fix. Its time is chosen so that a filter, which adds the odometry after it, counts
no error twice:

- If the path was estimated from the field, it is that of the last sample over the tag whose
  position is well determined. No odometry is in the fix.
- If odometry measured the path, it is that of the sample in the middle of the magnets. There, an
  error of the scale of odometry has no effect, which has moved the last pose by half the length of
  the tag times that error; the odometry after it is new to the fix.
"""

from __future__ import annotations

import warnings
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.polaris.array import Samples, SensorArray
from locatk.core.polaris.given_path import (
    backward_warning,
    compare_path,
    contradiction_warning,
    coverage_warning,
    known_path,
)
from locatk.core.polaris.identification.early import EarlyTags, identify_running, is_beyond_doubt
from locatk.core.polaris.identification.tags import (
    IdentifiedPass,
    TagObservation,
    may_be_one_tag,
)
from locatk.core.polaris.localization import (
    PlanarPoses,
    distance_along,
    heading_correction,
    poses_over_tag,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.preprocessing import (
    CHANGE_LAGS_SAMPLES,
    MIN_CHANGE_SIGMAS,
    MIN_PASS_MARGIN_SAMPLES,
    MIN_SAMPLES,
    PASS_TO_MARGIN_RATIO,
    PassRange,
    PreprocessedSamples,
    bar_energy,
    field_change,
    find_passes,
    preprocess,
)
from locatk.core.polaris.solver import by_magnets, has_no_tag, identify_range, name_designs
from locatk.core.polaris.tag import PlanarPose, Tags
from locatk.core.solution import SolverWarning
from locatk.core.streaming.events import (
    DetectionEvent,
    Fix,
    Stream,
    StreamEvent,
    WarningEvent,
)
from locatk.core.streaming.plausibility import is_plausible_odometry, plausible_fields
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

MAX_PASS_SAMPLES = 2400
"""Number of samples at which a pass is cut: 24 s at 100 Hz, 1 cm/s over a tag of 0.1 m with its
margins. An array that rests over a tag sees no changes, and its pass ends by itself."""

HISTORY_SAMPLES = 256
"""Number of samples before a pass from which, with those of the pass, the noise is estimated."""

CAPACITY_SAMPLES = 2 * MAX_PASS_SAMPLES + HISTORY_SAMPLES
"""Number of samples that are kept: two passes that may be one tag."""

CAPACITY_POSES = 20_000
"""Number of poses of odometry that are kept: as long as the samples, at four times their rate."""

MAX_HELD_SAMPLES = 20_000
"""Maximum number of samples that wait for odometry."""

NOISE_PERIOD_SAMPLES = 128
"""Number of samples after which the noise is estimated again, between passes."""

IDLE_BLOCK_SAMPLES, PASS_BLOCK_SAMPLES = 16, 4
"""Number of samples after which changes of the field are tested, between passes and in one."""

CHANGE_WINDOW_SAMPLES = 2 * max(CHANGE_LAGS_SAMPLES)
"""Number of samples before a block with which it is compared."""

MAX_SILENCE_S = 1.0
"""Time without samples after which a pass has ended [s]."""

ROW_PASSED_RATIO = 0.8
"""Energy of the field relative to its last maximum from which a row of magnets is behind the array.
A magnet at a distance r has r^-6 of it: at the usual height of 10 mm the array is 3 mm behind."""

RISE_RATIO = 1.5
"""Energy relative to its last minimum from which the next row approaches."""

DECAY_RATIO = 0.3
"""Energy relative to that of the last attempt from which another one follows: the array has moved
on by a fifth of its distance from the magnets."""

MIN_ROW_ENERGY = 200.0
"""Least energy of a maximum in units of the noise: a magnet explains 80 of several samples."""

MAX_ATTEMPTS = 12
"""Maximum number of early identifications in a pass."""

CHECK_PERIOD_SAMPLES = 2
"""Number of samples after which early tags are checked again."""

MAX_VARIANCE_RATIO = 2.0
"""Largest variance of the position of a fix relative to that of the best pose over the tag."""

MAX_WARNINGS = 1000
"""Number of warnings of a device after which there are no more."""

MAX_ODOMETRY_DELAY_NS = 500_000_000
"""Time by which odometry may arrive later than samples of the same time [ns]. A device whose
odometry is farther behind is treated as one without, until it has caught up."""

NEVER_NS, FOREVER_NS = -(2**62), 2**62
"""Times before and after all others."""

_TagKey = tuple[int, int]
"""Identity of a design, and id of a tag."""


class PolarisStream(Stream):
    """Stream of the Polaris system, see :class:`~locatk.core.streaming.events.Stream`.

    Parameters
    ----------
    tags : Tags, mapping of str to Tags, or None
        As of :func:`.solver.solve`.
    """

    system = "polaris"

    def __init__(
        self,
        tags: Tags | Mapping[str, Tags] | None = None,
    ) -> None:
        self._designs = name_designs(tags)
        self._devices: dict[str, _DeviceStream] = {}

    def push(self, observations: Any) -> Sequence[StreamEvent]:
        """Return the results that samples or odometry make known; other data are not used."""
        if not isinstance(observations, Samples | Trajectory) or not len(observations):
            return ()
        name = observations.device
        device = self._devices.get(name)
        if device is None:
            device = _DeviceStream(name, self._designs)
            self._devices[name] = device
        if isinstance(observations, Trajectory):
            return device.push_odometry(observations)
        return device.push_samples(observations)

    def advance(self, time_ns: int) -> Sequence[StreamEvent]:
        """Release samples that wait for odometry, and end passes of arrays that fell silent."""
        return [event for each in self._devices.values() for event in each.advance(time_ns)]

    def finish(self) -> Sequence[StreamEvent]:
        """End all passes."""
        return [event for each in self._devices.values() for event in each.finish()]


class _Ring:
    """The newest rows of a table, addressed by the number of rows before them.

    Parameters
    ----------
    capacity : int
        Least number of rows that are kept; twice as many are stored at most.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self.first = 0
        self.stop = 0
        self._columns: list[NDArray[Any]] = []

    def append(self, *columns: Any) -> None:
        """Add rows; each column is (k, ...)."""
        count = len(columns[0])
        if not self._columns:
            self._columns = [np.empty((0, *c.shape[1:]), c.dtype) for c in columns]
        used = self.stop - self.first
        if used + count > len(self._columns[0]):
            kept = min(used, self.capacity)
            size = min(max(2 * (kept + count), 64), 2 * self.capacity + count)
            grown = [np.empty((size, *c.shape[1:]), c.dtype) for c in self._columns]
            for new, old in zip(grown, self._columns, strict=True):
                new[:kept] = old[used - kept : used]
            self._columns, self.first, used = grown, self.stop - kept, kept
        for column, new in zip(self._columns, columns, strict=True):
            column[used : used + count] = new
        self.stop += count

    def rows(self, first: int, stop: int) -> list[NDArray[Any]]:
        """Return the rows with these numbers, as copies."""
        inside = slice(max(first - self.first, 0), stop - self.first)
        return [column[inside].copy() for column in self._columns]

    def drop_before(self, number: int) -> None:
        """Forget all rows before a number."""
        number = min(max(number, self.first), self.stop)
        used = self.stop - number
        for column in self._columns:
            column[:used] = column[number - self.first : self.stop - self.first].copy()
        self.first = number


@dataclass
class _RunningPass:
    """State of the pass that is being recorded.

    Attributes
    ----------
    first : int
        First sample, with the margin before the first change.
    first_change, last_change : int
    level_t : (N, 3) ndarray
        Field before the pass.
    is_rising : bool
        True until a row of magnets was left behind, and again when the next one approaches.
    peak, least : float
        Maximum of the energy while it rises, and minimum after that.
    attempt_energy, last_energy : float
        Energies at the last early identification (0 if it was successful), and of the last sample.
    attempts : int
        Number of early identifications.
    early : EarlyTags or None
        Complete tags that are not beyond doubt yet.
    checked : int
        Number of samples when they were checked.
    """

    first: int
    first_change: int
    last_change: int
    level_t: Array
    is_rising: bool = True
    peak: float = 0.0
    least: float = np.inf
    attempt_energy: float = np.inf
    last_energy: float = 0.0
    attempts: int = 0
    early: EarlyTags | None = None
    checked: int = NEVER_NS

    def has_passed_row(self, energy: float) -> bool:
        """Take the energy of the next sample; return whether to identify tags now."""
        # A spike lasts for one sample.
        steady, self.last_energy = min(energy, self.last_energy), energy
        if self.is_rising:
            self.peak = max(self.peak, steady)
            is_passed = self.peak > MIN_ROW_ENERGY and energy < ROW_PASSED_RATIO * self.peak
        else:
            self.least = min(self.least, energy)
            if steady > max(RISE_RATIO * self.least, MIN_ROW_ENERGY):
                self.is_rising, self.peak = True, steady
            is_passed = self.early is None and energy < DECAY_RATIO * self.attempt_energy
        if not is_passed or self.attempts >= MAX_ATTEMPTS:
            return False
        self.is_rising, self.least, self.attempt_energy = False, energy, energy
        return True


class _DeviceStream:
    """Stream of one array. Samples are numbered from the first one."""

    def __init__(self, device: str, named_designs: Mapping[str | None, Tags]) -> None:
        self.device = device
        self.designs = tuple(by_magnets(tuple(named_designs.values())))
        self.names = {id(tags): name for name, tags in named_designs.items()}
        self.first_tag: _TagKey | None = None
        self.warned: set[str] = set()
        # Input.
        self.array: SensorArray | None = None
        self.samples = _Ring(CAPACITY_SAMPLES)
        self.odometry = _Ring(CAPACITY_POSES)
        self.start_ns: int | None = None
        self.newest_ns = self.odometry_ns = self.advanced_ns = NEVER_NS
        self.held: deque[tuple[int, Array]] = deque()
        # Passes.
        self.last_ns = NEVER_NS
        self.noise_t: Array | None = None
        self.noise_number = 0
        self.running: _RunningPass | None = None
        self.handled = 0
        self.unidentified: IdentifiedPass | None = None
        self.reported: dict[_TagKey, TagObservation] = {}
        self.last_tag: tuple[int, PlanarPose, PlanarPoses] | None = None

    # ---- input

    def push_samples(self, samples: Samples) -> list[StreamEvent]:
        """Take samples, and return the results of those that need not wait for odometry."""
        if self.array is None:
            self.array = samples.array
        elif len(samples.array) != len(self.array):
            raise InputError(
                f"{self.device} has {len(samples.array)} sensors, not {len(self.array)} as before",
                hint="Give each array a name of its own",
            )
        events: list[StreamEvent] = []
        fields_t = plausible_fields(samples.field_t)
        for time, field_t in zip(samples.time_ns.tolist(), fields_t, strict=True):
            if time < self.newest_ns:
                message = "samples with a time before that of earlier ones were left out"
                events += self._warn(self.newest_ns, "samples_out_of_order", message)
                continue
            if self.start_ns is None:
                self.start_ns = time
            self.newest_ns = time
            self.held.append((time, field_t))
            events += self._release()
        return events

    def push_odometry(self, odometry: Trajectory) -> list[StreamEvent]:
        """Take poses of odometry, and return the results of samples that waited for them."""
        events: list[StreamEvent] = []
        # Strictly ascending, also relative to earlier poses.
        latest = np.maximum.accumulate(np.append(self.odometry_ns, odometry.time_ns))[:-1]
        is_valid = is_plausible_odometry(odometry) & (odometry.time_ns > latest)
        if not is_valid.all():
            message = (
                "poses of the odometry that are not finite numbers, or not later than earlier "
                "ones, were left out"
            )
            events += self._warn(int(odometry.time_ns[-1]), "odometry_invalid", message)
        if is_valid.any():
            valid = odometry.select(np.asarray(is_valid))
            self.odometry.append(valid.time_ns, valid.position, valid.quaternion)
            self.odometry_ns = int(valid.time_ns[-1])
        return events + self._release()

    def advance(self, time_ns: int) -> list[StreamEvent]:
        """Release the samples up to a time, and end the pass of an array that fell silent."""
        self.advanced_ns = max(self.advanced_ns, time_ns)
        events = self._release()
        if not self.held and time_ns - self.last_ns > MAX_SILENCE_S * 1e9:
            events += self._end_pass()
        return events

    def finish(self) -> list[StreamEvent]:
        """Release all samples, and end the pass."""
        return self.advance(FOREVER_NS)

    def _release(self) -> list[StreamEvent]:
        """Process the samples that need not wait for odometry of the same time."""
        if self.start_ns is None:
            return []
        delay_ns = self.newest_ns - max(self.odometry_ns, self.start_ns)
        limit_ns = self.newest_ns
        if delay_ns <= MAX_ODOMETRY_DELAY_NS:
            limit_ns = max(self.odometry_ns, self.advanced_ns)
        events: list[StreamEvent] = []
        while self.held and (self.held[0][0] <= limit_ns or len(self.held) > MAX_HELD_SAMPLES):
            events += self._process(*self.held.popleft())
        return events

    # ---- passes

    def _process(self, time_ns: int, field_t: Array) -> list[StreamEvent]:
        """Take the next sample."""
        events: list[StreamEvent] = []
        if time_ns - self.last_ns > MAX_SILENCE_S * 1e9:
            events += self._end_pass()
        self.last_ns = time_ns
        self.samples.append(np.array([time_ns]), field_t[None])
        count = self.samples.stop
        block = IDLE_BLOCK_SAMPLES if self.running is None else PASS_BLOCK_SAMPLES
        is_old = self.noise_t is None or count >= self.noise_number + NOISE_PERIOD_SAMPLES
        if self.running is None and is_old and count % block == 0:
            events += self._estimate_noise()
        if self.noise_t is None:
            return events
        if self.running is not None:
            events += self._follow(field_t)
        if count % block == 0:
            events += self._test_changes(block)
        return events

    def _estimate_noise(self) -> list[StreamEvent]:
        """Estimate the noise of the newest samples."""
        preprocessed, events = self._preprocess(self.samples.stop - 2 * HISTORY_SAMPLES)
        if preprocessed is not None:
            self.noise_t, self.noise_number = preprocessed.noise_t, self.samples.stop
        return events

    def _preprocess(self, first: int) -> tuple[PreprocessedSamples | None, list[StreamEvent]]:
        """Return the samples from a number on without implausible values; None if too few."""
        window = self._window(first)
        if len(window) < MIN_SAMPLES or window.time_ns[0] == window.time_ns[-1]:
            return None, []
        if not np.isfinite(window.field_t).any():
            message = f"no sensor of {self.device} gives samples"
            return None, self._warn(self.last_ns, "no_samples", message)
        preprocessed = preprocess(window, is_running=True)
        events: list[StreamEvent] = []
        for warning in preprocessed.warnings:
            # The numbers in parentheses are those of the window.
            key = warning.message.partition(" (")[0] if warning.code == "sensor_stuck" else ""
            events += self._report(self.last_ns, warning, warning.code + key)
        return preprocessed, events

    def _window(self, first: int) -> Samples:
        """Return the samples from a number on."""
        assert self.array is not None
        time_ns, field_t = self.samples.rows(first, self.samples.stop)
        return Samples(self.device, self.array, time_ns, field_t)

    def _test_changes(self, block: int) -> list[StreamEvent]:
        """Look for changes of the field in the newest samples; begin or end a pass by them."""
        assert self.noise_t is not None
        count = self.samples.stop
        first = max(self.samples.first, count - block - CHANGE_WINDOW_SAMPLES)
        change = field_change(self._window(first), self.noise_t)
        number = first + np.flatnonzero(change > MIN_CHANGE_SIGMAS)
        number = number[number >= max(self.handled, count - block - CHANGE_WINDOW_SAMPLES // 2)]
        events: list[StreamEvent] = []
        running = self.running
        if running is None:
            return self._begin_pass(int(number[0]), int(number[-1])) if len(number) else events
        if len(number):
            running.last_change = max(running.last_change, int(number[-1]))
        changed = running.last_change + 1 - running.first_change
        margin = max(MIN_PASS_MARGIN_SAMPLES, changed // PASS_TO_MARGIN_RATIO)
        # A change is known half a lag later, and two samples after the end show that it is one.
        quiet = max(CHANGE_WINDOW_SAMPLES * 3 // 4, margin + 2)
        if count - 1 - running.last_change > quiet:
            return self._end_pass()
        if count - running.first >= MAX_PASS_SAMPLES:
            events += self._end_pass(is_cut=True)
            self.samples.drop_before(count)
            self.handled = count
        return events

    def _begin_pass(self, first_change: int, last_change: int) -> list[StreamEvent]:
        """Follow a pass from its first change on."""
        first = max(first_change - MIN_PASS_MARGIN_SAMPLES, self.samples.first)
        if first >= self.handled:
            self.reported = {}
        _, field_t = self.samples.rows(first, self.samples.stop)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # A sensor without a sample there.
            level_t = np.nanmean(field_t[: max(first_change - first - 2, 1)], axis=0)
        self.running = _RunningPass(first, first_change, last_change, level_t)
        events: list[StreamEvent] = []
        for sample in field_t[first_change - first :]:
            events += self._follow(sample)
        return events

    def _follow(self, field_t: Array) -> list[StreamEvent]:
        """Identify the tags of the running pass if a row of magnets was left behind."""
        running = self.running
        if running is None or not self.designs or self.noise_t is None:
            return []
        is_passed = running.has_passed_row(bar_energy(field_t, running.level_t, self.noise_t))
        number = self.samples.stop
        is_check = running.early is not None and number >= running.checked + CHECK_PERIOD_SAMPLES
        if not (is_passed or is_check):
            return []
        preprocessed, events = self._preprocess(running.first - HISTORY_SAMPLES)
        if preprocessed is None or number - running.first < MIN_SAMPLES:
            return events
        count = len(preprocessed.samples)
        part = PassRange(count - (number - running.first), count)
        path_m = known_path(self._given_path(preprocessed.samples.time_ns), part)
        if is_passed:
            running.attempts += 1
            known = len(self.reported)
            running.early = identify_running(preprocessed, part, self.designs, path_m, known)
        running.checked = number
        early = running.early
        if early is not None and is_beyond_doubt(early, preprocessed, part, path_m):
            running.early, running.attempt_energy = None, 0.0
            for observation in early.result.observations:
                events += self._report_tag(preprocessed.samples, early.result, observation)
        return events

    def _given_path(self, time_ns: NDArray[np.int64]) -> Array | None:
        """Return the distance (n,) moved at samples, by odometry; None without it."""
        if self.odometry.stop == 0:
            return None
        pose_ns, position, quaternion = self.odometry.rows(self.odometry.first, self.odometry.stop)
        # From the pose before the first sample to that after the last one: sums over others would
        # round differently if the odometry was cut into other pieces.
        before = max(int(np.searchsorted(pose_ns, time_ns[0], "right")) - 1, 0)
        after = int(np.searchsorted(pose_ns, time_ns[-1])) + 1
        if pose_ns[0] > time_ns[-1]:
            return None
        if len(pose_ns[before:after]) < 2:
            return np.full(len(time_ns), np.nan)
        used = slice(before, after)
        pose_ns, position, quaternion = pose_ns[used], position[used], quaternion[used]
        covariance = np.broadcast_to(np.nan, (len(pose_ns), 6, 6))
        driven = Trajectory(self.device, "odometry", pose_ns, position, quaternion, covariance)
        path_m = distance_along(driven, time_ns)
        # Whether poses after a gap are known already depends on how the input is interleaved.
        next_pose = np.clip(np.searchsorted(pose_ns, time_ns), 1, len(pose_ns) - 1)
        is_gap = pose_ns[next_pose] - pose_ns[next_pose - 1] > MAX_ODOMETRY_DELAY_NS
        return np.where(is_gap, np.nan, path_m)

    def _end_pass(self, is_cut: bool = False) -> list[StreamEvent]:
        """Detect and identify the tags of the running pass as in a finished recording."""
        running, self.running = self.running, None
        if running is None:
            return []
        first, before = running.first, self.unidentified
        if before is not None:
            if running.last_change - before.magnets.first < MAX_PASS_SAMPLES:
                first = before.magnets.first
            else:
                self.unidentified = None
        start = max(self.samples.first, first - HISTORY_SAMPLES)
        preprocessed, events = self._preprocess(start)
        handled = self.handled
        self.handled = running.last_change + 1
        if preprocessed is None:
            return events
        given_m = self._given_path(preprocessed.samples.time_ns)
        for part in find_passes(preprocessed.samples, preprocessed.noise_t):
            if start + part.stop > handled and start + part.stop > running.first_change:
                events += self._solve_pass(preprocessed, part, given_m, start, is_cut)
                self.handled = max(self.handled, start + part.stop)
        return events

    def _solve_pass(
        self,
        preprocessed: PreprocessedSamples,
        part: PassRange,
        given_m: Array | None,
        start: int,
        is_cut: bool,
    ) -> list[StreamEvent]:
        """Return the results of one pass, a range of the samples from number ``start`` on."""
        samples, before = preprocessed.samples, self.unidentified
        current = identify_range(preprocessed, self.designs, part, given_m)
        if has_no_tag(preprocessed, self.designs, part, given_m, current) or current is None:
            return []
        if before is not None:
            first = before.magnets.first - start
            shifted = replace(before.magnets, first=first, stop=before.magnets.stop - start)
            before = replace(before, magnets=shifted)
            if any(may_be_one_tag(before, current, tags) for tags in self.designs):
                whole = PassRange(first, current.magnets.stop)
                merged = identify_range(preprocessed, self.designs, whole, given_m)
                if merged is not None and merged.is_identified:
                    current = merged
        events = self._report_path(current, given_m)
        self.unidentified = None
        if not (current.is_identified or self.reported):
            magnets = current.magnets
            shifted = replace(magnets, first=magnets.first + start, stop=magnets.stop + start)
            self.unidentified = replace(current, magnets=shifted)
        if self.reported and not current.is_identified:
            ids = ", ".join(str(tag_id) for _, tag_id in self.reported)
            message = f"the end of the pass contradicts the early identification of tag {ids}"
            warning = SolverWarning("early_tag_contradicted", message).about(self.device)
            events.append(WarningEvent(self.device, current.magnets.time_ns, warning))
        for observation in current.observations:
            if observation.refused and is_cut:
                observation = replace(observation, refused="pass_too_long")
            events += self._report_tag(samples, current, observation)
        return events

    # ---- results

    def _report_path(self, current: IdentifiedPass, given_m: Array | None) -> list[StreamEvent]:
        """Return the warnings of a pass and its path."""
        found = list(
            dict.fromkeys(w for each in current.observations for w in each.magnets.warnings)
        )
        if given_m is not None:
            contradiction = compare_path(given_m, current.observations[0])
            found += [
                each
                for each in (
                    contradiction_warning([contradiction], None),
                    coverage_warning(given_m, [current.magnets]),
                )
                if each is not None
            ]
        backward = backward_warning([current], given_m)
        found += [] if backward is None else [backward]
        events: list[StreamEvent] = []
        for warning in found:
            events += self._report(
                current.magnets.time_ns, warning.about(self.device), warning.code
            )
        return events

    def _report_tag(
        self, samples: Samples, current: IdentifiedPass, observation: TagObservation
    ) -> list[StreamEvent]:
        """Return the detection of a tag with its fix and heading correction, once in a pass."""
        tag_id, tags, time_ns = observation.tag_id, observation.tags, observation.magnets.time_ns
        if tag_id is None or tags is None:
            detection = observation.detection(self.device, samples.time_ns)
            return [DetectionEvent(self.device, time_ns, detection)]
        key = (id(tags), tag_id)
        poses = self._poses(samples, observation)
        if key in self.reported:
            # The whole pass determines the last pose over the tag better.
            if poses is not None and self.last_tag is not None and self.last_tag[0] == tag_id:
                self.last_tag = (*self.last_tag[:2], poses.select(slice(-1, None)))
            return []
        self.reported[key] = observation
        detection = observation.detection(self.device, samples.time_ns, self.names[id(tags)])
        events: list[StreamEvent] = [DetectionEvent(self.device, time_ns, detection)]
        if observation.unexplained:
            message = (
                f"{len(observation.unexplained)} further magnets near tag {tag_id} belong to no tag"
            )
            events += self._warn(time_ns, "other_magnets", message, f"other_magnets {key}")
        pose = self._tag_pose(observation)
        if pose is None:
            location = f"in the frame of {self._frame}" if self.first_tag else "on the site"
            message = f"tag {tag_id} has no position {location}"
            return events + self._warn(time_ns, "tag_not_on_site", message, message)
        if poses is None:
            return events
        events.append(self._fix(current.magnets, poses))
        if self.first_tag is None:
            events += self._correct_heading(time_ns, tag_id, pose)
            self.last_tag = (tag_id, pose, poses.select(slice(-1, None)))
        return events

    @property
    def _frame(self) -> str:
        """Name of the frame of the fixes."""
        return "site" if self.first_tag is None else f"tag-{self.first_tag[1]}"

    def _tag_pose(self, observation: TagObservation) -> PlanarPose | None:
        """Return the pose of a tag in the frame of the fixes; None if it is not known."""
        if any(tags.site for tags in self.designs):
            return observation.site_pose
        assert observation.tag_id is not None
        key = (id(observation.tags), observation.tag_id)
        if self.first_tag is None:
            self.first_tag = key
        return PlanarPose(0.0, 0.0, 0.0) if key == self.first_tag else None

    def _poses(self, samples: Samples, observation: TagObservation) -> PlanarPoses | None:
        """Return the poses over a tag; None if there are none."""
        pose = self._tag_pose(observation)
        poses = None if pose is None else poses_over_tag(samples, observation, pose)
        return poses if poses is not None and len(poses.time_ns) else None

    def _fix(self, magnets: DetectedMagnets, poses: PlanarPoses) -> Fix:
        """Return the pose of a pass that serves a filter best (see the module)."""
        variance = poses.covariance[:, 0, 0] + poses.covariance[:, 1, 1]
        row = int(np.flatnonzero(variance <= MAX_VARIANCE_RATIO * variance.min())[-1])
        if not magnets.is_path_estimated:
            row = int(np.abs(poses.time_ns - magnets.time_ns).argmin())
        return Fix(
            device=self.device,
            frame=self._frame,
            time_ns=int(poses.time_ns[row]),
            position=poses.position[row],
            quaternion=quaternion_from_heading(poses.heading[row : row + 1])[0],
            covariance=poses.covariance[row],
        )

    def _correct_heading(self, time_ns: int, tag_id: int, pose: PlanarPose) -> list[StreamEvent]:
        """Return the rotation from the tag before to this one, if both are on the site."""
        if self.last_tag is None or self.last_tag[1] == pose:
            return []
        from_tag, _, last = self.last_tag
        correction = heading_correction(self.device, from_tag, last, tag_id, pose)
        return [] if correction is None else [DetectionEvent(self.device, time_ns, correction)]

    def _warn(self, time_ns: int, code: str, message: str, key: str = "") -> list[StreamEvent]:
        """Return a warning about the device, once for each key."""
        warning = SolverWarning(code, message).about(self.device)
        return self._report(time_ns, warning, key or code)

    def _report(self, time_ns: int, warning: SolverWarning, key: str) -> list[StreamEvent]:
        """Return a warning, once for each key."""
        if key in self.warned or len(self.warned) >= MAX_WARNINGS:
            return []
        self.warned.add(key)
        return [WarningEvent(self.device, time_ns, warning)]
