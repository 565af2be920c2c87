"""Grouping of sweeps into epochs: reports, unsynchronised rotors, and each limit by itself."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from locatk.core.kernels import kernels
from locatk.core.lighthouse import epochs as limits
from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.epochs import Epochs, group_epochs
from locatk.core.lighthouse.recording import Sweeps

Array = NDArray[np.float64]


def position_at(t: Array) -> Array:
    """Return positions (n, 3) of a receiver that moves at up to 1 m/s."""
    return np.stack([0.8 * np.cos(0.9 * t), 0.7 * np.sin(1.3 * t), 0.4 + 0.3 * np.sin(t)], -1)


def count_errors(epochs: Epochs, lamps: Any, start_ns: int) -> Array:
    """Return counts minus those that each station has at the time of the epoch."""
    t = (epochs.time_ns - start_ns) * 1e-9
    true = [lamp.counts(lamp.angles(position_at(t))) for lamp in lamps]
    return epochs.counts - np.stack(true, axis=1)


def assert_same(a: Epochs, b: Epochs) -> None:
    for name in ("time_ns", "device", "channels", "counts"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert a.rejected == b.rejected
    assert a.devices == b.devices


@pytest.fixture(scope="module")
def report(world: Any) -> Any:
    lamps = world.lamps(2, 5)
    return world.drive(lamps, world.curve(40, flat=True))


def test_a_report_is_an_epoch(report: Any) -> None:
    epochs = group_epochs(report.sweeps)
    np.testing.assert_array_equal(epochs.counts, report.counts)
    np.testing.assert_array_equal(epochs.time_ns, report.time_ns)
    np.testing.assert_array_equal(epochs.channels, [2, 5])
    assert epochs.rejected == {}
    assert epochs.labelled


def random_sweeps(n: int) -> Sweeps:
    """Return sweeps with silences, long epochs, planes that occur again, and invalid counts."""
    rng = np.random.default_rng(4)
    return Sweeps(
        devices=("a", "b", "c", "d"),
        time_ns=np.cumsum(rng.choice([0, 1, 5_000_000, 25_000_000], n)),
        device=rng.choice([0, 1, 3], n).astype(np.int32),
        sensor=rng.integers(0, 3, n, np.int32),
        channel=rng.integers(1, 6, n, np.int32),
        polynomial=np.full(n, -1, np.int32),
        sweep=rng.integers(-1, 2, n, np.int32),
        count=rng.uniform(-1e3, 1.3e5, n),
    )


@pytest.mark.parametrize("size", [1, 700, 2500])
def test_blocks_do_not_change_the_epochs(size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    sweeps = random_sweeps(5000)
    at_once = group_epochs(sweeps)
    monkeypatch.setattr(limits, "SWEEPS_PER_BLOCK", size)
    assert_same(at_once, group_epochs(sweeps))
    assert len(at_once.devices) == 9


@pytest.mark.skipif(kernels is None, reason="the compiled kernels were not built")
def test_the_kernel_equals_its_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    sweeps = random_sweeps(5000)
    compiled = group_epochs(sweeps)
    monkeypatch.setattr(limits, "kernels", None)
    assert_same(compiled, group_epochs(sweeps))
    assert len(compiled) > 500


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_sweeps_may_be_in_any_order(report: Any, world: Any, seed: int) -> None:
    sweeps = report.sweeps
    shuffled = world.take(sweeps, np.random.default_rng(seed).permutation(len(sweeps)))
    assert_same(group_epochs(shuffled), group_epochs(sweeps))


def test_the_counts_of_a_pair_may_be_in_either_order(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    turned = world.take(sweeps, np.arange(len(sweeps)).reshape(-1, 2)[:, ::-1].ravel())
    assert_same(group_epochs(turned), group_epochs(sweeps))


def test_a_reported_plane_is_used(report: Any, world: Any) -> None:
    sweeps = replace(report.sweeps, sweep=np.tile(np.array([0, 1], np.int32), 80))
    assert_same(group_epochs(sweeps), group_epochs(report.sweeps))
    # A single sweep is used if its plane is reported.
    second = world.take(sweeps, np.flatnonzero(sweeps.sweep == 1))
    counts = group_epochs(second).counts
    assert np.isnan(counts[..., 0]).all()
    np.testing.assert_array_equal(counts[..., 1], report.counts[..., 1])


def test_a_missing_sweep_does_not_affect_other_stations(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    gone = 4 * 7 + 1  # second plane of channel 2 in report 7
    epochs = group_epochs(world.take(sweeps, np.delete(np.arange(len(sweeps)), gone)))
    assert len(epochs) == 40
    np.testing.assert_array_equal(epochs.counts[7, 1], report.counts[7, 1])
    # The remaining first plane is used as such or rejected: it is never taken for the second.
    assert np.isnan(epochs.counts[7, 0, 1])
    assert epochs.counts[7, 0, 0] == report.counts[7, 0, 0] or epochs.rejected == {
        "plane_unknown": 1
    }


def test_a_repeated_report_is_used_once(report: Any, world: Any) -> None:
    epochs = group_epochs(world.join(report.sweeps, report.sweeps))
    np.testing.assert_array_equal(epochs.counts, report.counts)
    assert epochs.rejected == {"repeated_in_rotation": len(report.sweeps)}


def test_a_repeated_report_with_planes_is_used_once(report: Any, world: Any) -> None:
    sweeps = replace(report.sweeps, sweep=np.tile(np.array([0, 1], np.int32), 80))
    epochs = group_epochs(world.join(sweeps, sweeps))
    np.testing.assert_array_equal(epochs.counts, report.counts)
    assert epochs.rejected == {"repeated_in_rotation": len(sweeps)}


def test_two_sweeps_of_one_plane_are_not_a_pair(report: Any, world: Any) -> None:
    sweeps = report.sweeps
    first = world.take(sweeps, np.arange(0, len(sweeps), 2))
    again = replace(first, count=first.count + 3)
    counts = group_epochs(world.join(first, again)).counts
    # The second plane follows by about a third of a rotation, never by three steps.
    assert not np.isfinite(counts).all(axis=2).any()


def test_only_known_channels_and_counts_within_a_rotation_are_used(report: Any) -> None:
    sweeps = report.sweeps
    channel, count = sweeps.channel.copy(), sweeps.count.copy()
    channel[[0, 1]] = 0
    channel[[4, 5]] = 17
    count[[8, 9]] = 119_876  # a rotation of channel 2 has 119,625 steps
    count[[12, 13]] = np.nan, -1
    epochs = group_epochs(replace(sweeps, channel=channel, count=count))
    assert epochs.rejected == {"unknown_channel": 4, "count_above_period": 4}
    np.testing.assert_array_equal(epochs.channels, [2, 5])
    np.testing.assert_array_equal(np.isnan(epochs.counts[:4, 0]).all(axis=1), True)
    np.testing.assert_array_equal(epochs.counts[:4, 1], report.counts[:4, 1])
    np.testing.assert_array_equal(epochs.counts[4:], report.counts[4:])


@pytest.mark.parametrize("invalid", [{"channel": 17}, {"count": 2e5}, {"count": np.nan}])
def test_invalid_sweeps_give_no_epoch(report: Any, invalid: dict[str, float]) -> None:
    sweeps = report.sweeps
    columns = {
        name: np.full(len(sweeps), value, getattr(sweeps, name).dtype)
        for name, value in invalid.items()
    }
    epochs = group_epochs(replace(sweeps, **columns))
    assert len(epochs) == 0
    assert sum(epochs.rejected.values()) == len(sweeps)


def test_no_sweep_gives_no_epoch(report: Any, world: Any) -> None:
    epochs = group_epochs(world.take(report.sweeps, np.zeros(0, np.int64)))
    assert len(epochs) == 0
    assert not epochs.labelled


def test_labelled_means_that_all_sweeps_have_a_polynomial(report: Any) -> None:
    sweeps = report.sweeps
    assert not group_epochs(replace(sweeps, polynomial=np.full(len(sweeps), -1, np.int32))).labelled
    some = sweeps.polynomial.copy()
    some[5] = -1
    assert not group_epochs(replace(sweeps, polynomial=some)).labelled


def test_devices_and_photodiodes_have_epochs_of_their_own(world: Any) -> None:
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
def test_unsynchronised_sweeps_are_interpolated_to_one_time(
    world: Any, channels: tuple[int, ...]
) -> None:
    lamps = world.lamps(*channels)
    sweeps = world.stream(lamps, position_at, 4.0)
    epochs = group_epochs(sweeps)
    assert 195 <= len(epochs) <= 220
    error = count_errors(epochs, lamps, world.start_ns)
    # In 20 ms the receiver moves by 100 counts and more; a count is 50 microradians.
    worst = np.nanmax(np.abs(error))
    assert worst < 3
    seen = np.isfinite(epochs.counts).all(axis=2).mean()
    assert seen > (0.8 if 16 in channels else 0.9)


def test_interpolation_changes_the_counts_of_a_moving_receiver(world: Any) -> None:
    # The test above can fail: raw counts differ from interpolated ones.
    lamps = world.lamps(1, 2)
    sweeps = world.stream(lamps, position_at, 4.0)
    epochs = group_epochs(sweeps)
    raw = np.sort(sweeps.count[sweeps.channel == 1])
    moved = np.sort(epochs.counts[:, 0].ravel())
    moved = moved[np.isfinite(moved)]
    assert len(np.setdiff1d(np.rint(moved), raw)) > 0.3 * len(moved)


def test_lost_sweeps_do_not_mix_up_planes(world: Any) -> None:
    lamps = world.lamps(1, 2, 5, 16)
    sweeps = world.stream(lamps, position_at, 6.0)
    kept = np.flatnonzero(np.random.default_rng(0).random(len(sweeps)) > 0.2)
    epochs = group_epochs(world.take(sweeps, kept))
    error = np.abs(count_errors(epochs, lamps, world.start_ns))
    error = error[np.isfinite(error)]
    # The same plane of two rotations must not be taken for both planes of one, which would be
    # an error of a third of a rotation, 40,000 counts.
    assert np.count_nonzero(error > 1000) == 0
    assert np.percentile(error, 99) < 10


def test_every_sweep_is_used_or_counted_as_rejected(world: Any) -> None:
    lamps = world.lamps(1, 2, 16)
    sweeps = world.stream(lamps, position_at, 4.0)
    kept = np.flatnonzero(np.random.default_rng(1).random(len(sweeps)) > 0.1)
    epochs = group_epochs(world.take(sweeps, kept))
    used = np.count_nonzero(np.isfinite(epochs.counts))
    assert used + sum(epochs.rejected.values()) == len(kept)


@pytest.mark.parametrize("degrees", [2.5, -3.0, 10.0])
def test_spikes_are_rejected_and_counted(world: Any, degrees: float) -> None:
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


def test_a_lasting_change_is_motion(world: Any) -> None:
    lamps = world.lamps(1)
    points = np.repeat([[0.0, 0.0, 0.0], [0.5, 0.4, 0.0]], 10, axis=0)
    epochs = group_epochs(world.drive(lamps, points).sweeps)
    assert epochs.rejected == {}


def test_neighbours_after_a_gap_do_not_contradict_a_sweep(world: Any) -> None:
    drive = world.drive(world.lamps(1), world.curve(30, flat=True), step_s=1.1)
    drive.turned(np.array([10]), 0, 0, np.radians(4))
    assert group_epochs(drive.sweeps).rejected == {}


def test_take_selects_epochs(report: Any) -> None:
    epochs = group_epochs(report.sweeps)
    some = epochs.take(np.array([3, 5]))
    assert len(some) == 2
    np.testing.assert_array_equal(some.counts, epochs.counts[[3, 5]])
    np.testing.assert_array_equal(some.time_ns, epochs.time_ns[[3, 5]])


def test_sweeps_have_a_length(report: Any) -> None:
    assert isinstance(report.sweeps, Sweeps)
    assert len(report.sweeps) == 160


# ---- limits, each by itself

PERIOD = float(period_counts(1))
MS = 1_000_000
PAIR = (40_000.0, 80_000.0)
"""Counts of both planes straight ahead."""


def make_sweeps(*rows: tuple[float, ...], sensor: int = 0) -> Sweeps:
    """Make sweeps of rows (time in ns, count[, channel[, plane[, device]]])."""
    defaults = (0.0, 0.0, 1, -1, 0)
    time_ns, count, channel, plane, device = np.array(
        [(*row, *defaults[len(row) :]) for row in rows]
    ).T
    n = len(rows)
    return Sweeps(
        devices=("robot", "other"),
        time_ns=1_000_000_000_000 + time_ns.astype(np.int64),
        device=device.astype(np.int32),
        sensor=np.full(n, sensor, np.int32),
        channel=channel.astype(np.int32),
        polynomial=2 * (channel.astype(np.int32) - 1),
        sweep=plane.astype(np.int32),
        count=count,
    )


@pytest.mark.parametrize(("delay_ns", "paired"), [(10_500_000, True), (10_500_001, False)])
def test_the_second_plane_follows_within_the_pair_delay(delay_ns: int, paired: bool) -> None:
    epochs = group_epochs(make_sweeps((0, PAIR[0]), (delay_ns, PAIR[1])))
    assert epochs.rejected == ({} if paired else {"plane_unknown": 2})
    if paired:
        np.testing.assert_array_equal(epochs.counts, [[PAIR]])


@pytest.mark.parametrize(
    ("turns", "paired"), [(0.124, False), (0.126, True), (0.549, True), (0.551, False)]
)
def test_the_counts_of_a_pair_differ_by_the_plane_delay(turns: float, paired: bool) -> None:
    first = 1_000.0
    epochs = group_epochs(make_sweeps((0, first), (6 * MS, first + turns * PERIOD)))
    assert epochs.rejected == ({} if paired else {"plane_unknown": 2})


def test_sweeps_of_two_stations_or_photodiodes_are_not_a_pair() -> None:
    assert group_epochs(make_sweeps((0, PAIR[0]), (0, PAIR[1], 2))).rejected == {"plane_unknown": 2}
    other = group_epochs(make_sweeps((0, PAIR[0]), (0, PAIR[1], 1, -1, 1)))
    assert other.rejected == {"plane_unknown": 2}


def test_of_three_linked_sweeps_the_first_two_are_a_pair() -> None:
    counts = (10_000.0, 50_000.0, 90_000.0)
    epochs = group_epochs(make_sweeps(*((6 * MS * k, c) for k, c in enumerate(counts))))
    assert epochs.rejected == {"plane_unknown": 1}
    np.testing.assert_array_equal(epochs.counts[0], [counts[:2]])


def test_three_sweeps_with_one_time_stamp_are_ambiguous() -> None:
    counts = (10_000.0, 50_000.0, 90_000.0)
    crowd = group_epochs(make_sweeps(*((0, c) for c in counts)))
    assert crowd.rejected == {"plane_unknown": 3}
    # A possible pair of the last two is as ambiguous, and so are two possible pairs.
    for counts_of_crowd in ((10_000.0, 11_000.0, 51_000.0), (1e3, 2.5e4, 5e4, 7.5e4)):
        ambiguous = group_epochs(make_sweeps(*((0, c) for c in counts_of_crowd)))
        assert ambiguous.rejected == {"plane_unknown": len(counts_of_crowd)}
    # Reported planes resolve it.
    planes = (0, 1, -1)
    known = group_epochs(make_sweeps(*((0, c, 1, p) for c, p in zip(counts, planes, strict=True))))
    assert known.rejected == {"plane_unknown": 1}
    np.testing.assert_array_equal(known.counts, [[counts[:2]]])
    # Two sweeps with the stamp and one after it are a pair and a single sweep.
    after = group_epochs(make_sweeps((0, counts[0]), (0, counts[1]), (1, counts[2])))
    assert after.rejected == {"plane_unknown": 1}


def test_a_crowd_ends_with_its_station_and_photodiode() -> None:
    pairs = [(0, count, channel) for channel in (1, 2, 3) for count in PAIR]
    assert group_epochs(make_sweeps(*pairs)).rejected == {}
    pairs = [(0, count, 1, -1, device) for device in (0, 1) for count in PAIR]
    assert group_epochs(make_sweeps(*pairs)).rejected == {}


@pytest.mark.parametrize(("end_ns", "number"), [(30_000_000, 1), (30_000_001, 2)])
def test_an_epoch_ends_after_its_longest_duration(end_ns: int, number: int) -> None:
    epochs = group_epochs(make_sweeps((0, 4e4, 1, 0), (15 * MS, 4e4, 2, 0), (end_ns, 4e4, 3, 0)))
    assert len(epochs) == number


@pytest.mark.parametrize(("silence_ns", "number"), [(20_000_000, 1), (20_000_001, 2)])
def test_an_epoch_ends_with_a_silence(silence_ns: int, number: int) -> None:
    epochs = group_epochs(make_sweeps((0, 4e4, 1, 0), (silence_ns, 4e4, 2, 0)))
    assert len(epochs) == number


def test_an_epoch_is_of_one_photodiode() -> None:
    epochs = group_epochs(make_sweeps((0, 4e4, 1, 0, 0), (1 * MS, 4e4, 2, 0, 1)))
    np.testing.assert_array_equal(epochs.device, [0, 1])


def test_an_epoch_ends_when_a_plane_occurs_again() -> None:
    again = group_epochs(make_sweeps((0, 4e4, 1, 0), (5 * MS, 4.1e4, 1, 0)))
    assert len(again) == 2
    second = group_epochs(make_sweeps((0, 4e4, 1, 0), (5 * MS, 8e4, 1, 1)))
    assert len(second) == 1


def test_a_pair_is_never_split() -> None:
    # The pair of channel 2 has its mean within the epoch, and its second sweep after its end.
    rows = [(0, PAIR[0]), (8 * MS, PAIR[1]), (28 * MS, PAIR[0], 2), (38 * MS, PAIR[1], 2)]
    epochs = group_epochs(make_sweeps(*rows, (17 * MS, 4e4, 3, 0)))
    assert len(epochs) == 1
    assert np.isfinite(epochs.counts[0, :2]).all()


@pytest.mark.parametrize(
    ("count", "reason"),
    [(0.0, None), (PERIOD - 1, None), (PERIOD, "count_above_period"), (-1.0, "count_above_period")],
)
def test_a_count_is_within_one_rotation(count: float, reason: str | None) -> None:
    epochs = group_epochs(make_sweeps((0, count, 1, 0)))
    assert epochs.rejected == ({} if reason is None else {reason: 1})


def spike_sweeps(degrees: float, *, step_ms: float = 20, after: float = 0.0) -> Sweeps:
    """Make single sweeps of a robot at rest, the middle one off by ``degrees``.

    ``after`` is the offset of the last two in degrees.
    """
    offsets = np.array([0.0, 0.0, degrees, after, after]) / 360 * PERIOD
    return make_sweeps(
        *((k * step_ms * MS, 4e4 + offset, 1, 0) for k, offset in enumerate(offsets))
    )


@pytest.mark.parametrize(("degrees", "spikes"), [(1.99, 0), (2.01, 1), (-1.99, 0), (-2.01, 1)])
def test_spikes_exceed_two_degrees(degrees: float, spikes: int) -> None:
    assert group_epochs(spike_sweeps(degrees)).rejected.get("spike", 0) == spikes


@pytest.mark.parametrize(("after", "spikes"), [(1.9, 1), (2.1, 0)])
def test_the_neighbours_of_a_spike_agree(after: float, spikes: int) -> None:
    assert group_epochs(spike_sweeps(5.0, after=after)).rejected.get("spike", 0) == spikes


@pytest.mark.parametrize(("degrees", "after"), [(3.0, 1.5), (1.5, -1.0)])
def test_a_step_that_one_neighbour_confirms_is_no_spike(degrees: float, after: float) -> None:
    assert group_epochs(spike_sweeps(degrees, after=after)).rejected == {}


@pytest.mark.parametrize(("step_ms", "spikes"), [(499.0, 1), (500.0, 0)])
def test_the_neighbours_of_a_spike_are_within_a_second(step_ms: float, spikes: int) -> None:
    assert group_epochs(spike_sweeps(3.0, step_ms=step_ms)).rejected.get("spike", 0) == spikes


def test_the_neighbours_of_a_spike_are_of_its_device() -> None:
    rows = [(k * 20 * MS, 4e4 + (1e3 if k == 1 else 0), 1, 0, int(k == 2)) for k in range(3)]
    assert group_epochs(make_sweeps(*rows)).rejected == {}


@pytest.mark.parametrize(("step_ms", "moved"), [(249.0, True), (250.0, False)])
def test_counts_are_interpolated_between_near_neighbours_only(step_ms: float, moved: bool) -> None:
    # Both stations see a count that grows by 1,000 a second, channel 2 10 ms after channel 1.
    rows = [
        (time_ms * MS, 4e4 + time_ms, channel, 0)
        for k in range(3)
        for channel, time_ms in ((1, k * step_ms), (2, k * step_ms + 10))
    ]
    counts = group_epochs(make_sweeps(*rows)).counts[1, :, 0] - 4e4
    expected = [step_ms + 5, step_ms + 5] if moved else [step_ms, step_ms + 10]
    np.testing.assert_allclose(counts, expected, atol=1e-6)


def test_interpolation_uses_one_photodiode_only() -> None:
    # The other device has the same times and very different counts.
    rows = [
        (time_ms * MS, 4e4 + time_ms + 1e4 * device, channel, 0, device)
        for device in (0, 1)
        for k in range(3)
        for channel, time_ms in ((1, k * 100), (2, k * 100 + 10))
    ]
    epochs = group_epochs(make_sweeps(*rows))
    for device in (0, 1):
        counts = epochs.counts[epochs.device == device, :, 0] - 4e4 - 1e4 * device
        np.testing.assert_allclose(counts, [[k * 100 + 5] * 2 for k in range(3)], atol=1e-6)


def test_repeated_sweeps_are_counted_once() -> None:
    once = [(0, PAIR[0]), (0, PAIR[1])]
    epochs = group_epochs(make_sweeps(*once, *once, once[0]))
    assert epochs.rejected == {"repeated_in_rotation": 3}
    np.testing.assert_array_equal(epochs.counts, [[PAIR]])


def test_limits_admit_every_channel() -> None:
    # Half of the slowest rotation is a possible pair; a report holds a rotation of each station.
    slowest_ns = max(float(period_counts(channel)) for channel in range(1, 17)) / 6e6 * 1e9
    assert slowest_ns / 2 < limits.MAX_PAIR_DELAY_NS < slowest_ns
    assert slowest_ns < limits.MAX_SILENCE_NS < limits.MAX_EPOCH_NS < 2 * slowest_ns
