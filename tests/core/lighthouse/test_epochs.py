"""Sweeps that belong together, from reports and from rotors that turn freely."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.lighthouse.epochs import Epochs, group_epochs
from locatk.core.lighthouse.recording import Sweeps

Array = NDArray[np.float64]


def where(t: Array) -> Array:
    """A receiver that is carried around at up to a metre a second."""
    return np.stack([0.8 * np.cos(0.9 * t), 0.7 * np.sin(1.3 * t), 0.4 + 0.3 * np.sin(t)], -1)


def missed(epochs: Epochs, lamps: Any, start_ns: int) -> Array:
    """Counts less what each lamp would show at the very instant of the epoch."""
    t = (epochs.time_ns - start_ns) * 1e-9
    true = [lamp.counts(lamp.angles(where(t))) for lamp in lamps]
    return epochs.counts - np.stack(true, axis=1)


def same(a: Epochs, b: Epochs) -> None:
    for name in ("time_ns", "device", "channels", "counts"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.rejected == b.rejected
    assert a.devices == b.devices


@pytest.fixture(scope="module")
def report(world: Any) -> Any:
    lamps = world.lamps(2, 5)
    return world.drive(lamps, world.curve(40, flat=True))


def test_a_report_is_a_moment(report: Any) -> None:
    epochs = group_epochs(report.sweeps)
    np.testing.assert_array_equal(epochs.counts, report.counts)
    np.testing.assert_array_equal(epochs.time_ns, report.time_ns)
    np.testing.assert_array_equal(epochs.channels, [2, 5])
    assert epochs.rejected == {}
    assert epochs.labelled


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_sweeps_come_in_any_order(report: Any, world: Any, seed: int) -> None:
    sweeps = report.sweeps
    shuffled = world.take(sweeps, np.random.default_rng(seed).permutation(len(sweeps)))
    same(group_epochs(shuffled), group_epochs(sweeps))


def test_the_counts_of_a_pair_come_in_either_order(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    turned = world.take(sweeps, np.arange(len(sweeps)).reshape(-1, 2)[:, ::-1].ravel())
    same(group_epochs(turned), group_epochs(sweeps))


def test_a_stated_sweep_is_believed(report: Any, world: Any) -> None:
    sweeps = replace(report.sweeps, sweep=np.tile(np.array([0, 1], np.int32), 80))
    same(group_epochs(sweeps), group_epochs(report.sweeps))
    # One plane alone is of use only where it is known which.
    second = world.take(sweeps, np.flatnonzero(sweeps.sweep == 1))
    counts = group_epochs(second).counts
    assert np.isnan(counts[..., 0]).all()
    np.testing.assert_array_equal(counts[..., 1], report.counts[..., 1])


def test_a_missing_sweep_costs_no_other_station(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    gone = 4 * 7 + 1  # second plane of channel 2 in report 7
    epochs = group_epochs(world.take(sweeps, np.delete(np.arange(len(sweeps)), gone)))
    assert len(epochs) == 40
    np.testing.assert_array_equal(epochs.counts[7, 1], report.counts[7, 1])
    # The lonely first plane keeps its place or is left out: it is never called the second.
    assert np.isnan(epochs.counts[7, 0, 1])
    assert epochs.counts[7, 0, 0] == report.counts[7, 0, 0] or epochs.rejected == {
        "plane_unknown": 1
    }


def test_a_report_that_is_there_twice_counts_once(report: Any, world: Any) -> None:
    epochs = group_epochs(world.join(report.sweeps, report.sweeps))
    np.testing.assert_array_equal(epochs.counts, report.counts)
    assert epochs.rejected == {"repeated_in_rotation": len(report.sweeps)}


def test_a_labelled_report_that_is_there_twice_counts_once(report: Any, world: Any) -> None:
    sweeps = replace(report.sweeps, sweep=np.tile(np.array([0, 1], np.int32), 80))
    epochs = group_epochs(world.join(sweeps, sweeps))
    np.testing.assert_array_equal(epochs.counts, report.counts)
    assert epochs.rejected == {"repeated_in_rotation": len(sweeps)}


def test_one_plane_twice_is_no_pair(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    first = world.take(sweeps, np.arange(0, len(sweeps), 2))
    again = replace(first, count=first.count + 3)
    counts = group_epochs(world.join(first, again)).counts
    # The second plane follows by about a third of a turn, never by three steps.
    assert not np.isfinite(counts).all(axis=2).any()


def test_only_known_channels_and_counts_within_a_rotation_are_used(report: Any) -> None:
    sweeps = report.sweeps
    channel, count = sweeps.channel.copy(), sweeps.count.copy()
    channel[[0, 1]] = 0
    channel[[4, 5]] = 17
    count[[8, 9]] = 119_876  # channel 2 turns in 119,625 steps
    count[[12, 13]] = np.nan, -1
    epochs = group_epochs(replace(sweeps, channel=channel, count=count))
    assert epochs.rejected == {"unknown_channel": 4, "count_above_period": 4}
    np.testing.assert_array_equal(epochs.channels, [2, 5])
    np.testing.assert_array_equal(np.isnan(epochs.counts[:4, 0]).all(axis=1), True)
    np.testing.assert_array_equal(epochs.counts[:4, 1], report.counts[:4, 1])
    np.testing.assert_array_equal(epochs.counts[4:], report.counts[4:])


@pytest.mark.parametrize("spoil", [{"channel": 17}, {"count": 2e5}, {"count": np.nan}])
def test_nothing_usable_is_no_moment(report: Any, spoil: dict[str, float]) -> None:
    sweeps = report.sweeps
    columns = {
        name: np.full(len(sweeps), value, getattr(sweeps, name).dtype)
        for name, value in spoil.items()
    }
    epochs = group_epochs(replace(sweeps, **columns))
    assert len(epochs) == 0
    assert sum(epochs.rejected.values()) == len(sweeps)


def test_no_sweep_is_no_moment(report: Any, world: Any) -> None:
    epochs = group_epochs(world.take(report.sweeps, np.zeros(0, np.int64)))
    assert len(epochs) == 0
    assert not epochs.labelled


def test_labels_are_named_only_where_all_have_one(report: Any) -> None:
    sweeps = report.sweeps
    assert not group_epochs(replace(sweeps, polynomial=np.full(len(sweeps), -1, np.int32))).labelled
    some = sweeps.polynomial.copy()
    some[5] = -1
    assert not group_epochs(replace(sweeps, polynomial=some)).labelled


def test_devices_and_photodiodes_are_kept_apart(world: Any) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(400, flat=True)[:40])
    drive.devices, drive.device = ("red", "blue"), np.arange(40, dtype=np.int32) % 2
    drive.time_ns[:] = world.start_ns + np.arange(40) // 2 * 100_000_000
    epochs = group_epochs(drive.sweeps)
    assert epochs.devices == ("red", "blue")
    for device in (0, 1):
        np.testing.assert_array_equal(
            epochs.counts[epochs.device == device], drive.counts[device::2]
        )

    sensor = np.repeat(np.where(drive.device == 0, 0, 3), 4).astype(np.int32)
    epochs = group_epochs(replace(drive.sweeps, device=np.zeros(160, np.int32), sensor=sensor))
    assert epochs.devices == ("red/0", "red/3")
    np.testing.assert_array_equal(epochs.counts[epochs.device == 1], drive.counts[1::2])


@pytest.mark.parametrize("channels", [(1,), (1, 2), (1, 2, 5), (2, 16)])
def test_sweeps_of_free_rotors_are_moved_to_one_instant(
    world: Any, channels: tuple[int, ...]
) -> None:
    lamps = world.lamps(*channels)
    sweeps = world.stream(lamps, where, 4.0)
    epochs = group_epochs(sweeps)
    assert 195 <= len(epochs) <= 220
    error = missed(epochs, lamps, world.start_ns)
    # In 20 ms the receiver moves by 100 counts and more; a count is 50 microradians.
    worst = np.nanmax(np.abs(error))
    assert worst < 3
    seen = np.isfinite(epochs.counts).all(axis=2).mean()
    assert seen > (0.8 if 16 in channels else 0.9)


def test_without_the_move_a_driving_receiver_would_be_off(world: Any) -> None:
    # That the test above can fail: the raw counts are off by far more.
    lamps = world.lamps(1, 2)
    sweeps = world.stream(lamps, where, 4.0)
    epochs = group_epochs(sweeps)
    raw = np.sort(sweeps.count[sweeps.channel == 1])
    moved = np.sort(epochs.counts[:, 0].ravel())
    moved = moved[np.isfinite(moved)]
    assert len(np.setdiff1d(np.rint(moved), raw)) > 0.3 * len(moved)


def test_free_rotors_with_lost_sweeps_are_not_mixed_up(world: Any) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    sweeps = world.stream(lamps, where, 6.0)
    kept = np.flatnonzero(np.random.default_rng(0).random(len(sweeps)) > 0.2)
    epochs = group_epochs(world.take(sweeps, kept))
    error = np.abs(missed(epochs, lamps, world.start_ns))
    error = error[np.isfinite(error)]
    # The same plane of two rotations must not be taken for both planes of one: a third of
    # a turn, 40,000 counts, wrong.
    assert np.count_nonzero(error > 1000) == 0
    assert np.percentile(error, 99) < 10


def test_every_sweep_is_used_or_counted(world: Any) -> None:
    lamps = world.lamps(1, 2, 16)
    sweeps = world.stream(lamps, where, 4.0)
    kept = np.flatnonzero(np.random.default_rng(1).random(len(sweeps)) > 0.1)
    epochs = group_epochs(world.take(sweeps, kept))
    used = np.count_nonzero(np.isfinite(epochs.counts))
    assert used + sum(epochs.rejected.values()) == len(kept)


@pytest.mark.parametrize("degrees", [2.5, -3.0, 10.0])
def test_single_jumps_are_dropped_and_counted(world: Any, degrees: float) -> None:
    lamps = world.lamps(1, 2)
    drive = world.drive(lamps, world.curve(800, flat=True))
    clean = drive.counts.copy()
    rows = np.array([20, 60, 61, 100])  # 60 and 61 on different planes
    drive.turned(rows[:2], 0, 0, np.radians(degrees))
    drive.turned(rows[2:], 1, 1, np.radians(degrees))
    epochs = group_epochs(drive.sweeps)
    assert epochs.rejected == {"spike": 4}
    assert np.isnan(epochs.counts[[20, 60], 0, 0]).all()
    assert np.isnan(epochs.counts[[61, 100], 1, 1]).all()
    kept = np.isfinite(epochs.counts)
    assert np.count_nonzero(~kept) == 4
    np.testing.assert_array_equal(epochs.counts[kept], clean[kept])


def test_a_jump_that_stays_is_motion(world: Any) -> None:
    lamps = world.lamps(1)
    points = np.repeat([[0.0, 0.0, 0.0], [0.5, 0.4, 0.0]], 10, axis=0)
    epochs = group_epochs(world.drive(lamps, points).sweeps)
    assert epochs.rejected == {}


def test_a_gap_hides_no_jump(world: Any) -> None:
    # Neighbours a second and more away say nothing of a sweep.
    drive = world.drive(world.lamps(1), world.curve(30, flat=True), step_s=1.1)
    drive.turned(np.array([10]), 0, 0, np.radians(4))
    assert group_epochs(drive.sweeps).rejected == {}


def test_take_keeps_the_chosen_moments(report: Any) -> None:
    epochs = group_epochs(report.sweeps)
    some = epochs.take(np.array([3, 5]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.counts, epochs.counts[[3, 5]])
    np.testing.assert_array_equal(some.time_ns, epochs.time_ns[[3, 5]])


def test_sweeps_know_their_number(report: Any) -> None:
    assert isinstance(report.sweeps, Sweeps)
    assert len(report.sweeps) == 160
