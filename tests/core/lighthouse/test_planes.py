"""Which plane a sweep was: pairs, single ones, third ones, devices that move."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.lighthouse.demodulation.pipeline import MAX_PLANE_TRACK_ROTATIONS, identify_planes


def both(rotations: int, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and place of two planes, in order."""
    rotation = np.repeat(np.arange(rotations), 2)
    return rotation, np.stack([first, second], axis=1).ravel()


def test_pairs() -> None:
    rotation, place = both(50, np.full(50, 0.3), np.full(50, 0.62))
    assert identify_planes(rotation, place).tolist() == [0, 1] * 50
    assert identify_planes(np.zeros(0, np.int64), np.zeros(0)).tolist() == []


def test_single_ones_by_their_neighbours_while_the_device_moves() -> None:
    noise = np.random.default_rng(0)
    k = np.arange(500)
    rotation, place = both(500, 0.3 + 0.08 * np.sin(k / 40), 0.66 + 0.08 * np.sin(k / 40 + 1))
    truth = np.tile([0, 1], 500)
    seen = noise.random(1000) < 0.7
    plane = identify_planes(rotation[seen], place[seen])
    assert np.array_equal(plane, truth[seen])


def test_only_one_plane_is_unknown() -> None:
    rotation = np.arange(30)
    assert np.all(identify_planes(rotation, np.full(30, 0.4)) == -1)


def test_far_from_any_pair_is_unknown() -> None:
    rotation = np.array([0, 0, MAX_PLANE_TRACK_ROTATIONS + 5])
    assert identify_planes(rotation, np.array([0.3, 0.6, 0.3])).tolist() == [0, 1, -1]
    rotation = np.array([0, 0, MAX_PLANE_TRACK_ROTATIONS - 5])
    assert identify_planes(rotation, np.array([0.3, 0.6, 0.3])).tolist() == [0, 1, 0]


def test_a_third_sweep_is_not_taken_for_a_plane() -> None:
    rotation = np.array([0, 0, 1, 1, 2, 2, 2, 3, 3])
    place = np.array([0.3, 0.6, 0.3, 0.6, 0.3, 0.45, 0.6, 0.3, 0.6])
    assert identify_planes(rotation, place).tolist() == [0, 1, 0, 1, 0, -1, 1, 0, 1]


def test_two_that_claim_a_plane_are_both_doubted() -> None:
    rotation = np.array([0, 0, 1, 1, 1, 2, 2])
    place = np.array([0.3, 0.6, 0.3, 0.301, 0.6, 0.3, 0.6])
    assert identify_planes(rotation, place).tolist() == [0, 1, -1, -1, 1, 0, 1]


def test_a_pair_too_close_is_none() -> None:
    assert np.all(identify_planes(np.array([0, 0]), np.array([0.3, 0.35])) == -1)
    assert np.all(identify_planes(np.array([0, 0]), np.array([0.1, 0.9])) == -1)


@pytest.mark.parametrize(("off", "plane"), [(0.029, 0), (-0.029, 0), (0.031, -1), (-0.031, -1)])
def test_a_single_sweep_is_close_to_those_of_its_plane(off: float, plane: int) -> None:
    phase = np.array([0.3, 0.62, 0.3 + off])
    assert identify_planes(np.array([0, 0, 1]), phase).tolist() == [0, 1, plane]
    phase = np.array([0.3, 0.62, 0.62 + off])
    assert identify_planes(np.array([0, 0, 1]), phase)[2] == (1 if plane == 0 else -1)


def test_a_sweep_between_both_planes_of_a_moving_device_is_unknown() -> None:
    # Near the second plane of the pair before, and near the first plane of the pair after.
    rotation = np.array([0, 0, 10, 20, 20])
    phase = np.array([0.30, 0.55, 0.54, 0.53, 0.78])
    assert identify_planes(rotation, phase).tolist() == [0, 1, -1, 0, 1]
