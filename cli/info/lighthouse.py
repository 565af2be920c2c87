"""Tables of Lighthouse stations and receivers for ``locatk info`` and ``locatk import``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Table = tuple[tuple[str, ...], list[tuple[Any, ...]]]
"""A header and its rows."""

STATION_KEYS = {"id", "period_ticks", "sweeps", "missed", "calibration", "frames", "damaged"}
"""Entries of the metadata records ``station-<channel>`` that :func:`station_table` shows."""


def is_shown(name: str, key: str) -> bool:
    """Return whether an entry of the metadata is in the table of stations."""
    return name.startswith("station-") and key in STATION_KEYS


def station_table(stations: Sequence[Mapping[str, Any]], scale: str | None = None) -> Table:
    """Return the table of stations without columns that are unknown for all of them.

    Parameters
    ----------
    stations : sequence of mapping
        As described by :func:`locatk.formats.descriptions.lighthouse.describe_station`.
    scale : str, optional
        Origin of the scale of the scene; positions are in units if it is ``"unit"``.
    """
    unit = "units" if scale == "unit" else "m"

    def is_known(key: str) -> bool:
        return any(station.get(key) is not None for station in stations)

    columns: list[tuple[str, bool, Callable[[Mapping[str, Any]], object]]] = [
        ("channel", True, lambda s: s["channel"]),
        ("id", True, lambda s: hexadecimal(s["id"]) or "-"),
        ("period", True, lambda s: f"{s['period_ticks']:.0f}"),
        ("ppm", is_known("ppm"), lambda s: _or_dash(s["ppm"], "+.2f")),
        ("sweeps", True, lambda s: _or_dash(s["sweeps"])),
        ("rejected", is_known("rejected"), lambda s: _or_dash(s["rejected"])),
        ("decoded", is_known("decode_rate"), lambda s: _percent(s["decode_rate"])),
        ("calibration", True, lambda s: s["calibration"] or "-"),
        ("vs. others [mrad]", is_known("verification_rad"), _verification),
        ("OOTX frames", is_known("frames"), lambda s: _or_dash(s["frames"])),
        ("damaged", any(s["damaged"] for s in stations), lambda s: _or_dash(s["damaged"])),
        (f"position [{unit}]", is_known("position_m"), lambda s: _position(s["position_m"])),
    ]
    shown = [(title, cell) for title, is_needed, cell in columns if is_needed]
    rows = [tuple(cell(station) for _, cell in shown) for station in stations]
    return tuple(title for title, _ in shown), rows


def receiver_table(receivers: Sequence[Mapping[str, Any]]) -> Table:
    """Return the table of receivers."""
    header = ("receiver", "kind", "sensors", "size [mm]", "directions")
    rows = [
        (
            each.get("device", "-"),
            each["name"] or "-",
            each["sensors"],
            " x ".join(f"{size:.4g}" for size in each["size_mm"]),
            "-" if each["normal"] is None else "known",
        )
        for each in receivers
    ]
    return header, rows


def hexadecimal(number: int | None) -> str | None:
    """Format a serial number as on the label of a station."""
    return None if number is None else f"{number:08x}"


def _or_dash(value: Any, form: str = "") -> str:
    return "-" if value is None else f"{value:{form}}"


def _position(position: Sequence[float] | None) -> str:
    return "-" if position is None else ", ".join(f"{x:.3f}" for x in position)


def _percent(fraction: float | None) -> str:
    """Format a fraction, rounded down: 100 % means all."""
    return "-" if fraction is None else f"{math.floor(1000 * fraction + 1e-9) / 10:.1f} %"


def _verification(station: Mapping[str, Any]) -> str:
    residual_rad = station.get("verification_rad")
    return "-" if residual_rad is None else f"{1e3 * residual_rad:.2f}"
