"""True values at the times of estimates."""

from __future__ import annotations

import numpy as np

from locatk.formats.benchmarks.plan.truth import at_times


def test_values_are_interpolated_to_a_nanosecond() -> None:
    """A float has steps of 256 ns at the times of today."""
    known_ns = 1_700_000_000_000_000_000 + np.array([0, 100, 300])
    values = np.array([[0.0, 1.0], [100.0, 1.0], [500.0, 3.0]])
    found = at_times(known_ns[0] + np.array([7, 101]), known_ns, values)
    np.testing.assert_allclose(found, [[7.0, 1.0], [102.0, 1.01]])
