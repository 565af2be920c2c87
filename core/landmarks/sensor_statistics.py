"""Running statistics of hall sensors: offsets, noise, range and dead sensors, in bounded memory.

They are the causal counterparts of what :func:`.preprocessing.preprocess` finds in a whole
recording. Medians and quantiles are those of histograms. All statistics forget: if they contain
:data:`MAX_STATISTIC_SAMPLES` samples, each of these counts half from then on.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSensors
from locatk.core.landmarks.preprocessing import (
    MAX_OFFSET_T,
    MIN_LEVELS,
    MIN_NOISE_T,
    MIN_OFFSET_SAMPLES,
    MIN_PLATEAU_READINGS,
    MIN_SPIKE_T,
    MIN_SPREAD_FRACTION,
    NOISE_QUANTILE,
    NORMAL_QUARTILE_OF_MAGNITUDE,
    UNKNOWN_NOISE_T,
)

Array = NDArray[np.float64]

MAX_STATISTIC_SAMPLES = 20_000
"""Samples after which they count half: offsets and noise are exact to a percent with them, and
drifts over minutes are followed."""

OFFSET_BIN_T = 1e-6
"""Resolution of offsets: a hundredth of their standard deviation."""

NOISE_BIN_T, NOISE_BINS = 1e-6, 4000
"""Resolution and number of the second differences from which the noise is estimated."""

UPDATE_SAMPLES = 32
"""Samples after which the results are computed again."""

MAX_LEVELS = 1024
"""Different readings that are kept in order to find the resolution of the sensors."""


class SensorStatistics:
    """Statistics of the readings of one robot.

    Attributes
    ----------
    sensors : HallSensors
    offset_t : (N,) ndarray
        Offsets of the sensors; 0 as long as too few readings are known.
    noise_t : float
        Standard deviation of a sample: as given, or from second differences.
    range_t : float
        Range of the sensors: as given, or the largest reading if many have it.
    is_silent, is_constant : (N,) ndarray
        Sensors that have reported nothing, and those that never changed, compared with the others.
    """

    def __init__(self, sensors: HallSensors) -> None:
        count = len(sensors)
        self.sensors = sensors
        self._quiet = np.zeros((count, 2 * round(MAX_OFFSET_T / OFFSET_BIN_T)))
        self._quiet_rows = 0.0
        self._second = np.zeros(NOISE_BINS + 1)
        self._last_rows = np.empty((0, count))
        self._levels = np.empty(0)
        self._moments = np.zeros((3, count))  # Sums of 1, x and x^2.
        self._largest_t, self._largest_count = 0.0, 0
        self._samples, self._updated_samples = 0, 0
        self._update()

    def _update(self) -> None:
        """Compute the results from the samples so far."""
        self._updated_samples = self._samples
        self.offset_t, self.noise_t = self._median_offsets(), self._sample_noise()
        self.range_t = self._range()
        self.is_silent = np.asarray(self._moments[0] == 0)
        self.is_constant = self._constant_sensors()

    def add_raw(self, field_t: Array) -> None:
        """Take raw readings (n, N), the newest last."""
        rows = np.concatenate([self._last_rows, field_t])
        self._last_rows = rows[-2:]
        if len(rows) > 2:
            second = np.abs(rows[2:] - 2 * rows[1:-1] + rows[:-2])
            bins = np.minimum(second[~np.isnan(second)] / NOISE_BIN_T, NOISE_BINS).astype(int)
            self._second += np.bincount(bins, minlength=NOISE_BINS + 1)
            if self._second.sum() > MAX_STATISTIC_SAMPLES * len(self.sensors):
                self._second /= 2
        values = field_t[~np.isnan(field_t)]
        if len(self._levels) < MAX_LEVELS:
            self._levels = np.unique(np.concatenate([self._levels, values]))
        largest = float(np.abs(values).max(initial=0.0))
        if largest > (1 + 1e-9) * self._largest_t:
            self._largest_t, self._largest_count = largest, 0
        self._largest_count += int((np.abs(values) > (1 - 1e-9) * self._largest_t).sum())

    def add_valid(self, field_t: Array) -> None:
        """Take readings (n, N) that are ``nan`` if they are invalid."""
        is_known = ~np.isnan(field_t)
        known = np.where(is_known, field_t, 0.0)
        self._moments += [is_known.sum(axis=0), known.sum(axis=0), (known**2).sum(axis=0)]
        if self._moments[0].max() > MAX_STATISTIC_SAMPLES:
            self._moments /= 2
        is_quiet = (np.abs(known) < MAX_OFFSET_T).all(axis=1)
        bins = np.floor((known[is_quiet] + MAX_OFFSET_T) / OFFSET_BIN_T).astype(int)
        sensor = np.broadcast_to(np.arange(len(self.sensors)), bins.shape)
        is_counted = is_known[is_quiet]
        np.add.at(self._quiet, (sensor[is_counted], bins[is_counted]), 1.0)
        self._quiet_rows += int(is_quiet.sum())
        if self._quiet_rows > MAX_STATISTIC_SAMPLES:
            self._quiet /= 2
            self._quiet_rows /= 2
        self._samples += len(field_t)
        # The first samples are few: their results change with every one of them.
        if self._samples - self._updated_samples >= min(UPDATE_SAMPLES, self._samples / 4):
            self._update()

    def _median_offsets(self) -> Array:
        """Return the offsets (N,) of the sensors."""
        total = self._quiet.sum(axis=1)
        if self._quiet_rows < MIN_OFFSET_SAMPLES:
            return np.zeros(len(total))
        median = [int(np.searchsorted(counts, counts[-1] / 2)) for counts in self._quiet.cumsum(1)]
        offset = (np.array(median) + 0.5) * OFFSET_BIN_T - MAX_OFFSET_T
        return np.where(total > 0, offset, 0.0)

    def _sample_noise(self) -> float:
        """Return the standard deviation of a sample."""
        step_t = float(np.diff(self._levels).min()) if len(self._levels) >= MIN_LEVELS else 0.0
        least_t = max(MIN_NOISE_T, step_t / math.sqrt(12))
        if self.sensors.noise_t > 0 and math.isfinite(self.sensors.noise_t):
            return max(self.sensors.noise_t, least_t)
        counts = self._second.cumsum()
        if not counts[-1]:
            return max(UNKNOWN_NOISE_T, least_t)
        quantile_t = (int(np.searchsorted(counts, NOISE_QUANTILE * counts[-1])) + 0.5) * NOISE_BIN_T
        # A second difference has the variance 1 + 4 + 1.
        return max(quantile_t / NORMAL_QUARTILE_OF_MAGNITUDE / math.sqrt(6), least_t)

    def _range(self) -> float:
        """Return the range of the sensors."""
        if math.isfinite(self.sensors.range_t):
            return self.sensors.range_t
        is_plateau = self._largest_count >= MIN_PLATEAU_READINGS
        return self._largest_t if is_plateau and self._largest_t >= MIN_SPIKE_T else math.inf

    def _constant_sensors(self) -> NDArray[np.bool_]:
        """Return which sensors (N,) never changed."""
        count, total, squares = self._moments
        count = np.maximum(count, 1e-300)
        variance = np.where(self.is_silent, np.nan, squares / count - (total / count) ** 2)
        if self.is_silent.all():
            return np.zeros(len(count), bool)
        # Rounding makes the variance of a constant as large as 1e-16 of its square.
        variance = np.maximum(variance - 1e-14 * squares / count, 0.0)
        return np.asarray(variance < MIN_SPREAD_FRACTION**2 * np.nanmax(variance))
