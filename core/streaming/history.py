"""Recent past of a filter: observations may arrive late and are processed in the order of time.

The state of a filter is a function of its motion samples and fixes in the order of their times. The
history keeps the newest of them with the state after each one. A late fix is inserted, and the
states after it are computed again, so that they equal those of in-order processing; a fix between
two motion samples divides the motion between them. A fix that is newer than the newest motion is
used at once by extrapolating the motion, and processed again when the motion becomes known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CHI2_999 = (np.nan, 10.827566, 13.815511, 16.266236, 18.466827, 20.515006, 22.457744)
"""99.9 % quantiles of the chi-squared distribution with 0 to 6 degrees of freedom. They are
tabulated because importing scipy takes long; a test compares them."""

MAX_PENDING_FIXES = 64
"""Number of fixes newer than the newest motion that are kept: those of 0.25 s at 250 per second."""


MIN_RATE_FRACTION, MIN_RATE_INTERVAL_S = 0.1, 0.002
"""Time between two samples from which their motion tells a rate: this fraction of the time between
those before, at most 2 ms, to which the times of received messages jitter."""


class FilterModel(Protocol):
    """Equations of a filter: all of its knowledge is in a state vector and a covariance.

    Attributes
    ----------
    state_size, error_size, motion_size, fix_size : int
        Lengths of the state, of the error that the covariance is of, of a motion and of a fix.
    """

    @property
    def state_size(self) -> int: ...
    @property
    def error_size(self) -> int: ...
    @property
    def motion_size(self) -> int: ...
    @property
    def fix_size(self) -> int: ...

    def unknown_state(self) -> tuple[Array, Array]:
        """Return state and covariance before any fix."""

    def part(self, motion: Array, fraction: float) -> Array:
        """Return the motion in a fraction of the duration of ``motion``; above 1 extrapolates."""

    def propagate(
        self, state: Array, covariance: Array, motion: Array, duration_s: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a motion."""

    def update(
        self, state: Array, covariance: Array, fix: Array, interpolation_s2: float
    ) -> tuple[Array, Array]:
        """Return state and covariance after a fix.

        ``interpolation_s2`` times an unknown acceleration is the error of the interpolated motion.
        """


@dataclass(frozen=True, slots=True)
class NewestState:
    """State of a filter and its covariance at a time."""

    time_ns: int
    state: Array
    covariance: Array


class FilterHistory:
    """Newest motions and fixes of a filter with the states after them, in preallocated arrays.

    Parameters
    ----------
    model : FilterModel
    capacity : int
        Number of motions and fixes that are kept. A fix older than all of them is refused.
    """

    def __init__(self, model: FilterModel, capacity: int) -> None:
        self._model = model
        self._capacity = capacity
        # Rows are appended until the arrays, of twice the capacity, are full. Then they are moved.
        rows = 2 * capacity + 2
        self._time_ns = np.zeros(rows, np.int64)
        self._is_motion = np.zeros(rows, np.bool_)
        self._motion = np.zeros((rows, model.motion_size))
        self._fix = np.zeros((rows, model.fix_size))
        self._interpolation_s2 = np.zeros(rows)
        self._state = np.zeros((rows, model.state_size))
        self._covariance = np.zeros((rows, model.error_size, model.error_size))
        self._start = self._end = 0
        self._last_motion = -1
        self._last_rate: tuple[Array, float] | None = None
        self._rate_ns = 0
        self._unknown = model.unknown_state()

    def __len__(self) -> int:
        return self._end - self._start

    @property
    def nbytes(self) -> int:
        """Size of the arrays in bytes."""
        return sum(array.nbytes for array in self._arrays())

    @property
    def state(self) -> Array:
        """State after the newest motion or fix."""
        return self._state[self._end - 1] if len(self) else self._unknown[0]

    @property
    def covariance(self) -> Array:
        """Covariance of :attr:`state`."""
        return self._covariance[self._end - 1] if len(self) else self._unknown[1]

    @property
    def time_ns(self) -> int | None:
        """Time of :attr:`state`; None before the first motion or fix."""
        return int(self._time_ns[self._end - 1]) if len(self) else None

    @property
    def motion_time_ns(self) -> int | None:
        """Time of the newest motion."""
        return int(self._time_ns[self._last_motion]) if self._last_motion >= 0 else None

    def predict(self, time_ns: int, newest: NewestState | None = None) -> tuple[Array, Array]:
        """Return state and covariance at a time that is not before that of the newest state.

        ``newest`` is an earlier result of :meth:`newest_state`.
        """
        newest = newest or self.newest_state()
        if time_ns <= newest.time_ns:
            return newest.state, newest.covariance
        duration_s = (time_ns - newest.time_ns) * 1e-9
        motion = self._extrapolated(duration_s)
        return self._model.propagate(newest.state, newest.covariance, motion, duration_s)

    def newest_state(self) -> NewestState:
        """Return a copy of the state after the newest motion or fix; there must be one."""
        row = self._end - 1
        return NewestState(
            int(self._time_ns[row]), self._state[row].copy(), self._covariance[row].copy()
        )

    def add_motion(self, time_ns: int, motion: Array) -> bool:
        """Take the motion since the previous motion sample; of the first, only the time counts.

        Return False, and ignore it, if it is not newer than the newest motion.
        """
        if self._last_motion < 0:
            self._last_motion = self._insert(0)
            self._time_ns[0], self._is_motion[0] = time_ns, True
            self._replay(0)
            return True
        first_ns = int(self._time_ns[self._last_motion])
        if time_ns <= first_ns:
            return False
        row = self._last_motion + 1
        while row < self._end and self._time_ns[row] < time_ns:
            self._divide(row, motion, first_ns, time_ns)
            row += 1
        row = self._insert(row)
        self._time_ns[row], self._is_motion[row] = time_ns, True
        fraction = (time_ns - int(self._time_ns[row - 1])) / (time_ns - first_ns)
        self._motion[row] = self._model.part(motion, fraction) if fraction < 1 else motion
        changed, self._last_motion = self._last_motion + 1, row
        self._measure_rate(time_ns, motion, (time_ns - first_ns) * 1e-9)
        self._extrapolate_pending()
        self._replay(changed)
        self._start = max(self._start, self._end - self._capacity)
        return True

    def add_fix(self, time_ns: int, fix: Array) -> bool:
        """Take a fix.

        Return False, and ignore it, if it is older than the history, or if
        :data:`MAX_PENDING_FIXES` wait for the motion already.
        """
        if self._last_motion < 0 or time_ns < self._time_ns[self._start]:
            return False
        times = self._time_ns[self._start : self._end]
        row = self._start + int(np.searchsorted(times, time_ns, "right"))
        is_late = row <= self._last_motion
        if not is_late and self._end - 1 - self._last_motion >= MAX_PENDING_FIXES:
            return False
        row = self._insert(row)
        self._time_ns[row], self._is_motion[row], self._fix[row] = time_ns, False, fix
        if is_late:
            self._divide_between(row)
        else:
            self._extrapolate_pending()
        self._replay(row)
        self._start = max(self._start, self._end - self._capacity)
        return True

    # ---- rows

    def _insert(self, row: int) -> int:
        """Make room for a row before ``row``; return its index."""
        if self._end == len(self._time_ns):
            shift = self._start
            for array in self._arrays():
                array[: self._end - shift] = array[shift : self._end].copy()
            self._start, self._end = 0, self._end - shift
            self._last_motion -= shift
            row -= shift
        if row < self._end:
            for array in self._arrays():
                array[row + 1 : self._end + 1] = array[row : self._end].copy()
            if row <= self._last_motion:
                self._last_motion += 1
        self._end += 1
        self._motion[row] = self._interpolation_s2[row] = 0.0
        return row

    def _arrays(self) -> tuple[NDArray[Any], ...]:
        return (
            self._time_ns,
            self._is_motion,
            self._motion,
            self._fix,
            self._interpolation_s2,
            self._state,
            self._covariance,
        )

    def _divide(self, row: int, motion: Array, first_ns: int, last_ns: int) -> None:
        """Set the motion of a pending fix to its part of the motion between two samples."""
        time_ns, before_ns = int(self._time_ns[row]), int(self._time_ns[row - 1])
        fraction = (time_ns - before_ns) / (last_ns - first_ns)
        self._motion[row] = self._model.part(motion, fraction)
        self._interpolation_s2[row] = 0.5e-18 * (time_ns - first_ns) * (last_ns - time_ns)

    def _divide_between(self, row: int) -> None:
        """Divide the motion of the row after a late fix between both."""
        time_ns = int(self._time_ns[row])
        before_ns, after_ns = int(self._time_ns[row - 1]), int(self._time_ns[row + 1])
        fraction = (time_ns - before_ns) / (after_ns - before_ns)
        self._motion[row] = self._model.part(self._motion[row + 1], fraction)
        self._motion[row + 1] = self._model.part(self._motion[row + 1], 1.0 - fraction)
        first, last = row - 1, row + 1
        while first > self._start and not self._is_motion[first]:
            first -= 1
        while not self._is_motion[last]:
            last += 1
        first_ns, last_ns = int(self._time_ns[first]), int(self._time_ns[last])
        self._interpolation_s2[row] = 0.5e-18 * (time_ns - first_ns) * (last_ns - time_ns)

    def _measure_rate(self, time_ns: int, motion: Array, duration_s: float) -> None:
        """Take the motion between two samples as the rate of the newest motion.

        Samples that arrive together may have nearly the same time, and then tell no rate.
        """
        if self._last_rate is not None:
            least_s = min(MIN_RATE_FRACTION * self._last_rate[1], MIN_RATE_INTERVAL_S)
            if (time_ns - self._rate_ns) * 1e-9 < least_s:
                return
        self._last_rate, self._rate_ns = (motion, duration_s), time_ns

    def _extrapolated(self, duration_s: float) -> Array:
        """Return the motion in a time after the newest sample, at the rate of the newest motion."""
        if self._last_rate is None:
            return np.zeros(self._model.motion_size)
        motion, known_s = self._last_rate
        return self._model.part(motion, duration_s / known_s)

    def _extrapolate_pending(self) -> None:
        """Set the motions of fixes that are newer than the newest motion."""
        known_ns = int(self._time_ns[self._last_motion])
        known_s = self._last_rate[1] if self._last_rate is not None else 0.0
        for row in range(self._last_motion + 1, self._end):
            step_s = int(self._time_ns[row] - self._time_ns[row - 1]) * 1e-9
            since_s = (int(self._time_ns[row]) - known_ns) * 1e-9
            self._motion[row] = self._extrapolated(step_s)
            self._interpolation_s2[row] = 0.5 * since_s * (since_s + known_s)

    def _replay(self, first: int) -> None:
        """Compute the states from a row on."""
        model = self._model
        for row in range(first, self._end):
            if row == self._start:
                state, covariance = self._unknown
            else:
                duration_ns = int(self._time_ns[row] - self._time_ns[row - 1])
                state, covariance = self._state[row - 1], self._covariance[row - 1]
                if duration_ns > 0:
                    state, covariance = model.propagate(
                        state, covariance, self._motion[row], duration_ns * 1e-9
                    )
            if not self._is_motion[row]:
                state, covariance = model.update(
                    state, covariance, self._fix[row], float(self._interpolation_s2[row])
                )
            self._state[row], self._covariance[row] = state, covariance
