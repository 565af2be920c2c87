"""Check of a magnetometer array: fields by magpylib, rotations by scipy, readings in counts."""

from __future__ import annotations

import magpylib
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.array_check import check_array

EARTH_T = np.array([19e-6, 1e-6, -44e-6])
COUNT_T = 0.3e-6
NOISE_T = 0.5e-6


def _recording(
    sensors: int = 9,
    *,
    seed: int = 0,
    turns: str = "xyz",
    magnet_at: int | None = 0,
    rest: int = 0,
    field_scale: float = 1.0,
) -> np.ndarray:
    """Readings (n, N, 3) of a bar that is turned by hand, then touched by a magnet."""
    rng = np.random.default_rng(seed)
    key = Rotation.random(12, random_state=seed)
    if turns == "z":
        key = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi, (12, 1)))
    elif not turns:
        key = Rotation.identity(12)
    rotation = Slerp(np.arange(12), key)(np.linspace(0, 11, 900))
    field = np.repeat(rotation.inv().apply(EARTH_T)[:, None], sensors, axis=1) * field_scale
    field = np.concatenate([np.repeat(field[:1], rest, axis=0), field])
    if magnet_at is not None:
        position = bar(sensors, 0.02)
        magnet = magpylib.magnet.Cylinder(polarization=(0, 0, 1.3), dimension=(0.01, 0.003))
        heights = np.concatenate([np.linspace(0.2, 0.02, 30), np.linspace(0.02, 0.2, 30)])
        magnet.position = position[magnet_at] + heights[:, None] * [0, 0, -1.0]
        near = magpylib.getB(magnet, position).reshape(-1, sensors, 3)
        field = np.concatenate([field, field[-1] + near])
    # Hard iron of each sensor, noise, counts.
    field = field + rng.normal(scale=20e-6, size=(sensors, 3))
    field += rng.normal(scale=NOISE_T, size=field.shape)
    return np.round(field / COUNT_T) * COUNT_T


def _check(field_t: np.ndarray, **array: object):
    n, sensors, _ = field_t.shape
    time_ns = np.arange(n, dtype=np.int64) * 20_000_000
    return check_array(Samples("bar", SensorArray(bar(sensors, 0.02)), time_ns, field_t))


def _codes(check) -> list[tuple[int | None, str]]:
    return [(fault.sensor, fault.code) for fault in check.faults]


@pytest.mark.parametrize("sensors", [1, 2, 3, 9])
@pytest.mark.parametrize("seed", range(4))
def test_correct_arrays_have_no_fault(sensors, seed):
    check = _check(_recording(sensors, seed=seed))
    assert not check.faults
    assert check.field_t == pytest.approx(np.linalg.norm(EARTH_T), rel=0.05)
    for figures in check.sensors:
        assert figures.axes == (1, 2, 3)
        assert figures.gain == pytest.approx(1, abs=0.05)
        assert figures.noise_t == pytest.approx(NOISE_T, rel=0.5)
    assert [text for text in check.untested if "all sensors share" not in text] == []


def test_most_of_a_recording_may_be_at_rest():
    assert not _check(_recording(rest=2000)).faults


@pytest.mark.parametrize(
    ("matrix", "axes", "code", "words"),
    [
        (np.diag([-1, 1, 1]), (-1, 2, 3), "axis_inverted", "x is inverted"),
        (np.diag([-1, -1, 1]), (-1, -2, 3), "axis_inverted", "x and y are inverted"),
        (np.eye(3)[[1, 0, 2]], (2, 1, 3), "axes_exchanged", "x, y, z measure y, x, z"),
        (np.eye(3)[[1, 2, 0]], (2, 3, 1), "axes_exchanged", "x, y, z measure y, z, x"),
        (
            np.diag([1, 1, -1]) @ np.eye(3)[[1, 0, 2]],
            (2, 1, -3),
            "axes_exchanged",
            "measure y, x, -z",
        ),
    ],
)
@pytest.mark.parametrize("sensor", [0, 5])
def test_exchanged_and_inverted_axes_are_named(matrix, axes, code, words, sensor):
    field = _recording()
    field[:, sensor] = field[:, sensor] @ matrix.T
    check = _check(field)
    assert _codes(check) == [(sensor, code)]
    assert words in check.faults[0].message
    assert check.sensors[sensor].axes == axes


@pytest.mark.parametrize("gain", [0.5, 0.8, 1.25, 5.0])
def test_wrong_gains_are_named(gain):
    field = _recording()
    field[:, 3] *= gain
    check = _check(field)
    assert _codes(check) == [(3, "gain")]
    assert check.sensors[3].gain == pytest.approx(gain, rel=0.05)
    assert "times the gain of the others" in check.faults[0].message


def test_the_gain_of_one_axis_is_named():
    field = _recording()
    field[:, 3, 2] *= 1.5
    check = _check(field)
    assert _codes(check) == [(3, "gain")]
    assert "its z axis has 1.5" in check.faults[0].message


def test_dead_sensors_are_named():
    field = _recording()
    field[:, 1] = np.nan
    field[:, 4] = 0.0
    field[:, 6, 1] = field[0, 6, 1]
    check = _check(field)
    assert _codes(check) == [(1, "no_readings"), (4, "constant"), (6, "axis_dead")]
    assert check.sensors[6].axes == (1, 0, 3)


def test_missing_and_noisy_readings_are_named():
    field = _recording()
    rng = np.random.default_rng(1)
    field[rng.random(len(field)) < 0.2, 2] = np.nan
    field[:, 7] += rng.normal(scale=3e-6, size=field[:, 7].shape)
    assert _codes(_check(field)) == [(2, "readings_missing"), (7, "noisy")]


def test_rotated_sensors_are_named():
    field = _recording()
    field[:, 8] = Rotation.from_euler("z", 25, degrees=True).apply(field[:, 8])
    check = _check(field)
    assert _codes(check) == [(8, "rotated")]
    assert "25 degrees" in check.faults[0].message


def test_units_that_are_wrong_in_all_sensors_are_named():
    assert _codes(_check(_recording(field_scale=10.0, magnet_at=None))) == [
        (None, "field_implausible")
    ]


@pytest.mark.parametrize(("nearest", "words"), [(8, "the order may be reversed"), (4, "sensor 5")])
def test_the_order_of_the_sensors_is_tested_by_a_magnet(nearest, words):
    check = _check(_recording(magnet_at=nearest))
    assert _codes(check) == [(None, "order")]
    assert words in check.faults[0].message


def test_a_saturated_reading_is_the_nearest_one():
    field = _recording(magnet_at=0)
    field[-40:-20, 0] = np.nan
    assert not _check(field).faults


def test_without_a_magnet_the_order_is_untested():
    check = _check(_recording(magnet_at=None))
    assert not check.faults
    assert any(text.startswith("order of the sensors") for text in check.untested)


def test_arrays_that_were_not_turned_are_untested():
    check = _check(_recording(turns="", magnet_at=None))
    assert not check.faults
    assert any("not turned" in text for text in check.untested)
    assert np.isnan(check.sensors[0].gain)


@pytest.mark.parametrize("seed", range(3))
def test_turning_about_one_axis_compares_the_other_two(seed):
    field = _recording(turns="z", seed=seed)
    field[:, 2, :2] = field[:, 2, 1::-1]
    field[:, 5, :2] *= 0.5
    check = _check(field)
    assert _codes(check) == [(2, "axes_exchanged"), (5, "gain")]
    assert check.sensors[0].axes == (1, 2, 0)
    assert check.sensors[2].axes == (2, 1, 0)
    assert any(text.startswith("gain and sign along z") for text in check.untested)


def test_iron_nearby_is_named():
    field = _recording(magnet_at=None)
    rng = np.random.default_rng(3)
    smooth = np.cumsum(rng.normal(size=field.shape), axis=0)
    field += 15e-6 * smooth / smooth.std(axis=0)
    assert (None, "disturbed") in _codes(_check(field))


def test_two_sensors_that_disagree_are_both_doubtful():
    field = _recording(2)
    field[:, 1] = field[:, 1, [1, 0, 2]]
    check = _check(field)
    assert _codes(check) == [(1, "axes_exchanged")]
    assert any(text.startswith("which sensors are right") for text in check.untested)


@pytest.mark.parametrize("gain", [0.75, 1.25, 1.5])
def test_the_gains_of_two_sensors_are_not_averaged(gain):
    field = _recording(2)
    field[:, 1] *= gain
    check = _check(field)
    assert _codes(check) == [(1, "gain")]
    assert check.sensors[1].gain == pytest.approx(gain, rel=0.02)
    assert any(text.startswith("which sensors are right") for text in check.untested)


def test_two_rotated_sensors_are_not_averaged():
    field = _recording(2)
    field[:, 1] = Rotation.from_euler("x", 16, degrees=True).apply(field[:, 1])
    assert _codes(_check(field)) == [(1, "rotated")]


def test_without_a_majority_the_right_sensors_are_unknown():
    field = _recording(4)
    field[:, 2:] = field[:, 2:, [1, 0, 2]]
    check = _check(field)
    assert _codes(check) == [(2, "axes_exchanged"), (3, "axes_exchanged")]
    assert any(text.startswith("which sensors are right") for text in check.untested)
    field = _recording(5)
    field[:, 3:] = field[:, 3:, [1, 0, 2]]
    assert not any(text.startswith("which sensors") for text in _check(field).untested)


def test_samples_that_no_sensor_shares_are_named():
    field = _recording(3, magnet_at=None)
    n = len(field)
    for sensor in range(3):
        field[sensor * n // 3 : (sensor + 1) * n // 3, sensor] = np.nan
    check = _check(field)
    assert {fault.code for fault in check.faults} == {"readings_missing"}
    assert any("too few samples have the readings of all" in text for text in check.untested)


def test_the_order_is_untested_without_sensor_1():
    field = _recording()
    field[:, 0] = np.nan
    check = _check(field)
    assert _codes(check) == [(0, "no_readings")]
    assert any("sensor 1 has no readings" in text for text in check.untested)


def test_without_any_reading_nothing_is_tested():
    field = np.full((200, 3, 3), np.nan)
    check = _check(field)
    assert _codes(check) == [(k, "no_readings") for k in range(3)]
    assert check.untested


def test_sensors_with_few_readings_do_not_hinder_the_others():
    field = _recording()
    field[:540, 1] = np.nan
    field[400:, 2] = np.nan
    field[:, 5, 0] *= -1
    check = _check(field)
    assert _codes(check) == [(1, "readings_missing"), (2, "readings_missing"), (5, "axis_inverted")]


def test_gains_are_relative_to_the_median_of_all_sensors():
    """One of the three is not among those that agree, but its gain counts."""
    field = _recording(3)
    field[:, 1] = field[:, 1, [1, 0, 2]]
    field[:, 2] *= 0.5
    check = _check(field)
    assert _codes(check) == [(1, "axes_exchanged"), (2, "gain")]
    assert check.sensors[2].gain == pytest.approx(0.5, rel=0.05)


def test_magnets_all_the_time_are_refused():
    field = _recording(magnet_at=None)
    field[::40, 4] += 1e-3
    with pytest.raises(InputError, match="a magnet or iron moves near bar"):
        _check(field)


def test_short_recordings_are_refused():
    with pytest.raises(InputError, match="the check needs at least"):
        _check(_recording()[:20])
