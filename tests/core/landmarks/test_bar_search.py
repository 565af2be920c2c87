"""Search for bars: feasible heights, and the reason if there are none."""

from __future__ import annotations

import math

import pytest

from locatk.core.errors import InputError
from locatk.core.landmarks.design.analysis import analyse_landmark
from locatk.core.landmarks.design.bar_search import search_bars
from locatk.core.landmarks.design.routes import forecast_floor

DEFAULT_BAR = (30e-3, 10e-3, 5e-3)


@pytest.mark.slow
def test_heights_are_those_with_the_wanted_accuracy() -> None:
    heights_m = (8e-3, 16e-3)
    (loose,) = search_bars(0.2, 20e-3, bars_m=[DEFAULT_BAR], heights_m=heights_m)
    assert loose.is_feasible
    assert not loose.reason
    expected = forecast_floor(loose.analysis.geometry, 0.2, routes=6)
    assert loose.forecast == expected
    wanted_m = 0.99 * expected.position_p95_m
    best_m = [loose.analysis.geometry.sensor_height_m]
    (strict,) = search_bars(0.2, wanted_m, bars_m=[DEFAULT_BAR], heights_m=best_m)
    assert (strict.heights_m, strict.reason) == ((), "not accurate enough")


def test_feasible_bars_come_first_and_strong_ones_need_a_larger_pitch() -> None:
    strong = (50.8e-3, 12.7e-3, 12.7e-3)
    options = search_bars(0.2, 20e-3, bars_m=[strong, DEFAULT_BAR], heights_m=[12e-3])
    assert [option.is_feasible for option in options] == [True, False]
    pitch_m = options[1].analysis.min_pitch_m
    assert pitch_m == analyse_landmark(options[1].analysis.geometry).min_pitch_m > 0.2
    assert options[1].reason == f"needs a pitch of {1e3 * pitch_m:.3g} mm"
    # Long bars are moved outwards, so that they do not overlap.
    assert options[1].analysis.geometry.radius_m == pytest.approx(0.03175)


def test_bars_far_below_the_sensors_are_too_weak() -> None:
    (option,) = search_bars(0.3, 5e-3, bars_m=[(6e-3, 1e-3, 1e-3)], heights_m=[30e-3])
    assert not option.is_feasible
    assert math.isinf(option.forecast.position_p95_m)


@pytest.mark.parametrize("wrong", [(0.0, 1e-3), (0.2, -1e-3)])
def test_impossible_wishes_are_refused(wrong: tuple[float, float]) -> None:
    with pytest.raises(InputError, match="accuracy"):
        search_bars(*wrong)


def test_a_pitch_at_which_all_bars_overlap_is_refused() -> None:
    with pytest.raises(InputError, match="overlap at a pitch of 1 mm") as raised:
        search_bars(1e-3, 8e-3, bars_m=[DEFAULT_BAR, (40e-3, 12e-3, 5e-3)])
    assert raised.value.hint == "Give at least 60 mm"
