"""Outliers among simulated sweeps: exchanged stations, reflections, demodulation errors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.simulation.optics import OpticalLink, PositionFunction, SweepPairs

Array = NDArray[np.float64]

WALL_DISTANCE_M = 2.5
"""Distance of the reflecting walls from the centre of the floor [m]."""

ANGLE_ERROR_RAD = (float(np.radians(2.0)), float(np.radians(60.0)))
"""Range of the demodulation errors, drawn with a uniform logarithm [rad]. Real ones exceed
2 degrees for a single step (paper IV.A)."""


def inject_faults(
    pairs: SweepPairs,
    links: Sequence[OpticalLink],
    outliers: float,
    noise_rad: float,
    rng: np.random.Generator,
) -> None:
    """Replace a fraction of the sweeps by outliers, a third of each kind.

    Parameters
    ----------
    pairs : SweepPairs
        Changed in place.
    links : sequence of OpticalLink
    outliers : float
        Fraction of the received sweeps, 0 to 1. If too few can be exchanged (a report must
        contain two stations) or reflected, the others get demodulation errors.
    noise_rad : float
        Standard deviation of the rotor angles of reflections.
    rng : Generator
    """
    total = round(outliers * np.count_nonzero(np.isfinite(pairs.count)))
    _exchange_stations(pairs, links, total // 6, rng)
    _reflect(pairs, links, total // 6, noise_rad, rng)
    _add_angle_errors(pairs, total - int(np.count_nonzero(pairs.is_outlier)), rng)


def _exchange_stations(
    pairs: SweepPairs, links: Sequence[OpticalLink], events: int, rng: np.random.Generator
) -> None:
    """Exchange the labels of two sweeps of different stations within a report."""
    robot = np.array([link.robot for link in links])[pairs.link]
    order = np.lexsort((rng.random(len(robot)), pairs.report, robot))
    first, second = order[:-1], order[1:]
    is_partner = (robot[first] == robot[second]) & (pairs.report[first] == pairs.report[second])
    # Only the first two of each report in this random order, so that no pair has two partners.
    is_partner &= np.r_[True, ~is_partner[:-1]][: len(is_partner)]
    first, second = first[is_partner], second[is_partner]
    plane = rng.integers(0, 2, len(first))
    a, b = (first, plane), (second, plane)
    # Each count must be within the period of the other station; nan compares false.
    is_possible = (pairs.count[a] < period_counts(pairs.channel[b])) & (
        pairs.count[b] < period_counts(pairs.channel[a])
    )
    chosen = rng.permutation(np.flatnonzero(is_possible))[:events]
    a, b = (first[chosen], plane[chosen]), (second[chosen], plane[chosen])
    for label in (pairs.channel, pairs.polynomial):
        label[a], label[b] = label[b], label[a]
    pairs.is_outlier[a] = pairs.is_outlier[b] = True


def _reflect(
    pairs: SweepPairs,
    links: Sequence[OpticalLink],
    events: int,
    noise_rad: float,
    rng: np.random.Generator,
) -> None:
    """Replace both sweeps of rotations by their reflection in the wall ahead of the station."""
    is_complete = np.isfinite(pairs.count).all(axis=1) & ~pairs.is_outlier.any(axis=1)
    chosen = rng.permutation(np.flatnonzero(is_complete))[:events]
    for index in np.unique(pairs.link[chosen]):
        rows = chosen[pairs.link[chosen] == index]
        noise = rng.normal(0.0, noise_rad, (len(rows), 2))
        time_s, count = _reflected(pairs.start_s[rows], links[index], noise)
        is_received = np.isfinite(count).all(axis=1)
        rows = rows[is_received]
        pairs.time_s[rows], pairs.count[rows] = time_s[is_received], count[is_received]
        pairs.is_outlier[rows] = True


def reflect_in_runs(
    pairs: SweepPairs,
    links: Sequence[OpticalLink],
    edges_s: Sequence[Array],
    noise_rad: float,
    rng: np.random.Generator,
) -> None:
    """Replace the sweeps of whole intervals by their reflection in the wall ahead of the station.

    The direct light is hidden meanwhile: a sweep without a reflection is lost.

    Parameters
    ----------
    pairs : SweepPairs
        Changed in place.
    links : sequence of OpticalLink
    edges_s : sequence of (2 k,) ndarray
        For each link, ascending starts and ends of the intervals.
    noise_rad : float
        Standard deviation of the rotor angles.
    rng : Generator
    """
    for index, (link, edges) in enumerate(zip(links, edges_s, strict=True)):
        is_hidden = (pairs.link == index) & (np.searchsorted(edges, pairs.start_s) % 2 == 1)
        rows = np.flatnonzero(is_hidden & np.isfinite(pairs.count).any(axis=1))
        noise = rng.normal(0.0, noise_rad, (len(rows), 2))
        time_s, count = _reflected(pairs.start_s[rows], link, noise)
        count[~np.isfinite(pairs.count[rows])] = np.nan
        pairs.time_s[rows], pairs.count[rows] = time_s, count
        pairs.is_outlier[rows] = True


def draw_intervals(
    rng: np.random.Generator, fraction: float, mean_s: float, duration_s: float
) -> Array:
    """Return ascending starts and ends (2 k,) of intervals in a session [s].

    Their total is exactly the given fraction of its duration.
    """
    total_s = fraction * duration_s
    count = int(np.ceil(total_s / mean_s))
    if count == 0:
        return np.zeros(0)
    durations_s = np.zeros(2 * count)
    durations_s[0::2] = rng.dirichlet(np.ones(count + 1))[:-1] * (duration_s - total_s)
    durations_s[1::2] = rng.dirichlet(np.full(count, 2.0)) * total_s
    return np.cumsum(durations_s)


def _reflected(start_s: Array, link: OpticalLink, noise: Array) -> tuple[Array, Array]:
    """Return the times and counts (n, 2) of the reflections in rotations from ``start_s`` on."""
    return link.source.observe(start_s, _mirror_position(link), noise)


def _mirror_position(link: OpticalLink) -> PositionFunction:
    """Return the position of the mirror image of a photodiode in the wall ahead of the station."""
    forward = link.source.station.rotation[:2, 0]
    axis = int(np.argmax(np.abs(forward)))
    wall_m = np.copysign(WALL_DISTANCE_M, forward[axis])

    def position(time_s: Array) -> Array:
        mirrored = link.position(time_s)
        mirrored[..., axis] = 2 * wall_m - mirrored[..., axis]
        return mirrored

    return position


def _add_angle_errors(pairs: SweepPairs, events: int, rng: np.random.Generator) -> None:
    """Add demodulation errors of :data:`ANGLE_ERROR_RAD` to single sweeps."""
    inliers = np.flatnonzero((np.isfinite(pairs.count) & ~pairs.is_outlier).ravel())
    chosen = np.unravel_index(rng.permutation(inliers)[:events], pairs.count.shape)
    period = period_counts(pairs.channel[chosen])
    low, high = ANGLE_ERROR_RAD
    size = low * (high / low) ** rng.random(len(period)) / (2 * np.pi) * period
    step = np.ceil(size) * rng.choice([-1.0, 1.0], len(period))
    count = pairs.count[chosen]
    is_outside = (count + step < 0) | (count + step >= period)
    pairs.count[chosen] = count + np.where(is_outside, -step, step)
    pairs.is_outlier[chosen] = True
