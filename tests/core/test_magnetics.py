"""Fields of dipoles, against magpylib and against Maxwell."""

from __future__ import annotations

import warnings

import magpylib
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from locatk.core.magnetics import dipole_field, dipole_tensor

far = st.floats(0.002, 0.5) | st.floats(-0.5, -0.002)
moment = st.floats(-1, 1)


@settings(max_examples=60, deadline=None)
@given(st.tuples(far, far, far), st.tuples(moment, moment, moment))
def test_field_is_magpylibs(place: tuple[float, ...], moments: tuple[float, ...]) -> None:
    expected = magpylib.misc.Dipole(moment=moments).getB(place)
    np.testing.assert_allclose(
        dipole_field(place, moments), expected, rtol=1e-8, atol=1e-9 * np.abs(expected).max()
    )


@settings(max_examples=40, deadline=None)
@given(st.tuples(far, far, far))
def test_tensor_is_symmetric_and_traceless(place: tuple[float, ...]) -> None:
    tensor = dipole_tensor(place)
    np.testing.assert_allclose(tensor, tensor.T, rtol=1e-12)
    assert abs(np.trace(tensor)) < 1e-12 * np.abs(tensor).max()


def test_field_has_neither_sources_nor_curl() -> None:
    """Its derivatives by x, y and z are a symmetric, traceless matrix in free space."""
    place, step = np.array([0.013, -0.007, 0.011]), 1e-6
    ahead = place + step * np.eye(3)
    behind = place - step * np.eye(3)
    moments = [1e-3, -2e-3, 5e-4]
    slope = (dipole_field(ahead, moments) - dipole_field(behind, moments)) / (2 * step)
    assert abs(np.trace(slope)) < 1e-7 * np.abs(slope).max()
    np.testing.assert_allclose(slope, slope.T, atol=1e-7 * np.abs(slope).max())


def test_shapes_broadcast() -> None:
    rng = np.random.default_rng(0)
    offsets, moments = rng.normal(size=(7, 4, 3)), rng.normal(size=(4, 3))
    field = dipole_field(offsets, moments)
    assert field.shape == (7, 4, 3)
    assert dipole_tensor(offsets).shape == (7, 4, 3, 3)
    np.testing.assert_allclose(field[5, 2], dipole_field(offsets[5, 2], moments[2]))


def test_at_the_dipole_the_field_is_not_finite_without_a_warning() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not np.isfinite(dipole_tensor(np.zeros(3))).any()
