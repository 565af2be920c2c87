"""Texts from files of others, made safe for terminals, file names and spreadsheets.

A terminal acts upon control characters (ECMA-48): they move the cursor, change its title or hide
the text before them. Bidirectional overrides reorder what a reader sees (Unicode Standard Annex 9),
and characters without width make different names look alike.
"""

from __future__ import annotations

import re
import unicodedata

_HIDDEN_CATEGORIES = ("Cc", "Cf", "Cs", "Co", "Cn", "Zl", "Zp")
"""Categories of Unicode without a visible character of their own; blanks are ``Zs``."""

_FIRST_BYTE_SURROGATE = 0xDC00
"""``os.fsdecode`` maps byte ``b`` that is not UTF-8 to this plus ``b`` (PEP 383)."""

_NOT_IN_FILE_NAMES = frozenset('/\\:*?"<>|')
"""Characters that Linux, macOS or Windows do not allow in a file name."""

_DEVICE_NAME = re.compile(
    "(con|prn|aux|nul|(com|lpt)[0-9\u00b9\u00b2\u00b3]|con(in|out)\\$) *(?=[.]|$)", re.I
)
"""Names of devices of Windows, also with an ending, which opens the device. Source: Microsoft,
Naming Files, Paths, and Namespaces, https://learn.microsoft.com/windows/win32/fileio/naming-a-file."""

MAX_NAME_BYTES = 150
"""Longest part of a file name that is made of a text; most file systems allow 255 in all."""

_FORMULA_START = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""Beginnings of a cell that spreadsheets take for a formula, also those of full width."""


def escape_controls(text: str, *, keep: str = "") -> str:
    r"""Replace invisible characters by escapes such as ``\x1b`` and ``\u202e``, except ``keep``."""
    if text.isprintable():
        return text
    return "".join(_escape(c) if _is_hidden(c) and c not in keep else c for c in text)


def is_one_line(text: str) -> bool:
    """Return whether a text has no line end, also none that only Unicode defines."""
    return text.splitlines() in ([], [text])


def _is_hidden(character: str) -> bool:
    return unicodedata.category(character) in _HIDDEN_CATEGORIES


def _escape(character: str) -> str:
    code = ord(character)
    if _FIRST_BYTE_SURROGATE + 0x80 <= code <= _FIRST_BYTE_SURROGATE + 0xFF:
        code -= _FIRST_BYTE_SURROGATE
    if code <= 0xFF:
        return f"\\x{code:02x}"
    return f"\\u{code:04x}" if code <= 0xFFFF else f"\\U{code:08x}"


def file_name_part(text: str) -> str:
    """Return ``text`` as a part of a file name on any system.

    Characters that are invisible or not allowed become ``_``, as does a ``.`` or ``-`` at the
    beginning, which hides a file or looks like an option, and a ``.`` or blank at the end, which
    Windows removes. Names of its devices begin with ``_``. Long texts are cut.
    """
    name = "".join("_" if _is_hidden(c) or c in _NOT_IN_FILE_NAMES else c for c in text)
    if name[:1] in (".", "-"):
        name = "_" + name[1:]
    if _DEVICE_NAME.match(name):
        name = "_" + name
    name = name.encode()[:MAX_NAME_BYTES].decode(errors="ignore")
    if name[-1:] in (".", " ", ""):
        name = name[:-1] + "_"
    return name


def spreadsheet_text(text: str) -> str:
    """Return a text for a cell of CSV that no spreadsheet takes for a formula.

    A text that begins with ``=``, ``+``, ``-``, ``@``, a tab or a line end gets an apostrophe in
    front, as do texts that begin like a result of this function, so that
    :func:`text_of_spreadsheet` inverts it. Source: OWASP, CSV Injection,
    https://owasp.org/www-community/attacks/CSV_Injection.
    """
    return f"'{text}" if _FORMULA_START.match(text) else text


def text_of_spreadsheet(cell: str) -> str:
    """Return the text of a cell that :func:`spreadsheet_text` wrote."""
    return cell[1:] if cell.startswith("'") and _FORMULA_START.match(cell) else cell
