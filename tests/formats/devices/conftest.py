"""Frames that a Lighthouse deck sent."""

from __future__ import annotations

from typing import Any

import pytest

PUBLISHED_FRAMES = """
    1 5431ed 13d None     0 128aa
    0 543291 141    0 28992 1a639
    3 5436c4 147    0     0 1f5dc
    2 543769 140    0     0 026f3
    0 56bcd9 120 None     0 1b903
    1 56be78 110    0 70714 175a5
    2 56c094 113    0     0 05879
    3 56c21a 12a    0     0 1c094
    1 5b82f5 13f None     0 0debe
    0 5b8395 144    1 28992 11c42
    3 5b87c8 146    1     0 194c5
    2 5b8870 144    1     0 19e30
    0 5e0dcf 118 None     0 19864
    1 5e0f71 119    1 70711 1511f
    2 5e1189 113    1     0 0d239
    3 5e1314 127    1     0 08c31
"""
"""Sensor, TS, Width, polynomial of Mode, SyncTime and BeamWord: readme of bitcraze/lighthouse-fpga,
``print_frame.py``."""


@pytest.fixture
def published_frames() -> list[dict[str, Any]]:
    """Sixteen frames: sensor, tick, width, polynomial (None if unknown), offset and word."""
    frames = []
    for line in PUBLISHED_FRAMES.split("\n")[1:-1]:
        sensor, tick, width, polynomial, offset, word = line.split()
        frames.append(
            {
                "sensor": int(sensor),
                "tick": int(tick, 16),
                "width": int(width, 16),
                "polynomial": None if polynomial == "None" else int(polynomial),
                "offset": int(offset),
                "word": int(word, 16),
            }
        )
    return frames
