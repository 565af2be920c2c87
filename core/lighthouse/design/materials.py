"""Bill of materials of a Lighthouse room."""

from __future__ import annotations

from locatk.core.materials import BillItem, Price

_SOURCE = "small quantities, Lighthouse paper, section I"

PUBLISHED_PRICES = {
    "base station": Price(200.0, "USD", "2024-05", _SOURCE),
    "photodiode": Price(2.30, "USD", "2024-05", _SOURCE),
    "front end": Price(1.20, "USD", "2024-05", _SOURCE),
}
"""Prices by part: "a basestation costs $200, with receiver diodes and front-end chips priced at
$2.30 and $1.20 respectively, in small quantities" (Alvarado-Marin et al., Lighthouse Localization
of Miniature Wireless Robots, DOI 10.1109/LRA.2024.3405345, section I)."""

MOUNTS = {
    "wall": "tilting wall bracket with a 1/4-20 UNC thread, screws and plugs for the wall",
    "ceiling": "tilting ceiling bracket with a 1/4-20 UNC thread, screws and plugs for the ceiling",
    "tripod": "light stand or tripod with a 1/4-20 UNC thread, weighted",
}
"""Mounts by kind. Stations have a thread for camera tripods, 1/4-20 UNC."""

PARTS = (
    "base station",
    *(f"{kind} mount" for kind in MOUNTS),
    "power extension",
    "photodiode",
    "front end",
)
"""Parts that can have a price."""


def bill_of_materials(
    mounts: dict[str, int], *, robots: int = 1, photodiodes: int = 1
) -> tuple[BillItem, ...]:
    """Return the parts of a room, with the prices of the paper.

    Parameters
    ----------
    mounts : dict of str to int
        Number of stations by kind of mount, ``"wall"``, ``"ceiling"`` or ``"tripod"``.
    robots : int
    photodiodes : int
        On each robot, each with a front end.
    """
    stations, receivers = sum(mounts.values()), robots * photodiodes
    items = [
        ("base station", stations, "SteamVR Base Station 2.0 (Lighthouse V2) with its supply"),
        *((f"{kind} mount", count, MOUNTS[kind]) for kind, count in mounts.items() if count),
        ("power extension", stations, "extension cord, or a mains socket near the station"),
        ("photodiode", receivers, "Osram BPW 32 S-Z, as in the paper"),
        ("front end", receivers, "Triad TS4231 light-to-digital converter"),
    ]
    return tuple(
        BillItem(part, count, detail, PUBLISHED_PRICES.get(part)) for part, count, detail in items
    )
