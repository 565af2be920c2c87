"""Check of hall sensors: a magnet by magpylib that is moved below one sensor after the other."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.halls import HallSamples, HallSensors, circle
from locatk.core.landmarks.halls_check import check_halls

NOISE_T = 3e-5
STEP_T = 5e-5


def _recording(order=(0, 1, 2, 3), *, north_up: bool = True, seed: int = 0) -> np.ndarray:
    """Readings (n, 4) while a disc magnet is moved along the sensors by hand."""
    rng = np.random.default_rng(seed)
    position = np.column_stack([circle(), np.zeros(4)])
    stops = np.vstack([[0.3, 0, 0], position[list(order)], [0.3, 0.1, 0]])
    stops[:, 2] = -0.012 + rng.uniform(-0.003, 0.003, len(stops))
    knots = np.arange(len(stops))
    time = np.linspace(0, len(stops) - 1, 1200)
    path = np.column_stack([np.interp(time, knots, stops[:, axis]) for axis in range(3)])
    # The hand rests far away for most of the recording.
    path = np.vstack([np.repeat(path[:1], 2000, axis=0), path])
    magnet = magpylib.magnet.Cylinder(
        polarization=(0, 0, 1.2 if north_up else -1.2), dimension=(0.01, 0.005)
    )
    magnet.position = path
    field = magpylib.getB(magnet, position)[:, :, 2]
    field = field + rng.normal(scale=5e-5, size=4) + rng.normal(scale=NOISE_T, size=field.shape)
    return np.round(field / STEP_T) * STEP_T


def _check(field_t: np.ndarray):
    time_ns = np.arange(len(field_t), dtype=np.int64) * 5_000_000
    return check_halls(HallSamples("robot", HallSensors(), time_ns, field_t))


def _codes(check) -> list[tuple[int | None, str]]:
    return [(fault.sensor, fault.code) for fault in check.faults]


@pytest.mark.parametrize("seed", range(6))
def test_correct_sensors_have_no_fault(seed):
    check = _check(_recording(seed=seed))
    assert not check.faults
    assert not check.untested
    times = [figures.response_s for figures in check.sensors]
    assert times == sorted(times)
    for figures in check.sensors:
        assert figures.response_t > 5e-3
        assert abs(figures.zero_t) < 2e-4


def test_exchanged_sensors_are_named():
    field = _recording()[:, [0, 3, 2, 1]]
    check = _check(field)
    assert _codes(check) == [(None, "order")]
    assert "left and right are exchanged" in check.faults[0].message


def test_other_orders_are_listed():
    check = _check(_recording((1, 2, 3, 0)))
    assert _codes(check) == [(None, "order")]
    assert "in the order left, rear, right, front" in check.faults[0].message


def test_inverted_sensors_are_named():
    field = _recording()
    field[:, 2] *= -1
    assert _codes(_check(field)) == [(2, "inverted")]


def test_sensors_that_are_all_inverted_may_be_a_turned_magnet():
    check = _check(_recording(north_up=False))
    assert _codes(check) == [(None, "inverted")]
    assert "north side of the magnet was down" in check.faults[0].message


def test_one_sensor_differs_from_most_also_with_a_turned_magnet():
    field = _recording(north_up=False)
    field[:, 1] *= -1
    assert _codes(_check(field)) == [(None, "inverted"), (1, "inverted")]


def test_a_magnet_may_pass_again_on_its_way_back():
    there = _recording()[:-150]
    check = _check(np.concatenate([there, there[2200:][::-1]]))
    assert not check.faults


def test_dead_weak_and_noisy_sensors_are_named():
    rng = np.random.default_rng(1)
    field = _recording()
    field[:, 0] = np.nan
    field[:, 1] *= 0.1
    field[:, 2] = STEP_T * rng.integers(0, 2, len(field))
    assert _codes(_check(field)) == [(0, "no_readings"), (1, "weak"), (2, "no_response")]
    field = _recording()
    field[:, 1] = 0.0
    field[:, 3] += rng.normal(scale=3e-4, size=len(field))
    assert _codes(_check(field)) == [(1, "constant"), (3, "noisy")]


def test_missing_readings_and_wrong_zero_levels_are_named():
    field = _recording()
    field[::5, 1] = np.nan
    field[:, 3] += 2e-3
    check = _check(field)
    assert _codes(check) == [(1, "readings_missing"), (3, "zero_level")]
    assert check.faults[1].message.startswith(("reads 1.9", "reads 2.0"))


def test_without_a_magnet_response_and_order_are_untested():
    check = _check(_recording()[:1500])
    assert not check.faults
    assert any(text.startswith("order, sign and gain") for text in check.untested)


def test_short_recordings_are_refused():
    with pytest.raises(InputError, match="the check needs at least"):
        _check(_recording()[:10])
