"""Natural order of names."""

from __future__ import annotations

from itertools import permutations

from locatk.core.natural_order import natural_key


def test_numbers_are_compared_by_value() -> None:
    names = ["robot-10", "robot-2", "Robot-3", "robot", "2", "10", "a1b10", "a1b9"]
    assert sorted(names, key=natural_key) == [
        "2", "10", "a1b9", "a1b10", "robot", "robot-2", "Robot-3", "robot-10",
    ]  # fmt: skip


def test_any_names_have_one_order() -> None:
    names = ["", "a", "A", "a01", "a1", "1a", "a²"]
    assert {tuple(sorted(order, key=natural_key)) for order in permutations(names)} == {
        tuple(sorted(names, key=natural_key))
    }
