"""Field of the bars: against magpylib, against Maxwell, and the two twins against each other."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace

import magpylib
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.kernels import kernels
from locatk.core.landmarks import field as bars
from locatk.core.landmarks.field import basis, basis_gradient, landmark_field
from locatk.core.landmarks.landmark import Geometry, signs

GEOMETRIES = (
    Geometry(),
    Geometry(bar_length_m=0.04, sensor_height_m=0.005, remanence_t=1.0),
    Geometry(bar_length_m=0.05, bar_width_m=0.005, radius_m=0.028, bar_height_m=0.003),
)


def peer(geometry: Geometry, strengths: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whole field (n, 3) of four cuboids by magpylib, each placed and turned by itself."""
    total = np.zeros((len(points), 3))
    for k, strength in enumerate(strengths):
        rotation = math.pi / 2 * k
        bar = magpylib.magnet.Cuboid(
            # magnetised counter-clockwise: along +y where the bar lies on the right
            polarization=(0, geometry.remanence_t * strength, 0),
            dimension=(geometry.bar_width_m, geometry.bar_length_m, geometry.bar_height_m),
            position=(geometry.radius_m, 0, -geometry.bar_height_m / 2),
        )
        bar.rotate_from_angax(rotation, "z", anchor=0, degrees=False)
        total += bar.getB(points)
    return total


def scattered(geometry: Geometry, seed: int, count: int = 3000) -> np.ndarray:
    """Points (n, 3) from over the bars to 0.2 m away, all above their top faces."""
    rng = np.random.default_rng(seed)
    near = rng.uniform(-0.06, 0.06, (count, 2))
    far = rng.uniform(-0.2, 0.2, (count, 2))
    height = np.concatenate([rng.uniform(0.002, 0.03, count), rng.uniform(0.002, 0.1, count)])
    return np.column_stack([np.concatenate([near, far]), height])


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_each_bar_is_magpylibs(geometry: Geometry) -> None:
    points = scattered(geometry, 2)
    result = basis(geometry, points[:, :2], points[:, 2])
    for k in range(4):
        expected = peer(geometry, np.eye(4)[k], points)
        error = np.abs(result[:, k] - expected[:, 2])
        size = np.linalg.norm(expected, axis=1)
        strong = size > 5e-4
        assert strong.sum() > 1000
        assert (error[strong] <= 1e-12 * size[strong]).all()
        # Farther off the logarithms are alike: both have the rounding of what they subtract.
        assert (error <= 1e-12 * size + 2e-15 * geometry.remanence_t).all()


@pytest.mark.slow
@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_landmarks_are_magpylibs(geometry: Geometry) -> None:
    points = scattered(geometry, 1)
    # Where bars cancel, the field is less than any of them: rounding is that of the bars.
    single = np.abs(basis(geometry, points[:, :2], points[:, 2])).max(axis=1)
    for code in range(16):
        expected = peer(geometry, signs(code), points)
        result = landmark_field(geometry, code, points[:, :2], points[:, 2])
        size = np.maximum(np.linalg.norm(expected, axis=1), single)
        error = np.abs(result - expected[:, 2])
        strong = size > 1e-3
        assert (error[strong] <= 1e-12 * size[strong]).all()
        assert (error <= 1e-12 * size + 6e-15 * geometry.remanence_t).all()


def test_beside_and_below_too() -> None:
    """A sensor beside the bars, and one under them."""
    geometry = GEOMETRIES[0]
    points = np.array([[0.045, 0.004, -0.002], [0.002, 0.001, -0.003], [0.03, 0.012, -0.02]])
    expected = peer(geometry, signs(0b0111), points)
    result = landmark_field(geometry, 0b0111, points[:, :2], points[:, 2])
    np.testing.assert_allclose(result, expected[:, 2], rtol=1e-11)


def test_a_rotated_landmark_has_a_rotated_field() -> None:
    geometry = GEOMETRIES[0]
    points = scattered(geometry, 3)[:200]
    field = basis(geometry, points[:, :2], points[:, 2])
    rotated = points[:, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # by 90 degrees
    after = basis(geometry, rotated, points[:, 2])
    np.testing.assert_allclose(after, np.roll(field, 1, axis=1), rtol=0, atol=1e-15)


def test_a_bar_is_odd_along_itself_and_rises_counter_clockwise() -> None:
    geometry = GEOMETRIES[0]
    along = np.array([[0.025, y] for y in (-0.010, 0.0, 0.010)])
    field = basis(geometry, along)[:, 0]
    assert field[1] == pytest.approx(0, abs=1e-15)
    assert field[2] > 1e-3
    assert field[0] == pytest.approx(-field[2], rel=1e-12)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_gradient_is_the_slope(geometry: Geometry) -> None:
    points = scattered(geometry, 4, 300)
    field, slope = basis_gradient(geometry, points[:, :2], points[:, 2])
    np.testing.assert_array_equal(field, basis(geometry, points[:, :2], points[:, 2]))
    step = 2e-6
    for axis in range(3):
        # Fourth order, so that what is left is rounding and not the step.
        value = [
            basis(geometry, moved[:, :2], moved[:, 2])
            for moved in (points + n * step * np.eye(3)[axis] for n in (-2, -1, 1, 2))
        ]
        numeric = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * step)
        size = np.linalg.norm(slope, axis=-1)
        error = np.abs(slope[..., axis] - numeric)
        assert (error <= 1e-6 * size + 1e-14 / step).all()


def test_gradient_is_magpylibs() -> None:
    """Outside of the bars there is no current: slopes of Bz are those of Bx, By by height."""
    geometry = GEOMETRIES[0]
    points = scattered(geometry, 5, 100)
    slopes = basis_gradient(geometry, points[:, :2], points[:, 2])[1]
    total = np.einsum("nki,k->ni", slopes, signs(0b0011))
    up = np.array([0, 0, 1e-5])
    above, below = (peer(geometry, signs(0b0011), points + path * up) for path in (1, -1))
    expected = (above - below) / 2e-5
    np.testing.assert_allclose(total, expected, atol=1e-4 * np.abs(expected).max())


def test_edges_are_finite_and_their_neighbours_right() -> None:
    """On the lines of the edges the true field has no bound; nobody warns, nothing is nan."""
    g = GEOMETRIES[0]
    across, along = g.radius_m + g.bar_width_m / 2, g.bar_length_m / 2
    lines = (
        [(across, along, z) for z in (0.0, -g.bar_height_m, -g.bar_height_m / 2, 0.01)]
        + [(across, y, z) for y in (0.0, along, 2 * along) for z in (0.0, -g.bar_height_m)]
        + [(x, along, z) for x in (0.0, g.radius_m, across, 0.1) for z in (0.0, -g.bar_height_m)]
    )
    at = np.array(lines)
    with np.errstate(all="raise"):
        for field, slope in (
            basis_gradient(g, at[:, :2], at[:, 2]),
            bars.evaluate_numpy(g, at, gradient=True),
        ):
            assert np.isfinite(field).all()
            assert np.isfinite(slope).all()
            assert np.abs(field).max() < 10 * g.remanence_t
    # A tenth of a millimetre off the edge it is magpylib's again.
    beside = at[0] + [1e-4, 1e-4, 1e-4]
    expected = peer(g, np.eye(4)[0], beside[None])[0, 2]
    assert basis(g, beside[:2], beside[2])[0] == pytest.approx(expected, rel=1e-12)


def test_far_away_it_is_a_dipole() -> None:
    """Half a metre off, to the cube of the distance and the digits of a far field."""
    g = GEOMETRIES[0]
    moment = g.remanence_t / (4e-7 * math.pi) * g.bar_length_m * g.bar_width_m * g.bar_height_m
    middle = np.array([g.radius_m, 0, -g.bar_height_m / 2])
    for scale, tolerance in ((1.0, 3e-3), (10.0, 3e-5), (100.0, 3e-7)):
        direction = np.array([0.3, 0.5, 0.4]) * scale
        point = middle + direction
        distance = np.linalg.norm(direction)
        # z of the field of a dipole along y
        dipole = 1e-7 * 3 * moment * direction[1] * direction[2] / distance**5
        assert basis(g, point[:2], point[2])[0] == pytest.approx(dipole, rel=tolerance)


def test_far_fields_equal_the_reference() -> None:
    """Largest fields [uT] by distance at 1.2 T, computed with a prototype equal to magpylib."""
    phi = np.radians(np.arange(720) / 2)
    reference_ut = {
        0b0101: {0.06: 2327, 0.08: 527, 0.115: 82, 0.15: 21, 0.2: 5},
        0b0111: {0.06: 2481, 0.08: 600, 0.115: 107, 0.15: 32, 0.2: 9},
        0b1111: {0.06: 628, 0.08: 85, 0.115: 7, 0.15: 1, 0.2: 0.1},
    }
    for code, by_distance in reference_ut.items():
        for radius, expected in by_distance.items():
            circle = radius * np.column_stack([np.cos(phi), np.sin(phi)])
            result = 1e6 * np.abs(landmark_field(Geometry(), code, circle)).max()
            assert result == pytest.approx(expected, rel=0.01, abs=0.6 if expected > 0.5 else 0.06)


@settings(max_examples=40, deadline=None)
@given(
    st.tuples(*[st.floats(-0.1, 0.1)] * 2, st.floats(-0.03, 0.05)),
    st.floats(0.005, 0.05),
    st.floats(0.002, 0.02),
)
def test_twins_agree(position: tuple[float, ...], length: float, width: float) -> None:
    if kernels is None:
        pytest.skip("no compiled twin here")
    g = replace(Geometry(), bar_length_m=length, bar_width_m=width, radius_m=0.035)
    at = np.array([position])
    field, slope = basis_gradient(g, at[:, :2], at[:, 2])
    other, its_slope = bars.evaluate_numpy(g, at, gradient=True)
    np.testing.assert_allclose(field, other, rtol=1e-9, atol=1e-13)
    np.testing.assert_allclose(slope, its_slope, rtol=1e-9, atol=1e-9 * np.abs(slope).max())


def test_without_the_compiled_twin_all_is_the_same() -> None:
    points = scattered(GEOMETRIES[0], 6, 50)
    code = (
        "import numpy as np, sys\n"
        "from locatk.core.kernels import kernels\n"
        "from locatk.core.landmarks.field import basis_gradient\n"
        "from locatk.core.landmarks.landmark import Geometry\n"
        "assert kernels is None\n"
        "at = np.frombuffer(sys.stdin.buffer.read()).reshape(-1, 3)\n"
        "f, s = basis_gradient(Geometry(), at[:, :2], at[:, 2])\n"
        "sys.stdout.buffer.write(np.concatenate([f[..., None], s], -1).tobytes())\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        input=points.tobytes(),
        capture_output=True,
        env={**os.environ, "LOCATK_NUMPY": "1"},
        check=True,
    )
    reported = np.frombuffer(done.stdout).reshape(-1, 4, 4)
    field, slope = basis_gradient(GEOMETRIES[0], points[:, :2], points[:, 2])
    np.testing.assert_allclose(field, reported[..., 0], rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(slope, reported[..., 1:], rtol=1e-9, atol=1e-11)


def test_shapes_broadcast() -> None:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (7, 3, 2))
    heights = np.array([0.01, 0.012, 0.02])
    field, slope = basis_gradient(Geometry(), points, heights)
    assert field.shape == (7, 3, 4)
    assert slope.shape == (7, 3, 4, 3)
    np.testing.assert_array_equal(field[4, 2], basis(Geometry(), points[4, 2], 0.02))
    np.testing.assert_array_equal(
        basis(Geometry(), points), basis(Geometry(), points, Geometry().sensor_height_m)
    )
    assert basis(Geometry(), np.empty((0, 2))).shape == (0, 4)
    assert landmark_field(Geometry(), 5, points).shape == (7, 3)
