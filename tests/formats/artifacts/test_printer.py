"""Manifests in the measured scale of a printer."""

from __future__ import annotations

import numpy as np
import pytest

from locatk.core.dots.sheet import Manifest, Sheet
from locatk.formats.artifacts.printer import with_printer_scale


def tiles(page_mm: tuple[float, float]) -> Manifest:
    """Two papers side by side that carry one area, the second 150 mm further right."""
    pitch = 0.508
    step = round(150 / pitch)
    sheets = tuple(
        Sheet(
            f"floor-c{k + 1}r1",
            (1000 + k * step, 2000),
            (350, 300),
            (0, 0),
            page_mm,
            (10.0, 10.0),
            position_mm=(k * step * pitch, 0.0),
        )
        for k in range(2)
    )
    return Manifest(sheets)


def test_tiles_still_join_once_the_scale_is_known() -> None:
    manifest = with_printer_scale(
        with_printer_scale(tiles((210.0, 297.0)), (1.01, 0.99)), (1.002, 0.997)
    )
    assert manifest.scale == (1.002, 0.997)
    shared = np.array([[1000 + 320.0, 2050.0]])
    first, second = (manifest.to_metres(k, shared) for k in range(2))
    np.testing.assert_allclose(first, second, atol=1e-9)
    nominal = tiles((210.0, 297.0)).to_metres(0, shared)
    np.testing.assert_allclose(first, nominal * [1.002, 0.997], atol=1e-9)


def test_landscape_papers_exchange_the_scales() -> None:
    assert with_printer_scale(tiles((297.0, 210.0)), (1.002, 0.997)).scale == (0.997, 1.002)


def test_a_sheet_that_is_not_a_tile_has_no_position() -> None:
    sheet = Sheet("A4-0001", (0, 0), (300, 500), (0, 0), (210.0, 297.0), (10.0, 10.0))
    manifest = with_printer_scale(Manifest((sheet,)), (1.002, 0.997))
    assert manifest.sheets[0].position_mm is None
    assert manifest.to_metres(0, [[0.0, 0.0]])[0] == pytest.approx([0.01002, 0.287 * 0.997])
