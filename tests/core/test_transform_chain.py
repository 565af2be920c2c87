"""Composed transforms agree with matrices."""

from __future__ import annotations

import numpy as np

from locatk.core.geometry import matrix_from_quaternion, quaternion_from_matrix, rotation_exp
from locatk.core.trajectory import Trajectory
from locatk.core.transform_chain import compose


def transform(frame: str, time_ns: list[int], seed: int) -> Trajectory:
    random = np.random.default_rng(seed)
    n = len(time_ns)
    quaternion = quaternion_from_matrix(rotation_exp(random.normal(size=(n, 3))))
    time = np.array(time_ns, np.int64)
    unknown = np.full((n, 6, 6), np.nan)
    return Trajectory("part", frame, time, random.normal(size=(n, 3)), quaternion, unknown)


def matrix(track: Trajectory, index: int) -> np.ndarray:
    result = np.eye(4)
    result[:3, :3] = matrix_from_quaternion(track.quaternion[index])
    result[:3, 3] = track.position[index]
    return result


def test_three_transforms_are_multiplied() -> None:
    times = [10, 20, 30]
    chain = [transform(frame, times, seed) for seed, frame in enumerate("abc")]
    result = compose(chain, "a to d")
    assert (result.device, result.frame, result.time_ns.tolist()) == ("a to d", "a", times)
    for k in range(3):
        expected = matrix(chain[0], k) @ matrix(chain[1], k) @ matrix(chain[2], k)
        np.testing.assert_allclose(matrix(result, k), expected, atol=1e-14)


def test_slow_transforms_are_interpolated_but_not_extrapolated() -> None:
    slow = transform("map", [10, 30], 1)
    fast = transform("odom", [5, 10, 15, 20, 25, 30, 35], 2)
    result = compose([slow, fast], "robot")
    assert result.time_ns.tolist() == [10, 15, 20, 25, 30]
    np.testing.assert_allclose(matrix(result, 0), matrix(slow, 0) @ matrix(fast, 1), atol=1e-14)
    middle = slow.position.mean(axis=0)
    relative = matrix(result, 2) @ np.linalg.inv(matrix(fast, 3))
    np.testing.assert_allclose(relative[:3, 3], middle, atol=1e-12)


def test_a_single_sample_is_constant() -> None:
    moving, fixed = transform("odom", [10, 20, 30], 3), transform("base", [999], 4)
    result = compose([moving, fixed], "camera")
    assert len(result) == 3
    np.testing.assert_allclose(matrix(result, 2), matrix(moving, 2) @ matrix(fixed, 0), atol=1e-14)


def test_transforms_of_different_times_have_no_result() -> None:
    assert len(compose([transform("a", [1, 2], 5), transform("b", [3, 4], 6)], "c")) == 0
