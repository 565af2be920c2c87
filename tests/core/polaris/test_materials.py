"""Discs and bill of materials of tags."""

from __future__ import annotations

from dataclasses import replace

import pytest

from locatk.core.errors import InputError
from locatk.core.materials import NDFEB_REMANENCES_T
from locatk.core.polaris.design.materials import bill_of_materials, disc_magnet
from locatk.core.polaris.tag import Tags


@pytest.mark.parametrize("grade", NDFEB_REMANENCES_T)
def test_discs_keep_their_grade(grade: str) -> None:
    low, high = NDFEB_REMANENCES_T[grade]
    disc = disc_magnet(2e-3, 1e-3, grade=grade)
    assert disc.grade == grade
    assert low < disc.remanence_t < high


def test_moments_of_common_discs() -> None:
    assert disc_magnet(2e-3, 0.5e-3, grade="N52").moment == pytest.approx(1.812e-3, rel=1e-3)
    assert disc_magnet(3e-3, 1e-3, grade="N42").moment == pytest.approx(7.312e-3, rel=1e-3)
    measured = disc_magnet(2e-3, 0.5e-3, grade="N52", remanence_t=1.1)
    assert (measured.grade, measured.remanence_t) == ("N52", 1.1)
    with pytest.raises(InputError, match="no grade"):
        disc_magnet(2e-3, 0.5e-3, grade="N99")
    with pytest.raises(InputError, match="remanence"):
        disc_magnet(2e-3, 0.5e-3, remanence_t=14_500)
    with pytest.raises(InputError, match="no disc"):
        disc_magnet(-2e-3, 0.5e-3, grade="N52")


def test_the_bill_counts_tags() -> None:
    items = {item.part: item for item in bill_of_materials(Tags(), 9, "MLX90393", 20)}
    assert items["disc magnet"].count == 100
    assert items["substrate"].count == 20
    assert items["magnetometer"].count == 9
    # "< $0.015" and "< $2 each" (Polaris, ACM MobiCom 2024, sections 7.2 and 7.1)
    prices = {part: item.price.amount for part, item in items.items() if item.price is not None}
    assert prices == {"disc magnet": 0.015, "magnetometer": 2.0}
    other = bill_of_materials(
        replace(Tags(), magnet=disc_magnet(3e-3, 1e-3, grade="N42")), 9, "MLX90393"
    )
    assert other[0].price is None
