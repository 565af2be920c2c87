"""What no sensor can have measured is taken out, and what one can is left."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.polaris.array import Samples, SensorArray, bar
from locatk.core.polaris.preprocessing import cleaned

NOISE = np.full((5, 3), 1e-6)


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
    found, warnings = cleaned(samples(), NOISE)
    np.testing.assert_array_equal(found.field_t, samples().field_t)
    assert warnings == ()


@pytest.mark.parametrize("at", [30, 100])
def test_a_misframed_row_goes(at: int) -> None:
    """At rest, and at the peak of a magnet."""
    made = samples()
    made.field_t[at] += 1e-3
    found, warnings = cleaned(made, NOISE)
    gone = changed(made, found)
    assert gone[at].all()
    assert gone.sum() == 15
    assert [each.code for each in warnings] == ["spikes"]
    assert "15 values" in warnings[0].message


def test_a_stuck_sensor_goes_while_it_is_stuck() -> None:
    made = samples()
    made.field_t[60:140, 2] = made.field_t[60, 2]
    found, warnings = cleaned(made, NOISE)
    gone = changed(made, found)
    assert gone[60:140, 2].all()
    assert not gone[:60].any()
    assert not gone[140:].any()
    assert not gone[:, [0, 1, 3, 4]].any()
    assert warnings[0].code == "sensor_stuck"
    assert "sensor 3 was stuck (40 % of the time)" in warnings[0].message


def test_a_bar_without_noise_is_not_stuck() -> None:
    made = samples()
    made.field_t[:] = 1e-5
    found, warnings = cleaned(made, NOISE)
    assert np.isfinite(found.field_t).all()
    assert warnings == ()


def test_what_is_not_finite_is_missing() -> None:
    made = samples()
    made.field_t[50, 1, 2] = np.inf
    found, _ = cleaned(made, NOISE)
    assert np.isnan(found.field_t[50, 1, 2])
    assert changed(made, found).sum() == 0
