"""Paper sizes."""

from __future__ import annotations

import pytest

from locatk.core.errors import InputError
from locatk.core.paper_sizes import PAPER_SIZES_MM, paper_name, paper_size, parse_paper


def test_papers() -> None:
    assert paper_size("A4") == ("A4", (210.0, 297.0))
    assert paper_size(" letter ", landscape=True) == ("Letter", (279.4, 215.9))
    assert paper_size("Tabloid", landscape=False) == ("Tabloid", (279.4, 431.8))
    assert paper_size("914.4x3000mm") == ("914.4x3000", (914.4, 3000.0))
    assert paper_size("24x36in") == ("609.6x914.4", (609.6, 914.4))
    assert paper_size('8.5 x 11"')[1] == PAPER_SIZES_MM["Letter"]
    assert paper_size("60x90 cm")[1] == paper_size("0.6x0.9M")[1] == (600.0, 900.0)
    assert paper_size("3000 X 600") == ("3000x600", (3000.0, 600.0))
    assert paper_size("3000x600", landscape=False)[1] == (600.0, 3000.0)
    # ISO 216: each paper is the one before, cut in half.
    for large, small in (("A0", "A1"), ("A1", "A2"), ("A2", "A3"), ("A3", "A4"), ("A4", "A5")):
        assert PAPER_SIZES_MM[small] == (PAPER_SIZES_MM[large][1] // 2, PAPER_SIZES_MM[large][0])
    assert paper_name((297.4, 209.8)) == "A4"
    assert paper_name((215.9, 279.4)) == "Letter"
    assert paper_name((500.2, 30)) == "500x30"


@pytest.mark.parametrize(
    "text",
    ["A9", "", "10x", "0x100mm", "-5x100", "1e9x1e9", "nanx5", "٣x٣", "24x36ft", "24x4000in"],
)
def test_unknown_papers_are_refused(text: str) -> None:
    with pytest.raises(InputError):
        paper_size(text)


def test_rolls() -> None:
    assert parse_paper("A4").size_mm == (210.0, 297.0)
    assert not parse_paper("A4").is_roll
    assert parse_paper("ROLL:914 mm").name == "roll:914mm"
    assert parse_paper("roll:914.4").size_mm[0] == 914.4
    assert parse_paper("roll:914.4").is_roll
    assert parse_paper("roll:36in") == parse_paper("roll:914.4mm")
    for text in ("roll", "roll:0mm", "roll:5001mm", "roll:914mm wide"):
        with pytest.raises(InputError):
            parse_paper(text)
