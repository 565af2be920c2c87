"""Times of the light of angles that the firmware logs later, on simulated flights."""

from __future__ import annotations

from types import ModuleType

import numpy as np
import pytest

from locatk.core.lighthouse.channels import period_counts
from locatk.core.lighthouse.late_angles import date_late_angles

RATES = ((84 / 85 - 1e-3, 84 / 85 + 1e-3), (0.999, 1.001))


def logged(crazyflie: ModuleType, seconds: float, count: int) -> dict[str, np.ndarray]:
    stations = crazyflie.stations(count)
    for k, station in enumerate(stations):
        station.zero_s = 0.003 + 0.0057 * k
    flight = crazyflie.Flight(seconds, 1.2, stations)
    time, _, station, plane, angle, light = np.array(crazyflie.firmware_angles(flight)).T
    channel, plane = station.astype(int) + 1, plane.astype(int)
    turns = (angle + np.array([2, 4])[plane] * np.pi / 3) / (2 * np.pi)
    return {
        "time": time, "channel": channel, "plane": plane, "light": light,
        "count": turns * period_counts(channel),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3])
def test_light_is_dated_to_a_fraction_of_a_millisecond(crazyflie: ModuleType, count: int) -> None:
    log = logged(crazyflie, 21.0, count)
    for rate in (84 / 85, 0.98906, 1.0):
        event = 31.0 + rate * (log["time"] + 0.0006)
        dated = date_late_angles(event, log["channel"], log["plane"], log["count"], RATES)
        assert dated is not None
        assert dated.clock.is_estimated
        # The rotors are the reference; they are up to 19 ppm off.
        assert dated.clock.rate == pytest.approx(rate, rel=25e-6)
        light = dated.clock.offset_s + dated.clock.rate * dated.time_s
        error = (light - 31.0) / rate - log["light"]
        assert np.abs(error).max() < 4e-4
        assert np.ptp(error) < 5e-4


def test_a_short_log_of_two_stations_is_uncertain(crazyflie: ModuleType) -> None:
    log = logged(crazyflie, 3.0, 2)
    columns = (log["channel"], log["plane"], log["count"])
    dated = date_late_angles(log["time"], *columns, RATES)
    assert dated is None or not dated.clock.is_estimated


def test_few_events_are_not_dated() -> None:
    nothing = np.zeros(0)
    none = np.zeros(0, np.int64)
    assert date_late_angles(nothing, none, none, nothing, RATES) is None
    few = np.arange(5.0)
    one = np.ones(5, np.int64)
    assert date_late_angles(few, one, one, 7e4 * np.ones(5), RATES) is None


def test_a_station_at_random_is_not_dated(crazyflie: ModuleType) -> None:
    log = logged(crazyflie, 11.0, 1)
    rng = np.random.default_rng(3)
    n = 200
    dated = date_late_angles(
        np.append(log["time"], rng.uniform(0, 11, n)),
        np.append(log["channel"], np.full(n, 7)),
        np.append(log["plane"], rng.integers(0, 2, n)),
        np.append(log["count"], rng.uniform(2e4, 1e5, n)),
        RATES,
    )
    assert dated is not None
    assert np.isnan(dated.time_s[-n:]).all()
    assert np.isfinite(dated.time_s[:-n]).all()
