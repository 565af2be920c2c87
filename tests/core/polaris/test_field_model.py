"""The solver's field of a disc, against magpylib's cylinder."""

from __future__ import annotations

from typing import Any

import magpylib
import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray

from locatk.core.polaris.detection.field_model import MagnetOffsets, disc_correction
from locatk.core.polaris.tag import Magnet

Array = NDArray[np.float64]

DISC = Magnet(2e-3, 0.5e-3, 1.45)


def over(height: float, count: int = 23) -> tuple[MagnetOffsets, Array]:
    """A plane of sensors over a magnet: as offsets and as places (5, count, 3)."""
    x = np.linspace(-0.03, 0.03, count)
    y = np.array([-0.021, -0.008, 0.0, 0.005, 0.03])
    along = np.broadcast_to(x[:, None], (len(y), 3, count, 1)).copy()
    offsets = MagnetOffsets.from_components(along, y[:, None, None, None], height)
    position = np.stack(np.broadcast_arrays(x, y[:, None], height), axis=-1)
    return offsets, position


def cylinder(position: Array, magnet: Magnet, angle: float) -> Array:
    """magpylib's field (..., 3) of a disc that is magnetised towards ``angle``."""
    polarization = magnet.remanence_t * np.array([np.cos(angle), np.sin(angle), 0])
    source = magpylib.magnet.Cylinder(
        polarization=polarization, dimension=(magnet.diameter_m, magnet.height_m)
    )
    return np.asarray(source.getB(position))


def modelled(offsets: MagnetOffsets, moment: ArrayLike, flat: float = 0.0) -> Array:
    """The solver's field, in the shape of :func:`cylinder`."""
    field = offsets.unit_fields(flat)[:, :, :, 0] @ np.asarray(moment, float)
    return np.asarray(field.transpose(0, 2, 1))


def flat_moment(magnet: Magnet, angle: float) -> Array:
    return magnet.moment * np.array([np.cos(angle), np.sin(angle), 0])


@pytest.mark.parametrize("angle", [0.0, 0.7, np.pi / 2, 4.0])
@pytest.mark.parametrize(
    ("magnet", "height", "point", "disc"),
    [
        (DISC, 0.010, 0.02, 5e-4),
        (DISC, 0.005, 0.07, 8e-3),
        (Magnet(1e-3, 0.5e-3, 1.45), 0.005, 0.015, 5e-4),
        (Magnet(3e-3, 1e-3, 1.19), 0.010, 0.04, 3e-3),
        (Magnet(2e-3, 4e-3, 1.3), 0.015, 0.04, 2e-3),  # taller than wide: the other sign
    ],
)
def test_disc_is_magpylibs_cylinder(
    magnet: Magnet, height: float, point: float, disc: float, angle: float
) -> None:
    offsets, position = over(height)
    truth = cylinder(position, magnet, angle)
    peak = np.abs(truth).max()
    moment = flat_moment(magnet, angle)
    as_point = np.abs(modelled(offsets, moment) - truth).max() / peak
    as_disc = np.abs(modelled(offsets, moment, disc_correction(magnet)) - truth).max() / peak
    assert as_point < point
    assert as_disc < disc
    assert as_disc < 0.25 * as_point  # what the thickness is for


def test_moment_upward_is_magpylibs_too() -> None:
    offsets, position = over(0.01)
    moment = (0, 0, 2e-3)
    truth = magpylib.misc.Dipole(moment=moment).getB(position)
    np.testing.assert_allclose(modelled(offsets, moment), truth, atol=1e-9 * np.abs(truth).max())


def test_no_magnet_is_a_point() -> None:
    assert disc_correction(None) == 0.0


def shifted(offsets: MagnetOffsets, **by: float) -> MagnetOffsets:
    return MagnetOffsets.from_components(
        offsets.x + by.get("x", 0.0), offsets.y + by.get("y", 0.0), offsets.z + by.get("z", 0.0)
    )


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_gradients_are_those_of_the_field(axis: int) -> None:
    offsets, _ = over(0.01)
    moments = np.array([[1.2e-3, -0.7e-3, 3e-4]])
    step, name = 1e-6, "xyz"[axis]

    def field(by: float) -> Array:
        units = shifted(offsets, **{name: by}).unit_fields()
        return np.asarray(np.einsum("sanmj,mj->sanm", units, moments))

    numeric = (field(step) - field(-step)) / (2 * step)
    analytic = offsets.gradients(moments)[axis]
    np.testing.assert_allclose(analytic, numeric, atol=1e-6 * np.abs(numeric).max())


def test_each_axis_of_the_field_has_its_own_place_along_the_track() -> None:
    """X, Y and Z are converted one after the other, while the array moves on."""
    _, position = over(0.01)
    shift = np.array([-5e-4, 0.0, 5e-4])
    along = position[:, None, :, None, 0] + shift[:, None, None]
    skewed = MagnetOffsets.from_components(along, position[:, None, :1, None, 1], 0.01)
    result = modelled(skewed, flat_moment(DISC, 1.0), disc_correction(DISC))
    for axis in range(3):
        truth = cylinder(position + [shift[axis], 0, 0], DISC, 1.0)[..., axis]
        assert np.abs(result[..., axis] - truth).max() < 1e-3 * np.abs(truth).max()


def test_disc_correction_is_the_second_derivative_along_z() -> None:
    """To second order a disc's field is ``f + c f_zz`` (here by finite differences)."""
    rng = np.random.default_rng(4)
    x, y = rng.uniform(-0.02, 0.02, (3, 3, 5, 2)), rng.uniform(-0.02, 0.02, (3, 1, 1, 2))
    height, step, correction = 0.011, 1e-4, -1e-7

    def fields(z: float, c: float = 0.0) -> Any:
        return MagnetOffsets.from_components(x, y, z).unit_fields(c)

    second = (fields(height + step) - 2 * fields(height) + fields(height - step)) / step**2
    expected = correction * second
    change = fields(height, correction) - fields(height)
    np.testing.assert_allclose(change, expected, atol=1e-3 * np.abs(expected).max())
