"""What one line of text is: numbers, names and values, names alone, telemetry, or words."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

from locatk.formats.devices.lines.columns import meaning

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
_MAY_TELL = re.compile(r"[_\[(]|(?i:seq|millis|micros)")
_VALUE = re.compile(rf":[ \t]*([+-]?{_DIGITS})".encode())
_CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")

BLANK = " "

LATEST_MS = 2.0**52
"""Times are below; in microseconds they still are whole numbers."""

_ALIKE = 256

_FEWEST_WORDS = 4
"""Words in a row that may be names though none of them looks like one."""


def separator(text: str) -> str:
    """What separates the cells of a line; blanks where nothing else does."""
    return next((one for one in (";", ",", "\t") if one in text), BLANK)


def cells(text: str, separated: str) -> list[str]:
    """Cells of a line, without the blanks around them."""
    if separated == BLANK:
        return text.split()
    return [cell.strip() for cell in text.split(separated)]


def columns(one: str, other: str) -> int | None:
    """How many columns two lines of numbers have, None where they disagree. A separator at the
    end is one too many, unless cells before it are empty as well."""
    counts, trailing = [], []
    for text in (one, other):
        separated = separator(text)
        row = cells(text, separated)
        counts.append(len(row))
        trailing.append(separated != BLANK and not row[-1] and bool(row[-2]))
    if counts[0] == counts[1]:
        return counts[0] - all(trailing)
    few, many = sorted(range(2), key=lambda i: counts[i])
    return counts[few] if counts[many] - trailing[many] == counts[few] else None


def number(cell: str) -> float:
    """A cell that is a number, as a number; ``nan`` where it is empty.

    Arduino prints ``ovf`` for what it cannot print.
    """
    return math.inf if cell.endswith("ovf") else float(cell or "nan")


def numbers(row: Sequence[str]) -> list[float] | None:
    """Numbers of a line, None where it is none of numbers."""
    if not all(map(_IS_NUMBER.fullmatch, row)):
        return None
    return [number(cell) for cell in row]


def pairs(text: str) -> tuple[tuple[str, ...], list[float]] | None:
    """Names and values of a line of ``name:value``, None where it is none."""
    separated = separator(text)
    if separated == BLANK:
        found = _words(text)
    else:
        row = text.split(separated)
        matches = [_PAIR.fullmatch(cell) for cell in (row if row[-1].strip() else row[:-1])]
        found = [(match[1], match[2]) for match in matches if match]
        if len(found) < len(matches):
            found = []
    names = tuple(name for name, _ in found)
    if not names or len(set(names)) < len(names):
        return None
    return names, [number(value) for _, value in found]


def _words(text: str) -> list[tuple[str, str]]:
    """Names and values that only blanks separate: none, or the whole line is of them."""
    found, at = [], 0
    while at < len(text):
        match = _PAIR_OF_WORDS.match(text, at)
        if match is None:
            whole = _PAIR.fullmatch(text)
            return [(whole[1], whole[2])] if whole else []
        found.append((match[1], match[2]))
        at = match.end()
    return found


def header(text: str, known: tuple[str, ...] = ()) -> tuple[str, ...] | None:
    """Names of columns, None where a line is none of names.

    Words in a row may as well be a message: they are names if they look like some. Where
    there are names already (``known``), others for as many columns must look so, too.
    """
    text = text.lstrip("#% ")
    separated = separator(text)
    row = [cell.strip("\"' ") for cell in cells(text, separated)]
    if row and not row[-1]:
        row = row[:-1]
    labels = len(row) > 1 and all(cell.endswith(":") for cell in row)
    names = tuple(cell.rstrip(": ") for cell in row) if labels else tuple(row)
    if not names or len(set(names)) < len(names) or not all(map(_IS_NAME.fullmatch, names)):
        return None
    if names == known or labels:
        return names
    few = len(names) < (_FEWEST_WORDS if separated == BLANK else 2)
    if few or len(names) == len(known):
        looks = all(map(_LIKE_A_NAME.search, names))
        if not looks and not (_MAY_TELL.search(text) and meaning(names).told):
            return None
    if any(name.count(" ") > 1 or name[-1] in ".!?" for name in names):
        return None
    return names


def garbage(text: str) -> bool:
    """Whether there are characters that nobody prints, or many bytes that are no UTF-8."""
    return _CONTROL.search(text) is not None or 8 * text.count("\ufffd") > len(text)


def damaged(row: Sequence[str], columns: int) -> bool:
    """Whether cells that are not all numbers, or names and numbers, were: most are and none of
    the others is a word, or half are of as many as there are ``columns``."""
    odd = [cell for cell in row if not (_IS_NUMBER.fullmatch(cell) or _PAIR.fullmatch(cell))]
    right = sum(map(bool, row)) - len(odd)
    if len(row) == columns and 2 * right >= columns:
        return right > 0
    return 2 * right > len(row) and not any(map(_IS_WORD.match, odd))


class Alike(Generic[T]):
    """Lines of names and values that were read before, so that one which differs in its
    numbers alone is read at once."""

    def __init__(self) -> None:
        self._known: dict[tuple[bytes, int], tuple[re.Pattern[bytes], T]] = {}

    def forget(self) -> None:
        """Forget them all."""
        self._known.clear()

    def learn(self, raw: bytes, values: Sequence[float], what: T) -> None:
        """Lines like ``raw``, in which colons lead to these ``values``, are ``what``."""
        parts = _VALUE.split(raw)
        if list(map(float, parts[1::2])) == list(values):
            if len(self._known) >= _ALIKE:
                self._known.clear()
            pattern = _VALUE.pattern.join(map(re.escape, parts[::2]))
            self._known[_label(raw)] = re.compile(pattern), what

    def read(self, raw: bytes) -> tuple[T, list[float]] | None:
        """What a line is, and its values; None where it is like none."""
        found = self._known.get(_label(raw))
        match = None if found is None else found[0].fullmatch(raw)
        return (found[1], list(map(float, match.groups()))) if found and match else None


def _label(raw: bytes) -> tuple[bytes, int]:
    """What tells lines of names and values apart, for the most part."""
    return raw[: raw.find(b":")], raw.count(b":")


class Telemetry(NamedTuple):
    """What a line of Teleplot says.

    Attributes
    ----------
    names : tuple of str
        Of the values of one point.
    points : list of (float or None, list of float)
        Milliseconds, where they are told, and values.
    text : str
        Words instead of points.
    drawing : bool
        A picture or a shape, of which nothing is taken.
    """

    names: tuple[str, ...]
    points: list[tuple[float | None, list[float]]]
    text: str = ""
    drawing: bool = False


_DRAWINGS = ("3D|", "JPG|", "PNG|")
_WIDTHS = {"xy": "xy", "xyz": "xyz"}


def telemetry(text: str) -> Telemetry | None:
    """What a line says that began with ``>``, which is taken off; None where it is damaged."""
    if text.startswith(_DRAWINGS):
        return Telemetry((), [], drawing=True)
    said, _, flag = text.rpartition("|") if "|" in text else (text, "", "")
    flags = flag.split(",")
    said, _, unit = said.partition("§")
    name, colon, values = said.partition(":")
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
        found = numbers([cell.strip() for cell in point.split(":")])
        if found is None or not len(names) <= len(found) <= len(names) + 1:
            if found is not None or _LIKE_A_NUMBER.match(point):
                return None
            return Telemetry((), [], text=f"{name}: {values.strip()}")
        time = found.pop(-1 if axes else 0) if len(found) > len(names) else None
        if time is not None and not 0 <= time < LATEST_MS:
            return None
        points.append((time, found))
    return Telemetry(names, points) if points else None
