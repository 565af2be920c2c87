"""Text on the origin of a live recording, from its metadata record ``capture``."""

from __future__ import annotations

import re
from typing import Any

LOSSES = (
    ("bad", "bad frames"),
    ("lost", "missing frames"),
    ("unknown", "frames of unknown type"),
    ("skipped", "bytes outside of frames"),
    ("gaps", "gaps"),
    ("gap_s", "s without connection"),
    ("silences", "silences"),
    ("overruns", "bytes overrun"),
    ("dropped", "frames of the camera dropped"),
    ("line_errors", "bytes with line errors"),
    ("clock_step_s", "s by which the wall clock was set"),
)
"""Counters that should be zero, and their meaning."""

SHOWN_KEYS = {
    *("device", "port", "name", "part", "parts", "started_ns", "ended_ns", "ended", "note"),
    *("bytes", "frames", "high_water_bytes"),
    *(key for key, _ in LOSSES),
}
SHOWN_PREFIXES = (
    "samples",
    "meta",
    "tick_offset_s",
    "tick_drift_ppm",
    "tick_jitter_s",
    "tick_restarts",
)

BYTE_UNITS = (("GB", 1e9), ("MB", 1e6), ("kB", 1e3))


def is_shown(name: str, key: str) -> bool:
    """Return whether an entry of the metadata is in :func:`lines` or in the table of streams."""
    prefix, colon, _ = key.partition(":")
    known = key in SHOWN_KEYS or (bool(colon) and prefix in SHOWN_PREFIXES)
    return name == "channels" or (name == "capture" and known)


def lines(record: dict[str, Any]) -> list[tuple[str, str]]:
    """Format the origin and the losses of a recording as labels and texts.

    Parameters
    ----------
    record : dict
        Entries of the record, numbers as numbers.
    """
    if not record:
        return []
    device = [str(record["device"])] if record.get("device") else []
    device += [f"on {record['port']}"] if "port" in record else []
    origin = [
        " ".join(device),
        f"as {record['name']}" if "name" in record else "",
        f"part {record['part']}" if "part" in record else "",
        f"of {record['parts']} parts" if "parts" in record else "",
        f"ended: {record['ended']}" if "ended" in record else "end not recorded",
    ]
    result = [("capture", ", ".join(each for each in origin if each))]
    if any(isinstance(record.get(key), int) for key in ("bytes", "frames")):
        losses = [_counted(record[key], text) for key, text in LOSSES if _number(record, key)]
        if not record.get("frames") and record.get("device") not in (None, "raw"):
            losses.insert(0, f"no frame of {record['device']}")
        result += [("received", _received(record)), ("losses", ", ".join(losses) or "none")]
    result += [("clock", text) for text in _clocks(record)]
    meta = [
        f"{key.removeprefix('meta:')} = {value}"
        for key, value in record.items()
        if key.startswith("meta:")
    ]
    return [*result, ("note", str(record.get("note", ""))), ("meta", ", ".join(meta))]


def _counted(count: float, words: str) -> str:
    """Format ``3 gaps``, or ``1 gap``."""
    if count == 1:
        words = re.sub(r"\b(frame|byte|gap|silence)s\b", r"\1", words)
    return f"{count:g} {words}"


def _received(record: dict[str, Any]) -> str:
    """Format the amounts of data and their rates."""
    duration_s = (_number(record, "ended_ns") - _number(record, "started_ns")) / 1e9
    has_duration = "started_ns" in record and "ended_ns" in record and duration_s > 0
    bytes_, frames = _number(record, "bytes"), _number(record, "frames")
    words = []
    if bytes_:
        rate = f" ({size(round(bytes_ / duration_s))}/s)" if has_duration else ""
        words.append(f"{size(bytes_)}{rate}")
    if "frames" in record:
        rate = f" ({frames / duration_s:.4g}/s)" if has_duration else ""
        words.append(f"{frames} frames{rate}")
    if _number(record, "high_water_bytes"):
        words.append(f"at most {size(record['high_water_bytes'])} waited")
    return ", ".join(words)


def _clocks(record: dict[str, Any]) -> list[str]:
    """Format the clock of each node; a node without a name is the only one."""
    nodes = dict.fromkeys(key.partition(":")[2] for key in record if key.startswith("tick_"))
    texts = []
    for node in nodes:
        known = [
            f"{name} {record[key]} {unit}".rstrip()
            for prefix, name, unit in (
                ("tick_drift_ppm", "drift", "ppm"),
                ("tick_jitter_s", "95 % arrive within", "s"),
                ("tick_restarts", "restarts", ""),
            )
            if (key := f"{prefix}:{node}") in record
        ]
        texts.append((f"{node}: " if node else "") + ", ".join(known))
    return texts


def _number(record: dict[str, Any], key: str) -> Any:
    """Return the number under ``key``; 0 if there is none."""
    value = record.get(key)
    return value if isinstance(value, int | float) else 0


def size(count: float) -> str:
    """Format a number of bytes."""
    for unit, scale in BYTE_UNITS:
        if count >= scale:
            return f"{count / scale:.3g} {unit}"
    return f"{count} byte{'' if count == 1 else 's'}"
