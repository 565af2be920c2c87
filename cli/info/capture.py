"""What a live recording says of itself in its record ``capture``, as text for people."""

from __future__ import annotations

import re
from typing import Any

COUNTED = (
    ("bad", "bad frames"),
    ("lost", "missing frames"),
    ("unknown", "frames of unknown type"),
    ("skipped", "bytes in no frame"),
    ("gaps", "gaps"),
    ("gap_s", "s without connection"),
    ("silences", "silences"),
    ("overruns", "bytes overrun"),
    ("dropped", "frames of the camera dropped"),
    ("line_errors", "bytes with line errors"),
    ("clock_step_s", "s by which the wall clock was set"),
)
"""What should be zero, and the words for it."""

TOLD = {
    *("device", "port", "name", "part", "parts", "started_ns", "ended_ns", "ended", "note"),
    *("bytes", "frames", "high_water_bytes"),
    *(key for key, _ in COUNTED),
}
PREFIXES = ("samples", "meta", "tick_offset_s", "tick_drift_ppm", "tick_jitter_s", "tick_restarts")


def told(name: str, key: str) -> bool:
    """Whether an entry of the metadata is among the :func:`lines`, or in the table of streams."""
    prefix, colon, _ = key.partition(":")
    known = key in TOLD or (bool(colon) and prefix in PREFIXES)
    return name == "channels" or (name == "capture" and known)


def lines(found: dict[str, Any]) -> list[tuple[str, str]]:
    """How a recording came about, and what it missed: labels and words; ``found`` are the
    entries of the record, numbers as numbers."""
    if not found:
        return []
    whence = [found.get("device"), "port" in found and f"on {found['port']}"]
    words = [
        " ".join(str(each) for each in whence if each),
        f"as {found['name']}" if "name" in found else "",
        f"part {found['part']}" if "part" in found else "",
        f"of {found['parts']} parts" if "parts" in found else "",
        f"ended: {found['ended']}" if "ended" in found else "its end is not told",
    ]
    said = [("capture", ", ".join(each for each in words if each))]
    if any(isinstance(found.get(key), int) for key in ("bytes", "frames")):
        missed = [_counted(found[key], text) for key, text in COUNTED if _number(found, key)]
        if not found.get("frames") and found.get("device") not in (None, "raw"):
            missed.insert(0, f"no frame of {found['device']}")
        said += [("received", _received(found)), ("losses", ", ".join(missed) or "none")]
    said += [("clock", words) for words in _clocks(found)]
    meta = [
        f"{key.removeprefix('meta:')} = {value}"
        for key, value in found.items()
        if key.startswith("meta:")
    ]
    return [*said, ("note", str(found.get("note", ""))), ("meta", ", ".join(meta))]


def _counted(count: float, words: str) -> str:
    """``3 gaps``, ``1 gap``."""
    if count == 1:
        words = re.sub(r"\b(frame|byte|gap|silence)s\b", r"\1", words)
    return f"{count:g} {words}"


def _received(found: dict[str, Any]) -> str:
    duration = (_number(found, "ended_ns") - _number(found, "started_ns")) / 1e9
    amount, frames = _number(found, "bytes"), _number(found, "frames")
    timed = "started_ns" in found and "ended_ns" in found and duration > 0
    words = []
    if amount:
        rate = f" ({size(round(amount / duration))}/s)" if timed else ""
        words.append(f"{size(amount)}{rate}")
    if "frames" in found:
        rate = f" ({frames / duration:.4g}/s)" if timed else ""
        words.append(f"{frames} frames{rate}")
    if _number(found, "high_water_bytes"):
        words.append(f"at most {size(found['high_water_bytes'])} waited")
    return ", ".join(words)


def _clocks(found: dict[str, Any]) -> list[str]:
    """What is known of the clock of each node; one without a name is the only one."""
    nodes = dict.fromkeys(key.partition(":")[2] for key in found if key.startswith("tick_"))
    words = []
    for node in nodes:
        known = [
            f"{name} {found[key]} {unit}".rstrip()
            for prefix, name, unit in (
                ("tick_drift_ppm", "drift", "ppm"),
                ("tick_jitter_s", "95 % arrive within", "s"),
                ("tick_restarts", "restarts", ""),
            )
            if (key := f"{prefix}:{node}") in found
        ]
        words.append((f"{node}: " if node else "") + ", ".join(known))
    return words


def _number(found: dict[str, Any], key: str) -> Any:
    """The number under ``key``; 0 where there is none."""
    value = found.get(key)
    return value if isinstance(value, int | float) else 0


def size(count: float) -> str:
    """A number of bytes for people."""
    for unit, scale in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} byte{'' if count == 1 else 's'}"
