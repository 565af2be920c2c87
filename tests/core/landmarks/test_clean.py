"""Readings that are none are left out, and all others stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from locatk.core.landmarks.halls import HallSamples, HallSensors
from locatk.core.landmarks.preprocessing import FULL, cleaned
from locatk.core.solution import SolverWarning

Array = NDArray[np.float64]


def recorded(field: Array) -> HallSamples:
    time_ns = np.arange(len(field), dtype=np.int64) * 5_000_000
    return HallSamples("robot", HallSensors(), time_ns, field)


def waves() -> Array:
    """Bumps of 25 mT that are some 14 samples wide, as fast robots see them."""
    rng = np.random.default_rng(2)
    turn = np.linspace(0, 60, 400)[:, None] + np.arange(4)
    return np.asarray(0.025 * np.sin(turn) + rng.normal(0, 1.5e-4, turn.shape))


def test_single_jumps_are_left_out_and_counted() -> None:
    field = waves()
    at = [(50, 0), (51, 2), (200, 3), (333, 0)]
    for row, column in at:
        field[row, column] += 0.06 if field[row, column] > 0 else -0.06
    kept, warnings = cleaned(recorded(field))
    assert [tuple(where) for where in np.argwhere(np.isnan(kept))] == at
    assert warnings == [SolverWarning("spikes", "robot: 4 single readings jump; left out")]


def test_good_readings_stay_as_they_are() -> None:
    field = waves()
    kept, warnings = cleaned(recorded(field))
    assert (kept == field).all()
    assert warnings == []


def test_the_end_of_a_range_that_was_not_told_is_found() -> None:
    field = np.clip(waves(), -0.02, 0.02)
    kept, warnings = cleaned(recorded(field))
    assert (np.isnan(kept) == (np.abs(field) >= FULL * 0.02)).all()
    assert [each.code for each in warnings] == ["range_from_data", "saturated"]
    assert "readings end at 20 mT" in warnings[0].message
