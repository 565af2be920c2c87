"""Standstills of devices, from sweeps alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from locatk.core.lighthouse.recording import Sweeps
from locatk.core.lighthouse.scene.standstills import find_standstills

from .rooms import START_NS, Stay, room, sweeps_of

STAYS = (
    Stay((0.0, 0.0, 0.0)),
    Stay((1.0, 0.0, 0.0), rest_s=2.0),
    Stay((1.0, 1.0, 0.0), rest_s=5.0, move_s=4.0),
    Stay((0.0, 1.0, 0.3), rest_s=1.0),  # too short
    Stay((-1.0, 1.0, 0.0)),
)
RESTS_S = ((0.0, 3.0), (4.5, 6.5), (8.0, 13.0), (19.5, 22.5))


def found_s(sweeps: Sweeps) -> list[tuple[float, float]]:
    return [
        (1e-9 * (each.start_ns - START_NS), 1e-9 * (each.end_ns - START_NS))
        for each in find_standstills(sweeps)
    ]


def check(sweeps: Sweeps, slack_s: float = 0.6) -> None:
    found = found_s(sweeps)
    assert len(found) == len(RESTS_S)
    for (start, end), (true_start, true_end) in zip(found, RESTS_S, strict=True):
        # Within the rest, up to half of a window of 0.25 s.
        assert true_start - 0.13 < start < true_start + slack_s
        assert true_end - slack_s < end < true_end + 0.13


@pytest.mark.parametrize("noise_rad", [2e-5, 1e-4, 4e-4])
@pytest.mark.parametrize("stations", [1, 2, 4])
def test_rests_are_found_to_a_quarter_of_a_second(noise_rad: float, stations: int) -> None:
    rng = np.random.default_rng(20 + stations)
    check(sweeps_of(room(rng, stations), STAYS, rng, noise_rad=noise_rad))


def test_planes_may_be_unknown_and_sweeps_wrong() -> None:
    rng = np.random.default_rng(31)
    sweeps = sweeps_of(room(rng, 2), STAYS, rng)
    sweeps = replace(sweeps, sweep=np.full_like(sweeps.sweep, -1))
    wrong = rng.random(len(sweeps)) < 0.1
    count = np.where(wrong, rng.uniform(0, 119000, len(sweeps)), sweeps.count)
    check(replace(sweeps, count=count))


def test_a_device_with_several_photodiodes_rests_once() -> None:
    rng = np.random.default_rng(32)
    offsets = ((0.02, 0.01, 0), (-0.02, 0.01, 0), (0.02, -0.01, 0), (-0.02, -0.01, 0))
    sweeps = sweeps_of(room(rng, 2), STAYS, rng, offsets=offsets)
    check(sweeps)
    assert {each.device for each in find_standstills(sweeps)} == {"robot"}


def test_a_drone_that_hovers_does_not_rest() -> None:
    """It drifts by centimetres; a device in a hand trembles as much."""
    rng = np.random.default_rng(33)
    sweeps = sweeps_of(room(rng, 2), (Stay((0, 0, 1), 30.0),), rng, wobble_m=0.02)
    assert find_standstills(sweeps) == []


def test_a_slow_motion_is_no_rest() -> None:
    rng = np.random.default_rng(34)
    stays = (Stay((0, 0, 0), 0.1, 40.0), Stay((0.4, 0, 0), 0.1))  # 10 mm/s
    assert find_standstills(sweeps_of(room(rng, 2), stays, rng)) == []


def test_interrupted_light_does_not_divide_a_rest() -> None:
    rng = np.random.default_rng(35)
    sweeps = sweeps_of(room(rng, 2), STAYS, rng)
    time_s = 1e-9 * (sweeps.time_ns - START_NS)
    hidden = (time_s > 9.0) & (time_s < 11.5)
    check(sweeps.take(~hidden))


def test_a_station_by_reflection_does_not_end_a_rest() -> None:
    rng = np.random.default_rng(36)
    sweeps = sweeps_of(room(rng, 4), STAYS, rng)
    time_s = 1e-9 * (sweeps.time_ns - START_NS)
    reflected = (sweeps.channel == 2) & (time_s > 10.0) & (time_s < 11.0)
    check(replace(sweeps, count=np.where(reflected, sweeps.count + 3000, sweeps.count)))


def test_devices_are_separate_and_ordered_by_time() -> None:
    rng = np.random.default_rng(37)
    scene = room(rng, 2)
    first = sweeps_of(scene, (Stay((0, 0, 0), 2.0), Stay((1, 0, 0), 3.0)), rng, device="a")
    second = sweeps_of(scene, (Stay((0, 1, 0), 0.1), Stay((1, 1, 0), 4.0)), rng, device="b")
    both = Sweeps(
        ("a", "b"),
        *(np.r_[getattr(first, name), getattr(second, name)] for name in ("time_ns",)),
        np.r_[first.device, second.device + 1].astype(np.int32),
        *(
            np.r_[getattr(first, name), getattr(second, name)]
            for name in ("sensor", "channel", "polynomial", "sweep", "count")
        ),
    )
    assert [each.device for each in find_standstills(both)] == ["a", "b", "a"]
    assert find_standstills(both.take(np.zeros(len(both), bool))) == []


def test_the_stations_of_a_rest() -> None:
    rng = np.random.default_rng(38)
    sweeps = sweeps_of(room(rng, 4), STAYS, rng)
    time_s = 1e-9 * (sweeps.time_ns - START_NS)
    sweeps = sweeps.take(~((sweeps.channel == 3) & (time_s < 4.0)))
    first, second, *_ = find_standstills(sweeps)
    assert (first.channels, second.channels) == ((1, 2, 4), (1, 2, 3, 4))
    assert second.duration_s == pytest.approx(1.75, abs=0.26)


def test_many_wrong_sweeps_do_not_divide_a_rest() -> None:
    """One of ten sweeps is anywhere; in some windows of some planes most are."""
    rng = np.random.default_rng(39)
    sweeps = sweeps_of(room(rng, 2), STAYS, rng)
    time_s = 1e-9 * (sweeps.time_ns - START_NS)
    window = (4 * time_s).astype(int)
    is_glitch = (window % 5 == sweeps.channel % 5) & (sweeps.sweep == window % 2)
    wrong = np.where(is_glitch, rng.random(len(sweeps)) < 0.8, rng.random(len(sweeps)) < 0.1)
    count = sweeps.count + np.where(wrong, rng.normal(0, 500, len(wrong)), 0.0)
    check(replace(sweeps, count=count), slack_s=0.9)


def test_devices_that_report_rarely() -> None:
    """A DotBot reports ten times a second."""
    rng = np.random.default_rng(40)
    sweeps = sweeps_of(room(rng, 2), STAYS, rng)
    number = ((sweeps.time_ns - START_NS) // 20_000_000).astype(int)
    found = found_s(sweeps.take(number % 5 == 0))
    assert len(found) == len(RESTS_S)
    for (start, end), (true_start, true_end) in zip(found, RESTS_S, strict=True):
        assert true_start - 0.3 < start < end < true_end + 0.3
        assert end - start > 0.9


def test_a_person_who_passes_does_not_divide_a_rest() -> None:
    rng = np.random.default_rng(41)
    sweeps = sweeps_of(room(rng, 2), STAYS, rng)
    time_s = 1e-9 * (sweeps.time_ns - START_NS)
    passing = (time_s > 10.0) & (time_s < 10.4)
    check(replace(sweeps, count=np.where(passing, sweeps.count + 2000, sweeps.count)))


def test_a_motion_towards_a_station_is_seen_by_the_other() -> None:
    rng = np.random.default_rng(42)
    scene = room(rng, 2)
    first = scene.stations[0].position
    near, far = 0.3 * first, -0.2 * first
    stays = (Stay(tuple(near), 0.05, 8.0), Stay(tuple(far), 0.05))  # 0.2 m/s
    assert find_standstills(sweeps_of(scene, stays, rng)) == []
