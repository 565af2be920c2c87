"""Classification of one line of text: numbers, names with values, names, telemetry, or words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

from locatk.formats.devices.lines.columns import interpret_columns

T = TypeVar("T")

_DIGITS = r"(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_NUMBER = rf"[+-]?(?:{_DIGITS}|[nN][aA][nN]|[iI][nN][fF]|ovf)"
_NAME = r"[^\W\d][^:,;\t\"'=<>{}|]{0,63}"

_IS_NUMBER = re.compile(rf"(?:{_NUMBER})?")
_IS_NAME = re.compile(_NAME)
_PAIR = re.compile(rf" *({_NAME}?) *: *({_NUMBER}) *")
_PAIR_OF_WORDS = re.compile(rf"([^\W\d][^\s:,;]*)[ \t]*:[ \t]*({_NUMBER})(?:[ \t]+|$)")
_IS_WORD = re.compile(r"\$?[^\W\d](?!.*:.*[0-9])")
_LIKE_A_NUMBER = re.compile(r"[-+.]?[0-9]")
_LIKE_A_NAME = re.compile(r"[_\[]")
_MAY_HAVE_MEANING = re.compile(r"[_\[(]|(?i:seq|millis|micros)")
_VALUE = re.compile(rf":[ \t]*([+-]?{_DIGITS})".encode())
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")

BLANK = " "
"""Separator of cells that any number of blanks and tabs separate."""

MAX_TIME_MS = 2.0**52
"""Larger times are damaged; these are still whole numbers in microseconds."""

MAX_CACHED_LINES = 256

MAX_REPLACED_FRACTION = 1 / 8
"""Largest fraction of characters of a text that may be damaged UTF-8."""

MIN_HEADER_WORDS = 4
"""Words in a row that may be a header even if none of them looks like a name."""


def detect_separator(text: str) -> str:
    """Return the separator of the cells of a line: semicolon, comma, tab, otherwise blanks."""
    return next((character for character in (";", ",", "\t") if character in text), BLANK)


def split_cells(text: str, separator: str) -> list[str]:
    """Split a line into cells, without the blanks around them."""
    if separator == BLANK:
        return text.split()
    return [cell.strip() for cell in text.split(separator)]


def count_columns(text: str, other_text: str) -> int | None:
    """Return the number of columns of two lines of numbers; None if they disagree.

    A separator at the end adds no column, unless the cells before it are empty as well.
    """
    counts, trailing = [], []
    for line in (text, other_text):
        separator = detect_separator(line)
        row = split_cells(line, separator)
        counts.append(len(row))
        trailing.append(separator != BLANK and not row[-1] and bool(row[-2]))
    if counts[0] == counts[1]:
        return counts[0] - all(trailing)
    fewer, more = sorted(range(2), key=lambda i: counts[i])
    return counts[fewer] if counts[more] - trailing[more] == counts[fewer] else None


def parse_number(cell: str) -> float:
    """Return the number in a cell; ``nan`` if it is empty.

    Arduino prints ``ovf`` for numbers that it cannot print.
    """
    return math.inf if cell.endswith("ovf") else float(cell or "nan")


def parse_number_row(row: Sequence[str]) -> list[float] | None:
    """Return the numbers of a row; None if any cell is neither empty nor a number."""
    if not all(map(_IS_NUMBER.fullmatch, row)):
        return None
    return [parse_number(cell) for cell in row]


def parse_pairs(text: str) -> tuple[tuple[str, ...], list[float]] | None:
    """Return the names and values of a line of ``name:value``; None if it is not one."""
    separator = detect_separator(text)
    if separator == BLANK:
        pairs = _pairs_of_words(text)
    else:
        row = text.split(separator)
        matches = [_PAIR.fullmatch(cell) for cell in (row if row[-1].strip() else row[:-1])]
        pairs = [(match[1], match[2]) for match in matches if match]
        if len(pairs) < len(matches):
            pairs = []
    names = tuple(name for name, _ in pairs)
    if not names or len(set(names)) < len(names):
        return None
    return names, [parse_number(value) for _, value in pairs]


def _pairs_of_words(text: str) -> list[tuple[str, str]]:
    """Return the names and values of a line of pairs that only blanks separate; else none."""
    pairs, position = [], 0
    while position < len(text):
        match = _PAIR_OF_WORDS.match(text, position)
        if match is None:
            single = _PAIR.fullmatch(text)
            return [(single[1], single[2])] if single else []
        pairs.append((match[1], match[2]))
        position = match.end()
    return pairs


def parse_header(text: str, known: tuple[str, ...] = ()) -> tuple[str, ...] | None:
    """Return the names of columns; None if a line is not a header.

    Words in a row may also be a message: they are a header if they look like names. If columns
    have names already (``known``), names of as many other columns have to look so, too.
    """
    text = text.lstrip("#% ")
    separator = detect_separator(text)
    row = [cell.strip("\"' ") for cell in split_cells(text, separator)]
    if row and not row[-1]:
        row = row[:-1]
    are_labels = len(row) > 1 and all(cell.endswith(":") for cell in row)
    names = tuple(cell.rstrip(": ") for cell in row) if are_labels else tuple(row)
    if not names or len(set(names)) < len(names) or not all(map(_IS_NAME.fullmatch, names)):
        return None
    if names == known or are_labels:
        return names
    is_short = len(names) < (MIN_HEADER_WORDS if separator == BLANK else 2)
    if is_short or len(names) == len(known):
        look_like_names = all(map(_LIKE_A_NAME.search, names))
        has_meaning = _MAY_HAVE_MEANING.search(text) and interpret_columns(names).has_meaning
        if not look_like_names and not has_meaning:
            return None
    if any(name.count(" ") > 1 or name[-1] in ".!?" for name in names):
        return None
    return names


def is_garbage(text: str) -> bool:
    """Return whether a line has control characters, or many bytes that are not UTF-8."""
    replaced = text.count("\ufffd")
    return _CONTROL.search(text) is not None or replaced > MAX_REPLACED_FRACTION * len(text)


def is_damaged_row(row: Sequence[str], columns: int) -> bool:
    """Return whether a row of which not all cells are numbers was one of numbers.

    It was if most cells are numbers, or names with numbers, and none of the others is a word; or
    if half of them are and there are as many as ``columns``.
    """
    odd = [cell for cell in row if not (_IS_NUMBER.fullmatch(cell) or _PAIR.fullmatch(cell))]
    intact = sum(map(bool, row)) - len(odd)
    if len(row) == columns and 2 * intact >= columns:
        return intact > 0
    return 2 * intact > len(row) and not any(map(_IS_WORD.match, odd))


class PairLineCache(Generic[T]):
    """Patterns of lines of ``name:value``, so that a line with other numbers is read at once."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int], tuple[re.Pattern[bytes], T]] = {}

    def clear(self) -> None:
        """Forget all lines."""
        self._known.clear()

    def learn(self, raw: bytes, values: Sequence[float], target: T) -> None:
        """Remember that lines like ``raw``, in which colons precede ``values``, are ``target``."""
        parts = _VALUE.split(raw)
        if list(map(float, parts[1::2])) == list(values):
            if len(self._known) >= MAX_CACHED_LINES:
                self._known.clear()
            pattern = _VALUE.pattern.join(map(re.escape, parts[::2]))
            self._known[_label(raw)] = re.compile(pattern), target

    def read(self, raw: bytes) -> tuple[T, list[float]] | None:
        """Return the target and the values of a line; None if it is like none before."""
        known = self._known.get(_label(raw))
        match = None if known is None else known[0].fullmatch(raw)
        return (known[1], list(map(float, match.groups()))) if known and match else None


def _label(raw: bytes) -> tuple[bytes, int]:
    """Return the first name of a line and the number of its colons, which usually identify it."""
    return raw[: raw.find(b":")], raw.count(b":")


class Telemetry(NamedTuple):
    """Line of Teleplot.

    Attributes
    ----------
    names : tuple of str
        Names of the values of one point.
    points : list of (float or None, list of float)
        Milliseconds, if given, and values.
    text : str
        Words instead of points.
    is_drawing : bool
        True for a picture or a shape, which is ignored.
    """

    names: tuple[str, ...]
    points: list[tuple[float | None, list[float]]]
    text: str = ""
    is_drawing: bool = False


_DRAWINGS = ("3D|", "JPG|", "PNG|")


def parse_telemetry(text: str) -> Telemetry | None:
    """Parse a line of Teleplot without its leading ``>``; None if it is damaged."""
    if text.startswith(_DRAWINGS):
        return Telemetry((), [], is_drawing=True)
    content, _, flag = text.rpartition("|") if "|" in text else (text, "", "")
    flags = flag.split(",")
    content, _, unit = content.partition("§")
    name, colon, values = content.partition(":")
    name = name.partition(",")[0].strip()
    if not colon or not name:
        return Telemetry((), [], text=values.strip() if colon else text.strip())
    if "t" in flags:
        words = [point.rpartition(":")[2] if ":" in point else point for point in values.split(";")]
        return Telemetry((), [], text=f"{name}: {'; '.join(words)}")
    axes = next((flag for flag in flags if flag in ("xy", "xyz")), "")
    unit = f"[{unit.strip()}]" if unit.strip() else ""
    names = tuple(f"{name}.{axis}{unit}" for axis in axes) or (name + unit,)
    points = []
    for point in filter(None, (each.strip() for each in values.split(";"))):
        numbers = parse_number_row([cell.strip() for cell in point.split(":")])
        if numbers is None or not len(names) <= len(numbers) <= len(names) + 1:
            if numbers is not None or _LIKE_A_NUMBER.match(point):
                return None
            return Telemetry((), [], text=f"{name}: {values.strip()}")
        # The time is the first number of a point, but the last one of a point with axes.
        time_ms = numbers.pop(-1 if axes else 0) if len(numbers) > len(names) else None
        if time_ms is not None and not 0 <= time_ms < MAX_TIME_MS:
            return None
        points.append((time_ms, numbers))
    return Telemetry(names, points) if points else None
