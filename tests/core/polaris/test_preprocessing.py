"""Preprocessing: implausible values, noise and passes, on synthetic and simulated recordings."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.preprocessing import (
    PassRange,
    estimate_noise,
    find_passes,
    is_no_pass,
    least_magnet_field,
    preprocess,
)

Array = NDArray[np.float64]

CELLS = ((0, 0), (1, 1), (0, 2), (1, 2), (2, 2))
SYMBOLS = (0, 3, 5, 2, 6)


# ---- implausible values


def samples(seed: int = 0) -> Samples:
    """A bar of five that passes a magnet: a peak of 150 uT in some ten samples, and noise."""
    rng = np.random.default_rng(seed)
    time = np.arange(200)
    peak = 150e-6 * np.exp(-(((time - 100) / 4) ** 2))
    field = rng.normal(size=(200, 5, 3)) * 1e-6 + peak[:, None, None] + 4e-5
    return Samples("bar", SensorArray(bar(5, 0.02)), time * 10_000_000, field)


def changed(before: Samples, after: Samples) -> NDArray[np.bool_]:
    return np.isnan(after.field_t) & np.isfinite(before.field_t)


def test_a_magnet_is_no_spike() -> None:
    result = preprocess(samples())
    np.testing.assert_array_equal(result.samples.field_t, samples().field_t)
    assert result.warnings == ()


@pytest.mark.parametrize("at", [30, 100])
def test_a_misframed_row_goes(at: int) -> None:
    """At rest, and at the peak of a magnet."""
    generated = samples()
    generated.field_t[at] += 1e-3
    result = preprocess(generated)
    gone = changed(generated, result.samples)
    assert gone[at].all()
    assert gone.sum() == 15
    assert [each.code for each in result.warnings] == ["spikes", "samples_missing"]
    assert "15 values" in result.warnings[0].message


def test_a_stuck_sensor_goes_while_it_is_stuck() -> None:
    generated = samples()
    generated.field_t[60:140, 2] = generated.field_t[60, 2]
    result = preprocess(generated)
    gone = changed(generated, result.samples)
    assert gone[60:140, 2].all()
    assert not gone[:60].any()
    assert not gone[140:].any()
    assert not gone[:, [0, 1, 3, 4]].any()
    assert result.warnings[0].code == "sensor_stuck"
    assert "sensor 3 was stuck (40 % of the time)" in result.warnings[0].message


def test_a_bar_without_noise_is_not_stuck() -> None:
    generated = samples()
    generated.field_t[:] = 1e-5
    result = preprocess(generated)
    assert np.isfinite(result.samples.field_t).all()
    assert result.warnings == ()


def test_non_finite_samples_are_missing() -> None:
    generated = samples()
    generated.field_t[50, 1, 2] = np.inf
    result = preprocess(generated)
    assert np.isnan(result.samples.field_t[50, 1, 2])
    assert changed(generated, result.samples).sum() == 0


# ---- noise and passes


def passes_of(samples: Any) -> list[PassRange]:
    return find_passes(samples, estimate_noise(samples))


@pytest.mark.parametrize("noise", [0.2e-6, 1e-6])
def test_noise_near_magnets(noise: float, world: Any) -> None:
    """It is that of the sensors although magnets pass for half of the recording."""
    tag = world.Tag(CELLS, SYMBOLS)
    samples = world.record([tag], world.line(length=0.3), noise=noise)
    np.testing.assert_allclose(np.median(estimate_noise(samples)), noise, rtol=0.12)
    assert estimate_noise(samples).shape == (9, 3)


def test_noise_by_sensor_and_axis(world: Any) -> None:
    samples = world.record([], world.line(length=2.0, speed=0.1), noise=0.0)
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.2e-6, 3e-6, (9, 3))
    noisy = world.spoiled(samples, samples.field_t + truth * rng.standard_normal((2000, 9, 3)))
    np.testing.assert_allclose(estimate_noise(noisy), truth, rtol=0.2)


def test_noise_of_few_samples_is_what_the_array_states(world: Any) -> None:
    samples = world.record([], world.line(length=0.02), array=world.bar(noise=7e-7))
    np.testing.assert_array_equal(estimate_noise(samples), np.full((9, 3), 7e-7))


def test_noise_is_never_less_than_the_quantum_allows(world: Any) -> None:
    quantum = np.array([1.5e-7, 1.5e-7, 2.4e-7])
    array = replace(world.bar(), quantum_t=quantum)
    still = world.record([], world.line(), array=array, noise=0.0)
    assert np.all(estimate_noise(still) >= quantum / 4)
    bare = world.record([], world.line(), noise=0.0)
    assert np.all(estimate_noise(bare) > 0)


@pytest.mark.slow
@pytest.mark.parametrize("step_mm", [0.1, 0.3, 1.0, 4.0, 8.0])
def test_one_pass_a_tag_and_all_of_it(step_mm: float, world: Any) -> None:
    course = world.line(length=1.2, speed=step_mm / 10)
    samples = world.record([world.Tag(CELLS, SYMBOLS, heading=0.7)], course, seed=3)
    (part,) = passes_of(samples)
    x = np.linspace(-0.6, 0.6, len(samples), endpoint=False)
    tag = world.Tag(CELLS, SYMBOLS, heading=0.7)
    assert x[part.first] < tag.places[:, 0].min() - 0.008
    assert x[part.stop - 1] > tag.places[:, 0].max() + 0.008
    assert x[part.stop - 1] - x[part.first] < 0.26 + 50 * step_mm * 1e-3  # not all of it


def test_distant_tags_are_separate_passes(world: Any) -> None:
    tags = [world.Tag(CELLS, SYMBOLS, x=x) for x in (-0.5, 0.0, 0.5)]
    parts = passes_of(world.record(tags, world.line(length=1.4)))
    assert len(parts) == 3
    for part, x in zip(parts, (-0.5, 0.0, 0.5), strict=True):
        assert part.first < (x + 0.7) * 1000 < part.stop
    assert all(a.stop <= b.first for a, b in pairwise(parts))


def test_the_end_of_the_recording_is_the_end_of_the_pass(world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.3))
    cut = replace(samples, time_ns=samples.time_ns[:150], field_t=samples.field_t[:150])
    (part,) = passes_of(cut)
    assert part.stop == 150


def test_noise_alone_is_no_pass(world: Any) -> None:
    for seed in range(5):
        assert passes_of(world.record([], world.line(length=3.0), seed=seed)) == []


def test_a_common_field_of_all_sensors_is_no_pass(world: Any) -> None:
    """The robot turns under the Earth's field; its motors start and stop."""
    samples = world.record([], world.line(length=1.0))
    n = len(samples)
    u = np.linspace(0, 6, n)
    common = 40e-6 * np.column_stack([np.cos(u), np.sin(u), 0 * u])
    common += 8e-6 * (np.arange(n) // 40 % 2)[:, None]
    assert passes_of(world.spoiled(samples, samples.field_t + common[:, None])) == []


@pytest.mark.parametrize("missing", [0.0, 0.1])
def test_sensors_that_give_nothing_do_not_hide_the_tag(missing: float, world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.4))
    field = samples.field_t.copy()
    field[:, 2] = np.nan
    field[np.random.default_rng(0).random(field.shape[:2]) < missing] = np.nan
    (part,) = passes_of(world.spoiled(samples, field))
    assert part.first < 160
    assert part.stop > 240


def test_even_one_sensor_sees_that_magnets_passed(world: Any) -> None:
    samples = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.4), array=world.bar(1))
    assert passes_of(samples)


def test_noise_of_a_sensor_without_samples_is_that_of_the_others(world: Any) -> None:
    samples = world.record([], world.line(length=0.5), array=world.bar(noise=np.nan))
    field = samples.field_t.copy()
    field[:, 2] = np.nan
    noise = estimate_noise(world.spoiled(samples, field))
    np.testing.assert_array_equal(noise[2], np.median(np.delete(noise, 2, axis=0), axis=0))


@pytest.mark.parametrize(
    ("rows", "order", "message"),
    [(slice(0, 19), 1, "19 samples"), (slice(0, 40), -1, "time stamps"), (slice(0, 0), 1, "0 s")],
)
def test_unusable_recordings_are_errors(rows: slice, order: int, message: str) -> None:
    recording = samples()
    cut = Samples(
        "bar", recording.array, recording.time_ns[rows][::order].copy(), recording.field_t[rows]
    )
    with pytest.raises(InputError, match=message):
        preprocess(cut)


def test_equal_time_stamps_are_an_error() -> None:
    recording = samples()
    frozen = replace(recording, time_ns=np.zeros_like(recording.time_ns))
    with pytest.raises(InputError, match="time stamps"):
        preprocess(frozen)


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([0, 10, 10, 30], [0, 7, 17, 30]),  # one stamp was late
        ([0, 40, 40, 40, 40, 80, 80, 80, 80], [0, 16, 32, 45, 55, 65, 75, 85, 95]),
    ],
)
def test_equal_time_stamps_are_separated(times: list[int], expected: list[int]) -> None:
    recording = samples()
    later = 1_000 + 10 * np.arange(len(recording) - len(times))
    time_ns = np.concatenate([np.array(times), later])
    result = preprocess(replace(recording, time_ns=time_ns)).samples.time_ns
    assert list(result[: len(times) - 2]) == expected[:-2]
    assert np.all(np.diff(result) > 0)
    np.testing.assert_array_equal(result[len(times) :], later)


def test_different_time_stamps_are_kept() -> None:
    recording = samples()
    assert preprocess(recording).samples.time_ns is recording.time_ns


def test_missing_values_are_no_change_of_the_field(world: Any) -> None:
    """Sensors have offsets of up to 300 uT, which a missing value must not turn into a signal."""
    for seed in range(4):
        resting = world.record([], world.line(length=1.0), offsets=300e-6, seed=seed)
        field = resting.field_t.copy()
        field[np.random.default_rng(seed).random(field.shape) < 0.15] = np.nan
        assert passes_of(world.spoiled(resting, field)) == []


def rest(world: Any, seed: int, change_t: Array) -> Samples:
    """A resting bar of which the field changes by ``change_t`` (n, 9, 3), over three seconds."""
    resting = world.record([], world.line(length=0.3), noise=0.9e-6, seed=seed)
    return world.spoiled(resting, resting.field_t + change_t)


def is_pass(recording: Samples, **known: Any) -> list[bool]:
    noise_t = estimate_noise(recording)
    parts = find_passes(recording, noise_t)
    return [not is_no_pass(recording, part, noise_t, **known) for part in parts]


@pytest.mark.parametrize("seed", range(3))
def test_a_motor_that_starts_is_no_pass(seed: int, world: Any) -> None:
    """Its field is fixed in shape, however strong it is."""
    rng = np.random.default_rng(seed)
    shape = 60e-6 * rng.standard_normal((9, 3))
    current = 1 / (1 + np.exp(-(np.arange(300) - 150) / rng.uniform(1, 20)))
    assert is_pass(rest(world, seed, current[:, None, None] * shape)) == [False]


@pytest.mark.parametrize("seed", range(3))
def test_drift_is_no_pass_over_a_known_tag(seed: int, world: Any) -> None:
    """Sensors that warm up, each axis at its own rate."""
    rng = np.random.default_rng(seed)
    drift = 8e-6 * rng.standard_normal((1, 9, 3))
    change = drift * (1 - np.exp(-np.arange(300)[:, None, None] / rng.uniform(10, 60, (9, 3))))
    recording = rest(world, seed, change)
    field_t = least_magnet_field(recording, 1.8e-3, 0.01)
    results = is_pass(recording, magnet_field_t=field_t)
    assert results
    assert not any(results)


@pytest.mark.parametrize("seed", range(3))
def test_a_pass_is_one_even_over_a_weak_magnet(seed: int, world: Any) -> None:
    """A single magnet of a third of the design's field, and the end of the bar over a tag."""
    rng = np.random.default_rng(seed)
    kinds = (
        ({"strength": (0.6, 0.0, 0.0, 0.0, 0.0), "heading": rng.uniform(0, 6)}, 0.012, 0.0),
        ({"heading": rng.uniform(-0.1, 0.1)}, 0.011, 0.125),
    )
    for shape, clearance, lateral in kinds:
        tag = world.Tag(CELLS, SYMBOLS, **shape)
        course = world.line(length=0.4, lateral=lateral)
        recording = world.record([tag], course, clearance=clearance, noise=0.9e-6, seed=seed)
        field_t = least_magnet_field(recording, 1.8e-3, 0.01)
        assert is_pass(recording, magnet_field_t=field_t) == [True]


def test_a_path_at_rest_is_no_pass(world: Any) -> None:
    recording = world.record([world.Tag(CELLS, SYMBOLS)], world.line(length=0.4))
    path = np.linspace(0, 0.4, len(recording))
    assert is_pass(recording, path_m=path) == [True]
    assert is_pass(recording, path_m=1e-3 * path) == [False]


def test_the_field_of_a_magnet_between_sensors(world: Any) -> None:
    """Against magpylib, for the midpoint of two sensors and a moment along the track or across."""
    recording = world.record([], world.line(), array=world.bar(2, 0.03))
    fields = []
    for moment in ((1e-3, 0, 0), (0, 1e-3, 0)):
        magnet = magpylib.misc.Dipole(moment=moment, position=(0, 0, -0.012))
        fields.append(np.linalg.norm(magnet.getB(recording.array.position_m)))
    assert least_magnet_field(recording, 1e-3, 0.012) == pytest.approx(min(fields))
