"""Magnet grades and sizes of parts."""

from __future__ import annotations

import pytest

from locatk.core.errors import InputError
from locatk.core.materials import (
    NDFEB_REMANENCES_T,
    magnet_material,
    remanence_of_grade,
    size_mm_text,
)


@pytest.mark.parametrize("grade", NDFEB_REMANENCES_T)
def test_the_remanence_of_a_grade_is_the_middle_of_its_range(grade: str) -> None:
    low, high = NDFEB_REMANENCES_T[grade]
    assert remanence_of_grade(grade) == pytest.approx((low + high) / 2, abs=1e-4)


def test_unknown_grades_are_rejected_with_the_known_ones() -> None:
    with pytest.raises(InputError, match="no grade 'N99'") as error:
        remanence_of_grade("N99")
    assert "N52" in (error.value.hint or "")


@pytest.mark.parametrize(
    ("remanence", "material"),
    [
        (1.2, "NdFeB N35"),
        (1.22, "NdFeB N35 or N38"),
        (1.45, "N52"),
        (0.4, "ferrite"),
        (0.9, "magnet"),
    ],
)
def test_remanences_are_named_after_grades(remanence: float, material: str) -> None:
    assert material in magnet_material(remanence)


def test_the_listed_range_has_a_tolerance() -> None:
    low, high = NDFEB_REMANENCES_T["N35"][0], NDFEB_REMANENCES_T["N52"][1]
    assert magnet_material(low - 0.004) == "NdFeB N35"
    assert magnet_material(high + 0.004) == "NdFeB N52"
    assert magnet_material(low - 0.006) == magnet_material(high + 0.006) == "magnet"


def test_sizes_have_no_superfluous_digits() -> None:
    assert size_mm_text(0.03, 0.01, 0.005) == "30 x 10 x 5 mm"
    assert size_mm_text(0.002, 0.0005) == "2 x 0.5 mm"
