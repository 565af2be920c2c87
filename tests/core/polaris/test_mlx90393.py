"""The magnetometer's data sheet, against its tables and the published recordings."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.mlx90393 import (
    INVALID_OSR_AND_FILTER,
    MEASURED_NOISE_UT,
    Settings,
    published_bar,
    settings_for_rate,
)

CONVERSION_MS = (
    (1.27, 1.84, 3.00, 5.30),
    (1.46, 2.23, 3.76, 6.84),
    (1.84, 3.00, 5.30, 9.91),
    (2.61, 4.53, 8.37, 16.05),
    (4.15, 7.60, 14.52, 28.34),
    (7.22, 13.75, 26.80, 52.92),
    (13.36, 26.04, 51.38, 102.07),
    (25.65, 50.61, 100.53, 200.37),
)
"""The data sheet's table, by filter and oversampling (as in Adafruit's driver)."""

ALLOWED = [(o, f) for o in range(4) for f in range(8) if (o, f) not in INVALID_OSR_AND_FILTER]


@pytest.fixture(scope="module")
def recorded(data: Path) -> NDArray[np.float64]:
    """Rows (10, 150, 9, 3) in microtesla of the ten default runs while the car stood."""
    folder = data / "polaris" / "default"
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}")
    runs = []
    for path in sorted(folder.glob("RawData_*.csv")):
        with path.open(newline="") as stream:
            rows = list(csv.reader(stream))[1:151]
        cells = [re.findall(r"-?\d+\.?\d*(?:e-?\d+)?", " ".join(row[2:])) for row in rows]
        runs.append(np.array(cells, float).reshape(-1, 9, 3))
    return np.array(runs)


@pytest.mark.parametrize(("osr", "filt"), ALLOWED)
def test_conversion_time_follows_the_data_sheet(osr: int, filt: int) -> None:
    part = Settings(osr=osr, filt=filt)
    assert round(part.conversion_s * 1e3, 2) == CONVERSION_MS[filt][osr]
    assert part.max_rate_hz < 1 / part.conversion_s
    assert 3 * part.axis_s < part.conversion_s


def test_a_count_and_the_range() -> None:
    part = Settings()
    assert part.quantum_t == pytest.approx(np.array([0.150, 0.150, 0.242]) * 1e-6)
    assert part.range_t == pytest.approx([4.9e-3, 4.9e-3, 7.9e-3], rel=0.005)
    assert Settings(gain=0).quantum_t == pytest.approx(5 * part.quantum_t, rel=0.005)
    assert Settings(resolution=2).range_t == pytest.approx(4 * part.range_t)
    # At resolution 3 zero is at 0x4000: the range stays, the count doubles.
    assert Settings(resolution=3).range_t == pytest.approx(Settings(resolution=2).range_t)
    assert Settings(hallconf=0).quantum_t == pytest.approx(
        np.array([0.196, 0.196, 0.316]) * 1e-6, rel=0.001
    )


@pytest.mark.parametrize(
    "wrong",
    [
        {"gain": 8},
        {"gain": -1},
        {"resolution": 4},
        {"osr": 4},
        {"filt": 8},
        {"hallconf": 1},
        {"osr": 0, "filt": 1},
    ],
    ids=str,
)
def test_settings_that_the_part_has_not(wrong: dict[str, int]) -> None:
    with pytest.raises(InputError, match="MLX90393"):
        Settings(**wrong)


def test_noise_is_that_of_the_recordings(recorded: NDArray[np.float64]) -> None:
    noise = np.median(recorded.std(1), axis=(0, 1))
    assert noise == pytest.approx(MEASURED_NOISE_UT, rel=0.08)
    assert Settings().noise_t == pytest.approx(np.array(MEASURED_NOISE_UT) * 1e-6)


def test_recordings_are_whole_counts(recorded: NDArray[np.float64]) -> None:
    counts = recorded / (Settings().quantum_t * 1e6)
    assert np.abs(counts - np.rint(counts)).max() < 0.05


def test_noise_is_not_made_up() -> None:
    for other in (Settings(osr=2), Settings(filt=5), Settings(gain=6), Settings(resolution=1)):
        assert np.isnan(other.noise_t).all()
    usual = Settings().assumed_noise_t
    assert Settings(filt=5).assumed_noise_t == pytest.approx(usual)
    assert (Settings(osr=2).assumed_noise_t > 1.3 * usual).all()
    coarse = Settings(gain=0, resolution=3)
    assert coarse.assumed_noise_t == pytest.approx(coarse.quantum_t / np.sqrt(12))


def test_the_slowest_settings_that_are_fast_enough() -> None:
    chosen = settings_for_rate(100, Settings())
    assert chosen is not None
    assert (chosen.osr, chosen.filt) == (2, 3)
    assert settings_for_rate(61, Settings()) == Settings()
    assert settings_for_rate(1000, Settings()) is None
    kept = settings_for_rate(100, Settings(gain=5, resolution=1))
    assert kept is not None
    assert (kept.gain, kept.resolution) == (5, 1)


def test_the_bar_is_mounted_as_published() -> None:
    """The part looks right, back and down; it converts X, then Y, then Z."""
    noise = np.array([1.0, 2.0, 3.0]) * 1e-6
    array = published_bar(9, 0.02, noise_t=noise)
    assert len(array) == 9
    assert array.position_m[0].tolist() == [0, -0.08, 0]
    assert np.diff(array.position_m[:, 1]) == pytest.approx(0.02)
    # A field along an axis of the array is seen by this axis of the part:
    seen_by = {"x": 1, "y": 0, "z": 2}
    assert array.noise_t.tolist() == [noise[i] for i in seen_by.values()]
    assert array.range_t.tolist() == [Settings().range_t[i] for i in seen_by.values()]
    order = np.argsort(array.delay_s)
    assert order.tolist() == [1, 0, 2]
    assert array.delay_s.sum() == pytest.approx(0)
    assert np.diff(array.delay_s[order]) == pytest.approx(5.19e-3, rel=0.001)
    assert "osr 3 filt 3" in array.sensor


@pytest.mark.parametrize(("count", "spacing"), [(0, 0.02), (9, 0.0), (9, -1.0), (9, np.nan)])
def test_no_bar(count: int, spacing: float) -> None:
    with pytest.raises(InputError, match="no bar"):
        published_bar(count, spacing)
