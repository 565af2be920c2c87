"""What goes wrong with simulated sweeps: jumps, reflections, mistaken stations."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.simulation.optics import OpticalLink, Places, SweepPairs

Array = NDArray[np.float64]

WALL_M = 2.5
"""Distance of the reflecting walls from the middle of the floor, in metres."""

JUMP_RAD = (float(np.radians(2.0)), float(np.radians(60.0)))
"""Size of demodulation errors (paper IV.A: more than 2 degrees for a single step)."""


def inject_faults(
    pairs: SweepPairs,
    links: Sequence[OpticalLink],
    outliers: float,
    noise_rad: float,
    rng: np.random.Generator,
) -> None:
    """Make a share of the sweeps wrong, a third of each kind.

    Parameters
    ----------
    pairs : SweepPairs
        Changed in place; of a report that one station only was seen in, none are swapped.
    links : sequence of OpticalLink
    outliers : float
        The share, 0 to 1. What cannot be swapped or reflected jumps.
    noise_rad : float
        Standard deviation of the rotor angles of reflections.
    rng : Generator
    """
    total = round(outliers * np.count_nonzero(np.isfinite(pairs.count)))
    _swap(pairs, links, total // 6, rng)
    _reflect(pairs, links, total // 6, noise_rad, rng)
    _jump(pairs, total - int(np.count_nonzero(pairs.wrong)), rng)


def _swap(
    pairs: SweepPairs, links: Sequence[OpticalLink], events: int, rng: np.random.Generator
) -> None:
    """Exchange the labels of two sweeps, one each of two stations, within reports."""
    robot = np.array([link.robot for link in links])[pairs.link]
    order = np.lexsort((rng.random(len(robot)), pairs.report, robot))
    first, second = order[:-1], order[1:]
    same = (robot[first] == robot[second]) & (pairs.report[first] == pairs.report[second])
    # The first two of each report in this random order, so that no pair has two partners.
    same &= np.r_[True, ~same[:-1]][: len(same)]
    first, second = first[same], second[same]
    plane = rng.integers(0, 2, len(first))
    a, b = (first, plane), (second, plane)
    # A label's period must hold the count; nan compares false.
    possible = (pairs.count[a] < period_counts(pairs.channel[b])) & (
        pairs.count[b] < period_counts(pairs.channel[a])
    )
    chosen = rng.permutation(np.flatnonzero(possible))[:events]
    a, b = (first[chosen], plane[chosen]), (second[chosen], plane[chosen])
    for label in (pairs.channel, pairs.polynomial):
        label[a], label[b] = label[b], label[a]
    pairs.wrong[a] = pairs.wrong[b] = True


def _reflect(
    pairs: SweepPairs,
    links: Sequence[OpticalLink],
    events: int,
    noise_rad: float,
    rng: np.random.Generator,
) -> None:
    """Let both sweeps reach the robot by way of the wall that the station looks at."""
    whole = np.isfinite(pairs.count).all(axis=1) & ~pairs.wrong.any(axis=1)
    chosen = rng.permutation(np.flatnonzero(whole))[:events]
    for number in np.unique(pairs.link[chosen]):
        rows = chosen[pairs.link[chosen] == number]
        link = links[number]
        mirrored = _mirrored(link)
        noise = rng.normal(0.0, noise_rad, (len(rows), 2))
        time_s, count = link.light.observe(pairs.start_s[rows], mirrored, noise)
        lit = np.isfinite(count).all(axis=1)
        rows = rows[lit]
        pairs.time_s[rows], pairs.count[rows] = time_s[lit], count[lit]
        pairs.wrong[rows] = True


def _mirrored(link: OpticalLink) -> Places:
    """Where the robot seems to be, seen in the wall before the station."""
    forward = link.light.station.rotation[:2, 0]
    axis = int(np.argmax(np.abs(forward)))
    wall_m = np.copysign(WALL_M, forward[axis])

    def where(time_s: Array) -> Array:
        place = link.position(time_s)
        place[..., axis] = 2 * wall_m - place[..., axis]
        return place

    return where


def _jump(pairs: SweepPairs, events: int, rng: np.random.Generator) -> None:
    """Errors of demodulation: a sweep's count is off by an angle of :data:`JUMP_RAD`."""
    good = np.flatnonzero((np.isfinite(pairs.count) & ~pairs.wrong).ravel())
    chosen = np.unravel_index(rng.permutation(good)[:events], pairs.count.shape)
    period = period_counts(pairs.channel[chosen])
    low, high = JUMP_RAD
    size = low * (high / low) ** rng.random(len(period)) / (2 * np.pi) * period
    step = np.ceil(size) * rng.choice([-1.0, 1.0], len(period))
    count = pairs.count[chosen]
    outside = (count + step < 0) | (count + step >= period)
    pairs.count[chosen] = count + np.where(outside, -step, step)
    pairs.wrong[chosen] = True
