"""Published arrays of MagX, compared with numbers of its release."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.polaris.magx import LAYOUTS_MM, published_array

# First, fifth and last row of Codes/optimization/config.py in centimetres.
RELEASED_CM = {
    "magx-large": [(4.9, -4.9, -1.63), (0, -4.9, 1.63), (0, 4.9, 1.63)],
    "magx-medium": [(4, -4, -1.63), (0, -4, 1.63), (0, 4, 1.63)],
    "magx-small": [(3, -3, -1.63), (0, -3, 1.63), (0, 3, 1.63)],
    "magx-stacked": [(4.9, -4.9, -1.63), (4.9, -4.9, 1.63), (-4.9, 4.9, 1.63)],
    "magx-flat": [(4.89, 4.89, 0), (0, -4.89, 0), (-4.89, -4.89, 0)],
    "magx-cube": [(4.89, 4.89, -4.9), (4.89, 4.89, 4.9), (-4.89, -4.89, 4.9)],
    "magx-flat-cube": [(4.89, 4.89, -1.6), (4.89, 4.89, 1.6), (-4.89, -4.89, 1.6)],
}


@pytest.mark.parametrize("name", LAYOUTS_MM)
def test_positions_are_those_of_the_release(name: str) -> None:
    layout = LAYOUTS_MM[name]
    assert layout.shape == (8, 3)
    assert len(np.unique(layout, axis=0)) == 8
    np.testing.assert_allclose(layout[[0, 4, 7]] / 10, RELEASED_CM[name])


def test_the_array_is_in_the_axes_of_its_readings() -> None:
    """The decoder of ``magx-array`` converts readings of the parts by x = -Y, y = -X, z = -Z."""
    array = published_array("magx-large")
    np.testing.assert_allclose(array.position_m[0], [0.049, -0.049, 0.0163])
    assert "osr 3 filt 5" in array.sensor


def test_other_names_are_refused() -> None:
    with pytest.raises(InputError, match="no array 'magx'"):
        published_array("magx")
