"""Points for tags from a DXF drawing: block inserts, closed outlines or points with text.

:mod:`.dxf` describes positions and rotations; the rotation of an insert is the heading of its tag,
so that the x axis of the block is that of the tag. The id of a tag is the first of:

- the attribute ID of the insert;
- a text in the block, or next to the object: a whole number, also as in ``tag 12`` or ``#12``. Text
  after it, as in ``12 dock``, is the meaning;
- the number at the end of the name of the block, as in ``TAG_12``, if no block is used twice.

The meaning is the attribute MEANING, or a text in the block or next to the object that is no id.
:mod:`locatk.formats.exporters.floors.site_drawing` writes such drawings.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from locatk.core.polaris.design.site import SitePoint
from locatk.core.polaris.tag import MAX_MEANING_CHARACTERS
from locatk.formats.importers.floors.dxf import DxfObject, DxfReader, DxfText
from locatk.formats.importers.floors.site_csv import MAX_ID_DIGITS

ID_ATTRIBUTE, MEANING_ATTRIBUTE = "ID", "MEANING"

_ID_TEXT = re.compile(
    rf"(?:(?:tag|id|no\.?|nr\.?|#)[ _:#]*)?([0-9]{{1,{MAX_ID_DIGITS}}})(?:[ :,;]+(.*))?", re.I
)
_BLOCK_NUMBER = re.compile(rf".*[^0-9]([0-9]{{1,{MAX_ID_DIGITS}}})", re.S)


@dataclass(frozen=True)
class DrawnSite:
    """Points of a drawing.

    Attributes
    ----------
    points : tuple of SitePoint
        In the order of the file.
    has_heading : bool
        Whether any object is an insert.
    unit : str
        Unit of the drawing.
    ignored : dict of str to int
        Number of other entities on the layers, by their kinds in the terms of DXF.
    """

    points: tuple[SitePoint, ...]
    has_heading: bool
    unit: str
    ignored: dict[str, int]


def read_site_drawing(path: Path, layers: Sequence[str], unit: str | None = None) -> DrawnSite:
    """Read the points on layers of a drawing.

    Parameters
    ----------
    path : path
    layers : sequence of str
        Layers of the tags and of their texts.
    unit : str, optional
        Unit of the drawing, which takes precedence over that of the file.

    Raises
    ------
    FormatError
        See :class:`~locatk.formats.importers.floors.dxf.DxfReader`; an id is not a whole number, a
        tag has two ids, a text with an id belongs to no tag, or a meaning is too long.
    """
    reader = DxfReader(path)
    content = reader.read(layers, unit)
    block_uses = Counter(item.block for item in content.objects if item.block)
    are_blocks_unique = max(block_uses.values(), default=0) == 1
    points = []
    for item in content.objects:
        texts = _Texts(reader, item)
        tag_id = _attribute_id(reader, item)
        if tag_id is None:
            tag_id = texts.tag_id
        number = _BLOCK_NUMBER.fullmatch(item.block)
        if tag_id is None and are_blocks_unique and number is not None:
            tag_id = int(number[1])
        meaning = item.attributes.get(MEANING_ATTRIBUTE) or texts.meaning
        if len(meaning) > MAX_MEANING_CHARACTERS or not meaning.isprintable():
            raise reader.error(
                f"the meaning is not one line of at most {MAX_MEANING_CHARACTERS} characters",
                item.handle,
                "Shorten it, or move texts that are no meanings to another layer",
            )
        heading = item.rotation_rad or 0.0
        points.append(SitePoint(item.x_m, item.y_m, heading, tag_id, meaning, item.name))
    lost = [text for text in content.distant_texts if _ID_TEXT.fullmatch(text.text)]
    if lost and any(point.tag_id is None for point in points):
        raise reader.error(
            f"the text {lost[0].text!r} is next to no tag",
            lost[0].handle,
            "Place it nearer to its tag than half of the distance to the next tag",
        )
    has_heading = any(item.rotation_rad is not None for item in content.objects)
    ignored = dict(content.ignored)
    if len(content.distant_texts) > len(lost):
        ignored["distant TEXT"] = len(content.distant_texts) - len(lost)
    return DrawnSite(tuple(points), has_heading, content.unit, ignored)


class _Texts:
    """Id and meaning by the texts of an object; those in its block come first."""

    def __init__(self, reader: DxfReader, item: DxfObject) -> None:
        self.tag_id: int | None = None
        meanings: list[str] = []
        for texts in (item.block_texts, item.nearby_texts):
            ids = [(text, match) for text in texts if (match := _ID_TEXT.fullmatch(text.text))]
            if self.tag_id is None and ids:
                if len({int(match[1]) for _, match in ids}) > 1:
                    raise _two_ids(reader, item, [text for text, _ in ids])
                self.tag_id = int(ids[0][1][1])
                meanings += [match[2] for _, match in ids if match[2]]
            meanings += [text.text for text in texts if not _ID_TEXT.fullmatch(text.text)]
        self.meaning = " ".join(filter(None, meanings))


def _two_ids(reader: DxfReader, item: DxfObject, texts: list[DxfText]) -> Exception:
    found = " and ".join(repr(text.text) for text in texts[:2])
    return reader.error(
        f"a tag with two ids, {found}",
        item.handle,
        "Place each text next to its tag, and other numbers on another layer",
    )


def _attribute_id(reader: DxfReader, item: DxfObject) -> int | None:
    """Return the id by the attribute of an insert; None if it has none."""
    text = item.attributes.get(ID_ATTRIBUTE, "")
    if not text:
        return None
    if not (text.isascii() and text.isdigit() and len(text) <= MAX_ID_DIGITS):
        raise reader.error(
            f"the attribute {ID_ATTRIBUTE} is {text[:40]!r}",
            item.handle,
            "Give a whole number from 0, or leave it empty",
        )
    return int(text)
