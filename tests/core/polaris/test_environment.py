"""Fields of the environment: against a dense estimate with magpylib's dipoles."""

from __future__ import annotations

import math
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.errors import InputError
from locatk.core.polaris.array import SensorArray, bar
from locatk.core.polaris.codec import layout_of
from locatk.core.polaris.design.accuracy_bound import magnet_covariance
from locatk.core.polaris.design.environment import (
    ENVIRONMENTS,
    MOTORS,
    QUIET,
    REINFORCED,
    Environment,
    environment_of,
)
from locatk.core.polaris.design.planning import ReadingConditions, evaluate_design
from locatk.core.polaris.simulation.options import SimulationOptions, usual_bar
from locatk.core.polaris.simulation.session import simulate
from locatk.core.polaris.solver import SolveOptions, solve
from locatk.core.polaris.tag import Tags, cell_positions, symbol_angles

Array = NDArray[np.float64]

MINI = Tags(order=2, magnets=3, spacing_m=0.02, clearance_m=0.01)


def dense_covariance(environment: Environment, sensors: SensorArray, step_m: float) -> Array:
    """Covariance of x, y and angle of the magnets from a dense weighted least-squares estimate.

    Unknowns are also the height, moments, and a polynomial of the fourth degree for each axis of
    each sensor; derivatives are central differences of magpylib's dipoles.
    """
    layout = layout_of(MINI, 77)
    position = cell_positions(MINI, layout.cells)
    angle = symbol_angles(MINI, layout.symbols)
    margin = 8 * MINI.clearance_m
    low, high = position[:, 0].min() - margin, position[:, 0].max() + margin
    x = np.arange(math.floor(low / step_m), math.ceil(high / step_m) + 1) * step_m
    points = x[:, None, None] * [1.0, 0.0, 0.0] + sensors.position_m

    def field(p: Array) -> Array:
        total = np.zeros(points.shape)
        for k in range(3):
            px, py, a, strength = p[4 * k : 4 * k + 4]
            moment = strength * MINI.magnet.moment * np.array([math.cos(a), math.sin(a), 0.0])
            source = magpylib.misc.Dipole(moment=moment, position=(px, py, -p[-1]))
            total += source.getB(points.reshape(-1, 3)).reshape(points.shape)
        return total

    start = np.append(np.column_stack([position, angle, np.ones(3)]).ravel(), MINI.clearance_m)
    columns = []
    for k in range(len(start)):
        step = 1e-6 * (np.arange(len(start)) == k)
        columns.append((field(start + step) - field(start - step)).ravel() / 2e-6)
    trends = np.polynomial.legendre.legvander(x / np.abs(x).max(), 4)
    for channel in np.eye(points[0].size).reshape(-1, *points[0].shape):
        columns += [(channel * trend[:, None, None]).ravel() for trend in trends.T]
    jacobian = np.array(columns).T
    noise = np.broadcast_to(sensors.noise_t, points.shape).ravel()
    scale = np.linalg.norm(jacobian / noise[:, None], axis=0)
    estimator = np.linalg.pinv(jacobian / noise[:, None] / scale) / noise / scale[:, None]

    y = sensors.position_m[:, 1]
    correlation = np.exp(-((x[:, None] - x) ** 2) / 2 / environment.length_m**2)
    across = np.exp(-((y[:, None] - y) ** 2) / 2 / environment.length_m**2)
    if environment.is_common:
        growth = 1 + environment.gradient_per_m * (y - y.mean())
        across = np.outer(growth, growth)
    disturbance = environment.field_t**2 * np.kron(correlation, np.kron(across, np.eye(3)))
    total = estimator @ (np.diag(noise**2) + disturbance) @ estimator.T
    kept = [4 * k + part for k in range(3) for part in range(3)]
    return total[np.ix_(kept, kept)]


@pytest.mark.parametrize("environment", [REINFORCED, MOTORS, Environment("any", 5e-6, 0.02)])
def test_agrees_with_a_dense_estimate(environment: Environment) -> None:
    sensors = SensorArray(bar(3, 0.02), noise_t=np.array([0.9, 0.8, 1.3]) * 1e-6)
    ours = magnet_covariance(
        MINI,
        layout_of(MINI, 77),
        sensors,
        step_m=5e-3,
        nuisance="strength",
        environment=environment,
    )
    dense = dense_covariance(environment, sensors, 5e-3)
    scale = np.sqrt(np.diag(dense))
    assert ours / np.outer(scale, scale) == pytest.approx(dense / np.outer(scale, scale), abs=2e-3)


@pytest.mark.parametrize("nuisance", ["strength", "steps"])
def test_the_variance_grows_with_the_square_of_the_field(nuisance: str) -> None:
    sensors = SensorArray(bar(3, 0.02), noise_t=np.full(3, 1e-6))

    def covariance(field_t: float) -> Array:
        environment = replace(REINFORCED, field_t=field_t)
        return magnet_covariance(
            MINI,
            layout_of(MINI, 77),
            sensors,
            step_m=5e-3,
            nuisance=nuisance,  # type: ignore[arg-type]
            environment=environment,
        )

    first, second, third = (covariance(field_t) for field_t in (1e-6, 2e-6, 3e-6))
    assert third - first == pytest.approx((second - first) * 8 / 3, rel=1e-6)
    assert (np.diag(second) > np.diag(first)).all()


def test_environments_by_name_and_by_field() -> None:
    for name, environment in ENVIRONMENTS.items():
        assert environment_of(name) is environment
    assert environment_of("3.5").field_t == pytest.approx(3.5e-6)
    for text in ("loud", "", "-1", "nan", "1e9"):
        with pytest.raises(InputError):
            environment_of(text)
    with pytest.raises(InputError, match="correlation length"):
        Environment("flat", 1e-6, 0.0)


def test_a_design_for_iron_says_what_to_change() -> None:
    quiet, iron = (
        evaluate_design(Tags(), ReadingConditions(environment=environment))
        for environment in (QUIET, REINFORCED)
    )
    assert iron.free_speed.angle_rad > 1.5 * quiet.free_speed.angle_rad
    assert iron.between_to_noise < quiet.between_to_noise
    assert iron.misread > quiet.misread
    assert not iron.warnings
    assert any("Drive the array over your floor" in note for note in iron.notes)
    strong = evaluate_design(Tags(), ReadingConditions(environment=environment_of("20")))
    assert any("20 uT environment" in warning for warning in strong.warnings)


@pytest.mark.slow
def test_the_solver_reaches_the_forecast_over_iron() -> None:
    """Passes over cylinders with a random field added, known speed."""
    rate_hz, speed = 60.0, 0.1
    array = usual_bar(rate_hz=rate_hz, noise_t=None)
    errors, predicted = [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        tag_id = int(rng.integers(327_680))
        session = simulate(
            Tags(),
            SimulationOptions(
                array=array, rate_hz=rate_hz, route=(tag_id,), speed_mps=speed, seed=seed,
                lateral_m=0.005,
            ),
        )  # fmt: skip
        x = session.truth.position[:, 0]
        along = np.linalg.cholesky(REINFORCED.path_correlation(x) + 1e-6 * np.eye(len(x)))
        y = array.position_m[:, 1]
        across = np.linalg.cholesky(REINFORCED.bar_correlation(y) + 1e-6 * np.eye(len(y)))
        white = rng.normal(size=(3, len(x), len(y)))
        iron = REINFORCED.field_t * np.moveaxis(along @ white @ across.T, 0, -1)
        samples = replace(session.samples, field_t=session.samples.field_t + iron)
        (tag,) = solve([samples], Tags(), SolveOptions(speed_mps=speed)).detections
        assert tag.tag_id == tag_id
        magnets = np.array([[m.y_m, m.angle_rad - tag.heading_rad] for m in tag.magnets])
        truth = np.column_stack(
            [
                session.magnets.position_m[:, 1],
                symbol_angles(Tags(), layout_of(Tags(), tag_id).symbols),
            ]
        )
        difference = magnets - truth
        difference[:, 0] -= difference[:, 0].mean()
        errors.append([difference[:, 0], np.angle(np.exp(1j * difference[:, 1]))])
        covariance = magnet_covariance(
            Tags(), layout_of(Tags(), tag_id), array, step_m=speed / rate_hz, offset_m=-0.005,
            nuisance="strength", environment=REINFORCED,
        )  # fmt: skip
        predicted.append(np.diag(covariance).reshape(-1, 3)[:, 1:].mean(axis=0))
    reached = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    ratio = np.sqrt(np.mean(predicted, axis=0)) / reached
    assert ((ratio > 0.5) & (ratio < 2)).all(), ratio
