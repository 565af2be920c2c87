"""What tests of printed pages share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pikepdf
import pytest

OTHER_COLOURS = {"g", "G", "rg", "RG", "k", "K", "sc", "SC"}
PAINTING = {"Tj", "'", "f", "S", "B", "b", "Do"}


@pytest.fixture
def assert_one_ink() -> Callable[[Any], None]:
    """``assert_one_ink(page)``: its content, or that of a form, is in full black ink alone.

    That is the ink of this name on devices with inks, and plain black on all others.
    """

    def check(holder: Any) -> None:
        (space,) = holder.Resources.ColorSpace.values()
        assert list(map(str, space[:3])) == ["/Separation", "/Black", "/DeviceGray"]
        assert (list(space[3].C0), list(space[3].C1)) == ([1], [0])
        drawn = [(str(op), operands) for operands, op in pikepdf.parse_content_stream(holder)]
        names = [name for name, _ in drawn]
        assert not OTHER_COLOURS & set(names)
        tints = [operands for name, operands in drawn if name in ("scn", "SCN")]
        assert all([float(value) for value in operands] == [1] for operands in tints)
        # The ink is selected before anything is painted.
        first = next(number for number, name in enumerate(names) if name in PAINTING)
        assert names.index("scn") < first
        assert "S" not in names or names.index("SCN") < first

    return check
