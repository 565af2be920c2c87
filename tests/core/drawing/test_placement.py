"""Free space for texts between lines and other texts."""

from __future__ import annotations

import pytest

from locatk.core.drawing import Circle, Line, Text
from locatk.core.drawing.placement import TEXT_CLEARANCE_MM, Obstacles, interrupt, text_box


def test_the_box_of_upright_text_is_that_of_level_text_rotated() -> None:
    left, bottom, right, top = text_box(Text("page", (10.0, 20.0), 7.0))
    turned = text_box(Text("page", (10.0, 20.0), 7.0, angle_deg=90))
    assert turned == pytest.approx((30 - top, 10 + left, 30 - bottom, 10 + right))


def test_the_first_free_text_is_placed_and_becomes_an_obstacle() -> None:
    obstacles = Obstacles([Line((0, 1), (50, 1)), Circle((5, 12), 3)], (0, 0, 50, 50))
    texts = [Text("ab", position, 7.0) for position in ((2, 0), (3, 10), (-1, 30), (20, 20))]
    assert obstacles.place(texts) == [texts[-1]]
    assert obstacles.place(texts) == []


def test_lines_are_interrupted_by_texts() -> None:
    label = Text("ab", (10.0, -1.0), 7.0)
    parts = interrupt(Line((0.0, 0.0), (40.0, 0.0)), [label, Text("far", (20.0, 5.0), 7.0)])
    left, _, right, _ = text_box(label)
    assert [part.start[0] for part in parts] == pytest.approx(
        [0, right + TEXT_CLEARANCE_MM + 0.075]
    )
    assert [part.end[0] for part in parts] == pytest.approx([left - TEXT_CLEARANCE_MM - 0.075, 40])
