"""The sixteen channels, against the tables of others and against recordings."""

from __future__ import annotations

import gzip
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from locatk.core.lighthouse import channels

RECORDED_TICKS = {
    1: 958999, 3: 952992, 4: 948995, 7: 940992, 8: 938997, 9: 936993,
    11: 918989, 12: 910995, 16: 886993,
}  # fmt: skip
"""Median time between sync pulses in the recordings of libsurvive-extras-data."""

RP2040_US = (
    19979, 19938, 19854, 19771, 19729, 19646, 19604, 19563,
    19521, 19354, 19146, 18979, 18896, 18771, 18604, 18479,
)  # fmt: skip
"""DotBots/lh2_on_rp2040."""

LIBSURVIVE_HZ = (
    50.0521, 50.1567, 50.3673, 50.5796, 50.6864, 50.9014, 51.0096, 51.1182,
    51.2273, 51.6685, 52.2307, 52.6894, 52.9217, 53.2741, 53.7514, 54.1150,
)  # fmt: skip


def test_periods_are_those_of_crazyflie(world: Any) -> None:
    assert dict(zip(channels.CHANNELS, channels.PERIOD_TICKS, strict=True)) == world.ticks


def test_periods_are_those_of_other_firmware() -> None:
    seconds = channels.period_ticks(np.arange(1, 17)) / channels.TICK_HZ
    np.testing.assert_allclose(seconds * 1e6, RP2040_US, atol=0.51)
    np.testing.assert_allclose(1 / seconds, LIBSURVIVE_HZ, atol=6e-5)


@pytest.mark.parametrize(("channel", "ticks"), RECORDED_TICKS.items())
def test_periods_are_those_recorded(channel: int, ticks: int) -> None:
    # The two peers' typing errors are off by 900 and 2000 ticks.
    assert abs(int(channels.period_ticks(channel)) - ticks) <= 20


def test_periods_are_those_of_the_published_recording(recordings: Path) -> None:
    path = recordings / "libsurvive" / "tracker-cal-attempt.rec.gz"
    syncs = defaultdict(list)
    with gzip.open(path, "rt", errors="replace") as lines:
        for line in lines:
            words = line.split()
            if len(words) == 7 and words[2] == "Y":
                syncs[int(words[3]) + 1].append(int(words[4]))
    periods = {
        channel: np.median(np.diff(np.array(times)) % (1 << 32))
        for channel, times in syncs.items()
        if len(times) > 100
    }
    assert len(periods) >= 2
    for channel, ticks in periods.items():
        assert abs(channels.period_ticks(channel) - ticks) < 30


def test_a_rotation_fits_into_the_sequence() -> None:
    counts = channels.period_counts(np.arange(1, 17))
    assert counts[0] == 119_875
    assert np.all(counts < 131_071)
    assert channels.period_counts(np.array([[1, 2], [16, 1]])).shape == (2, 2)


def test_polynomials_come_in_pairs() -> None:
    polynomial = np.arange(channels.POLYNOMIAL_COUNT)
    np.testing.assert_array_equal(channels.channel_of(polynomial), np.repeat(range(1, 17), 2))
    np.testing.assert_array_equal(channels.slow_bit_of(polynomial), np.tile([0, 1], 16))
