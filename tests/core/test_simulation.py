"""Parts that the simulators share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.geometry import heading_from_quaternion
from locatk.core.simulation import (
    MAX_SAMPLES,
    MAX_SESSION_S,
    SESSION_START_NS,
    check_options,
    check_session_size,
    exact_trajectory,
    quantize,
    random_stream,
    require_finite,
    require_fraction,
    require_fraction_below_1,
    require_not_negative,
    require_positive,
    stamps_ns,
)


@dataclass
class Options:
    value: float | None


@pytest.mark.parametrize(
    ("require", "valid", "invalid"),
    [
        (require_positive, (1e-9, 5.0, None), (0.0, -1.0, math.inf, math.nan)),
        (require_not_negative, (0.0, 5.0, None), (-1e-9, math.inf, math.nan)),
        (require_finite, (0.0, -5.0, None), (math.inf, math.nan)),
        (require_fraction, (0.0, 0.5, 1.0), (-1e-9, 1.1, math.nan)),
        (require_fraction_below_1, (0.0, 0.999), (-1e-9, 1.0, math.nan)),
    ],
)
def test_ranges_of_options(require, valid, invalid) -> None:
    for value in valid:
        check_options(Options(value), require(Options(value), "value"))
    for value in invalid:
        with pytest.raises(InputError, match=r"a simulation with value ") as caught:
            check_options(Options(value), require(Options(value), "value"))
        assert str(caught.value.hint).startswith("give ")


def test_values_are_rounded_to_steps() -> None:
    values = np.array([[0.26, 0.26, -0.26], [0.74, 0.74, math.nan]])
    assert quantize(values, 0.5)[:, :2].tolist() == [[0.5, 0.5], [0.5, 0.5]]
    by_column = quantize(values, np.array([0.5, 0.0, 0.1]))
    assert by_column[:, :2].tolist() == [[0.5, 0.26], [0.5, 0.74]]
    assert by_column[0, 2] == pytest.approx(-0.3)
    assert math.isnan(by_column[1, 2])
    assert np.array_equal(quantize(values, 0.0), values, equal_nan=True)


def test_each_source_of_errors_has_its_own_numbers() -> None:
    first, again, other, seed = (
        random_stream(*key).normal() for key in ((1, 2), (1, 2), (1, 3), (2, 2))
    )
    assert first == again
    assert len({first, other, seed}) == 3


def test_truth_is_exact() -> None:
    time_ns = stamps_ns(np.array([0.0, 0.25]))
    assert (time_ns - SESSION_START_NS).tolist() == [0, 250_000_000]
    flat = exact_trajectory("a", "floor", time_ns, np.ones((2, 2)), np.array([0.0, 1.5]))
    assert flat.position.tolist() == [[1.0, 1.0, 0.0]] * 2
    assert heading_from_quaternion(flat.quaternion) == pytest.approx([0.0, 1.5])
    assert not flat.covariance.any()
    raised = exact_trajectory("a", "floor", time_ns, np.full((2, 3), 2.0), np.zeros(2))
    assert raised.position.tolist() == [[2.0] * 3] * 2


def test_sessions_have_a_largest_size() -> None:
    check_session_size(MAX_SAMPLES, MAX_SESSION_S)
    assert stamps_ns(np.array([MAX_SESSION_S]))[0] > SESSION_START_NS
    for samples, duration_s in (
        (MAX_SAMPLES + 1, 1.0),
        (math.inf, 1.0),
        (math.nan, 1.0),
        (2, 2 * MAX_SESSION_S),
        (2, math.inf),
    ):
        with pytest.raises(InputError, match="a simulation of "):
            check_session_size(samples, duration_s)
