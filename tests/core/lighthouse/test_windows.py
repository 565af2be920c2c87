"""Windows of samples at a fixed rate, each by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.lighthouse import lfsr
from locatk.core.lighthouse.demodulation import identification
from locatk.core.lighthouse.demodulation.identification import identify_sequences, read_windows
from locatk.core.lighthouse.demodulation.soft_bits import demodulate_bursts, split_windows


def sampled(
    polynomial: int, index: int, late_ns: float, rate_hz: float = 32e6, size: int = 64
) -> NDArray[np.uint8]:
    """A window of light whose first bit begins ``late_ns`` after the first sample, drawn sample
    by sample from the definition of the line code."""
    first = index - 4
    ones = lfsr.state_at(first + np.arange(220), polynomial) >> 16
    levels, level = [], 0
    for one in ones.tolist():
        level ^= 1
        levels.append(level)
        level ^= one
        levels.append(level)
    when_ns = np.arange(8 * size) / rate_hz * 1e9 - late_ns + 4e9 / 6e6
    chip = np.floor(when_ns * 12e6 / 1e9 + 1e-9).astype(int)
    return np.packbits(np.array(levels, np.uint8)[chip])


def test_each_window_gives_polynomial_index_and_start() -> None:
    rng = np.random.default_rng(5)
    polynomial = rng.integers(0, 32, 300)
    index = rng.integers(10, 110_000, 300)
    late_ns = rng.uniform(0, 160, 300)
    rows = np.stack([sampled(*each) for each in zip(polynomial, index, late_ns, strict=True)])
    found = read_windows(rows)
    assert found.matches.is_certain().all()
    assert np.array_equal(found.matches.polynomial, polynomial)
    # The first bit that was read may be one of those before or after: its time says which.
    began_ns = found.first_bit_sample / 32e6 * 1e9
    true_ns = late_ns + (found.matches.index - index) * 1e9 / 6e6
    assert np.max(np.abs(began_ns - true_ns)) < 30


def test_blocks_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rows = np.stack([sampled(5, 1000 + 37 * k, 40.0) for k in range(50)])
    rows[7] = 0
    whole = read_windows(rows)
    monkeypatch.setattr(identification, "WINDOWS_PER_BLOCK", 7)
    parts = read_windows(rows)
    assert np.array_equal(whole.matches.index, parts.matches.index)
    assert np.allclose(whole.first_bit_sample, parts.first_bit_sample, atol=1e-6, equal_nan=True)
    assert np.isnan(whole.first_bit_sample[7])
    assert whole.matches.polynomial[7] == -1


def test_no_windows_have_no_matches() -> None:
    found = read_windows(np.zeros((0, 64), np.uint8))
    assert len(found.matches) == len(found.first_bit_sample) == 0


def test_only_so_many_polynomials() -> None:
    rows = np.stack([sampled(9, 5000, 10.0)])
    assert read_windows(rows).matches.polynomial[0] == 9
    assert not read_windows(rows, polynomials=8).matches.is_certain()[0]


def test_too_low_a_rate_is_refused() -> None:
    with pytest.raises(InputError, match="too few"):
        read_windows(np.zeros((1, 64), np.uint8), 12e6)


@pytest.mark.slow
def test_published_windows_are_read(data: Path) -> None:
    """More than the published decoder reads (79.6 %), and no station that is not there."""
    from locatk.formats.benchmarks.infrared import published_windows

    rows = published_windows(data / "lighthouse")
    matches = read_windows(rows).matches
    good = matches.is_certain()
    assert np.mean(good) > 0.95
    assert set(np.unique(matches.polynomial[good])) == {0, 1, 2, 3}
    again = identify_sequences(demodulate_bursts(split_windows(rows)))
    assert np.array_equal(again.index, matches.index)
