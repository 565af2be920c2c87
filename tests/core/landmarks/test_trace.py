"""Corrections of odometry against odometry that really errs so, and frames there and back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.landmarks.detection.trace import (
    Drift,
    Trace,
    bent,
    compose,
    corrections,
    relative,
    sensor_places,
)

Array = NDArray[np.float64]

ALONE = {
    "scale": Drift(1, 0, 0, 0, 0),
    "turn_scale": Drift(0, 1, 0, 0, 0),
    "curvature": Drift(0, 0, 1, 0, 0),
}


def driven(steps: Array, *, scale: float = 0, turn_scale: float = 0, curvature: float = 0) -> Array:
    """Poses (n + 1, 3) from ways and turns (n, 2), each a small arc, if wheels err so."""
    poses = [np.zeros(3)]
    for way, turn in steps:
        x, y, heading = poses[-1]
        turned = turn * (1 + turn_scale) + curvature * abs(way)
        middle = heading + turned / 2
        far = way * (1 + scale)
        poses.append(
            np.array([x + far * math.cos(middle), y + far * math.sin(middle), heading + turned])
        )
    return np.array(poses)


def winding(seed: int = 0) -> Array:
    """Ways and turns of straights, spins and arcs."""
    random = np.random.default_rng(seed)
    parts = []
    for _ in range(4):
        parts.append(np.tile([0.002, 0.0], (50, 1)))
        parts.append(np.tile([0.0, 0.02 * random.choice([-1, 1])], (40, 1)))
        parts.append(np.tile([0.002, 0.01], (40, 1)))
    return np.concatenate(parts)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("reference", [0, 200, -1])
def test_constant_errors_are_what_wheels_do(number: int, reference: int) -> None:
    """To first order: an error half as large leaves a quarter."""
    told = driven(winding())
    reference %= len(told)
    name = list(ALONE)[number]
    missed = []
    for size in (0.02, 0.01):
        true = driven(winding(), **{name: size})
        # Both as the robot at the reference sees them: that is where a trace has its frame.
        true, seen = relative(true, true[reference]), relative(told, told[reference])
        wrong = np.zeros(corrections(seen, reference, Drift()).shape[2])
        wrong[number] = size
        drift = ALONE[name]
        missed.append(np.abs(seen + corrections(seen, reference, drift) @ wrong - true).max())
        assert np.abs(seen - true).max() > 5 * missed[-1]
    assert missed[1] < 0.3 * missed[0] + 1e-12


@pytest.mark.parametrize("number", range(3))
def test_bent_takes_large_errors_off_exactly(number: int) -> None:
    told = driven(winding(1))
    true = driven(winding(1), **{list(ALONE)[number]: 0.3})
    steady = np.zeros(3)
    steady[number] = 0.3
    found = bent(told, steady, Drift(1, 1, 1))
    # Arcs are bent by middle headings: the steps are small, not nothing.
    np.testing.assert_allclose(found, true, atol=2e-4)
    assert np.abs(told - true).max() > 0.02


@pytest.mark.parametrize("reference", [0, 130, 479])
def test_nothing_is_wrong_at_the_reference(reference: int) -> None:
    pose = driven(winding(2))
    assert not corrections(pose, reference, Drift())[reference].any()


def test_a_random_walk_grows_as_a_walk_does() -> None:
    """Variance of place and heading is in proportion to the way, whatever the sampling."""
    way = np.zeros((601, 3))
    way[:, 0] = np.linspace(0, 1.5, 601)
    drift = Drift(0, 0, 0, 1e-3, 0.0)
    spread = np.einsum("nim,njm->nij", *[corrections(way, 0, drift)] * 2)
    # Once every 150 mm, as the walk is a straight line in between.
    at = np.arange(60, 601, 60)
    np.testing.assert_allclose(spread[at, 0, 0], 1e-6 * np.arange(1, 11), rtol=1e-9)
    np.testing.assert_allclose(spread[at, 1, 1], spread[at, 0, 0], rtol=1e-9)
    sparse = corrections(way[::50], 0, drift)
    np.testing.assert_allclose(sparse[-1] @ sparse[-1].T, spread[-1], rtol=1e-9)


@pytest.mark.parametrize("length", [0.04, 0.2, 0.77])
def test_a_walk_is_no_longer_for_being_cut(length: float) -> None:
    """A way that is no whole number of units has its own share of them."""
    way = np.zeros((101, 3))
    way[:, 0] = np.linspace(0, length, 101)
    last = corrections(way, 0, Drift(0, 0, 0, 1e-3, 0.0))[-1]
    assert (last @ last.T)[0, 0] == pytest.approx(1e-6 * length / 0.15)


def test_a_walk_of_heading_swings_the_way() -> None:
    way = np.zeros((601, 3))
    way[:, 0] = np.linspace(0, 1.5, 601)
    last = corrections(way, 0, Drift(0, 0, 0, 0.0, 1e-2))[-1]
    spread = last @ last.T
    assert spread[2, 2] == pytest.approx(1e-4 * 10)
    # Brownian heading integrated over a way s of n units: variance sigma^2 n s^2 / 3.
    assert spread[1, 1] == pytest.approx(1e-4 * 10 * 1.5**2 / 3, rel=0.02)


poses = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)


@settings(deadline=None, max_examples=40)
@given(poses, poses)
def test_frames_there_and_back(frame: Array, pose: Array) -> None:
    local = relative(pose[None], frame)
    np.testing.assert_allclose(compose(frame, local)[0], pose, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(poses)
def test_sensors_are_points_of_the_robot(pose: Array) -> None:
    lever = np.array([[0.03, 0.01], [-0.02, 0.005]])
    c, s = math.cos(pose[2]), math.sin(pose[2])
    want = pose[:2] + lever @ np.array([[c, s], [-s, c]])
    np.testing.assert_allclose(sensor_places(pose[None], lever)[0], want, atol=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 300), st.integers(1, 80), st.data())
def test_thinned_keeps_the_reference_and_the_weight(
    count: int, most: int, data: st.DataObject
) -> None:
    reference = data.draw(st.integers(0, count - 1))
    pose = np.zeros((count, 3))
    pose[:, 0] = np.arange(count) - reference
    trace = Trace(
        pose,
        corrections(pose, reference, Drift()),
        np.zeros((count, 4)),
        np.zeros((4, 2)),
        np.ones(count),
        reference,
    )
    thin = trace.thinned(most)
    assert len(thin) <= most
    assert thin.pose[thin.reference, 0] == 0
    assert thin.share * len(thin) == pytest.approx(count, abs=thin.share)
