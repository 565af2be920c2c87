"""Trajectories: probabilities of poses, and selections."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.trajectory import PROVISIONAL_PROBABILITY, Trajectory

POINTS = Trajectory.from_positions("robot", "map", np.arange(4), np.zeros((4, 3)))


def test_a_selection_keeps_the_probabilities_of_its_poses() -> None:
    probability = np.array([0.9, 0.99, np.nan, 1.0])
    found = replace(POINTS, probability=probability).select(np.array([False, True, True, True]))
    assert found.probability is not None
    np.testing.assert_array_equal(found.probability, probability[1:])
    assert (found.min_probability, found.is_provisional) == (0.99, True)
    assert not found.select(np.array([False, False, True])).is_provisional
    assert POINTS.select(np.ones(4, bool)).probability is None


def test_a_trajectory_is_provisional_if_one_pose_is() -> None:
    limit = PROVISIONAL_PROBABILITY
    assert not replace(POINTS, probability=np.full(4, limit)).is_provisional
    assert replace(POINTS, probability=np.array([1, 1, limit - 1e-9, 1])).is_provisional
    assert not replace(POINTS, probability=np.full(4, np.nan)).is_provisional
    with pytest.raises(ValueError, match=r"probability has shape \(3,\), not \(4,\)"):
        replace(POINTS, probability=np.ones(3))
