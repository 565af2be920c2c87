"""Detection of the magnets of one pass: matched filter, then maximum-likelihood fits.

Several speeds and heights are tried. For each, a matched filter proposes magnets, the fit improves
them together with the path of the array, and the filter searches the residual for more. The
hypotheses that explain the samples best are refined first. Sources that turn out to be too weak
(iron debris, a magnet of another kind) stay in the fit but are not reported as magnets.

The matched filter resamples the pass to rows of a quarter of the height over the magnets, so that
one set of templates per height serves every speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from locatk.core.errors import DegenerateError
from locatk.core.polaris.array import Samples
from locatk.core.polaris.detection.field_model import MagnetOffsets
from locatk.core.polaris.detection.fit import (
    BUILD_NUISANCES,
    MAX_MOTION_RESIDUAL_SIGMAS,
    PassFit,
    PassState,
    fit_coarse,
    fit_pass,
)
from locatk.core.polaris.detection.motion import Motion
from locatk.core.polaris.detection.window import (
    PassPriors,
    PassWindow,
    PreparedPass,
    begin_at_level,
    prepare_pass,
    time_hypotheses,
    trend_basis,
)
from locatk.core.polaris.magnets import DetectedMagnets
from locatk.core.polaris.preprocessing import PassRange, PreprocessedSamples
from locatk.core.polaris.tag import Tags
from locatk.core.robust import SIGMA_PER_MEDIAN_ABSOLUTE
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]

ROW_HEIGHTS = 0.25
"""Distance of the rows along the track, in heights: a magnet's field is smooth over it."""

TEMPLATE_HALF_LENGTH_HEIGHTS = 3.0
"""Half length of a template along the track, in heights; the field has fallen to some percent."""

COLUMN_HEIGHTS = 0.5
"""Distance of the candidate positions across the track, in heights."""

SIDE_MARGIN_HEIGHTS = 1.5
"""Distance beyond the last sensor up to which magnets are searched for, in heights."""

MIN_HEIGHT_M = 1e-3
"""Least height of the sensors over the magnets in a fit that is continued [m]: below, they would be
inside of the magnets of the published tags."""

MAX_ROWS = 100_000
"""Number of rows of a pass beyond which a fit has diverged: those of 100 m at a height of 4 mm."""

MIN_SENSORS_WITH_SHARED_FIELD = 5
"""Number of sensors from which a field that all share is separated from magnets: each magnet is
out of range of some of them."""

MIN_MAGNET_ENERGY = 80.0
"""Least sum of squares of the samples, in units of their noise, that a magnet must explain. Noise
alone reaches 45 among the thousands of positions of a pass."""

MIN_ENERGY_FRACTION = 0.02
"""Least energy of a magnet relative to the most energetic one detected before it."""

SPEED_MAGNETS = 3
"""Number of magnets by which speeds and heights are compared."""

TRIED_STEPS_M = np.geomspace(0.02e-3, 10e-3, 14)
"""Distances moved in a sample period that are tried [m]."""

MAX_PASS_LENGTH_M = 2.0
"""Maximum length of a pass [m]."""

LAST_RESORT_EFFORT_FRACTION = 0.25
"""Work that the fit of a grid of magnets may take, relative to that of all other fits."""

MAX_INITIAL_GUESSES = 4
"""Number of initial guesses that are refined."""

MAX_FORWARD_REMAINING = 0.5
"""Fraction of the samples' squares that the first magnets leave unexplained, from which the array
may have moved backward."""

SEARCH_SHARED_FIELD_T = 3e-6
"""Standard deviation of a field that all sensors share (motors, rotation in the Earth's field) that
is allowed for while magnets are searched for [T]."""

MAX_GROWTH_ROUNDS = 4
"""Maximum number of searches of the residual for more magnets."""

MAX_NEW_SOURCES = 4
"""Maximum number of sources that are added at once."""

MAX_WORTHWHILE_RESIDUAL_RATIO = 0.95
"""Ratio of the rms residual after to before above which a further attempt is not worthwhile."""

WHITE_RESIDUAL_SIGMAS = 1.6
"""Rms residual, in standard deviations of the noise, up to which no other guess is needed."""

UNRELATED_RESIDUAL_SIGMAS = 3.0
"""Rms residual from which a model does not describe the samples at all."""

MAX_GIVEN_PATH_RESIDUAL_RATIO = 1.2
"""Largest rms residual with a given path, relative to that with a free one. With 0.5 uT of noise,
paths that are 3 to 4 % too short or too long reach it, and the spacing of a tag corrects smaller
errors. True paths reach 1.00 in simulation, and on the published runs."""

DEBRIS_RESIDUAL_SIGMAS = 1.3
"""Rms residual above which weak sources are added as well."""

NEW_SOURCE_RESIDUAL_FACTOR = 12.0
"""Least energy of a source in a residual, relative to the residual's mean square."""

DRIFT_TREND_TERMS = 5
"""Terms of a background that drifts more than a straight line."""

MAX_DRIFT_SQUARE = 6.0
"""Mean square of the slow part of a residual, in units of the noise, from which the background gets
more terms; 1 is expected of noise."""

MAX_SHARED_SQUARE = 2.0
"""Mean square of the part of a residual that all sensors share, in units of the noise, from which a
shared field is estimated; 1 is expected of noise."""

MIN_MOMENT_RATIO = 0.4
"""Least moment of a magnet relative to the median of the tag's magnets; weaker ones are debris."""

MIN_INITIAL_MOMENT_RATIO = 0.25
"""Least moment of an initial magnet relative to the strongest."""

MIN_SOURCE_MOMENT_RATIO = 0.03
"""Least moment of any source relative to the strongest."""

MAX_MOMENT_RATIO = 3.0
"""Largest moment, relative to the expected one, that enters the median of the tag's magnets."""

MERGE_DISTANCE_HEIGHTS = 0.6
"""Distance of two sources below which they are one, in heights."""

INITIAL_SEPARATION_HEIGHTS = 1.2
"""Least distance of two initial magnets, in heights: a closer one only corrects the shape of the
other's field."""

HIDDEN_DEBRIS_ANGLE, HIDDEN_DEBRIS_POSITION = 1.0, 0.25
"""Variances of a magnet's direction, and of its x and y in squared heights, by a layer of dipoles
of any direction whose mean square moment on a squared height is that of the magnet. They are
integrals of the least-squares solution for one magnet over the plane of the sensors."""

MAX_PATH_STEP_HEIGHTS = 3.0
"""Largest deviation of a step from the mean one between two samples over the magnets, in heights:
samples that are farther apart have no field in common. The published recordings lose samples over
up to 1.1 heights."""

MIN_RADIUS_M, MAX_ATTITUDE_RAD = 0.08, np.radians(5.0)
"""Least radius of the path, and largest attitude of the array, at which simulated tags of five
magnets and a spacing of 40 mm are read: none at 70 mm, and few from 6 degrees on."""

RECENT_GROUPS = 6
"""Number of averaged samples whose speed the array is assumed to keep after them."""

DEFAULT_SKEW_PERIODS = 0.2
"""Initial skew if the expected one is half a sample period or more."""


@dataclass(frozen=True)
class MagnetHypothesis:
    """Explanation of one pass by magnets.

    Attributes
    ----------
    prepared : PreparedPass
    fit : PassFit
    magnets : DetectedMagnets
        The magnets of the fit in the array's frame.
    """

    prepared: PreparedPass
    fit: PassFit
    magnets: DetectedMagnets


@dataclass(frozen=True)
class RunningPass:
    """Coarse fit of a pass that has not ended yet.

    Attributes
    ----------
    prepared : PreparedPass
    priors : PassPriors
    coarse : PassFit
    """

    prepared: PreparedPass
    priors: PassPriors
    coarse: PassFit

    def coarse_magnets(self) -> DetectedMagnets:
        """Return the magnets of the coarse fit, without covariance, in its frame.

        Raises
        ------
        DegenerateError
            There are none under the bar.
        """
        state = self.coarse.state
        chosen = _magnet_indices(self.prepared, self.coarse)
        moment = state.moment_am2[chosen]
        return DetectedMagnets(
            time_ns=0,
            first=self.prepared.first,
            stop=self.prepared.first + self.prepared.sample_count,
            path_m=state.path_m,
            position_m=state.position_m[chosen],
            angle_rad=np.arctan2(moment[:, 1], moment[:, 0]),
            moment_am2=np.hypot(moment[:, 0], moment[:, 1]),
            covariance=np.full((3 * len(chosen),) * 2, np.nan),
            path_sigma_m=np.full(len(state.path_m), np.nan),
            is_path_estimated=self.prepared.window.path_m is None,
            height_m=state.height_m,
        )


def detect_magnets(
    preprocessed: PreprocessedSamples,
    part: PassRange,
    tags: Tags | None,
    path_m: Array | None = None,
) -> Iterator[MagnetHypothesis]:
    """Yield explanations of one pass by magnets, the most promising first.

    Nothing is yielded if the pass holds no magnet. If the samples contradict the given path (lost
    samples, a start from rest), the path is estimated from the field as well.

    Parameters
    ----------
    preprocessed : PreprocessedSamples
    part : PassRange
    tags : Tags or None
        Their clearance, magnet and spacing are expected.
    path_m : (n,) ndarray, optional
        Distance that the array had moved at each sample of the recording.
    """
    for path in (path_m, None) if path_m is not None else (None,):
        prepared = prepare_pass(preprocessed.samples, part, preprocessed.noise_t, tags, path)
        for fit in _pass_fits(prepared):
            try:
                magnets = _to_array_frame(preprocessed.samples, prepared, fit)
            except DegenerateError:
                continue
            yield MagnetHypothesis(prepared, fit, magnets)


def detect_running_pass(
    preprocessed: PreprocessedSamples, part: PassRange, tags: Tags, path_m: Array | None = None
) -> RunningPass | None:
    """Detect the magnets of a pass that has not ended yet, coarsely.

    The pass must begin before the first magnet. Only the most promising initial guess is tried.

    Parameters
    ----------
    preprocessed, part, tags, path_m
        As of :func:`detect_magnets`.

    Returns
    -------
    RunningPass or None
        None if the samples hold no magnet yet, or do not determine it.
    """
    prepared = begin_at_level(
        prepare_pass(preprocessed.samples, part, preprocessed.noise_t, tags, path_m)
    )
    # A slope would be taken from the field of magnets ahead.
    level = replace(prepared, window=replace(prepared.window, trend_terms=1))
    try:
        guesses = _timed_guesses(level)
        if not guesses:
            return None
        timed, guess = guesses[0]
        fit = _grow_coarse_fit(timed, guess)
    except DegenerateError:
        return None
    window = replace(timed.window, trend_terms=prepared.window.trend_terms)
    return RunningPass(replace(timed, window=window), guess.priors, fit)


def extend_running_pass(
    preprocessed: PreprocessedSamples,
    part: PassRange,
    tags: Tags,
    before: MagnetHypothesis,
    path_m: Array | None = None,
) -> RunningPass | None:
    """Fit the magnets of a hypothesis, coarsely, to more samples of its pass.

    Parameters
    ----------
    preprocessed, part, tags, path_m
        As of :func:`detect_magnets`; the pass has the same first sample as before.
    before : MagnetHypothesis

    Returns
    -------
    RunningPass or None
        None if the samples do not determine the magnets any more.
    """
    prepared = prepare_pass(preprocessed.samples, part, preprocessed.noise_t, tags, path_m)
    old, state, index = before.prepared, before.fit.state, prepared.group_index
    if prepared.window.path_m is not None and old.window.path_m is not None:
        path = prepared.window.path_m + (state.path_m[0] - old.window.path_m[0])
    else:
        path = np.interp(index, old.group_index, state.path_m)
        last = min(RECENT_GROUPS, len(state.path_m) - 1)
        step = state.path_m[-1] - state.path_m[-1 - last]
        step /= old.group_index[-1] - old.group_index[-1 - last]
        path += np.maximum(index - old.group_index[-1], 0.0) * step
    priors = prepared.priors[0]
    try:
        fit = fit_coarse(prepared.window, replace(state, path_m=path), priors)
    except DegenerateError:
        return None
    return RunningPass(prepared, priors, fit)


def refine_running_pass(samples: Samples, running: RunningPass) -> MagnetHypothesis:
    """Return the final fit of a pass as far as it has been recorded.

    Raises
    ------
    DegenerateError
        The samples do not determine the magnets.
    """
    fit = _refine_fit(running.prepared, running.priors, running.coarse)
    magnets = _to_array_frame(samples, running.prepared, fit)
    return MagnetHypothesis(running.prepared, fit, magnets)


def detect_magnets_at(
    samples: Samples, hypothesis: MagnetHypothesis, positions_m: Array
) -> MagnetHypothesis:
    """Fit a pass again with a source at each given position; weak ones are dropped.

    Parameters
    ----------
    samples : Samples
    hypothesis : MagnetHypothesis
        Explanation whose path and height are the initial guess.
    positions_m : (K, 2) ndarray
        In the frame of the hypothesis' magnets.

    Raises
    ------
    DegenerateError
        The samples do not determine the magnets.
    """
    prepared, magnets = hypothesis.prepared, hypothesis.magnets
    window, priors = prepared.window, prepared.priors[0]
    # The grid of a dense tag is the last resort, and has effort of its own.
    window.effort.limit = window.effort.spent + LAST_RESORT_EFFORT_FRACTION * window.effort.limit
    # Nuisances of a fit without some of the magnets may have replaced them.
    state = replace(
        hypothesis.fit.state,
        position_m=to_fit_frame(magnets, positions_m),
        moment_am2=np.zeros((len(positions_m), 3)),
        crab_rad=0.0,
        motion=None,
        free=frozenset(),
    )
    coarse = fit_coarse(window, state, priors)
    moment = _horizontal_moments(coarse.state)
    is_strong = moment > MIN_MOMENT_RATIO * np.median(np.sort(moment)[-3:])
    state = _select_sources(coarse.state, is_strong)
    fit = fit_pass(window, _without_spurious_sources(state, prepared), priors)
    again = replace(_to_array_frame(samples, prepared, fit), warnings=magnets.warnings)
    return MagnetHypothesis(prepared, fit, again)


def bar_in_frame(magnets: DetectedMagnets, state: PassState) -> float:
    """Return the x of the bar [m] at the last sample of a fit, in the frame of the magnets."""
    poses = (state.motion or Motion.straight(state.path_m, 0.0, state.height_m)).poses(
        state.path_m[-1:], state.crab_rad
    )
    offset = poses.position_m[0, :2] - magnets.origin_m
    return float((offset @ _rotation(magnets.origin_heading_rad))[0])


def to_fit_frame(magnets: DetectedMagnets, positions_m: Array) -> Array:
    """Return positions (K, 2) in the frame of the fit from those in the frame of the magnets."""
    return np.asarray(positions_m @ _rotation(-magnets.origin_heading_rad) + magnets.origin_m)


# ---- matched filter


@dataclass(frozen=True)
class MagnetCandidate:
    """Magnet found by the matched filter.

    Attributes
    ----------
    position_m, moment_am2 : (2,) ndarray
    energy : float
        Squares of the samples, in units of their noise, that it explains.
    """

    position_m: Array
    moment_am2: Array
    energy: float


def subtract_shared_field(fields: Array) -> Array:
    """Subtract from fields (N, ...) the part that all sensors of the bar share.

    It is the Earth's field, which rotates with the robot, and that of its motors. Fields of a bar
    with few sensors are returned unchanged.
    """
    if len(fields) < MIN_SENSORS_WITH_SHARED_FIELD:
        return fields
    return fields - fields.mean(axis=0)


class MatchedFilter:
    """Templates of one magnet for an array at one height.

    Parameters
    ----------
    sensors_m : (N, 3) ndarray
    noise_t : (N, 3) ndarray
    height_m : float
    """

    def __init__(self, sensors_m: Array, noise_t: Array, height_m: float) -> None:
        self.row_m = ROW_HEIGHTS * height_m
        self.half_rows = round(TEMPLATE_HALF_LENGTH_HEIGHTS / ROW_HEIGHTS)
        self.channels = 3 * len(sensors_m)
        along = np.arange(-self.half_rows, self.half_rows + 1) * self.row_m
        left, right = sensors_m[:, 1].max(), sensors_m[:, 1].min()
        margin = SIDE_MARGIN_HEIGHTS * height_m
        count = int(np.ceil((left - right + 2 * margin) / (COLUMN_HEIGHTS * height_m))) + 1
        self.across_m = np.linspace(right - margin, left + margin, count)
        shape = (len(sensors_m), 3, len(along), count)
        offsets = MagnetOffsets.from_components(
            np.broadcast_to((sensors_m[:, 0, None] + along)[:, None, :, None], shape),
            (sensors_m[:, 1:2] - self.across_m)[:, None, None],
            height_m,
        )
        fields = offsets.unit_fields()[..., :2] / noise_t[:, :, None, None, None]
        # From (N, axis, rows, columns, moment) to columns x (rows, N, axis) x moment.
        templates = subtract_shared_field(fields).transpose(2, 0, 1, 3, 4)
        templates = np.ascontiguousarray(templates.reshape(-1, count, 2).transpose(1, 0, 2))
        # Orthonormal for each position, so that energies are sums of squares.
        self.triangle = np.linalg.cholesky(templates.transpose(0, 2, 1) @ templates)
        templates = templates @ np.linalg.inv(self.triangle).transpose(0, 2, 1)
        self.templates = np.hstack([templates[:, :, 0].T, templates[:, :, 1].T]).astype(np.float32)

    def find_magnets(
        self, path_m: Array, scaled: Array, max_count: int, min_energy: float
    ) -> tuple[list[MagnetCandidate], float]:
        """Find magnets one after the other, the strongest first (matching pursuit).

        Parameters
        ----------
        path_m : (n,) ndarray
            Position of the array along the track.
        scaled : (n, 3 N) ndarray
            Samples in units of their noise, without background.
        max_count : int
        min_energy : float
            Energy of the weakest magnet.

        Returns
        -------
        candidates : list of MagnetCandidate
        remaining : float
            Fraction of the samples' squares that they do not explain.
        """
        row_path, rows = self._resample(path_m, scaled)
        total = float((rows.astype(float) ** 2).sum())
        candidates: list[MagnetCandidate] = []
        columns = len(self.across_m)
        residual = rows.copy()
        while len(candidates) < max_count:
            products = self._correlate(residual)
            energies = products[:, 0] ** 2 + products[:, 1] ** 2
            row, column = divmod(int(np.argmax(energies)), columns)
            energy = float(energies[row, column])
            if energy < min_energy:
                break
            min_energy = max(min_energy, MIN_ENERGY_FRACTION * energy)
            product = products[row, :, column]
            position = np.array([row_path[row], self.across_m[column]])
            moment = np.linalg.solve(self.triangle[column].T, product)
            candidates.append(MagnetCandidate(position, moment, energy))
            explained = self.templates[:, [column, column + columns]] @ product
            low, high = max(row - self.half_rows, 0), min(row + self.half_rows + 1, len(residual))
            start = low - row + self.half_rows
            explained = explained.reshape(-1, self.channels)
            residual[low:high] -= explained[start : start + high - low]
        remaining = float((residual.astype(float) ** 2).sum())
        return candidates, remaining / max(total, 1e-30)

    def _resample(self, path_m: Array, scaled: Array) -> tuple[Array, NDArray[np.float32]]:
        """Return the positions of rows (R,) along the track, and mean samples (R, 3 N) there."""
        order = np.argsort(path_m, kind="stable")
        by_sensor = scaled[order].reshape(len(order), -1, 3).swapaxes(0, 1)
        scaled = subtract_shared_field(by_sensor).swapaxes(0, 1).reshape(len(order), -1)
        # Strictly ascending, also while the array rests.
        path = path_m[order] + 1e-9 * np.arange(len(path_m))
        length = (path[-1] - path[0]) / self.row_m
        if not length < MAX_ROWS:
            raise DegenerateError("the samples do not determine the path of the pass")
        count = max(int(length), 1)
        edges = path[0] + self.row_m * np.arange(count + 1)
        middle = (path[1:] + path[:-1]) / 2
        borders = np.concatenate([[path[0]], middle, [path[-1]]])
        width = np.diff(borders)[:, None]
        integral = np.vstack([np.zeros(scaled.shape[1]), np.cumsum(scaled * width, axis=0)])
        sample = np.clip(np.searchsorted(borders, edges, "right") - 1, 0, len(scaled) - 1)
        value = integral[sample] + scaled[sample] * (edges - borders[sample])[:, None]
        rows = np.diff(value, axis=0) / self.row_m
        return (edges[1:] + edges[:-1]) / 2, rows.astype(np.float32)

    def _correlate(self, rows: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the products (R, 2, columns) of the templates with the samples around each row.

        Their squares are the energy that a magnet there would explain.
        """
        padded = np.pad(rows, ((self.half_rows, self.half_rows), (0, 0)))
        size = (2 * self.half_rows + 1) * self.channels
        windows = np.lib.stride_tricks.as_strided(
            padded, (len(rows), size), (padded.strides[0], padded.strides[1])
        )
        return (windows @ self.templates).reshape(len(rows), 2, -1)


# ---- initial guesses


@dataclass(frozen=True)
class _InitialGuess:
    """Speed and height, with the fraction of the samples' squares that they leave unexplained."""

    priors: PassPriors
    state: PassState
    remaining: float
    matched_filter: MatchedFilter


def _initial_guesses(prepared: PreparedPass, direction: float) -> list[_InitialGuess]:
    """Return an initial guess for each speed and height.

    ``direction`` is 1 for an array that moves forward, -1 for one that moves backward.
    """
    guesses = []
    window = prepared.window
    for priors in prepared.priors:
        height = priors.height_m[0]
        matched_filter = MatchedFilter(window.sensors_m, window.noise_t, height)
        if window.path_m is not None:
            duration = max(np.ptp(window.time_periods), 1e-9)
            paths = [(window.path_m, float(np.ptp(window.path_m) / duration))]
        else:
            duration = window.time_periods[-1] - window.time_periods[0]
            time = window.time_periods - window.time_periods.mean()
            paths = [
                (direction * step * time, direction * step)
                for step in TRIED_STEPS_M
                if 2 * height < step * duration < MAX_PASS_LENGTH_M
            ]
        for path, step in paths:
            candidates, remaining = matched_filter.find_magnets(
                path, prepared.scaled, SPEED_MAGNETS, MIN_MAGNET_ENERGY
            )
            if candidates:
                state = _initial_state(candidates, path, step, priors)
                guesses.append(_InitialGuess(priors, state, remaining, matched_filter))
    return guesses


def _initial_state(
    candidates: list[MagnetCandidate], path: Array, mean_step: float, priors: PassPriors
) -> PassState:
    """Return the state with the magnets of the matched filter; its path is 0 in the middle."""
    middle = int(np.argmin(np.abs(path - np.median(path))))
    skew = priors.skew_periods[0]
    return PassState(
        position_m=np.array([candidate.position_m for candidate in candidates]),
        moment_am2=np.array([[*candidate.moment_am2, 0.0] for candidate in candidates]),
        path_m=path - path[middle],
        mean_step_m=mean_step,
        height_m=priors.height_m[0],
        skew_periods=skew if skew < 0.5 else DEFAULT_SKEW_PERIODS,
    )


def _pass_fits(prepared: PreparedPass) -> Iterator[PassFit]:
    """Yield fits of a pass, one per initial guess; nothing if the pass holds no magnet.

    The speeds, heights and time axes that explain the samples best come first.
    """
    least = np.inf
    for timed, guess in _timed_guesses(prepared)[:MAX_INITIAL_GUESSES]:
        if prepared.window.effort.is_exhausted:
            return
        try:
            fit = _grow_fit(timed, guess)
        except DegenerateError:
            continue
        yield fit
        is_residual_moderate = WHITE_RESIDUAL_SIGMAS < least < UNRELATED_RESIDUAL_SIGMAS
        if is_residual_moderate and fit.rms_sigma > MAX_WORTHWHILE_RESIDUAL_RATIO * least:
            return  # Another initial guess does not reduce the residual.
        least = min(least, fit.rms_sigma)


def _timed_guesses(prepared: PreparedPass) -> list[tuple[PreparedPass, _InitialGuess]]:
    """Return the initial guesses for each time axis, those that leave least unexplained first.

    An array that moves backward is considered only if forward travel explains little: no magnets
    have the field of magnets that are passed in the other direction.
    """
    guesses: list[tuple[PreparedPass, _InitialGuess]] = []
    for direction in (1.0, -1.0) if prepared.window.path_m is None else (1.0,):
        for timed in time_hypotheses(prepared):
            guesses += [(timed, guess) for guess in _initial_guesses(timed, direction)]
        guesses.sort(key=lambda pair: pair[1].remaining)
        if guesses and guesses[0][1].remaining < MAX_FORWARD_REMAINING:
            break
    return guesses


# ---- growing a fit


def _grow_fit(prepared: PreparedPass, guess: _InitialGuess) -> PassFit:
    """Fit from one initial guess; magnets are added until the residual holds no more."""
    return _refine_fit(prepared, guess.priors, _grow_coarse_fit(prepared, guess))


def _grow_coarse_fit(prepared: PreparedPass, guess: _InitialGuess) -> PassFit:
    """Fit coarsely from one initial guess, with all magnets that are found."""
    state = guess.state
    candidates, _ = guess.matched_filter.find_magnets(
        state.path_m, prepared.scaled, prepared.max_sources, MIN_MAGNET_ENERGY
    )
    separate = _separate_candidates(candidates, state.height_m)
    state = _initial_state(separate, state.path_m, state.mean_step_m, guess.priors)
    return _add_missed_sources(
        prepared, guess.priors, fit_coarse(_coarse_window(prepared), state, guess.priors)
    )


def _coarse_window(prepared: PreparedPass) -> PassWindow:
    """Return the window of a coarse fit, which allows for a field that all sensors share."""
    window = prepared.window
    has_shared_field = len(window.sensors_m) >= MIN_SENSORS_WITH_SHARED_FIELD
    return replace(window, common_t=SEARCH_SHARED_FIELD_T if has_shared_field else 0.0)


def _add_missed_sources(prepared: PreparedPass, priors: PassPriors, fit: PassFit) -> PassFit:
    """Add sources to a coarse fit until its residual holds no more."""
    for _ in range(MAX_GROWTH_ROUNDS):
        missed = _find_missed_sources(prepared, fit)
        if not missed or prepared.window.effort.is_exhausted:
            break
        before = fit
        fit = fit_coarse(_coarse_window(prepared), _with_sources(fit.state, missed), priors)
        if fit.rms_sigma > MAX_WORTHWHILE_RESIDUAL_RATIO * before.rms_sigma:
            break
    return fit


def _refine_fit(prepared: PreparedPass, priors: PassPriors, fit: PassFit) -> PassFit:
    """Return the final fit of the magnets of a coarse one, without those that are spurious."""
    window = prepared.window
    if window.path_m is not None and fit.rms_sigma > UNRELATED_RESIDUAL_SIGMAS:
        raise DegenerateError("the samples contradict the given path")
    # Only a fit that allows for a shared field shows how large it is.
    has_shared_field = len(window.sensors_m) >= MIN_SENSORS_WITH_SHARED_FIELD
    if has_shared_field and fit.shared_square > max(MAX_SHARED_SQUARE, 2 * fit.rms_sigma**2):
        information = np.mean(1 / window.noise_t**2) * len(window.sensors_m)
        window = replace(window, common_t=float(np.sqrt((fit.shared_square - 1) / information)))
    state = _without_spurious_sources(fit.state, prepared)
    if window.path_m is not None and _is_path_contradicted(window, state, priors):
        raise DegenerateError("the samples contradict the given path")
    while True:
        fit = fit_pass(window, state, priors)
        if _has_drift(window, fit):
            window = replace(window, trend_terms=DRIFT_TREND_TERMS)
            fit = fit_pass(window, fit.state, priors)
        moment = _horizontal_moments(fit.state)
        # Magnets of a dense tag are correlated, and need not be significant alone.
        is_significant = fit.significance > MIN_MAGNET_ENERGY
        is_significant |= moment > MIN_MOMENT_RATIO * moment.max()
        state = _without_spurious_sources(_select_sources(fit.state, is_significant), prepared)
        is_complete = len(state.position_m) == len(fit.state.position_m)
        if is_complete or window.effort.is_exhausted:
            break
    return fit


def _is_path_contradicted(window: PassWindow, state: PassState, priors: PassPriors) -> bool:
    """Return whether a free path explains the samples better than the given one.

    Motions of the bar would explain a wrong path as well, and are left out of the comparison.
    """
    given = fit_pass(window, state, priors, BUILD_NUISANCES)
    # From the given path, a free one leads to the nearest path that the samples prefer.
    free = fit_pass(replace(window, path_m=None), given.state, priors, BUILD_NUISANCES)
    return given.rms_sigma > MAX_GIVEN_PATH_RESIDUAL_RATIO * free.rms_sigma


def _separate_candidates(
    candidates: list[MagnetCandidate], height_m: float
) -> list[MagnetCandidate]:
    """Return candidates, ordered by strength, without weak ones and neighbours of stronger ones."""
    separate: list[MagnetCandidate] = []
    strongest = np.hypot(*candidates[0].moment_am2)
    limit = INITIAL_SEPARATION_HEIGHTS * height_m
    for candidate in candidates:
        is_near = any(
            np.linalg.norm(candidate.position_m - other.position_m) < limit for other in separate
        )
        is_strong = np.hypot(*candidate.moment_am2) > MIN_INITIAL_MOMENT_RATIO * strongest
        if is_strong and not is_near:
            separate.append(candidate)
    return separate


def _find_missed_sources(prepared: PreparedPass, fit: PassFit) -> list[MagnetCandidate]:
    """Return the sources that the residual of a fit still holds."""
    window, state = prepared.window, fit.state
    if state.height_m < MIN_HEIGHT_M:
        # The resolution of the filter follows the height: it would take hours.
        raise DegenerateError("the samples do not determine the height of the sensors")
    matched_filter = MatchedFilter(window.sensors_m, window.noise_t, state.height_m)
    residual = np.nan_to_num(fit.residual / np.sqrt(window.counts)[:, None, None])
    candidates, _ = matched_filter.find_magnets(
        state.path_m,
        residual.reshape(len(window.time_periods), -1),
        min(MAX_NEW_SOURCES, prepared.max_sources - len(state.position_m)),
        max(MIN_MAGNET_ENERGY, NEW_SOURCE_RESIDUAL_FACTOR * fit.rms_sigma**2),
    )
    # Weak sources cost time and accuracy; they are added only if the residual asks for them.
    min_moment = 0.0
    if fit.rms_sigma <= DEBRIS_RESIDUAL_SIGMAS:
        min_moment = 0.5 * MIN_MOMENT_RATIO * float(np.median(_horizontal_moments(state)))
    limit = MERGE_DISTANCE_HEIGHTS * state.height_m
    candidates = [_in_floor_frame(candidate, state) for candidate in candidates]
    return [
        candidate
        for candidate in candidates
        if np.hypot(*candidate.moment_am2) > min_moment
        and np.all(np.linalg.norm(state.position_m - candidate.position_m, axis=1) > limit)
    ]


def _in_floor_frame(candidate: MagnetCandidate, state: PassState) -> MagnetCandidate:
    """Return a candidate whose position is along and across a path in the frame of the fit."""
    if state.motion is None or state.motion.is_straight:
        return candidate
    along, across = candidate.position_m
    poses = state.motion.poses(np.array([along]), state.crab_rad)
    axes = poses.rotation[0, :2, :2]
    return replace(
        candidate,
        position_m=poses.position_m[0, :2] + axes @ [0.0, across],
        moment_am2=axes @ candidate.moment_am2,
    )


def _along_and_across(state: PassState) -> tuple[Array, Array]:
    """Return the positions (M,), (M,) of the sources along the path, and across the bar there.

    On a curve they belong to the sample at which the source was nearest to the bar.
    """
    poses = state.bar_poses
    if poses is None:
        return state.position_m[:, 0], state.position_m[:, 1]
    offset = state.position_m[:, None] - poses.position_m[:, :2]
    local = np.einsum("mni,nij->mnj", offset, poses.rotation[:, :2, :2])
    nearest = np.abs(local[..., 0]).argmin(axis=1)
    chosen = local[np.arange(len(local)), nearest]
    return state.path_m[nearest] + chosen[:, 0], chosen[:, 1]


def _rotation(angle_rad: float) -> Array:
    """Return the matrix (2, 2) that turns row vectors into axes turned by the angle."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _has_drift(window: PassWindow, fit: PassFit) -> bool:
    """Return whether the residual holds slow trends beyond the terms of the background.

    In units of the noise, a white residual has a mean square of 1 along each trend.
    """
    if window.trend_terms >= DRIFT_TREND_TERMS:
        return False
    residual = np.nan_to_num(fit.residual).reshape(len(window.time_periods), -1)
    basis = np.linalg.qr(trend_basis(window.time_periods, DRIFT_TREND_TERMS))[0]
    projection = basis[:, window.trend_terms :].T @ residual
    return bool((projection**2).mean() > MAX_DRIFT_SQUARE)


def _horizontal_moments(state: PassState) -> Array:
    """Return the magnitudes (M,) of the horizontal moments."""
    return np.hypot(state.moment_am2[:, 0], state.moment_am2[:, 1])


def _select_sources(state: PassState, chosen: NDArray[np.bool_] | list[int]) -> PassState:
    """Return the state with some of the sources only."""
    return replace(
        state,
        position_m=state.position_m[chosen],
        moment_am2=state.moment_am2[chosen],
    )


def _with_sources(state: PassState, candidates: list[MagnetCandidate]) -> PassState:
    """Return the state with further sources."""
    positions = [candidate.position_m for candidate in candidates]
    moments = [[*candidate.moment_am2, 0.0] for candidate in candidates]
    return replace(
        state,
        position_m=np.vstack([state.position_m, positions]),
        moment_am2=np.vstack([state.moment_am2, moments]),
    )


def _is_passed(state: PassState, sensors_m: Array, margin_heights: float) -> NDArray[np.bool_]:
    """Return which sources (M,) the array passed, up to a margin around its sensors."""
    margin = margin_heights * state.height_m
    along, across = _along_and_across(state)
    is_passed = along > state.path_m.min() + sensors_m[:, 0].min() - margin
    is_passed &= along < state.path_m.max() + sensors_m[:, 0].max() + margin
    is_passed &= across > sensors_m[:, 1].min() - margin
    is_passed &= across < sensors_m[:, 1].max() + margin
    return is_passed


def _without_spurious_sources(state: PassState, prepared: PreparedPass) -> PassState:
    """Remove sources outside of the area passed, very weak ones, and duplicates of stronger ones.

    Two magnets of a tag are at least ``prepared.min_separation_m`` apart; a weak source may be
    closer to a magnet, but not at its position.

    Raises
    ------
    DegenerateError
        No source remains.
    """
    position = state.position_m
    is_passed = _is_passed(state, prepared.window.sensors_m, SIDE_MARGIN_HEIGHTS + 0.5)
    moment = np.where(is_passed, _horizontal_moments(state), 0.0)
    by_strength = np.argsort(-moment)
    strongest = moment[by_strength[0]]
    kept: list[int] = []
    for k in by_strength:
        is_weak = moment[k] < MIN_MOMENT_RATIO * strongest
        limit = MERGE_DISTANCE_HEIGHTS * state.height_m if is_weak else prepared.min_separation_m
        distance = np.linalg.norm(position[kept] - position[k], axis=1)
        if moment[k] > MIN_SOURCE_MOMENT_RATIO * strongest and np.all(distance > limit):
            kept.append(int(k))
    if not kept:
        raise DegenerateError("no magnet is left under the bar")
    return _select_sources(state, kept)


# ---- from a fit to magnets


def _magnet_indices(prepared: PreparedPass, fit: PassFit) -> NDArray[np.intp]:
    """Return the sources that are magnets of a tag: under the bar, and not far weaker than others.

    Raises
    ------
    DegenerateError
        None is.
    """
    state = fit.state
    is_under_bar = _is_passed(state, prepared.window.sensors_m, SIDE_MARGIN_HEIGHTS)
    moment = np.where(is_under_bar, _horizontal_moments(state), 0.0)
    expected = prepared.priors[0].moment_am2
    is_usual = moment > MIN_MOMENT_RATIO / 2 * expected
    usual = moment[is_usual & (moment < MAX_MOMENT_RATIO * expected)]
    if len(usual) == 0:
        usual = moment[moment > MIN_MOMENT_RATIO * moment.max()]
    if len(usual) == 0:
        raise DegenerateError("no magnet is left under the bar")
    return np.flatnonzero(moment > MIN_MOMENT_RATIO * np.median(usual))


def _debris_covariance(prepared: PreparedPass, fit: PassFit, magnets: NDArray[np.intp]) -> Array:
    """Return the covariance (3 M, 3 M) of magnets by debris that is hidden under them.

    Debris that was detected between the magnets shows how much of it is on the floor. What is
    closer to a magnet than :data:`INITIAL_SEPARATION_HEIGHTS` changes its field, and is taken for
    another position and moment of the magnet.
    """
    state, sensors = fit.state, prepared.window.sensors_m
    moment = _horizontal_moments(state)
    debris = np.setdiff1d(np.arange(len(moment)), magnets)
    debris = debris[moment[debris] < MIN_MOMENT_RATIO * np.median(moment[magnets])]
    width = np.ptp(sensors[:, 1]) + 2 * SIDE_MARGIN_HEIGHTS * state.height_m
    # Two of three components of a moment of any direction are horizontal.
    density = 1.5 * (moment[debris] ** 2).sum() / (width * np.ptp(state.path_m))
    angle = HIDDEN_DEBRIS_ANGLE * density * state.height_m**2 / moment[magnets] ** 2
    place = HIDDEN_DEBRIS_POSITION * density * state.height_m**4 / moment[magnets] ** 2
    return np.diag(np.column_stack([place, place, angle]).ravel())


def _require_continuous_path(
    prepared: PreparedPass, state: PassState, chosen: NDArray[np.intp]
) -> None:
    """Check that the path over the magnets has no step that no field bridges.

    Raises
    ------
    DegenerateError
        The magnets before and after such a step have no common frame.
    """
    along = _along_and_across(state)[0][chosen]
    # Without single samples that were disturbed.
    path = median_filter(state.path_m, 5)
    excess = np.diff(path) - state.mean_step_m * np.diff(prepared.window.time_periods)
    low, high = np.minimum(path[1:], path[:-1]), np.maximum(path[1:], path[:-1])
    # Beyond the fields of the first and of the last magnet, nothing holds the path.
    is_over = low > along.min() - state.height_m
    is_over &= high < along.max() + state.height_m
    is_large = np.abs(excess) > MAX_PATH_STEP_HEIGHTS * state.height_m
    if prepared.window.path_m is None and np.any(is_over & is_large):
        raise DegenerateError("the path over the magnets is interrupted")


def _path_sigma(fit: PassFit, noise_factor: float) -> Array:
    """Return the standard deviations (n,) of the path, by the residual of each sample.

    A sample that the magnets do not explain (of another time, or disturbed) has no position.
    """
    size = np.abs(fit.residual).reshape(len(fit.residual), -1)
    is_empty = ~np.isfinite(size).any(axis=1)
    size[is_empty] = 0.0
    residual = SIGMA_PER_MEDIAN_ABSOLUTE * np.nanmedian(size, axis=1)
    sigma = fit.path_sigma_m * np.maximum(residual, noise_factor)
    return np.where(residual > UNRELATED_RESIDUAL_SIGMAS, MAX_PASS_LENGTH_M, sigma)


def _to_array_frame(samples: Samples, prepared: PreparedPass, fit: PassFit) -> DetectedMagnets:
    """Return the magnets of a fit, in the array's frame at a sample near their middle."""
    state = fit.state
    # Errors of the model show in the residual.
    noise_factor = max(1.0, fit.robust_sigma)
    chosen = _magnet_indices(prepared, fit)
    _require_continuous_path(prepared, state, chosen)
    position = state.position_m[chosen]
    index = np.arange(prepared.sample_count)
    path = np.interp(index, prepared.group_index, state.path_m)
    if prepared.path_m is not None and prepared.window.path_m is not None:
        path = prepared.path_m + (state.path_m[0] - prepared.window.path_m[0])
    path_sigma = np.interp(index, prepared.group_index, _path_sigma(fit, noise_factor))
    if prepared.window.path_m is None:
        # Within a group the array may have moved evenly, or have rested.
        at_rest = np.repeat(state.path_m, prepared.window.counts.astype(int))
        path_sigma = np.hypot(path_sigma, path - at_rest)
    motion = state.motion or Motion.straight(path, 0.0, state.height_m)
    poses = motion.poses(path, state.crab_rad)
    yaw = np.arctan2(poses.rotation[:, 1, 0], poses.rotation[:, 0, 0])
    # Near the magnets' middle, but at a sample whose position is well determined: it is not if
    # the field is weak there or the sample was damaged.
    distance = np.abs(median_filter(poses.position_m[:, 0], 5) - position.mean(axis=0)[0])
    reference = int(np.argmin(distance + 3 * path_sigma))
    rows = (3 * chosen[:, None] + np.arange(3)).ravel()
    origin, heading = poses.position_m[reference, :2], float(yaw[reference])
    into_array = _rotation(heading)
    jacobian = np.eye(3)
    jacobian[:2, :2] = into_array.T
    by_magnet = np.kron(np.eye(len(chosen)), jacobian)
    covariance = by_magnet @ fit.covariance[np.ix_(rows, rows)] @ by_magnet.T
    covariance = covariance * noise_factor**2 + _debris_covariance(prepared, fit, chosen)
    moment = state.moment_am2[chosen]
    moment[:, :2] = moment[:, :2] @ into_array
    # Deviations from the pose at the reference sample.
    planar = motion.planar_derivatives(path, state.crab_rad)
    planar = planar - planar[reference]
    planar[:, :2] = into_array.T @ planar[:, :2]
    motion_covariance = planar @ fit.motion_covariance @ planar.swapaxes(1, 2) * noise_factor**2
    forward, lateral = ((poses.position_m[:, :2] - origin) @ into_array).T
    return DetectedMagnets(
        time_ns=int(samples.time_ns[prepared.first + reference]),
        first=prepared.first,
        stop=prepared.first + prepared.sample_count,
        path_m=forward,
        lateral_m=lateral,
        heading_rad=yaw - heading,
        motion_covariance=motion_covariance,
        position_m=(position - origin) @ into_array,
        angle_rad=np.arctan2(moment[:, 1], moment[:, 0]),
        moment_am2=np.hypot(moment[:, 0], moment[:, 1]),
        covariance=covariance,
        path_sigma_m=path_sigma,
        is_path_estimated=prepared.window.path_m is None,
        height_m=state.height_m,
        height_sigma_m=fit.height_sigma_m * noise_factor,
        residual_sigma=fit.rms_sigma,
        robust_residual_sigma=fit.robust_sigma,
        origin_m=origin,
        origin_heading_rad=heading,
        other_sources=len(state.position_m) - len(chosen),
        warnings=tuple(_motion_warnings(fit, path)),
    )


def _motion_warnings(fit: PassFit, path_m: Array) -> Iterator[SolverWarning]:
    """Yield a warning if the bar moved on a narrower curve, or was more tilted, than is read."""
    state = fit.state
    if state.motion is None or fit.rms_sigma > MAX_MOTION_RESIDUAL_SIGMAS:
        return
    along, _ = _along_and_across(state)
    is_over = (path_m > along.min()) & (path_m < along.max())
    if "curve" in state.free and is_over.any():
        radius = 1 / np.abs(state.motion.curvature(path_m[is_over])).max()
        if radius < MIN_RADIUS_M:
            yield SolverWarning(
                "curved_path",
                f"the path over the magnets has a radius of {radius * 1e3:.0f} mm; tags are read "
                f"from {MIN_RADIUS_M * 1e3:.0f} mm on",
            )
    attitude = state.motion.coefficients[state.motion.groups["attitude"]]
    tilt = float(np.hypot(*attitude))
    if tilt > MAX_ATTITUDE_RAD:
        yield SolverWarning(
            "tilted_array",
            f"the array is tilted by {np.degrees(tilt):.1f} degrees; tags are read up to "
            f"{np.degrees(MAX_ATTITUDE_RAD):.0f}",
        )
