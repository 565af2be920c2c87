"""Landmark maps from DXF drawings: block inserts, closed outlines or points with letters.

:mod:`.dxf` describes positions and rotations; the rotation of an insert is the heading of its
landmark as built. The letters of the bars, as in ``NNSN``, are the first of: the attribute LANDMARK
of the insert, a text in the block or next to the object that ends in them, as in ``0,3 NNSN``, and
the end of the name of the block, as in ``LANDMARK_NNSN``. Walls are not read.
:mod:`locatk.formats.exporters.floors.map_drawing` writes such drawings.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from locatk.core.errors import error_context
from locatk.core.landmarks.landmark import code_of
from locatk.core.landmarks.map.floor import FloorMap
from locatk.core.landmarks.map.grid_fit import MAX_OFFSET_M, floor_from_poses
from locatk.formats.importers.floors.dxf import DxfLayers, DxfObject, DxfReader

LETTERS_ATTRIBUTE = "LANDMARK"

LETTER_COUNT = 4
"""Number of bars of a landmark."""


def read_map_drawing(
    path: Path,
    layers: Sequence[str],
    unit: str | None = None,
    *,
    pitch_m: float | None = None,
    tolerance_m: float = MAX_OFFSET_M,
) -> tuple[FloorMap, DxfLayers]:
    """Read the landmarks on layers of a drawing; pitch and cells are estimated from the positions.

    Parameters
    ----------
    path : path
    layers : sequence of str
        Layers of the landmarks and of their texts.
    unit : str, optional
        Unit of the drawing, which takes precedence over that of the file.
    pitch_m, tolerance_m
        See :func:`locatk.core.landmarks.map.grid_fit.fit_grid`.

    Raises
    ------
    FormatError
        See :class:`~locatk.formats.importers.floors.dxf.DxfReader`; a landmark has no letters.
    InputError
        The positions are not on a grid; the error names the handle of a deviating one.
    """
    reader = DxfReader(path)
    content = reader.read(layers, unit)
    codes = [_code(reader, item) for item in content.objects]
    poses = [(item.x_m, item.y_m, item.rotation_rad or 0.0) for item in content.objects]
    names = [item.name for item in content.objects]
    with error_context(path):
        floor = floor_from_poses(codes, poses, names, pitch_m=pitch_m, tolerance_m=tolerance_m)
    return floor, content


def _code(reader: DxfReader, item: DxfObject) -> int:
    texts = [item.attributes.get(LETTERS_ATTRIBUTE, "")]
    texts += [text.text for text in (*item.block_texts, *item.nearby_texts)]
    for text in (*texts, item.block):
        try:
            return code_of(text[-LETTER_COUNT:].upper())
        except ValueError:
            continue
    raise reader.error(
        "a landmark without the letters of its bars",
        item.handle,
        "Name its block as in LANDMARK_NNSN, or place the letters next to it: counter-clockwise "
        "from +x",
    )
