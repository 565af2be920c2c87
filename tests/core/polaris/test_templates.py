"""Template sets, against magpylib driven sample by sample and against published figures."""

from __future__ import annotations

import math

import magpylib
import numpy as np
import pytest

from locatk.core.errors import InputError
from locatk.core.polaris.published.cylinders import cylinder_fields
from locatk.core.polaris.published.templates import (
    MAX_SET_SAMPLES,
    TemplateGrid,
    dipole_fields,
    template_set,
    templates,
)
from locatk.core.polaris.tag import Magnet, Tags

ALONG = np.linspace(-0.03, 0.03, 31)


def driven(magnet: Magnet, clearance: float, lateral: float, angle: float) -> np.ndarray:
    """A turned magnet and a sensor that is moved over it."""
    source = magpylib.magnet.Cylinder(
        polarization=(magnet.remanence_t, 0, 0), dimension=(magnet.diameter_m, magnet.height_m)
    ).rotate_from_angax(math.degrees(angle), "z")
    return np.array([source.getB((x, lateral, clearance)) for x in ALONG])


@pytest.mark.slow
@pytest.mark.parametrize("magnet", [Magnet(), Magnet(3e-3, 1e-3, 1.2, "N35")])
def test_cylinders_are_magpylibs(magnet: Magnet) -> None:
    laterals, angles = np.array([-0.01, 0.0, 0.004]), np.radians([0, 35, 90, 200])
    generated = templates(magnet, 0.006, ALONG, laterals, angles, cylinder_fields)
    assert generated.field_t.shape == (12, 31, 3)
    for lateral, angle, field in zip(
        generated.lateral_m, generated.angle_rad, generated.field_t, strict=True
    ):
        true = driven(magnet, 0.006, lateral, angle)
        np.testing.assert_allclose(field, true, rtol=1e-9, atol=1e-14)


def test_the_grid_holds_every_offset_with_every_orientation_once() -> None:
    generated = templates(Magnet(), 0.01, ALONG, np.array([-0.01, 0.0, 0.01]), np.array([0.0, 1.0]))
    assert generated.lateral_m.tolist() == [-0.01, 0.0, 0.01] * 2
    assert generated.angle_rad.tolist() == [0.0] * 3 + [1.0] * 3


def test_dipoles_are_within_the_disc_s_size_of_cylinders() -> None:
    # 1.4 % of the peak at 10 mm, 5.6 % at 5 mm.
    laterals, angles = np.linspace(-0.01, 0.01, 5), np.linspace(0, math.tau, 36, endpoint=False)
    for clearance, most in ((0.01, 0.015), (0.005, 0.06)):
        near, true = (
            templates(Magnet(), clearance, ALONG, laterals, angles, fields).field_t
            for fields in (dipole_fields, cylinder_fields)
        )
        worst = np.abs(near - true).max() / np.linalg.norm(true, axis=-1).max()
        assert 0.1 * most < worst < most


def test_the_released_set_s_peak() -> None:
    # Polaris' template_36_5_80.txt: 2 x 1 mm, 2 T, 15 mm away, 147.5 uT straight above.
    disc = Magnet(2e-3, 1e-3, 2.0, "")
    generated = templates(disc, 0.015, np.zeros(1), np.zeros(1), np.zeros(1), cylinder_fields)
    assert np.linalg.norm(generated.field_t) == pytest.approx(147.5e-6, abs=0.5e-6)


def test_the_paper_s_set() -> None:
    generated = template_set(Tags(), 0.01)
    assert generated.field_t.shape == (180, 80, 3)
    assert np.unique(generated.lateral_m) == pytest.approx([-0.01, -0.005, 0, 0.005, 0.01])
    assert np.diff(np.unique(np.degrees(generated.angle_rad))) == pytest.approx(10)
    # Straight above a magnet that points ahead, the field points back.
    ahead = generated.field_t[(generated.angle_rad == 0) & (generated.lateral_m == 0)][0]
    assert ahead[:, 0].argmin() in (39, 40)
    assert ahead[:, 0].min() == pytest.approx(-np.abs(generated.field_t).max(), rel=0.01)
    assert np.abs(ahead[:, 1]).max() == 0
    assert ahead[0, 2] < 0 < ahead[-1, 2]


def test_resolution_of_a_set() -> None:
    generated = template_set(Tags(), 0.01, TemplateGrid(orientations=360, offsets=3, points=15))
    assert generated.field_t.shape == (1080, 15, 3)
    assert np.unique(generated.lateral_m) == pytest.approx([-0.01, 0, 0.01])
    assert np.diff(np.unique(np.degrees(generated.angle_rad))) == pytest.approx(1)


def test_a_single_offset_is_the_middle() -> None:
    assert set(template_set(Tags(), 0.01, TemplateGrid(offsets=1)).lateral_m) == {0.0}


def test_a_set_of_cylinders() -> None:
    generated = template_set(Tags(), 0.01, TemplateGrid(4, 3, 9), cylinder_fields)
    disc = Tags().magnet
    source = magpylib.magnet.Cylinder(
        polarization=(disc.remanence_t, 0, 0), dimension=(disc.diameter_m, disc.height_m)
    )
    np.testing.assert_allclose(generated.field_t[1, 4], source.getB((0, 0, 0.01)), atol=1e-14)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ((1, 5, 80), "1 orientations"),
        ((3601, 1, 5), "3601 orientations"),
        ((36, 0, 80), "0 offsets"),
        ((36, 102, 80), "102 offsets"),
        ((36, 5, 4), "4 points"),
        ((36, 5, 1001), "1001 points"),
        ((3600, 100, 100), "36,000,000 samples"),
    ],
)
def test_resolutions_that_are_refused(numbers: tuple[int, int, int], message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        TemplateGrid(*numbers)
    assert error.value.hint


def test_limits_of_the_resolution() -> None:
    assert TemplateGrid(2, 1, 5).points == 5
    assert TemplateGrid(1000, 5, 1000).orientations == 1000
    assert MAX_SET_SAMPLES == 1000 * 5 * 1000
