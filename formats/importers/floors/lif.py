"""Layouts in VDMA's Layout Interchange Format (LIF) 1.0.0 and 2.0.0: checked access to the JSON.

The format is described in :mod:`locatk.formats.exporters.floors.layout_lif`. Landmark maps
(:mod:`.map_lif`) and sites of tags (:mod:`.site_lif`) are read from its nodes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from typing import Any, NamedTuple

from locatk.core.errors import FormatError

MAX_COORDINATE_M = 1e4
"""10 km, larger than any floor: larger numbers are in another unit."""

NAME_KEY = {"1": "nodeName", "2": "nodeDescriptor"}
"""Key of the name of a node by the major version of LIF."""


class LayoutNode(NamedTuple):
    """Node of a layout.

    Attributes
    ----------
    data : dict
        Its JSON object.
    where : str
        Its path in the file, as in ``"nodes[3]"``.
    node_id : str
    x_m, y_m : float
    """

    data: dict[str, Any]
    where: str
    node_id: str
    x_m: float
    y_m: float


class LayoutReader:
    """Checked access to the JSON; errors name ``file``."""

    def __init__(self, file: str | os.PathLike[str]) -> None:
        self._file = file

    def nodes(self, layout: dict[str, Any]) -> Iterator[LayoutNode]:
        """Yield the nodes of a layout, of which no two have the same id."""
        known = set()
        for number, node in enumerate(self.objects(layout, "nodes")):
            where = f"nodes[{number}]"
            node_id = self.text(node, "nodeId", where)
            if node_id in known:
                raise self.error(f"node {node_id!r} occurs twice", where)
            known.add(node_id)
            yield LayoutNode(node, where, node_id, *self.position(node, where))

    def error(self, message: str, where: str, hint: str | None = None) -> FormatError:
        return FormatError(message, file=self._file, where=where, hint=hint)

    def layout(self, text: str) -> tuple[dict[str, Any], str]:
        """Return the only layout of the text, and the major version of its format."""
        try:
            data = json.loads(text.removeprefix("\ufeff"))
        except json.JSONDecodeError as error:
            raise FormatError(
                f"not JSON ({error.msg})", file=self._file, where=error.lineno
            ) from None
        except (ValueError, RecursionError) as error:
            raise FormatError(f"not JSON ({error})", file=self._file) from None
        if not isinstance(data, dict):
            raise FormatError("not LIF: expected an object", file=self._file)
        major = self._major_version(data)
        root = "layouts" if major == "1" else "origins"
        if root not in data:
            raise FormatError(f"not LIF {major}: expected the key {root!r}", file=self._file)
        parents = [data] if major == "1" else self.objects(data, "origins")
        layouts = [layout for parent in parents for layout in self.objects(parent, "layouts")]
        if len(layouts) != 1:
            raise self.error(
                f"{len(layouts)} layouts, expected one",
                "layouts",
                "A map or a site is one floor: keep one layout in the file",
            )
        return layouts[0], major

    def _major_version(self, data: dict[str, Any]) -> str:
        """Return the stated major version; a file without one is recognized by its keys."""
        head = data.get("metaInformation")
        version = head.get("lifVersion") if isinstance(head, dict) else None
        if version is None:
            return "2" if "origins" in data else "1"
        major = version.split(".")[0] if isinstance(version, str) else ""
        if major not in NAME_KEY:
            raise self.error(
                f"version {version!r} of LIF is not supported",
                "metaInformation.lifVersion",
                "Export the layout as LIF 1.0.0 or 2.0.0",
            )
        return major

    def objects(self, data: dict[str, Any], key: str) -> list[dict[str, Any]]:
        """Return a list of objects."""
        value = data.get(key)
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            raise self.error("expected a list of objects", key)
        return value

    def text(self, data: dict[str, Any], key: str, where: str) -> str:
        """Return a string that is not empty; ``where`` is the path of ``data``."""
        value = data.get(key)
        if not isinstance(value, str) or not value:
            raise self.error("expected a string", f"{where}.{key}")
        return value

    def position(self, node: dict[str, Any], where: str) -> tuple[float, float]:
        """Return the position of a node in metres."""
        position = node.get("nodePosition")
        coordinates = []
        for axis in ("x", "y"):
            value = position.get(axis) if isinstance(position, dict) else None
            is_number = isinstance(value, int | float) and not isinstance(value, bool)
            if value is None or not is_number or not abs(value) <= MAX_COORDINATE_M:
                raise self.error(
                    f"expected x and y in metres, up to {MAX_COORDINATE_M:g}",
                    f"{where}.nodePosition",
                )
            coordinates.append(float(value))
        return coordinates[0], coordinates[1]
