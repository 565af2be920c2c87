"""Parts that all simulators share: validation of options, random streams, times and truth.

A simulator draws the random numbers of each source of errors from a stream of its own, so that a
change of one source leaves the others unchanged: more noise, for example, leaves the path as it is.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.geometry import quaternion_from_heading
from locatk.core.trajectory import Trajectory

Array = NDArray[np.float64]

SESSION_START_NS = 1_767_225_600_000_000_000
"""Start of every simulated session, 2026-01-01T00:00:00Z [ns since 1970]."""

MAX_SAMPLES = 10_000_000
"""Largest number of samples of a session that is simulated as one array, in about 10 GB."""

MAX_SESSION_S = 1e9
"""Longest session that is simulated, 30 years [s]; int64 nanoseconds end after 236 years."""

Rule = tuple[str, bool, str]
"""Name of an option, validity of its value, and a description of the valid values."""


# ---- options


def check_options(options: object, rules: Iterable[Rule]) -> None:
    """Raise an error for the first simulation option with an impossible value.

    Parameters
    ----------
    options : object
        Its attributes are the options.
    rules : iterable of Rule

    Raises
    ------
    InputError
        The first option that is not valid.
    """
    for name, is_valid, expected in rules:
        if not is_valid:
            value = getattr(options, name)
            raise InputError(f"a simulation with {name} {value!r}", hint=f"give {expected}")


def require_positive(options: object, *names: str) -> Iterator[Rule]:
    """Yield the rules of finite options above 0; None is valid."""
    for name in names:
        value = getattr(options, name)
        yield name, value is None or 0 < value < math.inf, "a number above 0"


def require_not_negative(options: object, *names: str) -> Iterator[Rule]:
    """Yield the rules of finite options of at least 0; None is valid."""
    for name in names:
        value = getattr(options, name)
        yield name, value is None or 0 <= value < math.inf, "0 or more"


def require_finite(options: object, *names: str) -> Iterator[Rule]:
    """Yield the rules of finite options; None is valid."""
    for name in names:
        value = getattr(options, name)
        yield name, value is None or math.isfinite(value), "a number"


def require_fraction(options: object, *names: str) -> Iterator[Rule]:
    """Yield the rules of options from 0 to 1."""
    for name in names:
        yield name, 0 <= getattr(options, name) <= 1, "0 to 1"


def require_fraction_below_1(options: object, *names: str) -> Iterator[Rule]:
    """Yield the rules of options from 0 to below 1."""
    for name in names:
        yield name, 0 <= getattr(options, name) < 1, "0 to below 1"


def check_session_size(samples: float, duration_s: float) -> None:
    """Raise an error for a session that would not fit into the memory, or not into its times.

    Raises
    ------
    InputError
        There are more than :data:`MAX_SAMPLES`, or it is longer than :data:`MAX_SESSION_S`.
    """
    if not samples <= MAX_SAMPLES:
        raise InputError(
            f"a simulation of {samples:.3g} samples",
            hint=f"At most {MAX_SAMPLES:,} are simulated: choose a shorter duration or path, a "
            "lower rate or fewer robots",
        )
    if not duration_s <= MAX_SESSION_S:
        raise InputError(
            f"a simulation of {duration_s:.3g} s",
            hint=f"At most {MAX_SESSION_S:.0e} s are simulated: choose a shorter duration, a "
            "higher rate or speed",
        )


# ---- random numbers, times, sensors, truth


def random_stream(seed: int, *source: int) -> np.random.Generator:
    """Return the random numbers of one source of errors of a simulation."""
    return np.random.default_rng([seed, *source])


def stamps_ns(time_s: Array) -> NDArray[np.int64]:
    """Convert seconds since the start of a session to nanoseconds since 1970."""
    return SESSION_START_NS + np.rint(time_s * 1e9).astype(np.int64)


def quantize(values: Array, step: float | Array) -> Array:
    """Round values to multiples of a step, which is broadcast; a step of 0 changes nothing."""
    step = np.asarray(step, float)
    divisor = np.where(step > 0, step, 1.0)
    return np.where(step > 0, np.rint(values / divisor) * divisor, values)


def exact_trajectory(
    device: str, frame: str, time_ns: NDArray[np.int64], position_m: Array, heading_rad: Array
) -> Trajectory:
    """Return a trajectory with headings about the vertical and with zero covariance.

    Parameters
    ----------
    device, frame : str
    time_ns : (n,) int64 ndarray
    position_m : (n, 2) or (n, 3) ndarray
        Positions in the plane have the height 0.
    heading_rad : (n,) ndarray
    """
    count = len(time_ns)
    if position_m.shape[1] == 2:
        position_m = np.column_stack([position_m, np.zeros(count)])
    orientation = quaternion_from_heading(heading_rad)
    return Trajectory(device, frame, time_ns, position_m, orientation, np.zeros((count, 6, 6)))
