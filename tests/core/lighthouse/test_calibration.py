"""Calibration of light planes, against independent copies of libsurvive and Crazyflie."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from locatk.core.lighthouse import calibration as cal
from locatk.core.lighthouse.calibration import (
    FACTORY_UNITS,
    GENERIC_CALIBRATION,
    PHASE_TILT_SIGMA_RAD,
)
from locatk.core.lighthouse.light_planes import plane_normals, rays

Array = NDArray[np.float64]


def calibration_of(planes: Any, model: str = "libsurvive") -> cal.Calibration:
    """Convert two planes with libsurvive's names of parameters."""
    sweeps = [
        [p.phase, p.tilt, p.curve, p.gibmag, p.gibpha, p.ogeemag, p.ogeephase] for p in planes
    ]
    return cal.Calibration(np.array(sweeps), "factory", model)


def field_points(n: int = 200, seed: int = 0) -> Array:
    """Return points (n, 3) over a field of view of 110 by 80 degrees, 0.5 to 6 m away."""
    rng = np.random.default_rng(seed)
    azimuth, elevation = rng.uniform(-0.96, 0.96, n), rng.uniform(-0.7, 0.7, n)
    away = rng.uniform(0.5, 6, n)
    level = away * np.cos(elevation)
    return np.stack(
        [level * np.cos(azimuth), level * np.sin(azimuth), away * np.sin(elevation)], axis=1
    )


def crazyflie_angle(point: Array, t: float, sweep: Array) -> float:
    """``lighthouseCalibrationMeasurementModelLh2``; ``t`` is -30 degrees for the first."""
    x, y, z = point
    ax, r = math.atan2(y, x), math.hypot(x, y)
    base = ax + math.asin(z * math.tan(t - sweep[cal.TILT]) / r)
    gib = -sweep[cal.GIBMAG] * math.cos(ax + sweep[cal.GIBPHASE])
    return base - (sweep[cal.PHASE] + gib)


@pytest.mark.parametrize("unit", range(len(FACTORY_UNITS)))
def test_libsurvive_in_its_own_axes(unit: int, world: Any) -> None:
    planes = world.planes_of(FACTORY_UNITS[unit])
    points = field_points()
    forward, left, up = points.T
    theirs = [world.libsurvive_angle(p, k == 1, -left, up, -forward) for k, p in enumerate(planes)]
    ours = cal.predict_angles(points, calibration_of(planes))
    np.testing.assert_allclose(ours, np.stack(theirs, axis=1), atol=1e-13)


def test_ideal_planes_are_those_of_crazyflies_documentation() -> None:
    # alpha = atan2(y, x) + asin(z tan t / hypot(x, y)), t = -30, +30 degrees.
    points = field_points()
    x, y, z = points.T
    for k, t in enumerate((-math.pi / 6, math.pi / 6)):
        theirs = np.arctan2(y, x) + np.arcsin(z * math.tan(t) / np.hypot(x, y))
        np.testing.assert_allclose(
            cal.predict_angles(points, cal.IDEAL_CALIBRATION)[:, k], theirs, atol=1e-14
        )


def test_ideal_gradient_is_crazyflies_h_vector() -> None:
    points = field_points(50)
    _, by_point, _ = cal.predict_with_gradient(points, cal.IDEAL_CALIBRATION)
    for (x, y, z), rows in zip(points, by_point, strict=True):
        for k, t in enumerate((-math.pi / 6, math.pi / 6)):
            r = math.hypot(x, y)
            q = math.tan(t) / math.sqrt(r**2 - (z * math.tan(t)) ** 2)
            h = [(-y - x * z * q) / r**2, (x - y * z * q) / r**2, q]
            np.testing.assert_allclose(rows[k], h, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("unit", [0, 4, 9])
def test_crazyflie_model_is_its_firmwares(unit: int, world: Any) -> None:
    calibration = calibration_of(world.planes_of(FACTORY_UNITS[unit]), "crazyflie")
    points = field_points(50)
    nominal = (-np.pi / 6, np.pi / 6)
    theirs = [
        [crazyflie_angle(p, t, calibration.sweeps[k]) for k, t in enumerate(nominal)]
        for p in points
    ]
    np.testing.assert_allclose(cal.predict_angles(points, calibration), theirs, atol=1e-14)


@pytest.mark.parametrize("model", cal.MODELS)
@pytest.mark.parametrize("unit", [1, 6, 9])
def test_gradients_are_those_of_small_steps(unit: int, model: str, world: Any) -> None:
    calibration = calibration_of(world.planes_of(FACTORY_UNITS[unit]), model)
    points = field_points(60)
    angles, by_point, by_tilt = cal.predict_with_gradient(points, calibration)
    np.testing.assert_array_equal(angles, cal.predict_angles(points, calibration))
    step = 1e-6
    for axis in range(3):
        move = step * np.eye(3)[axis]
        numeric = (
            cal.predict_angles(points + move, calibration)
            - cal.predict_angles(points - move, calibration)
        ) / (2 * step)
        np.testing.assert_allclose(by_point[..., axis], numeric, atol=2e-8)
    for sign in (1, -1):
        moved = calibration.sweeps.copy()
        moved[:, cal.TILT] += sign * step
        shifted = cal.predict_angles(points, cal.Calibration(moved, "factory", model))
        by_tilt = by_tilt - sign * shifted / (2 * step)
    np.testing.assert_allclose(by_tilt, 0, atol=2e-8)


def test_phase_is_subtracted_from_the_angle() -> None:
    sweeps = np.zeros((2, 7))
    sweeps[1, cal.PHASE] = -0.005
    points = field_points(5)
    change = cal.predict_angles(points, cal.Calibration(sweeps, "factory")) - cal.predict_angles(
        points, cal.IDEAL_CALIBRATION
    )
    np.testing.assert_allclose(change, np.tile([0, 0.005], (5, 1)), atol=1e-15)


def test_points_above_the_cone_have_no_angle() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        above = cal.predict_angles(
            np.array([[0.1, 0.0, 2.0], [2.0, 0.0, 0.1]]), GENERIC_CALIBRATION
        )
        gradient = cal.predict_with_gradient(np.array([[0.1, 0.0, 2.0]]), GENERIC_CALIBRATION)[1]
    assert np.isnan(above[0]).all()
    assert np.isfinite(above[1]).all()
    assert not np.isfinite(gradient).any()


@pytest.mark.parametrize("unit", range(len(FACTORY_UNITS)))
def test_correcting_gives_plain_planes_through_the_point(unit: int, world: Any) -> None:
    planes = world.planes_of(FACTORY_UNITS[unit])
    calibration = calibration_of(planes)
    points = field_points()
    forward, left, up = points.T
    observed = np.stack(
        [world.libsurvive_angle(p, k == 1, -left, up, -forward) for k, p in enumerate(planes)], 1
    )
    corrected = cal.ideal_angles(observed, calibration)
    ray = rays(corrected, calibration.tilts)
    np.testing.assert_allclose(ray, points / points[:, :1], atol=2e-6)
    level = np.hypot(points[:, 0], points[:, 1])[:, None]
    missed = np.einsum("nki,ni->nk", plane_normals(corrected, calibration.tilts), points) / level
    assert np.max(np.abs(missed)) < 1e-6
    # Without it, planes miss by milliradians.
    raw = np.einsum("nki,ni->nk", plane_normals(observed, calibration.tilts), points) / level
    assert np.max(np.abs(raw)) > 1e-3


def test_three_iterations_correct_to_a_tenth_of_a_microradian(world: Any) -> None:
    # As the docstring of ideal_angles states, in the field of view of a usual scene.
    for unit in FACTORY_UNITS:
        calibration = calibration_of(world.planes_of(unit))
        points = field_points()
        points = points[np.abs(points[:, 2]) < 0.5 * np.hypot(points[:, 0], points[:, 1])]
        observed = cal.predict_angles(points, calibration)
        three = cal.ideal_angles(observed, calibration)
        many = cal.ideal_angles(observed, calibration, iterations=20)
        assert np.max(np.abs(three - many)) < 1e-7


@pytest.mark.slow
def test_correcting_as_crazyflie_does_gives_its_ray(world: Any) -> None:
    # The firmware's fixed point: corrected angles are those of 30-degree planes.
    calibration = calibration_of(world.planes_of(FACTORY_UNITS[3]), "crazyflie")
    for point in field_points(40):
        raw = [
            crazyflie_angle(point, t, calibration.sweeps[k])
            for k, t in enumerate((-np.pi / 6, np.pi / 6))
        ]
        a = list(raw)
        for _ in range(50):
            y = math.tan((a[0] + a[1]) / 2)
            z = math.sin(a[1] - a[0]) / (math.tan(math.pi / 6) * (math.cos(a[1]) + math.cos(a[0])))
            bent = [
                crazyflie_angle(np.array([1.0, y, z]), t, calibration.sweeps[k])
                for k, t in enumerate((-np.pi / 6, np.pi / 6))
            ]
            a = [a[k] + raw[k] - bent[k] for k in range(2)]
        ours = rays(cal.ideal_angles(np.array(raw), calibration), calibration.tilts)
        np.testing.assert_allclose(ours, [1.0, y, z], atol=3e-6)


def test_missing_angles_stay_missing() -> None:
    observed = np.array([[0.1, np.nan], [np.nan, np.nan], [0.1, -0.1]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        corrected = cal.ideal_angles(observed, GENERIC_CALIBRATION)
    assert not np.isfinite(corrected[:2]).all(axis=1).any()
    assert np.isfinite(corrected[2]).all()


def test_the_generic_calibration_is_the_mean_of_real_units() -> None:
    # Mean and spread over the nine units in jdavidberger/libsurvive-extras-data.
    assert GENERIC_CALIBRATION.source == "generic"
    np.testing.assert_allclose(
        GENERIC_CALIBRATION.sweeps[:, cal.TILT], [-0.0493, 0.0459], atol=5e-4
    )
    np.testing.assert_allclose(GENERIC_CALIBRATION.sweeps[:, cal.PHASE], [0, -0.0051], atol=5e-4)
    np.testing.assert_allclose(PHASE_TILT_SIGMA_RAD, [[0, 0.0016], [0.0019, 0.0020]], atol=5e-4)
    # The mean of gib is that of the waves, not of their sizes and phases.
    azimuth = np.linspace(-1, 1, 9)
    for k in range(2):
        waves = FACTORY_UNITS[:, 5 + k, None] * np.cos(azimuth + FACTORY_UNITS[:, 7 + k, None])
        ours = GENERIC_CALIBRATION.sweeps[k, cal.GIBMAG] * np.cos(
            azimuth + GENERIC_CALIBRATION.sweeps[k, cal.GIBPHASE]
        )
        np.testing.assert_allclose(ours, waves.mean(axis=0), atol=1e-12)


def test_units_are_those_of_libsurvives_file(recordings: Path, world: Any) -> None:
    text = (recordings / "libsurvive" / "tracker-cal-attempt.rec.gz.json").read_text()
    found = 0
    for block in re.findall(r'"lighthouse\d+":(\{[^}]*\})', text):
        lamp = json.loads(re.sub(r"[\r\n]", "", block))
        if lamp.get("OOTXSet") != "1":
            continue
        names = [f.name for f in dataclasses.fields(world.Plane)]
        theirs = {name: [float(v) for v in lamp[f"fcal{name}"]] for name in names}
        unit = min(FACTORY_UNITS, key=lambda u: np.abs(u[1:3] - theirs["tilt"]).sum())
        for k, plane in enumerate(world.planes_of(unit)):
            for key, values in theirs.items():
                assert getattr(plane, key) == pytest.approx(values[k], abs=1e-6), key
        found += 1
    assert found >= 2


def test_properties_of_a_calibration(world: Any) -> None:
    assert not cal.IDEAL_CALIBRATION.is_distorted
    assert cal.IDEAL_CALIBRATION.source == "none"
    assert GENERIC_CALIBRATION.is_distorted
    factory = calibration_of(world.planes_of(FACTORY_UNITS[0]))
    np.testing.assert_allclose(
        factory.tilts, [np.pi / 6 + FACTORY_UNITS[0, 1], -np.pi / 6 + FACTORY_UNITS[0, 2]]
    )


@pytest.mark.parametrize("name", cal.PARAMETERS)
def test_distorted_means_a_wave_or_a_curve(name: str) -> None:
    sweeps = np.zeros((2, 7))
    sweeps[1, cal.PARAMETERS.index(name)] = 0.01
    calibration = cal.Calibration(sweeps, "estimated")
    assert calibration.is_distorted is (name in ("curve", "gibmag", "ogeemag"))
    # Undistorted planes are those of the ideal model but for tilt and phase.
    points = field_points(20)
    tilts_and_phases = np.zeros((2, 7))
    tilts_and_phases[:, :2] = sweeps[:, :2]
    plain = cal.predict_angles(points, cal.Calibration(tilts_and_phases, "estimated"))
    difference = np.max(np.abs(cal.predict_angles(points, calibration) - plain))
    assert bool(difference > 1e-6) is calibration.is_distorted


@pytest.mark.parametrize(
    ("name", "value"),
    [("phase", 0.005), ("tilt", 0.05), ("curve", 0.3), ("gibmag", 0.005), ("ogeemag", 0.3)],
)
def test_every_parameter_is_corrected(name: str, value: float) -> None:
    sweeps = np.zeros((2, 7))
    sweeps[:, cal.PARAMETERS.index(name)] = value
    calibration = cal.Calibration(sweeps, "estimated")
    points = field_points(50)
    corrected = cal.ideal_angles(cal.predict_angles(points, calibration), calibration)
    level = np.hypot(points[:, 0], points[:, 1])[:, None]
    distance = np.einsum("nki,ni->nk", plane_normals(corrected, calibration.tilts), points) / level
    assert np.max(np.abs(distance)) < 1e-6


def test_the_crazyflie_model_ignores_curve_and_ogee() -> None:
    sweeps = np.zeros((2, 7))
    sweeps[:, [cal.CURVE, cal.OGEEMAG]] = 0.3
    points = field_points(20)
    np.testing.assert_array_equal(
        cal.predict_angles(points, cal.Calibration(sweeps, "factory", "crazyflie")),
        cal.predict_angles(points, cal.IDEAL_CALIBRATION),
    )


# ---- single sweeps with derivatives by all parameters


def with_columns(calibration: cal.Calibration, **columns: float) -> cal.Calibration:
    """Return a calibration with some parameters of both planes replaced."""
    sweeps = calibration.sweeps.copy()
    for name, value in columns.items():
        sweeps[:, cal.PARAMETERS.index(name)] = value
    return dataclasses.replace(calibration, sweeps=sweeps)


CALIBRATIONS = {
    "unit": cal.Calibration(
        np.array(
            [
                [0.0, -0.05, 0.4, 0.02, 2.2, 0.5, 1.4],
                [-0.006, 0.046, -0.3, 0.03, -0.5, 0.4, -2.6],
            ]
        ),
        "factory",
    ),
    "ideal": cal.IDEAL_CALIBRATION,
    "without gib": with_columns(GENERIC_CALIBRATION, gibmag=0.0),
    "without ogee": with_columns(GENERIC_CALIBRATION, ogeemag=0.0),
    "without curve": with_columns(GENERIC_CALIBRATION, curve=0.0, ogeemag=0.0),
}


@pytest.mark.parametrize("model", cal.MODELS)
@pytest.mark.parametrize("name", CALIBRATIONS)
def test_derivatives_of_sweeps_are_those_of_small_steps(name: str, model: str) -> None:
    calibration = dataclasses.replace(CALIBRATIONS[name], model=model)
    points = field_points(40)
    plane = np.random.default_rng(0).integers(0, 2, len(points))
    rows, step = np.arange(len(points)), 1e-6
    angle, by_point, by_parameters = cal.predict_sweeps(points, plane, calibration)
    np.testing.assert_array_equal(angle, cal.predict_angles(points, calibration)[rows, plane])

    def angles(points: Array, parameters: Array) -> Array:
        other = calibration.with_linear_parameters(parameters)
        return cal.predict_angles(points, other)[rows, plane]

    start = calibration.linear_parameters()
    for axis in range(3):
        move = step * np.eye(3)[axis]
        numeric = (angles(points + move, start) - angles(points - move, start)) / (2 * step)
        np.testing.assert_allclose(by_point[:, axis], numeric, atol=2e-8)
    for k in range(7):
        move = step * np.eye(7)[k]
        numeric = (angles(points, start + move) - angles(points, start - move)) / (2 * step)
        np.testing.assert_allclose(by_parameters[:, k], numeric, atol=2e-8, err_msg=str(k))


def test_only_the_plane_of_a_sweep_counts() -> None:
    points = np.array([[2.0, 0.3, 0.4], [2.0, 0.3, 0.4], [0.1, 0.0, 2.0]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        angle, by_point, by_parameters = cal.predict_sweeps(
            points, np.array([0, 1, 1]), GENERIC_CALIBRATION
        )
    both = cal.predict_angles(points[:1], GENERIC_CALIBRATION)[0]
    np.testing.assert_array_equal(angle, [both[0], both[1], np.nan])
    assert by_point.shape == (3, 3)
    assert by_parameters.shape == (3, 7)


@pytest.mark.parametrize("name", CALIBRATIONS)
def test_linear_parameters_describe_the_same_planes(name: str) -> None:
    calibration = dataclasses.replace(CALIBRATIONS[name], model="crazyflie")
    parameters = calibration.linear_parameters()
    again = calibration.with_linear_parameters(parameters)
    assert (again.source, again.model) == (calibration.source, "crazyflie")
    np.testing.assert_allclose(again.linear_parameters(), parameters, atol=1e-15)
    for model in cal.MODELS:
        np.testing.assert_allclose(
            cal.predict_angles(field_points(20), dataclasses.replace(again, model=model)),
            cal.predict_angles(field_points(20), dataclasses.replace(calibration, model=model)),
            atol=1e-14,
        )


def test_linear_parameters_are_phasors() -> None:
    sweeps = np.array([[1.0, 2.0, 3.0, 2.0, np.pi / 2, 4.0, np.pi], np.zeros(7)])
    calibration = cal.Calibration(sweeps.copy(), "factory")
    np.testing.assert_allclose(
        calibration.linear_parameters(), [[1, 2, 3, 0, 2, -4, 0], np.zeros(7)], atol=1e-15
    )
    # Neither direction changes its input.
    parameters = np.arange(14.0).reshape(2, 7)
    calibration.with_linear_parameters(parameters)
    np.testing.assert_array_equal(parameters, np.arange(14.0).reshape(2, 7))
    np.testing.assert_array_equal(calibration.sweeps, sweeps)
